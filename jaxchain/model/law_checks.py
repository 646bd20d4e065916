"""Whether a curve mu(s) can be a law of friction: looked at before it is used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# Speeds at which a law is looked at: from where none has changed yet to where no mass gets.
_SPEEDS = np.concatenate([[0.0], np.geomspace(1e-12, 1e2, 1121)])
# Of the greatest friction: what is a jump, and what may hide one and gets a closer look.
_JUMP, _STEEP = 1e-6, 1e-9
# A closer look takes the steepest part of an interval, again and again, down to rounding.
_PARTS, _ROUNDS, _MOST = 16, 10, 32


def check_curve(name: str, coefficient: Callable[[Any], Any], mu_static: Any) -> None:
    """Raises `ValueError` with the speed at which mu is negative, not finite, or jumps.

    **Arguments:** `name` of the law, for the error; `coefficient` = mu of an array of speeds, of
    shape (speeds,) or (speeds, n), made of concrete numbers; `mu_static`, which mu(0) must be.
    """
    curve = f"Friction law `{name}`"

    def mu(speeds: np.ndarray) -> np.ndarray:
        """Of shape (speeds, 1), or (speeds, n)."""
        with jax.ensure_compile_time_eval():
            values = np.asarray(coefficient(jnp.asarray(speeds)), float)
        if values.shape[:1] != speeds.shape:
            raise ValueError(
                f"{curve} must take speeds element by element, but of an array of shape "
                f"{speeds.shape} it makes one of shape {values.shape}."
            )
        return values.reshape(speeds.size, -1)

    values = mu(_SPEEDS)
    for bad, what in ((~np.isfinite(values), "not finite"), (values < 0, "negative")):
        if np.any(bad):
            row, mass = np.argwhere(bad)[0]
            raise ValueError(
                f"{curve} is {what} at the speed {_SPEEDS[row]:.6g}: mu = {values[row, mass]:.6g}."
                f" Up to a speed of {_SPEEDS[-1]:g} it must be finite and at least 0."
            )
    least_jump = _JUMP * values.max()
    if np.any(np.abs(values[0] - np.asarray(mu_static, float)) > least_jump):
        raise ValueError(
            f"{curve} jumps at the speed 0: `mu_static` is {mu_static}, but mu(0) is "
            f"{np.squeeze(values[0])}. Both are the friction at rest and must be the same."
        )
    jump, speed = _greatest_jump(mu, values)
    if jump > least_jump:
        raise ValueError(
            f"{curve} jumps at the speed {speed:.6g}, by {jump:.6g}. mu(s) must be continuous: "
            "let it change over a small range of speeds."
        )


def _greatest_jump(
    mu: Callable[[np.ndarray], np.ndarray], values: np.ndarray
) -> tuple[float, float]:
    """(height, speed) of the greatest change between two speeds that are the same to rounding."""
    rise = np.max(np.abs(np.diff(values, axis=0)), axis=1)
    beside = np.pad(rise, 1)
    stands_out = rise > 3 * (beside[:-2] + beside[2:]) + _STEEP * values.max()
    steep = np.flatnonzero(stands_out)
    if steep.size == 0:
        return 0.0, 0.0
    steep = steep[np.argsort(-rise[steep])][:_MOST]
    low, high, row = _SPEEDS[steep], _SPEEDS[steep + 1], np.arange(min(steep.size, _MOST))
    for _ in range(_ROUNDS):
        parts = np.linspace(low, high, _PARTS + 1, axis=1)
        values = mu(parts.ravel()).reshape(*parts.shape, -1)
        change = np.max(np.abs(np.diff(values, axis=1)), axis=2)
        at = np.argmax(change, axis=1)
        low, high, rise = parts[row, at], parts[row, at + 1], change[row, at]
    greatest = np.argmax(rise)
    return float(rise[greatest]), float(high[greatest])
