"""Smoothed friction and its variational equations in NumPy, integrated by SciPy: for one mass."""

import numpy as np
from scipy.integrate import solve_ivp


class OneMass:
    """x'' + 2 xi x' + x = -mu(|w|) tanh(w / eps), w = x' - v_d, exponential decay of friction."""

    def __init__(self, width, xi=0.05, mu_static=1.0, mu_dynamic=0.5, v_ref=0.5):
        self.width, self.xi, self.v_ref = width, xi, v_ref
        self.mu_static, self.mu_dynamic = mu_static, mu_dynamic

    def force_and_slope(self, w):
        drop = (self.mu_static - self.mu_dynamic) * np.exp(-abs(w) / self.v_ref)
        mu, direction = self.mu_dynamic + drop, np.tanh(w / self.width)
        slope = drop / self.v_ref * np.sign(w) * direction - mu * (1 - direction**2) / self.width
        return -mu * direction, slope

    def after(self, x, v, period, belt_speed, rtol=1e-12):
        """(x, v) and the monodromy matrix after a period."""

        def field(t, y):
            x, v = y[:2]
            force, slope = self.force_and_slope(v - belt_speed)
            jacobian = np.array([[0.0, 1.0], [-1.0, slope - 2 * self.xi]])
            moved = jacobian @ y[2:].reshape(2, 2)
            return [v, force - 2 * self.xi * v - x, *moved.ravel()]

        start = [x, v, 1.0, 0.0, 0.0, 1.0]
        run = solve_ivp(field, (0.0, period), start, method="DOP853", rtol=rtol, atol=1e-13)
        end = run.y[:, -1]
        return end[:2], end[2:].reshape(2, 2)
