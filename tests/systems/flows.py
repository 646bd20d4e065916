"""Flows with known Lyapunov exponents, dressed as oscillators."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxchain import Chain, ExponentialDecay, TanhFriction
from jaxchain._types import State
from jaxchain.model.oscillators import AbstractOscillators

# J. C. Sprott, Chaos and Time-Series Analysis, Oxford 2003, appendix A.
LORENZ = (0.9056, 0.0, -14.5723)
# The divergence of the Lorenz field, the same everywhere: -(sigma + 1 + beta).
LORENZ_DIVERGENCE = -(10.0 + 1.0 + 8.0 / 3.0)


class Lorenz63(AbstractOscillators):
    """Lorenz's three equations as displacements, and three velocities that only decay.

    v' = -rate v adds three exponents -rate; for stock solvers only, as x' is not v.
    """

    rate: jax.Array
    springs: None = eqx.field(static=True, default=None)

    def local_force(self, t, x, v):
        return -self.rate * v

    def divergence(self, t, y):
        return LORENZ_DIVERGENCE - 3.0 * self.rate

    def stiffness_diagonal(self, n):
        return jnp.zeros(())

    def __call__(self, t: Any, y: State, args: object = None) -> State:
        (a, b, c), v = y
        return jnp.stack([10 * (b - a), a * (28 - c) - b, a * b - 8 / 3 * c]), -self.rate * v


def linear_chain(n: int, damping_ratio: float, coupling: Any) -> tuple[Chain, jax.Array]:
    """(a chain whose friction is constant as long as no mass is as fast as the belt, exponents).

    The exponents are the real parts of its eigenvalues, the greatest first.
    """
    # The same class as in the paper's chain, so that one program serves both.
    friction = TanhFriction(ExponentialDecay(0.5, 0.5, 0.5), 1e-3)
    chain = Chain(n, friction, belt_speed=50.0, damping_ratio=damping_ratio, coupling=coupling)
    J = chain.jacobian(0.0, (jnp.zeros(n), jnp.zeros(n)))
    return chain, -jnp.sort(-jnp.real(jnp.linalg.eigvals(J)))
