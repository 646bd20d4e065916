"""A run that goes on while its parameters change: the part of the explorer without pictures.

One compiled program advances any state of a model by one frame.  The model is an argument of it,
so that a change of a parameter compiles nothing and keeps the state.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._checks import to_float
from ..model.arguments import as_chain, as_model, as_state
from ..model.initial_states import equation_8
from ..model.model import AbstractModel, StateVariable
from ..model.parameters import Parameter
from ..observers.quantities import active, energy, mean_period, settled
from ..observers.samples import Trajectory
from ..result import NAMES, code, ended_well, message
from ..simulation.run import simulate
from ..simulation.sticking import is_sticking
from ..solvers.rosenbrock import Rodas4

# Samples of a frame; the longest frame, in natural units of time: fifty samples a period.
SAMPLES, LONGEST = 8, 1.0
# Samples that are kept, and the least time between two of them: at least 80 time units.
KEPT, LEAST_INTERVAL = 2048, 0.04
# The time units of a window of amplitudes, three periods, and how many of them are compared.
WINDOW, WINDOWS, SETTLED = 20.0, 4, 1e-3
# The most steps of a frame; the size at which a run counts as exploding; parameters of an array
# that have sliders; seconds of computing for a picture.
MOST_STEPS, EXPLODES, MOST_ENTRIES, BUDGET = 20_000, 1e6, 16, 0.025
_PEAKS, _TRAIL = 64, 4000
OTHER_WIDTH = 1e-3


@eqx.filter_jit
def frame(model: AbstractModel, state: Any, t: Any, length: Any, component: int) -> Any:
    """The next `SAMPLES` states of a run, what a picture shows of them, and how it ended.

    **Returns:** times; y, y' of the variable `component`, the state and whether masses stick, each
    of shape (samples, n); the number of the result.
    """
    times = t + length * jnp.arange(1, SAMPLES + 1) / SAMPLES
    # The exact linear solve serves every coupling; the choice by it would compile anew.
    solver = None if model.dry else Rodas4()
    watch = Trajectory(times)
    how: Any = {"t0": t, "observe": watch, "max_steps": MOST_STEPS, "throw": False}
    run = simulate(model, state, times[-1], solver=solver, **how)

    def seen(t: Any, state: Any) -> Any:
        sticks = is_sticking(model, t, state)
        return (
            *model.value_and_rate(t, state, component),
            jnp.zeros(state[0].shape, bool) if sticks is None else sticks,
        )

    value, rate, sticks = jax.vmap(seen)(times, run.observed)
    return times, jnp.stack([value, rate, *run.observed]), sticks, run.state, code(run.result)


class Run:
    """One model under way, with its last samples."""

    def __init__(self, model: AbstractModel, state: Any, t: float = 0.0) -> None:
        self.model, self.failure = model, ""
        self._contacts: Any = None
        self.component = next(
            (k for k in range(len(state)) if model.velocity_of(k) == model.contact), 0
        )
        self.unit = float(model.natural_scales()[0])
        self.restart(state, t)

    def restart(self, state: Any, t: float = 0.0) -> None:
        """Begins again from a state, and forgets all samples."""
        self.state, self.t, self.failure, self.way = state, t, "", 0.0
        m, n = len(state), len(state[0])
        self._times, self._count = np.full(2 * KEPT, np.nan), 0
        self._parts = np.full((2 + m, 2 * KEPT, n), np.nan)
        self.sticks = np.zeros(n, bool)
        self.last = np.stack(state)

    def advance(self, length: float) -> None:
        """One frame of at most `LONGEST`; a run that fails stays as it was before."""
        given = np.float64(self.t), np.float64(length)
        times, parts, sticks, state, result = frame(self.model, self.state, *given, self.component)
        name, parts = NAMES[int(result)], np.asarray(parts)
        size = np.max(np.abs(parts[:, -1]))
        if not ended_well(name) or not size < EXPLODES:
            why = message(name) if not ended_well(name) else "it grows without bound."
            self.failure = f"The run stopped at t = {self.t:.6g}: {why}"
            return
        self.state, self.t, self.last = state, self.t + length, parts[2:, -1]
        self.sticks = np.asarray(sticks[-1])
        self.way += length * self.belt_speed if self.model.frictional else 0.0
        self._keep(np.asarray(times), parts)

    def _keep(self, times: np.ndarray, parts: np.ndarray) -> None:
        if self._count + SAMPLES > 2 * KEPT:
            self._times[:KEPT], self._parts[:, :KEPT] = (
                self._times[KEPT:].copy(),
                self._parts[:, KEPT:].copy(),
            )
            self._count -= KEPT
        least, last = LEAST_INTERVAL * self.unit, -np.inf
        if self._count:
            last = self._times[self._count - 1]
        every = max(round(least * SAMPLES / (times[-1] - times[0] + 1e-300)), 1)
        for k in range(min(every, SAMPLES) - 1, SAMPLES, every):
            if times[k] > last + 0.999 * least:
                self._times[self._count], last = times[k], times[k]
                self._parts[:, self._count] = parts[:, k]
                self._count += 1

    @property
    def belt_speed(self) -> float:
        """v_d at present, of the first contact; 0 without one."""
        if self._contacts is None or self._contacts[0] is not self.model:
            self._contacts = self.model, self.model.frictional_contacts, None
        model, contacts, speed = self._contacts
        if speed is None:  # contacts are made anew, which takes a millisecond
            speed = float(np.ravel(contacts[0].speed_at(self.t))[0]) if contacts else 0.0
            if not (contacts and contacts[0].moving):
                self._contacts = model, contacts, speed
        return speed

    def window(self, length: float) -> tuple[np.ndarray, np.ndarray]:
        """(times, y, y' and the state) of the last `length` time units."""
        first = max(self._count - KEPT, 0)
        first += int(
            np.searchsorted(self._times[first : self._count], self.t - length * self.unit)
        )
        return self._times[first : self._count], self._parts[:, first : self._count]

    def extremes(self, times: np.ndarray, parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(half peak-to-peak of each mass, times of maxima with NaN), between samples, too."""
        value, rate = parts[:2]
        if len(times) < 2:
            return np.full(value.shape[1], np.nan), np.full((1, value.shape[1]), np.nan)
        before, after = rate[:-1], rate[1:]
        step = np.diff(times)[:, None]
        turns = before * after < 0
        share = np.where(turns, before / np.where(turns, before - after, 1.0), 0.0)
        # The rate is nearly linear between samples.
        extreme = np.where(turns, value[:-1] + 0.5 * before * share * step, value[:-1])
        high = np.maximum(extreme.max(0), value.max(0))
        low = np.minimum(extreme.min(0), value.min(0))
        peaks = np.where(turns & (before > 0), times[:-1, None] + share * step, np.nan)
        return (high - low) / 2, peaks


@dataclass
class Numbers:
    """What is shown of a run: amplitudes, energy, which masses vibrate, period, regular or not."""

    amplitude: np.ndarray
    energy: float
    vibrating: np.ndarray | None
    """Of a model with a belt of constant speed."""
    period: float
    regular: bool | None
    """None until four windows have passed."""


@dataclass
class Slider:
    """A scalar parameter of the model with a range to explore."""

    name: str
    row: Parameter
    value: float
    low: float
    high: float
    step: float = field(init=False)

    def __post_init__(self) -> None:
        nice = 10.0 ** np.floor(np.log10((self.high - self.low) / 100))
        self.step = float(
            nice * min((1, 2, 5), key=lambda k: abs(300 * k * nice - (self.high - self.low)))
        )


class Session:
    """One visitor's run: parameters, state, kicks and starts, and the same beside it, dry.

    **Arguments:** `model`, any that `simulate` takes; `state`, where it begins.

    **Raises:** `ValueError` as `simulate`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain
        >>> from jaxchain.explorer.session import Session
        >>> chain = paper_chain(3)
        >>> session = Session(chain, equation_8(chain, 1))
        >>> for _ in range(40):
        ...     session.advance(1.0)
        >>> session.change(belt_speed=1.6)  # the run goes on from its state
        >>> session.advance(1.0)
        >>> round(session.runs[0].t), session.numbers().vibrating.tolist()
        (41, [False, True, False])
    """

    def __init__(self, model: AbstractModel, state: Any) -> None:
        as_model(model)
        self.start = as_state(model, state, "state")
        self.runs = [Run(model, self.start)]
        self.n, self.mass, self.speed, self.seed = len(self.start[0]), 0, 10.0, 0
        self.mass = int(np.argmax(np.abs(np.asarray(self.start[0] - self._rest()[0]))))
        self.sliders = list(self._sliders())
        names = [slider.name for slider in self.sliders]
        self.axis = next((n for n in ("belt_speed", *names) if n in names), None)
        self.trail: deque[tuple[float, float]] = deque(maxlen=_TRAIL)

    @property
    def run(self) -> Run:
        """The run that parameters, pictures and numbers are of."""
        return self.runs[0]

    @property
    def model(self) -> Any:
        """The model as its parameters are now."""
        return self.run.model

    def _rest(self) -> Any:
        return self.model.equilibrium() or tuple(0.0 * part for part in self.start)

    def _sliders(self) -> Any:
        """Of each scalar parameter, and of each entry of a small array."""
        numbers = self.model.parameters()
        ordered = [name for name in self.model.parameter_names if name in numbers]
        for name in [*ordered, *(numbers.keys() - ordered)]:
            row, array = self.model.parameter(name), np.asarray(numbers[name])
            names = [name]
            if array.ndim:
                if array.size > MOST_ENTRIES:
                    continue
                names = [f"{name}[{', '.join(map(str, at))}]" for at in np.ndindex(array.shape)]
            for entry, number in zip(names, array.reshape(-1).tolist(), strict=True):
                size = 2.0 * abs(number) or 1.0
                low = 0.0 if number >= 0 else -size
                if row.sign == "positive":
                    low = 0.05 * number
                high = 0.0 if number < 0 else size * (5.0 if row.name == "width" else 1.0)
                yield Slider(entry, row, number, low, high)

    def value(self, name: str) -> float:
        """A parameter, or an entry of one."""
        return float(self.model.value_of(name))

    def change(self, **changes: Any) -> None:
        """Changes parameters; the state is kept.  Raises the library's `ValueError`."""
        changed = [run.model.with_(**self._known(run.model, changes)) for run in self.runs]
        for run, model in zip(self.runs, changed, strict=True):
            run.model, run.failure = model, ""

    def _known(self, model: Any, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Without the width for dry friction beside, which has none."""
        beside = model is not self.model and model.dry
        return {k: v for k, v in changes.items() if not (beside and k == "width")}

    def beside(self, shown: bool) -> None:
        """Starts the same run with the other friction, dry or smoothed, from the present state."""
        if not shown:
            del self.runs[1:]
        elif len(self.runs) == 1:
            if not self.model.frictional:
                raise ValueError(f"`{type(self.model).__name__}` has no friction to compare.")
            other = self.model.with_(width=OTHER_WIDTH if self.model.dry else None)
            self.runs.append(Run(other, self.run.state, self.run.t))
            self.runs[1].way = self.run.way

    def restart(self, state: Any, t: float = 0.0) -> None:
        """Begins again from a state; `ValueError` unless it is one of the model."""
        state = as_state(self.model, state, "state")
        for run in self.runs:
            run.restart(state, t)

    @property
    def starts(self) -> list[str]:
        """What `restart_from` takes for this model: eq. (8) is one of a chain."""
        try:
            as_chain(self.model)
        except ValueError:
            return ["given", "random", "typed"]
        return ["eq. (8)", "given", "random", "typed"]

    def restart_from(self, kind: str, excited: int = 1, typed: str = "") -> None:
        """Begins again: "eq. (8)" with `excited` masses, "given", "random", or a "typed" state."""
        if kind == "eq. (8)":
            self.restart(equation_8(self.model, excited))
        elif kind == "random":
            self.seed += 1
            draw, scale = np.random.default_rng(self.seed), self.reach() or 1.0
            self.restart(
                tuple(part + draw.uniform(-scale, scale, self.n) for part in self._rest())
            )
        else:
            self.restart(self.start if kind == "given" else self.parsed(typed))

    def parsed(self, text: str) -> Any:
        """A state from numbers alone: a line or part up to ";" for each variable."""
        rows = [row for row in text.replace("\n", ";").split(";") if row.strip()]
        m = len(self.start)
        try:
            numbers = [[float(word) for word in row.replace(",", " ").split()] for row in rows]
        except ValueError as error:
            raise ValueError(f"The state must be typed in numbers: {error}.") from None
        if len(rows) != m or any(len(row) not in (1, self.n) for row in numbers):
            raise ValueError(
                f"The state must have {m} rows, separated by `;`, of {self.n} numbers (or one for "
                f"all masses), but has {[len(row) for row in numbers]}."
            )
        return tuple(jnp.broadcast_to(to_float(row), (self.n,)) for row in numbers)

    def kick(self, mass: int, velocity: float) -> None:
        """Adds to the velocity of a mass, of other cells to the variable `contact`."""
        for run in self.runs:
            parts, k = list(run.state), min(run.model.contact, len(run.state) - 1)
            parts[k] = parts[k].at[mass].add(velocity)
            run.state, run.failure = tuple(parts), ""

    def reach(self) -> float:
        """The greatest distance from steady sliding, of the first window or of the start."""
        value = self.run.window(WINDOW)[1][0] if self.run.t else np.asarray(self.start[0])[None]
        rest = np.asarray(self._rest()[self.run.component])
        return float(np.max(np.abs(value - rest), initial=0.0))

    @property
    def failure(self) -> str:
        """Why a run stopped; empty while all go on."""
        return " ".join(run.failure for run in self.runs if run.failure)

    def advance(self, length: float) -> None:
        """Goes on by `length` time units, or by as many as can be computed for a picture."""
        began, left = time.perf_counter(), length
        while left > 1e-9 and not self.failure and time.perf_counter() - began < BUDGET:
            step = min(left, LONGEST * self.run.unit)
            for run in self.runs:
                run.advance(step)
            left -= step

    def numbers(self, which: int = 0) -> Numbers:
        """The numbers of the last window."""
        run = self.runs[which]
        span = WINDOW
        if (forced := run.model.forcing_period()) is not None:
            span = max(span, 2.0 * float(forced) / run.unit)
        amplitude = run.extremes(*run.window(span))[0]
        times, parts = run.window(WINDOWS * span)
        peaks = np.full(_PEAKS, np.nan)
        found = run.extremes(times, parts)[1][:, self.mass]
        found = found[np.isfinite(found)][-_PEAKS:]
        peaks[: len(found)] = found
        vibrating = regular = None
        contacts = run.model.frictional_contacts
        if len(contacts) == 1 and not contacts[0].moving:
            vibrating = np.asarray(active(jnp.asarray(amplitude), contacts[0].belt_speed))
        edges = np.searchsorted(times, run.t - span * run.unit * np.arange(WINDOWS, -1, -1))
        if len(times) and times[0] <= run.t - (WINDOWS - 0.05) * span * run.unit:
            cuts = itertools.pairwise(edges)
            windows = [run.extremes(times[a:b], parts[:, a:b])[0] for a, b in cuts]
            regular = bool(settled(jnp.asarray(np.stack(windows)), SETTLED))
        return Numbers(
            amplitude, float(energy(jnp.asarray(amplitude))), vibrating,
            float(mean_period(jnp.asarray(peaks))), regular,
        )  # fmt: skip

    def leave_trail(self, numbers: Numbers) -> None:
        """Notes the present place in the bifurcation diagram."""
        if self.axis is not None and np.isfinite(numbers.energy):
            self.trail.append((self.value(self.axis), numbers.energy))

    @property
    def shown(self) -> tuple[StateVariable, StateVariable]:
        """The variables of the phase portrait."""
        run = self.run
        first = run.model.variable(run.component)
        velocity = run.model.velocity_of(run.component)
        rate = StateVariable(f"rate of {first.name}", "1", f"rate of {first.name}")
        return first, rate if velocity is None else run.model.variable(velocity)
