"""Designing vibration away: the least change of a chain that makes it quiet or robust enough."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._checks import (
    check_function,
    check_positive,
    check_positive_number,
    is_traced,
    shown,
    to_float,
)
from .._types import ArrayLike, Given, ScalarLike
from ..basins.blows import Blow, gentlest_blow
from ..boundaries.ranges import StabilityRange, stability_range
from ..continuation.damped_newton import where
from ..continuation.gradient_descent import check_descent, stay_inside
from ..continuation.iteration import TrialStep, iterate
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..result import Outcome, SearchResult
from .measurements import above_floor, at_edges, begin_search

# Longest step, in units of `scale`, and how often it may be rejected.
_LONGEST, _MOST_REFUSED = 0.3, 12
_ARMIJO, _ROUNDING = 1e-4, 1e-10
# The penalty in units of 1 / |grad g|^2, and its growth if g does not fall to a quarter.
_PENALTY, _GROWTH, _ENOUGH = 10.0, 4.0, 0.25
_LBFGS = optax.chain(optax.scale_by_lbfgs(), optax.scale(-1.0))


class Design(Outcome):
    """The result of `design`.

    - `theta`, `chain`: the design and its chain; `cost`: its cost.
    - `range`, its `StabilityRange`, or `blow`, its `Blow`, depending on the target; the other is
      None.
    - `multiplier`: lambda of grad cost = -lambda grad g, the cost of a further unit of g; 0 if the
      target costs nothing.
    - `angle`: between grad cost and -grad g, in radians, 0 at an optimum; NaN if either vanishes.
    - `residual`: the greater of |grad cost + lambda grad g| and the violation of g <= 0.
    - `result`: successful if `residual` is at most the tolerance (a local optimum).
    - `evaluations`: the number of boundaries, or blows, with derivatives.
    - `at_edge`: for each edge of the domain of the chain's numbers whether the design is held back
      by it.
    - `path`, `costs`, `aims`: every design tried, its cost, and its speed or blow; NaN from entry
      `evaluations` on.

    See `design` for an example.
    """

    may_be_missing = ("angle", "path", "costs", "aims")
    theta: PyTree
    chain: Chain
    cost: Float[Array, ""]
    range: StabilityRange | None
    blow: Blow | None
    multiplier: Float[Array, ""]
    angle: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    evaluations: Int[Array, ""]
    at_edge: dict[str, Bool[Array, ""]]
    path: PyTree
    costs: Float[Array, " steps"]
    aims: Float[Array, " steps"]


class _DesignPoint(eqx.Module):
    """A design in units of `scale`, with its cost, target and their gradients."""

    z: Float[Array, " m"]
    cost: Float[Array, ""]
    g: Float[Array, ""]  # aim - target, or target - aim
    cost_slope: Float[Array, " m"]
    g_slope: Float[Array, " m"]
    aim: Float[Array, ""]
    boundary: StabilityRange | Blow

    def multiplier(self, last_multiplier: Array, penalty: Array) -> Array:
        return jnp.maximum(0.0, last_multiplier + penalty * self.g)

    def lagrangian(self, last_multiplier: Array, penalty: Array) -> tuple[Array, Array]:
        """c + (m^2 - lambda^2) / (2 rho), with m = max(0, lambda + rho g), and its gradient."""
        m = self.multiplier(last_multiplier, penalty)
        value = self.cost + (m**2 - last_multiplier**2) / (2.0 * penalty)
        return value, self.cost_slope + m * self.g_slope


class _DesignSearch(eqx.Module):
    best: _DesignPoint
    trial: TrialStep
    last_multiplier: Float[Array, ""]  # lambda
    penalty: Float[Array, ""]  # rho; NaN before the first point
    missing: Float[Array, ""]  # |m - lambda| / rho when lambda was last set
    residual: Float[Array, ""]
    path: Float[Array, "steps m"]
    costs: Float[Array, " steps"]
    aims: Float[Array, " steps"]


def design(
    chain: Chain,
    change: Callable[[Chain, Any], Chain],
    start: PyTree,
    *,
    width_below: Given[ScalarLike | None] = None,
    highest_below: Given[ScalarLike | None] = None,
    blow_above: Given[ScalarLike | None] = None,
    cost: Callable[[Any], Any] | None = None,
    scale: Given[ArrayLike | None] = None,
    mass: Given[int | None] = None,
    optimiser: optax.GradientTransformation | None = None,
    steps: Given[int] = 200,
    tolerance: Given[ScalarLike] = 1e-6,
) -> Design:
    """The cheapest design theta whose vibration ends at a low speed, or needs a hard blow.

    minimise cost(theta)   subject to   g(theta) = aim(change(chain, theta)) - target <= 0

    where the aim is the `width` of the `stability_range` or its `highest` speed; or subject to
    target - size <= 0, the size being that of the `gentlest_blow` at the chain's belt speed.  The
    method is the augmented Lagrangian (Nocedal and Wright, Numerical Optimization, chapter 17) in
    one compiled loop, which evaluates one boundary, or blow, with its derivatives per round.  A
    design without vibration meets the target.  A step is shortened if its boundary or blow is not
    found, or if steady sliding is unstable where a blow is the target.  Steps stay where `Chain`
    and its law accept the numbers and damping is not negative, and a number that must be positive
    keeps a hundredth of its first value.

    **Arguments:**

    - `change(chain, theta)`, the chain of a design, for instance `lambda chain, xi:
      chain.with_(damping_ratio=xi)`; `start`, the first theta, any pytree.
    - `width_below`, `highest_below` or `blow_above`: the target, a dimensionless speed; one of the
      three.  `blow_above` needs a first design with stable sliding.  It has a kink where two
      masses have the same gentlest blow: change equal masses together.
    - `cost(theta)`: by default 1/2 |(theta - start) / scale|^2.
    - `scale`: a significant change of theta, one number or a pytree like `start`; by default
      |start|, or 1 where that is 0.
    - `mass`: as in `stability_range`; with `blow_above` the only mass that is hit, by default any.
    - `optimiser`: an optax transformation without a line search, such as `optax.adam(0.01)`, for
      theta in units of `scale`; by default L-BFGS.  Steps that do not improve are shortened.
    - `steps`: the greatest number of boundaries, or blows.

    **Returns:** a `Design`.

    **Raises:** `ValueError` for bad input.  **Warns** if the design is at an edge of the domain.
    `result` reports a search that does not converge.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.inverse import design
    >>> damped = lambda chain, xi: chain.with_(damping_ratio=xi)
    >>> chain = paper_chain(n=1, width=None)
    >>> found = design(chain, damped, 0.05, highest_below=1.7)
    >>> round(float(found.theta), 4), round(float(found.range.fold), 4)
    (0.0555, 1.7)
    """
    index = check_mass(chain, mass)
    targets = {
        "width_below": width_below,
        "highest_below": highest_below,
        "blow_above": blow_above,
    }
    given = {name: target for name, target in targets.items() if target is not None}
    if len(given) != 1:
        raise ValueError(
            "One of the arguments `width_below`, `highest_below` and `blow_above` must be given, "
            f"but they are {width_below}, {highest_below} and {blow_above}: a bistable range or a "
            "belt speed is to fall, or a blow to rise."
        )
    [(name, target)] = given.items()
    check_positive_number(name, target, "it is a speed, such as 0.3.")
    optimiser = _LBFGS if optimiser is None else optimiser
    check_descent(optimiser, steps)
    check_positive_number("tolerance", tolerance, "1e-6 is usual.")
    if cost is not None:
        check_function("cost", cost, "theta -> a number", 1)
    flat, unravel, floor = begin_search(chain, change, start)
    if scale is None:
        units = jnp.where(flat == 0, 1.0, jnp.abs(flat))
    else:
        changes, _ = ravel_pytree(jax.tree.map(lambda leaf: to_float(leaf, "scale"), scale))
        check_positive("scale", changes, "it is a change that counts.")
        if changes.size not in (1, flat.size):
            raise ValueError(
                f"Argument `scale` must hold one number, or {flat.size} as `start` does, but is "
                f"{shown(scale)}."
            )
        units = jnp.broadcast_to(changes, flat.shape)
    hit = None if mass is None else (index,)
    problem = _DesignProblem(
        chain, flat, units, to_float(target), floor, change, cost, index, hit, name, unravel
    )
    found = _solve(problem, optimiser, steps, to_float(tolerance))
    if not is_traced(found) and any(found.at_edge.values()):
        edges = ", ".join(f"`{name}`" for name, there in found.at_edge.items() if there)
        warnings.warn(
            f"The design is at the edge of the domain, {edges}: the target asks for values beyond "
            "it. Change other numbers, too, or choose a target that is easier to reach.",
            stacklevel=2,
        )
    return found


class _DesignProblem(eqx.Module):
    chain: Chain
    start: Float[Array, " m"]
    scale: Float[Array, " m"]
    target: Float[Array, ""]
    floor: Float[Array, " q"]  # see `begin_search`
    change: Callable[[Chain, Any], Chain]
    cost_function: Callable[[Any], Any] | None
    mass: int = eqx.field(static=True)
    hit: tuple[int] | None = eqx.field(static=True)
    name: str = eqx.field(static=True)
    unravel: Callable[[Array], Any] = eqx.field(static=True)

    def theta(self, z: Array) -> Array:
        return self.start + self.scale * z

    def chain_at(self, z: Array) -> Chain:
        return self.change(self.chain, self.unravel(self.theta(z)))

    def margins(self, z: Array) -> Array:
        """How far inside its domain each number is."""
        return above_floor(self.chain_at(z), self.floor)

    def point(self, z: Array) -> _DesignPoint:
        """The values at a design, with forward derivatives: the searches have no reverse mode."""

        def both(z: Array) -> tuple[Array, tuple[Array, Array, StabilityRange | Blow]]:
            g, aim, boundary = self._aim(self.chain_at(z))
            cost = 0.5 * jnp.sum(z**2)
            if self.cost_function is not None:
                cost = to_float(self.cost_function(self.unravel(self.theta(z))))
            values = jnp.stack([cost, g])
            return values, (values, aim, boundary)

        slopes, (values, aim, boundary) = jax.jacfwd(both, has_aux=True)(z)
        return _DesignPoint(z, values[0], values[1], slopes[0], slopes[1], aim, boundary)

    def unknown(self) -> StabilityRange | Blow:
        """Unknown values in the shapes of `point`, before the first one."""
        shapes = eqx.filter_eval_shape(lambda z: self._aim(self.chain_at(z))[2], self.start)

        def blank(leaf: Any) -> Array:
            real = jnp.issubdtype(leaf.dtype, jnp.inexact)
            return jnp.full(leaf.shape, jnp.inf if real else 0, leaf.dtype)

        nothing = jax.tree.map(blank, shapes)
        return eqx.tree_at(lambda boundary: boundary.result, nothing, SearchResult.nonfinite)

    def _aim(self, chain: Chain) -> tuple[Array, Array, StabilityRange | Blow]:
        """(g, its speed or blow, the result with them); g is NaN if unknown."""
        if self.name == "blow_above":
            blow = gentlest_blow(chain, self.hit)
            none = blow.result == SearchResult.no_vibration
            # Without vibration the target is met, and there is nothing to differentiate.
            g = jnp.where(none, -self.target, self.target - jnp.where(none, 0.0, blow.size))
            return jnp.where(none | blow.successful, g, jnp.nan), blow.size, blow
        boundary = stability_range(chain, self.mass)
        aim = boundary.width if self.name == "width_below" else boundary.highest
        return jnp.where(boundary.successful, aim - self.target, jnp.nan), aim, boundary


@eqx.filter_jit
def _solve(problem: _DesignProblem, optimiser: Any, steps: int, tolerance: Array) -> Design:
    transform: Any = optax.with_extra_args_support(optimiser)
    size = problem.start.size
    zero, infinite = jnp.zeros(size), jnp.asarray(jnp.inf)
    blank = _DesignPoint(zero, infinite, infinite, zero, zero, infinite, problem.unknown())

    def ended(now: _DesignSearch) -> SearchResult:
        of, refused = SearchResult, now.trial.refused
        result = of.where(refused < _MOST_REFUSED, of.max_steps_reached, of.no_step_helps)
        unknown = jnp.isinf(now.best.cost) & (refused > 0)
        result = of.where(unknown, of.nonfinite, result)
        return of.where(now.residual <= tolerance, of.successful, result)

    def round_(now: _DesignSearch, count: Array) -> _DesignSearch:
        trial = problem.point(now.best.z + now.trial.length * now.trial.step)
        first = jnp.isinf(now.best.cost)
        steepness = jnp.sum(trial.g_slope**2)
        scaled = _PENALTY / jnp.where(steepness > 0, steepness, 1.0)
        penalty = jnp.where(first, scaled, now.penalty)
        value, slope = trial.lagrangian(now.last_multiplier, penalty)
        before, before_slope = now.best.lagrangian(now.last_multiplier, penalty)
        # A step of an optimiser with momentum may increase the loss: accept it.
        slant = jnp.sum(before_slope * now.trial.step)
        descent = jnp.minimum(now.trial.length * slant, 0.0)
        limit = before + _ARMIJO * descent + _ROUNDING * (1.0 + jnp.abs(before))
        uphill = slant >= 0
        sound = jnp.isfinite(value) & jnp.all(jnp.isfinite(slope))
        good = sound & (first | uphill | (value <= limit))

        best = where(good, trial, now.best)
        m = best.multiplier(now.last_multiplier, penalty)
        _, slope = best.lagrangian(now.last_multiplier, penalty)
        # Along the edges that are reached nothing is left to gain across them.
        off, _ = stay_inside(problem.margins, best.z, -slope)
        missing, off = jnp.abs(m - now.last_multiplier) / penalty, jnp.sqrt(jnp.sum(off**2))
        # Early Lagrangians need no exact minimum.
        renew = good & (off <= jnp.maximum(0.3 * missing, 0.3 * tolerance))
        slow = renew & (missing > _ENOUGH * now.missing)
        last_multiplier = jnp.where(renew, m, now.last_multiplier)
        new_penalty = jnp.where(slow, _GROWTH * penalty, penalty)
        value, slope = best.lagrangian(last_multiplier, new_penalty)
        # Another Lagrangian: restart the optimiser.
        memory = where(renew, transform.init(zero), now.trial.memory)
        step, memory = transform.update(slope, memory, best.z, value=value, grad=slope)

        def inside(step: Array) -> Array:
            step = step * jnp.minimum(1.0, _LONGEST / jnp.max(jnp.abs(step)))
            return stay_inside(problem.margins, best.z, step)[0]

        # An edge may turn a step of the optimiser uphill, but not one along the gradient.
        within, steepest = inside(step), inside(-slope)
        turned = (jnp.sum(slope * step) < 0) & (jnp.sum(slope * within) >= 0)
        step = jnp.where(turned, steepest, within)
        return _DesignSearch(
            best=best,
            trial=now.trial.after(good, step, memory),
            last_multiplier=last_multiplier,
            penalty=new_penalty,
            missing=jnp.where(renew, missing, now.missing),
            residual=jnp.where(good, jnp.maximum(off, missing), now.residual),
            path=now.path.at[count].set(problem.theta(trial.z)),
            costs=now.costs.at[count].set(trial.cost),
            aims=now.aims.at[count].set(trial.aim),
        )

    path, record = jnp.full((steps, size), jnp.nan), jnp.full(steps, jnp.nan)
    begin = TrialStep.first(transform, zero), jnp.zeros(()), jnp.ones(()), infinite, infinite
    search = _DesignSearch(blank, *begin, path, record, record)
    last, result, evaluations = iterate(round_, search, ended, steps)
    best = last.best
    _, slope = best.lagrangian(last.last_multiplier, last.penalty)
    _, bent = stay_inside(problem.margins, best.z, -slope)
    return Design(
        theta=problem.unravel(problem.theta(best.z)),
        chain=problem.chain_at(best.z),
        cost=best.cost,
        range=best.boundary if isinstance(best.boundary, StabilityRange) else None,
        blow=best.boundary if isinstance(best.boundary, Blow) else None,
        multiplier=best.multiplier(last.last_multiplier, last.penalty),
        angle=_angle(best.cost_slope, -best.g_slope),
        residual=last.residual,
        result=result,
        evaluations=evaluations,
        at_edge=at_edges(problem.chain_at(best.z), bent),
        path=jax.vmap(problem.unravel)(last.path),
        costs=last.costs,
        aims=last.aims,
    )


def _angle(a: Array, b: Array) -> Array:
    """The angle, in [0, pi], accurate also for small angles."""
    a, b = a / jnp.sqrt(jnp.sum(a**2)), b / jnp.sqrt(jnp.sum(b**2))
    return 2.0 * jnp.arctan2(jnp.sqrt(jnp.sum((a - b) ** 2)), jnp.sqrt(jnp.sum((a + b) ** 2)))
