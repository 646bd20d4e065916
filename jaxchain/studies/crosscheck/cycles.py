"""The vibrating cycle of one oscillator, measured: amplitude, period, and time on the belt."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from jaxchain._types import ScalarLike, State
from jaxchain.model.chain import Chain
from jaxchain.model.oscillators import AbstractOscillators
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.base import AbstractObserver, Step, Variable
from jaxchain.observers.quantities import active_above
from jaxchain.observers.section import Section
from jaxchain.observers.stick_time import StickTime, sticking
from jaxchain.result import ended_well
from jaxchain.scenes.tables import TimeTable
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.studies.crosscheck.bias import HEAD_START

QUANTITIES = ("amplitude", "period", "stick_time")
# How a run of an oscillator ended.
VIBRATES, RESTS, UNSETTLED, FAILED = range(4)
OUTCOMES = ("vibrates", "rests", "unsettled", "failed")
# Two successive maxima of a cycle, and the periods before them, agree as well as this.
_SETTLED = 1e-8
# A small step off the belt, for a derivative: relative to the belt speed; and its tolerance.
_OFF, _OFF_RTOL = 1e-4, 1e-9


class CycleStickTime(AbstractObserver):
    """For how long each mass sticks in one period, from one of its maxima to the next.

    The last period that is complete counts.  No mass sticks at a maximum, where v = 0, so that no
    stretch of sticking is cut.
    """

    def init(
        self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, Array]:
        del field, t0, t1
        return jnp.zeros_like(y0[0]), jnp.full_like(y0[0], jnp.nan)

    def update(self, accumulator: tuple[Array, Array], step: Step) -> tuple[Array, Array]:
        since_maximum, last = accumulator
        begin, end = sticking(step)
        since_maximum = since_maximum + jnp.maximum(end - begin, 0.0) * (step.t1 - step.t0)
        turns, _ = step.turning_points()
        maximum = turns & (step.y0[1] > 0)
        return jnp.where(maximum, 0.0, since_maximum), jnp.where(maximum, since_maximum, last)

    def read(self, accumulator: tuple[Array, Array]) -> Array:
        return accumulator[1]

    def label(self, value: Array, chain: Chain) -> dict[str, Variable]:
        return StickTime().label(value, chain)


def watch_cycles(time: TimeTable) -> list[AbstractObserver]:
    """What `find_cycles` wants to know of a run."""
    # A maximum every half period of a free mass would be many.
    capacity = math.ceil(time.window / math.pi) + 2
    section = Section(0, capacity=capacity, start=time.transient)
    return [Amplitude(window=time.window), section, CycleStickTime()]


def find_cycles(data: xr.Dataset) -> xr.Dataset:
    """The vibrating cycles of one mass, from a sweep over `belt_speed` with `watch_cycles`.

    **Returns:** `amplitude`, `period`, `stick_time` and `outcome`, a number of `OUTCOMES`, over
    the axes of the sweep; NaN where there is no cycle.
    """
    time, top = _last(data["section_time"], 3), _last(data["section_displacement"], 3)
    before, period = (time.diff("point").isel(point=i) for i in (0, 1))
    amplitude, speed = data["amplitude"], data["belt_speed"]
    apart = np.maximum(
        abs(before / period - 1), abs(top.isel(point=1) - top.isel(point=2)) / amplitude
    )
    outcome = xr.where(apart <= _SETTLED, VIBRATES, UNSETTLED)  # NaN is not settled
    threshold = speed.copy(data=np.asarray(active_above(speed.values)))
    outcome = xr.where(amplitude > threshold, outcome, RESTS)
    well = ended_well(data["result"])
    outcome = xr.where(well, outcome, FAILED).astype(np.int8)
    found = {"amplitude": amplitude, "period": period, "stick_time": data["stick_time"]}
    return xr.Dataset(found).where(outcome == VIBRATES).assign(outcome=outcome)


def _last(points: xr.DataArray, count: int) -> xr.DataArray:
    """The last `count` of the points that there are, NaN in front where there are fewer."""
    place = points.notnull().sum("point") - count + xr.DataArray(np.arange(count), dims="last")
    return points.isel(point=place.clip(0)).where(place >= 0).rename(last="point")


def expected_factors(chain: Chain, cycles: xr.Dataset) -> xr.Dataset:
    """The factor `a` of the error that smoothing a dry cycle is to cause, see `bias.py`.

    Every quantity Q changes by d ln Q / 4 per relative speed at the release.  And a mass that
    lands counts as sticking from `stick_speed` on, (eps / 2) ln(1 / eps) to leading order: by as
    much earlier as it takes to lose this speed.

    **Arguments:** `cycles` over `belt_speed`, from `find_cycles`, with true dry friction.

    **Returns:** amplitude, period and stick time over `belt_speed`, NaN where there is no cycle.
    """
    rows = np.stack([cycles[name].values for name in ("belt_speed", *QUANTITIES)])
    expected = np.full((len(QUANTITIES), rows.shape[1]), np.nan)
    vibrating = np.isfinite(rows).all(axis=0)
    if vibrating.any():
        speed, *base = rows[:, vibrating]
        factors = HEAD_START * _response(chain, speed, np.stack(base))
        stick = base[QUANTITIES.index("stick_time")]
        # At the release friction and spring balance; at the landing, with the same friction, the
        # spring is shorter by the way on the belt.
        deceleration = float(np.ravel(chain.stiffness)[0]) * np.abs(speed) * stick
        factors[QUANTITIES.index("stick_time")] += 0.5 / (deceleration * stick)
        expected[:, vibrating] = factors
    return xr.Dataset(
        {name: ("belt_speed", row) for name, row in zip(QUANTITIES, expected, strict=True)},
        coords={"belt_speed": cycles["belt_speed"]},
    )


def _response(chain: Chain, speed: np.ndarray, base: np.ndarray) -> np.ndarray:
    """d ln Q / du of amplitude, period and stick time, of values `base`.

    u > 0: the relative speed at which the mass leaves the belt.
    """

    def left_at(speed: Array, u: Array, duration: Array) -> Array:
        own = chain.with_(belt_speed=speed)
        release = jnp.sign(speed) * own.greatest_hold() - 2.0 * own.damping_ratio * speed
        x = jnp.broadcast_to(release / own.stiffness, (1,))
        v = jnp.broadcast_to(speed - jnp.sign(speed) * u, (1,))
        run = simulate(
            own, (x, v), duration, observe=(Amplitude(), StickTime()), solver=EventDriven(),
            rtol=_OFF_RTOL, throw=False,
        )  # fmt: skip
        amplitude, stick = run.observed
        # The belt has the rest of the way to go to the next release.
        rest = (x - run.state[0]) / speed
        return jnp.concatenate([amplitude, duration + rest, stick + rest])

    _, period, stick = base
    duration = period - 0.5 * stick  # the mass is on the belt again
    both = jax.jit(jax.vmap(left_at))
    small = _OFF * np.abs(speed)
    once, twice = (np.asarray(both(speed, k * small, duration)).T - base for k in (1.0, 2.0))
    return (2.0 * once - 0.5 * twice) / small / base
