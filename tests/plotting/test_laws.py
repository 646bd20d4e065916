"""The picture of a friction law agrees with the law."""

import jax.numpy as jnp
import numpy as np
from drawn import SCALES, legend

from jaxchain.model.chain import paper_chain
from jaxchain.model.friction import Coulomb, ExponentialDecay
from jaxchain.plotting.laws import plot_friction_law

LAW = ExponentialDecay(1.0, 0.5, 0.5)


def lines(axes):
    return [np.asarray(line.get_xydata()) for line in axes.get_lines()]


def test_a_dry_law_has_two_branches_and_an_upright_line_between_them():
    left, right, jump, _ = lines(plot_friction_law(LAW, reach=2.0))
    for (w, force), sign in ((left.T, 1.0), (right.T, -1.0)):
        np.testing.assert_allclose(force, sign * np.asarray(LAW.coefficient(jnp.abs(w))))
        assert np.abs(w).max() == 2.0
    np.testing.assert_array_equal(jump, [[0.0, -1.0], [0.0, 1.0]])


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


def test_a_smoothed_law_lies_over_the_dry_one():
    axes = plot_friction_law(paper_chain(1, width=0.05))
    *_, smoothed, _ = lines(axes)
    w, force = smoothed.T
    expected = -(0.5 + 0.5 * np.exp(-np.abs(w) / 0.5)) * np.tanh(w / 0.05)
    np.testing.assert_allclose(force, expected, rtol=1e-12, atol=1e-15)
    assert np.all(np.diff(w) >= 0)
    assert legend(axes) == ["dry", r"$\varepsilon$ = 0.05"]
