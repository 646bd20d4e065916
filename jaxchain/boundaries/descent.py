"""Both boundaries with optax: the Hopf speed by gradient descent, the fold by gradient ascent."""

import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from .._checks import check_number, check_positive_number, check_whole
from .._types import Given, ScalarLike
from ..continuation.damped_newton import where
from ..continuation.gradient_descent import MOST_STEPS, check_descent, descend
from ..model.arguments import as_chain
from ..model.chain import Chain, require_smoothed
from ..model.initial_states import check_mass
from ..model.sliding import growth_rate
from ..result import Outcome, SearchResult
from .fold import first_guess, forward_share, loose_rtol, value_and_jacobian


class HopfDescent(Outcome):
    """The Hopf speed by gradient descent, with its iterates.

    - `belt_speed`, and `growth_rate` there, which is zero at the boundary.
    - `steps`: the number of updates.  `result`: successful if |growth rate| <= the tolerance.
    - `speeds`, `growth_rates`: of every iterate from the start; NaN after entry `steps`.

    See `hopf_by_descent` for an example.
    """

    may_be_missing = ("speeds", "growth_rates")
    belt_speed: Float[Array, ""]
    growth_rate: Float[Array, ""]
    steps: Int[Array, ""]
    result: SearchResult
    speeds: Float[Array, " entries"]
    growth_rates: Float[Array, " entries"]


def hopf_by_descent(
    chain: Chain,
    start: Given[PyTree | None] = None,
    optimiser: optax.GradientTransformation | None = None,
    steps: Given[int] = 1000,
    tolerance: Given[ScalarLike] = 1e-10,
) -> HopfDescent:
    """A Hopf speed by gradient descent on g(v_d)^2, g the growth rate of steady sliding.

    Prefer `hopf_belt_speed`: bracketing and Newton's method need fewer than ten steps and find the
    uppermost boundary without a start.  The descent takes some 300 steps of Adam and ends at the
    boundary near its start; use it as a part of a larger optimisation.  It has no derivatives; use
    those of `hopf_belt_speed`.

    **Arguments:** `chain`; `start`, a belt speed > 0 (default: |v_d| of the chain); `optimiser`,
    any optax transformation (default `optax.adam(0.1)`); `steps`, the greatest number until |g| <=
    `tolerance`.  The speed stays positive.

    **Returns:** a `HopfDescent`.

    **Raises:** `ValueError` for a start, a number of steps or a tolerance that is not positive.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.boundaries import hopf_by_descent
    >>> found = hopf_by_descent(paper_chain(n=1))
    >>> bool(found.successful), round(float(found.belt_speed), 6)
    (True, 1.151293)
    """
    as_chain(chain)
    start = jnp.abs(chain.belt_speed) if start is None else start
    check_positive_number("start", start, "it is a belt speed, such as 1.5.")
    check_positive_number("tolerance", tolerance, "it is a growth rate, such as 1e-10.")
    optimiser = _constant_adam() if optimiser is None else optimiser
    check_descent(optimiser, steps)
    begin, least = (jnp.asarray(value, float) for value in (start, tolerance))
    return _descend(chain, begin, optimiser, steps, least)


@eqx.filter_jit
def _descend(
    chain: Chain, start: Any, optimiser: optax.GradientTransformation, steps: Any, tolerance: Array
) -> HopfDescent:
    descent = descend(
        lambda speed: growth_rate(chain, speed) ** 2,
        start,
        optimiser,
        steps,
        tolerance**2,
        margins=lambda speed: speed,
    )
    rates = jax.vmap(lambda speed: growth_rate(chain, speed))(descent.path)
    rate = growth_rate(chain, descent.solution)
    return HopfDescent(
        belt_speed=descent.solution,
        growth_rate=rate,
        steps=descent.steps,
        result=descent.result,
        speeds=descent.path,
        growth_rates=rates,
    )


# An optimiser is part of the compiled program, and compared by identity.
_constant_adam = ft.cache(lambda: optax.adam(0.1))


@ft.cache
def _adam(steps: int) -> optax.GradientTransformation:
    return optax.adam(optax.exponential_decay(0.1, steps, 0.003), b1=0.5)


class FoldDescent(Outcome):
    """The fold by gradient ascent, with its iterates.

    - `belt_speed`, the greatest one reached, and `slope` = d(v_d)/ds there in units of the width,
      zero at the fold.
    - `result`: successful if |slope| <= the tolerance.
    - `scaled_peak_velocities`, `belt_speeds`: s = max w / eps and v_d of every step; NaN before
      the first cycle is found.

    See `fold_by_descent` for an example.
    """

    may_be_missing = ("scaled_peak_velocities", "belt_speeds")
    belt_speed: Float[Array, ""]
    slope: Float[Array, ""]
    result: SearchResult
    scaled_peak_velocities: Float[Array, " entries"]
    belt_speeds: Float[Array, " entries"]


def fold_by_descent(
    chain: Given[Chain],
    mass: Given[int | None] = None,
    *,
    start: Given[PyTree | None] = None,
    optimiser: optax.GradientTransformation | None = None,
    steps: Given[int] = 60,
    tolerance: Given[ScalarLike] = 1e-3,
) -> FoldDescent:
    """The fold of `fold_belt_speed` by gradient ascent: the maximum belt speed of a vibration.

    The cycles with s = max w / eps of mass `mass` form a curve v_d = V(s), and the fold is its
    maximum.  Each step integrates one period with its tangents.  This gives Newton's correction,
    which closes the cycle, and by the implicit function theorem the slope dV/ds for the optimiser.

    Prefer `fold_belt_speed`: a secant method for dV/ds = 0 needs some ten such integrations for
    nine digits; the ascent needs one per step, for eight digits.  It uses only values and slopes;
    use it as a part of a larger optimisation, or with constraints.

    **Arguments:** `chain` and `mass` as in `fold_belt_speed`; `start`, the first s (default: 0.7
    below the prediction of averaging); `optimiser`, any optax transformation, in asinh s and for V
    / width (default: Adam with a rate that falls from 0.1 to 0.0003); `steps` in all; `tolerance`
    of the slope.

    **Returns:** a `FoldDescent`.

    **Raises:** `ValueError` as `fold_belt_speed`, and for a tolerance that is not positive.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.boundaries import fold_by_descent
    >>> found = fold_by_descent(paper_chain(n=1, width=1e-2))
    >>> round(float(found.belt_speed), 5)
    1.79246
    """
    mass = check_mass(chain, mass)
    require_smoothed(chain, "use `find_fold`, or ", "chain")
    check_positive_number("tolerance", tolerance, "1e-3 is usual.")
    if start is not None:
        check_number("start", start, "it is max w / eps of a cycle, some -3.")
        start = jnp.asarray(start, float)
    check_whole("steps", steps, 1, MOST_STEPS)
    optimiser = _adam(steps) if optimiser is None else optimiser
    check_descent(optimiser, steps)
    return _ascend(chain, mass, start, optimiser, steps, jnp.asarray(tolerance, float))


@eqx.filter_jit
def _ascend(
    chain: Chain,
    mass: int,
    first: Array | None,
    optimiser: optax.GradientTransformation,
    steps: int,
    tolerance: Array,
) -> FoldDescent:
    # `descend` is for a loss that depends on the unknown alone; here each step also corrects the
    # cycle, which is carried along.
    start = first_guess(chain, mass)
    shooting = eqx.tree_at(lambda s: s.rtol, start.shooting, 1e-3 * loose_rtol(chain))
    width, index = jnp.min(chain.width), shooting.z_index
    first = jnp.sinh(start.point[-1]) - 0.7 if first is None else first

    def update(carry: tuple[Array, Any], _: None) -> tuple[tuple[Array, Any], tuple]:
        point, state = carry
        z = point[-1]
        r, jacobian = value_and_jacobian(shooting, forward_share(start, point), point)
        both = jnp.linalg.solve(jacobian[:, :-1], jnp.stack([r, jacobian[:, -1]], axis=1))
        q, tangent = point[:-1] - both[:, 0], -both[:, 1]
        slope = tangent[index] / width
        # Before the cycle closes, its slope is not accurate.
        closed = jnp.max(jnp.abs(r)) < 1e-4
        change, moved = optimiser.update(-slope, state, z)
        change = jnp.where(closed, jnp.asarray(change), 0.0)
        record = jnp.sinh(z), q[index], slope / jnp.cosh(z), closed
        point = jnp.append(q + tangent * change, z + change)
        return (point, where(closed, moved, state)), record

    begin = start.point.at[-1].set(jnp.arcsinh(first)), optimiser.init(jnp.arcsinh(first))
    _, (scaled_peak_velocities, speeds, slopes, closed) = lax.scan(update, begin, length=steps)
    best, some = jnp.argmax(jnp.where(closed, speeds, -jnp.inf)), jnp.any(closed)
    of = SearchResult
    result = of.where(some, of.max_steps_reached, of.no_cycle)
    result = of.where(some & (jnp.abs(slopes[best]) <= tolerance), of.successful, result)
    return FoldDescent(
        belt_speed=jnp.where(some, speeds[best], jnp.nan),
        slope=jnp.where(some, slopes[best], jnp.nan),
        result=result,
        scaled_peak_velocities=scaled_peak_velocities,
        belt_speeds=jnp.where(closed, speeds, jnp.nan),
    )
