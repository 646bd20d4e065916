"""The chain with true dry friction, as a Taylor series about the present."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.model.chain import Chain
from jaxchain.model.friction import ExponentialDecay
from jaxchain.solvers.dry_events import start
from jaxchain.solvers.dry_series import expand


def test_the_series_has_every_force_of_the_chain():
    """A force that is added to the chain, and not to the series, must not be lost in silence."""
    chain = Chain(
        4, ExponentialDecay(1.0, 0.5, 0.5), 0.3, damping_ratio=np.array([0.1, 0.2, 0.05, 0.3]),
        coupling=np.array([0.2, 0.3, 0.1, 0.4]), stiffness=np.array([1.0, 2.0, 0.5, 1.5]),
        normal_load=np.array([1.0, 0.7, 1.2, 0.9]),
    )  # fmt: skip
    # Two slide forward, two backward; none sticks.
    x, v = np.array([0.5, -1.2, 2.0, 0.1]), np.array([1.0, 0.7, -0.4, 0.0])

    @jax.jit
    def series_and_derivatives(x, v):
        _, modes = start(chain, 0.0, (x, v))
        series = expand(chain, 0.0, (x, v), modes, 4)

        def force(t):
            x, v = (jnp.polyval(jnp.stack(c)[::-1], t) for c in (series.x[0], series.v[0]))
            return chain.free_force(x, v), v - chain.belt_speed

        # And the equation of motion, v' = r - direction p mu.
        def total(t):
            r, w = force(t)
            return r - modes.direction * chain.load * chain.law.coefficient(jnp.abs(w))

        derivatives = [lambda t: force(t)[0]]
        for _ in range(3):
            derivatives.append(jax.jacfwd(derivatives[-1]))
        found = [series.r[k] for k in range(4)], [series.v[0][k] for k in range(3)]
        return *found, [d(0.0) for d in derivatives], (total(0.0), jax.jacfwd(total)(0.0))

    r, velocity, derivatives, (value, slope) = series_and_derivatives(x, v)
    for k, derivative in enumerate(derivatives):
        np.testing.assert_allclose(r[k], derivative / math.factorial(k), rtol=1e-12)
    np.testing.assert_allclose(velocity[1], value, rtol=1e-12)
    np.testing.assert_allclose(2.0 * velocity[2], slope, rtol=1e-12)
