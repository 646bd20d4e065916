"""Figures and what they mark: the Hopf speed, moving fronts, the unstable cycle, failed runs."""

import ast
import inspect
import json

import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex
from synthetic import ladder, results, single

from jaxchain.plotting import sweeps as plot
from jaxchain.plotting.diagram import basin_brackets, hopf_belt_speed, intervals, moving_fronts
from jaxchain.plotting.style import RED, save_figure
from jaxchain.plotting.sweeps import figure, figure_3
from jaxchain.scenes.report import summary


def lines(axes, label):
    return [line for line in axes.get_lines() if line.get_label() == label]


def across(line):
    return np.asarray(line.get_xdata()).tolist()


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def panels(page):
    return [axes for axes in page.axes if axes.get_xlabel()]


def test_figure_3_has_amplitude_on_the_left_and_energy_on_the_right():
    left, right = panels(figure_3(ladder(), single()))
    assert "amplitude" in left.get_ylabel()
    assert "energy" in right.get_ylabel()
    assert left.get_xlabel() == right.get_xlabel() == r"belt speed $\tilde v_d$ (–)"
    assert legend(left) == ["vibrating", "at rest", "unstable cycle"]
    assert legend(right) == ["moving fronts", "at rest", "at rest, unstable"]
    assert figure_3(ladder(), single()).get_figwidth() == 7.0


def test_every_run_is_one_point_at_its_place():
    data = single()
    (left,) = panels(figure({"single": data}))
    (vibrating,), (resting,) = lines(left, "vibrating"), lines(left, "at rest")
    assert len(across(vibrating)) == int((data.active_count == 1).sum())
    assert len(across(resting)) == int((data.active_count == 0).sum())
    assert set(np.asarray(vibrating.get_ydata())) == {1.5}
    data = ladder()
    (right, _) = figure({"ladder": data}).axes
    (points,) = [c for c in right.collections if c.get_array() is not None]
    count = np.asarray(points.get_array())
    np.testing.assert_array_equal(count, data.active_count.values[data.energy > 0])
    np.testing.assert_allclose(np.asarray(points.get_offsets())[:, 1], 0.5 * 1.5**2 * count)


def test_states_differ_by_marker_and_by_colour():
    (axes,) = panels(figure({"single": single()}))
    (vibrating,), (resting,) = lines(axes, "vibrating"), lines(axes, "at rest")
    assert vibrating.get_marker() != resting.get_marker()
    assert to_hex(vibrating.get_color()) != to_hex(resting.get_color())


def test_rest_below_the_hopf_speed_is_drawn_hollow():
    axes = panels(figure({"ladder": ladder()}))[0]
    (unstable,) = lines(axes, "at rest, unstable")
    assert across(unstable) == [1.0, 1.1]
    assert to_hex(unstable.get_markerfacecolor()) == "#ffffff"


def test_rest_is_drawn_as_stable_only_where_the_numbers_of_the_run_say_so():
    bare = ladder().drop_vars("hopf_belt_speed")  # as `sweep` returns it
    (unstable,) = lines(panels(figure({"ladder": bare}))[0], "at rest, unstable")
    assert across(unstable) == [1.0, 1.1]
    assert "at rest       at belt speeds 1.2 to 1.9\n" in summary("ladder", bare)
    damped = results(
        {"damping_ratio": [0.05, 0.1], "belt_speed": [0.5, 1.0, 1.3]},
        np.zeros((2, 3)),
        2,
        damping_ratio="swept",
    ).drop_vars("hopf_belt_speed")  # v_H is ln(10) / 2, and ln(5) / 2
    axes = panels(figure({"damped": damped}))[0]
    assert across(*lines(axes, "at rest, unstable")) == [0.5, 1.0, 0.5]
    assert across(*lines(axes, "at rest")) == [1.3, 1.0, 1.3]


@pytest.mark.parametrize("attrs", [{"vary": "the function `mistune`"}, {"law": "Rational"}])
def test_rest_of_a_chain_that_is_not_known_is_not_drawn_as_stable(attrs):
    law = attrs.pop("law", "ExponentialDecay")
    data = results({"belt_speed": [1.0, 1.3]}, np.zeros(2), 2, friction_law=law)
    data = data.drop_vars("hopf_belt_speed").assign_attrs(attrs)
    axes = panels(figure({"two": data}))[0]
    assert legend(axes) == ["at rest, stability unknown"]
    assert to_hex(lines(axes, legend(axes)[0])[0].get_markerfacecolor()) == "#ffffff"


def shaken():
    """One mass that has not come to rest at 1.3 ... 1.9, for its two smaller starts."""
    data = single()
    quiet = data.active_count == 0
    data["amplitude"] = data.amplitude.where(~quiet | (data.displacement > 1), 0.3)
    data["energy"] = 0.5 * (data.amplitude**2).sum("oscillator")
    return data


@pytest.mark.parametrize("left_out", ["energy", "amplitude"])
def test_only_what_does_not_move_is_at_rest(left_out):
    data = shaken().drop_vars(left_out)
    (axes,) = panels(figure({"single": data}))
    (resting,), (moving,) = lines(axes, "at rest"), lines(axes, plot.NOT_VIBRATING)
    (vibrating,) = lines(axes, "vibrating")
    assert across(resting) == [1.9, 1.9]
    assert across(moving) == [1.3, 1.3, 1.6, 1.6, 1.9, 1.9]
    np.testing.assert_allclose(np.asarray(moving.get_ydata()), 0.3)
    three = (resting, moving, vibrating)
    assert len({str(line.get_marker()) for line in three}) == 3
    assert len({to_hex(line.get_color()) for line in three}) == 3
    text = summary("single", data)
    assert "at rest       at belt speeds 1.9\n" in text
    assert "weak          at belt speeds 1.3 to 1.9: moves, but no mass above v_d / 2" in text


def test_without_amplitudes_nobody_is_called_at_rest():
    data = shaken()[["active_count", "result", "steps"]]
    (axes,) = panels(figure({"single": data}))
    assert not lines(axes, "at rest")
    assert len(across(*lines(axes, plot.NONE_VIBRATES))) == 8
    assert "at rest" not in summary("single", data)
    assert "weak          at belt speeds 1.3 to 1.9: no mass above" in summary("single", data)


def test_a_slow_start_below_the_hopf_speed_makes_no_unstable_cycle():
    data = single()
    data["active_count"][1, 0] = 0  # belt speed 1.0: not gone far enough yet
    assert basin_brackets(data) == [(1.3, 0.9, 1.1), (1.6, 0.9, 1.1)]


def test_the_hopf_speed_is_read_off_the_data():
    for axes in panels(figure_3(ladder(), single())):
        assert 0.5 * np.log(10) in [across(line)[0] for line in axes.get_lines()]
    for axes in panels(figure_3(ladder(), single(), hopf=1.25)):
        assert 1.25 in [across(line)[0] for line in axes.get_lines()]


@pytest.mark.parametrize("values", [None, np.nan, [1.1, 1.2], [np.nan, 1.2]])
def test_no_hopf_speed_is_drawn_that_is_not_that_of_all_runs(values):
    data = single().drop_vars("hopf_belt_speed")
    if values is not None:
        data["hopf_belt_speed"] = (("coupling",) * np.ndim(values), values)
    assert hopf_belt_speed(data) is None
    assert all(len(across(line)) > 1 for line in panels(figure({"single": data}))[0].get_lines())


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


def test_saved_cycles_are_drawn_through_their_fold_instead_of_brackets():
    (axes,) = panels(figure({"single": single(), "single_cycles": branch()}))
    (unstable,), (fold,) = lines(axes, "unstable cycle"), lines(axes, "fold")
    assert across(unstable) == [1.15, 1.5, 1.8]
    assert (across(fold), np.asarray(fold.get_ydata()).tolist()) == ([1.8], [1.7])
    solid = [across(line) for line in axes.get_lines() if line.get_linestyle() == "-"]
    assert [1.8, 1.4, 0.5] in solid


def test_fronts_move_where_the_active_count_changes():
    data = ladder()
    moving = moving_fronts(data)
    assert moving is not None
    assert data.belt_speed.values[moving.values].tolist() == [1.0, 1.1, 1.2, 1.7]
    assert intervals(data.belt_speed.values, moving.values) == [
        (1.0, pytest.approx(1.25)),
        (pytest.approx(1.65), pytest.approx(1.75)),
    ]
    axes = panels(figure({"ladder": data}))[0]
    dashed = [line for line in axes.get_lines() if to_hex(line.get_color()) == RED.lower()]
    assert [across(line)[0] for line in dashed] == pytest.approx([1.0, 1.25, 1.65, 1.75])


def test_a_failed_run_is_neither_a_front_nor_the_death_of_all():
    data = ladder()
    data["result"][5, :] = 6
    data["active_count"][5, :] = np.nan
    data["result"][7, 6] = 6  # the fully excited run at 1.7
    data["active_count"][7, 6] = np.nan
    moving = moving_fronts(data)
    assert moving is not None
    assert data.belt_speed.values[moving.values].tolist() == [1.0, 1.1, 1.2, 1.7]


def test_no_fronts_are_looked_for_without_the_number_of_excited_masses():
    assert moving_fronts(single()) is None


def test_intervals_reach_half_way_to_the_next_value_and_stop_at_the_ends():
    positions = np.array([3.0, 1.0, 2.0])  # in any order
    assert intervals(positions, np.array([True, False, False])) == [(2.5, 3.0)]
    assert intervals(positions, np.array([True, True, True])) == [(1.0, 3.0)]
    assert intervals(positions, np.array([False, False, False])) == []


def test_the_unstable_cycle_lies_between_starts_that_end_differently():
    assert basin_brackets(single()) == [(1.3, 0.9, 1.1), (1.6, 0.9, 1.1)]
    assert basin_brackets(ladder()) == []


def test_failed_runs_are_crosses_and_are_listed_with_advice():
    data = single()
    data["result"][1, 2] = 6
    data["active_count"][1, 2] = np.nan
    data["energy"][1, 2] = np.nan
    (axes,) = panels(figure({"single": data}))
    (crosses,) = lines(axes, "failed")
    assert crosses.get_marker() == "x"
    assert across(crosses) == [1.0]
    text = summary("single", data)
    assert "19 successful, 1 nonfinite" in text
    assert "failed        belt_speed 1, displacement 1.1: nonfinite" in text
    assert "NaN or infinite" in text


def test_a_summary_says_where_the_chain_vibrates():
    text = summary("ladder", ladder())
    assert "70 (10 belt_speed x 7 excited)" in text
    assert "Hopf speed    1.1513" in text
    assert "vibrating     at belt speeds 1 to 1.7" in text
    assert "at rest       at belt speeds 1.2 to 1.9" in text
    assert "moving fronts at belt speeds 1 to 1.2, 1.7" in text
    assert max(map(len, text.splitlines())) < 100


def test_a_sweep_of_anything_else_is_drawn_over_its_first_number():
    width = np.array([1e-4, 1e-3, 1e-2])
    data = results({"width": width, "excited": np.arange(3)}, [[0, 1, 2]] * 3, 4, belt_speed=1.5)
    (axes,) = panels(figure({"widths": data}))
    assert "width" in axes.get_xlabel()
    assert axes.get_xscale() == "log"
    assert "Hopf" not in summary("widths", data)


@pytest.mark.parametrize("kept", [["amplitude"], ["energy"], ["active_count"]])
def test_a_figure_is_drawn_from_whatever_was_kept(kept):
    for data in (ladder(), single()):
        figure({"some": data[[*kept, "result", "steps"]]})
        assert "outcome" in summary("some", data[[*kept, "result", "steps"]])


def test_a_sweep_in_which_everything_failed_still_gives_a_figure():
    data = results({"belt_speed": np.array([1.0, 1.5])}, [-1, -1], 3)
    assert len(across(lines(panels(figure({"bad": data}))[0], "failed")[0])) == 2


def test_a_long_chain_and_a_large_sweep_are_drawn_too(tmp_path):
    speeds = np.linspace(1, 2, 20_000)
    count = np.arange(20_000)
    data = results({"belt_speed": speeds}, count % 2, 2)
    data.attrs["parameters"] = json.dumps(json.loads(data.attrs["parameters"]) | {"n": 20_000})
    data["active_count"] = (("belt_speed",), count)
    save_figure(figure({"long": data}), tmp_path / "long")
    assert (tmp_path / "long.pdf").stat().st_size < 1e6


def test_more_than_two_experiments_fill_rows():
    page = figure({"a": ladder(), "b": single(), "c": single()})
    assert [axes.get_title(loc="left") for axes in panels(page)] == ["(a)", "(b)", "(c)"]


def test_figures_are_saved_as_png_and_pdf(tmp_path):
    files = save_figure(figure_3(ladder(), single()), tmp_path / "name.with.dots")
    assert [file.name for file in files] == ["name.with.dots.png", "name.with.dots.pdf"]
    assert files[0].read_bytes().startswith(b"\x89PNG")
    assert files[1].read_bytes().startswith(b"%PDF")


def test_drawing_leaves_matplotlib_as_it_was():
    before = dict(matplotlib.rcParams)
    figure_3(ladder(), single())
    assert dict(matplotlib.rcParams) == before
    tree = ast.parse(inspect.getsource(plot))
    assert "pyplot" not in {
        alias.name for node in ast.walk(tree) for alias in getattr(node, "names", [])
    }
