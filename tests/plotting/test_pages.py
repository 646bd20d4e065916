"""Figures of scenes and what they mark: the Hopf speed, moving fronts, cycles, failed runs."""

from typing import Any

import matplotlib
import numpy as np
import pytest
import xarray as xr
from drawn import across, height, labelled, legend
from synthetic import ladder, results, single

from jaxchain.plotting import pages
from jaxchain.plotting.branches import PARTS
from jaxchain.plotting.diagram import hopf_belt_speed, intervals, moving_fronts
from jaxchain.plotting.pages import figure
from jaxchain.plotting.style import shades
from jaxchain.scenes.report import summary


def where(line):
    return across(line).tolist()


def named_panels(page):
    return [axes for axes in page.axes if axes.get_xlabel()]


def test_every_run_is_one_point_at_its_place():
    data = single()
    (left,) = named_panels(figure({"single": data}))
    (vibrating,), (resting,) = labelled(left, "vibrating"), labelled(left, "steady sliding")
    assert len(where(vibrating)) == int((data.active_count == 1).sum())
    assert len(where(resting)) == int((data.active_count == 0).sum())
    assert set(np.asarray(vibrating.get_ydata())) == {1.5}
    data = ladder()
    right, bar = figure({"ladder": data}).axes
    assert bar.get_ylabel() == "vibrating oscillators"
    unnamed = [line for line in right.get_lines() if str(line.get_label()).startswith("_")]
    assert len(unnamed) == 6
    for count, points in enumerate(unnamed, 1):
        assert points.get_color() == shades(6)(count - 1)
        speeds = data.belt_speed.broadcast_like(data.energy).values[data.active_count == count]
        assert sorted(where(points)) == sorted(speeds)
        np.testing.assert_allclose(height(points), 0.5 * 1.5**2 * count)


def test_rest_is_drawn_as_stable_only_where_the_numbers_of_the_run_say_so():
    bare = ladder().drop_vars("hopf_belt_speed")  # as `sweep` returns it
    (unstable,) = labelled(named_panels(figure({"ladder": bare}))[0], "unstable sliding")
    assert where(unstable) == [1.0, 1.1]
    assert "sliding       at belt speeds 1.2 to 1.9\n" in summary("ladder", bare)
    damped = results(
        {"damping_ratio": [0.05, 0.1], "belt_speed": [0.5, 1.0, 1.3]},
        np.zeros((2, 3)),
        2,
        damping_ratio="swept",
    ).drop_vars("hopf_belt_speed")  # v_H is ln(10) / 2, and ln(5) / 2
    axes = named_panels(figure({"damped": damped}))[0]
    assert where(*labelled(axes, "unstable sliding")) == [0.5, 1.0, 0.5]
    assert where(*labelled(axes, "steady sliding")) == [1.3, 1.0, 1.3]


def test_only_what_does_not_move_slides_steadily():
    """One mass that has not come to rest at 1.3 ... 1.9, for its two smaller starts."""
    data = single()
    quiet = data.active_count == 0
    data["amplitude"] = data.amplitude.where(~quiet | (data.displacement > 1), 0.3)
    (axes,) = named_panels(figure({"single": data.drop_vars("energy")}))
    (resting,), (moving,) = labelled(axes, "steady sliding"), labelled(axes, pages.NOT_VIBRATING)
    assert where(resting) == [1.9, 1.9]
    assert sorted(where(moving)) == [1.3, 1.3, 1.6, 1.6, 1.9, 1.9]
    np.testing.assert_allclose(np.asarray(moving.get_ydata()), 0.3)
    assert resting.get_marker() != moving.get_marker()
    text = summary("single", data)
    assert "sliding       at belt speeds 1.9\n" in text
    assert "weak          at belt speeds 1.3 to 1.9: moves, but no mass above v_d / 2" in text


def test_the_hopf_speed_is_read_off_the_data():
    before = dict(matplotlib.rcParams)
    for given, expected in ((None, 0.5 * np.log(10)), (1.25, 1.25)):
        page = figure({"single": single(), "ladder": ladder(), "more": ladder()}, hopf=given)
        for axes in named_panels(page):
            assert where(*labelled(axes, r"Hopf $\tilde v_H$")) == [expected] * 2
    assert [axes.get_title(loc="left") for axes in named_panels(page)] == ["(a)", "(b)", "(c)"]
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("values", [None, np.nan, [np.nan, 1.2]])
def test_no_hopf_speed_is_drawn_that_is_not_that_of_all_runs(values):
    data = single().drop_vars("hopf_belt_speed")
    if values is not None:
        data["hopf_belt_speed"] = (("coupling",) * np.ndim(values), values)
    assert hopf_belt_speed(data) is None
    (axes,) = named_panels(figure({"single": data}))
    assert not labelled(axes, r"Hopf $\tilde v_H$")


def branch():
    """Unstable cycles from rest at 1.15 to a fold at 1.8, and stable ones back to 0.5."""
    return xr.Dataset(
        {
            "belt_speed": ("point", [1.15, 1.5, 1.8, 1.4, 0.5]),
            "amplitude": ("point", [0.0, 1.0, 1.7, 1.6, 0.9]),
            "stable": ("point", [False, False, False, True, True]),
            "fold_belt_speed": 1.8,
            "fold_amplitude": 1.7,
        }
    )


def test_saved_cycles_are_drawn_through_their_fold():
    (axes,) = named_panels(figure({"single": single(), "single_cycles": branch()}))
    (unstable,), (fold,) = labelled(axes, "unstable"), labelled(axes, "fold")
    assert where(unstable)[::PARTS] == [1.15, 1.5, 1.8, 1.4]
    assert unstable.get_linestyle() == "--"
    assert (where(fold), height(fold).tolist()) == ([1.8], [1.7])
    (stable,) = labelled(axes, "stable")
    assert (where(stable)[::PARTS], stable.get_linestyle()) == ([1.4, 0.5], "-")


def test_fronts_move_where_the_active_count_changes():
    data = ladder()
    moving = moving_fronts(data)
    assert moving is not None
    assert data.belt_speed.values[moving.values].tolist() == [1.0, 1.1, 1.2, 1.7]
    assert intervals(data.belt_speed.values, moving.values) == [
        (1.0, pytest.approx(1.25)),
        (pytest.approx(1.65), pytest.approx(1.75)),
    ]
    axes = named_panels(figure({"ladder": data}))[0]
    patches: Any = axes.patches
    bands = [(band.get_x(), band.get_x() + band.get_width()) for band in patches]
    np.testing.assert_allclose(bands, [(1.0, 1.25), (1.65, 1.75)])
    assert legend(axes).count("moving fronts") == 1
    assert "moving fronts at belt speeds 1 to 1.2, 1.7" in summary("ladder", data)


def test_failed_runs_are_crosses_and_are_listed_with_advice():
    data = single()
    data["result"][1, 2] = 6
    data["active_count"][1, 2] = np.nan
    data["energy"][1, 2] = np.nan
    (axes,) = named_panels(figure({"single": data}))
    (crosses,) = labelled(axes, "failed")
    assert crosses.get_marker() == "x"
    assert where(crosses) == [1.0]
    text = summary("single", data)
    assert "19 successful, 1 nonfinite" in text
    assert "failed        belt_speed 1, displacement 1.1: nonfinite" in text
    assert "NaN or infinite" in text


def test_the_figure_of_a_scene_of_cells_shows_every_run(pairs):
    data = pairs[["amplitude_velocity", "result", "steps"]]
    (axes,) = named_panels(figure({"pairs": data}))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("mu (–)", "amplitude of velocity (–)")
    assert legend(axes) == ["0.5", "1"]
    for k, line in enumerate(axes.get_lines()):
        expected = pairs["amplitude_velocity"].values[:, k]
        np.testing.assert_array_equal(np.sort(height(line)), np.sort(expected.ravel()))
    text = summary("pairs", data)
    assert "model         VanDerPol, n 2; mu swept; coupling 0.1" in text
    assert "6 successful" in text
