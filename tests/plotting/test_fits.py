"""The picture of a profile shows chi^2 over the number, and its interval."""

import jax.numpy as jnp
import numpy as np
from drawn import height

from jaxchain.inverse import Profile
from jaxchain.plotting.fits import plot_profile


def shaded(axes):
    (shade,) = axes.patches
    return shade.get_x(), shade.get_x() + shade.get_width()


def test_a_profile_is_drawn_with_its_limit_and_its_interval():
    values = jnp.linspace(0.3, 0.7, 41)
    chi = ((values - 0.5) / 0.05) ** 2
    low, high = 0.5 - 0.05 * 1.959964, 0.5 + 0.05 * 1.959964
    of_v = Profile(values, 3.0 + chi, *map(jnp.asarray, (3.0, low, high, 0.95)))
    axes = plot_profile(of_v, "$v_0$ (–)")
    curve, limit = axes.get_lines()
    np.testing.assert_array_equal(curve.get_xdata(), values)
    np.testing.assert_allclose(height(curve), chi, atol=1e-9)
    np.testing.assert_allclose(height(limit), 1.959964**2, rtol=1e-6)
    np.testing.assert_allclose(shaded(axes), (low, high))
    assert axes.get_xlabel() == "$v_0$ (–)"
    # An interval that does not end goes to the edge.
    endless = Profile(values, 3.0 + chi, *map(jnp.asarray, (3.0, -jnp.inf, high, 0.95)))
    assert shaded(plot_profile(endless, "$v_0$ (–)"))[0] == values[0]
