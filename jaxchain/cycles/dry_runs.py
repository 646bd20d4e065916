"""Event-driven runs over a period of a cycle with dry friction."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._checks import to_float
from .._types import State
from ..observers.base import Step
from ..observers.section import AbstractSection
from ..simulation.event_driven import EventDriven
from ..simulation.run import Simulation, simulate
from ..solvers.dry_events import start as on_the_belt
from ..solvers.dry_friction import alone, modes_at, motion, rates, slip_speed
from .variational import ExtremesAndTrace

# The most steps of an event-driven run over a period, and some for each mass: a search may try
# absurd periods and laws.
PERIOD_STEPS, STEPS_PER_MASS = 4_000, 400


class Cuts(AbstractSection):
    """States in which a mass is released by the belt, or is fastest while it slides behind it."""

    def _slope(self, step: Step, theta: Any, y: State) -> Array:
        field: Any = step.field
        return field.belt_direction() * slipping(field, step.time(theta), y)[self.oscillator]

    def _slope_after(self, step: Step, last: Array) -> Array:
        del step
        return last


def slipping(model: Any, t: Any, y: State) -> Float[Array, " n"]:
    """w' of masses that slide behind the belt; 0 at the release, r = -p mu_st.

    Of several contacts the first slides behind, and the others as they do; without any it is the
    acceleration of the first displacement.
    """
    backward, u = -model.belt_direction(), model.contact - len(y) // 2
    if not alone(model):
        modes = modes_at(model, t, y)
        modes = modes.at[: y[0].size].set(backward) if modes.size else modes
        return motion(model, t, y, modes)[len(y) // 2 + u]
    (contact,) = model.frictional_contacts
    mu = contact.law.coefficient(jnp.abs(slip_speed(model, t, y)))
    return rates(model, t, y, model.accelerations(t, y), mu, backward)[u]


class DryRun(eqx.Module):
    """Event-driven runs over a period, from the state at which a dry cycle is cut.

    That is where mass `mass` is released by the belt, or fastest; of a forced cycle at t = 0.
    """

    field: Any
    rtol: Any
    mass: int = eqx.field(static=True)
    forcing_periods: int | None = eqx.field(static=True)

    def over(self, state: State, time: Any, observe: Any, t0: Any = 0.0) -> Simulation:
        """A run for `time`."""
        return simulate(
            self.field, state, t0 + time, t0=t0, observe=observe, solver=EventDriven(),
            rtol=self.rtol, max_steps=PERIOD_STEPS + STEPS_PER_MASS * state[0].size, throw=False,
        )  # fmt: skip

    def from_the_cut(
        self, state: State, period: Array, t0: Any = None
    ) -> tuple[State, State, Any]:
        """(the state at the cut, that a period later, what `ExtremesAndTrace` sees on the way).

        `t0`: the time of `state`; a forced cycle is cut at a multiple of the force's period.
        """

        def once_round(state: State, given: tuple[Array, Array]) -> tuple[State, Any]:
            begin, time = given
            cuts = [Cuts(self.mass, 1, of="velocity")] if self.forcing_periods is None else []
            run = self.over(state, time, [*cuts, ExtremesAndTrace()], begin)
            *cut, along = run.observed
            there = run.state
            for _, *parts in cut:
                there = on_the_belt(self.field, 0.0, tuple(part[0] for part in parts))[0]
            return there, (state, run.state, along)

        # A run that is compiled once; first a little more than a period, for an orbit that begins
        # at the cut.
        zero, times = jnp.zeros(()), [(jnp.zeros(()), period)]
        if self.forcing_periods is None:
            times.insert(0, (zero, 1.05 * period))
        elif t0 is not None:
            forced = to_float(self.field.forcing_period())
            times.insert(0, (t0, jnp.ceil(t0 / forced) * forced - t0))
        given = jnp.stack([time for time, _ in times]), jnp.stack([time for _, time in times])
        _, seen = lax.scan(once_round, state, given)
        return jax.tree.map(lambda leaf: leaf[-1], seen)
