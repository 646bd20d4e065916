"""Whether a kicked chain comes to rest in steady sliding or goes on vibrating, told as it runs.

With d = x - x_s the energy E = (v^T v + d^T K d) / 2 of a motion falls at the rate

    sum_n v_n [2 xi_n v_n - p_n (F(v_n - v_d) - F(-v_d))],

every term of which is positive while 0 < |v_n| < v*_n, the least speed at which friction gains on
damping.  As |v_n| <= sqrt(2 E), a motion with sqrt(2 E) < min v*_n dies: LaSalle's principle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import ScalarLike, State
from ..model.chain import Chain, steady_sliding
from ..model.oscillators import AbstractOscillators
from ..model.sliding import growth_rate
from ..observers.amplitude import Amplitude
from ..observers.base import AbstractObserver, Step
from ..observers.quantities import active
from ..simulation.event_driven import EventDriven
from ..simulation.run import Simulation, simulate

# Speeds at which friction is held against damping, in units of the belt's.
_SPEEDS = np.linspace(0.0, 1.0, 4097)[1:]
# Where some mass gains at all speeds: a motion this small, in units of the belt speed, is linear.
_LINEAR = 1e-3
# Periods in succession in which a mass sticks (smoothed friction may hold it on an unstable cycle
# for a while, close to the fold), and between two times at most.
_STICKS, _SMOOTHED_STICKS, _APART = 5.0, 30.0, 1.6
# A run is as long as so many times of decay, and at most this.
_DECAYS, _LEAST, _LONGEST = 40.0, 200.0, 1e5
# For how many times of decay masses stick until they are said to vibrate, if less was not enough.
_PATIENCE = 0.0, 5.0, _DECAYS
LEVELS = len(_PATIENCE)
# The end of a run, of which amplitudes are taken; random tries that run together.
_WINDOW, _TOGETHER = 40.0, 256
# A lower order than suits it best: a third more steps, and half the time to compile.
_RTOL, _ORDER = 1e-9, 8


def quiet_radius(chain: Chain) -> Float[Array, ""]:
    """The sqrt(2 E) below which every motion dies where steady sliding attracts, min v*_n.

    Friction is held against damping at 4096 speeds up to the belt's.  With masses that gain at
    every speed, and others that make up for it, 1e-3 |v_d| takes its place: there the motion is
    linear.

    >>> from jaxchain import paper_chain
    >>> round(float(quiet_radius(paper_chain(1, belt_speed=1.5, width=None))), 2)
    0.63
    """
    speed = jnp.abs(chain.belt_speed)
    ahead = chain.with_(belt_speed=speed)

    def gains(velocity: Array) -> Array:
        own = jnp.full(chain.n, velocity)
        force = ahead.local_force(0.0, own, own) - ahead.local_force(0.0, own, 0.0 * own)
        return jnp.any(velocity * force > 0.0)

    tried = jnp.asarray(np.stack([_SPEEDS, -_SPEEDS])) * speed
    gaining = jnp.any(jax.vmap(jax.vmap(gains))(tried), axis=0)
    first = jnp.argmax(gaining)
    below = jnp.where(jnp.any(gaining), jnp.asarray(np.append(0.0, _SPEEDS))[first], 1.0)
    return jnp.maximum(below, _LINEAR) * speed


class _Watched(eqx.Module):
    last: Float[Array, " n"]  # time at which it stuck last
    since: Float[Array, " n"]  # from which on it has stuck in every period
    died: Bool[Array, ""]
    vibrates: Bool[Array, " n"]


class Fate(AbstractObserver):
    """Whether a motion dies, or masses go on to stick period after period.

    It dies once sqrt(2 E) is less than `radius`; it vibrates once some mass has stuck in every
    period for the time `patience`, of five at least, or thirty with smoothed friction: on the
    cycles that a motion may follow for long, the unstable ones, all masses slip.  Where the
    belt is nearly too fast for it, a mass may stick for long and be stopped by its neighbours
    nevertheless.  A motion of which neither is said vibrates without sticking, or has not had the
    time.

    **Value:** (whether it died, which masses vibrate).
    """

    rest: Float[Array, " n"]
    radius: Float[Array, ""]
    patience: Float[Array, ""]

    def init(
        self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> _Watched:
        del t1
        never = jnp.full_like(y0[0], -jnp.inf)
        since = jnp.zeros_like(y0[0]) + t0
        none = jnp.zeros(y0[0].shape, bool)
        return _Watched(never, since, self._dead(field, y0), none)

    def _dead(self, field: AbstractOscillators, state: State) -> Bool[Array, ""]:
        x, v = state
        d = x - self.rest
        return jnp.sum(v * v - d * field.restoring_force(d)) < self.radius**2

    def update(self, accumulator: _Watched, step: Step) -> _Watched:
        now, field = accumulator, step.field
        x, v = step.y1
        switching = field.switching(step.t1, v)
        assert switching is not None  # what rides on a belt switches
        speed: Any = field.stick_speed()
        held = jnp.abs(switching[0]) <= speed
        held = held & (field.unheld_force(x, v) <= 0)
        period = 2.0 * jnp.pi / jnp.sqrt(field.stiffness_diagonal(x.shape[0]))
        anew = held & (step.t1 - now.last > _APART * period)
        since = jnp.where(anew, step.t1, now.since)
        dry = isinstance(field, Chain) and field.dry
        periods = _STICKS if dry else _SMOOTHED_STICKS
        enough = jnp.maximum(periods * period, self.patience)
        vibrates = held & (step.t1 - since > enough)
        died = now.died | self._dead(field, step.y1)
        return _Watched(jnp.where(held, step.t1, now.last), since, died, now.vibrates | vibrates)

    def settled(self, accumulator: _Watched) -> Bool[Array, ""]:
        return accumulator.died | jnp.any(accumulator.vibrates)

    def read(self, accumulator: _Watched) -> tuple[Bool[Array, ""], Bool[Array, " n"]]:
        return accumulator.died, accumulator.vibrates


class Trials(eqx.Module):
    """Runs of a chain that begin with a kick of steady sliding."""

    chain: Chain
    rest: Float[Array, " n"]
    radius: Float[Array, ""]
    rate: Float[Array, ""]  # at which the least disturbance of steady sliding decays
    horizon: Float[Array, ""]
    patience: Float[Array, ""]  # see `Fate`

    @classmethod
    def of(cls, chain: Chain) -> Trials:
        """Trials of a chain: how fast sliding decays says how long a run takes to decide."""
        frozen = lax.stop_gradient(chain)
        rate = -growth_rate(frozen, frozen.belt_speed)
        # NaN is as good as none.
        time = jnp.where(rate > 0, _DECAYS / jnp.where(rate > 0, rate, 1.0), _LEAST)
        horizon = jnp.clip(time + _LEAST, _LEAST, _LONGEST)
        return cls(
            frozen, steady_sliding(frozen)[0], quiet_radius(frozen), rate, horizon, jnp.zeros(())
        )

    def patiently(self, level: Int[Array, ""]) -> Trials:
        """For a mass that sticks once more and more often until it is said to vibrate."""
        decay = 1.0 / jnp.where(self.rate > 0, self.rate, 1.0)
        patience = jnp.asarray(_PATIENCE)[level] * decay
        return eqx.tree_at(lambda t: t.patience, self, patience)

    def run(self, kick: Float[Array, " n"], observe: Any = None) -> Simulation:
        """The run after a kick from steady sliding; by default it is watched for its `Fate`."""
        observe = Fate(self.rest, self.radius, self.patience) if observe is None else observe
        return _run(self.chain, (self.rest, kick), self.horizon, observe)

    def dies(self, kick: Float[Array, " n"]) -> tuple[Bool[Array, ""], Float[Array, ""]]:
        """Whether it does, and the time at which that, or that it vibrates, was clear."""
        run = self.run(kick)
        return run.observed[0], run.t

    def ends(self, kick: Float[Array, " n"]) -> tuple[Bool[Array, ""], Bool[Array, " n"]]:
        """Whether any motion is left at the end of a long run, and which masses vibrate there."""
        amplitude = self.run(kick, observe=Amplitude(window=_WINDOW)).observed
        stiffness = self.chain.stiffness_diagonal(self.chain.n)
        # A velocity, to be compared with one.
        fastest = jnp.max(jnp.sqrt(stiffness) * amplitude)
        return fastest > 0.5 * self.radius, active(amplitude, self.chain.belt_speed)

    def vibrating_among(self, another: Callable[[Array], Array], tries: int) -> Int[Array, ""]:
        """How many of so many random kicks another(key) lead to vibration."""
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
    """E at a time after a kick of steady sliding, to be differentiated forward."""
    rest = steady_sliding(chain)[0]
    x, v = _run(chain, (rest, kick), time).state
    d = x - rest
    return 0.5 * jnp.sum(v * v - d * chain.restoring_force(d))
