"""The study `boundaries`: its table, its files, its picture, and that its numbers fit together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from synthetic import stored

from jaxchain.boundaries import find_fold
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.studies.boundaries import curves as boundaries_curves
from jaxchain.studies.boundaries import study as boundaries_study
from jaxchain.studies.boundaries.figure import draw
from jaxchain.studies.boundaries.report import summary
from jaxchain.studies.boundaries.study import run

SMALL = [
    "damping_ratio={start=0.05,stop=0.3,count=2}",
    "mu_static={start=0.8,stop=1.0,count=2}",
    "width={start=1e-3,stop=0.4,count=3,spacing='log'}",
    "coupling={start=5e-3,stop=0.01,count=2,masses=3}",
    "cycles={width=[0.01],lowest=0.5}",
]


def made_up():
    """Datasets of the shape that the study has, with a fold that ends."""
    datasets = {}
    for name, end in (("damping_ratio", 0.4), ("mu_static", 2.0), ("coupling", 0.1), ("width", 1)):
        values = np.linspace(0.05, 0.5, 8) * end
        hopf = np.linspace(1.0, 0.2, 8)
        fold = hopf * np.linspace(1.5, 1.1, 8)
        fold[-1] = np.nan
        data = xr.Dataset(
            {
                "hopf": (name, hopf), "hopf_nonsmooth": (name, hopf), "fold": (name, fold),
                "fold_nonsmooth": (name, 1.6 * hopf),
            },
            coords={name: values},
            attrs={"meeting_value": 0.48 * end, "meeting_belt_speed": 0.25},
        )  # fmt: skip
        datasets[name] = data
    datasets["coupling"].attrs |= {"masses": 5, "meeting_value": np.nan}
    datasets["coupling"].attrs["meeting_belt_speed"] = np.nan
    speed = np.array([[1.0, np.nan, 1.5, 1.8, 1.2], [1.0, 1.2, 1.6, 1.9, np.nan]])
    amplitude = np.where(np.isnan(speed), np.nan, [0.0, 0.5, 1.2, 1.7, 1.2])
    datasets["cycles"] = xr.Dataset(
        {"belt_speed": (("width", "point"), speed), "amplitude": (("width", "point"), amplitude)},
        coords={"width": [0.01, 0.0], "stable": ("point", np.arange(5) > 3)},
        attrs={"fold": 3, "hopf_nonsmooth": 1.0},
    )
    return datasets


def test_the_picture_shows_curves_their_meeting_and_the_cycles():
    page = draw(made_up())
    panels = page.axes
    assert len(panels) == 6
    for axes, name in zip(
        panels[:4], ("damping_ratio", "mu_static", "coupling", "width"), strict=True
    ):
        data = made_up()[name]
        lines = {line.get_label(): line for line in axes.get_lines()}
        np.testing.assert_array_equal(lines[r"Hopf $\tilde v_H$"].get_xdata(), data["hopf"])
        x, y = map(np.asarray, lines["fold, smoothed"].get_data())
        has_end = name != "coupling"
        assert ("they meet (GH)" in lines) == has_end
        # The fold's curve ends where it meets the other, not at the last value with a fold.
        assert len(x) == 7 + has_end
        if has_end:
            assert (x[-1], y[-1]) == (0.25, data.attrs["meeting_value"])
    dashed = [line for line in panels[4].get_lines() if line.get_label() == "dry friction"]
    np.testing.assert_array_equal(dashed[0].get_xdata(), [1.9])  # stable: from the fold on


def test_the_summary_names_folds_meetings_and_the_price_of_the_width():
    said = "\n".join(summary(*item) for item in made_up().items())
    assert "damping_ratio: folds at 7 of 8 values" in said
    assert "coupling, ring of 5" in said
    assert "the fold ends on the Hopf curve at 0.192" in said
    assert said.count("the fold ends") == 3
    first, dry = said.split("damping_ratio")[2].splitlines()[1:3], said.splitlines()[-1]
    assert first[0].split() == ["0.02", *["1.000000"] * 2, "1.500000", "1.600000", "-1.0e-01"]
    assert dry.split() == ["0", "4", "1.900000", "1.7000"]


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("base.width=-1.0", "base.width"),
        ("base.mu_dynamic=1.5", "mu_static"),
        ("mu_static.start=0.3", "mu_static"),
        ("width.stop=1e-5", "stop"),
        ("width.count=1", "width.count"),
        ("coupling.masses=2", "coupling.masses"),
        ("cycles.width=[]", "cycles.width"),
        ("damping_ratio.spacing='odd'", "damping_ratio.spacing"),
        ("colour=1", "colour"),
    ],
)
def test_a_bad_table_is_refused_with_its_key(override, key):
    with pytest.raises(SceneError, match=key):
        load_scene("boundaries", [override])


@pytest.fixture(scope="module")
def study():
    return load_scene("boundaries", SMALL).scene


@pytest.mark.exhaustive
def test_a_small_study(study, tmp_path, monkeypatch):
    """With a made-up ring and made-up cycles, which have tests of their own."""
    monkeypatch.setattr(boundaries_study, "ring_curve", lambda study: made_up()["coupling"])
    monkeypatch.setattr(boundaries_study, "cycles", lambda study, folds: made_up()["cycles"])
    said = []
    data = run(study, tmp_path, name="small", report=said.append)
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {"small.zarr", "small.nc", "small.png", "small.pdf", "report.html"}
    assert list(data) == ["damping_ratio", "mu_static", "width", "coupling", "cycles"]
    assert stored(tmp_path / "small")["width"].identical(data["width"])
    for name in ("damping_ratio", "mu_static"):
        own = data[name]
        assert bool((own["hopf"] < own["fold"]).all())
        assert bool((own["fold"] < own["fold_nonsmooth"]).all())
    # The closed form; and the paper's set is the same one on each curve.
    xi = data["damping_ratio"]
    np.testing.assert_allclose(xi["hopf_nonsmooth"], 0.5 * np.log(0.5 / xi["damping_ratio"]))
    paper = [xi["fold_nonsmooth"][0], data["mu_static"]["fold_nonsmooth"][1]]
    np.testing.assert_allclose([*paper, *data["width"]["fold_nonsmooth"]], 1.836600972, rtol=1e-9)
    np.testing.assert_allclose(xi["fold"][0], 1.792455775, rtol=1e-9)
    # Beyond the width at which they meet there is no fold.
    width = data["width"]
    assert np.isfinite(width["fold"].values).tolist() == [True, True, False]
    assert 0.3 < width.attrs["meeting_value"] < 0.35
    assert any("the fold ends on the Hopf curve" in text for text in said)


@pytest.mark.exhaustive
def test_the_ring_of_a_study(study):
    data = boundaries_curves.ring_curve(study)
    assert data.attrs["masses"] == 3
    np.testing.assert_allclose(data["hopf"], np.log(10.0) / 2)
    # Weakly coupled it is one mass; coupling takes from the vibration.
    own, dry = data["fold"].values, data["fold_nonsmooth"].values
    assert 1.792455775 > own[0] > own[1] > 1.7
    assert 1.836600972 > dry[0] > dry[1] > 1.7
    assert np.all(own < dry)


@pytest.mark.exhaustive
def test_the_cycles_of_a_study(study):
    chain = boundaries_curves.base_chain(study)
    folds = jax.vmap(lambda width: find_fold(chain.with_(width=width)))(jnp.array([0.01]))
    data = boundaries_curves.cycles(study, folds)
    assert data["width"].values.tolist() == [0.01, 0.0]
    top = data["belt_speed"].max("point")
    np.testing.assert_allclose(top, [1.792455775, 1.836600972], rtol=1e-9)
    at_top = data.isel(point=data.attrs["fold"])
    np.testing.assert_array_equal(at_top["belt_speed"], top)
    # At the same belt speed, smoothed and dry cycles are alike, stable and unstable.
    for part in (slice(None, data.attrs["fold"]), slice(data.attrs["fold"], None)):
        curves = []
        for width in (0.01, 0.0):
            own = data.sel(width=width).isel(point=part).dropna("point")
            order = np.argsort(own["belt_speed"].values)
            curves.append((own["belt_speed"].values[order], own["amplitude"].values[order]))
        smoothed, dry = (np.interp(1.5, *curve) for curve in curves)
        np.testing.assert_allclose(smoothed, dry, rtol=0.03)
