"""Independent answers for the study of extremes: NumPy and SciPy, nothing of the integrators.

Each takes plain numbers and returns the state at the end, (x_1 .. x_n, v_1 .. v_n).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from jaxchain.studies.extremes.table import Model


@dataclass(frozen=True)
class Oscillator:
    """One mass on the belt, with the exponential law: x'' + 2 xi x' + k x = F(x' - v_d)."""

    belt_speed: float = 1.2
    damping_ratio: float = 0.05
    width: float = 1e-6
    mu_static: float = 1.0
    mu_dynamic: float = 0.5
    v_ref: float = 0.5
    stiffness: float = 1.0
    displacement: float = 3.0
    velocity: float = 0.0
    duration: float = 50.0

    def mu(self, speed: float) -> float:
        """The friction coefficient at a sliding speed."""
        drop = self.mu_static - self.mu_dynamic
        return self.mu_dynamic + drop * math.exp(-abs(speed) / self.v_ref)

    def dry_amplitude(self, window: float) -> np.ndarray:
        """Half the distance between the extremes of x in the last `window`."""
        turns: list[tuple[float, float]] = []
        self.dry(turns)
        x = [x for t, x in turns if t >= self.duration - window]
        return np.array([(max(x) - min(x)) / 2])

    def dry(self, turns: list[tuple[float, float]] | None = None) -> np.ndarray:
        """With true dry friction: slip by DOP853 to the next w = 0, stick in closed form.

        Where and when x turns is added to `turns`.
        """
        x, v, t, end = self.displacement, self.velocity, 0.0, self.duration
        while t < end:
            held = self.stiffness * x + 2 * self.damping_ratio * v  # what friction has to hold
            if v == self.belt_speed and abs(held) <= self.mu_static:
                x, t = self._stick(x, t, held)
                side = -math.copysign(1.0, self.belt_speed)
            else:
                w = v - self.belt_speed
                side = math.copysign(1.0, w) if w else -math.copysign(1.0, held)
            if t < end:
                x, v, t = self._slip(x, v, t, side, turns)
        return np.array([x, v])

    def _stick(self, x: float, t: float, held: float) -> tuple[float, float]:
        rate = self.stiffness * self.belt_speed
        left = self.duration - t
        if rate:
            left = min(left, (math.copysign(self.mu_static, rate) - held) / rate)
        return x + self.belt_speed * left, t + left

    def _slip(
        self, x: float, v: float, t: float, side: float, turns: list | None
    ) -> tuple[float, float, float]:
        def slope(t: float, y: Any) -> tuple[float, float]:
            friction = -side * self.mu(y[1] - self.belt_speed)
            return y[1], friction - 2 * self.damping_ratio * y[1] - self.stiffness * y[0]

        def meets_belt(t: float, y: Any) -> float:
            return y[1] - self.belt_speed

        def rests(t: float, y: Any) -> float:
            return y[1]

        meets_belt.terminal, meets_belt.direction = True, -side  # pyright: ignore
        run = solve_ivp(
            slope, (t, self.duration), (x, v), method="DOP853", rtol=1e-12, atol=1e-14,
            events=(meets_belt, rests), max_step=0.2 / math.sqrt(max(self.stiffness, 1.0)),
        )  # fmt: skip
        if turns is not None:
            turns += [(t, y[0]) for t, y in zip(run.t_events[1], run.y_events[1], strict=True)]
        x, v = run.y[:, -1]
        return x, (self.belt_speed if run.status == 1 else v), float(run.t[-1])

    def end(self, model: Model) -> np.ndarray:
        """With the friction of a model."""
        return self.dry() if model == "nonsmooth" else self.smoothed()

    def smoothed(self) -> np.ndarray:
        """With the smoothed law, by LSODA with the exact Jacobian."""
        return smoothed_chain(self, np.array([self.displacement]), np.array([self.velocity]))

    def smoothed_amplitude(self, window: float) -> np.ndarray:
        """Half peak-to-peak over the last `window`, from samples 1e-3 apart."""
        times = np.arange(self.duration - window, self.duration, 1e-3)
        start = np.array([self.displacement]), np.array([self.velocity])
        x = smoothed_chain(self, *start, times=times)[0]
        return np.array([np.ptp(x) / 2])


def smoothed_chain(
    mass: Oscillator,
    x: np.ndarray,
    v: np.ndarray,
    springs: np.ndarray | None = None,
    times: np.ndarray | None = None,
) -> np.ndarray:
    """Equal masses joined by `springs`, the matrix C of v' = g(v) - k x - C x, by LSODA.

    **Returns:** the state at the end, or at each of `times`, shape (2 n, times).
    """
    n, eps = x.size, mass.width
    drop = mass.mu_static - mass.mu_dynamic
    stiffness = mass.stiffness * np.eye(n) + (0 if springs is None else springs)

    def force(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s, decay = np.abs(w), drop * np.exp(-np.abs(w) / mass.v_ref)
        mu, turn = mass.mu_dynamic + decay, np.tanh(w / eps)
        slope = decay / mass.v_ref * np.sign(w) * turn - mu * (1 - turn**2) / eps
        return -mu * turn, slope + 0 * s

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        x, v = y[:n], y[n:]
        pull = force(v - mass.belt_speed)[0] - 2 * mass.damping_ratio * v - stiffness @ x
        return np.concatenate([v, pull])

    def jacobian(t: float, y: np.ndarray) -> np.ndarray:
        damping = force(y[n:] - mass.belt_speed)[1] - 2 * mass.damping_ratio
        return np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, np.diag(damping)]])

    run = solve_ivp(
        slope, (0.0, mass.duration), np.concatenate([x, v]), method="LSODA", jac=jacobian,
        rtol=1e-11, atol=1e-12, t_eval=times,
    )  # fmt: skip
    if not run.success:
        raise ArithmeticError(f"The witness failed: {run.message}")
    return run.y if times is not None else run.y[:, -1]


def ring(n: int, springs: np.ndarray | float, cyclic: bool = True) -> np.ndarray:
    """The matrix C of springs between neighbours; spring i joins masses i and i + 1."""
    constants = np.broadcast_to(springs, (n if cyclic else n - 1,))
    matrix = np.zeros((n, n))
    for i, constant in enumerate(constants):
        j = (i + 1) % n
        pair = np.array([[1.0, -1.0], [-1.0, 1.0]]) * constant
        matrix[np.ix_([i, j], [i, j])] += pair
    return matrix


def linear_chain(
    stiffness: np.ndarray, damping_ratio: float, force: float, x: np.ndarray, v: np.ndarray,
    duration: float,
) -> np.ndarray:  # fmt: skip
    """A chain under a constant force on every mass, x'' + 2 xi x' + K x = force, exactly."""
    n = x.size
    generator = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-stiffness, -2 * damping_ratio * np.eye(n)]]
    )
    rest = np.concatenate([np.linalg.solve(stiffness, np.full(n, force)), np.zeros(n)])
    return rest + expm(generator * duration) @ (np.concatenate([x, v]) - rest)
