"""Figures and what they mark: the Hopf speed, moving fronts, the unstable cycle, failed runs."""

import itertools
import json
from typing import Any

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from synthetic import cycle_branch, ladder, results, single

from jaxchain import Amplitude, sweep
from jaxchain.model.ready_made import VanDerPol
from jaxchain.model.units import Scales
from jaxchain.plotting import sweeps as plot
from jaxchain.plotting.branches import plot_branch
from jaxchain.plotting.diagram import basin_brackets, hopf_belt_speed, intervals, moving_fronts
from jaxchain.plotting.style import COLUMN_WIDTH, RED, SERIES, save_figure
from jaxchain.plotting.sweeps import figure, figure_3, plot_sweep
from jaxchain.result import NAMES
from jaxchain.scenes.report import summary


def labelled(axes, label):
    return [line for line in axes.get_lines() if line.get_label() == label]


def where(line):
    return np.asarray(line.get_xdata()).tolist()


def named_panels(page):
    return [axes for axes in page.axes if axes.get_xlabel()]


def test_figure_3_has_amplitude_on_the_left_and_energy_on_the_right():
    left, right = named_panels(figure_3(ladder(), single()))
    assert "amplitude" in left.get_ylabel()
    assert "energy" in right.get_ylabel()
    assert left.get_xlabel() == right.get_xlabel() == r"belt speed $\tilde v_d$ (–)"
    assert legend(left) == ["vibrating", "steady sliding", "unstable cycle"]
    assert legend(right) == ["moving fronts", "steady sliding", "unstable sliding"]
    assert figure_3(ladder(), single()).get_figwidth() == 7.0


def test_every_run_is_one_point_at_its_place():
    data = single()
    (left,) = named_panels(figure({"single": data}))
    (vibrating,), (resting,) = labelled(left, "vibrating"), labelled(left, "steady sliding")
    assert len(where(vibrating)) == int((data.active_count == 1).sum())
    assert len(where(resting)) == int((data.active_count == 0).sum())
    assert set(np.asarray(vibrating.get_ydata())) == {1.5}
    data = ladder()
    (right, _) = figure({"ladder": data}).axes
    (points,) = [c for c in right.collections if c.get_array() is not None]
    count = np.asarray(points.get_array())
    np.testing.assert_array_equal(count, data.active_count.values[data.energy > 0])
    np.testing.assert_allclose(np.asarray(points.get_offsets())[:, 1], 0.5 * 1.5**2 * count)


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


@pytest.mark.parametrize("attrs", [{"vary": "the function `mistune`"}, {"law": "Rational"}])
def test_rest_of_a_chain_that_is_not_known_is_not_drawn_as_stable(attrs):
    law = attrs.pop("law", "ExponentialDecay")
    data = results({"belt_speed": [1.0, 1.3]}, np.zeros(2), 2, friction_law=law)
    data = data.drop_vars("hopf_belt_speed").assign_attrs(attrs)
    axes = named_panels(figure({"two": data}))[0]
    assert legend(axes) == ["sliding, stability unknown"]
    assert to_hex(labelled(axes, legend(axes)[0])[0].get_markerfacecolor()) == "#ffffff"


def shaken():
    """One mass that has not come to rest at 1.3 ... 1.9, for its two smaller starts."""
    data = single()
    quiet = data.active_count == 0
    data["amplitude"] = data.amplitude.where(~quiet | (data.displacement > 1), 0.3)
    data["energy"] = 0.5 * (data.amplitude**2).sum("oscillator")
    return data


@pytest.mark.parametrize("left_out", ["energy", "amplitude"])
def test_only_what_does_not_move_slides_steadily(left_out):
    data = shaken().drop_vars(left_out)
    (axes,) = named_panels(figure({"single": data}))
    (resting,), (moving,) = labelled(axes, "steady sliding"), labelled(axes, plot.NOT_VIBRATING)
    (vibrating,) = labelled(axes, "vibrating")
    assert where(resting) == [1.9, 1.9]
    assert where(moving) == [1.3, 1.3, 1.6, 1.6, 1.9, 1.9]
    np.testing.assert_allclose(np.asarray(moving.get_ydata()), 0.3)
    three = (resting, moving, vibrating)
    assert len({str(line.get_marker()) for line in three}) == 3
    assert len({to_hex(line.get_color()) for line in three}) == 3
    text = summary("single", data)
    assert "sliding       at belt speeds 1.9\n" in text
    assert "weak          at belt speeds 1.3 to 1.9: moves, but no mass above v_d / 2" in text


def test_a_slow_start_below_the_hopf_speed_makes_no_unstable_cycle():
    data = single()
    data["active_count"][1, 0] = 0  # belt speed 1.0: not gone far enough yet
    assert basin_brackets(data) == [(1.3, 0.9, 1.1), (1.6, 0.9, 1.1)]


def test_the_hopf_speed_is_read_off_the_data():
    for axes in named_panels(figure_3(ladder(), single())):
        assert 0.5 * np.log(10) in [where(line)[0] for line in axes.get_lines()]
    for axes in named_panels(figure_3(ladder(), single(), hopf=1.25)):
        assert 1.25 in [where(line)[0] for line in axes.get_lines()]


@pytest.mark.parametrize("values", [None, np.nan, [1.1, 1.2], [np.nan, 1.2]])
def test_no_hopf_speed_is_drawn_that_is_not_that_of_all_runs(values):
    data = single().drop_vars("hopf_belt_speed")
    if values is not None:
        data["hopf_belt_speed"] = (("coupling",) * np.ndim(values), values)
    assert hopf_belt_speed(data) is None
    assert all(
        len(where(line)) > 1 for line in named_panels(figure({"single": data}))[0].get_lines()
    )


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
    (axes,) = named_panels(figure({"single": single(), "single_cycles": branch()}))
    (unstable,), (fold,) = labelled(axes, "unstable cycle"), labelled(axes, "fold")
    assert where(unstable) == [1.15, 1.5, 1.8]
    assert (where(fold), np.asarray(fold.get_ydata()).tolist()) == ([1.8], [1.7])
    solid = [where(line) for line in axes.get_lines() if line.get_linestyle() == "-"]
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
    axes = named_panels(figure({"ladder": data}))[0]
    dashed = [line for line in axes.get_lines() if to_hex(line.get_color()) == RED.lower()]
    assert [where(line)[0] for line in dashed] == pytest.approx([1.0, 1.25, 1.65, 1.75])


def test_a_failed_run_is_neither_a_front_nor_the_death_of_all():
    data = ladder()
    data["result"][5, :] = 6
    data["active_count"][5, :] = np.nan
    data["result"][7, 6] = 6  # the fully excited run at 1.7
    data["active_count"][7, 6] = np.nan
    moving = moving_fronts(data)
    assert moving is not None
    assert data.belt_speed.values[moving.values].tolist() == [1.0, 1.1, 1.2, 1.7]


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


def test_a_summary_says_where_the_chain_vibrates():
    text = summary("ladder", ladder())
    assert "70 (10 belt_speed x 7 excited)" in text
    assert "Hopf speed    1.1513" in text
    assert "vibrating     at belt speeds 1 to 1.7" in text
    assert "sliding       at belt speeds 1.2 to 1.9" in text
    assert "moving fronts at belt speeds 1 to 1.2, 1.7" in text
    assert max(map(len, text.splitlines())) < 100


@pytest.mark.parametrize("kept", [["amplitude"], ["energy"], ["active_count"]])
def test_a_figure_is_drawn_from_whatever_was_kept(kept):
    for data in (ladder(), single()):
        figure({"some": data[[*kept, "result", "steps"]]})
        assert "outcome" in summary("some", data[[*kept, "result", "steps"]])


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
    assert [axes.get_title(loc="left") for axes in named_panels(page)] == ["(a)", "(b)", "(c)"]


def test_drawing_leaves_matplotlib_as_it_was():
    before = dict(matplotlib.rcParams)
    figure_3(ladder(), single())
    assert dict(matplotlib.rcParams) == before


@pytest.fixture(scope="module")
def pairs():
    """Two van der Pol's cells over mu and the start, their velocities observed, too."""
    watch = [Amplitude(window=7.0, component=k) for k in (1, 0)]
    over = {"mu": [0.5, 1.0, 2.0], "x": [0.5, 1.0]}

    def start(cells, x):
        return jnp.stack([x, 2 * x]), jnp.zeros(2)

    return sweep(VanDerPol(mu=1.0, coupling=0.1), start, 15.0, over=over, observe=watch)


def test_a_sweep_of_cells_is_drawn_with_the_names_of_its_components(pairs):
    axes = plot_sweep(pairs, hue="x")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("mu (–)", "energy of displacement (–)")
    for k, line in enumerate(axes.get_lines()):
        np.testing.assert_array_equal(height(line), pairs.energy[:, k])
    axes = plot_sweep(pairs.isel(oscillator=1, x=0), "amplitude_velocity")
    assert axes.get_ylabel() == "amplitude of velocity (–)"
    np.testing.assert_array_equal(heights(axes)[0], pairs.amplitude_velocity[:, 0, 1])
    only = pairs[["amplitude_velocity", "energy_velocity", "result"]]
    np.testing.assert_array_equal(
        heights(plot_sweep(only, hue="x"))[0], only.energy_velocity[:, 0]
    )


@pytest.mark.parametrize("kept", ["energy_velocity", "amplitude_velocity"])
def test_the_figure_of_a_scene_of_cells_shows_every_run(pairs, kept):
    data = pairs[[kept, "result", "steps"]]
    (axes,) = named_panels(figure({"pairs": data}))
    word = kept.partition("_")[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("mu (–)", f"{word} of velocity (–)")
    assert legend(axes) == ["0.5", "1"]
    for k, line in enumerate(axes.get_lines()):
        expected = pairs[kept].values[:, k]
        np.testing.assert_array_equal(np.sort(height(line)), np.sort(expected.ravel()))
    text = summary("pairs", data)
    assert "model         VanDerPol, n 2; mu swept; coupling 0.1" in text
    assert "6 successful" in text


SCALES = Scales.from_dimensional(
    mass=2.0, damping=2.0, stiffness=200.0, coupling_stiffness=2.0, normal_load=10.0
)


def across(line):
    return np.asarray(line.get_xdata())


def height(line):
    return np.asarray(line.get_ydata())


def heights(axes):
    return [height(line) for line in axes.get_lines()]


def page_of(axes) -> Any:
    return axes.get_figure(root=True)


def legend_of(axes) -> Any:
    return axes.get_legend()


def legend(axes):
    return [text.get_text() for text in legend_of(axes).get_texts()]


def test_a_series_for_each_value_by_colour_and_marker():
    data = ladder()
    axes = plot_sweep(data, hue="excited")
    assert isinstance(axes, Axes)
    assert page_of(axes).get_figwidth() == COLUMN_WIDTH
    for k, height in enumerate(heights(axes)):
        np.testing.assert_array_equal(height, data.energy[:, k])
    looks = [(line.get_color(), line.get_marker()) for line in axes.get_lines()]
    assert len({colour for colour, _ in looks}) == len({str(marker) for _, marker in looks}) == 7
    assert legend(axes) == [str(k) for k in range(7)]
    title = legend_of(axes).get_title().get_text()
    assert " ".join(title.split()) == "oscillators excited at the start"


def test_a_branch_over_a_sweep_leaves_the_legend_its_title():
    data = single()
    axes = plot_sweep(data, hue="displacement")
    plot_branch(cycle_branch(1), ax=axes)
    assert legend(axes)[-4:] == ["stable", "unstable", "fold", "Hopf point"]
    assert legend_of(axes).get_title().get_text() == "displacement\n$\\tilde x_n$ (–)"


def test_many_series_have_a_colour_bar_and_as_many_colours():
    data = ladder()
    axes = plot_sweep(data, "active_share", "excited", hue="belt_speed")
    assert data.sizes["belt_speed"] > len(SERIES)
    shades = {line.get_color() for line in axes.get_lines()}
    assert len(shades) == data.sizes["belt_speed"]
    assert axes.get_legend() is None
    (bar,) = [other for other in axes.figure.axes if other is not axes]
    assert bar.get_ylabel() == r"belt speed $\tilde v_d$ (–)"
    for row, height in zip(data.active_count.values, heights(axes), strict=True):
        np.testing.assert_allclose(height, row / 6, rtol=1e-15)


def test_every_value_of_every_dimension_is_somewhere():
    data = results(
        {"belt_speed": [1.0, 1.2], "damping_ratio": [0.04, 0.05, 0.06], "excited": [0, 1, 2, 3]},
        np.tile([0, 1, 2, 3], (2, 3, 1)), 3,
    )  # fmt: skip
    data["energy"] = data.energy + np.arange(24.0).reshape(2, 3, 4)  # all different
    for order in itertools.permutations(data.energy.dims):
        names = dict(zip(("x", "hue", "col"), order, strict=True))
        panels = plot_sweep(data, "energy", **names)
        assert panels.shape == (data.sizes[names["col"]],)
        drawn = np.concatenate([np.concatenate(heights(axes)) for axes in panels.ravel()])
        np.testing.assert_array_equal(np.sort(drawn), np.sort(data.energy.values.ravel()))
    panels = plot_sweep(data)
    assert panels.shape == (4, 3)  # rows, columns
    assert panels[2, 1].get_title() == "excited = 2\n$\\xi$ = 0.05"
    np.testing.assert_array_equal(heights(panels[2, 1])[0], data.energy[:, 1, 2])


def test_on_axes_that_are_given_a_dimension_without_a_place_is_named():
    data = ladder()
    given = Figure().subplots()
    with pytest.raises(ValueError, match="dimension `excited` of 7 values"):
        plot_sweep(data, ax=given)
    with pytest.raises(ValueError, match="dimension `oscillator` of 6 values"):
        plot_sweep(data, "amplitude", hue="excited", ax=given)
    assert not given.get_lines()
    assert plot_sweep(data.sel(excited=3), ax=given) is given
    three = Figure().subplots(1, 3)
    few = data.isel(excited=[1, 2, 3])
    assert plot_sweep(few, col="excited", ax=three).tolist() == three.tolist()


@pytest.mark.parametrize("layout", [None, "constrained"])
def test_a_legend_stands_within_the_page_whatever_lays_it_out(layout):
    data = ladder().isel(excited=[1, 2, 3])
    page = Figure(layout=layout)
    left, right = page.subplots(1, 2)
    plot_sweep(data, hue="excited", ax=left)
    page.draw_without_rendering()
    beside = legend_of(left).get_window_extent().x0 > left.get_window_extent().x1 - 1
    assert beside == (layout is not None)
    assert legend_of(left).get_window_extent().x1 < right.get_window_extent().x0
    page = Figure(layout=layout)
    panels = page.subplots(1, 2)
    runs = ladder().isel(excited=[1, 2, 3], belt_speed=[0, 3], oscillator=[0, 1])
    plot_sweep(runs, "amplitude", "excited", hue="belt_speed", col="oscillator", ax=panels)
    page.draw_without_rendering()
    (own,) = page.legends or [legend_of(panels[0])]
    assert own.get_window_extent().x1 <= page.bbox.x1 + 1


def test_what_has_not_run_yet_is_not_called_failed():
    data = results({"belt_speed": [1.0, 1.1, 1.2]}, np.array([1, 1, 1]), 1)
    data["result"][:2] = [NAMES.index("pending"), NAMES.index("nonfinite")]
    runs, *crosses = plot_sweep(data).get_lines()
    np.testing.assert_array_equal(height(runs), [np.nan, np.nan, 1.5])
    where = {line.get_label(): across(line).tolist() for line in crosses}
    assert where == {"not run": [1.0], "failed": [1.1]}


def test_what_is_swept_together_is_drawn_over_one_of_them():
    data = results({"sample": [0, 1, 2]}, [0, 1, 2], 2).drop_vars("sample")
    data = data.assign_coords(belt_speed=("sample", [1.3, 1.1, 1.2]))
    (line,) = plot_sweep(data, x="belt_speed").get_lines()
    np.testing.assert_array_equal(across(line), [1.3, 1.1, 1.2])
    np.testing.assert_array_equal(height(line), data.energy)
    with pytest.raises(ValueError, match="`sample` is drawn already"):
        plot_sweep(data, x="belt_speed", hue="sample")


def test_one_oscillator_shows_its_amplitude_in_si_if_asked():
    data = single()
    data["belt_speed"].attrs["units"] = "x0 omega_n"
    data["amplitude"].attrs["units"] = "x0"
    axes = plot_sweep(data.isel(displacement=-1), scales=SCALES)
    assert axes.get_xlabel() == "belt speed $v_d$ (m/s)"
    assert axes.get_ylabel() == "vibration amplitude $A_n$ (m)"
    (line,) = axes.get_lines()
    np.testing.assert_allclose(across(line), 0.5 * data.belt_speed, rtol=1e-14)
    known = data.amplitude.isel(displacement=-1, oscillator=0)
    np.testing.assert_allclose(height(line), 0.05 * known, rtol=1e-14)


def test_segments_of_the_same_run_are_joined():
    data = results({"belt_speed": [1.0], "segment": [1, 2, 3]}, [[1, 1, 1]], 1)
    (line,) = plot_sweep(data, x="segment").get_lines()
    assert line.get_linestyle() == "-"


def test_a_variable_tells_all_runs_of_one_panel_apart():
    data = ladder()
    axes = plot_sweep(data, hue="active_count")
    assert isinstance(axes, Axes)
    counts = np.unique(data.active_count)
    assert legend(axes) == [str(int(count)) for count in counts]
    assert legend_of(axes).get_title().get_text() == "vibrating\noscillators"
    speeds = data.belt_speed.broadcast_like(data.energy)
    for count, line in zip(counts, axes.get_lines(), strict=True):
        here = data.active_count.transpose(*data.energy.dims).values == count
        drawn = sorted(zip(across(line), height(line), strict=True))
        assert drawn == sorted(zip(speeds.values[here], data.energy.values[here], strict=True))


def test_a_variable_has_the_same_colours_in_all_panels_and_a_bar_for_many_values():
    data = ladder()
    data["energy"] = data.energy + np.linspace(0.0, 1.0, 70).reshape(10, 7)
    for hue in ("active_count", "energy"):
        panels = plot_sweep(data, "energy", "excited", hue=hue, col="belt_speed")
        drawn = [
            (point, line.get_color())
            for axes in panels
            for line in axes.get_lines()
            for point in height(line)
        ]
        assert sorted(point for point, _ in drawn) == sorted(data.energy.values.ravel())
        of = {}
        for point, colour in drawn:
            value = data[hue].values[data.energy.values == point][0]
            assert of.setdefault(value, colour) == colour
        # A bar has 256 shades.
        assert len(set(of.values())) == (7 if hue == "active_count" else pytest.approx(50, abs=10))
    bar = page_of(panels[0]).axes[-1]
    assert bar.get_ylabel() == r"vibration energy $\tilde E$ (–)"


def test_a_run_without_a_value_of_the_hue_is_drawn_grey_and_a_failed_one_as_failed():
    data = ladder()
    data["shade"] = data.active_count.astype(float)
    data["shade"][0, 0] = np.nan
    data["result"][1, 1] = NAMES.index("nonfinite")
    axes = plot_sweep(data, hue="shade")
    *_, unknown, failed = axes.get_lines()
    assert legend(axes)[-2:] == ["unknown", "failed"]
    assert height(unknown).tolist() == [float(data.energy[0, 0])]
    assert across(failed).tolist() == [float(data.belt_speed[1])]
    assert sum(len(height(line)) for line in axes.get_lines()) - 1 == data.energy.size
    with pytest.raises(ValueError, match="`hue` = 'amplitude' has the dimension `oscillator`"):
        plot_sweep(data, hue="amplitude")


def test_words_are_told_apart_by_name():
    names = [f"state {k}" for k in range(9)]
    data = results({"belt_speed": [1.0, 1.2], "state": names}, np.zeros((2, 9), int), 1)
    axes = plot_sweep(data, hue="state")
    assert legend(axes) == names
    assert len({line.get_color() for line in axes.get_lines()}) == 9
    assert plot_sweep(data.isel(belt_speed=0), x="state").get_xscale() == "linear"


def test_times_are_joined_within_one_run_only():
    data = ladder().rename(belt_speed="segment")
    for hue, style in (("excited", "-"), ("active_count", "None")):
        assert {line.get_linestyle() for line in plot_sweep(data, hue=hue).get_lines()} == {style}


def test_a_number_that_spans_decades_has_a_logarithmic_axis():
    data = results({"width": [1e-4, 1e-3, 1e-2]}, [1, 1, 1], 1)
    assert plot_sweep(data).get_xscale() == "log"


def test_without_amplitudes_no_run_is_called_steady_sliding():
    data = shaken()[["active_count", "result", "steps"]]
    (axes,) = named_panels(figure({"single": data}))
    assert not labelled(axes, "steady sliding")
    assert len(where(*labelled(axes, plot.NONE_VIBRATES))) == 8
    assert "sliding" not in summary("single", data)
    assert "weak          at belt speeds 1.3 to 1.9: no mass above" in summary("single", data)


def test_more_panels_than_are_legible_are_refused():
    data = single().rename(displacement="pull")
    with pytest.raises(ValueError, match=r"at most 24 panels are .* `plot_map`"):
        plot_sweep(data.isel(pull=np.zeros(30, int)))
    axes = {name: [0.1, 0.2] for name in ("belt_speed", "coupling", "width", "v_ref", "mu_static")}
    with pytest.raises(ValueError, match=r"dimension `v_ref` of 2 values and `mu_static` of 2"):
        plot_sweep(results(axes, np.zeros((2,) * 5, int), 2))
