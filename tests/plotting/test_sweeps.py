"""Pictures of sweeps show each run at its place, by colour, marker and panel."""

import itertools

import numpy as np
import pytest
from drawn import SCALES, across, height, heights, legend, legend_of, page_of
from matplotlib.figure import Figure
from synthetic import ladder, results

from jaxchain.plotting.style import COLUMN_WIDTH
from jaxchain.plotting.sweeps import plot_sweep
from jaxchain.result import NAMES


def test_a_sweep_of_cells_is_drawn_with_the_names_of_its_components(pairs):
    axes = plot_sweep(pairs, hue="x")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("mu (–)", "energy of displacement (–)")
    for k, line in enumerate(axes.get_lines()):
        np.testing.assert_array_equal(height(line), pairs.energy[:, k])
    axes = plot_sweep(pairs.isel(oscillator=1, x=0), "amplitude_velocity")
    assert axes.get_ylabel() == "amplitude of velocity (–)"
    np.testing.assert_array_equal(heights(axes)[0], pairs.amplitude_velocity[:, 0, 1])


def test_a_series_for_each_value_by_colour_and_marker():
    data = ladder()
    axes = plot_sweep(data, hue="excited")
    assert page_of(axes).get_figwidth() == COLUMN_WIDTH
    for k, drawn in enumerate(heights(axes)):
        np.testing.assert_array_equal(drawn, data.energy[:, k])
    looks = [(line.get_color(), line.get_marker()) for line in axes.get_lines()]
    assert len({colour for colour, _ in looks}) == len({str(marker) for _, marker in looks}) == 7
    assert legend(axes) == [str(k) for k in range(7)]
    data.energy.attrs["units"] = "x0^2"  # x0 is 0.05 m
    for k, drawn in enumerate(heights(plot_sweep(data, hue="excited", scales=SCALES))):
        np.testing.assert_allclose(drawn, 0.0025 * data.energy[:, k])


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
    assert panels[2, 1].get_title() == "excited = 2\n$\\xi$ = 0.05"
    np.testing.assert_array_equal(heights(panels[2, 1])[0], data.energy[:, 1, 2])


def test_on_axes_that_are_given_a_dimension_without_a_place_is_named():
    data = ladder()
    given = Figure().subplots()
    with pytest.raises(ValueError, match="dimension `excited` of 7 values"):
        plot_sweep(data, ax=given)
    assert not given.get_lines()
    assert plot_sweep(data.sel(excited=3), ax=given) is given
    three = Figure().subplots(1, 3)
    few = data.isel(excited=[1, 2, 3])
    assert plot_sweep(few, col="excited", ax=three).tolist() == three.tolist()


def test_a_legend_stands_within_the_page_whatever_lays_it_out():
    page = Figure(layout="constrained")
    left, right = page.subplots(1, 2)
    plot_sweep(ladder().isel(excited=[1, 2, 3]), hue="excited", ax=left)
    page.draw_without_rendering()
    own = legend_of(left).get_window_extent()
    assert own.x0 > left.get_window_extent().x1 - 1
    assert own.x1 < right.get_window_extent().x0


def test_what_has_not_run_yet_is_not_called_failed():
    data = results({"belt_speed": [1.0, 1.1, 1.2]}, np.array([1, 1, 1]), 1)
    data["result"][:2] = [NAMES.index("pending"), NAMES.index("nonfinite")]
    runs, *crosses = plot_sweep(data).get_lines()
    np.testing.assert_array_equal(height(runs), [np.nan, np.nan, 1.5])
    where = {line.get_label(): across(line).tolist() for line in crosses}
    assert where == {"not run": [1.0], "failed": [1.1]}
    # A number that spans decades has a logarithmic axis.
    decades = data.rename(belt_speed="width").assign_coords(width=[1e-4, 1e-3, 1e-2])
    assert plot_sweep(decades).get_xscale() == "log"


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
