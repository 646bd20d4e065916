"""Runs after a kick from steady sliding: which die out, and the threshold of vibration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import ScalarLike, State
from ..model.chain import Chain, steady_sliding
from ..model.model import AbstractModel
from ..model.sliding import growth_rate
from ..observers.amplitude import Amplitude
from ..observers.base import AbstractObserver, Step
from ..observers.quantities import active
from ..simulation.event_driven import EventDriven
from ..simulation.run import Simulation, simulate

# Speeds at which friction is compared with damping, in units of the belt speed.
_SPEEDS = np.linspace(0.0, 1.0, 4097)[1:]
# Used if friction exceeds damping at all speeds for some mass: a motion this small, in units of
# the belt speed, is linear.
_LINEAR = 1e-3
# Successive periods in which a mass must stick (close to the fold smoothed friction may hold it on
# an unstable cycle for a while), and the most periods between two such times.
_STICKS, _SMOOTHED_STICKS, _APART = 5.0, 30.0, 1.6
# Length of a run in decay times, and its limit.
_DECAYS, _LEAST, _LONGEST = 40.0, 200.0, 1e5
# Decay times for which a mass must stick to count as vibrating; the next one if it was too short.
_PATIENCE = 0.0, 5.0, _DECAYS
LEVELS = len(_PATIENCE)
# The window at the end of a run for amplitudes; random tries in one batch.
_WINDOW, _TOGETHER = 40.0, 256
# A lower order than the optimum: a third more steps, and half the time to compile.
_RTOL, _ORDER = 1e-9, 8


def quiet_radius(chain: Chain) -> Float[Array, ""]:
    """The sqrt(2 E) below which every motion dies out if sliding is stable, min v*_n.

    Friction is compared with damping at 4096 speeds up to the belt speed.  If friction exceeds
    damping at every speed for some masses, and other masses compensate this, the result is 1e-3
    |v_d|, below which the motion is linear.

    >>> from jaxchain import paper_chain
    >>> round(float(quiet_radius(paper_chain(1, belt_speed=1.5, width=None))), 2)
    0.63
    """
    speed = jnp.abs(chain.belt_speed)
    ahead = chain.with_(belt_speed=speed)

    def gains(velocity: Array) -> Array:
        blow = jnp.full(chain.n, velocity)
        force = ahead.local_force(0.0, blow, blow) - ahead.local_force(0.0, blow, 0.0 * blow)
        return jnp.any(velocity * force > 0.0)

    tried = jnp.asarray(np.stack([_SPEEDS, -_SPEEDS])) * speed
    gaining = jnp.any(jax.vmap(jax.vmap(gains))(tried), axis=0)
    first = jnp.argmax(gaining)
    below = jnp.where(jnp.any(gaining), jnp.asarray(np.append(0.0, _SPEEDS))[first], 1.0)
    return jnp.maximum(below, _LINEAR) * speed


def _doubled_energy(chain: Any, rest: Array, state: State) -> Array:
    """2 E of the motion around steady sliding."""
    x, v = state
    d = x - rest
    return jnp.sum(v * v - d * chain.restoring_force(d))


class _Watched(eqx.Module):
    last: Float[Array, " n"]  # time at which it stuck last
    since: Float[Array, " n"]  # time since which it has stuck in every period
    died: Bool[Array, ""]
    vibrates: Bool[Array, " n"]


class DecayOrVibrate(AbstractObserver):
    """Whether a motion dies out, or masses keep sticking period after period.

    It has died out once sqrt(2 E) is less than `radius`.  It vibrates once some mass has stuck in
    every period for the time `patience`, and for at least five periods (thirty with smoothed
    friction): on unstable cycles, which a motion may follow for long, all masses slip.  If the
    belt is nearly too fast for vibration, a mass may stick for long and still be stopped by its
    neighbours.  A motion with neither flag vibrates without sticking, or the run was too short.

    **Value:** (whether it died, which masses vibrate).
    """

    rest: Float[Array, " n"]
    radius: Float[Array, ""]
    patience: Float[Array, ""]

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> _Watched:
        del t1
        never = jnp.full_like(y0[0], -jnp.inf)
        since = jnp.zeros_like(y0[0]) + t0
        none = jnp.zeros(y0[0].shape, bool)
        return _Watched(never, since, self._dead(field, y0), none)

    def _dead(self, field: Any, state: State) -> Bool[Array, ""]:
        return _doubled_energy(field, self.rest, state) < self.radius**2

    def update(self, accumulator: _Watched, step: Step) -> _Watched:
        now, field = accumulator, cast(Chain, step.field)
        x, v = step.y1
        left, right = field.neighbours(step.y1)
        switching = field.switching(step.t1, v)
        assert switching is not None  # a field with a belt has `switching`
        speed: Any = field.stick_speed()
        sticks = jnp.abs(switching[0]) <= speed
        sticks = sticks & (field.excess_force(step.t1, left, step.y1, right) <= 0)
        period = 2.0 * jnp.pi / jnp.sqrt(field.stiffness_diagonal(x.shape[0]))
        anew = sticks & (step.t1 - now.last > _APART * period)
        since = jnp.where(anew, step.t1, now.since)
        periods = _STICKS if field.dry else _SMOOTHED_STICKS
        enough = jnp.maximum(periods * period, self.patience)
        vibrates = sticks & (step.t1 - since > enough)
        died = now.died | self._dead(field, step.y1)
        return _Watched(jnp.where(sticks, step.t1, now.last), since, died, now.vibrates | vibrates)

    def settled(self, accumulator: _Watched) -> Bool[Array, ""]:
        return accumulator.died | jnp.any(accumulator.vibrates)

    def read(self, accumulator: _Watched) -> tuple[Bool[Array, ""], Bool[Array, " n"]]:
        return accumulator.died, accumulator.vibrates


class Trials(eqx.Module):
    """Runs of a chain that begin with a kick from steady sliding."""

    chain: Chain
    rest: Float[Array, " n"]
    radius: Float[Array, ""]
    rate: Float[Array, ""]  # of the slowest disturbance of steady sliding
    horizon: Float[Array, ""]
    patience: Float[Array, ""]  # see `DecayOrVibrate`

    @classmethod
    def of(cls, chain: Chain) -> Trials:
        """Trials of a chain; the decay rate of disturbances determines the length of the runs."""
        fixed = lax.stop_gradient(chain)
        rate = -growth_rate(fixed, fixed.belt_speed)
        # NaN counts as no decay.
        time = jnp.where(rate > 0, _DECAYS / jnp.where(rate > 0, rate, 1.0), _LEAST)
        horizon = jnp.clip(time + _LEAST, _LEAST, _LONGEST)
        return cls(
            fixed, steady_sliding(fixed)[0], quiet_radius(fixed), rate, horizon, jnp.zeros(())
        )

    def with_longer_runs(self, level: Int[Array, ""]) -> Trials:
        """The trials with longer `patience`: masses must stick in more periods."""
        decay = 1.0 / jnp.where(self.rate > 0, self.rate, 1.0)
        patience = jnp.asarray(_PATIENCE)[level] * decay
        return eqx.tree_at(lambda t: t.patience, self, patience)

    def run(self, kick: Float[Array, " n"], observe: Any) -> Simulation:
        """The run after a kick from steady sliding."""
        return _run(self.chain, (self.rest, kick), self.horizon, observe)

    def dies(self, kick: Float[Array, " n"]) -> tuple[Bool[Array, ""], Float[Array, ""]]:
        """Whether the motion dies out, and the time at which this, or vibration, was decided."""
        run = self.run(kick, DecayOrVibrate(self.rest, self.radius, self.patience))
        return run.observed[0], run.t

    def ends(self, kick: Float[Array, " n"]) -> tuple[Bool[Array, ""], Bool[Array, " n"]]:
        """Whether any motion is left at the end of a long run, and which masses vibrate."""
        amplitude = self.run(kick, Amplitude(window=_WINDOW)).observed
        stiffness = self.chain.stiffness_diagonal(self.chain.n)
        # A velocity, comparable with the belt speed.
        fastest = jnp.max(jnp.sqrt(stiffness) * amplitude)
        return fastest > 0.5 * self.radius, active(amplitude, self.chain.belt_speed)

    def vibrating_among(self, another: Callable[[Array], Array], tries: int) -> Int[Array, ""]:
        """How many of `tries` random kicks another(key) lead to vibration."""
        if tries == 0:
            return jnp.zeros((), int)

        def some(chunk: Array) -> Array:
            number = chunk * _TOGETHER + jnp.arange(_TOGETHER)
            keys = jax.vmap(lambda k: jax.random.fold_in(jax.random.key(0), k))(number)
            dead, _ = jax.vmap(self.dies)(jax.vmap(another)(keys))
            return jnp.sum(~dead & (number < tries))

        return jnp.sum(lax.map(some, jnp.arange(-(-tries // _TOGETHER))))


def _run(chain: Chain, initial: State, t1: Any, observe: Any = None) -> Simulation:
    return simulate(
        chain, initial, t1, observe=observe, solver=EventDriven(_ORDER) if chain.dry else None,
        rtol=_RTOL, adjoint=dfx.ForwardMode(), throw=False,
    )  # fmt: skip


def energy_after(chain: Chain, kick: Float[Array, " n"], time: ScalarLike) -> Float[Array, ""]:
    """E at a time after a kick from steady sliding, for forward derivatives."""
    rest = steady_sliding(chain)[0]
    return 0.5 * _doubled_energy(chain, rest, _run(chain, (rest, kick), time).state)


# Factor by which a size that dies out is raised, and the most runs of a threshold search.
_RAISE, _MOST_RUNS = 1.25, 200
# A share of the size below which all motions die out: certain to die out.
_SURELY = 0.999
# The hardest kick tried: in units of the belt speed and of the speed of a released mass.
_HARDEST = 8.0


def hardest(chain: Chain) -> Float[Array, ""]:
    """The size of the hardest kick that is tried, in each of sqrt(n) directions."""
    stiffness = jnp.min(chain.stiffness_diagonal(chain.n))
    release_speed = jnp.max(chain.static_limit()) / jnp.sqrt(stiffness)
    return _HARDEST * jnp.sqrt(chain.n) * (jnp.abs(chain.belt_speed) + release_speed)


class Threshold(eqx.Module):
    """The threshold of vibration along a direction.

    After `low` the motion dies out, after `high` it vibrates (infinite if nothing up to the
    hardest kick does); `time`: when the motion of `low` had died out; `runs`: their number.
    """

    low: Float[Array, ""]
    high: Float[Array, ""]
    time: Float[Array, ""]
    runs: Int[Array, ""]


class _SizeBracket(eqx.Module):
    low: Float[Array, ""]
    high: Float[Array, ""]
    dies: Bool[Array, ""]  # whether `low` is known to die out
    vibrates: Bool[Array, ""]  # and `high`
    share: Float[Array, ""]  # by how much an end moves if it is on the wrong side
    time: Float[Array, ""]
    runs: Int[Array, ""]


def upwards(trials: Trials) -> tuple[Array, Array]:
    """(guess, share) for a search for the first threshold along a direction.

    It goes upwards from a size that certainly dies out, in steps of a quarter.
    """
    return _SURELY * trials.radius, jnp.zeros(())


def threshold(
    trials: Trials,
    direction: Float[Array, " n"],
    guess: Any,
    share: Any,
    precision: Any,
    wanted: Any = True,
) -> Threshold:
    """r(u), bracketed to a relative `precision`.

    It starts from a guess with an error of about `share`; see `upwards`.  In a batch, lanes that
    are done or not `wanted` take no steps, so the others need not wait for them.
    """
    most, surely = hardest(trials.chain), _SURELY * trials.radius
    share = jnp.asarray(share)
    first = share == 0
    low = jnp.maximum(guess * (1.0 - share), surely)
    share = jnp.where(first, _RAISE - 1.0, share)
    high = jnp.maximum(guess, surely) * (1.0 + share)

    def going(now: _SizeBracket) -> Array:
        wide = now.high - now.low > precision * now.high
        open_ = ~(now.dies & now.vibrates)
        more = (now.low < most) & (now.runs < _MOST_RUNS)
        return wanted & (wide | open_) & more

    def halve(now: _SizeBracket) -> _SizeBracket:
        middle = 0.5 * (now.low + now.high)
        size = jnp.where(now.vibrates, middle, now.high)
        size = jnp.where(now.dies, size, now.low)
        dead, time = trials.dies(jnp.where(going(now), size, 0.0) * direction)
        lower = jnp.maximum(surely, size * (1.0 - now.share))
        low = jnp.where(dead, size, jnp.where(now.dies, now.low, lower))
        high = jnp.where(dead & ~now.vibrates & now.dies, size * (1.0 + now.share), now.high)
        return _SizeBracket(
            low=low,
            high=jnp.where(dead, high, size),
            dies=now.dies | dead | (low <= surely),
            vibrates=now.vibrates | ~dead,
            share=jnp.where(
                now.dies & now.vibrates, now.share, jnp.minimum(2.0 * now.share, _RAISE - 1.0)
            ),
            time=jnp.where(dead, time, now.time),
            runs=now.runs + 1,
        )

    no, none = jnp.asarray(False), jnp.zeros((), int)
    last = lax.while_loop(
        going, halve, _SizeBracket(low, high, low <= surely, no, share, jnp.ones(()), none)
    )
    bracketed = last.dies & last.vibrates & (last.runs < _MOST_RUNS)
    return Threshold(last.low, jnp.where(bracketed, last.high, jnp.inf), last.time, last.runs)
