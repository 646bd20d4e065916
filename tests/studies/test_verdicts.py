"""The study `verdicts`: its table, what the paper says, its dataset, picture and words."""

import numpy as np
import pytest
from synthetic import stored

from jaxchain.chaos.classification import KINDS, VERDICTS, Evidence, classify
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.storage import save
from jaxchain.studies.verdicts.figure import (
    LOOKS,
    LOWEST,
    decisive,
    draw,
    trap_example,
    unstable_growth,
)
from jaxchain.studies.verdicts.paper import CLAIMS, agrees, claim, why
from jaxchain.studies.verdicts.report import summary
from jaxchain.studies.verdicts.runs import to_dataset
from jaxchain.studies.verdicts.study import run
from jaxchain.studies.verdicts.table import Case


def made_up_run(kind, noise, exponents=(), locked_at=np.nan, seed=0, width=2e-4):
    values = np.asarray(exponents, float)
    reach = 1e-9 if kind in ("cycle", "unstable") else width
    steps = np.arange(1.0, 21.0)
    return Evidence(
        noise, seed, kind=kind, time=16000.0, locked_at=locked_at, active=np.ones(3, bool),
        energy=3.7, period=6.2, exponents=values, low=values - reach, high=values + reach,
        smooth=values, symmetry_time=200 * steps,
        symmetry=np.minimum(1e-9 * np.exp(0.5 * steps), 0.3),
    )  # fmt: skip


def state(clean, noisy):
    return classify([clean, *(made_up_run(*args) for args in noisy)])


CYCLE = (0.0, -7e-4, -8e-4)
FOUND = [
    state(made_up_run("rest", 0.0), [("rest", 1e-3)] * 2),
    state(made_up_run("cycle", 0.0, CYCLE, 12000.0), [("cycle", 1e-3, CYCLE, 13000.0)] * 2),
    state(
        made_up_run("unstable", 0.0, (3.5e-3, 0.0, -1e-3), 2000.0),
        [("chaos", 1e-3, (1e-3, 0.0, -1e-3)), ("chaos", 1e-3, (2e-3, 0.0, -1e-3))],
    ),
    state(made_up_run("torus", 0.0, (0.0, 0.0, -1e-3)), [("torus", 1e-3, (0.0, 0.0, -1e-3))] * 2),
    state(made_up_run("open", 0.0), [("open", 1e-3, (1e-5, 0.0, -1e-3)), ("open", 1e-3)]),
]


@pytest.fixture
def datasets():
    case = Case(belt_speed=1.5, excited=[0, 5, 7, 3, 6], paper="figures 6 to 8")
    data = to_dataset(case, FOUND, 3)
    for key, shift in (("", 0.0), ("_low", -1e-4), ("_high", 1e-4)):
        data[f"smoothed_exponent{key}"] = (("excited", "order"), np.full((5, 3), -1e-3 + shift))
    data.attrs |= {"smoothed_width": 1e-3, "smoothed_time": 1e4}
    return {"slow": data}


def test_the_paper_contradicts_itself_on_8_and_19_only_by_silence():
    assert claim("figures 6 to 8", 8) == claim("figures 6 to 8", 19) == ("periodic", "")
    assert claim("figures 6 to 8", 12) == ("irregular", "irregular")
    assert claim("figures 6 to 8", 0) == ("", "")
    assert claim("figure 10", 18) == ("perhaps not", "")
    assert all(0 < k <= 20 for pair in CLAIMS.values() for said in pair for k in said)


@pytest.mark.parametrize(
    ("verdict", "said", "fits"),
    [
        ("periodic", "periodic", True),
        ("chaotic", "periodic", False),
        ("quasi-periodic", "irregular", True),
        ("periodic", "irregular", False),
        ("transient", "periodic", None),
        ("periodic", "", None),
        ("periodic", "perhaps not", None),
    ],
)
def test_a_verdict_fits_a_claim_or_not(verdict, said, fits):
    assert agrees(verdict, said) is fits


def test_reasons_name_the_traps():
    late = why(FOUND[1], "irregular", "irregular")
    assert late.startswith("against text (irregular) and caption (irregular): phases lock only by")
    assert "13000" in late
    symmetric = why(FOUND[2], "", "periodic")
    assert symmetric.startswith("against caption (periodic): the start without noise")
    assert "3.5e-03" in symmetric
    assert why(FOUND[3], "", "") == ""


def test_the_dataset_holds_every_run_and_can_be_read_again(datasets, tmp_path):
    data = datasets["slow"]
    save(data, tmp_path / "verdicts", "slow", {"scene": "verdicts"})
    again = stored(tmp_path / "verdicts")["slow"]
    names = [VERDICTS[i] for i in again["verdict"].values]
    assert names == ["at rest", "periodic", "chaotic", "quasi-periodic", "transient"]
    assert again["excited"].values.tolist() == [0, 5, 7, 3, 6]
    assert again["exponent"].dims == ("excited", "run", "order")
    assert str(again["paper_caption"].values[2]) == "periodic"
    assert again["active"].sum("oscillator").values.tolist() == [3] * 5
    assert KINDS[int(again["kind"][2, 0])] == "unstable"


def test_what_is_annihilated_is_written_and_drawn_as_that():
    cycle = (0.0, -np.inf, -np.inf)
    found = [state(made_up_run("cycle", 0.0, cycle, 50.0), [("cycle", 1e-3, cycle, 60.0)] * 2)]
    data = to_dataset(Case(belt_speed=1.5, excited=[1], paper="figures 6 to 8"), found, 3)
    assert decisive(data)["value"][0] == -np.inf
    assert "-inf  [-inf, -inf]" in summary("slow", data)
    axes = draw({"slow": data}).axes[0]
    below = [np.asarray(line.get_ydata()) for line in axes.lines if line.get_marker() == "v"]
    assert [values.tolist() for values in below if values.size] == [[LOWEST]]


def test_what_is_drawn_is_what_decides(datasets):
    found = decisive(datasets["slow"])
    np.testing.assert_allclose(found["value"], [np.nan, -7e-4, 1.5e-3, 0.0, 1e-5])
    np.testing.assert_allclose(found["low"][2], 1e-3 - 2e-4)
    np.testing.assert_allclose(found["high"][2], 2e-3 + 2e-4)
    growth = unstable_growth(datasets["slow"])
    np.testing.assert_array_equal(np.isfinite(growth), [False, False, True, False, False])
    assert growth[2] == 3.5e-3
    assert trap_example(datasets) == ("slow", 2)


def test_the_picture_shows_every_state_once(datasets):
    page = draw(datasets)
    exponents, symmetry = page.axes
    assert len(page.legends[0].get_texts()) == len(LOOKS) + 2
    points = [line for line in exponents.get_lines() if line.get_marker() in ("o", "s", "D", "^")]
    dry = [line for line in points if line.get_color() != "black"]
    shown = {line.get_marker(): np.size(line.get_xdata()) for line in dry}
    assert shown == {"o": 1, "s": 1, "D": 1, "^": 1}
    assert len(symmetry.get_lines()) == 3 + 1  # the runs, and the slope of the unstable orbit
    del datasets["slow"]["smoothed_exponent"]
    datasets["slow"] = datasets["slow"].isel(excited=[0, 1])
    calm = draw(datasets)
    assert "no state is lost" in calm.axes[-1].texts[0].get_text()


def test_the_summary_is_the_table_state_by_state(datasets):
    lines = summary("slow", datasets["slow"]).splitlines()
    assert len(lines) == 2 + 5
    row = next(line for line in lines if line.split()[0] == "7")
    assert row.split()[1:5] == ["3", "-", "periodic", "chaotic"]
    assert "[+8.0e-04, +2.2e-03]" in row


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("times.longest=10.0", "times.longest: must be at least `first` = 2000, but is 10"),
        (
            "case.slow.excited=[21]",
            "case.slow.excited: must hold nothing above 20 (`n`), but holds",
        ),
        ("case.slow.paper='figure 11'", "case.slow.paper"),
        ("exponents=1", "exponents"),
        ("window=5e-324", "window: must hold at least one period, 6.283"),
        ("times.exponents=1e-3", "times.exponents: must hold at least one period"),
        ("smoothed.time=1.0", "has a `time` that must hold at least one period"),
    ],
)
def test_a_wrong_table_is_named(override, problem):
    with pytest.raises(SceneError) as error:
        load_scene("verdicts", [override])
    assert any(problem in found for found in error.value.problems)


@pytest.mark.long
def test_a_small_study_runs_into_its_folder(tmp_path):
    small = [
        "n=3", "case={one={belt_speed=1.5,excited=[0,1]}}", "noise={levels=[1e-3],seeds=1}",
        "times={first=1000.0,longest=1000.0,exponents=500.0}", "smoothed={time=0.0}", "lanes=2",
    ]  # fmt: skip
    study = load_scene("verdicts", small).scene
    said = []
    found = run(study, tmp_path, report=said.append)
    assert [VERDICTS[i] for i in found["one"]["verdict"].values] == ["at rest", "periodic"]
    # A lone mass: the cycle attracts at the rate at which a resting neighbour is damped, about.
    assert -0.05 < found["one"]["exponent"].values[1, 0, 1] < -0.01
    assert {file.name for file in tmp_path.iterdir()} == {
        "verdicts.zarr", "verdicts.nc", "verdicts.png", "verdicts.pdf", "report.html"
    }  # fmt: skip
    assert "one: belt speed 1.5" in said[0]
