"""The drawing of the model shows what the chain has, and its own law of friction."""

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from drawn import SCALES
from matplotlib.colors import to_hex
from matplotlib.patches import FancyArrowPatch, Rectangle

from jaxchain.model.chain import paper_chain
from jaxchain.model.friction import Coulomb, ExponentialDecay
from jaxchain.plotting.colours import BLUE
from jaxchain.plotting.model import draw_model, plot_friction_law
from jaxchain.plotting.style import STYLE
from jaxchain.plotting.symbols import zigzag


def texts(axes):
    return [text.get_text() for text in axes.texts]


def masses(axes):
    return [patch for patch in axes.patches if isinstance(patch, Rectangle)][1:]  # no ceiling


def points(line):
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def curve(axes, label):
    (line,) = [line for line in axes.get_lines() if line.get_label() == label]
    return points(line)


def test_every_mass_has_its_load_and_displacement_and_the_last_is_called_n():
    left, _ = draw_model(paper_chain(20), masses=4).axes
    assert len(masses(left)) == 4
    # A load and a displacement for every mass, and one arrow for the belt.
    assert sum(isinstance(patch, FancyArrowPatch) for patch in left.patches) == 2 * 4 + 1
    names = texts(left)
    assert names.count("$m$") == names.count("$P$") == 4
    assert [name for name in names if "x_" in name] == [f"$x_{{{n}}}$" for n in (1, 2, 3, "N")]
    assert {"$k$", "$c$", "$k_c$", "$v_d$", "…", "$k_c$ closes the ring"} <= set(names)


def test_what_the_chain_has_not_is_not_drawn():
    left, _ = draw_model(paper_chain(3).with_(ends="free"), masses=4).axes
    assert len(masses(left)) == 3
    assert "$k_c$" in texts(left)
    assert "$k_c$ closes the ring" not in texts(left)
    left, _ = draw_model(paper_chain(1)).axes
    assert len(masses(left)) == 1
    assert not [name for name in texts(left) if "k_c" in name or name == "…"]


def test_friction_is_that_of_eq_1_and_2_and_of_its_smoothing():
    _, right = draw_model(paper_chain(20, width=0.05)).axes
    w, force = curve(right, "dry")
    np.testing.assert_allclose(force, -(0.5 + 0.5 * np.exp(-np.abs(w) / 0.5)), rtol=1e-14)
    # Where the law is set-valued a vertical line joins its two values.
    vertical = [y for x, y in map(points, right.get_lines()) if x.tolist() == [0.0, 0.0]]
    assert [-1.0, 1.0] in [y.tolist() for y in vertical]
    w, force = curve(right, r"$\varepsilon$ = 0.05")
    expected = -(0.5 + 0.5 * np.exp(-np.abs(w) / 0.5)) * np.tanh(w / 0.05)
    np.testing.assert_allclose(force, expected, rtol=1e-12, atol=1e-15)
    assert np.all(np.diff(w) >= 0)
    ticks = dict(
        zip(right.get_yticks(), [t.get_text() for t in right.get_yticklabels()], strict=True)
    )
    assert ticks[1.0] == r"$\mu_{st}$"
    assert ticks[-0.5] == r"$-\mu_d$"
    # The layer of smoothing, in widths.
    (inset,) = right.child_axes
    assert inset.get_xlabel() == r"$\tilde v_{rel}/\varepsilon$"
    (layer,) = [points(line) for line in inset.get_lines() if line.get_color() == BLUE]
    expected = -(0.5 + 0.5 * np.exp(-np.abs(layer[0]) * 0.1)) * np.tanh(layer[0])
    np.testing.assert_allclose(layer[1], expected, atol=1e-15)


@pytest.mark.parametrize("chain", [paper_chain(20), paper_chain(2, belt_speed=-1.0)])
def test_no_two_labels_overlap(chain):
    page = draw_model(chain)
    with matplotlib.rc_context(STYLE):
        page.draw_without_rendering()
    for axes in page.axes:
        boxes = [text.get_window_extent() for text in axes.texts]
        legend = axes.get_legend()
        boxes += [] if legend is None else [legend.get_window_extent()]
        for i, box in enumerate(boxes):
            assert not any(box.overlaps(other) for other in boxes[:i])


def test_a_spring_keeps_its_ends():
    x, y = zigzag((1.0, 2.0), (4.0, 6.0))
    assert (x[0], y[0], x[-1], y[-1]) == pytest.approx((1.0, 2.0, 4.0, 6.0))


LAW = ExponentialDecay(1.0, 0.5, 0.5)


def lines(axes):
    return [np.asarray(line.get_xydata()) for line in axes.get_lines()]


def test_a_dry_law_has_two_branches_and_an_upright_line_between_them():
    left, right, jump, _ = lines(plot_friction_law(LAW, reach=2.0))
    for (w, force), sign in ((left.T, 1.0), (right.T, -1.0)):
        np.testing.assert_allclose(force, sign * np.asarray(LAW.coefficient(jnp.abs(w))))
        assert np.abs(w).max() == 2.0
    np.testing.assert_array_equal(jump, [[0.0, -1.0], [0.0, 1.0]])
    # Of masses that differ the first is shown.
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


def test_the_belt_points_where_it_goes():
    for speed in (1.5, -1.5):
        left, right = draw_model(paper_chain(2, belt_speed=speed)).axes
        arrows = [patch for patch in left.patches if isinstance(patch, FancyArrowPatch)]
        (belt,) = [arrow for arrow in arrows if to_hex(arrow.get_edgecolor()) == BLUE.lower()]
        start, end = vars(belt)["_posA_posB"]
        assert np.sign(end[0] - start[0]) == np.sign(speed)
        at, force = curve(right, "steady sliding")
        assert at[0] == -speed
        np.testing.assert_allclose(force[0], np.sign(speed) * (0.5 + 0.5 * np.exp(-3.0)))
