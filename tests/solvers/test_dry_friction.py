"""The chain with true dry friction, as a Taylor series about the present."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxchain.model.chain import Chain
from jaxchain.model.friction import ExponentialDecay
from jaxchain.solvers.dry_events import start
from jaxchain.solvers.dry_series import expand


def test_the_series_has_every_force_of_the_chain():
    """A force that is added to the chain, and not to the series, must not be lost in silence."""
    chain = Chain(
        4, ExponentialDecay(1.0, 0.5, 0.5), 0.3, damping_ratio=jnp.array([0.1, 0.2, 0.05, 0.3]),
        coupling=jnp.array([0.2, 0.3, 0.1, 0.4]), stiffness=jnp.array([1.0, 2.0, 0.5, 1.5]),
        normal_load=jnp.array([1.0, 0.7, 1.2, 0.9]),
    )  # fmt: skip
    # Two slide forward, two backward; none sticks.
    x, v = jnp.array([0.5, -1.2, 2.0, 0.1]), jnp.array([1.0, 0.7, -0.4, 0.0])
    _, modes = start(chain, 0.0, (x, v))
    series = jax.jit(lambda x, v, modes: expand(chain, 0.0, (x, v), modes, 4))(x, v, modes)

    def polynomial(t: Any, coefficients: list[Array]) -> Array:
        return jnp.polyval(jnp.stack(coefficients)[::-1], t)

    def force(t):
        return chain.free_force(polynomial(t, series.x[0]), polynomial(t, series.v[0]))

    derivative, factorial = force, 1.0
    for k in range(4):
        np.testing.assert_allclose(series.r[k], jax.jit(derivative)(0.0) / factorial, rtol=1e-12)
        derivative, factorial = jax.jacfwd(derivative), factorial * (k + 1)

    def relative(t):
        return polynomial(t, series.v[0]) - chain.belt_speed

    # And the equation of motion, v' = r - direction p mu, at t = 0 and in its first derivative.
    def friction(t):
        return -modes.direction * chain.load * chain.law.coefficient(jnp.abs(relative(t)))

    def total(t):
        return force(t) + friction(t)

    value, slope = jax.jit(lambda t: (total(t), jax.jacfwd(total)(t)))(0.0)
    np.testing.assert_allclose(series.v[0][1], value, rtol=1e-12)
    np.testing.assert_allclose(2.0 * series.v[0][2], slope, rtol=1e-12)
