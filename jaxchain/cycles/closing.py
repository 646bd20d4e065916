"""Periodic orbits closed by Newton's method with any solver, also with true dry friction.

`find_limit_cycle` is the better tool for smoothed friction, in coordinates that suit it; here the
state itself is the unknown, and the derivative is that of the run, with its saltation at sticking
and release if the solver is `EventDriven`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

from .._checks import to_float
from .._types import State
from ..continuation.damped_newton import Factors, factorise
from ..model.oscillators import AbstractOscillators
from ..observers.stick_time import MostSticking
from ..simulation.event_driven import EventDriven
from ..simulation.run import simulate
from .floquet import check_orbit, floquet_multipliers, multiplier_resolution
from .least_period import Returned, Returns, close_orbit_once, greatest_gap

# Integrations at most, and the step that is rounding.
_MOST, _FINE = 8, 1e-13
# What may be left of the return, compared with the size of the orbit, where it is closed.
_CLOSED = 1e-6


class ClosedOrbit(NamedTuple):
    """A periodic orbit, or the attempt at one.

    - `state` and `period`, the least one; `gap`, the greatest component of what is left of the
      return; `distance`, of how far the iteration went from where it began (of the period, that of
      one time round).
    - `multipliers`: the Floquet multipliers but the trivial one, greatest modulus first.  With
      true dry friction as many, the last ones, are exactly 0 as masses ever stick together; NaN
      are others that are not told from zero, of a modulus below `resolution`, as sticking makes
      them in smoothed friction.
    - `defect`: |M f - f| / |f|, what the trivial one's vector misses, and any other may;
      `resolution`: that, or rounding.
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
    chain: AbstractOscillators,
    state: Any,
    period: Any,
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

    **Arguments:** `state` = (x, v), both of shape (n,); `period` > 0; `solver` and `rtol` as for
    `simulate`.

    **Returns:** `ClosedOrbit`; look at its `gap` and `distance` before anything else.  Works
    under `jit` and `vmap`.

    **Raises:** `ValueError` for bad input.

    !!! example

        ```python
        import jax.numpy as jnp
        from jaxchain import EventDriven, paper_chain
        chain = paper_chain(n=1)
        start = jnp.array([2.2]), jnp.zeros(1)
        orbit = close_orbit(chain, start, 6.26, solver=EventDriven())
        orbit.multipliers  # 0: it sticks
        ```
    """
    x, v = check_orbit(chain, state, period, rtol)
    return _close(chain, (x, v), to_float(period), solver, rtol)


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
            [[slopes[:, :-1] - jnp.eye(2 * n), f[:, None]], [f[None], jnp.zeros((1, 1))]]
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
    u, slopes, gap = best.u + failed, best.aux.slopes + failed, greatest_gap(best) + failed
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
