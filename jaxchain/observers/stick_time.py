"""The time for which each mass sticks to the belt, and the number of masses that stick at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_positive_number, check_whole, to_float
from .._internals import unvmap_any
from .._types import ScalarLike, State
from ..model.contacts import along
from ..model.model import AbstractModel
from .base import AbstractObserver, Step, Variable, all_finite, window_fits, zeros


class StickTime(AbstractObserver):
    """The time for which each mass sticks to the belt during a window.

    The window is the last `window` time units of the run (None: the whole run); the run must not
    be shorter. The ends of sticking are located between steps. Value: shape (n,), a dimensionless
    time. With dry friction a mass sticks while w = v - v_d is 0. With a smoothed law it sticks
    while |w| is below the speed of greatest friction, `TanhFriction.stick_speed`, *and* the force
    on it, without this friction, does not exceed p mu_st. The speed alone would give a time too
    long by sqrt[eps ln(1 / eps)], because a released mass leaves the belt like t^2.

    **Arguments:** `window`, its length in dimensionless time; `contact`, which one of the several
    contacts of a cell, counted from 0.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import StickTime, equation_8, paper_chain, simulate
        >>> chain = paper_chain(n=1, belt_speed=1.0, width=None)
        >>> run = simulate(chain, equation_8(chain, 1), 60.0, observe=StickTime(window=6.4325))
        >>> round(float(run.observed[0]), 2)  # of the last period, with true dry friction
        1.01
    """

    window: float | None = eqx.field(static=True, default=None)
    contact: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        if self.window is not None:
            check_positive_number("window", self.window, "some periods of about 2 pi.")
        check_whole("contact", self.contact, 0, None, "it counts contacts from 0.")

    def init(
        self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, Array]:
        contacts = field.frictional_contacts
        if not contacts:
            raise ValueError(
                "`StickTime` needs masses that can stick to a belt: a `Chain`, or "
                "`MechanicalCells` with friction."
            )
        if self.contact >= len(contacts):
            raise ValueError(
                f"Argument `contact` = {self.contact} must be less than the number of contacts, "
                f"{len(contacts)}: they are counted from 0."
            )
        window = t1 - t0 if self.window is None else self.window
        return jnp.zeros_like(y0[0]), to_float(t1 - window)

    def fits(self, t0: ScalarLike, t1: ScalarLike) -> Any:
        return window_fits(self.window, t0, t1)

    def update(self, accumulator: tuple[Array, Array], step: Step) -> tuple[Array, Array]:
        total, start = accumulator
        watching = step.t1 > start

        def time() -> Array:
            begin, end = sticking(step, self.contact)
            # Without 1 a lane that has ended, whose steps have no length, has NaN as gradient.
            length = jnp.where(step.t1 > step.t0, step.t1 - step.t0, 1.0)
            clipped = jnp.clip((start - step.t0) / length, 0.0, 1.0)
            return jnp.maximum(end - jnp.maximum(begin, clipped), 0.0) * (step.t1 - step.t0)

        gained = lax.cond(unvmap_any(watching), time, lambda: jnp.zeros_like(total))
        return jnp.where(watching, total + gained, total), start

    def finite(self, accumulator: tuple[Array, Array]) -> Bool[Array, ""]:
        return all_finite(accumulator)

    def read(self, accumulator: tuple[Array, Array]) -> Float[Array, " n"]:
        return accumulator[0]

    def label(self, value: Float[Array, " n"], model: Any) -> dict[str, Variable]:
        name = "time for which a mass sticks during the window"
        return {"stick_time": Variable(value, ("oscillator",), model.time_unit, name)}


def sticking(step: Step, contact: int = 0) -> tuple[Array, Array]:
    """The part of a step during which each mass sticks, as thetas from and to."""
    field: Any = step.field
    one = field.frictional_contacts[contact]
    if field.dry:  # steps end at events
        held = _held(step, one)
        return jnp.zeros(held.shape), jnp.where(held, 1.0, 0.0)

    def too_fast(theta: Any) -> Array:
        return jnp.abs(_slip(step, one, theta)) - one.friction.stick_speed()

    def excess(theta: Any) -> Array:
        # A neighbour at the time of this mass: its own theta is that of its neighbour.
        (behind,), (ahead,) = field.neighbours((theta,))
        own, at_end = step.state(theta), jnp.arange(theta.size)
        left, right = (
            tuple(jnp.where(ends, a, b) for a, b in zip(own, side, strict=True))
            for ends, side in (
                (alone & (at_end == 0), field.neighbours(step.state(ahead))[0]),
                (alone & (at_end == theta.size - 1), field.neighbours(step.state(behind))[1]),
            )
        )
        t = step.t0 + theta * (step.t1 - step.t0)
        return field.excess_force(t, left, own, right, contact)

    alone = field.ends == "free"
    begin, end = _where_negative(too_fast, step.y0[0])
    caught, released = _where_negative(excess, step.y0[0])
    return jnp.maximum(begin, caught), jnp.minimum(end, released)


# A mass that slides between two rests on the belt within a step is faster than this, in its units;
# the velocities of several displacements that stick to each other differ by rounding.
_CREEP, _ROUNDING = 1e-6, 1e-11


def _slip(step: Step, contact: Any, theta: Array) -> Array:
    """w of a contact within a step."""
    d = len(step.y0) // 2
    v = [step.part(theta, d + i) if e else theta for i, e in enumerate(contact.direction)]
    return along(contact.direction, v) - contact.speed_at(step.t0 + theta * (step.t1 - step.t0))


def _held(step: Step, contact: Any) -> Array:
    """Which masses stick throughout a step of a dry run: they have the belt's speed at both ends.

    Between these the series of a belt whose speed changes errs by the tolerance.
    """
    least, still = 0.0, 0.0

    def slip(theta: float) -> Array:
        return _slip(step, contact, jnp.full_like(step.y0[0], theta))

    w0, w1 = contact.slip(step.t0, step.y0), contact.slip(step.t1, step.y1)
    unit = step.field.natural_scales()[1] + jnp.abs(contact.speed_at(step.t0))
    if contact.moving:
        least = _CREEP * unit
    if step.field.stops:  # an impact ends the step
        w1 = slip(1.0)
    others = len(step.field.frictional_contacts) > 1 or step.field.stops
    if contact.displacement is None or others:
        still = _ROUNDING * unit
    between = jnp.abs(slip(0.5)) <= jnp.maximum(least, still)
    end = jnp.maximum(least, still) if step.field.stops else still
    return (jnp.abs(w0) <= still) & (jnp.abs(w1) <= end) & between


def _where_negative(
    gap: Callable[[Any], Array], like: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The interval of theta in [0, 1] with gap(theta) <= 0, if it changes sign at most once."""
    half = jnp.full_like(like, 0.5)
    g0, middle, g1 = gap(jnp.zeros_like(half)), gap(half), gap(jnp.ones_like(half))
    crosses = (g0 > 0) != (g1 > 0)
    theta = zeros(gap, crosses, g0, g1, elsewhere=0.0)
    throughout = (g0 <= 0) & (g1 <= 0) & (middle <= 0)
    begin = jnp.where(crosses & (g0 > 0), theta, 0.0)
    end = jnp.where(crosses, jnp.where(g0 > 0, 1.0, theta), jnp.where(throughout, 1.0, 0.0))
    return begin, end


class MostSticking(AbstractObserver):
    """The greatest number of masses that stick at the same time, with true dry friction.

    **Value:** a whole number, over the whole run.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate
        >>> from jaxchain.observers import MostSticking
        >>> chain = paper_chain(3, belt_speed=1.0, width=None)
        >>> starts = [equation_8(chain, excited) for excited in (0, 3)]
        >>> [int(simulate(chain, s, 60.0, observe=MostSticking()).observed) for s in starts]
        [0, 2]
    """

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del t0, t1, y0
        if not field.dry and field.stick_speed() is None:
            raise ValueError(
                "`MostSticking` needs masses that can stick to a belt: a `Chain`, or "
                "`MechanicalCells` with dry friction."
            )
        return jnp.zeros((), int)

    def update(self, accumulator: Any, step: Step) -> Any:
        held = [jnp.sum(_held(step, contact)) for contact in step.field.frictional_contacts]
        return jnp.maximum(accumulator, sum(held, start=jnp.zeros((), int)))

    def read(self, accumulator: Any) -> Int[Array, ""]:
        return accumulator

    def label(self, value: Int[Array, ""], model: Any) -> dict[str, Variable]:
        del model
        name = "masses that ever stick at the same time"
        return {"most_sticking": Variable(value, (), "1", name, is_count=True)}
