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
from jax import lax
from jaxtyping import Array, Complex, Float

from ._types import State
from .floquet import floquet_multipliers
from .simulate import simulate
from .structure import AbstractOscillators

_NEWTON_STEPS = 4


class ClosedOrbit(NamedTuple):
    """A periodic orbit, or the attempt at one.

    - `state` and `period`; `gap`, the greatest component of what is left of the return;
      `distance`, of how far the iteration went from where it began.
    - `multipliers`: the Floquet multipliers but the trivial one, greatest modulus first;
      `defect`: |M f - f| / |f|, what the trivial one's vector misses.
    """

    state: State
    period: Float[Array, ""]
    gap: Float[Array, ""]
    distance: Float[Array, ""]
    multipliers: Complex[Array, " others"]
    defect: Float[Array, ""]

    @property
    def exponents(self) -> Float[Array, " others"]:
        """ln |multiplier| / period; -inf for what sticking annihilates."""
        return jnp.log(jnp.abs(self.multipliers)) / self.period


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

    with 4 steps.  A mass that sticks at the start does so afterwards.

    **Arguments:** `state` = (x, v), both of shape (n,); `solver` and `rtol` as for `simulate`.

    **Returns:** `ClosedOrbit`; look at its `gap` and `distance` before anything else.  Works
    under `jit` and `vmap`.

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
    return _close(chain, state, jnp.asarray(period, float), solver, rtol)


@eqx.filter_jit
def _close(
    chain: AbstractOscillators, state: State, period: Array, solver: Any, rtol: Any
) -> ClosedOrbit:
    start = jnp.concatenate([*state, period[None]])
    n = state[0].shape[0]

    def flow(u: Array) -> tuple[Array, Array]:
        run = simulate(chain, (u[:n], u[n:-1]), u[-1], solver=solver, rtol=rtol, throw=False)
        end = jnp.concatenate(run.state)
        return end, end

    derivative = jax.jacfwd(flow, has_aux=True)

    def newton(u: Array, _: None) -> tuple[Array, None]:
        slopes, end = derivative(u)
        f = slopes[:, -1]
        matrix = jnp.block(
            [[slopes[:, :-1] - jnp.eye(2 * n), f[:, None]], [f[None], jnp.zeros((1, 1))]]
        )
        right = jnp.append(u[:-1] - end, 0.0)
        return u + jnp.linalg.solve(matrix, right), None

    u, _ = lax.scan(newton, start, None, length=_NEWTON_STEPS)
    slopes, end = derivative(u)
    found = floquet_multipliers(slopes[:, :-1], slopes[:, -1])
    return ClosedOrbit(
        (u[:n], u[n:-1]), u[-1], jnp.max(jnp.abs(end - u[:-1])),
        jnp.max(jnp.abs(u - start)), found.multipliers, found.defect,
    )  # fmt: skip
