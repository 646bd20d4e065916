"""Where the fold of cycles meets the Hopf point: the generalised Hopf (Bautin) point.

Along the Hopf curve in the plane of the belt speed and another number, vibration sets in abruptly
where the first Lyapunov coefficient l1 is positive, with a stable state of rest beside a vibrating
one up to the fold; and gently where l1 is negative, without a fold.  At l1 = 0 the fold ends,
tangentially to the Hopf curve (Kuznetsov, Elements of Applied Bifurcation Theory, section 8.3).

For one mass l1 has the sign of F'''(-v_d).  Dry friction that weakens exponentially has
F''' > 0 throughout, so that its fold and Hopf point meet at a belt at rest only.  Smoothed
friction mu tanh(v_d / eps) has a peak, and F''' < 0 up to a few widths beyond it:

    v_d = (eps / 2) ln[16 mu_st v_0^3 / ((mu_st - mu_d) eps^3)]  to leading order,

and the damping there is about p (mu_st - mu_d) / (2 v_0), that of dry friction at rest.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._checks import check_one_of, check_positive_number, is_traced
from ..continuation.damped_newton import newton
from ..continuation.implicit import attach_derivative
from ..model.chain import Chain
from ..model.initial_states import check_vibrating
from ..model.parameters import CHAIN
from ..model.sliding import sliding_damping
from ..result import Outcome, SearchResult
from .criticality import first_lyapunov_coefficient
from .hopf import hopf_belt_speed

# The zero of l1 lies close to the end of the Hopf curve where the width is small.
_GRID, _ZOOMS = 48, 5
# Third derivatives at a width eps err by rounding over eps^3.
_TOLERANCE = 1e-8


class GeneralisedHopf(Outcome):
    """A Hopf point with l1 = 0, at `value` of the parameter; NaN unless `successful`."""

    value: Float[Array, ""]
    belt_speed: Float[Array, ""]
    result: SearchResult

    def _rows(self) -> dict[str, Any]:
        return {"value": self.value, "belt speed": self.belt_speed}


def generalised_hopf(chain: Chain, parameter: Any, low: Any, high: Any) -> GeneralisedHopf:
    """The point of the Hopf curve of one mass at which l1 = 0, where the fold ends.

    Solves d(v_d) = 0, l1 = 0 in (v_d, parameter): ever finer grids between `low` and `high`, in
    the logarithm, enclose the last change of sign of l1 along `hopf_belt_speed`; Newton's method
    follows.

    **Arguments:** `chain` of one mass; `parameter`, the name of its number that varies, such as
    "damping_ratio", "mu_static" or "width"; `low`, `high`, positive, between which.

    **Returns:** both dimensionless numbers, differentiable in every other number of the chain.
    Works under `jit` and `vmap`.

    **Raises:** `ValueError` for a chain of several masses, an unknown name or a bad interval.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> meeting = generalised_hopf(paper_chain(n=1), "width", 0.05, 1.0)
    >>> round(float(meeting.value), 3)  # with wider layers vibration sets in gently
    0.349
    """
    check_vibrating(chain, 0)
    if chain.n != 1:
        raise ValueError(f"Argument `chain` must have one mass, but has {chain.n}.")
    own = [name for name, row in CHAIN.items() if row.per == "mass"]
    known = {*own, *chain.friction.numbers(), "width"}
    check_one_of("parameter", parameter, sorted(known))
    for name, end in (("low", low), ("high", high)):
        check_positive_number(name, end, "the values in between are spaced by their logarithm.")
    if not is_traced(low, high) and float(low) >= float(high):
        raise ValueError(f"Argument `low` = {low} must be below `high` = {high}.")
    return _meeting(chain, parameter, jnp.asarray(low, float), jnp.asarray(high, float))


@eqx.filter_jit
def _meeting(chain: Chain, parameter: str, low: Array, high: Array) -> GeneralisedHopf:
    frozen = jax.tree.map(lax.stop_gradient, chain)

    def kind(logarithm: Array) -> Array:
        own = frozen.with_(**{parameter: jnp.exp(logarithm)})
        return _coefficient(own, hopf_belt_speed(own))

    def zoom(_: Any, now: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """The last interval of a grid over which l1 changes sign, or else the Hopf curve ends."""
        low, high, _ = now
        grid = jnp.linspace(low, high, _GRID)
        kinds = jax.vmap(kind)(grid)
        left, right = kinds[:-1], kinds[1:]
        changes = left * right <= 0  # false for NaN
        changed = jnp.any(changes)
        ends = jnp.isnan(left) != jnp.isnan(right)
        at = jnp.max(jnp.where(jnp.where(changed, changes, ends), jnp.arange(_GRID - 1), -1))
        return grid[at], grid[at + 1], changed

    ends = jnp.log(low), jnp.log(high), jnp.asarray(False)
    start, _, changed = lax.fori_loop(0, _ZOOMS, zoom, ends)
    value = jnp.exp(start)
    speed = hopf_belt_speed(frozen.with_(**{parameter: value}))
    unit = jnp.stack([value, speed])
    system = _System(parameter)
    begin = jnp.where(changed, jnp.ones(2), jnp.nan)
    known = jnp.where(jnp.isnan(begin * unit), 1.0, begin)
    root = newton(system.scaled, known, (frozen, unit), tolerance=_TOLERANCE)
    result = SearchResult.where(changed, root.result, SearchResult.no_meeting)
    found = changed & root.successful
    both = attach_derivative(system, jnp.where(found, root.value * unit, jnp.nan), chain)
    return GeneralisedHopf(value=both[0], belt_speed=both[1], result=result)


class _System(eqx.Module):
    """(d, l1) over (value of the parameter, belt speed)."""

    parameter: str = eqx.field(static=True)

    def __call__(self, u: Float[Array, "2"], chain: Chain) -> Float[Array, "2"]:
        own = chain.with_(**{self.parameter: u[0]})
        return jnp.stack([sliding_damping(own, u[1]), _coefficient(own, u[1])])

    def scaled(self, u: Float[Array, "2"], args: tuple[Chain, Array]) -> Float[Array, "2"]:
        chain, unit = args
        return self(u * unit, chain)


def _coefficient(chain: Chain, belt_speed: Array) -> Array:
    """l1 of one mass, whose modes are all alike."""
    one = jnp.ones(1, dtype=complex)
    return first_lyapunov_coefficient(chain, belt_speed, jnp.sqrt(chain.stiffness), one)
