"""A run and, along with it, what is linear in the numbers that it starts from, in one loop.

To differentiate a loop, and that for several directions at once, JAX traces its body some six
times, and carries derivatives of all that a step decides.  Here a step is traced once, with its
derivatives in the state alone; its size, its error and its observers have none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import State
from ..model.oscillators import AbstractOscillators
from ..observers.base import AbstractObserver, Step
from ..simulation.accuracy import MAX_STEP
from ..simulation.plan import forward_only
from ..simulation.smoothed import SmoothedPlan
from ..solvers.rosenbrock import AbstractStructuredRosenbrock

# A period takes some hundreds; an orbit that is lost must not keep the others waiting.
MOST_STEPS = 50_000
# A step that would end nearer to the end, in units in the last place, ends there.
_ULPS = 100

Make = Callable[[Float[Array, " m"]], tuple[AbstractOscillators, State, Float[Array, ""]]]


class Pushed(NamedTuple):
    """The state after a run and its derivatives, along the first axis; NaN if it failed."""

    end: State
    slopes: State  # of shape (m, n)
    observed: list
    complete: Bool[Array, ""]


class _Run(NamedTuple):
    t: Float[Array, ""]
    ahead: Float[Array, ""]  # where the next step ends
    y: State
    slopes: State
    memory: Any  # of the step-size control
    accumulators: list
    result: Any
    steps: Int[Array, ""]


def push(
    make: Make,
    point: Float[Array, " m"],
    *,
    rtol: Any,
    solver: AbstractStructuredRosenbrock,
    observers: Sequence[AbstractObserver] = (),
) -> Pushed:
    """The state after a time, with its derivatives in the m numbers of `point`.

    The derivatives are those of the steps with their sizes held fixed, but for the last one, which
    ends when the run does.  To be called under `jit`.

    **Arguments:** `make`: point -> (field, first state, time); `observers`, without derivatives.
    """
    unit = jnp.eye(point.shape[0])
    field, start, length = make(point)
    _, first, by_length = jax.vmap(lambda one: _tangents(make, point, one))(unit)
    plan = SmoothedPlan(
        solver=solver, observers=list(observers), rtol=rtol, atol=0.1 * rtol, max_step=MAX_STEP,
        t1=length,
    )  # fmt: skip
    controller = plan.controller(field)
    order: Any = solver.error_order(None)
    begun = plan.begin(field, start, 0.0, length)
    clipped = length - _ULPS * (length - jnp.nextafter(length, -jnp.inf))
    of = dfx.RESULTS

    def goes_on(now: _Run) -> Array:
        return (now.t < length) & (now.result == of.successful) & (now.steps < MOST_STEPS)

    def body(now: _Run) -> _Run:
        last = now.ahead == length

        def step(point: Array, y: State, ahead: Array) -> tuple[State, Any]:
            terms: Any = dfx.ODETerm(make(point)[0])  # pyright: ignore[reportArgumentType]
            y1, error, dense, _, result = solver.step(terms, now.t, ahead, y, None, None, False)
            return y1, (error, dense, result)

        def along(one: Array, slope: State, longer: Array) -> Any:
            moved = one, slope, jnp.where(last, longer, 0.0)
            return jax.jvp(step, (point, now.y, now.ahead), moved, has_aux=True)

        y, slopes, (error, dense, result) = jax.vmap(along, out_axes=(None, 0, None))(
            unit, now.slopes, by_length
        )
        error = jax.tree.map(lambda e: jnp.where(jnp.isnan(e), jnp.inf, e), error)
        kept, t, ahead, _, memory, control = controller.adapt_step_size(
            now.t, now.ahead, now.y, y, None, error, order, now.memory
        )
        t = jnp.minimum(t, length)
        end = jnp.where(kept, length, t + 0.5 * (length - t))
        ahead = jnp.where(ahead > clipped, end, ahead)
        inside = solver.interpolation_cls(t0=now.t, t1=now.ahead, **dense)
        seen = Step(
            field, now.t, now.ahead, now.y, y,
            lambda theta: inside.at(theta, 0), lambda theta: inside.at(theta, 1),
        )  # fmt: skip
        pairs = zip(observers, now.accumulators, strict=True)
        accumulators = [o.update(accumulator, seen) for o, accumulator in pairs]
        y, slopes, accumulators = jax.tree.map(
            lambda new, old: jnp.where(kept, new, old),
            (y, slopes, accumulators),
            (now.y, now.slopes, now.accumulators),
        )
        result = of.where(kept, result, of.successful)
        result = of.where(result == of.successful, control, result)
        return _Run(t, ahead, y, slopes, memory, accumulators, result, now.steps + 1)

    memory = begun.memory
    result = of.where(begun.running, of.successful, of.internal_error)
    begin = _Run(
        begun.t, jnp.minimum(begun.t + memory.step_size, length), start, first, memory.controller,
        begun.accumulators, result, jnp.zeros((), int),
    )  # fmt: skip
    ended = lax.while_loop(goes_on, body, begin)
    good = (ended.t >= length) & (ended.result == of.successful)
    good = good & jnp.all(jnp.isfinite(jnp.stack(ended.y)))
    y, slopes = jax.tree.map(lambda a: jnp.where(good, a, jnp.nan), (ended.y, ended.slopes))
    observed = [o.read(a) for o, a in zip(observers, ended.accumulators, strict=True)]
    return forward_only(Pushed(y, slopes, observed, good))


def _tangents(make: Make, point: Array, one: Array) -> tuple[None, State, Array]:
    """Of the first state and of the time, along `one`."""

    def rest(point: Array) -> tuple[State, Array]:
        _, state, length = make(point)
        return state, length

    _, (state, length) = jax.jvp(rest, (point,), (one,))
    return None, state, length
