"""The study `ladder`: its table, its files, its picture, and that its checks can fail."""

import numpy as np
import pytest
import xarray as xr
from synthetic import stored

from jaxchain.localization.patterns import LockedPattern
from jaxchain.plotting.branches import PARTS
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.studies._study import from_rows
from jaxchain.studies.ladder.branches import symmetry
from jaxchain.studies.ladder.checks import _rate, draw_lots
from jaxchain.studies.ladder.figure import draw
from jaxchain.studies.ladder.report import branches_of, stable_ranges, summary
from jaxchain.studies.ladder.study import run

SMALL = [
    "ring={masses=4,coupling=0.01,width=0.05}",
    "walk={start=1.45,slowest=1.4,fastest=1.9,points=6,rtol=1e-9,tolerance=1e-8}",
    "rungs={count=[1,2],pattern=['in-phase','alternating'],switch=[]}",
    "ensemble={belt_speed={start=1.4,stop=1.5,count=2},transient=50.0,window=20.0}",
    "checks={orbits=3,periods=20,dry=1,dry_time=200.0}",
    "couplings={coupling=[0.005,0.01],count=[1],masses=4,points=4}",
]


def branch(count, pattern, fold=1.8):
    """A branch that comes up stably, folds and goes down unstably."""
    s = np.linspace(-1.0, 1.0, 21)
    speed = fold - 0.5 * s**2
    amplitude = np.zeros((21, 6))
    amplitude[:, :count] = (speed - 0.3 * s)[:, None]
    flat = np.ones((21, 6))
    return xr.Dataset(
        {
            "belt_speed": ("point", speed), "energy": ("point", 0.5 * (amplitude**2).sum(1)),
            "period": ("point", 6.2 + 0 * s), "unstable": ("point", (s > 0.01).astype(int)),
            "multiplier": ("point", 1.0 + 0.1 * s),
            "amplitude": (("point", "oscillator"), amplitude),
            "x": (("point", "oscillator"), flat), "v": (("point", "oscillator"), flat),
            "residual": ("point", np.geomspace(1e-12, 3e-9, 21)),
            "closing_error": ("point", np.geomspace(1e-12, 7e-8, 21)),
            "special_kind": ("special", np.array(["fold", "torus"])),
            "special_belt_speed": ("special", np.array([fold, 1.5])),
            "special_after": ("special", [10, 15]),
            "special_energy": ("special", 0.5 * count * np.array([fold**2, 2.0])),
        },
        attrs={
            "count": count, "pattern": pattern, "ended_up": "max_points",
            "ended_down": "left_bounds", "mass": 3,
        },
    )  # fmt: skip


@pytest.fixture
def made_up():
    speeds, excited = np.linspace(1.4, 1.8, 3), np.arange(7)
    ends = {
        "count": [1, 2, 1, 2], "coupling": [0.01, 0.01, 0.1, 0.1],
        "stable": [True, True, True, False], "growth": [-0.02, -0.002, -0.02, np.nan],
        "phase_growth": [-np.inf, -0.002, -np.inf, -0.02], "lower": [1.2, 1.3, np.nan, np.nan],
        "upper": [1.79, 1.73, 1.6, np.nan], "lower_kind": ["torus", "fold", "max_points", ""],
        "upper_kind": ["fold", "branch point", "fold", ""],
    }  # fmt: skip
    return {
        "patterns": from_rows(
            [{"key": "k1_single", "converged": 1}, {"key": "k2_in_phase", "converged": 0}], "p"
        ),
        "k1_single": branch(1, "single"),
        "k2_alternating": branch(2, "alternating", 1.7),
        "ensemble": xr.Dataset(
            {"energy": (("belt_speed", "excited"), np.outer(speeds, excited))},
            coords={"belt_speed": speeds, "excited": excited},
        ),
        "disturbed": from_rows(
            [
                {"multiplier": 0.9, "measured": 0.901, "shift": 1e-9},
                {"multiplier": 1.3, "measured": 0.95, "shift": 2e-9},
                {"multiplier": 1.3, "measured": np.nan, "shift": 3e-9},
            ],
            "orbit",
        ),
        "dry": from_rows(
            [
                {"energy": 1.01, "energy_smoothed": 1.0, "period": 6.2, "period_smoothed": 6.2},
            ],
            "orbit",
        ),
        "couplings": xr.Dataset({k: ("pattern", np.array(v)) for k, v in ends.items()}),
    }


def test_the_picture_has_stable_and_unstable_pieces_of_each_branch(made_up):
    page = draw(made_up)
    whole, _, ends = page.axes
    lines = [np.asarray(line.get_xydata()) for line in whole.get_lines()]
    solid, dashed = (line[::PARTS] for line in [line for line in lines if len(line) > 1][:2])
    own = made_up["k1_single"]
    np.testing.assert_array_equal(solid[:-1, 0], own["belt_speed"][:11])
    assert solid[-1, 0] == dashed[0, 0] == 1.8  # they meet in the fold
    assert len(dashed) == 12  # with a torus, beyond which it is as unstable as before
    singles = [line.get_xydata() for line in page.axes[1].get_lines()]
    marked = {tuple(map(float, xy[0])) for xy in map(np.asarray, singles) if len(xy) == 1}
    assert (1.8, 0.5 * 1.8**2) in marked
    upper = next(line for line in ends.get_lines() if line.get_label() == "$k = 1$")
    np.testing.assert_array_equal(upper.get_ydata(), [1.79, 1.6])


def test_the_summary_says_what_was_found(made_up):
    said = "\n".join(summary(key, data) for key, data in made_up.items())
    assert (
        "k1_single: 21 points at belt speeds 1.3000 ... 1.8000, stable at 1.3000 ... 1.8000"
        in said
    )
    assert "fold: 1.70000" in said
    assert "residual at most 3.0e-09, with a finer tolerance 7.0e-08" in said
    assert "patterns without a cycle: k2_in_phase" in said
    assert "2 of 3 orbits could be measured, of 1 of these the verdict agrees" in said
    assert "moves by at most 3.0e-09" in said
    assert "E differs by at most 1.00 %" in said
    found = [" ".join(line.split()) for line in said.splitlines()]
    assert "0.1 2 no cycle found -2.00e-02" in found
    assert "0.1 1 max_points 1.60000 (fold) -2.00e-02 -inf" in found
    assert "0.01 2 1.30000 (fold) 1.73000 (branch point) -2.00e-03 -2.00e-03" in found


def test_stable_ranges_are_those_between_stable_points(made_up):
    own = made_up["k1_single"]
    assert list(branches_of(made_up)) == ["k1_single", "k2_alternating"]
    own["unstable"][:] = np.where(np.arange(21) % 10 < 3, 0, 2)
    assert stable_ranges(own).count("...") == 3
    own["unstable"][:] = 1
    assert stable_ranges(own) == "no belt speed"


def test_the_symmetry_of_a_block_is_that_of_its_pattern():
    def images(*phases, n=8):
        return symmetry(n, LockedPattern(np.array(phases), 0.0, 0.0))

    assert images(0.0) == (4, [0, 7, 6, 5, 4, 5, 6, 7])
    assert images(0.0, 0.0) == (4, [7, 6, 5, 4, 4, 5, 6, 7])
    assert images(0.0, np.pi) == (4, None)
    assert images(0.0, 1.0, 0.0) == (4, [0, 7, 6, 5, 4, 5, 6, 7])
    assert images(*np.zeros(8)) == (4, [4] * 8)
    assert images(*(np.pi * np.arange(8))) == (4, [4, 5] * 4)
    assert images(*(np.pi / 4 * np.arange(8))) == (4, None)


def test_every_point_can_be_drawn_and_none_twice(made_up):
    branches = branches_of(made_up)
    lot = draw_lots(branches, 1000)
    assert len(set(lot)) == len(lot) == 42
    assert draw_lots(branches, 5) == draw_lots(branches, 5)
    assert len({key for key, _ in draw_lots(branches, 10)}) == 2


def test_the_rate_is_that_of_what_can_be_seen():
    p = np.arange(60)
    assert _rate(1e-6 * 0.9**p)[0] == pytest.approx(0.9)
    growing, count = _rate(1e-7 * 1.5**p)
    assert growing == pytest.approx(1.5)
    assert count < 20  # no more of it is small
    assert np.isnan(_rate(np.full(60, np.nan))[0])
    # What has reached the rounding is not looked at.
    assert _rate(np.maximum(1e-6 * 0.5**p, 1e-10))[0] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("walk.start=2.5", "walk"),
        ("rungs.count=[21]", "rungs.count"),
        ("rungs.count=[]", "rungs.count"),
        ("couplings.count=[10]", "couplings.count"),
        ("rungs.pattern=['odd']", "rungs.pattern"),
        ("ring.masses=3", "ring.masses"),
        ("ring.width=0.0", "ring.width"),
        ("checks.periods=2", "checks.periods"),
        ("checks.dry_time=5e-324", "checks.dry_time: must hold at least one period"),
        ("ensemble.window=6.2", "ensemble.window: must hold at least one period"),
        ("colour=1", "colour"),
    ],
)
def test_a_bad_table_is_refused_with_its_key(override, key):
    with pytest.raises(SceneError, match=key):
        load_scene("ladder", [override])


@pytest.mark.exhaustive
def test_a_small_study(tmp_path):
    study = load_scene("ladder", SMALL).scene
    said = []
    data = run(study, tmp_path, name="small", report=said.append)
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {"small.zarr", "small.nc", "small.png", "small.pdf", "report.html"}
    assert list(data) == [
        "patterns", "k1_single", "k2_in_phase", "k2_alternating", "ensemble", "disturbed", "dry",
        "couplings",
    ]  # fmt: skip
    assert np.all(data["patterns"]["converged"].values == 1)
    branch = stored(tmp_path / "small")["k2_alternating"]
    np.testing.assert_array_equal(branch["x"], data["k2_alternating"]["x"])
    for own in branches_of(data).values():
        assert float(own["residual"].max()) < 1e-8
        assert float(own["closing_error"].max()) < 1e-7
        step = np.diff(own["belt_speed"].values)
        assert np.all(step[: own.attrs["start"]] > 0)
    seen = data["disturbed"]
    np.testing.assert_allclose(seen["measured"], seen["multiplier"], rtol=1e-2)
    # The width is 0.05: of order eps ln(1 / eps).
    dry = data["dry"]
    np.testing.assert_allclose(dry["energy"], dry["energy_smoothed"], rtol=0.15)
    np.testing.assert_allclose(dry["period"], dry["period_smoothed"], rtol=0.02)
    assert said[1].startswith("k1_single: ")
