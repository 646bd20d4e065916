"""Oscillator systems with exact solutions, for the structured solvers."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxchain._types import State
from jaxchain.model.oscillators import AbstractOscillators
from jaxchain.model.springs import Springs


class AbstractExactOscillators(AbstractOscillators):
    """A system that knows its own solution (x, v) at any time."""

    @abc.abstractmethod
    def exact(self, t: Any) -> State:
        """(x, v) at time t from the state `exact(0)`."""


class LinearRing(AbstractExactOscillators):
    """x'' = -2 xi x' - k x + C x with one damping and one stiffness per mass: exp(J t) y_0."""

    damping: jax.Array
    stiffness: jax.Array
    springs: Springs | None
    x0: jax.Array
    v0: jax.Array

    def local_force(self, t, x, v):
        return -2 * self.damping * v

    def stiffness_diagonal(self, n):
        return self.stiffness if self.springs is None else self.stiffness + self.springs.row_sum(n)

    def exact(self, t: Any) -> State:
        n = self.x0.shape[0]
        flow = jax.scipy.linalg.expm(t * self.jacobian(0.0, (self.x0, self.v0)))
        y = flow @ jnp.concatenate([self.x0, self.v0])
        return y[:n], y[n:]


class Driven(AbstractExactOscillators):
    """Prothero and Robinson's problem for an oscillator: x = s(t) = sin(t + phase).

    v' = -rate (v - s') + s'' + K (s - x) + nonlinear (v^3 - s'^3), with K the whole stiffness;
    whatever `rate` is; the greater, the stiffer.
    """

    rate: jax.Array
    phase: jax.Array
    nonlinear: jax.Array
    springs: Springs | None
    stiffness: float = eqx.field(static=True, default=1.0)

    def local_force(self, t, x, v):
        s, ds = jnp.sin(t + self.phase), jnp.cos(t + self.phase)
        return (
            -self.rate * (v - ds) - s - self.restoring_force(s)
            - self.nonlinear * (v**3 - ds**3)
        )  # fmt: skip

    def stiffness_diagonal(self, n):
        if self.springs is None:
            return jnp.asarray(self.stiffness)
        return self.stiffness + self.springs.row_sum(n)

    def exact(self, t: Any) -> State:
        return jnp.sin(t + self.phase), jnp.cos(t + self.phase)


class DrivenInPlace(AbstractExactOscillators):
    """A driven oscillator with forces that are not linear in x: x = s(t) = sin(t + phase).

    v' = s'' + K (s - x) - rate (v - s') - cubic (x^3 - s^3) - mixed (x^2 v - s^2 s').
    """

    rate: jax.Array
    cubic: jax.Array
    mixed: jax.Array
    phase: jax.Array
    springs: Springs | None

    def local_force(self, t, x, v):
        s, ds = jnp.sin(t + self.phase), jnp.cos(t + self.phase)
        balance = -s - self.restoring_force(s) - self.rate * (v - ds)
        return balance - self.cubic * (x**3 - s**3) - self.mixed * (x**2 * v - s**2 * ds)

    def stiffness_diagonal(self, n):
        return jnp.ones(()) if self.springs is None else 1.0 + self.springs.row_sum(n)

    def exact(self, t: Any) -> State:
        return jnp.sin(t + self.phase), jnp.cos(t + self.phase)


class AbstractRing(AbstractOscillators):
    """x'' + x + springs = h(x, x') with the one number `strength` in h."""

    strength: jax.Array
    springs: Springs | None

    def stiffness_diagonal(self, n):
        return jnp.ones(()) if self.springs is None else 1.0 + self.springs.row_sum(n)


class VanDerPol(AbstractRing):
    """h = mu (1 - x^2) x'.  The cycle at mu = 1: period 6.6632868593, amplitude 2.0086198609."""

    def local_force(self, t, x, v):
        return self.strength * (1.0 - x**2) * v


class Cubic(AbstractRing):
    """h = -b x^3: Duffing's oscillators, which conserve energy."""

    def local_force(self, t, x, v):
        return -self.strength * x**3

    def energy(self, x, v):
        quadratic = 0.5 * (v**2 - x * self.restoring_force(x))
        return jnp.sum(quadratic + 0.25 * self.strength * x**4)


class Rayleigh(AbstractRing):
    """h = mu (1 - x'^2 / 3) x', the derivative of van der Pol's oscillator."""

    def local_force(self, t, x, v):
        return self.strength * (1.0 - v**2 / 3.0) * v


class Swinging(AbstractRing):
    """h = -strength cos(2 t) x, Mathieu's equation: autonomous it is not."""

    def local_force(self, t, x, v):
        return -self.strength * jnp.cos(2.0 * t) * x
