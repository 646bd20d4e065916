"""The figure of a branch agrees with its dataset: line, style, special points, names."""

from dataclasses import replace

import numpy as np
import pytest
from drawn import SCALES, legend, page_of
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from synthetic import cycle_branch, special_curve

from jaxchain.cycles.shooting import Shooting
from jaxchain.model.ready_made import VanDerPol
from jaxchain.plotting.branches import MARKS, PARTS, plot_branch, plot_special_curves, smooth
from jaxchain.plotting.style import COLUMN_WIDTH
from jaxchain.solvers.rosenbrock import Rodas5P


def points(line):
    """Those of the branch, between which the line is a curve."""
    x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    return x[::PARTS], y[::PARTS]


def named(axes):
    found = {}
    for line in axes.get_lines():
        found.setdefault(line.get_label(), []).append(line)
    return found


def test_the_line_is_the_energy_solid_while_stable_and_dashed_beyond_the_fold():
    branch = cycle_branch()
    axes = plot_branch(branch)
    (stable,), (unstable,) = (named(axes)[word] for word in ("stable", "unstable"))
    assert stable.get_linestyle() == "-"
    assert unstable.get_linestyle() == "--"
    fold, hopf = (0.5 * np.sum(point.amplitude**2) for point in branch.special)
    x, y = points(stable)
    np.testing.assert_array_equal(x, [*branch.parameter[:4], 1.85])
    np.testing.assert_allclose(y, [*branch.energy[:4], fold], rtol=1e-14)
    x, y = points(unstable)
    np.testing.assert_array_equal(x, [1.85, *branch.parameter[4:], 1.15])
    np.testing.assert_allclose(y, [fold, *branch.energy[4:], hopf], rtol=1e-14)


def test_a_branch_of_cells_bears_no_symbols_of_a_chain():
    branch = cycle_branch(1)
    shooting = Shooting(VanDerPol(mu=1.0), 1e-10, Rodas5P(), 0, (0,), "mu")
    data = replace(branch, name="mu", pieces=((shooting, branch.branch),)).to_dataset()
    axes = plot_branch(data)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("mu (–)", "amplitude of displacement (–)")
    x, y = points(named(axes)["stable"][0])
    np.testing.assert_array_equal(x[:4], branch.parameter[:4])
    np.testing.assert_array_equal(y[:4], branch.amplitude[:4, 0])
    assert plot_branch(data, "period").get_ylabel() == "least period T (–)"
    assert data.period.attrs["units"] == "1"


def test_special_points_are_marked_where_they_are_and_named():
    branch = cycle_branch(special=("fold", "torus", "hopf"))
    axes = plot_branch(branch)
    assert legend(axes) == ["stable", "unstable", "fold", "Hopf point", "torus"]
    for point in branch.special:
        marker, colour, word = MARKS[point.kind]
        (line,) = named(axes)[word]
        assert points(line)[0] == [point.parameter]
        assert points(line)[1] == pytest.approx(0.5 * np.sum(point.amplitude**2))
        assert line.get_marker() == marker
        if colour != "white":
            assert to_hex(line.get_color()) == to_hex(colour)
    looks = [(marker, colour) for marker, colour, _ in MARKS.values()]
    assert len(set(looks)) == len({marker for marker, _ in looks}) == len(MARKS)


def test_axes_in_si_units_have_scaled_numbers():
    axes, si = plot_branch(cycle_branch()), plot_branch(cycle_branch(), scales=SCALES)
    assert axes.get_xlabel() == r"belt speed $\tilde v_d$ (–)"
    assert (si.get_xlabel(), si.get_ylabel()) == (
        "belt speed $v_d$ (m/s)", "vibration energy $E$ (m²)",
    )  # fmt: skip
    for plain, own in zip(axes.get_lines(), si.get_lines(), strict=True):
        # x0 = P / k = 0.05 m, and omega_n = 10 / s.
        scaled = np.asarray(plain.get_xydata()) * [0.5, 0.0025]
        np.testing.assert_allclose(np.asarray(own.get_xydata()), scaled, rtol=1e-12)


def test_branches_lie_on_axes_that_are_given_each_word_once_in_the_legend():
    given = Figure().subplots()
    branch = cycle_branch()
    for colour, label in (("black", "upper"), ("red", "lower")):
        assert plot_branch(branch, ax=given, color=colour, label=label) is given
    assert legend(given) == [
        "upper, stable", "upper, unstable", "fold", "Hopf point", "lower, stable",
        "lower, unstable",
    ]  # fmt: skip
    assert page_of(plot_branch(branch)).get_figwidth() == COLUMN_WIDTH


def extremes(values):
    """Indices of the local extremes of `values`."""
    return (np.flatnonzero(np.diff(np.sign(np.diff(values)))) + 1).tolist()


def test_the_line_has_no_corners_and_no_folds_of_its_own():
    """x = t^2, y = t through the fold at t = 0, at uneven steps."""
    t = np.array([-1.0, -0.7, -0.5, -0.2, 0.0, 0.15, 0.4, 0.8, 1.0])
    x, y = smooth(t**2, t)
    np.testing.assert_array_equal((x[::PARTS], y[::PARTS]), (t**2, t))
    assert extremes(x) == [4 * PARTS]
    assert extremes(y) == []
    assert np.max(np.abs(x - y**2)) < 0.01  # of the chords 0.0225

    def corner(x, y):
        return np.max(np.abs(np.diff(np.unwrap(np.arctan2(np.diff(y), np.diff(x))))))

    assert corner(x, y) < 0.25 * corner(t**2, t)


def test_special_curves_meet_and_the_region_between_them_is_shaded():
    curves = [special_curve(kind) for kind in ("hopf", "fold")]
    axes = plot_special_curves([curves[0], curves[1].to_dataset()])
    regions = ["either", "vibrates by itself", "slides"]
    assert legend(axes) == [*regions, "Hopf point", "generalised Hopf", "fold"]
    for curve, word in zip(curves, ("Hopf point", "fold"), strict=True):
        (line,) = named(axes)[word]
        np.testing.assert_allclose(points(line), [curve.first, curve.second])
    for mark in named(axes)["generalised Hopf"]:
        assert mark.get_xydata().tolist() == [[0.5, 0.3]]
    either, alone, _ = (shaded.get_paths() for shaded in axes.collections)
    inside, outside = [(1.0, 0.15), (0.65, 0.25)], [(0.75, 0.15), (1.15, 0.15), (0.5, 0.29)]
    assert either[0].contains_points(inside).all()
    assert not either[0].contains_points(outside).any()
    assert alone[0].contains_points([(0.75, 0.15), (0.1, 0.25)]).all()
    assert not alone[0].contains_points(inside).any()
    assert "damping" in axes.get_ylabel()
