"""The study `edges`: its table, its summary, its picture, and a small one."""

import numpy as np
import pytest
import xarray as xr
from synthetic import stored

from jaxchain.model.chain import paper_chain, steady_sliding
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.studies.edges.compute import add_ranges, pulled, slip_cycles
from jaxchain.studies.edges.figure import draw
from jaxchain.studies.edges.report import OUTCOMES, motion, summary
from jaxchain.studies.edges.study import run
from jaxchain.studies.edges.table import Ring

GOOD, UNSETTLED, LOST = (
    OUTCOMES.index(name) for name in ("successful", "not_settled", "edge_lost")
)


def made_up():
    """Datasets of the shape that the study has."""
    speed = np.array([1.2, 1.5, 1.8])
    exact = np.array([0.4, 1.25, 1.79])
    one = xr.Dataset(
        {
            "amplitude": ("belt_speed", exact + 2e-8), "exact": ("belt_speed", exact),
            "sticking": ("belt_speed", [1.3, 1.6, 1.85]), "cut": ("belt_speed", exact + 0.5),
            "exact_cut": ("belt_speed", exact + 0.5 + 1e-11),
            "period": ("belt_speed", [6.28, 6.3, 6.31]),
            "exact_period": ("belt_speed", [6.28, 6.3, 6.31]),
            "multiplier": ("belt_speed", [1.1, 1.5, 2.0]), "outcome": ("belt_speed", 3 * [GOOD]),
            "hopf": 1.15, "fold": 1.84,
        },
        coords={"belt_speed": speed},
    )  # fmt: skip
    time = 20.0 * np.arange(1, 9)
    record = np.full((1, 4, 8, 5), 0.1)
    record[0, 0, :3, 2] = 1.28
    record[0, 0, 3:] = np.nan
    record[0, 1, :, 3] = 1.2 + 0.1 * np.cos(time)
    record[0, 2, :, 4] = 1.11 + 1e-5 * np.cos(time)
    ladder = xr.Dataset(
        {
            "record": (("belt_speed", "vibrating", "time", "oscillator"), record),
            "amplitude": (("belt_speed", "vibrating", "oscillator"), record[:, :, 0]),
            "mass": (("belt_speed", "vibrating"), [[3, 4, 5, 1]]),
            "outcome": (("belt_speed", "vibrating"), [[GOOD, UNSETTLED, UNSETTLED, LOST]]),
            "period": (("belt_speed", "vibrating"), [[6.23, np.nan, np.nan, np.nan]]),
            "gap": (("belt_speed", "vibrating"), [[1e-10, 1e-2, 1e-5, np.nan]]),
            "single": ("belt_speed", [1.25]),
        },
        coords={
            "belt_speed": [1.5], "vibrating": [0, 1, 2, 3], "time": time,
            "oscillator": np.arange(1, 6),
        },
    )  # fmt: skip
    tracking = xr.Dataset(
        {
            "edge": ("time", np.array([1.2, 1.3, np.nan])),
            "leaving": (("side", "after"), np.array([[1.2, 0.3], [1.3, 1.57]])),
            "mass": 12, "bracket": 1e-8, "outcome": UNSETTLED,
        },
        coords={
            "time": [20.0, 40.0, 60.0], "side": ["below", "above"], "after": [7.0, 14.0],
            "belt_speed": 1.5, "vibrating": 1,
        },
    )  # fmt: skip
    return {"one_mass": one, "ladder": add_ranges(ladder), "tracking": tracking}


def test_ranges_are_those_of_the_later_half_of_what_was_followed():
    data = made_up()["ladder"].isel(belt_speed=0)
    np.testing.assert_allclose(data["mean"].isel(vibrating=0), 1.28)
    later = 1.2 + 0.1 * np.cos(20.0 * np.arange(5, 9))
    own = data.isel(vibrating=1)
    np.testing.assert_allclose(
        [own["least"], own["mean"], own["greatest"]], [later.min(), later.mean(), later.max()]
    )


def test_the_summary_says_what_moves():
    data = made_up()
    rows = [data["ladder"].isel(belt_speed=0, vibrating=k) for k in range(4)]
    assert list(map(motion, rows)) == ["periodic", "beats", "settles", "edge lost"]
    said = {key: summary(key, own) for key, own in data.items()}
    assert "unstable cycle to 2.0e-08 without" in said["one_mass"]
    assert "0  periodic            1.28000" in said["ladder"]
    assert said["ladder"].splitlines()[-1].split() == ["3", "edge", "lost"]
    assert "mass 12 goes to amplitudes 0.3000 and 1.5700" in said["tracking"]


def test_the_picture():
    page = draw(made_up())
    first, errors, tracking, ladder, beats, profiles = page.axes
    lines = {line.get_label(): line for line in first.get_lines()}
    np.testing.assert_allclose(np.asarray(lines["unstable cycle"].get_ydata())[1], 1.25)
    assert [text.get_text().strip() for text in first.texts] == ["Hopf", "fold"]
    assert "edge state" in errors.get_ylabel()
    # What leaves the edge begins where the tracking ended.
    gone = next(line for line in tracking.get_lines() if line.get_label() == "vibrates")
    np.testing.assert_allclose(np.asarray(gone.get_xdata()), [47.0, 54.0])
    assert [label for label in ladder.get_legend_handles_labels()[1] if " to " in label] == [
        "0 to 1", "1 to 2", "2 to 3", "3 to 4"
    ]  # fmt: skip
    # What was lost is not drawn.
    assert np.isnan(np.asarray(beats.get_lines()[3].get_ydata())).all()
    assert profiles.get_yscale() == "log"


@pytest.mark.slow
def test_the_next_mass_is_pulled():
    chain = paper_chain(6, belt_speed=1.5, width=None)
    ring = Ring(masses=6, time=200.0, settling=200.0, pull=2.0)
    (x, v), (more, still) = pulled(chain, 1, ring, 1e-8)
    moved = np.flatnonzero(np.asarray(x) != np.asarray(more))
    np.testing.assert_array_equal(moved, [4])
    sliding, _ = steady_sliding(chain)
    assert float(more[4]) == pytest.approx(float(sliding[4]) + 2.0)
    assert float(still[4]) == 0.0
    np.testing.assert_array_equal(np.delete(v, 4), np.delete(still, 4))


@pytest.mark.long
def test_the_cycle_is_known_up_to_the_fold():
    chain = paper_chain(1, width=None)
    cycles = slip_cycles(chain, np.array([1.8, 1.83]))
    assert all(bool(cycle.successful) for cycle in cycles)
    np.testing.assert_allclose(cycles[1].amplitude, 1.83725765, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("base.mu_dynamic=1.0", "mu_static"),
        ("one_mass.belt_speed=[1.5,1.2]", "one_mass.belt_speed"),
        ("one_mass.strong=0.01", "strong"),
        ("ladder.vibrating=[20]", "ladder.vibrating"),
        ("ladder.vibrating=[-1]", "ladder.vibrating"),
        ("ladder.time=10.0", "ladder.time"),
        ("ladder.time=1e7", "ladder.time"),
        ("ladder.belt_speed=[1.5,1.5]", "ladder.belt_speed"),
        ("tracking.vibrating=20", "tracking.vibrating"),
        ("rtol=0.1", "rtol"),
        ("colour=1", "colour"),
    ],
)
def test_a_bad_table_is_refused_with_its_key(override, key):
    with pytest.raises(SceneError, match=key):
        load_scene("edges", [override])


SMALL = [
    "one_mass.belt_speed=[1.3,1.5,1.7]",
    "ladder={masses=6,vibrating=[0,1],belt_speed=[1.5],time=400.0}",
    "tracking={masses=6,vibrating=0,belt_speed=1.5,time=400.0,leaving=400.0}",
]


@pytest.mark.exhaustive
def test_a_small_study(tmp_path):
    said = []
    data = run(load_scene("edges", SMALL).scene, tmp_path, name="small", report=said.append)
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {"small.zarr", "small.nc", "small.png", "small.pdf", "report.html"}
    assert list(data) == ["one_mass", "ladder", "tracking"]
    for name, saved in stored(tmp_path / "small").items():
        assert saved.identical(data[name])
    one = data["one_mass"]
    np.testing.assert_allclose(one["amplitude"], one["exact"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(one["cut"], one["exact_cut"], rtol=0, atol=1e-8)
    low, high = data["tracking"]["leaving"].isel(after=-1).values
    assert low < 0.1
    assert high > 1.5
    # The same edge, in the ladder and tracked.
    np.testing.assert_allclose(
        data["ladder"]["mean"].sel(vibrating=0), data["tracking"]["edge"][-1], rtol=1e-4
    )
    assert len(said) == 3
