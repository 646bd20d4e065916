"""The friction law as it is: the dry one with its jump, the smoothed one over it."""

import jax.numpy as jnp
import numpy as np

from jaxchain.model.chain import paper_chain
from jaxchain.model.friction import Coulomb, ExponentialDecay
from jaxchain.model.units import Scales
from jaxchain.plotting.friction import plot_friction_law

LAW = ExponentialDecay(1.0, 0.5, 0.5)
SCALES = Scales.from_dimensional(
    mass=2.0, damping=2.0, stiffness=200.0, coupling_stiffness=2.0, normal_load=10.0
)


def lines(axes):
    return [np.asarray(line.get_xydata()) for line in axes.get_lines()]


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_a_dry_law_has_two_branches_and_an_upright_line_between_them():
    left, right, jump, _ = lines(plot_friction_law(LAW, reach=2.0))
    for (w, force), sign in ((left.T, 1.0), (right.T, -1.0)):
        np.testing.assert_allclose(force, sign * np.asarray(LAW.coefficient(jnp.abs(w))))
        assert np.abs(w).max() == 2.0
    np.testing.assert_array_equal(jump, [[0.0, -1.0], [0.0, 1.0]])


def test_the_smoothed_law_is_drawn_over_the_dry_one():
    smoothed = LAW.with_(width=0.05)
    chain = paper_chain(2, belt_speed=1.5, width=0.05)
    for given in (smoothed, chain):
        axes = plot_friction_law(given)
        assert legend(axes) == ["dry", r"$\varepsilon$ = 0.05"]
        w, force = lines(axes)[3].T
        np.testing.assert_allclose(force, smoothed.force(jnp.asarray(w)))
    assert axes.get_xlim() == (-1.25 * 1.5, 1.25 * 1.5)  # the belt speed is seen


def test_a_dry_chain_has_no_smoothed_law_and_masses_that_differ_show_the_first():
    chain = paper_chain(2, width=None).with_(mu_static=jnp.array([0.9, 1.2]))
    axes = plot_friction_law(chain)
    assert len(axes.get_lines()) == 4
    np.testing.assert_array_equal(lines(axes)[2][:, 1], [-0.9, 0.9])


def test_axes_in_si_units():
    axes = plot_friction_law(Coulomb(0.4), reach=1.0, scales=SCALES)
    assert axes.get_xlabel() == "relative velocity $v_{rel}$ (m/s)"
    assert axes.get_ylabel() == "friction force $F$ (N)"
    np.testing.assert_allclose(lines(axes)[2][:, 1], [-4.0, 4.0])
    assert axes.get_xlim() == (-0.5, 0.5)
