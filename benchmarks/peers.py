"""Peers outside JAX, at their best, for rings with exponentially decaying friction.

LSODA and CVODE with compiled right side and Jacobian for smoothed friction, heyoka with
events for dry friction. `pip install 'jaxchain[peers]'` brings them; each is imported where it is
used. All return functions of the tolerance that integrate from 0 to t1.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import equation_8

HALF_BANDWIDTH = 5
MOST_STEPS = 10**7


class CompiledRing:
    """The right side and the Jacobian of a ring, or of one mass, compiled by numba.

    The masses are folded, 0 N-1 1 N-2 ..., and displacements and velocities interleaved: then
    neighbours are at most two indices apart and the Jacobian is banded, which halves LSODA's time.
    `fold` and `unfold` convert from (x, v) to such a y of shape (2n,) and back. All compiled
    functions take the numbers p = `parameters(chain)`.
    """

    @no_type_check  # numba compiles functions without annotations
    def __init__(self, n: int):
        from numba import njit

        i = np.arange(n)
        self.order = np.where(i % 2 == 0, i // 2, n - 1 - i // 2)
        position = np.argsort(self.order)
        band_width = self.half_bandwidth = min(HALF_BANDWIDTH, 2 * n - 1)
        before, after = 2 * position[(self.order - 1) % n], 2 * position[(self.order + 1) % n]

        # Without signatures: CVODE lends its own arrays as read-only ones, a type apart.
        @njit
        def force_into(t, y, out, p):
            v_d, width, xi, eta, k, mu_st, mu_d, v_0 = p
            for m in range(n):
                x, v = y[2 * m], y[2 * m + 1]
                w = v - v_d
                mu = mu_d + (mu_st - mu_d) * math.exp(-abs(w) / v_0)
                springs = eta * (y[before[m]] + y[after[m]]) - (k + 2.0 * eta) * x
                out[2 * m] = v
                out[2 * m + 1] = -mu * math.tanh(w / width) - 2.0 * xi * v + springs

        @njit
        def jacobian_into(y, out, p, band):
            """Entry (i, j) goes to row i, or with a half `band` width to row band + i - j."""
            v_d, width, xi, eta, k, mu_st, mu_d, v_0 = p
            out[:] = 0.0
            for m in range(n):
                x, v = 2 * m, 2 * m + 1
                w = y[v] - v_d
                decay, direction = (mu_st - mu_d) * math.exp(-abs(w) / v_0), math.tanh(w / width)
                slope = decay / v_0 * abs(direction) - 2.0 * xi
                slope -= (mu_d + decay) * (1.0 - direction * direction) / width
                entries = (
                    (x, v, 1.0),
                    (v, x, -(k + 2.0 * eta)),
                    (v, v, slope),
                    (v, before[m], eta),
                    (v, after[m], eta),
                )
                for i, j, value in entries:
                    out[band + i - j if band else i, j] += value

        @njit("f8[::1](f8, f8[::1], f8[::1])")
        def force(t, y, p):
            out = np.empty(2 * n)
            force_into(t, y, out, p)
            return out

        @njit("f8[:, ::1](f8, f8[::1], f8[::1])")
        def band_jacobian(t, y, p):
            out = np.empty((2 * band_width + 1, 2 * n))
            jacobian_into(y, out, p, band_width)
            return out

        @njit
        def full_jacobian_into(t, y, _, out, p):
            jacobian_into(y, out, p, 0)

        self.force, self.force_into = force, force_into
        self.band_jacobian, self.full_jacobian_into = band_jacobian, full_jacobian_into

    @staticmethod
    def parameters(chain: Any) -> np.ndarray:
        """(v_d, width, xi, eta, k, mu_st, mu_d, v_0) of a chain."""
        law = chain.law
        eta = 0.0 if chain.n == 1 else chain.coupling
        numbers = (chain.belt_speed, chain.width, chain.damping_ratio, eta)
        numbers += (chain.stiffness, law.mu_static, law.mu_dynamic, law.v_ref)
        return np.array([float(number) for number in numbers])

    def fold(self, state: Any) -> np.ndarray:
        """y from (x, v)."""
        return np.stack([np.asarray(part)[self.order] for part in state], axis=-1).ravel()

    def unfold(self, y: np.ndarray) -> np.ndarray:
        """(x, v), shape (2, n), from y."""
        state = np.empty((2, self.order.size))
        state[:, self.order] = y.reshape(-1, 2).T
        return state


def lsoda(ring: CompiledRing, chain: Any, initial: Any, t1: float) -> Callable:
    """A function of rtol that integrates to t1 and returns (x, v), shape (2, n).

    By `odeint`, which costs less a step than `solve_ivp`: its loop is compiled, too.
    """
    from scipy.integrate import odeint

    y, p = ring.fold(initial), ring.parameters(chain)
    width = ring.half_bandwidth
    banded: Any = {"Dfun": ring.band_jacobian, "ml": width, "mu": width}

    def run(rtol: float) -> np.ndarray:
        tolerances = {"rtol": rtol, "atol": 0.1 * rtol, "mxstep": MOST_STEPS}
        path = odeint(ring.force, y, [0.0, t1], args=(p,), tfirst=True, **banded, **tolerances)
        return ring.unfold(path[-1])

    return run


def cvode(ring: CompiledRing, chain: Any, initial: Any, t1: float) -> Callable:
    """As `lsoda`, by the BDF method of CVODE."""
    from sksundae.cvode import CVODE

    y, p = ring.fold(initial), tuple(ring.parameters(chain).tolist())
    width = ring.half_bandwidth
    banded = {"linsolver": "band", "lband": width, "uband": width}

    def run(rtol: float) -> np.ndarray:
        tolerances = {"rtol": rtol, "atol": 0.1 * rtol, "max_num_steps": MOST_STEPS}
        jacobian: Any = {"jacfn": ring.full_jacobian_into, **banded}
        solver = CVODE(ring.force_into, userdata=p, **jacobian, **tolerances)
        return ring.unfold(solver.solve(np.array([0.0, t1]), y).y[-1])

    return run


class DryRing:
    """A ring with dry friction, or one mass, compiled by heyoka for one tolerance.

    As heyoka's documentation has it: what a mass does is a pair of runtime parameters, events are
    terminal, and a callback in Python decides at each how the mass goes on; heyoka takes no other
    callbacks. To give it its best:

    - one event for each mass: |w| while it slides, the reserve of friction squared,
      (p mu_st)^2 - r^2, while it sticks; in one direction only, so that leaving w = 0 is none;
    - callbacks that read and write through memory views, a third faster than NumPy's indexing;
    - `fast_math`, a fifth faster at the same error; all loops unrolled (no `compact_mode`) for up
      to a hundred masses, beyond which that compiles for minutes;
    - several `lanes`, which may differ in belt speed and start, as a batch of the SIMD width.
    """

    def __init__(self, chain: Any, tolerance: float, lanes: int = 1):
        import heyoka as hy

        law, n = chain.law, chain.n
        eta = 0.0 if n == 1 else float(chain.coupling)
        damping, stiffness = 2.0 * float(chain.damping_ratio), float(chain.stiffness) + 2.0 * eta
        self.numbers = (damping, stiffness, eta, float(law.mu_static))
        self.n, self.lanes, self.complete = n, lanes, hy.taylor_outcome.time_limit
        event = hy.t_event_batch if lanes > 1 else hy.t_event
        make = hy.taylor_adaptive_batch if lanes > 1 else hy.taylor_adaptive
        mu_st, mu_d, v_0 = float(law.mu_static), float(law.mu_dynamic), float(law.v_ref)
        x, v = (
            list(np.atleast_1d(hy.make_vars(*(f"{name}_{i:06d}" for i in range(n)))))
            for name in "xv"
        )
        # x' = v, v' = slides (r - direction mu(direction w)). Runtime parameters: the direction of
        # each mass (0 where it sticks), the belt speed, whether each slides (1) or sticks (0).
        accelerations, events = [], []
        self.switches = [self._switch(i) for i in range(n)]
        for i in range(n):
            direction, slides = hy.par[i], hy.par[n + 1 + i]
            r = -damping * v[i] - stiffness * x[i]
            if n > 1:
                r = r + eta * (x[i - 1] + x[(i + 1) % n])
            w = v[i] - hy.par[n]
            mu = mu_d + (mu_st - mu_d) * hy.exp(-direction * w / v_0)
            accelerations.append((v[i], slides * (r - direction * mu)))
            reserve = direction * w + (1.0 - slides) * (mu_st**2 - r * r)
            falling = hy.event_direction.negative
            events.append(event(reserve, callback=self.switches[i], direction=falling))
        shape = (lanes,) if lanes > 1 else ()
        self.integrator: Any = make(
            list(zip(x, v, strict=True)) + accelerations,
            np.zeros((2 * n, *shape)),
            pars=np.ones((2 * n + 1, *shape)),
            t_events=events,
            tol=tolerance,
            fast_math=True,
            compact_mode=n > 100,
        )
        # heyoka's own memory, with an axis of lanes, and a view of each lane.
        self.state = self.integrator.state.reshape(2 * n, lanes)
        self.pars = self.integrator.pars.reshape(2 * n + 1, lanes)
        self.views: list[Any] = [
            (memoryview(self.state[:, lane]), memoryview(self.pars[:, lane]))
            for lane in range(lanes)
        ]

    def _switch(self, i: int) -> Callable[..., bool]:
        """The mode of mass i after its event: heyoka's callback."""
        n, (damping, stiffness, eta, static_force) = self.n, self.numbers
        before, after, speed, slides = (i - 1) % n, (i + 1) % n, n + i, n + 1 + i

        def switch(_: Any, __: int, lane: int = 0) -> bool:
            y, p = self.views[lane]
            r = eta * (y[before] + y[after]) - damping * y[speed] - stiffness * y[i]
            if p[slides]:
                y[speed] = p[n]
                if -static_force <= r <= static_force:
                    p[i] = p[slides] = 0.0
                    return True
            p[i] = 1.0 if r > 0.0 else -1.0
            p[slides] = 1.0
            return True

        return switch

    def run(self, belt_speeds: Any, x: Any, v: Any, t1: float) -> np.ndarray:
        """(x, v) at t1, shape (2, n, lanes), from x and v of shape (n, lanes)."""
        n, ring, w = self.n, self.integrator, v - belt_speeds
        self.state[:n], self.state[n:] = x, v
        self.pars[:n], self.pars[n], self.pars[n + 1 :] = np.sign(w), belt_speeds, 1.0
        for mass, lane in zip(*np.nonzero(w == 0.0), strict=True):  # on the belt
            self.switches[int(mass)](ring, 0, int(lane))
        ring.reset_cooldowns()
        if self.lanes > 1:
            ring.set_time(np.zeros(self.lanes))
            ring.propagate_until(np.full(self.lanes, t1))
            ends = [result[0] for result in ring.propagate_res]
        else:
            ring.time = 0.0
            ends = [ring.propagate_until(t1)[0]]
        complete = all(end == self.complete for end in ends)
        end = self.state.reshape(2, n, self.lanes)
        return end.copy() if complete else np.full_like(end, np.nan)


def heyoka(chain: Any, belt_speeds: Any, excited: int, t1: float, batch: int) -> Callable:
    """A function of the tolerance that integrates from equation (8) to t1, and returns (x, v).

    Of shape (2, n), or (2, lanes, n) for an array of belt speeds, which are integrated `batch` at
    a time (1: one after the other); their number must be a multiple of it.
    """
    speeds = jnp.atleast_1d(belt_speeds)
    start = jax.vmap(lambda speed: equation_8(chain.with_(belt_speed=speed), excited))(speeds)
    x, v = (np.ascontiguousarray(np.asarray(part).T) for part in start)
    # Of events at one time, as of masses that move alike, it misses all but one.
    x = x + 1e-9 * np.arange(chain.n)[:, None]
    ring = functools.cache(lambda tolerance: DryRing(chain, tolerance, batch))
    batches = [slice(i, i + batch) for i in range(0, speeds.size, batch)]
    host = np.asarray(speeds)

    def run(tolerance: float) -> np.ndarray:
        ends = [ring(tolerance).run(host[b], x[:, b], v[:, b], float(t1)) for b in batches]
        state = np.concatenate(ends, axis=-1).swapaxes(1, 2)
        return state if np.ndim(belt_speeds) else state[:, 0]

    return run
