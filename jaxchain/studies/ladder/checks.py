"""Second looks at the branches of the study `ladder`: is each point a cycle, and is it stable?"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Complex, Float

from jaxchain.cycles.floquet import monodromy_matrix
from jaxchain.cycles.search import find_limit_cycle
from jaxchain.cycles.variational import flow
from jaxchain.model.chain import Chain
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.quantities import active, energy
from jaxchain.observers.section import PeakTimes
from jaxchain.simulation.accuracy import fit_linear_solve
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.solvers.rosenbrock import Rodas5P
from jaxchain.studies._study import from_rows
from jaxchain.studies.ladder.branches import ring
from jaxchain.studies.ladder.table import Study

# Ten times finer than branches are followed with.
_FINE_RTOL = 1e-11
_KICK = 1e-6
_ORBIT = ("belt_speed", "x", "v", "period")
# A disturbance is followed while it is neither rounding nor large, relative to the orbit.
_LEAST, _MOST = 3e-9, 1e-4
# At the end of a run: time that is looked at, and the most maxima in it.
_LAST, _PEAKS = 100.0, 24
_NOTHING: Any = ((), ())


def closing_errors(
    chain: Chain, data: xr.Dataset, rtol: float = _FINE_RTOL
) -> Float[np.ndarray, " point"]:
    """The gap of each point of a branch after its period, integrated with tolerance `rtol`.

    The greatest over all masses of |x_1 - x| and |v_1 - v| / (w^2 + eps^2)^(1/2), over the
    greatest velocity of the state: what the shooting equations are.
    """
    orbits = zip(*(data[key].values for key in _ORBIT), strict=True)
    tolerance = jnp.asarray(rtol)
    return np.array([float(_gap(chain, tolerance, *map(jnp.asarray, o))) for o in orbits])


@eqx.filter_jit
def _gap(
    chain: Chain, rtol: Array, speed: Array, x: Array, v: Array, period: Array
) -> Float[Array, ""]:
    x1, v1 = _after(chain.with_(belt_speed=speed), (x, v), period, rtol)
    layer = jnp.hypot(v - speed, chain.width)
    gap = jnp.maximum(jnp.max(jnp.abs(x1 - x)), jnp.max(jnp.abs(v1 - v) / layer))
    return gap / jnp.max(v)


def _after(chain: Chain, state: Any, period: Array, rtol: Any = _FINE_RTOL) -> Any:
    solver = fit_linear_solve(Rodas5P(), chain, _FINE_RTOL)
    return flow(chain, state, period, rtol=jnp.asarray(rtol), solver=solver)[0]


def draw_lots(branches: dict[str, xr.Dataset], count: int) -> list[tuple[str, int]]:
    """`count` of all points of all branches, by a lot that is the same each time."""
    every = [(key, i) for key, data in branches.items() for i in range(data.sizes["point"])]
    lot = np.random.default_rng(11).permutation(len(every))[:count]
    return [every[i] for i in np.sort(lot)]


def disturbed(study: Study, branches: dict[str, xr.Dataset]) -> xr.Dataset:
    """Whether disturbances grow as the multipliers say, of orbits drawn by lot.

    A random disturbance of size 1e-6 is added to the orbit, which is closed once more with a
    finer tolerance, and the part of it along the leading multiplier mu is watched from period to
    period: with the left eigenvector l of M, |l . (y - y_orbit)| goes as |mu|^p.

    **Returns:** for each orbit: `multiplier` = |mu|, `measured`, the same from the run (NaN if it
    leaves the range of a linear disturbance at once), `periods`, from how many, and `shift`, by
    how much the period changed as the orbit was closed with the finer tolerance.
    """
    chain, checks = ring(study), study.checks
    lot = draw_lots(branches, checks.orbits)
    rows = []
    kicks = np.random.default_rng(7).normal(size=(len(lot), 2 * chain.n))
    for (key, i), kick in zip(lot, kicks, strict=True):
        data = branches[key].isel(point=i)
        own = chain.with_(belt_speed=float(data["belt_speed"]))
        orbit = find_limit_cycle(
            own, (jnp.asarray(data["x"].values), jnp.asarray(data["v"].values)),
            period=float(data["period"]), vibrating=int(data.attrs["mass"]), rtol=_FINE_RTOL,
            tolerance=1e-8, throw=False,
        )  # fmt: skip
        left, size = _leading(own, orbit.state, orbit.period)
        sizes = _watch(
            own, orbit.state, orbit.period, jnp.asarray(kick / np.linalg.norm(kick)), left,
            checks.periods,
        )  # fmt: skip
        measured, count = _rate(np.asarray(sizes))
        rows.append(
            {
                "branch": key, "point": i, "belt_speed": float(data["belt_speed"]),
                "unstable": int(data["unstable"]), "multiplier": size, "measured": measured,
                "periods": count, "residual": float(orbit.residual),
                "shift": abs(float(orbit.period) - float(data["period"])),
            }
        )  # fmt: skip
    return from_rows(rows, "orbit")


def _leading(chain: Chain, state: Any, period: Any) -> tuple[Complex[Array, " m"], float]:
    """The left eigenvector of the leading nontrivial multiplier, and its modulus."""
    M = np.asarray(monodromy_matrix(chain, state, period, rtol=_FINE_RTOL))
    f = np.concatenate(chain(0.0, state))
    mu, lefts = np.linalg.eig(M.T)
    # The trivial one is the one whose left eigenvector is not square to the flow.
    share = np.abs(lefts.T @ f) / np.linalg.norm(f) / np.linalg.norm(lefts, axis=0)
    trivial = int(np.argmax(share - np.abs(mu - 1.0)))
    best = max((i for i in range(len(mu)) if i != trivial), key=lambda i: abs(mu[i]))
    return jnp.asarray(lefts[:, best]), float(abs(mu[best]))


@eqx.filter_jit
def _watch(
    chain: Chain, state: Any, period: Array, kick: Array, left: Array, periods: int
) -> Float[Array, " p"]:
    """|l . (y - y_orbit)| after 0, 1, 2, ... periods."""
    n = chain.n
    home = jnp.concatenate(state)

    def after(y: Array, _: None) -> tuple[Array, Array]:
        end = _after(chain, (y[:n], y[n:]), period)
        return jnp.concatenate(end), jnp.abs(left @ (y - home))

    return jax.lax.scan(after, home + _KICK * kick, None, length=periods)[1]


def _rate(sizes: Float[np.ndarray, " p"]) -> tuple[float, int]:
    """(growth per period by least squares of the logarithm, over how many periods)."""
    good = np.isfinite(sizes) & (sizes > _LEAST) & (sizes < _MOST)
    # The first piece without a gap, less its beginning, where other disturbances still fade.
    last = int(np.argmin(good)) if not good.all() else good.size
    first = min(2, last // 4)
    if last - first < 3:
        return np.nan, 0
    p = np.arange(first, last)
    return float(np.exp(np.polyfit(p, np.log(sizes[first:last]), 1)[0])), last - first


def dry_runs(study: Study, branches: dict[str, xr.Dataset]) -> xr.Dataset:
    """Runs with true dry friction from stable cycles of the smoothed law, drawn by lot.

    **Returns:** for each: `energy`, `period`, and those of the smoothed cycle,
    `energy_smoothed`, `period_smoothed`; `spread`, by how much the times between maxima differ
    among themselves, which is zero for a periodic motion.
    """
    chain, checks = ring(study), study.checks
    stable = {
        key: data.isel(point=np.flatnonzero(data["unstable"].values == 0))
        for key, data in branches.items()
    }
    lot = draw_lots(stable, checks.dry)
    picked = [stable[key].isel(point=i) for key, i in lot]
    speeds, x, v = (
        jnp.asarray(np.reshape([p[name].values for p in picked], (-1, *shape)))
        for name, shape in (("belt_speed", ()), ("x", (chain.n,)), ("v", (chain.n,)))
    )
    t1 = checks.dry_time
    observe = [Amplitude(window=_LAST), PeakTimes(capacity=_PEAKS, start=t1 - _LAST)]

    @jax.jit
    @jax.vmap
    def run(speed: Array, x: Array, v: Array) -> Any:
        own = chain.with_(belt_speed=speed)
        end = simulate(
            own, (x, v), t1, observe=observe, solver=EventDriven(), rtol=1e-8, throw=False
        )
        return end.observed

    amplitude, times = run(speeds, x, v) if lot else _NOTHING
    rows = []
    for (key, _), own, heights, peaks in zip(lot, picked, amplitude, times, strict=True):
        vibrates = active(heights, float(own["belt_speed"]))
        gaps: Any = np.diff(np.asarray(peaks[:, vibrates]), axis=0)
        gaps = gaps[np.isfinite(gaps)]
        known = gaps.size > 0
        rows.append(
            {
                "branch": key, "belt_speed": float(own["belt_speed"]),
                "energy": float(energy(heights)), "energy_smoothed": float(own["energy"]),
                "period": float(np.mean(gaps)) if known else np.nan,
                "period_smoothed": float(own["period"]),
                "spread": float(np.ptp(gaps)) if known else np.nan,
            }
        )  # fmt: skip
    return from_rows(rows, "orbit")
