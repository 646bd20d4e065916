"""Maps show each run's value at its place, and curves of special points on the axes they share."""

from typing import Any

import numpy as np
import pytest
from drawn import bar, legend
from matplotlib.colors import to_rgba
from synthetic import results, special_curve

from jaxchain.plotting.branches import PARTS, plot_special_curves
from jaxchain.plotting.colours import GREY, RED
from jaxchain.plotting.maps import plot_map
from jaxchain.result import NAMES

SPEEDS, DAMPING = np.array([1.0, 1.2, 1.6]), np.array([0.1, 0.2])


def runs(counts=((0, 1), (2, 3), (3, 3))):
    return results({"belt_speed": SPEEDS, "damping_ratio": DAMPING}, np.array(counts), 3)


def meshes(axes) -> list[Any]:
    return [one for one in axes.collections if hasattr(one, "get_coordinates")]


def edges(axes):
    """Those of the columns and of the rows."""
    corners = meshes(axes)[0].get_coordinates()
    return corners[0, :, 0], corners[:, 0, 1]


def test_each_run_is_a_cell_at_its_place_whichever_way_round_the_axes_are():
    data = runs()
    upright, lying = plot_map(data, value="energy"), plot_map(data, x="damping_ratio")
    np.testing.assert_array_equal(meshes(upright)[0].get_array(), data.energy.values.T)
    np.testing.assert_array_equal(meshes(lying)[0].get_array(), data.energy.values)
    for own, other in zip(edges(upright), reversed(edges(lying)), strict=True):
        np.testing.assert_array_equal(own, other)
    np.testing.assert_allclose(edges(upright)[0], [0.9, 1.1, 1.4, 1.8], rtol=1e-14)
    np.testing.assert_allclose(edges(upright)[1], [0.05, 0.15, 0.25], rtol=1e-14)
    assert upright.get_xlabel() == lying.get_ylabel() == r"belt speed $\tilde v_d$ (–)"
    assert bar(upright).get_ylabel() == r"vibration energy $\tilde E$ (–)"


def test_whole_numbers_have_a_colour_each_and_all_others_a_range():
    data = runs()
    counts, energies = (plot_map(data, value=name) for name in ("active_count", "energy"))
    (mesh,) = meshes(counts)
    assert (mesh.norm.vmin, mesh.norm.vmax, mesh.cmap.N) == (-0.5, 3.5, 4)
    assert bar(counts).get_ylabel() == "vibrating oscillators"
    (mesh,) = meshes(energies)
    assert (mesh.norm.vmin, mesh.norm.vmax) == (0.0, pytest.approx(3 * 0.5 * 1.5**2))
    assert mesh.cmap.N == 256


def test_runs_without_a_value_are_marked_and_the_legend_says_how_many_and_why():
    data = runs([[-1, 1], [-1, 3], [0, 2]])
    data["result"][0, 0] = NAMES.index("max_steps_reached")
    data["result"][2, 1] = NAMES.index("pending")
    data["energy"][0, 1] = np.nan
    axes = plot_map(data)
    mesh, *marked = meshes(axes)
    missing = [[True, True, False], [True, False, True]]
    np.testing.assert_array_equal(np.ma.getmaskarray(mesh.get_array()), missing)
    cells = {tuple(one.cmap(0)): (~one.get_array().mask).tolist() for one in marked}
    no = [False, False, False]
    expected = {
        RED: [[True, True, False], no],
        GREY: [no, [False, False, True]],
        "0.85": [no, [True, False, False]],
    }
    assert cells == {to_rgba(k): where for k, where in expected.items()}
    failed = "2 failed:\n1 max_steps_reached\n1 nonfinite"
    assert legend(axes) == ["1 not run:\npending", failed, "1 without a value"]


def test_a_function_reduces_other_dimensions_and_no_failed_run_is_averaged_over():
    counts = np.stack([runs().active_count, [[0, 3], [2, -1], [0, 0]]], axis=-1)
    axes = {"belt_speed": SPEEDS, "damping_ratio": DAMPING, "realisation": [0, 1]}
    data = results(axes, counts, 3)
    with pytest.raises(ValueError, match=r"`realisation` of 2 .* `data.isel\(realisation=0\)`"):
        plot_map(data)

    def share(data):
        return (data["active_count"] > 0).mean("realisation").rename("share that vibrates")

    shown = plot_map(data, value=share)
    drawn = meshes(shown)[0].get_array()
    np.testing.assert_array_equal(drawn.filled(-1.0), [[0.0, 1.0, 0.5], [1.0, -1.0, 0.5]])
    assert legend(shown) == ["1 failed:\nnonfinite"]
    assert bar(shown).get_ylabel() == "share that vibrates"


@pytest.mark.parametrize("x", ["belt_speed", "damping_ratio"])
def test_curves_lie_on_the_axes_of_their_parameters(x):
    hopf, fold = (special_curve(kind) for kind in ("hopf", "fold"))
    drawn = plot_map(runs(), x=x, curves=[hopf, fold.to_dataset()])
    alone = plot_special_curves([hopf, fold])
    way = 1 if x == "belt_speed" else -1
    assert legend(drawn) == ["Hopf point", "generalised Hopf", "fold"]
    for own, other in zip(drawn.get_lines(), alone.get_lines(), strict=True):
        assert own.get_label() == other.get_label()
        assert (own.get_color(), own.get_marker()) == (other.get_color(), other.get_marker())
        np.testing.assert_array_equal(np.stack(own.get_data())[::way], np.stack(other.get_data()))
    line = np.stack(drawn.get_lines()[0].get_data())[::way, ::PARTS]
    np.testing.assert_allclose(line, (hopf.first, hopf.second))
    assert drawn.get_xlim() == tuple(edges(drawn)[0][[0, -1]])


def test_equal_ratios_over_decades_are_equal_cells_of_a_logarithmic_axis():
    width = np.array([1e-4, 1e-3, 1e-2])
    data = results({"belt_speed": SPEEDS, "width": width}, np.ones((3, 3)), 1)
    axes = plot_map(data)
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")
    np.testing.assert_allclose(edges(axes)[1], 10.0 ** np.arange(-4.5, -1.0), rtol=1e-12)
    equal = plot_map(data.assign_coords(width=[0.01, 0.5, 0.99]))
    assert equal.get_yscale() == "linear"
