"""How the end of a step moves with its events: nothing but rounding, and its derivatives."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._types import State
from ..model.chain import Chain
from ..solvers.dry_friction import STICK, Modes, Series, greatest_hold
from ..solvers.taylor import value_and_slope
from .plan import Progress


def shifts(
    field: Chain, series: Series, modes: Modes, t: Array, hits: Array,
    v: Array, acceleration: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """One more Newton step to the events: nothing but rounding, and their whole derivative.

    (the shift of each mass's event, of shape (n,); their mean over those that have one, by
    which the step is made longer.)  The search itself is not differentiated; this is the
    implicit function theorem.
    """
    r, drift = value_and_slope(series.r, t)
    w = v - field.belt_speed
    slides = modes.direction != STICK
    excess = jnp.where(slides, w, r - jnp.sign(r) * greatest_hold(field))
    rate = lax.stop_gradient(jnp.where(slides, acceleration, drift))
    usable = hits & (rate != 0)
    each = jnp.where(usable, -excess, 0.0) / jnp.where(usable, rate, 1.0)
    mean = jnp.sum(each) / jnp.maximum(jnp.sum(usable), 1)
    return jnp.where(usable, each, mean), mean


def at_the_end(field: Chain, progress: Progress, t1: Any) -> Progress:
    """The same, where an event falls together with t1; but it moves with t1, not with the event.

    A run over the period of a cycle that is cut at an event ends so.
    """
    x, v = progress.state
    direction = progress.memory.modes.direction
    mu = field.law.coefficient(jnp.abs(v - field.belt_speed))
    slides = field.free_force(x, v) - direction * field.load * mu
    acceleration = jnp.where(direction == STICK, 0.0, slides)
    # Rounding, and 0 but for its derivative at any other end.
    rest = jnp.where(progress.running & (progress.t >= t1), t1 - progress.t, 0.0)
    state = x + rest * v, v + rest * acceleration
    return eqx.tree_at(lambda p: p.state, progress, state)


def head_start(
    field: Chain, state: State, modes: Modes, new: Modes, hits: Array, since: Array
) -> Array:
    """What masses that slide on through w = 0 have gained in speed `since` their own events.

    Of masses whose events fall together each is disturbed in its own way, and the step ends at
    their mean.  Zero but for rounding, which is left out, and its derivative.  One that comes to
    stick, or is let go, has no acceleration then.
    """
    through = hits & (modes.direction != STICK) & (new.direction != STICK)
    speed = jnp.zeros_like(state[1])
    friction = new.direction * field.load * field.law.coefficient(speed)
    return jnp.where(through, since * (field.free_force(*state) - friction), 0.0)


@jax.custom_jvp
def change_alone(a: Array) -> Array:
    """Zero, with the derivatives of `a`: nothing is computed where there are none."""
    return jnp.zeros_like(a)


@change_alone.defjvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    return change_alone(*primals), tangents[0]
