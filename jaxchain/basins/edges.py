"""Edge states: motions that stay on the boundary between two basins.

Of a `Chain` a side is known by the masses that vibrate; of any model by a classifier.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_kind, check_positive_number, is_traced, shown, to_float
from .._internals import nondifferentiable
from .._types import Given, ScalarLike, State, StateLike
from ..cycles.floquet import LimitCycle, check_force
from ..cycles.limit_cycle import find_limit_cycle
from ..model.arguments import as_chain, as_model, as_state
from ..model.chain import Chain
from ..model.model import AbstractModel
from ..observers.amplitude import Amplitude
from ..observers.quantities import active
from ..observers.samples import Samples
from ..observers.section import Section
from ..observers.stick_time import StickTime
from ..result import Outcome, SearchResult, ended_well
from ..simulation.method import Method, Solver
from ..simulation.run import MOST_SEGMENTS, simulate
from .classifiers import AbstractClassifier

# Two states, stacked: on the quiet side, on the other.
Pair: TypeAlias = tuple[Float[Array, "2 n"], ...]
SETTLE, CUT, TRACK, CHECK, DONE = range(5)
# Windows of the first block, and how much ranges of amplitudes may differ from block to block once
# a start has settled: shares of the distance between the two states and of the ranges themselves,
# unless these are as small a share of the belt speed.
_BLOCK, _SAME, _OF_ITSELF, _RESTS = 16, 0.03, 0.05, 1e-3
# Shares of the difference between quiet and vibrating amplitude: a mass within the first is quiet;
# one within the second vibrates if it also sticks.  Other phases of its neighbours change its
# amplitude by 4 %.
_NEAR_LOW, _NEAR_HIGH = 0.05, 0.1
# Successive windows that must agree.
_AGREE, _SETTLED = 3, 5
# Factor and number of times by which a bracket that has lost the edge is widened.
_WIDER, _MOST_WIDER = 4.0, 8


class Tracking(eqx.Module):
    """Settings of the tracking: windows, their number, distances and tolerances."""

    windows: int = eqx.field(static=True)
    window: Float[Array, ""]
    patience: Float[Array, ""]  # windows until a run must be decided
    near: Float[Array, ""]
    far: Float[Array, ""]
    tolerance: Float[Array, ""]
    rtol: float = eqx.field(static=True)  # a Python number: it sets the order of the series
    solver: Any
    classify: AbstractClassifier | None = None


class EdgeSearch(eqx.Module):
    """The state of the search; along an axis of 2 the quiet side comes first."""

    stage: Int[Array, ""]
    final: Bool[Array, ""]  # no more tracking: the next cut is the last
    ends: Pair  # of the bracket
    runs: Pair  # the present states of the two runs
    count: Int[Array, ""]  # windows since the runs began
    low: Float[Array, "2 n"]  # least and greatest amplitude of a block of windows
    high: Float[Array, "2 n"]
    last_low: Float[Array, "2 n"]  # of the block before
    last_high: Float[Array, "2 n"]
    # Which masses vibrate, or the states as a classifier codes them, of shape (2, k):
    vibrates: Array  # where the starts settle
    sides: Array  # on both sides, as last decided
    pattern: Array  # and in the two runs
    agree: Int[Array, " 2"]  # successive windows with the same decision
    widened: Int[Array, ""]
    tracked: Int[Array, ""]  # windows
    amplitudes: Float[Array, "windows n"]
    distances: Float[Array, " windows"]
    sharp: Float[Array, " n"]  # the last amplitude of a narrow bracket
    repeats: Int[Array, ""]
    result: SearchResult
    size: Float[Array, ""] | None = None  # the distance of the starts, with a classifier

    @property
    def settled(self) -> Bool[Array, ""]:
        """Whether the amplitudes on the edge have settled."""
        return self.repeats >= _SETTLED

    @property
    def distance(self) -> Float[Array, ""]:
        """Between the ends, in displacement and velocity together."""
        return gap(self.ends)


def gap(pair: Pair) -> Float[Array, ""]:
    """The distance between two states."""
    return jnp.sqrt(sum(jnp.sum((part[1] - part[0]) ** 2) for part in pair))


def track(model: Any, quiet: State, vibrating: State, how: Tracking) -> EdgeSearch:
    """The bracket of the edge between two starts, after tracking."""
    pair = tuple(jnp.stack(parts) for parts in zip(quiet, vibrating, strict=True))
    n = pair[0].shape[1]
    zero, blank = jnp.zeros((), int), jnp.full((2, n), jnp.nan, float)
    no_mass = jnp.zeros((2, n), bool)
    if how.classify is not None:
        ends_in = eqx.filter_eval_shape(lambda y: _ends_in(model, y, how)[0], quiet)
        no_mass = jnp.zeros((2, *ends_in.shape), ends_in.dtype)
    first = EdgeSearch(
        stage=zero + SETTLE, final=jnp.asarray(False), ends=pair, runs=pair, count=zero,
        low=blank, high=blank, last_low=blank, last_high=blank, vibrates=no_mass, sides=no_mass,
        pattern=no_mass, agree=jnp.zeros(2, int), widened=zero, tracked=zero,
        amplitudes=jnp.full((how.windows, n), jnp.nan, float),
        distances=jnp.full(how.windows, jnp.nan, float), sharp=blank[0], repeats=zero,
        result=_well(), size=None if how.classify is None else gap(pair),
    )  # fmt: skip

    watch = (Amplitude(), StickTime()) if how.classify is None else (Amplitude(),)

    def advance(start: State) -> tuple[State, Array, Array, Array]:
        run = simulate(
            model, start, how.window, observe=watch, solver=how.solver,
            rtol=how.rtol, adjoint=dfx.ForwardMode(), throw=False,
        )  # fmt: skip
        amplitude, *stick_time = run.observed
        sticks = stick_time[0] > 0 if stick_time else jnp.zeros(n, bool)
        return run.state, amplitude, sticks, ended_well(run.result)

    def classified(now: EdgeSearch) -> EdgeSearch:
        """The same by the states in which whole runs end; only tracking goes by windows."""

        def follow() -> tuple[Pair, Array, Array, Array]:
            runs, amplitude, _, well = jax.vmap(advance)(now.runs)
            return runs, amplitude, now.pattern, well

        def decide() -> tuple[Pair, Array, Array, Array]:
            codes, decided = jax.vmap(lambda y: _ends_in(model, y, how))(now.runs)
            return now.runs, blank, codes, decided

        runs, amplitude, codes, well = lax.cond(now.stage == TRACK, follow, decide)
        late = ~jnp.all(well) & (now.stage != TRACK)
        count = jnp.where(late, jnp.ceil(how.patience).astype(int), now.count + 1)
        now = replace(now, runs=runs, count=count, pattern=codes)
        now = replace(now, agree=jnp.where(well, _AGREE, 0))
        settled = replace(_begin_cut(now), vibrates=codes, sides=codes)
        settled = _failed(settled, ~jnp.all(well), SearchResult.undecided)
        settled = _failed(settled, jnp.all(codes[0] == codes[1]), SearchResult.same_state)
        stages = [settled, _cut(now, how), _track(now, amplitude, how), _check(now, how)]
        new = jax.tree.map(lambda *values: lax.select_n(now.stage, *values), *stages)
        return _failed(new, (now.stage == TRACK) & ~jnp.all(well), SearchResult.nonfinite)

    def window(now: EdgeSearch) -> EdgeSearch:
        runs, amplitude, sticks, well = jax.vmap(advance)(now.runs)
        now = replace(now, runs=runs, count=now.count + 1)
        stages = [
            _settle(model, now, amplitude, how),
            _cut(_judge(model, now, amplitude, sticks), how),
            _track(now, amplitude, how),
            _check(_judge(model, now, amplitude, sticks), how),
        ]
        new = jax.tree.map(lambda *values: lax.select_n(now.stage, *values), *stages)
        return _failed(new, ~jnp.all(well), SearchResult.nonfinite)

    # Windows of both runs decide at once. A classifier needs runs to their ends, which with
    # `VibratingMasses` took 30 to 150 times as long for the same edge of three and of six masses.
    turn = window if how.classify is None else classified
    return lax.while_loop(lambda now: now.stage != DONE, turn, first)


def _ends_in(model: Any, start: State, how: Tracking) -> tuple[Array, Array]:
    """(the code of the state in which a run ends, whether it is decided)."""
    classify: Any = how.classify
    run = simulate(
        model, start, how.patience * how.window, observe=classify, solver=how.solver,
        rtol=how.rtol, adjoint=dfx.ForwardMode(), throw=False,
    )  # fmt: skip
    found = classify.label(run.observed, model)
    decided = jnp.asarray(found["decided"].values) != 0
    return jnp.ravel(found["state"].values), decided & ended_well(run.result)


def _well() -> SearchResult:
    good = SearchResult.successful
    return SearchResult.where(jnp.asarray(True), good, good)  # an array, as in every later turn


def _either(condition: Array, yes: EdgeSearch, no: EdgeSearch) -> EdgeSearch:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _failed(now: EdgeSearch, bad: Array, why: SearchResult) -> EdgeSearch:
    """The search, ended if it is `bad`."""
    return replace(
        now,
        stage=jnp.where(bad, DONE, now.stage),
        result=SearchResult.where(bad & (now.result == SearchResult.successful), why, now.result),
    )


def _settle(chain: Chain, now: EdgeSearch, amplitude: Array, how: Tracking) -> EdgeSearch:
    """Both starts run on until the ranges of their amplitudes agree from block to block.

    Each block is twice as long as the previous one.  Only masses in which the states differ are
    checked; the others may continue to beat.
    """
    count = now.count
    ends = (count >= _BLOCK) & (count & (count - 1) == 0)  # 16, 32, 64, ...
    begun = count - 1
    opens = (begun == 0) | (begun >= _BLOCK) & (begun & (begun - 1) == 0)
    low = jnp.where(opens, amplitude, jnp.minimum(now.low, amplitude))
    high = jnp.where(opens, amplitude, jnp.maximum(now.high, amplitude))
    vibrates = active(0.5 * (low + high), chain.belt_speed)
    before = active(0.5 * (now.last_low + now.last_high), chain.belt_speed)
    differs = vibrates[0] != vibrates[1]
    speed = jnp.abs(chain.belt_speed)
    # In a slow decay the ranges differ little in absolute size, but much relative to themselves.
    way = jnp.abs(0.5 * (low[1] + high[1] - low[0] - high[0]))
    change = jnp.maximum(jnp.abs(low - now.last_low), jnp.abs(high - now.last_high))
    little = change <= _SAME * jnp.where(differs, way, speed)[None]  # false for NaN
    little &= (change <= _OF_ITSELF * high) | (high <= _RESTS * speed)
    compared = differs | ~jnp.any(differs)
    same = jnp.all(~compared[None] | little)
    settled = ends & same & jnp.all(vibrates == before)
    new = replace(
        now,
        low=low,
        high=high,
        vibrates=vibrates,
        sides=vibrates,
        last_low=jnp.where(ends, low, now.last_low),
        last_high=jnp.where(ends, high, now.last_high),
    )
    new = _either(settled, _begin_cut(new), new)
    new = _failed(new, settled & ~jnp.any(differs), SearchResult.same_state)
    return _failed(new, ~settled & (count >= how.patience), SearchResult.undecided)


def _thirds(part: Array) -> Array:
    """The points at a third and two thirds of the bracket."""
    step = (part[1] - part[0]) / 3.0
    return jnp.stack([part[0] + step, part[1] - step])


def _begin(now: EdgeSearch, stage: int, runs: Pair) -> EdgeSearch:
    zero = jnp.zeros((), int)
    return replace(now, stage=zero + stage, runs=runs, count=zero, agree=jnp.zeros(2, int))


def _begin_cut(now: EdgeSearch) -> EdgeSearch:
    return _begin(now, CUT, tuple(map(_thirds, now.ends)))


def _scale(now: EdgeSearch) -> Array:
    """The greatest amplitude of the masses in question."""
    if now.size is not None:
        return now.size
    differs = now.vibrates[0] != now.vibrates[1]
    return jnp.max(jnp.where(differs, jnp.max(now.last_high, axis=0), 0.0))


def _sides(now: EdgeSearch) -> tuple[Array, Array, Array]:
    """(masses in which the states differ, amplitudes quiet and vibrating), shape (1, n) each."""
    (one, other), low, high = now.vibrates, now.last_low, now.last_high
    quiet, lively = jnp.where(other, high[0], high[1]), jnp.where(other, low[1], low[0])
    return (one != other)[None], quiet[None], lively[None]


def is_between(now: EdgeSearch, amplitude: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether amplitudes on the edge are well above the threshold for a quiet mass.

    Otherwise runs that are not quiet may have been classified as quiet.
    """
    differs, quiet, lively = _sides(now)
    return jnp.any(differs & (amplitude[None] > quiet + 2.0 * _NEAR_LOW * (lively - quiet)))


def _judge(chain: Chain, now: EdgeSearch, amplitude: Array, sticks: Array) -> EdgeSearch:
    """The search after the evaluation of one more window of both runs."""
    differs, quiet, lively = _sides(now)
    way = lively - quiet
    is_low = amplitude <= quiet + _NEAR_LOW * way
    is_high = sticks & (amplitude >= lively - _NEAR_HIGH * way)
    pattern = jnp.where(differs, is_high, active(amplitude, chain.belt_speed))
    clear = jnp.all(~differs | is_low | is_high, axis=1)
    same = jnp.all(~differs | (pattern == now.pattern), axis=1) & (now.agree > 0)
    # A decision is final.
    before = now.agree >= _AGREE
    agree = jnp.where(clear, jnp.where(same, now.agree + 1, 1), 0)
    agree = jnp.where(before, now.agree, agree)
    pattern = jnp.where(before[:, None], now.pattern, pattern)
    return replace(now, pattern=pattern, agree=agree)


def _decided(now: EdgeSearch) -> tuple[Bool[Array, " 2"], Bool[Array, " 2"]]:
    """(which of the runs are decided, which are quiet)."""
    differs = (now.vibrates[0] != now.vibrates[1])[None]
    quiet = jnp.all(~differs | (now.pattern == now.vibrates[:1]), axis=1)
    return now.agree >= _AGREE, quiet


def _narrowed(now: EdgeSearch, side: int, third: int) -> EdgeSearch:
    """The end on one side moved to a third of the bracket."""
    ends = tuple(part.at[side].set(_thirds(part)[third]) for part in now.ends)
    return replace(now, ends=ends, sides=now.sides.at[side].set(now.pattern[third]))


def _cut(now: EdgeSearch, how: Tracking) -> EdgeSearch:
    """Moves one end as soon as the runs are decided."""
    decided, quiet = _decided(now)
    below, beyond = decided & quiet, decided & ~quiet
    middle = replace(now, ends=tuple(map(_thirds, now.ends)), sides=now.pattern)
    cut = _either(below[1], _narrowed(now, 0, 1), _either(beyond[0], _narrowed(now, 1, 0), middle))
    done = below[1] | beyond[0] | (below[0] & beyond[1])
    narrow = cut.distance <= how.near * _scale(now)
    follow = _begin(cut, TRACK, cut.ends)
    follow = replace(follow, stage=jnp.where(now.final, DONE, TRACK))
    new = _either(done, _either(narrow, follow, _begin_cut(cut)), now)
    return _failed(new, ~done & (now.count >= how.patience), SearchResult.undecided)


def _track(now: EdgeSearch, amplitude: Array, how: Tracking) -> EdgeSearch:
    """Integrates both ends by a window; the motion between them is recorded."""
    scale, distance, mean = _scale(now), gap(now.runs), jnp.mean(amplitude, axis=0)
    sharp = distance <= how.tolerance * scale
    same = jnp.max(jnp.abs(mean - now.sharp)) <= how.tolerance * scale
    repeats = jnp.where(sharp, jnp.where(same, now.repeats + 1, 0), now.repeats)
    new = replace(
        now,
        amplitudes=now.amplitudes.at[now.tracked].set(mean),
        distances=now.distances.at[now.tracked].set(distance),
        tracked=now.tracked + 1,
        sharp=jnp.where(sharp, mean, now.sharp),
        repeats=repeats,
    )
    final = new.settled | (new.tracked >= how.windows)
    over = final | (distance > how.far * scale)
    left = replace(new, ends=now.runs, final=final, widened=jnp.zeros((), int))
    return _either(over, _begin(left, CHECK, now.runs), new)


def _check(now: EdgeSearch, how: Tracking) -> EdgeSearch:
    """Checks that the ends are on different sides; errors may have moved both to one side."""
    decided, quiet = _decided(now)
    both, same = jnp.all(decided), quiet[0] == quiet[1]

    def moved(part: Array) -> Array:
        step = part[1] - part[0]
        up = jnp.stack([part[1], part[1] + _WIDER * step])
        down = jnp.stack([part[0] - _WIDER * step, part[0]])
        sorted_ = jnp.where(quiet[0], part, part[::-1])
        return jnp.where(same, jnp.where(quiet[0], up, down), sorted_)

    ends = tuple(map(moved, now.ends))
    good = replace(now, ends=ends, sides=jnp.where(quiet[0], now.pattern, now.pattern[::-1]))
    again = replace(_begin(now, CHECK, ends), ends=ends, widened=now.widened + 1)
    new = _either(both, _either(same, again, _begin_cut(good)), now)
    new = _failed(new, both & (new.widened > _MOST_WIDER), SearchResult.edge_lost)
    return _failed(new, ~both & (now.count >= how.patience), SearchResult.undecided)


# Windows examined at the end, and the states in them: one for each period.
_LAST, _RETURNS = 3, 24
# The closing error that is allowed, relative to the size of the orbit.
_CLOSED = 1e-6
RTOL = 1e-11


class EdgeState(Outcome):
    """The motion on the edge between two basins.

    - `state`: (x, v), or all m arrays of other cells, on the edge at the end; `below` and `above`:
      the ends of the bracket, on the quiet and on the vibrating side; `distance`: between these,
      sqrt(|dx|^2 + |dv|^2).  Runs from the two ends go to both sides if their `rtol` is at most
      that of the search.
    - `amplitude`: half peak-to-peak of each mass over three further windows, shape (n,).
    - `period`: of a periodic motion, NaN otherwise; `gap`: the least distance, relative to the
      size of the orbit, at which the motion returns within these windows.
    - `vibrates`: the masses that continue to vibrate from below and from above, shape (2, n); with
      `classify` the codes of both states, shape (2, k).
    - `mass`: the mass (from 0) in which the two sides differ most.
    - `times`, `amplitudes`, `distances`: ends of the windows of the tracking, shape (windows,),
      the amplitude of each mass in them, (windows, n), averaged over both ends of the bracket, and
      the distance of the ends; NaN after the end of the tracking.
    - `result`: the outcome.  If the tracking failed, numbers are NaN.
    - `chain`: the chain of this state.

    Dimensionless: displacements in P/k, times in 1 / omega_n.

    See `edge_state` for an example.
    """

    may_be_missing = ("period", "gap", "times", "amplitudes", "distances")
    chain: AbstractModel
    state: State
    below: State
    above: State
    distance: Float[Array, ""]
    amplitude: Float[Array, " n"]
    period: Float[Array, ""]
    gap: Float[Array, ""]
    vibrates: Array
    mass: Int[Array, ""]
    times: Float[Array, " windows"]
    amplitudes: Float[Array, "windows n"]
    distances: Float[Array, " windows"]
    result: SearchResult

    @property
    def periodic(self) -> Bool[Array, "..."]:
        """Whether the motion closes, to 1e-6 of its size."""
        return jnp.isfinite(self.period)

    def cycle(self, **how: Any) -> LimitCycle:
        """The limit cycle through `state`, by Newton's method: see `find_limit_cycle`.

        **Raises:** `RuntimeError` if there is none, `ValueError` if the motion is not periodic.
        """
        if not is_traced(self.period) and not bool(self.periodic):
            raise ValueError(
                "Argument `edge` is not periodic, so that there is no cycle to close: its `gap` "
                f"after a turn is {float(self.gap):.1e}."
            )
        mass = None if is_traced(self.mass) else int(self.mass)
        how = {"mass": mass} | how
        return find_limit_cycle(self.chain, (self.state, self.period), **how)


def edge_state(
    model: AbstractModel,
    quiet: Given[StateLike],
    vibrating: Given[StateLike],
    *,
    classify: Given[AbstractClassifier | None] = None,
    time: Any = None,
    window: Any = None,
    patience: Any = None,
    near: Given[ScalarLike] = 1e-10,
    far: Given[ScalarLike] = 1e-6,
    tolerance: Given[ScalarLike] = 1e-8,
    rtol: Given[ScalarLike] = RTOL,
    solver: Given[Solver | None] = None,
) -> EdgeState:
    """The state on the edge between the basins of two starts, by bisection and edge tracking.

    On the segment y(s) = y_quiet + s (y_vibrating - y_quiet) there is a point on the edge.  Runs
    from two points in between divide its bracket [a, b] into thirds, until |b - a| <= near A.
    Then a and b are integrated while |b - a| <= far A, the segment between the new states is
    divided again, and so on.  The bracket converges to a motion that is unstable in one direction
    and stable along the edge.  A is the greatest amplitude of the masses in question.

    First both starts settle.  The masses in question are those that vibrate from one start and not
    from the other.  A run is decided when for three windows each of these masses has been quiet,
    with an amplitude within 5 % (of the difference between the two states) of the quiet one, or
    has vibrated, within 10 % of the other amplitude and sticking to the belt.  A mass on the edge
    slides throughout, with repeating amplitudes.

    **Arguments:** (dimensionless)

    - `model`: a `Chain`, with dry friction or smoothed; `AbstractOscillators` or `AbstractCells`
      with `classify`.
    - `quiet`, `vibrating`: (x, v), both of shape (n,), from which different masses continue to
      vibrate; of other cells m arrays.
    - `classify`: an `AbstractClassifier`, whose `state` at the end of a run says to which side it
      belongs, any state but that from `quiet` to the other.  Runs take `patience` unless its
      `settled` ends them, and must be `decided`; A is the distance of the two starts.
    - `time`: the greatest time for which the edge is followed; the search ends as soon as the
      amplitudes of five windows (of a narrow bracket) agree within `tolerance` A.  `window`: at
      least a period, 2 pi for the paper's masses; of forced cells rounded up to a multiple of the
      period of the force.  Within it the two ends must separate by less than `far` / `near`.
      Both are Python numbers; 1000 and 20 in the unit of `natural_scales`.
    - `patience`: the time after which a run must be decided, 20000 in that unit.
    - `near`, `far`: see above.
    - `rtol`, `solver`: as for `simulate`; a small `near` needs a small `rtol`.

    **Returns:** an `EdgeState`.  It works under `jit` and `vmap`; many pairs are followed side by
    side. It has no derivatives (`RuntimeError`); differentiate the cycle on the edge with
    `find_limit_cycle`.  Its `result` is one of

    - "successful": amplitudes on the edge have settled;
    - "not_settled": followed for `time`, but amplitudes do not agree, as for a motion with two
      frequencies; the numbers are returned nevertheless;
    - "other_state": beyond the edge other masses vibrate than from `vibrating`;
    - "same_state", "undecided", "too_close", "edge_lost", "nonfinite": the edge was not found.

    **Raises:** `ValueError` for bad input.

    Source: Skufca, Yorke and Eckhardt, Phys. Rev. Lett. 96, 174101 (2006); Battelino et al.,
    Physica D 32, 296 (1988).

    !!! example

        One mass: the edge is the unstable cycle, on which it slides throughout.

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import excited_state, find_limit_cycle, paper_chain
        >>> from jaxchain.basins import edge_state
        >>> chain = paper_chain(1, belt_speed=1.7, width=None)
        >>> weak, strong = (excited_state(chain, 1, amplitude=a) for a in (0.5, 2.5))
        >>> edge = edge_state(chain, weak, strong)
        >>> exact = find_limit_cycle(chain, branch="unstable")
        >>> bool(abs(edge.amplitude[0] - exact.amplitude[0]) < 1e-6), bool(edge.periodic)
        (True, True)
    """
    if classify is None:
        as_chain(model, remedy="give `classify` for other models.", name="model")
    else:
        as_model(model)
        check_kind("classify", classify, AbstractClassifier, "None or an `AbstractClassifier`")
    quiet, vibrating = as_state(model, quiet, "quiet"), as_state(model, vibrating, "vibrating")
    check_force(model, quiet)
    if len(quiet) != len(vibrating) or quiet[0].shape != vibrating[0].shape:
        raise ValueError(
            "Arguments `quiet` and `vibrating` must have the same shapes, but have "
            f"{[p.shape for p in quiet]} and {[p.shape for p in vibrating]}."
        )
    unit = model.natural_scales()[0]
    usual = (time, 1000.0), (window, 20.0), (patience, 20000.0)
    time, window, patience = (b * unit if a is None else a for a, b in usual)
    check_positive_number("window", window, "20, some three periods, is usual.")
    check_positive_number("time", time, "1000 is usual.")
    check_positive_number("patience", patience, "20000 is usual.")
    for name, value in (("near", near), ("far", far), ("tolerance", tolerance)):
        check_positive_number(name, value, "see `edge_state`.")
    for name, value in (("time", time), ("window", window), ("rtol", rtol)):
        if is_traced(value):
            raise ValueError(
                f"Argument `{name}` decides what is compiled, but is traced: use a number of "
                "Python, the same for every run."
            )
    if not is_traced(near, far) and float(far) < 10.0 * float(near):
        raise ValueError(
            f"Argument `far` must be at least ten times `near` = {near}, but is {shown(far)}: "
            "the ends of the bracket run on from the one distance to the other."
        )
    check_positive_number("rtol", rtol, "1e-6 is usual.")
    solver = Method(solver, rtol).checked(model, quiet[0].size).solver
    length, forced = to_float(window), model.forcing_period()
    if forced is not None:
        length = jnp.ceil(length / forced) * forced  # every run starts at the phase 0 of the force
    windows = _count(time, window if is_traced(length) else float(length))
    how = Tracking(
        windows=windows,
        window=length,
        patience=to_float(patience) / length,
        near=to_float(near),
        far=to_float(far),
        tolerance=to_float(tolerance),
        rtol=float(rtol),
        solver=solver,
        classify=classify,
    )
    return _edge(model, quiet, vibrating, how)


def _count(time: Any, window: Any) -> int:
    """How many windows the edge is followed for."""
    count = round(float(time) / float(window))
    if not 1 <= count <= MOST_SEGMENTS:
        raise ValueError(
            f"Argument `time` must be 1 ... {MOST_SEGMENTS} times the `window`, {window}, but is "
            f"{time}: 1000 is usual."
        )
    return count


@eqx.filter_jit
def _edge(model: AbstractModel, quiet: State, vibrating: State, how: Tracking) -> EdgeState:
    fixed, quiet, vibrating = nondifferentiable(
        (model, quiet, vibrating),
        msg="`edge_state` has no derivatives: find the edge state outside the differentiated "
        "function, and inside it the cycle, `find_limit_cycle(chain, (edge.state, "
        "edge.period))`, which has them.",
    )
    bracket = track(fixed, quiet, vibrating, how)
    below, above = (tuple(part[side] for part in bracket.ends) for side in (0, 1))
    state = tuple(0.5 * (low + high) for low, high in zip(below, above, strict=True))
    if how.classify is None:
        difference = bracket.last_high[1] - bracket.last_high[0]
        differs = bracket.vibrates[0] != bracket.vibrates[1]
        mass = jnp.argmax(jnp.where(differs, jnp.abs(difference), -1.0))
    else:
        apart = [(a - b) ** 2 for a, b in zip(vibrating, quiet, strict=True)]
        mass = jnp.argmax(sum(apart))
    amplitude, period, missing, well = _last(fixed, state, mass, how)
    result = SearchResult.where(
        (bracket.result == SearchResult.successful) & ~well, SearchResult.nonfinite, bracket.result
    )
    if how.classify is None:
        close = (result == SearchResult.successful) & ~is_between(bracket, amplitude)
        result = SearchResult.where(close, SearchResult.too_close, result)
    followed = result == SearchResult.successful
    other = jnp.any(bracket.sides != bracket.vibrates)
    late = SearchResult.where(bracket.settled, result, SearchResult.not_settled)
    late = SearchResult.where(other, SearchResult.other_state, late)
    result = SearchResult.where(followed, late, result)

    def if_exists(tree: Any) -> Any:
        return jax.tree.map(lambda a: jnp.where(followed, a, jnp.nan), tree)

    return EdgeState(
        chain=model,
        state=if_exists(state),
        below=if_exists(below),
        above=if_exists(above),
        distance=if_exists(bracket.distance),
        amplitude=if_exists(amplitude),
        period=if_exists(period),
        gap=if_exists(missing),
        vibrates=bracket.sides,
        mass=mass,
        times=how.window * (1.0 + jnp.arange(how.windows)),
        amplitudes=bracket.amplitudes,
        distances=bracket.distances,
        result=result,
    )


def _last(
    model: AbstractModel, state: State, mass: Array, how: Tracking
) -> tuple[Array, Array, Array, Array]:
    """(amplitudes, period, closing error, whether the runs succeeded).

    The run starts from the middle of the bracket.  The first turning point of the mass in question
    is compared with later ones; of forced cells the first state with those after whole periods.
    """
    forced = model.forcing_period()
    section = Section(mass, _RETURNS) if forced is None else Samples(forced, _RETURNS)
    run = simulate(
        model,
        state,
        _LAST * how.window,
        observe=(Amplitude(), section),
        solver=how.solver,
        rtol=how.rtol,
        throw=False,
    )
    amplitude, (times, *parts) = run.observed
    size = jnp.sqrt(jnp.sum(amplitude**2))
    away = jnp.sqrt(jnp.sum(sum((part - part[:1]) ** 2 for part in parts), axis=1)) / size
    away = jnp.where(jnp.isnan(away).at[0].set(True), jnp.inf, away)
    closes = jnp.argmax(away <= _CLOSED)  # the first return, 0 for none
    period = times[closes] - times[0]
    closed = (closes > 0) & model.can_be_cycle(period, jnp.abs(state[-1]))
    period = jnp.where(closed, period, jnp.nan)
    return amplitude, period, jnp.min(away), ended_well(run.result)
