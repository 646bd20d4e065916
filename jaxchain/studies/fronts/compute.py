"""The numbers of the study `fronts`: measured with true dry friction, and predicted."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, ArrayLike

from jaxchain._statistics import student_reach
from jaxchain._types import State
from jaxchain.boundaries.grazing import nonsmooth_fold_belt_speed
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.localization.front_theory import (
    death_belt_speed,
    growth_coupling,
    single_cycle,
    spreading_speed,
)
from jaxchain.localization.fronts import depinning_belt_speed, read_speed
from jaxchain.model.chain import Chain
from jaxchain.model.initial_states import excited_block, excited_state
from jaxchain.model.parameters import PARAMETERS
from jaxchain.model.sliding import growth_rate
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.fronts import Fronts, FrontTrack
from jaxchain.result import Result
from jaxchain.scenes.values import array
from jaxchain.simulation.run import simulate
from jaxchain.studies._study import Job
from jaxchain.studies.fronts.table import Study
from jaxchain.sweeps.programs import map_lanes
from jaxchain.sweeps.sweeping import sweep

# Uniform noise on displacement and velocity of the masses that are excited.
NOISE = 0.1
# Where a window would be shorter, it would not hold a period.
_WINDOW, _WINDOWS = 6.6, 150
NUMBERS = ("speed", "error", "right", "left", "moved", "verdict")
PATTERNS = ["alternating", "in-phase"]
# Masses that a front passes before it is taken to have settled, and the share of the run at most.
_PASSED, _SHARE = 2.0, 0.2
_CURVE = 41
_EDGES = ("coupling", "edge", "pattern")


class BlockStart(eqx.Module):
    """A centred block as in eq. (8), signs alternating or alike, with a little noise inside.

    The quiet masses slide steadily: noise there would grow by itself below the Hopf speed.
    """

    block: int = eqx.field(static=True)

    def __call__(self, chain: Chain, seed: ArrayLike, in_phase: ArrayLike) -> State:
        x, v = excited_state(chain, self.block, block="centred")
        alike, _ = excited_state(chain, self.block, block="centred", pattern="in-phase")
        inside = excited_block(chain.n, self.block, "centred")
        keys = jax.random.split(jax.random.key(seed))
        shakes = [jax.random.uniform(key, (chain.n,), minval=-NOISE, maxval=NOISE) for key in keys]
        x = jnp.where(in_phase, alike, x) + jnp.where(inside, shakes[0], 0.0)
        return x, v + jnp.where(inside, shakes[1], 0.0)


def follow(
    chain: Chain,
    block: int,
    time: float,
    over: dict[str, Any],
    transient: Any,
    *,
    seeds: int = 1,
    **more: Any,
) -> xr.Dataset:
    """Speeds of the fronts of a block over the numbers in `over`, `pattern` and `seed`.

    **Arguments:** `transient`, a number or a data array over some of these; `more`, as for
    `sweep`.  **Returns:** `NUMBERS` and `result`.
    """
    data = sweep(
        chain, BlockStart(block), time, over={**over, "in_phase": [0, 1], "seed": range(seeds)},
        observe=FrontTrack(_windows(time)),
        **more,
    )  # fmt: skip
    codes = data["result"]
    waits = xr.zeros_like(codes, float) + transient
    fronts = [data[f"front_{name}"].values for name in ("right", "left", "count")]
    numbers = _read(chain.n, jnp.asarray(float(time)), codes.values, waits.values, *fronts)
    found = {name: (codes.dims, np.asarray(a)) for name, a in zip(NUMBERS, numbers, strict=True)}
    data = data[["result"]].assign(found).rename(in_phase="pattern")
    return data.assign_coords(pattern=PATTERNS).drop_vars("oscillator", errors="ignore")


def _windows(time: float) -> int:
    return min(int(time / _WINDOW), _WINDOWS)


@eqx.filter_jit
def _read(n: int, t1: Array, codes: Any, waits: Any, *fronts: Any) -> tuple[Array, ...]:
    def one(code: Array, wait: Array, *fronts: Array) -> tuple[Array, ...]:
        result = eqx.tree_at(lambda r: r._value, Result.successful, code)
        found = read_speed(Fronts(*fronts), n, 0.0, t1, wait, result)
        return tuple(getattr(found, name) for name in NUMBERS)

    return jnp.vectorize(one, signature="(),(),(w),(w),(w)->(),(),(),(),(),()")(
        codes, waits, *fronts
    )


def joined(parts: list[xr.Dataset], dim: str) -> xr.Dataset:
    """Runs of one seed each, in a row; attributes that differ are left out."""
    data: Any = xr.concat(parts, dim, combine_attrs="drop_conflicts")
    return data.isel(seed=0, drop=True)


def add_mean(data: xr.Dataset, over: tuple[str, ...]) -> xr.Dataset:
    """`data` with `mean_speed` of runs that differ in `over` only, and `mean_error`, its interval.

    The half-width is the greater of what the runs' own errors and what their scatter (Student's t
    at 95 %) say of the mean.
    """
    speed = data["speed"]
    count = speed.count(over)
    own = data["error"].mean(over) / np.sqrt(count)
    quantile = xr.apply_ufunc(lambda m: student_reach(0.95, np.maximum(m - 1, 1)), count)
    scatter = xr.where(count > 1, quantile * speed.std(over, ddof=1) / np.sqrt(count), 0.0)
    error = xr.where(scatter > own, scatter, own)
    return data.assign(mean_speed=speed.mean(over), mean_error=error)


def exponents(coupling: np.ndarray, speed: np.ndarray, error: np.ndarray) -> tuple[float, ...]:
    """(p, half-width at 95 %, number of points) of |speed| ~ coupling^p, by least squares.

    In logarithms, over the couplings at which the front moves for certain.
    """
    use = np.abs(speed) > error
    if use.sum() < 3:
        return np.nan, np.nan, float(use.sum())
    x, y = np.log(coupling[use]), np.log(np.abs(speed[use]))
    slope, offset = np.polyfit(x, y, 1)
    # From what is left over: 1 - r^2 would leave half the digits to a law that holds exactly.
    rest = y - slope * x - offset
    spread = np.sqrt((rest**2).sum() / (x.size - 2) / ((x - x.mean()) ** 2).sum())
    return float(slope), float(student_reach(0.95, x.size - 2) * spread), float(x.size)


def base_chain(study: Study, n: int, width: float | None = None) -> Chain:
    """The ring, or one mass alone, with dry friction unless there is a width."""
    coupling = None if n == 1 else study.base.coupling
    return study.base.chain(n, 1.5, width=width, coupling=coupling)


def _along(name: str, values: np.ndarray) -> tuple[str, np.ndarray, dict[str, str]]:
    """The coordinate `curve`, along which theory is drawn: values of a number of the chain."""
    return "curve", values, PARAMETERS[name].attrs


def growths(chain: Chain, speeds: Any) -> Array:
    """Growth rates of sliding at these belt speeds."""
    return jax.vmap(partial(growth_rate, chain))(jnp.asarray(speeds, float))


def spreading(chain: Chain, speeds: Any, coupling: float) -> np.ndarray:
    """Speed of linear spreading at these belt speeds, 0 where sliding is stable."""
    growth = jnp.maximum(growths(chain, speeds), 0.0)
    return np.asarray(spreading_speed(jnp.full(growth.shape, coupling), growth))


def transients(chain: Chain, speeds: np.ndarray, coupling: float, time: float) -> xr.DataArray:
    """How long fronts are left to settle: what `_PASSED` masses take at the greatest speed."""
    waits = np.minimum(_PASSED / spreading(chain, speeds, coupling), _SHARE * time)
    return xr.DataArray(waits, {"belt_speed": speeds}, "belt_speed")


def pictures(study: Study, job: Job) -> xr.Dataset:
    """Amplitude over mass and time of blocks that grow, stand and shrink."""
    del job
    part = study.pictures
    chain = base_chain(study, part.masses)

    @jax.jit
    @jax.vmap
    def watch(speed: jax.Array) -> jax.Array:
        own = chain.with_(belt_speed=speed)
        start = BlockStart(part.block)(own, 0, False)
        return simulate(
            own, start, part.time, observe=Amplitude(), segments=part.windows, rtol=study.rtol,
            throw=False,
        ).observed  # fmt: skip

    amplitude = np.asarray(watch(jnp.asarray(part.belt_speed)))
    return xr.Dataset(
        {"amplitude": (("belt_speed", "time", "oscillator"), amplitude)},
        coords={
            "belt_speed": part.belt_speed,
            "time": (np.arange(part.windows) + 0.5) * part.time / part.windows,
            "oscillator": np.arange(1, part.masses + 1),
        },
    )


def over_belt_speed(study: Study, job: Job) -> xr.Dataset:
    """Speeds of fronts over the belt speed, and that of linear spreading."""
    part, coupling = study.speed, study.base.coupling
    speeds = array(part.belt_speed)
    chain = base_chain(study, part.masses)
    waits = transients(chain, speeds, coupling, part.time)
    data = follow(
        chain, part.block, part.time, {"belt_speed": speeds}, waits, seeds=part.seeds,
        rtol=study.rtol, progress=job.progress, description="belt speed",
    )  # fmt: skip
    curve = np.linspace(speeds.min(), float(hopf_belt_speed(chain)), _CURVE)
    data["spreading"] = ("curve", spreading(chain, curve, coupling))
    return add_mean(data, ("pattern", "seed")).assign_coords(curve=_along("belt_speed", curve))


def over_coupling(study: Study, job: Job) -> xr.Dataset:
    """Speeds over the coupling, exponents, and linear spreading below the Hopf speed."""
    part = study.coupling
    chain, speeds = base_chain(study, part.masses), np.asarray(part.belt_speed)
    parts = []
    for coupling in part.coupling:
        time = float(np.clip(part.per_coupling / coupling, 400.0, part.time))
        over = {"belt_speed": speeds, "coupling": [coupling]}
        waits = transients(chain, speeds, coupling, time)
        parts.append(
            follow(
                chain, part.block, time, over, waits, rtol=study.rtol, progress=job.progress,
                description=f"coupling {coupling:g}",
            )
        )  # fmt: skip
    data = add_mean(joined(parts, "coupling"), ("pattern",))
    found = xr.apply_ufunc(
        exponents, data["coupling"], data["mean_speed"], data["mean_error"], vectorize=True,
        input_core_dims=[["coupling"]] * 3, output_core_dims=[[]] * 3,
    )  # fmt: skip
    data = data.assign(dict(zip(("exponent", "exponent_error", "points"), found, strict=True)))
    curve = np.geomspace(min(part.coupling), max(part.coupling), _CURVE)
    growth = growths(chain, speeds)
    spread = [spreading_speed(jnp.asarray(curve), jnp.full(_CURVE, g)) for g in growth]
    return data.assign(spreading=(("belt_speed", "curve"), np.asarray(spread), {})).assign_coords(
        curve=_along("coupling", curve)
    )


def pinning(study: Study, job: Job) -> xr.Dataset:
    """Where fronts come unstuck, over the coupling, and what is predicted.

    `stands` and `moves` (coupling, edge, pattern) enclose it: a front moves if it gains or loses a
    mass between a fifth of the time and its end.
    """
    part, couplings = study.pinning, np.asarray(study.pinning.coupling)

    def edge(chain: Chain, coupling: Any, moves: Any, in_phase: Any) -> tuple[Array, Array]:
        found = depinning_belt_speed(
            chain.with_(coupling=coupling), lambda own: BlockStart(part.block)(own, 0, in_phase),
            part.time, stands=part.stands, moves=moves, halvings=part.halvings,
            transient=_SHARE * part.time, windows=_windows(part.time), rtol=study.rtol,
        )  # fmt: skip
        return found.stands, found.moves

    over = np.meshgrid(couplings, [part.lowest, part.highest], [False, True], indexing="ij")
    share = -(-over[0].size // len(jax.local_devices()))
    with job.bar(total=over[0].size, unit="edge") as bar:
        found = map_lanes(
            edge, base_chain(study, part.masses), [a.ravel() for a in over], lanes=share,
            done=bar.update,
        )  # fmt: skip
    stands, moves = (xr.Variable(_EDGES, own.reshape(over[0].shape)) for own in found)
    data = xr.Dataset(
        {"stands": stands, "moves": moves},
        coords={"coupling": couplings, "edge": ["grows", "shrinks"], "pattern": PATTERNS},
    )
    return data.merge(predicted(base_chain(study, 1), part.highest))


def predicted(chain: Chain, highest: float) -> xr.Dataset:
    """The edges as the theory of fronts has them; `chain` is one mass.

    `growth_coupling` over belt speeds (`curve`) between v_H and `highest` for two phases
    (`cosine`), and `death_belt_speed` over `death_coupling`.
    """
    speeds = np.linspace(float(hopf_belt_speed(chain)) + 0.01, highest, _CURVE)
    cosines = np.array([0.0, -1.0])

    @eqx.filter_jit
    @jax.vmap
    def growing(speed: Array) -> tuple[Array, Array, Array]:
        own = chain.with_(belt_speed=speed)
        detuning, amplitude = single_cycle(own)
        each = [growth_coupling(own, detuning, amplitude, cosine) for cosine in cosines]
        return jnp.stack(each), detuning, amplitude

    threshold, detuning, amplitude = growing(jnp.asarray(speeds))
    couplings = np.geomspace(1e-3, 0.05, _CURVE)
    # Where masses die the detuning hardly depends on the belt speed.
    late = float(np.interp(0.93 * highest, speeds, np.asarray(detuning)))
    death = jax.jit(
        jax.vmap(lambda eta: death_belt_speed(chain, eta, late, nonsmooth_fold_belt_speed))
    )
    return xr.Dataset(
        {
            "growth_coupling": (("curve", "cosine"), np.asarray(threshold)),
            "detuning": ("curve", np.asarray(detuning)),
            "cycle_amplitude": ("curve", np.asarray(amplitude)),
            "death_belt_speed": ("death_coupling", np.asarray(death(jnp.asarray(couplings)))),
        },
        coords={
            "curve": _along("belt_speed", speeds), "cosine": cosines, "death_coupling": couplings,
        },
    )  # fmt: skip


def convergence(study: Study, job: Job) -> xr.Dataset:
    """The same speeds on other rings and with smoothed friction: dimension `case`."""
    part = study.convergence
    speeds = np.asarray(part.belt_speed)
    cases = [(part.masses, 0.0)] + [(n, 0.0) for n in part.other_masses]
    cases += [(part.masses, width) for width in part.width]
    waits = transients(base_chain(study, 1), speeds, study.base.coupling, part.time)
    parts = [
        follow(
            base_chain(study, n, width or None), round(part.block * n / part.masses), part.time,
            {"belt_speed": speeds}, waits, rtol=study.rtol,
            progress=job.progress, description=f"{n} masses, width {width:g}",
        )
        for n, width in cases
    ]  # fmt: skip
    data = add_mean(joined(parts, "case"), ("pattern",))
    masses, widths = zip(*cases, strict=True)
    return data.assign_coords(masses=("case", list(masses)), width=("case", list(widths)))
