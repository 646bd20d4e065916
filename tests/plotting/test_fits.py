"""The picture of a profile shows chi^2 over the number, and its interval."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import hopf_belt_speed
from jaxchain.inverse import Measurements, identify, profile
from jaxchain.model.chain import paper_chain
from jaxchain.plotting.fits import plot_profile


def shaded(axes):
    (shade,) = axes.patches
    return shade.get_x(), shade.get_x() + shade.get_width()


def test_a_profile_is_drawn_as_its_closed_form():
    chain, lab = paper_chain(1, width=None), Measurements(hopf=(1.2, 0.05))

    def law(chain, v):
        return chain.with_(v_ref=v)

    of_v = profile(identify(chain, law, jnp.array(0.6), lab), chain, law, lab, 0)
    axes = plot_profile(of_v, "$v_0$ (–)")
    curve, limit = axes.get_lines()
    values, rise = (np.asarray(data) for data in curve.get_data())
    exact = jax.vmap(lambda v: ((1.2 - hopf_belt_speed(law(chain, v))) / 0.05) ** 2)(values)
    np.testing.assert_allclose(rise, exact, atol=1e-9)
    assert np.ptp(np.asarray(limit.get_ydata())) == 0.0
    np.testing.assert_allclose(np.max(np.asarray(limit.get_ydata())), 1.959964**2, rtol=1e-6)
    low, high = shaded(axes)
    assert abs(np.interp(low, values, rise) - 1.959964**2) < 0.05
    np.testing.assert_allclose((low, high), (of_v.low, of_v.high))
    assert axes.get_xlabel() == "$v_0$ (–)"
