"""The amplitude of vibration, with an early end of runs."""

from __future__ import annotations

import functools
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_one_of, check_positive_number, check_whole, to_float
from .._internals import unvmap_any
from .._types import ScalarLike, State
from ..model.model import AbstractModel
from .base import AbstractObserver, Step, Variable, all_finite, renamed, window_fits
from .quantities import active, energy


class _AmplitudeState(eqx.Module):
    low: Float[Array, " n"]  # NaN before the window
    high: Float[Array, " n"]
    last_window: Float[Array, ""]  # its start
    rest: _Rest | None  # unless stop == "never"
    history: _History | None  # if stop == "steady"


class _Rest(eqx.Module):
    """Whether every mass is at rest: a few numbers per lane, no array."""

    boundary: Float[Array, ""]  # end of the present window
    quiet: Bool[Array, ""]


class _History(eqx.Module):
    """The amplitudes of the previous window, and the number of repetitions."""

    last: Float[Array, " n"]
    repeats: Int[Array, ""]


class Amplitude(AbstractObserver):
    """Half peak-to-peak of every displacement, A_n = (max x_n - min x_n) / 2, over a window.

    The window is the last `window` time units of the run (None: the whole run); the run must not
    be shorter.  Peaks are located between steps.  Value: shape (n,), in the unit of displacement
    (P/k).

    **Arguments:**

    - `window`: its length in dimensionless time, at least one period (2 pi).
    - `stop`: "never" runs to the end.  "quiet" stops the run when every mass is at its equilibrium
      (speed and acceleration below `quiet_below`; the amplitude is then reported as 0) *and* the
      equilibrium is stable, that is, every mass is damped, dF/dv < 2 xi, and held, and no force
      depends on time (`AbstractOscillators.attracts`).  This cannot change the answer.  "steady"
      also stops it when the amplitudes of `repeats` successive windows agree within `tolerance`.
      It may miss slow drifts of the phases, and instabilities that have not grown yet.  Both need
      a `window`.
    - `component`: which number of a cell is observed, 0 for the first one (see `AbstractCells`).

    **Raises:** `ValueError` for any other `stop`, and for numbers that are not positive.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, paper_chain, simulate
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> last_periods = Amplitude(window=20.0)
        >>> run = simulate(chain, equation_8(chain, 1), 100.0, observe=last_periods)
        >>> print(run.observed.round(2))  # one mass vibrates and shakes its neighbours
        [0.28 1.53 0.28]
        >>> calm = Amplitude(window=20.0, stop="quiet")
        >>> run = simulate(chain, equation_8(chain, 0), 1000.0, observe=calm)
        >>> run.outcome, bool(run.t < 1000.0)  # at rest there is nothing to wait for
        ('quiet', True)
    """

    window: float | None = eqx.field(static=True, default=None)
    stop: Literal["never", "quiet", "steady"] = eqx.field(static=True, default="never")
    tolerance: float = eqx.field(static=True, default=1e-6)
    repeats: int = eqx.field(static=True, default=5)
    quiet_below: float = eqx.field(static=True, default=1e-6)
    component: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        if self.window is not None:
            check_positive_number("window", self.window, "a period is about 2 pi; 100 is usual.")
        check_positive_number("tolerance", self.tolerance, "1e-6 is usual.")
        check_positive_number("quiet_below", self.quiet_below, "1e-6 is usual.")
        check_whole("repeats", self.repeats)
        check_whole("component", self.component, 0, remedy="0 is the first number of a cell.")
        check_one_of("stop", self.stop, ("never", "quiet", "steady"))
        if self.stop != "never" and self.window is None:
            raise ValueError(
                f"Argument `stop` = {self.stop!r} needs a `window`: the amplitudes of successive "
                "windows are compared."
            )

    def init(
        self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> _AmplitudeState:
        x = field.value_and_rate(t0, y0, self.component)[0]
        window = t1 - t0 if self.window is None else self.window
        start = to_float(t1 - window)
        seen = x if self.stop == "steady" else jnp.where(start > t0, jnp.nan, x)
        if self.stop == "never":
            return _AmplitudeState(seen, seen, start, None, None)
        # Windows end at t1, t1 - window, ...; the first one is longer by the remainder, because a
        # shorter window would be too short.
        complete = jnp.maximum(jnp.floor((t1 - t0) / jnp.maximum(window, 1e-300)), 1.0)
        rest = _Rest(boundary=to_float(t1 - window * (complete - 1.0)), quiet=jnp.zeros((), bool))
        history = None
        if self.stop == "steady":
            history = _History(jnp.full_like(x, jnp.nan), jnp.zeros((), int))
        return _AmplitudeState(seen, seen, start, rest, history)

    def fits(self, t0: ScalarLike, t1: ScalarLike) -> Any:
        return window_fits(self.window, t0, t1)

    def update(self, accumulator: _AmplitudeState, step: Step) -> _AmplitudeState:
        return self.update_if(True, accumulator, step)

    def update_if(self, counts: Any, accumulator: _AmplitudeState, step: Step) -> _AmplitudeState:
        step, counts = step.of(self.component), jnp.asarray(counts)
        acc, end = accumulator, step.y1[self.component]
        # Peaks before the last window are located only if amplitudes are compared.
        always = acc.history is not None
        watching = counts if always else counts & (step.t1 > acc.last_window)

        def with_peaks() -> tuple[Array, Array]:
            low, high, start = acc.low, acc.high, 0.0
            if not always:
                # The step in which the window begins counts from that time.
                opens = watching & (step.t0 <= acc.last_window)
                # Without 1 a lane that has ended, whose steps have no length, has NaN as gradient.
                length = jnp.where(opens, step.t1 - step.t0, 1.0)
                start = jnp.where(opens, (acc.last_window - step.t0) / length, 0.0)
                first = step.displacement(start)
                low, high = jnp.where(opens, first, low), jnp.where(opens, first, high)
            for has_extreme, theta in step.all_turning_points():
                extreme = jnp.where(has_extreme & (theta >= start), step.displacement(theta), end)
                low = jnp.minimum(low, jnp.minimum(extreme, end))
                high = jnp.maximum(high, jnp.maximum(extreme, end))
            return jnp.where(watching, low, acc.low), jnp.where(watching, high, acc.high)

        # One branch for the whole batch, and nothing else before the first window.
        nothing = lambda: (acc.low, acc.high)
        low, high = lax.cond(unvmap_any(watching), with_peaks, nothing)
        rest = None if acc.rest is None else self._rest(counts, acc.rest, step)
        history = None
        if acc.rest is not None and acc.history is not None:
            forget = counts & (step.t1 >= acc.rest.boundary)
            amplitude = (high - low) / 2
            same = jnp.max(jnp.abs(amplitude - acc.history.last)) <= self.tolerance
            repeats = jnp.where(same, acc.history.repeats + 1, 0)
            history = _History(
                jnp.where(forget, amplitude, acc.history.last),
                jnp.where(forget, repeats, acc.history.repeats),
            )
            low, high = jnp.where(forget, end, low), jnp.where(forget, end, high)
        return _AmplitudeState(low, high, acc.last_window, rest, history)

    def _rest(self, counts: Bool[Array, ""], rest: _Rest, step: Step) -> _Rest:
        """Checks once per window: a state whose velocity and acceleration vanish is at rest."""
        over = counts & (step.t1 >= rest.boundary)

        def look() -> Array:
            rates = [step.of(k).rate_after() for k in range(len(step.y1))]
            motion = jnp.max(functools.reduce(jnp.maximum, map(jnp.abs, rates)))
            attracts = step.field.attracts(step.t1, step.y1)
            return attracts & (motion < self.quiet_below)

        quiet = lax.cond(unvmap_any(over), look, lambda: jnp.asarray(False))
        window = 0.0 if self.window is None else self.window
        return _Rest(
            boundary=jnp.where(over, rest.boundary + window, rest.boundary),
            quiet=jnp.where(counts, over & quiet, rest.quiet),
        )

    def settled(self, accumulator: _AmplitudeState) -> Bool[Array, ""] | None:
        if accumulator.rest is None:
            return None
        if accumulator.history is None:
            return accumulator.rest.quiet
        return accumulator.rest.quiet | (accumulator.history.repeats >= self.repeats)

    def rests(self, accumulator: _AmplitudeState) -> Bool[Array, ""]:
        return jnp.asarray(False) if accumulator.rest is None else accumulator.rest.quiet

    def finite(self, accumulator: _AmplitudeState) -> Bool[Array, ""]:
        return all_finite(self.read(accumulator))

    def read(self, accumulator: _AmplitudeState) -> Float[Array, " n"]:
        if accumulator.history is not None:
            return accumulator.history.last
        amplitude = (accumulator.high - accumulator.low) / 2
        return jnp.where(self.rests(accumulator), 0.0, amplitude)

    def label(self, value: Float[Array, " n"], model: Any) -> dict[str, Variable]:
        variables = amplitude_variables(value, getattr(model, "belt_speed", None))
        return renamed(variables, model, self.component)


def amplitude_variables(
    amplitude: Float[Array, "*batch n"], belt_speed: Any
) -> dict[str, Variable]:
    """Amplitudes, their energy and the number of vibrating masses, as variables of a dataset.

    **Arguments:** `belt_speed`, one number or one for each state of a batch; None without a belt,
    or a function of time: then it is unknown which masses vibrate on their own.

    **Returns:** variables with the dimensions after those of the batch.
    """
    variables = {
        "amplitude": Variable(
            amplitude, ("oscillator",), "x0", "vibration amplitude A_n (half peak-to-peak)"
        ),
        "energy": Variable(energy(amplitude), (), "x0^2", "vibration energy E = 1/2 sum A_n^2"),
    }
    if belt_speed is not None and not callable(belt_speed):
        vibrate = jnp.sum(active(amplitude, belt_speed), axis=-1)
        variables["active_count"] = Variable(
            vibrate, (), "1", "masses with A_n > |v_d| / 2", is_count=True
        )
    return variables
