"""Peers outside JAX: LSODA and CVODE with compiled right side and Jacobian.

The masses of the ring are folded, 0 N-1 1 N-2 ..., and displacements and velocities interleaved:
then neighbours are at most two places apart and the Jacobian is banded, which halves LSODA's time.
numba and scikit-sundae are the optional extra `peers`, imported when a peer is made.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np

from jaxchain.model.chain import Chain
from jaxchain.model.friction import ExponentialDecay

HALF_BANDWIDTH = 5
_MOST_STEPS = 10**7


class PeerMissingError(RuntimeError):
    """A peer cannot run here; the message says how to get it."""


def optional(module: str, package: str) -> Any:
    """The module of a peer, or `PeerMissingError`."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise PeerMissingError(
            f"skipped, {package} is not installed: pip install 'jaxchain[peers]'"
        ) from None


class CompiledRing:
    """The right side and the Jacobian of a homogeneous ring, compiled by numba.

    A state is one array y of shape (2n,); `fold` and `unfold` convert from and to (x, v).
    `force(t, y, p)` returns y', `jacobian(t, y, p)` the Jacobian's band, shape (11, 2n), entry
    (i, j) in row 5 + i - j, with p = `parameters(chain)`: one compilation serves every chain of
    this size.
    """

    def __init__(self, n: int):
        if n < 3:
            raise ValueError(f"Argument `n` must be at least 3, but is {n}.")
        i = np.arange(n)
        self.order = np.where(i % 2 == 0, i // 2, n - 1 - i // 2)
        self._compile(optional("numba", "numba").njit)

    @no_type_check  # numba cannot compile a function that checks its types
    def _compile(self, njit: Callable) -> None:
        n = self.order.shape[0]
        place = np.argsort(self.order)
        before, after = 2 * place[(self.order - 1) % n], 2 * place[(self.order + 1) % n]
        band = HALF_BANDWIDTH

        # Without signatures: CVODE lends its own arrays as read-only ones, a type apart.
        @njit
        def force_into(t, y, out, p):
            v_d, width, xi, eta, k, mu_st, mu_d, v_0 = p
            for m in range(n):
                x, v = y[2 * m], y[2 * m + 1]
                w = v - v_d
                mu = mu_d + (mu_st - mu_d) * math.exp(-abs(w) / v_0)
                friction = -mu * math.tanh(w / width)
                springs = eta * (y[before[m]] + y[after[m]])
                out[2 * m] = v
                out[2 * m + 1] = friction - 2.0 * xi * v - (k + 2.0 * eta) * x + springs

        @njit("f8[::1](f8, f8[::1], f8[::1])")
        def force(t, y, p):
            out = np.empty(2 * n)
            force_into(t, y, out, p)
            return out

        @njit
        def slope(v, p):
            v_d, width, xi, _, _, mu_st, mu_d, v_0 = p
            w = v - v_d
            decay = (mu_st - mu_d) * math.exp(-abs(w) / v_0)
            direction = math.tanh(w / width)
            fall = decay / v_0 * abs(direction)
            return fall - (mu_d + decay) * (1.0 - direction * direction) / width - 2.0 * xi

        @njit("f8[:, ::1](f8, f8[::1], f8[::1])")
        def jacobian(t, y, p):
            eta, k = p[3], p[4]
            out = np.zeros((2 * band + 1, 2 * n))
            for m in range(n):
                row = 2 * m + 1
                out[band - 1, row] = 1.0
                out[band + 1, row - 1] = -(k + 2.0 * eta)
                out[band, row] = slope(y[row], p)
                for column in (before[m], after[m]):
                    out[band + row - column, column] += eta
            return out

        @njit
        def full_jacobian_into(t, y, _, out, p):
            eta, k = p[3], p[4]
            out[:] = 0.0
            for m in range(n):
                row = 2 * m + 1
                out[row - 1, row] = 1.0
                out[row, row - 1] = -(k + 2.0 * eta)
                out[row, row] = slope(y[row], p)
                out[row, before[m]] += eta
                out[row, after[m]] += eta

        self.force, self.jacobian = force, jacobian
        self.force_into, self.full_jacobian_into = force_into, full_jacobian_into

    @staticmethod
    def parameters(chain: Chain) -> np.ndarray:
        """The numbers of a chain in the order in which the compiled functions take them."""
        law = chain.law
        if not isinstance(law, ExponentialDecay) or chain.ends != "cyclic":
            raise ValueError("The compiled peer is a ring with exponentially decaying friction.")
        if chain.normal_load is not None or chain.coupling is None:
            raise ValueError("The compiled peer has uniform springs and no normal load.")
        numbers = (
            chain.belt_speed,
            chain.width,
            chain.damping_ratio,
            chain.coupling,
            chain.stiffness,
            law.mu_static,
            law.mu_dynamic,
            law.v_ref,
        )
        return np.array([float(number) for number in numbers])

    def fold(self, state: tuple[Any, Any]) -> np.ndarray:
        """y from (x, v)."""
        x, v = state
        return np.stack([np.asarray(x)[self.order], np.asarray(v)[self.order]], axis=-1).ravel()

    def unfold(self, y: np.ndarray) -> np.ndarray:
        """(x, v), shape (2, n), from y."""
        state = np.empty((2, self.order.shape[0]))
        state[0, self.order] = y[::2]
        state[1, self.order] = y[1::2]
        return state


def lsoda(ring: CompiledRing, chain: Chain, initial: Any, t1: float) -> Callable:
    """A function of rtol that integrates to t1 and returns (x, v), shape (2, n).

    By `odeint`, which costs less a step than `solve_ivp`: its loop is compiled, too.
    """
    from scipy.integrate import odeint

    y, p = ring.fold(initial), ring.parameters(chain)

    def run(rtol: float) -> np.ndarray:
        out = odeint(
            ring.force, y, [0.0, t1], args=(p,), tfirst=True, Dfun=ring.jacobian,
            ml=HALF_BANDWIDTH, mu=HALF_BANDWIDTH, rtol=rtol, atol=0.1 * rtol, mxstep=_MOST_STEPS,
        )  # fmt: skip
        return ring.unfold(out[-1])

    return run


def radau(ring: CompiledRing, chain: Chain, initial: Any, t1: float) -> Callable:
    """As `lsoda`, by SciPy's Radau IIA, whose loop is Python and whose linear algebra is dense."""
    from scipy.integrate import solve_ivp

    y, p = ring.fold(initial), ring.parameters(chain)
    jacobian = np.empty((y.size, y.size))

    def full(t: float, y: np.ndarray, p: np.ndarray) -> np.ndarray:
        ring.full_jacobian_into(t, y, y, jacobian, p)
        return jacobian.copy()

    def run(rtol: float) -> np.ndarray:
        path = solve_ivp(
            ring.force, (0.0, t1), y, method="Radau", args=(p,), jac=full, rtol=rtol,
            atol=0.1 * rtol, t_eval=(t1,),
        )  # fmt: skip
        return ring.unfold(path.y[:, -1]) if path.success else np.full((2, y.size // 2), np.nan)

    return run


def cvode(ring: CompiledRing, chain: Chain, initial: Any, t1: float) -> Callable:
    """As `lsoda`, by the BDF method of CVODE."""
    sundials = optional("sksundae.cvode", "scikit-sundae")
    y, p = ring.fold(initial), ring.parameters(chain)
    span = np.array([0.0, t1])

    def run(rtol: float) -> np.ndarray:
        solver = sundials.CVODE(
            ring.force_into, jacfn=ring.full_jacobian_into, userdata=tuple(p.tolist()),
            linsolver="band", lband=HALF_BANDWIDTH, uband=HALF_BANDWIDTH,
            rtol=rtol, atol=0.1 * rtol, max_num_steps=_MOST_STEPS,
        )  # fmt: skip
        return ring.unfold(solver.solve(span, y).y[-1])

    return run
