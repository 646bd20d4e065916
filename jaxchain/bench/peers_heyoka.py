"""heyoka, a Taylor integrator with events compiled by LLVM, for the chain with true dry friction.

As its documentation has it: what a mass does is a pair of runtime parameters, events are terminal,
and a callback in Python decides at each of them how the mass goes on.  heyoka takes callbacks of
no other kind.  To give it its best:

- one event for each mass: |w| while it slides, the reserve of friction squared, (p mu_st)^2 - r^2,
  while it sticks; watched in one direction only, so that leaving w = 0 is none;
- callbacks that read and write the state through memory views, which costs a third of numpy's
  indexing;
- `fast_math`, a fifth faster at the same error; all loops unrolled (no `compact_mode`);
- many lanes as batches of the processor's SIMD width, which takes events too.

heyoka is part of the optional extra `peers`, imported when a peer is made.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxchain.bench.peers import optional
from jaxchain.model.chain import Chain
from jaxchain.model.friction import ExponentialDecay

PACKAGE = "heyoka"


class DryRing:
    """A homogeneous ring with dry friction, or one mass: compiled for one tolerance.

    `lanes` of them at a time, which may differ in belt speed and start.  `events` counts those of
    the latest run, and `landings` those at which a mass came to the belt's speed.
    """

    def __init__(self, chain: Chain, tolerance: float, lanes: int = 1):
        self._heyoka = optional(PACKAGE, PACKAGE)
        self.chain, self.n, self.lanes = chain, chain.n, lanes
        self.numbers = _numbers(chain)
        self.events = self.landings = 0
        self._switches = [self._switch(mass) for mass in range(self.n)]
        self._integrator = self._compile(tolerance)
        # Views of heyoka's own memory, one of each lane.
        state, parameters = self._integrator.state, self._integrator.pars
        self._state, self._parameters = (
            array.reshape(len(array), lanes) for array in (state, parameters)
        )
        self._views: list[tuple[Any, Any]] = [
            (memoryview(self._state[:, lane]), memoryview(self._parameters[:, lane]))
            for lane in range(lanes)
        ]

    def _compile(self, tolerance: float) -> Any:
        """x' = v, v' = slides (r - direction mu(direction w)), with the events.

        Runtime parameters: the direction of every mass (0 where it sticks), the belt speed, and
        whether each slides (1) or sticks (0).
        """
        heyoka, n = self._heyoka, self.n
        xi, k, eta, mu_st, mu_d, v_0 = self.numbers
        x, v = (
            list(np.atleast_1d(heyoka.make_vars(*(f"{name}_{i:06d}" for i in range(n)))))
            for name in "xv"
        )
        batch = self.lanes > 1
        event = heyoka.t_event_batch if batch else heyoka.t_event
        make = heyoka.taylor_adaptive_batch if batch else heyoka.taylor_adaptive
        accelerations, events = [], []
        for i in range(n):
            direction, slides = heyoka.par[i], heyoka.par[n + 1 + i]
            r = -2.0 * xi * v[i] - (k + 2.0 * eta) * x[i]
            if n > 1:
                r = r + eta * (x[i - 1] + x[(i + 1) % n])
            w = v[i] - heyoka.par[n]
            mu = mu_d + (mu_st - mu_d) * heyoka.exp(-direction * w / v_0)
            accelerations.append((v[i], slides * (r - direction * mu)))
            events.append(
                event(
                    direction * w + (1.0 - slides) * (mu_st**2 - r * r),
                    callback=self._switches[i],
                    direction=heyoka.event_direction.negative,
                )
            )
        shape = (self.lanes,) if batch else ()
        return make(
            list(zip(x, v, strict=True)) + accelerations,
            np.zeros((2 * n, *shape)),
            pars=np.ones((2 * n + 1, *shape)),
            t_events=events,
            tol=tolerance,
            fast_math=True,
        )

    def _switch(self, i: int) -> Callable[..., bool]:
        """How mass i goes on after its event, as heyoka's callback."""
        n = self.n
        xi, k, eta, hold, _, _ = self.numbers
        before, after, speed, slides = (i - 1) % n, (i + 1) % n, n + i, n + 1 + i
        damping, stiffness = 2.0 * xi, k + 2.0 * eta

        def switch(_: Any, __: int, lane: int = 0) -> bool:
            y, p = self._views[lane]
            self.events += 1
            r = eta * (y[before] + y[after]) - damping * y[speed] - stiffness * y[i]
            if p[slides]:
                self.landings += 1
                y[speed] = p[n]
                if -hold <= r <= hold:
                    p[i] = p[slides] = 0.0
                    return True
            p[i] = 1.0 if r > 0.0 else -1.0
            p[slides] = 1.0
            return True

        return switch

    def run(self, belt_speeds: Any, initial: tuple[Any, Any], t1: float) -> np.ndarray:
        """(x, v) at t1, shape (2, n, lanes), from `initial` of shapes (n, lanes)."""
        n, integrator = self.n, self._integrator
        x, v = (np.reshape(part, (n, self.lanes)) for part in initial)
        w = v - belt_speeds
        self._state[:n], self._state[n:] = x, v
        self._parameters[:n], self._parameters[n], self._parameters[n + 1 :] = (
            np.sign(w), belt_speeds, 1.0,
        )  # fmt: skip
        for mass, lane in zip(*np.nonzero(w == 0.0), strict=True):  # on the belt
            self._switches[int(mass)](integrator, 0, int(lane))
        integrator.reset_cooldowns()
        self.events = self.landings = 0
        if self.lanes > 1:
            integrator.set_time(np.zeros(self.lanes))
            integrator.propagate_until(np.full(self.lanes, float(t1)))
            ends = [result[0] for result in integrator.propagate_res]
        else:
            integrator.time = 0.0
            ends = [integrator.propagate_until(float(t1))[0]]
        complete = all(end == self._heyoka.taylor_outcome.time_limit for end in ends)
        end = self._state.reshape(2, n, self.lanes)
        return end.copy() if complete else np.full_like(end, np.nan)


def simd_width() -> int:
    """How many lanes a batch of heyoka holds on this processor."""
    return optional(PACKAGE, PACKAGE).recommended_simd_size()


def heyoka(chain: Chain, initial: Any, t1: float) -> Callable[[float], np.ndarray]:
    """A function of the tolerance that integrates to t1 and returns (x, v), shape (2, n)."""
    compiled = functools.cache(lambda tolerance: DryRing(chain, tolerance))
    x, v = map(np.asarray, initial)
    belt_speed = float(chain.belt_speed)

    def run(tolerance: float) -> np.ndarray:
        return compiled(tolerance).run(belt_speed, (x, v), t1)[..., 0]

    return run


def heyoka_lanes(
    chain: Chain, belt_speeds: Sequence[float], initial: Any, t1: float, width: int
) -> Callable[[float], np.ndarray]:
    """As `heyoka` for many lanes, in batches of `width` (1: one after the other).

    `initial` is of shapes (lanes, n), and what is returned of shape (2, lanes, n).
    """
    if len(belt_speeds) % width:
        raise ValueError(
            f"Argument `belt_speeds` must be a multiple of {width}, but holds {len(belt_speeds)}."
        )
    compiled = functools.cache(lambda tolerance: DryRing(chain, tolerance, width))
    x, v = (np.ascontiguousarray(np.asarray(part).T) for part in initial)
    speeds = np.asarray(belt_speeds, float)
    batches = [slice(i, i + width) for i in range(0, len(speeds), width)]

    def run(tolerance: float) -> np.ndarray:
        ring = compiled(tolerance)
        ends = [ring.run(speeds[b], (x[:, b], v[:, b]), t1) for b in batches]
        return np.concatenate(ends, axis=-1).swapaxes(1, 2)

    return run


def _numbers(chain: Chain) -> tuple[float, ...]:
    """xi, k, eta, mu_st, mu_d, v_0."""
    law = chain.law
    if not isinstance(law, ExponentialDecay) or (chain.n > 1 and chain.ends != "cyclic"):
        raise ValueError("The compiled peer is a ring with exponentially decaying friction.")
    if chain.normal_load is not None or (chain.n > 1) != (chain.coupling is not None):
        raise ValueError("The compiled peer has uniform springs and no normal load.")
    eta = 0.0 if chain.coupling is None else chain.coupling
    numbers = (chain.damping_ratio, chain.stiffness, eta)
    return tuple(float(a) for a in (*numbers, law.mu_static, law.mu_dynamic, law.v_ref))
