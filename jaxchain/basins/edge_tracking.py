"""A bracket of the edge between two basins, cut and followed: one loop over windows of time.

Two runs go on side by side, a window of time after the other.  What they are for changes:

    SETTLE  from both starts, until amplitudes repeat: what vibrates on either side
    CUT     from both thirds of the bracket, until each is decided: the bracket shrinks
    TRACK   from both ends of the bracket, while they stay close: the motion on the edge
    CHECK   from where the ends have got to, until each is decided: does it hold the edge still?

then CUT again, and so on.  Under `vmap` every lane is at its own stage; none waits for another.

A run is decided against the two states on which the starts settle, by the masses that vibrate in
one of them only.  That its amplitudes repeat themselves decides nothing, for so they do near the
edge, the longer the nearer it is.
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

from .._types import State
from ..model.chain import Chain
from ..observers.amplitude import Amplitude
from ..observers.quantities import active
from ..observers.stick_time import StickTime
from ..result import SearchResult, ended_well
from ..simulation.run import simulate

# Two states, stacked: on the quiet side, on the other.
Pair: TypeAlias = tuple[Float[Array, "2 n"], Float[Array, "2 n"]]
SETTLE, CUT, TRACK, CHECK, DONE = range(5)
# Windows of the first block, and by what shares ranges of amplitudes may differ from block to
# block where a start has settled: of the way between the two states, and of themselves, unless
# they are as small a share of the belt speed.
_BLOCK, _SAME, _OF_ITSELF, _RESTS = 16, 0.03, 0.05, 1e-3
# Of the way from the quiet amplitude to the other one: a mass that is nearer than this is quiet,
# or vibrates if it sticks, too.  Other phases of its neighbours change its amplitude by 4 %.
_NEAR_LOW, _NEAR_HIGH = 0.05, 0.1
# Windows in succession that must say the same.
_AGREE, _SETTLED = 3, 5
# A bracket that has lost the edge is made so much wider, so many times.
_WIDER, _MOST_WIDER = 4.0, 8


class Tracking(eqx.Module):
    """What is asked for: windows of time, their number, distances and tolerances."""

    windows: int = eqx.field(static=True)
    window: Float[Array, ""]
    patience: Float[Array, ""]  # windows until a run must be decided
    near: Float[Array, ""]
    far: Float[Array, ""]
    tolerance: Float[Array, ""]
    rtol: float = eqx.field(static=True)  # a number: the order of the series is chosen by it
    solver: Any


class Bracket(eqx.Module):
    """The search under way; along an axis of 2 the quiet side is first, then the other."""

    stage: Int[Array, ""]
    final: Bool[Array, ""]  # no more tracking: the next cut is the last
    x: Float[Array, "2 n"]  # the ends of the bracket
    v: Float[Array, "2 n"]
    runs: Pair  # where the two runs have got to
    count: Int[Array, ""]  # windows since they began
    low: Float[Array, "2 n"]  # least and greatest amplitude of a block of windows
    high: Float[Array, "2 n"]
    last_low: Float[Array, "2 n"]  # of the block before
    last_high: Float[Array, "2 n"]
    vibrates: Bool[Array, "2 n"]  # in the states on which the starts settle
    sides: Bool[Array, "2 n"]  # which masses vibrate on both sides, as last decided
    pattern: Bool[Array, "2 n"]  # and in the two runs
    agree: Int[Array, " 2"]  # windows in succession in which it was that
    widened: Int[Array, ""]
    tracked: Int[Array, ""]  # windows
    amplitudes: Float[Array, "windows n"]
    distances: Float[Array, " windows"]
    sharp: Float[Array, " n"]  # the last amplitude of a narrow bracket
    repeats: Int[Array, ""]
    result: SearchResult

    @property
    def settled(self) -> Bool[Array, ""]:
        """Whether the motion on the edge repeats itself."""
        return self.repeats >= _SETTLED

    @property
    def distance(self) -> Float[Array, ""]:
        """Between the ends, in displacement and velocity together."""
        return gap((self.x, self.v))


def gap(pair: Pair) -> Float[Array, ""]:
    """The distance between two states."""
    return jnp.sqrt(sum(jnp.sum((part[1] - part[0]) ** 2) for part in pair))


def track(chain: Chain, quiet: State, vibrating: State, how: Tracking) -> Bracket:
    """The bracket of the edge between two starts, after tracking."""
    x, v = (jnp.stack(parts) for parts in zip(quiet, vibrating, strict=True))
    n = x.shape[1]
    zero, blank = jnp.zeros((), int), jnp.full((2, n), jnp.nan, float)
    nobody = jnp.zeros((2, n), bool)
    first = Bracket(
        stage=zero + SETTLE, final=jnp.asarray(False), x=x, v=v, runs=(x, v), count=zero,
        low=blank, high=blank, last_low=blank, last_high=blank, vibrates=nobody, sides=nobody,
        pattern=nobody, agree=jnp.zeros(2, int), widened=zero, tracked=zero,
        amplitudes=jnp.full((how.windows, n), jnp.nan, float),
        distances=jnp.full(how.windows, jnp.nan, float), sharp=blank[0], repeats=zero,
        result=_well(),
    )  # fmt: skip

    def advance(start: State) -> tuple[State, Array, Array, Array]:
        run = simulate(
            chain, start, how.window, observe=(Amplitude(), StickTime()), solver=how.solver,
            rtol=how.rtol, adjoint=dfx.ForwardMode(), throw=False,
        )  # fmt: skip
        amplitude, held = run.observed
        return run.state, amplitude, held > 0, ended_well(run.result)

    def window(now: Bracket) -> Bracket:
        runs, amplitude, sticks, well = jax.vmap(advance)(now.runs)
        now = replace(now, runs=runs, count=now.count + 1)
        stages = [
            _settle(chain, now, amplitude, how), _cut(_judge(chain, now, amplitude, sticks), how),
            _track(now, amplitude, how), _check(_judge(chain, now, amplitude, sticks), how),
        ]  # fmt: skip
        new = jax.tree.map(lambda *own: lax.select_n(now.stage, *own), *stages)
        return _failed(new, ~jnp.all(well), SearchResult.nonfinite)

    return lax.while_loop(lambda now: now.stage != DONE, window, first)


def _well() -> SearchResult:
    good = SearchResult.successful
    return SearchResult.where(jnp.asarray(True), good, good)  # an array, as in every later turn


def _either(condition: Array, yes: Bracket, no: Bracket) -> Bracket:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _failed(now: Bracket, bad: Array, why: SearchResult) -> Bracket:
    """The same, ended if it is `bad`."""
    return replace(
        now,
        stage=jnp.where(bad, DONE, now.stage),
        result=SearchResult.where(bad & (now.result == SearchResult.successful), why, now.result),
    )


def _settle(chain: Chain, now: Bracket, amplitude: Array, how: Tracking) -> Bracket:
    """Both starts run on until the ranges of their amplitudes agree from block to block.

    Each block is twice as long as the one before it.  Only masses in which the states differ are
    asked: the others may go on beating.
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
    # Of a decay that is slow the ranges hardly differ, but by much compared with themselves.
    way = jnp.abs(0.5 * (low[1] + high[1] - low[0] - high[0]))
    change = jnp.maximum(jnp.abs(low - now.last_low), jnp.abs(high - now.last_high))
    little = change <= _SAME * jnp.where(differs, way, speed)[None]  # false for NaN
    little &= (change <= _OF_ITSELF * high) | (high <= _RESTS * speed)
    asked = differs | ~jnp.any(differs)
    same = jnp.all(~asked[None] | little)
    settled = ends & same & jnp.all(vibrates == before)
    new = replace(
        now, low=low, high=high, vibrates=vibrates, sides=vibrates,
        last_low=jnp.where(ends, low, now.last_low),
        last_high=jnp.where(ends, high, now.last_high),
    )  # fmt: skip
    new = _either(settled, _begin_cut(new), new)
    new = _failed(new, settled & ~jnp.any(differs), SearchResult.same_state)
    return _failed(new, ~settled & (count >= how.patience), SearchResult.undecided)


def _thirds(part: Array) -> Array:
    """What lies a third and two thirds of the way from one end to the other."""
    step = (part[1] - part[0]) / 3.0
    return jnp.stack([part[0] + step, part[1] - step])


def _begin(now: Bracket, stage: int, runs: Pair) -> Bracket:
    zero = jnp.zeros((), int)
    return replace(now, stage=zero + stage, runs=runs, count=zero, agree=jnp.zeros(2, int))


def _begin_cut(now: Bracket) -> Bracket:
    return _begin(now, CUT, (_thirds(now.x), _thirds(now.v)))


def _scale(now: Bracket) -> Array:
    """The greatest amplitude of the masses in question."""
    differs = now.vibrates[0] != now.vibrates[1]
    return jnp.max(jnp.where(differs, jnp.max(now.last_high, axis=0), 0.0))


def _sides(now: Bracket) -> tuple[Array, Array, Array]:
    """(masses in which the states differ, their amplitudes quiet and not), shape (1, n) each."""
    (one, other), low, high = now.vibrates, now.last_low, now.last_high
    quiet, lively = jnp.where(other, high[0], high[1]), jnp.where(other, low[1], low[0])
    return (one != other)[None], quiet[None], lively[None]


def is_between(now: Bracket, amplitude: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether amplitudes on the edge are well above those that decide that a mass is quiet.

    Otherwise that may have been decided of runs that were not.
    """
    differs, quiet, lively = _sides(now)
    return jnp.any(differs & (amplitude[None] > quiet + 2.0 * _NEAR_LOW * (lively - quiet)))


def _judge(chain: Chain, now: Bracket, amplitude: Array, sticks: Array) -> Bracket:
    """With what a window says of both runs."""
    differs, quiet, lively = _sides(now)
    way = lively - quiet
    is_low = amplitude <= quiet + _NEAR_LOW * way
    is_high = sticks & (amplitude >= lively - _NEAR_HIGH * way)
    pattern = jnp.where(differs, is_high, active(amplitude, chain.belt_speed))
    clear = jnp.all(~differs | is_low | is_high, axis=1)
    same = jnp.all(~differs | (pattern == now.pattern), axis=1) & (now.agree > 0)
    # What has been decided stays so.
    before = now.agree >= _AGREE
    agree = jnp.where(clear, jnp.where(same, now.agree + 1, 1), 0)
    agree = jnp.where(before, now.agree, agree)
    pattern = jnp.where(before[:, None], now.pattern, pattern)
    return replace(now, pattern=pattern, agree=agree)


def _decided(now: Bracket) -> tuple[Bool[Array, " 2"], Bool[Array, " 2"]]:
    """(which of the runs are decided, which are quiet)."""
    differs = (now.vibrates[0] != now.vibrates[1])[None]
    quiet = jnp.all(~differs | (now.pattern == now.vibrates[:1]), axis=1)
    return now.agree >= _AGREE, quiet


def _narrowed(now: Bracket, side: int, third: int) -> Bracket:
    """The end on one side moved to a third of the bracket."""
    x = now.x.at[side].set(_thirds(now.x)[third])
    v = now.v.at[side].set(_thirds(now.v)[third])
    return replace(now, x=x, v=v, sides=now.sides.at[side].set(now.pattern[third]))


def _cut(now: Bracket, how: Tracking) -> Bracket:
    """One end is moved as soon as the runs allow it."""
    decided, quiet = _decided(now)
    below, beyond = decided & quiet, decided & ~quiet
    middle = replace(now, x=_thirds(now.x), v=_thirds(now.v), sides=now.pattern)
    cut = _either(below[1], _narrowed(now, 0, 1), _either(beyond[0], _narrowed(now, 1, 0), middle))
    done = below[1] | beyond[0] | (below[0] & beyond[1])
    narrow = cut.distance <= how.near * _scale(now)
    follow = _begin(cut, TRACK, (cut.x, cut.v))
    follow = replace(follow, stage=jnp.where(now.final, DONE, TRACK))
    new = _either(done, _either(narrow, follow, _begin_cut(cut)), now)
    return _failed(new, ~done & (now.count >= how.patience), SearchResult.undecided)


def _track(now: Bracket, amplitude: Array, how: Tracking) -> Bracket:
    """Both ends go on; the motion between them is recorded."""
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
    x, v = now.runs
    left = replace(new, x=x, v=v, final=final, widened=jnp.zeros((), int))
    return _either(over, _begin(left, CHECK, (x, v)), new)


def _check(now: Bracket, how: Tracking) -> Bracket:
    """The ends must still lie on either side; errors of the runs may have moved both to one."""
    decided, quiet = _decided(now)
    both, same = jnp.all(decided), quiet[0] == quiet[1]

    def moved(part: Array) -> Array:
        step = part[1] - part[0]
        up = jnp.stack([part[1], part[1] + _WIDER * step])
        down = jnp.stack([part[0] - _WIDER * step, part[0]])
        sorted_ = jnp.where(quiet[0], part, part[::-1])
        return jnp.where(same, jnp.where(quiet[0], up, down), sorted_)

    x, v = moved(now.x), moved(now.v)
    good = replace(now, x=x, v=v, sides=jnp.where(quiet[0], now.pattern, now.pattern[::-1]))
    again = replace(_begin(now, CHECK, (x, v)), x=x, v=v, widened=now.widened + 1)
    new = _either(both, _either(same, again, _begin_cut(good)), now)
    new = _failed(new, both & (new.widened > _MOST_WIDER), SearchResult.edge_lost)
    return _failed(new, ~both & (now.count >= how.patience), SearchResult.undecided)
