"""Periodic orbits closed by Newton's method with any solver, also with true dry friction.

`find_limit_cycle` is the better tool: for smoothed friction in coordinates that suit it, for dry
friction by what stands here, and with derivatives of the orbit.  Here the state itself is the
unknown, and the derivative is that of the run, with its saltation at sticking and release if the
solver is `EventDriven`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float, Int

from .._checks import to_float
from .._final import final
from .._types import State
from ..continuation.damped_newton import Factors, factorise
from ..continuation.implicit import attach_derivative
from ..model.chain import Chain
from ..model.oscillators import AbstractOscillators
from ..observers.amplitude import Amplitude
from ..observers.base import Step
from ..observers.section import AbstractSection
from ..observers.stick_time import MostSticking
from ..result import SearchResult
from ..simulation.accuracy import own_solver
from ..simulation.event_driven import EventDriven
from ..simulation.run import simulate
from ..solvers.dry_friction import start as on_the_belt
from .floquet import as_orbit, check_orbit, floquet_multipliers, multiplier_resolution
from .least_period import Returned, Returns, close_orbit_once, greatest_gap
from .limit_cycle import LEAST_VELOCITY, LimitCycle, can_be_cycle, is_trusted
from .variational import Along

# Integrations at most, and the step that is rounding.
_MOST, _FINE = 8, 1e-13
# What may be left of the return, compared with the size of the orbit, where it is closed.
_CLOSED = 1e-6


@final
class ClosedOrbit(NamedTuple):
    """A periodic orbit, or the attempt at one.

    - `state` and `period`, the least one; `gap`, the greatest component of what is left of the
      return, infinite where no cycle of the chain is so fast or has so short a period;
      `distance`, of how far the iteration went from where it began (of the period, that of
      one time round).
    - `multipliers`: the Floquet multipliers but the trivial one, greatest modulus first.  With
      true dry friction as many, the last ones, are exactly 0 as masses ever stick together; NaN
      are others that are not told from zero, of a modulus below `resolution`, as sticking makes
      them in smoothed friction.
    - `defect`: |M f - f| / |f|, what the trivial one's vector misses, and any other may;
      `resolution`: that, or rounding.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.cycles import close_orbit
        >>> from jaxchain.model import on_the_belt
        >>> chain = paper_chain(n=1, belt_speed=1.5, width=None)
        >>> orbit = close_orbit(chain, on_the_belt(chain), 6.3)
        >>> bool(orbit.gap < 1e-8), round(float(orbit.period), 4)
        (True, 6.3163)
        >>> orbit.multipliers.tolist(), orbit.exponents.tolist()  # sticking forgets everything
        ([0j], [-inf])
    """

    state: State
    period: Float[Array, ""]
    gap: Float[Array, ""]
    distance: Float[Array, ""]
    multipliers: Complex[Array, " others"]
    defect: Float[Array, ""]
    resolution: Float[Array, ""]

    @property
    def exponents(self) -> Float[Array, " others"]:
        """ln |multiplier| / period; -inf for what sticking annihilates, NaN if not resolved."""
        return jnp.log(jnp.abs(self.multipliers)) / self.period

    @property
    def highest_exponents(self) -> Float[Array, " others"]:
        """`exponents`, and what those that are not resolved lie below."""
        below = jnp.log(self.resolution) / self.period
        return jnp.where(jnp.isnan(self.multipliers), below, self.exponents)


def close_orbit(
    chain: Any,
    state: Any = None,
    period: Any = None,
    *,
    solver: Any = None,
    rtol: Any = 1e-9,
) -> ClosedOrbit:
    """The periodic orbit near a state that nearly comes back after `period`, by Newton's method.

    Solves flow(y, T) = y with the correction at right angles to the orbit:

        [[M - 1, f], [f^T, 0]] (dy, dT) = (y - flow(y, T), 0),    f = d flow / dT,

    with at most 8 integrations.  A mass that sticks at the start does so afterwards.  An orbit
    that has come back after a share of `period` (up to 16 times round) is closed again with this
    share.

    **Arguments:** a `LimitCycle` alone; or a chain, `state` = (x, v), both of shape (n,), and
    `period` > 0.  `solver` and `rtol` as for `simulate`.

    **Returns:** `ClosedOrbit`; look at its `gap` and `distance` before anything else.  Works
    under `jit` and `vmap`.

    **Raises:** `ValueError` for bad input.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.cycles import close_orbit
        >>> start = jnp.array([2.2]), jnp.zeros(1)
        >>> orbit = close_orbit(paper_chain(n=1, belt_speed=1.5, width=None), start, 6.26)
        >>> bool(orbit.gap < 1e-8), orbit.multipliers.tolist()  # 0: it sticks
        (True, [0j])
    """
    chain, state, period = as_orbit(chain, state, period)
    x, v = check_orbit(chain, state, period, rtol)
    return _close(chain, (x, v), to_float(period), own_solver(chain, solver), rtol)


class _Way(NamedTuple):
    """What a run tells besides its end."""

    slopes: Float[Array, "two_n m"]  # of the state at the end, in (x, v, T)
    returned: Returned
    sticking: Int[Array, ""]  # how many masses ever stick together, dry


@eqx.filter_jit
def _close(
    chain: AbstractOscillators, state: State, period: Array, solver: Any, rtol: Any
) -> ClosedOrbit:
    start = jnp.concatenate([*state, period[None]])
    n = state[0].shape[0]

    observe: dict[str, Any] = {"returned": Returns()}
    if isinstance(solver, EventDriven):
        observe["sticking"] = MostSticking()

    def flow(u: Array) -> tuple[Array, tuple[Array, Returned, Array]]:
        run = simulate(
            chain, (u[:n], u[n:-1]), u[-1], observe=observe, solver=solver, rtol=rtol,
            throw=False,
        )  # fmt: skip
        end, seen = jnp.concatenate(run.state), run.observed
        return end, (end, seen["returned"], seen.get("sticking", jnp.zeros((), int)))

    weights = jnp.full(start.shape, start.shape[0] ** -0.5)

    def linearise(u: Array) -> tuple[Array, Factors, _Way]:
        slopes, (end, returned, sticking) = jax.jacfwd(flow, has_aux=True)(u)
        f = slopes[:, -1]
        matrix = jnp.block(
            [
                [slopes[:, :-1] - jnp.eye(2 * n) + _free_phases(chain, f), f[:, None]],
                [f[None], jnp.zeros((1, 1))],
            ]
        )
        way = _Way(slopes, returned, sticking)
        return jnp.append(end - u[:-1], 0.0), factorise(matrix, weights), way

    best = close_orbit_once(
        linearise, start, weights, limit=_MOST, fine=_FINE,
        closed=lambda now: greatest_gap(now) <= _CLOSED * now.aux.returned.farthest,
        state_at=lambda u: (u[:n], u[n:-1]),
        shortened=lambda u, times: u.at[-1].divide(times),
    )  # fmt: skip
    failed = jnp.where(jnp.isfinite(best.length), 0.0, jnp.nan)
    u, slopes = best.u + failed, best.aux.slopes + failed
    possible = can_be_cycle(chain, u[-1], jnp.abs(u[n:-1]))
    gap = jnp.where(possible, greatest_gap(best), jnp.inf) + failed
    once = start.at[-1].divide(jnp.maximum(jnp.round(period / u[-1]), 1.0))
    found = floquet_multipliers(slopes[:, :-1], slopes[:, -1])
    resolution = jnp.maximum(found.defect, multiplier_resolution(slopes[:, :-1]))
    multipliers = jnp.where(jnp.abs(found.multipliers) < resolution, jnp.nan, found.multipliers)
    # Velocities of masses that stick together are all that of the belt.
    kept = jnp.arange(2 * n - 1) < 2 * n - 1 - best.aux.sticking
    multipliers = jnp.where(kept | ~jnp.isfinite(found.multipliers), multipliers, 0.0)
    return ClosedOrbit(
        (u[:n], u[n:-1]), u[-1], gap, jnp.max(jnp.abs(u - once)), multipliers,
        found.defect, resolution,
    )  # fmt: skip


def _free_phases(chain: AbstractOscillators, f: Float[Array, " two_n"]) -> Array:
    """sum_n f_n f_n^T / |f_n|^2, f_n the part of f of mass n, if masses are not coupled, else 0.

    Their phases are free, M f_n = f_n for each of them: without this M - 1 is singular.
    """
    n = f.shape[0] // 2
    if n == 1 or not chain.structured:
        return jnp.zeros(())
    parts = jnp.concatenate([jnp.diag(f[:n]), jnp.diag(f[n:])])  # column n is f_n
    sizes = jnp.sum(parts**2, axis=0)
    free = (parts / jnp.where(sizes > 0, sizes, 1.0)[None]) @ parts.T
    return free if chain.springs is None else jnp.all(chain.springs.constant == 0) * free


def dry_limit_cycle(
    chain: Chain, mass: int, state: State, period: Any, *, rtol: Any, tolerance: Any
) -> LimitCycle:
    """The cycle of a dry chain near a guess, cut where mass `mass` is let go, or is fastest.

    Derivatives as in `find_limit_cycle`.
    """
    frozen = lax.stop_gradient(chain)
    state, period = lax.stop_gradient((state, to_float(period)))
    cycle = _dry_cycle(frozen, mass, state, period, to_float(rtol), to_float(tolerance))
    unknowns = jnp.concatenate([*cycle.state, cycle.period[None], cycle.amplitude])
    equations = jax.tree_util.Partial(_dry_residual, mass)
    unknowns = attach_derivative(equations, unknowns, (chain, to_float(rtol)))
    x, v, period, amplitude = _parts(unknowns)
    return eqx.tree_at(
        lambda c: (c.chain, c.state, c.period, c.amplitude),
        cycle,
        (chain, (x, v), period, amplitude),
    )


@eqx.filter_jit
def _dry_cycle(
    chain: Chain, mass: int, state: State, period: Array, rtol: Array, tolerance: Array
) -> LimitCycle:
    orbit = close_orbit(chain, state, period, rtol=rtol)
    # A little more, for an orbit that begins there.
    watch = _Cuts(mass, 1, of="velocity")
    cut = simulate(
        chain, orbit.state, 1.05 * orbit.period, observe=watch, rtol=rtol, throw=False
    ).observed
    state, _ = on_the_belt(chain, (cut[1][0], cut[2][0]))
    run = simulate(chain, state, orbit.period, observe=Along(), rtol=rtol, throw=False)
    amplitude, fastest, _ = run.observed
    gap = jnp.concatenate(run.state) - jnp.concatenate(state)
    residual = jnp.max(jnp.abs(gap)) / fastest[mass]
    closed = (residual <= tolerance) & is_trusted(orbit.multipliers, orbit.defect)
    rests = closed & (fastest[mass] <= LEAST_VELOCITY)
    result = SearchResult.where(closed, SearchResult.successful, SearchResult.no_step_helps)
    result = SearchResult.where(rests, SearchResult.at_rest, result)
    result = SearchResult.where(jnp.isfinite(residual), result, SearchResult.nonfinite)
    result = SearchResult.where(jnp.isinf(orbit.gap), SearchResult.ran_away, result)
    return LimitCycle(
        chain=chain,
        state=state,
        period=orbit.period,
        residual=residual,
        result=result,
        multipliers=orbit.multipliers,
        trivial_defect=orbit.defect,
        liouville_defect=jnp.full_like(orbit.defect, jnp.nan),
        amplitude=amplitude,
        fastest=fastest,
        evaluations=jnp.asarray(_MOST),
        mass=mass,
    )


class _Cuts(AbstractSection):
    """States in which a mass that slides behind the belt is fastest, or is let go by the belt."""

    def _slope(self, step: Step, t: Any, y: State) -> Array:
        del t
        field: Any = step.field
        return field.belt_direction() * _slipping(field, *y)[self.oscillator]


def _slipping(chain: Chain, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
    """v' of masses that slide behind the belt; 0 where one is let go, r = -p mu_st."""
    pull = chain.load * chain.law.coefficient(jnp.abs(v - chain.belt_speed))
    return chain.free_force(x, v) + chain.belt_direction() * pull


def _parts(unknowns: Float[Array, " m"]) -> tuple[Array, Array, Array, Array]:
    """(x, v, period, amplitudes), 3 n + 1 numbers in all."""
    n = unknowns.shape[0] // 3
    return unknowns[:n], unknowns[n : 2 * n], unknowns[2 * n], unknowns[2 * n + 1 :]


def _dry_residual(
    mass: int, unknowns: Float[Array, " m"], parameters: tuple[Chain, Array]
) -> Float[Array, " m"]:
    """What is left of the return, of the section, and of the amplitudes."""
    chain, rtol = parameters
    x, v, period, amplitude = _parts(unknowns)
    run = simulate(chain, (x, v), period, observe=Amplitude(), rtol=rtol, throw=False)
    section = _slipping(chain, x, v)[mass]
    return jnp.concatenate(
        [run.state[0] - x, run.state[1] - v, section[None], run.observed - amplitude]
    )
