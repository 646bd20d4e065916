"""The non-smooth chain from event to event: SciPy's DOP853, and no smoothing of any kind.

Every mass sticks (mode 0), slips forward (+1, w > 0) or backward (-1, w < 0). Between two events
the modes are fixed and the equations smooth. A mode has *gaps* that are positive while it lasts:

    slip:   mode * w                             it ends where the mass meets the speed of the belt
    stick:  p mu_st - r   and   p mu_st + r      it ends where the holding force finds its limit

with r = -2 xi v - k x - springs the net force on the mass without friction. A mass that meets the
belt sticks if |r| <= p mu_st; otherwise it slips on to the side to which r pulls it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import DOP853, solve_ivp
from scipy.optimize import minimize_scalar, root_scalar

from . import Array, Numbers

# Gaps between -TOUCH and 0 are no event: rounding, or a touch as good as none.
TOUCH = 1e-13
# The first step after an event. A mass just released leaves as w = w'' t^2 / 2; after this step
# its gap is far beyond rounding, so that its release is not mistaken for a landing.
FIRST_STEP = 1e-3
# A step is searched for events at this many points, and around each minimum between them.
SAMPLES = 16
KINDS = {-1: "backward", 0: "stick", 1: "forward"}


class Event(NamedTuple):
    """From `time` on, `mass` (from 0) is in the mode `kind`: stick, forward or backward."""

    time: float
    mass: int
    kind: str


class Run(NamedTuple):
    """The state at the end, shape (n,); the events; the states at `times`, shape (times, n)."""

    time: float
    x: Array
    v: Array
    events: list[Event]
    sampled_x: Array
    sampled_v: Array


class Cycle(NamedTuple):
    """A stick-slip cycle of one mass: half peak-to-peak of x, period, and time on the belt."""

    amplitude: float
    period: float
    stick_time: float


class _Motion:
    """The equations of motion in given modes, for states y = (x, v) of shape (2 n, ...)."""

    def __init__(self, numbers: Numbers, rtol: float, atol: float, max_step: float) -> None:
        self.numbers, self.max_step = numbers, max_step
        self.tolerances: dict[str, Any] = {"rtol": rtol, "atol": atol}
        self.K = np.diag(numbers.stiffness)
        for i, j, c in numbers.springs:
            # += one entry at a time: of one mass both ends of the spring are on that mass.
            self.K[i, i] += c
            self.K[j, j] += c
            self.K[i, j] -= c
            self.K[j, i] -= c
        self.limit = numbers.load * numbers.mu_static

    def net_force(self, y: Array) -> Array:
        x, v = y[: self.numbers.n], y[self.numbers.n :]
        return -2 * (self.numbers.damping_ratio * v.T).T - self.K @ x

    def field(self, mode: Array) -> Callable[[float, Array], Array]:
        def slope(_: float, y: Array) -> Array:
            v = y[self.numbers.n :]
            # mode * w and not |w|: the same while the mode lasts, and smooth where it ends.
            mu = self.numbers.friction(mode * (v - self.numbers.belt_speed))
            a = self.net_force(y) - self.numbers.load * mu * mode
            return np.concatenate([v, np.where(mode == 0, 0.0, a)])

        return slope

    def gaps(self, y: Array, mode: Array) -> Array:
        """Shape (2 n, ...): gaps to the forward limit, then to the backward one; slip has one."""
        w = y[self.numbers.n :] - self.numbers.belt_speed
        r, sticks = self.net_force(y).T, mode == 0
        upper = np.where(sticks, self.limit - r, mode * w.T)
        lower = np.where(sticks, self.limit + r, mode * w.T)
        return np.concatenate([upper.T, lower.T])

    def modes_on_the_belt(self, y: Array) -> Array:
        r = self.net_force(y)
        return np.where(np.abs(r) <= self.limit, 0.0, np.sign(r))

    def stepper(self, mode: Array, y: Array, duration: float) -> DOP853:
        return DOP853(
            self.field(mode),
            0.0,
            y,
            duration,
            first_step=min(FIRST_STEP, duration),
            max_step=self.max_step,
            **self.tolerances,
        )

    def advance(self, mode: Array, y: Array, h: float) -> Array:
        """One step of exactly h, at most as long as one that was accepted.

        The interpolant between two steps is of order 7 only; a shorter step is of order 8.
        """
        if h <= 0:
            return y.copy()
        path = solve_ivp(
            self.field(mode), (0.0, h), y, method="DOP853", first_step=h, **self.tolerances
        )
        return path.y[:, -1]


def integrate(
    numbers: Numbers,
    x: Array,
    v: Array,
    t1: float,
    *,
    times: Sequence[float] | Array = (),
    rtol: float = 1e-13,
    atol: float = 1e-14,
    max_step: float = 0.2,
    stop: Callable[[Event], bool] | None = None,
) -> Run:
    """From (x, v) at time 0 to `t1`, or to the first event for which `stop` is true.

    `times` (ascending, within 0 ... t1) are states asked for; each is a step of its own from the
    last step before it, and does not change the run. `max_step` must be short beside a period, so
    that a gap has at most one minimum between two of the points at which a step is searched.
    """
    motion, n = _Motion(numbers, rtol, atol, max_step), numbers.n
    y = np.concatenate([np.asarray(x, float), np.asarray(v, float)])
    w = y[n:] - numbers.belt_speed
    mode = np.where(w == 0, motion.modes_on_the_belt(y), np.sign(w))
    wanted, sampled, events = list(times), [], []
    t, stalled = 0.0, 0
    while t < t1:
        stepper = motion.stepper(mode, y, t1 - t)
        found, start, before = None, 0.0, y
        while found is None and stepper.status == "running":
            start, before = stepper.t, stepper.y.copy()
            failure = stepper.step()
            if stepper.status == "failed":
                raise RuntimeError(f"DOP853 failed at t = {t + stepper.t}: {failure}")
            found = _first_event(motion, mode, start, before, stepper)
            end = stepper.t if found is None else start + found[0]
            while wanted and wanted[0] <= t + end:
                sampled.append(motion.advance(mode, before, wanted.pop(0) - t - start))
        if found is None:
            t, y = t1, stepper.y
            break
        h, gap = found
        stalled = stalled + 1 if start + h < 1e-12 else 0
        if stalled > 4 * n + 8:
            raise RuntimeError(f"The modes {mode} at t = {t} lead to no motion.")
        t += start + h
        y = motion.advance(mode, before, h)
        mass = gap % n
        # The speed of the belt exactly, so that a mass that sticks does not creep.
        y[n + mass] = numbers.belt_speed
        new = (1.0 if gap < n else -1.0) if mode[mass] == 0 else motion.modes_on_the_belt(y)[mass]
        mode = np.where(np.arange(n) == mass, new, mode)
        events.append(Event(float(t), int(mass), KINDS[int(new)]))
        if stop is not None and stop(events[-1]):
            break
    if t >= t1:
        sampled += [y] * len(wanted)  # times that rounding has put just beyond the end
    states = np.reshape(sampled, (-1, 2, n))
    return Run(t, y[:n], y[n:], events, states[:, 0], states[:, 1])


def _first_event(
    motion: _Motion, mode: Array, start: float, before: Array, stepper: DOP853
) -> tuple[float, int] | None:
    """(time since `start`, number of the gap) of the first event of the last step, or None."""
    path = stepper.dense_output()
    tau = np.linspace(0.0, stepper.t - start, SAMPLES + 1)
    gaps = motion.gaps(path(start + tau), mode)
    # Between two points a parabola falls below the lower of them by at most an eighth of its
    # second difference.
    bend = np.abs(np.diff(gaps, 2)).max(axis=1)
    first = None
    own = np.concatenate([np.full(mode.size, True), mode == 0])  # slip has one gap, stick two
    for i in np.flatnonzero(own & (gaps.min(axis=1) <= bend)):
        bracket = _bracket(
            lambda s, i=i: motion.gaps(path(start + s), mode)[i], tau, gaps[i], bend[i]
        )
        if bracket is None:
            continue
        h = _root(lambda s, i=i: motion.gaps(motion.advance(mode, before, s), mode)[i], bracket)
        if first is None or h < first[0]:
            first = h, int(i)
    return first


def _bracket(
    gap: Callable[[float], float], tau: Array, values: Array, bend: float
) -> tuple[float, float] | None:
    """Two neighbouring times between which `gap` goes below zero for the first time, or None."""
    points = dict(zip(tau.tolist(), values.tolist(), strict=True))
    if values[0] <= TOUCH:
        # Just released, or due at once: look whether it opens at all, and how soon it closes.
        points |= {s: gap(s) for s in float(tau[1]) * 0.5 ** np.arange(1.0, 17.0)}
    for j, value in enumerate(values):
        left, right = max(j - 1, 0), min(j + 1, tau.size - 1)
        if value <= min(values[left], values[right]) and -TOUCH <= value <= bend:
            # Without this, a gap that closes and opens between two points would be missed.
            lowest: Any = minimize_scalar(
                gap, bounds=(tau[left], tau[right]), method="bounded", options={"xatol": 1e-10}
            )
            points[float(lowest.x)] = float(lowest.fun)
    last = 0.0
    for s in sorted(points):
        if points[s] < -TOUCH:
            return last, s
        last = s
    return None


def _root(gap: Callable[[float], float], bracket: tuple[float, float]) -> float:
    a, b = bracket
    if gap(a) <= 0:  # two events at one time: the second one is due at the start
        return a
    return b if gap(b) >= 0 else _zero(gap, a, b)


def _zero(function: Callable[[float], float], a: float, b: float) -> float:
    return float(root_scalar(function, bracket=(a, b), xtol=1e-15, rtol=1e-14).root)


def vibrating_cycle(
    numbers: Numbers, *, rtol: float = 1e-13, atol: float = 1e-14, max_step: float = 0.2
) -> Cycle | None:
    """The stick-slip cycle of one mass, or None if there is none.

    A mass that sticks is always released at the same place, where the belt has brought the
    holding force to its limit. So the one slip phase that starts there is the cycle's. If it does
    not come back to the speed of the belt within one turn it never does: orbits in a plane do not
    cross, so each turn of this one lies inside the turn before.
    """
    assert numbers.n == 1
    v_d = numbers.belt_speed
    if v_d == 0:
        return None
    k = float(numbers.stiffness[0])
    limit = float(numbers.load[0] * numbers.mu_static[0])
    release = (np.sign(v_d) * limit - 2 * float(numbers.damping_ratio[0]) * v_d) / k
    tolerances: dict[str, Any] = {"rtol": rtol, "atol": atol, "max_step": max_step}

    def lands(event: Event) -> bool:
        # The release itself may come as a moment of stick.
        return event.kind == "stick" and event.time > 1e-9

    start = np.array([release]), np.array([v_d])
    horizon = 20 * np.pi / np.sqrt(k)
    slip = integrate(numbers, *start, horizon, stop=lands, **tolerances)
    if not slip.events or not lands(slip.events[-1]):
        return None
    times = np.linspace(0.0, slip.time, 401)
    xs, vs = integrate(numbers, *start, slip.time, times=times, **tolerances)[-2:]
    extremes = []
    for j in np.flatnonzero(vs[:-1, 0] * vs[1:, 0] < 0).tolist():

        def state(s: float, j: int = j) -> Run:
            return integrate(numbers, xs[j], vs[j], s, **tolerances)

        extremes.append(state(_zero(lambda s: state(s).v[0], 0.0, float(times[1]))).x[0])
    stick = (release - float(slip.x[0])) / v_d
    return Cycle(float(np.ptp(extremes)) / 2, float(slip.time + stick), float(stick))
