"""The verdict on a motion of any model from an ensemble of long runs, by the thresholds in
`Criteria`.

A motion is cut at the maxima of one cell, a forced one at multiples of the period of the force.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._checks import (
    check_concrete,
    check_flag,
    check_kind,
    check_nonnegative,
    check_positive_number,
    check_whole,
    shown,
    to_float,
)
from .._progress import progress_bar
from .._statistics import mean_interval
from .._types import ArrayLike, Given, ScalarLike, StateLike
from ..cycles.floquet import check_force
from ..cycles.limit_cycle import ClosedOrbit, StateEquations
from ..cycles.orbit import units_of
from ..model.arguments import as_model, as_state
from ..model.model import AbstractModel
from ..observers.amplitude import Amplitude
from ..observers.quantities import energy
from ..observers.samples import Samples
from ..observers.section import PeakTimes, Section
from ..result import NAMES, Printed, code, ended_well, message
from ..simulation.method import Method, Solver
from ..simulation.run import simulate
from ..sweeps.programs import map_lanes
from .lyapunov import LyapunovSpectrum, lyapunov_spectrum

KINDS = ("rest", "cycle", "unstable", "chaos", "torus", "open")
VERDICTS = (
    "steady sliding", "periodic", "quasi-periodic", "chaotic", "several attractors", "transient",
    "failed",
)  # fmt: skip
# Below this probability runs that do not lock are on another attractor.
_BY_CHANCE = 0.05
# The verdict that each kind stands for.
MEANINGS = {
    "rest": "steady sliding",
    "cycle": "periodic",
    "torus": "quasi-periodic",
    "chaos": "chaotic",
}


@dataclass(frozen=True, repr=False)
class Evidence(Printed):
    """The evidence of one run of an ensemble; unknown values are NaN or empty.

    - `noise`: standard deviation of the noise of the start; `seed`.
    - `kind`: one of `KINDS`, or the name of a failure; `time`: the length of the run; `locked_at`:
      the time from which it was on its orbit, or approached it.
    - `active`: which masses vibrate; `energy`, `energy_deviation`: mean and deviation over the
      windows of the last record; `drift`: relative difference of the means of its halves;
      `novelty`: see `novelty`.
    - `period`, `returns`: of the orbit and of its section; `spread`: see `Recurrence`.
    - `forcing_period`: of forced cells, whose periodic orbits have a multiple of it.
    - `exponents`, `low`, `high`: the leading exponents with 95 % intervals, descending; for a
      periodic orbit those of its multipliers, the first being the zero of the flow unless it is
      forced.  -inf is a
      direction that sticking erases, NaN one below rounding: for a periodic orbit, any value below
      `high`.
    - `smooth`: the same exponents by smoothly weighted averages, see `LyapunovSpectrum`;
      `exponent_time`: the time of the averages, 0 for exponents of multipliers.
    - `slips`: the greatest number of cycles that a vibrating mass gained on another in the second
      half of the last record; `delays`: the delay of each vibrating mass at the end, in periods.
      Both are unknown if a window has less than two maxima, or more than one in 3 time units.
    - `symmetry_time`, `symmetry`: see `symmetry_defect`.
    - `state`: (x, v), or all m arrays of other cells, at the end.

    See `verdict` for an example.
    """

    noise: float
    seed: int
    kind: str = "open"
    time: float = 0.0
    locked_at: float = math.nan
    active: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    energy: float = math.nan
    energy_deviation: float = math.nan
    drift: float = math.nan
    novelty: float = math.nan
    period: float = math.nan
    forcing_period: float = math.nan
    returns: int = 0
    spread: float = math.nan
    exponents: np.ndarray = field(default_factory=lambda: np.zeros(0))
    low: np.ndarray = field(default_factory=lambda: np.zeros(0))
    high: np.ndarray = field(default_factory=lambda: np.zeros(0))
    smooth: np.ndarray = field(default_factory=lambda: np.zeros(0))
    exponent_time: float = 0.0
    slips: float = math.nan
    delays: np.ndarray = field(default_factory=lambda: np.zeros(0))
    symmetry_time: np.ndarray = field(default_factory=lambda: np.zeros(0))
    symmetry: np.ndarray = field(default_factory=lambda: np.zeros(0))
    state: tuple[np.ndarray, ...] = ()

    @property
    def decided(self) -> bool:
        """Whether a longer run would not change the evidence.

        A run with noise must leave an unstable orbit: noise of 1e-8 needs 18 e-folding times.
        """
        return self.kind != "open" and (self.kind != "unstable" or self.noise == 0.0)

    @property
    def verdict(self) -> str:
        """The verdict on this run by itself: one of `VERDICTS`, "transient" unless it is known."""
        return MEANINGS.get(self.kind, "transient")

    @property
    def neutral(self) -> int:
        """The number of exponents that are always zero: that of the flow, unless it is forced."""
        return int(math.isnan(self.forcing_period))

    @property
    def relaxation_time(self) -> float:
        """1 / |slowest exponent| of an attracting orbit: the distance falls by e in this time.

        0 if sticking erases every distance; infinite if the orbit is one of a family, as for
        uncoupled masses; NaN if the exponent is not resolved: then it is below
        `longest_relaxation_time`.
        """
        return self._time(self.exponents)

    @property
    def longest_relaxation_time(self) -> float:
        """The relaxation time of the upper bound of the exponents."""
        return self._time(self.high)

    def _time(self, exponents: np.ndarray) -> float:
        fits = self.kind == "cycle" and len(exponents) > self.neutral
        rate = abs(float(exponents[self.neutral])) if fits else math.nan
        return 1.0 / rate if rate else math.inf


@dataclass(frozen=True, repr=False)
class Verdict(Printed):
    """The verdict on the motion from one start, from an ensemble of runs.

    - `verdict`: "steady sliding" (for other oscillators: an equilibrium), "periodic",
      "quasi-periodic", "chaotic", "several attractors" (with their `shares`), "transient" (not
      decided) or "failed"; `reason`, a sentence with the numbers; `remedy`: what would decide a
      transient, or what to do about a run that failed, else empty.
    - `shares`: which share of the runs with the strongest noise has which verdict by itself.
    - `undisturbed`: the verdict without noise; `depends_on_noise`: whether it differs.
    - `runs`: one `Evidence` per run; `longest`: the longest simulated time.

    See `verdict` for an example.
    """

    verdict: str
    reason: str
    remedy: str
    undisturbed: str
    depends_on_noise: bool
    longest: float
    runs: tuple[Evidence, ...]
    shares: Mapping[str, float] = field(default_factory=dict)

    @property
    def lead(self) -> Evidence:
        """The run with the most exponents among those that decide the verdict."""
        agreeing = [run for run in self.runs if run.verdict == self.verdict != "transient"]
        worst = max(run.noise for run in self.runs)
        noisiest = [run for run in self.runs if run.noise == worst]
        chosen = [r for r in agreeing if r.noise == worst] or agreeing or noisiest
        return max(chosen, key=lambda run: len(run.exponents))


@dataclass(frozen=True)
class Criteria:
    """The thresholds, with their reasons.

    Of `MechanicalCells` they count in the units of `sizes` and `natural_scales`.

    - `rest`: amplitude (x0) of a mass that does not move: above rounding, below any vibration.
      Of other cells it applies to each of the m variables, in its unit; a variable below it
      counts in no other criterion.
    - `near`: spread of section points, relative to the amplitude (of each of the m variables of
      other cells), below which Newton's method is tried; it converges from there, and a periodic
      orbit much farther away is a different one.
    - `sits`: spread of a run that stays on its orbit: above the solver's error of 1e-6, below that
      of a passage near an unstable orbit.
    - `gap`: the residual of Newton's method, relative to the amplitude of each variable of a cell.
    - `zero`: exponents (per time unit) of neutral directions: a tenth of the weakest chaos and of
      the slowest relaxation seen in blocks of vibrating masses, 1e-3.  Give a smaller one for
      cells that are damped more weakly, or whose periods are much longer than 2 pi.
    - `drift`: the greatest difference of the energies of both halves of a record on a torus.
    - `novelty`: its greatest value on a torus, see `novelty`: a steady drift has half
      of it, and 100 points on a square have 0.3.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, verdict
        >>> from jaxchain.chaos import Criteria
        >>> chain = paper_chain(1, belt_speed=1.5, width=None)
        >>> start = jnp.array([2.2]), jnp.zeros(1)
        >>> strict = Criteria(gap=1e-9)  # orbits must close better; all else as by default
        >>> verdict(chain, start, noise=(), criteria=strict).verdict
        'periodic'
    """

    rest: float = 1e-6
    near: float = 0.05
    sits: float = 1e-4
    gap: float = 1e-7
    zero: float = 1e-4
    drift: float = 0.02
    novelty: float = 0.3

    def __post_init__(self) -> None:
        for row in fields(self):
            check_positive_number(row.name, getattr(self, row.name), f"{row.default:g} is usual.")


def judge_exponents(run: Evidence, criteria: Criteria) -> str:
    """The kind of a run that did not close, from its exponents: chaos, cycle, torus or open.

    The flow has one exponent 0, a torus one more; a forced motion lacks that of the flow.

    >>> import numpy as np
    >>> low, high = np.array([1e-3, -1e-5]), np.array([3e-3, 1e-5])
    >>> run = Evidence(0.0, 0, exponents=np.array([2e-3, 0.0]), low=low, high=high)
    >>> judge_exponents(run, Criteria())
    'chaos'
    """
    if not len(run.exponents) or not np.all(np.isfinite(run.exponents[:1])):
        return "open"
    if run.low[0] > 0:
        return "chaos"
    # NaN, an exponent below rounding, is below all others.
    low, high = (np.where(np.isnan(run.exponents), -np.inf, a) for a in (run.low, run.high))
    neutral = (np.abs(low) < criteria.zero) & (np.abs(high) < criteria.zero)
    k = run.neutral
    if len(neutral) <= k or not all(neutral[:k]):
        return "open"
    if high[k] < -criteria.zero:
        return "cycle"
    return "torus" if neutral[k] and _comes_back(run, criteria) else "open"


def _comes_back(run: Evidence, criteria: Criteria) -> bool:
    return not (run.drift > criteria.drift or run.novelty > criteria.novelty)


def judge_torus(runs: Sequence[Evidence], criteria: Criteria) -> bool:
    """Whether the open runs of an ensemble are on a torus, judged by smooth averages.

    Mean +- t s / sqrt(m) over the m runs, Student's t at 95 %, lies within `zero` of 0 for both
    leading exponents (of a forced motion for the first one), and the energies do not drift.
    """
    zeros = 1 + runs[0].neutral
    smooth = [run for run in runs if run.kind == "open" and len(run.smooth) >= zeros]
    if len(smooth) < 2 or not all(_comes_back(run, criteria) for run in smooth):
        return False
    values = np.array([np.sort(run.smooth)[::-1][:zeros] for run in smooth])
    return bool(np.all(np.abs(mean_interval(values)) < criteria.zero))


def classify(runs: Sequence[Evidence]) -> Verdict:
    """The verdict on an ensemble whose runs have their `kind`.

    The verdict is that of the strongest noise, because a state that survives only in exact
    symmetry is not observed in practice; `undisturbed` is the verdict without noise.  Runs on
    unstable orbits do not count if others have left them.  If the runs of the strongest noise
    disagree, or any of them is open, the verdict is "transient"; if any of them failed, "failed".
    Where some lock so early that the others would have done so as well, with the same rate, it is
    "several attractors": of k runs that lock within t, of n in the total time T, (n t / T)^k is
    the probability of this by chance, and it is below 0.05.

    >>> still = [Evidence(noise, 0, kind="cycle") for noise in (0.0, 1e-3)]
    >>> classify(still).verdict
    'periodic'
    >>> classify([Evidence(0.0, 0, kind="unstable"), Evidence(1e-3, 0, kind="chaos")]).verdict
    'chaotic'
    """
    strongest = max(run.noise for run in runs)
    voters = [run for run in runs if run.noise == strongest]
    quiet = [run for run in runs if run.noise == 0.0] or voters
    verdict = _common(voters)
    undisturbed = "periodic" if quiet[0].kind == "unstable" else _common(quiet)
    kinds, votes = Counter(run.kind for run in runs), Counter(run.verdict for run in voters)
    counts = [f"{kinds[kind]} {kind}" for kind in KINDS if kinds[kind]]
    counts += [f"{kinds[name]} failed ({name})" for name in sorted(kinds.keys() - set(KINDS))]
    reason = f"{len(runs)} runs: {', '.join(counts)}"
    reason += "".join(f"; {text}" for text in _numbers(runs, verdict))
    return Verdict(
        verdict=verdict,
        reason=reason,
        remedy=_remedy(voters) if verdict in ("transient", "failed") else "",
        undisturbed=undisturbed,
        depends_on_noise=verdict != undisturbed or any(run.kind == "unstable" for run in quiet),
        longest=max(run.time for run in runs),
        runs=tuple(runs),
        shares={name: count / len(voters) for name, count in votes.items()},
    )


def _common(runs: Sequence[Evidence]) -> str:
    if any(run.kind not in KINDS for run in runs):
        return "failed"
    # Only some runs of an ensemble have exponents: other runs that have not closed count like
    # those.
    if any(run.kind in ("cycle", "rest") for run in runs):
        counted = runs
    else:
        counted = [run for run in runs if len(run.exponents) or run.kind != "open"]
    found = {run.verdict for run in counted}
    if len(found) > 1 and "transient" not in found and _end_apart(runs):
        return "several attractors"
    return found.pop() if len(found) == 1 else "transient"


def _end_apart(runs: Sequence[Evidence]) -> bool:
    """Whether runs that never locked are unlikely to be late ones, see `classify`."""
    ended = [run.locked_at for run in runs if run.kind in ("cycle", "rest")]
    total = sum(ended) + sum(run.time for run in runs if run.kind not in ("cycle", "rest"))
    # False for NaN, a run that was at rest from the start.
    return bool(ended) and (len(runs) * max(ended) / total) ** len(ended) < _BY_CHANCE


def _numbers(runs: Sequence[Evidence], verdict: str) -> list[str]:
    sentences = []
    closed = [run for run in runs if run.kind == "cycle"]
    if closed:
        times = [run.relaxation_time for run in closed]
        resolved = not any(map(math.isnan, times))
        slow = max(times) if resolved else max(run.longest_relaxation_time for run in closed)
        sentences.append(
            f"locked by {min(r.locked_at for r in closed):.0f} to "
            f"{max(r.locked_at for r in closed):.0f}, slowest relaxation time "
            + (f"{slow:.3g}" if resolved else f"below {slow:.3g} (not resolved)")
        )
        if math.isinf(slow):
            sentences.append(
                "the orbit is one of a family: some disturbances neither grow nor decay, such as "
                "those of the phases of masses that are not coupled"
            )
    unstable = [run for run in runs if run.kind == "unstable" and len(run.exponents)]
    if unstable:
        sentences.append(f"an unstable orbit grows at {max(r.exponents[0] for r in unstable):.2e}")
    with_exponents = [r for r in runs if r.kind in ("chaos", "torus", "open") and len(r.exponents)]
    if with_exponents:
        least = min(run.low[0] for run in with_exponents)
        most = max(run.high[0] for run in with_exponents)
        sentences.append(f"greatest exponents within [{least:.2e}, {most:.2e}]")
    never = [run for run in runs if run.kind in ("chaos", "torus", "open")]
    if never and verdict in ("chaotic", "quasi-periodic"):
        total = sum(run.time for run in never)
        # No event in a time t: with 95 % certainty the rate is below 3 / t.
        sentences.append(
            f"none of them locked, so that with 95 % the mean life is above {total / 3:.2g}"
        )
    return sentences


def _remedy(runs: Sequence[Evidence]) -> str:
    kinds = {run.kind for run in runs}
    longest = max(run.time for run in runs)
    failures = sorted(kinds - set(KINDS))
    if failures:
        return " ".join(f"Runs failed with `{name}`: {message(name)}" for name in failures)
    if kinds & {"cycle", "rest"} and len(kinds) > 1:
        ended = sum(run.kind in ("cycle", "rest") for run in runs)
        total = sum(r.locked_at if np.isfinite(r.locked_at) else r.time for r in runs)
        return (
            f"{ended} of {len(runs)} runs have ended on an orbit: the others take "
            f"{total / ended:.2g} on average, or there are two attractors; a `longest` of "
            f"{10 * total / ended:.1g}, or more seeds, would tell."
        )
    if "unstable" in kinds:
        return "Runs with noise stayed on the unstable orbit: take a longer run, or more noise."
    return (
        f"Exponents cannot yet be distinguished from zero, or the motion still changes at "
        f"{longest:.3g}: "
        "a longer `exponent_time` and `longest` would tell."
    )


# A record may be that of many runs, and on the host.
_Numbers: TypeAlias = Any
# The least number of returns for an orbit, and points of the section kept per window.
MOST_RETURNS = 4
_SPIRAL = 5.0


class RunRecord(NamedTuple):
    """The record of a run, window by window; W windows of n masses.

    - `t`: end of each window; `amplitude`: half peak-to-peak in it.
    - `peaks`: times of the maxima of every displacement, NaN where none.
    - `point_times`, `points`: when the reference mass was at a maximum, and the state
      (x_1 .. x_n, v_1 .. v_n) then; of forced cells at multiples of the forcing period.
    - `sizes`: the greatest amplitude over the cells, of each variable of a cell; of masses only
      the displacement counts.
    """

    t: Float[_Numbers, "*batch W"]
    amplitude: Float[_Numbers, "*batch W n"]
    peaks: Float[_Numbers, "*batch W peaks n"]
    point_times: Float[_Numbers, "*batch W points"]
    points: Float[_Numbers, "*batch W points two_n"]
    sizes: Any = None  # (*batch, W, m)


class Recurrence(NamedTuple):
    """How well the points of a section return.

    - `spread`: the greatest distance of a point of the second half of the record from the nearest
      of the `returns` last points, and of the last window's point from the one `returns` later;
      relative to the amplitude, in the greatest component.
    - `returns`: the number of returns of the best fit (1 ... `MOST_RETURNS`); `period`: their
      time.
    """

    spread: float
    returns: int
    period: float


def recurrence(record: RunRecord, *, scale: Any, closed: float = 1e-3) -> Recurrence:
    """Whether the second half of a record repeats the same q points of the section.

    It takes the least q whose spread is below `closed`, or at most 5 times the least of all (an
    orbit approached in a spiral has a smaller spread after a turn of the spiral).  Distances are
    relative to the amplitude `scale`, one number or one for each component.
    """
    points, times = record.points, record.point_times[-1]
    half, last = points[len(points) // 2 :], points[-1]
    tried = []
    for q in range(1, MOST_RETURNS + 1):
        away = np.max(np.abs(half[:, :1] - last[None, :q]) / scale, axis=-1).min(axis=1)
        worst = max(np.max(away), np.max(np.abs(last[q] - last[0]) / scale))
        spread = float(np.nan_to_num(worst, nan=np.inf))
        tried.append(Recurrence(spread, q, float(times[q] - times[0])))
    limit = max(closed, _SPIRAL * min(tried).spread)
    return next(candidate for candidate in tried if candidate.spread <= limit)


def novelty(record: RunRecord) -> float:
    """How new the states of the second half of a record are, 0 ... 1.

    The mean distance of its section points from the nearest of the first half, relative to the
    greatest distance of any two of the second half, in the greatest component.  A filled torus
    gives the spacing of its points, a steady drift one half.
    """
    before, after = np.array_split(record.points[:, 0], 2)
    away = [np.min(np.max(np.abs(before - point), axis=1)) for point in after]
    extent = np.max(np.ptp(after, axis=0))
    return float(np.mean(away) / extent) if extent > 0 else 0.0


def phases(record: RunRecord, masses: Any) -> Float[np.ndarray, "W active"]:
    """Cycles that each of some masses has completed since the first, one number per window.

    Between the maxima of a mass its phase grows linearly by one; that of the first mass in
    `masses` is subtracted.  The phases of locked masses are constant, others drift; whole numbers
    are phase slips.
    """
    peaks = record.peaks[:, :, masses]
    counts = np.sum(np.isfinite(peaks), axis=1)
    before = np.concatenate([np.zeros_like(counts[:1]), np.cumsum(counts, axis=0)[:-1]])
    # At the second maximum of a window, so that the length of a period is known around it.
    length = np.nanmean(np.diff(peaks, axis=1), axis=(0, 1))
    start = peaks[:, 0, :1]
    turned = before + (start - peaks[:, 0]) / length
    return turned - turned[:, :1]


def mean_periods(record: RunRecord, masses: Any) -> Float[np.ndarray, " active"]:
    """Mean time between the maxima of each of some masses over a record."""
    peaks = record.peaks[:, :, masses]
    count = np.sum(np.isfinite(peaks), axis=(0, 1))
    first, last = np.nanmin(peaks, axis=(0, 1)), np.nanmax(peaks, axis=(0, 1))
    return (last - first) / np.maximum(count - 1, 1)


def reflections(active: Bool[np.ndarray, " n"], ends: str) -> list[np.ndarray]:
    """The reflections of a ring, or of a row with free ends, that map the vibrating masses onto
    themselves: index arrays of shape (n,)."""
    n = len(active)
    sums = range(n) if ends == "cyclic" else [n - 1]
    images = [(s - np.arange(n)) % n for s in sums]
    return [image for image in images if np.array_equal(active[image], active)]


def symmetry_defect(
    record: RunRecord, active: Bool[np.ndarray, " n"], period: float, ends: str = "cyclic"
) -> Float[np.ndarray, " W"]:
    """How far the delays of a block are from a mirror image of themselves, window by window.

    min over R, s of max_i |phi_i - phi_{R i} - s| / P, wrapped, with the reflections R that keep
    the block, and s = 0 (the mirror image itself) or P/2 (half a period later); R and s are those
    of the first window.  0 is symmetric, 1/2 the greatest possible value.
    """
    first = record.peaks[:, 0]
    motions = []
    for image in reflections(active, ends):
        moved = active & (image != np.arange(len(active)))
        difference = (first - first[:, image])[:, moved] / period
        shifts = (0.0,) if np.any(active & ~moved) else (0.0, 0.5)
        for shift in shifts:
            windings = difference - shift
            motions.append(np.max(np.abs(windings - np.round(windings)), axis=1, initial=0.0))
    if not motions:
        return np.full(len(first), np.nan)
    return min(motions, key=lambda series: series[0])


# Windows of one compiled run; the least time between maxima of a mass, half a free period.
CHUNK = 20
_LEAST_PERIOD = 3.0
# The ratio of the transient of exponents to their window.
_SETTLE = 0.2
_BLOCKS = 20


class _VerdictTask(eqx.Module):
    """Settings of all runs; `window`: of a record; `time`, `count`: of exponents.

    `forced`: the period of the force, or None; `sizes`: what counts as 1 of each variable.
    """

    chain: AbstractModel
    solver: Any
    window: Array
    time: Array
    forced: Array | None
    sizes: Array
    rtol: float = eqx.field(static=True)
    peaks: int = eqx.field(static=True)  # kept per mass and window
    count: int = eqx.field(static=True)


@dataclass
class VerdictRun:
    """The state of a run; the section is at the maxima of the mass `reference`."""

    start: int
    state: tuple[np.ndarray, ...]
    evidence: Evidence
    reference: int
    outcome: str = "successful"


def _chunk(task: _VerdictTask, t0: Array, reference: Array, *state: Array) -> Any:
    """(the record of the next windows, the state at their end, how the run ended)."""
    section, others = Section(reference, MOST_RETURNS + 1), []
    if task.forced is not None:
        section = Samples(task.forced, MOST_RETURNS + 1)
    is_one_mass = len(state) == 2 and task.chain.velocity_of(0) == 1  # both turn together
    others = [Amplitude(component=k) for k in range(1, 1 if is_one_mass else len(state))]
    watch = Amplitude(), PeakTimes(capacity=task.peaks), section, others
    run = simulate(
        task.chain,
        state,
        t0 + CHUNK * task.window,
        t0=t0,
        observe=watch,
        solver=task.solver,
        rtol=task.rtol,
        segments=CHUNK,
        throw=False,
    )
    amplitude, peaks, (times, *states), more = run.observed
    ends = t0 + task.window * jnp.arange(1, CHUNK + 1)
    sizes = jnp.stack([jnp.max(part, axis=-1) for part in (amplitude, *more)], axis=-1)
    points = jnp.concatenate(states, axis=-1)
    return RunRecord(ends, amplitude, peaks, times, points, sizes), run.state, code(run.result)


def advance(
    task: _VerdictTask, lanes: int, trials: list[VerdictRun], stage: float
) -> Iterator[tuple[VerdictRun, RunRecord]]:
    """Advances trials of equal length to the time `stage`; each with its record until then.

    They run in batches, so that at most one record per lane is kept at a time.
    """
    width = lanes * len(jax.local_devices())
    for first in range(0, len(trials), width):
        batch, records = trials[first : first + width], []
        while batch[0].evidence.time < stage:
            rows = [(t.evidence.time, t.reference, *t.state) for t in batch]
            columns = [np.stack(column) for column in zip(*rows, strict=True)]
            record, state, ended = map_lanes(_chunk, task, columns, lanes=lanes)
            records.append(record)
            for k, trial in enumerate(batch):
                trial.state, trial.outcome = tuple(part[k] for part in state), NAMES[ended[k]]
                time = trial.evidence.time + CHUNK * float(task.window)
                trial.evidence = replace(trial.evidence, time=time)
        whole = RunRecord(*(np.concatenate(parts, axis=1) for parts in zip(*records, strict=True)))
        for k, trial in enumerate(batch):
            yield trial, RunRecord(*(part[k] for part in whole))


def _spectrum(task: _VerdictTask, *state: Array) -> LyapunovSpectrum:
    return lyapunov_spectrum(
        task.chain,
        state,
        (1.0 + _SETTLE) * task.time,
        transient=_SETTLE * task.time,
        count=task.count,
        blocks=_BLOCKS,
        solver=task.solver,
        rtol=task.rtol,
        throw=False,
    )


def measure_exponents(
    task: _VerdictTask, lanes: int, trials: list[VerdictRun], done: Callable[[int], object]
) -> None:
    """Adds the leading exponents of runs to their evidence.

    `done` is called with the number of runs measured since the last call.
    """
    if not trials:
        return
    columns = [np.stack(parts) for parts in zip(*(t.state for t in trials), strict=True)]
    spectra = map_lanes(_spectrum, task, columns, lanes=lanes, done=done)
    time = float(task.time)
    for k, trial in enumerate(trials):
        order = np.argsort(-spectra.exponents[k])
        names = ("exponents", "low", "high", "smooth")
        trial.state = tuple(part[k] for part in spectra.state)
        trial.outcome = NAMES[code(spectra.result)[k]]
        trial.evidence = replace(
            trial.evidence,
            **{name: getattr(spectra, name)[k][order] for name in names},
            exponent_time=time,
            time=trial.evidence.time + (1.0 + _SETTLE) * time,
            # Exponents of a run that fails are NaN, however long it runs.
            kind=trial.evidence.kind if ended_well(trial.outcome) else trial.outcome,
        )


# An exponent within this number of its errors counts as zero.
_NEUTRAL = 10.0
# Closed orbits found from one state: the reference mass, a point of the section, the orbit.
KnownOrbits = list[tuple[int, np.ndarray, ClosedOrbit]]


def judge_orbit(
    task: _VerdictTask,
    criteria: Criteria,
    trial: VerdictRun,
    record: RunRecord,
    orbits: KnownOrbits,
) -> Evidence:
    """The evidence of a run with its record, and whether it is decided.

    If a run ends on one of the `known` orbits, no new search is made; a new orbit is added to
    them.
    """
    evidence = replace(trial.evidence, kind="open", state=trial.state)
    if not ended_well(trial.outcome):
        return replace(evidence, kind=trial.outcome)
    amplitude, reference = record.amplitude, trial.reference
    half, n = len(amplitude) // 2, amplitude.shape[1]
    size = record.sizes[-1]
    least = criteria.rest * np.asarray(task.sizes)[: len(size)]
    moves = size >= least
    energies = np.asarray(energy(jnp.asarray(amplitude)))[half:]
    mean, deviation = float(np.mean(energies)), float(np.std(energies))
    evidence = replace(evidence, energy=mean, energy_deviation=deviation)
    if not np.any(moves):
        still = np.zeros(n, bool)
        return replace(evidence, active=still, kind="rest", locked_at=evidence.time, spread=0.0)
    # The size of the orbit in each component; one that does not move is noise.
    scale = np.repeat(np.where(moves, size, np.inf), n) if len(moves) > 1 else size
    active = amplitude[-1] > 0.5 * max(size[0], least[0])
    masses = np.flatnonzero(active)
    evidence = replace(evidence, active=active)
    if masses.size:
        before, after = (np.mean(part) for part in np.array_split(energies, 2))
        evidence = replace(evidence, drift=float(abs(before - after) / np.mean(energies)))
    counted = np.isfinite(record.peaks[:, :, masses])
    if masses.size and counted[:, 1].any(axis=0).all() and not counted[:, -1].any():
        turned = phases(record, masses)
        period = float(np.mean(mean_periods(record, masses)))
        defect = symmetry_defect(record, active, period, task.chain.ends)
        evidence = replace(
            evidence,
            slips=float(np.max(np.abs(turned[-1] - turned[half]))),
            period=period,
            delays=record.peaks[-1, 1, masses] / period,
            symmetry_time=np.append(evidence.symmetry_time, record.t),
            symmetry=np.append(evidence.symmetry, defect),
        )
    if task.forced is None and reference not in masses:
        # The reference mass does not move; the middle of the vibrating masses moves most
        # regularly.
        if masses.size:
            trial.reference = int(masses[np.argmin(np.abs(masses - n // 2))])
        return evidence
    spread, returns, period = recurrence(record, scale=scale, closed=criteria.sits)
    evidence = replace(evidence, novelty=novelty(record), spread=spread, returns=returns)
    if spread > criteria.near or not period > 0:
        return evidence
    point = record.points[-1, 0]
    near = (
        o for mass, p, o in orbits
        if mass == reference and np.max(np.abs(p - point) / scale) < criteria.sits
    )  # fmt: skip
    orbit = next(near, None)
    if orbit is None:
        start = tuple(jnp.asarray(part) for part in np.split(point, len(trial.state)))
        # What does not move must close, too: as well as the smallest of what moves.
        sizes = np.where(np.isfinite(scale), scale, np.min(scale))
        rtol = min(task.rtol, 1e-9)
        units = units_of(task.chain, start)
        equations = StateEquations(task.chain, rtol, task.solver, len(start), n, units=units)
        orbit = equations.close(start, to_float(period), to_float(sizes))
        if not (orbit.gap < criteria.gap and orbit.distance < 4 * criteria.near):
            return evidence
        orbits.append((reference, point, orbit))
    apart = np.abs(record.points[:, :1] - record.points[-1][None, :returns]) / scale
    outside = np.flatnonzero(~(apart.max(-1).min(1) < criteria.near))
    # The time since which the run has stayed close to its end.
    locked_at = float(record.t[outside[-1]]) if outside.size else evidence.time
    return _on_orbit(evidence, orbit, spread < criteria.sits, locked_at)


def _on_orbit(evidence: Evidence, orbit: ClosedOrbit, sits: bool, locked_at: float) -> Evidence:
    period = float(orbit.period)
    # An unresolved exponent, NaN, has a known upper bound.
    flow = np.zeros(evidence.neutral)
    rates, highest = (np.append(flow, a) for a in (orbit.exponents, orbit.highest_exponents))
    # Every multiplier may have the error of the trivial one; it affects rates of small ones more.
    error = max(float(orbit.defect), 1e-9) / period
    finite = np.isfinite(rates)
    errors = np.where(finite, error * np.exp(-np.where(finite, rates, 0.0) * period), 0.0)
    greatest = np.argmax(highest[flow.size :]) + flow.size
    stable = highest[greatest] < -errors[greatest]
    # One of a family of orbits: phases of uncoupled masses neither lock nor drift.
    neutral = sits and abs(highest[greatest]) <= _NEUTRAL * errors[greatest]
    if not (stable or neutral) and not (sits and highest[greatest] > errors[greatest]):
        return evidence
    if neutral:
        rates = np.where(np.abs(rates) <= _NEUTRAL * errors, 0.0, rates)
    order = np.argsort(-highest, kind="stable")
    return replace(
        evidence,
        kind="cycle" if stable or neutral else "unstable",
        period=period,
        locked_at=locked_at,
        exponents=rates[order],
        high=(highest + errors)[order],
        low=np.where(np.isnan(rates), -np.inf, rates - errors)[order],
    )


# The most runs of one kind; the remedy for systems without a verdict.
_MOST_RUNS = 10**5
_INSTEAD = "use `lyapunov_spectrum` or `simulate`."
_NOISE = "it holds standard deviations, such as (1e-8, 1e-3)."


def verdict(model: AbstractModel, initial: Given[StateLike], **settings: Any) -> Verdict:
    """Whether the motion from `initial` is steady, periodic, quasi-periodic or chaotic.

    **Arguments:** `model`; `initial`, the pair (x, v), both of shape (n,), or all m arrays of
    other cells; `settings` as for `verdicts`.

    **Returns:** a `Verdict`.

    **Raises:** `ValueError` for bad input.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, verdict
        >>> chain = paper_chain(n=1, belt_speed=1.5, width=None)
        >>> found = verdict(chain, (jnp.array([2.2]), jnp.zeros(1)))
        >>> found.verdict
        'periodic'
        >>> print(found.reason)  # a mass that sticks forgets everything
        7 runs: 7 cycle; locked by 2000 to 2000, slowest relaxation time 0
    """
    as_model(model)
    check_concrete(_INSTEAD, model=model, initial=initial)
    state = as_state(model, initial)
    return verdicts(model, tuple(part[None] for part in state), **settings)[0]


def verdicts(
    model: AbstractModel,
    initials: Given[ArrayLike],
    *,
    noise: Any = None,
    seeds: Any = 3,
    first: Any = None,
    longest: Any = None,
    exponent_time: Any = None,
    exponent_runs: Given[int] = 3,
    count: Given[int] = 3,
    window: Any = None,
    solver: Given[Solver | None] = None,
    rtol: Given[ScalarLike] = 1e-6,
    criteria: Criteria | None = None,
    lanes: Given[int] = 16,
    key: int = 0,
    progress: bool = False,
    description: str = "verdicts",
) -> list[Verdict]:
    """A verdict for each of several initial states of a chain, with all their runs at once.

    Every state is run without noise, and `seeds` times with each level of `noise` added to
    displacements and velocities, or to all m variables of other cells.  A run continues, doubling
    its time, until it is steady or approaches a periodic orbit that Newton's method has found, at
    most to `longest`.  The leading exponents are measured for runs that never close.

    A forced motion (see `AbstractCells.forcing_period`) is examined at multiples of the period of
    the force, and is periodic if it repeats after one to four of them, or if all its exponents
    are negative.  Without forcing, states at the maxima of the first variable of a cell are
    examined; if only other numbers move, and for an angle that grows, the exponents decide.

    **Arguments:**

    - `model`: a `Chain`, `AbstractOscillators` or `AbstractCells`; `initials`: (x, v), both of
      shape (states, n), or all m arrays of other cells.  Forced ones start at t = 0.
    - `noise`: standard deviations, ascending, in the units of the numbers: far below the size of
      the motion; () runs each state once.  1e-8 and 1e-3, of `MechanicalCells` in the units of
      their `sizes`.
    - `first`, `longest`: the run is examined after the time `first`, and whenever its time has
      doubled, up to `longest`; rounded up to chunks of 20 windows.  2000 and 32000, like all
      times here in the unit of `natural_scales`.
    - `exponent_time` (10000): window for exponents, after a fifth of it for directions to settle;
      `exponent_runs`: the number of runs of a state to measure, first the one without noise, then
      the noisiest; `count`: the number of exponents.
    - `window` (50): time over which amplitudes are measured, at least five periods; of a forced
      motion rounded up to a multiple of the period of the force, at least five of them.
    - `solver`, `rtol`: as for `simulate`.
    - `criteria`: the thresholds; `key`: of the noise.
    - `lanes`: the number of runs side by side on each device; the last bits depend on it, but not
      on the number of devices.
    - `progress`, `description`: a progress bar and its name.

    **Returns:** a `Verdict` for each state.  A failed run has the failure as its `kind` and does
    not affect the others.

    **Raises:** `ValueError` for bad input.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.chaos import verdicts
        >>> chain = paper_chain(1, belt_speed=1.5, width=None)
        >>> starts = jnp.array([[0.6], [2.2]]), jnp.zeros((2, 1))  # near sliding, and far from it
        >>> found = verdicts(chain, starts, noise=(1e-3,), seeds=1)
        >>> [one.verdict for one in found]
        ['steady sliding', 'periodic']
    """
    as_model(model)
    criteria = Criteria() if criteria is None else criteria
    check_kind("criteria", criteria, Criteria, "None or `Criteria`", "`Criteria()` has them.")
    check_concrete(_INSTEAD, model=model, initials=initials)
    states = as_state(model, initials, "initials", batch=True)
    first_state = as_state(model, tuple(part[0] for part in states), "initials")
    check_force(model, first_state)
    counts = (seeds, "seeds"), (exponent_runs, "exponent_runs"), (lanes, "lanes")
    for value, name in counts:
        check_whole(name, value, 1, _MOST_RUNS, "every one of them is a run.")
    check_whole("count", count, remedy="of the leading exponents 3 are usual.")
    check_whole("key", key, 0, remedy="it is the seed of the noise.")
    check_flag("progress", progress)
    check_kind("description", description, str, "the name of the progress bar")
    time = float(model.natural_scales()[0])
    sizes = model.sizes(first_state) or (1.0,) * len(first_state)
    sizes = np.array([float(size) or 1.0 for size in sizes])
    usual = (first, 2000.0), (longest, 32000.0), (exponent_time, 10000.0), (window, 50.0)
    every = [b * time if a is None else a for a, b in usual]
    first, longest, exponent_time, window = every
    times = (first, "first"), (longest, "longest"), (exponent_time, "exponent_time")
    for value, name in (*times, (window, "window")):
        check_positive_number(name, value, "a period is about 2 pi; see the defaults.")
    check_positive_number("rtol", rtol, "1e-6 is usual.")
    solver = Method(solver, rtol).checked(model, first_state[0].size).solver
    units = sizes if noise is None else np.ones_like(sizes)
    noise = (1e-8, 1e-3) if noise is None else noise
    if np.shape(to_float(noise, "noise", _NOISE)) != (len(np.ravel(noise)),):
        raise ValueError(f"Argument `noise` must be a sequence, but is {shown(noise)}: {_NOISE}")
    check_nonnegative("noise", noise, _NOISE)
    if longest < first:
        raise ValueError(f"Argument `longest` = {longest} must be at least `first` = {first}.")
    forced = model.forcing_period()
    if forced is not None:
        # Whole periods, so that every part of a run starts at the phase 0 of the force.
        forced = float(forced)
        window = max(math.ceil(window / forced), MOST_RETURNS + 1) * forced
        whole = math.ceil((1.0 + _SETTLE) * exponent_time / forced) * forced
        exponent_time = whole / (1.0 + _SETTLE)
    criteria = replace(criteria, zero=criteria.zero / time)
    trials = _starts(states, noise, units, seeds, key, math.nan if forced is None else forced)
    task = _VerdictTask(
        model,
        solver,
        jnp.asarray(float(window)),
        jnp.asarray(float(exponent_time)),
        None if forced is None else jnp.asarray(forced),
        jnp.asarray(sizes),
        float(rtol),
        peaks=int(window / (_LEAST_PERIOD * time)) + 2,
        count=min(int(count), sum(part.size for part in first_state)),
    )
    lanes = min(lanes, len(trials))
    orbits: list[KnownOrbits] = [[] for _ in states[0]]

    def advance_and_judge(going: list[VerdictRun], stage: float, *, again: bool = False) -> None:
        for trial, record in advance(task, lanes, going, stage):
            evidence = judge_orbit(task, criteria, trial, record, orbits[trial.start])
            # If a run has not locked at the second examination, its longer record is better
            # evidence.
            if not again or evidence.decided:
                trial.evidence = evidence

    with progress_bar(total=len(trials), desc=description, unit="run", show=progress) as bar:
        stage = first
        while True:
            going = [trial for trial in trials if not trial.evidence.decided]
            advance_and_judge(going, stage)
            bar.update(sum(trial.evidence.decided for trial in going))
            if stage >= longest or all(trial.evidence.decided for trial in trials):
                break
            # Runs have a whole number of chunks, so they may be longer than requested.
            reached = min(t.evidence.time for t in trials if not t.evidence.decided)
            while stage < longest and stage <= reached:
                stage = min(2.0 * stage, longest)
            if stage <= reached:
                break
        measured = _for_exponents(trials, exponent_runs)
        bar.update(sum(not trial.evidence.decided for trial in trials) - len(measured))
        measure_exponents(task, lanes, measured, bar.update)
        # Runs that have locked meanwhile are closed, too.
        end = max((trial.evidence.time for trial in measured), default=0.0)
        advance_and_judge(measured, end + 1.0, again=True)
    groups = [[t.evidence for t in trials if t.start == i] for i in range(len(orbits))]
    return [classify(_judged(group, criteria)) for group in groups]


def _judged(runs: Sequence[Evidence], criteria: Criteria) -> list[Evidence]:
    """The runs of one state; those with exponents that did not close are judged by these."""
    torus, judged = judge_torus(runs, criteria), []
    for run in runs:
        if run.kind == "open" and len(run.exponents):
            kind = "torus" if torus else judge_exponents(run, criteria)
            locked_at = run.time if kind == "cycle" else run.locked_at
            run = replace(run, kind=kind, locked_at=locked_at)
        judged.append(run)
    return judged


def _starts(
    states: tuple[Array, ...], noise: Sequence[float], units: Any, seeds: int, key: int,
    forced: float,
) -> list[VerdictRun]:  # fmt: skip
    trials, (count, n) = [], states[0].shape
    rng = np.random.default_rng(key)
    levels = [(0.0, 0)] + [(float(level), seed) for level in noise for seed in range(seeds)]
    for i, (level, seed) in itertools.product(range(count), levels):
        state = tuple(
            np.asarray(part[i]) + level * unit * rng.normal(size=n)
            for part, unit in zip(states, units, strict=True)
        )
        evidence = Evidence(level, seed, forcing_period=forced)
        trials.append(VerdictRun(i, state, evidence, n // 2))
    return trials


def _for_exponents(trials: list[VerdictRun], most: int) -> list[VerdictRun]:
    """Up to `most` open runs of each state: the one without noise, then the noisiest."""
    chosen = []
    for i in {trial.start for trial in trials}:
        open_trials = [t for t in trials if t.start == i and t.evidence.kind == "open"]
        chosen += sorted(open_trials, key=lambda t: -(t.evidence.noise or np.inf))[:most]
    return chosen
