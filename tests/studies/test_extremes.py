"""The study of extremes: its judge can fail, its witnesses are right, quick cases of it pass."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import stored

from jaxchain.scenes.errors import StudyFailedError
from jaxchain.studies._study import from_rows
from jaxchain.studies.extremes import study as extremes
from jaxchain.studies.extremes.chains import chain_cases
from jaxchain.studies.extremes.figure import draw
from jaxchain.studies.extremes.judging import RIGHT, WRONG, Answer, Case, judge
from jaxchain.studies.extremes.masses import mass_cases, single
from jaxchain.studies.extremes.table import Study
from jaxchain.studies.extremes.witnesses import Oscillator, linear_chain, ring, smoothed_chain

STUDY = Study(study="extremes", title="A test", width=[1e-3, 1e-10])


def case(value, witness, tolerance=1e-6):
    return Case("numbers", "a case", "reason", lambda model: Answer(value, witness, tolerance))


@pytest.mark.parametrize(
    ("value", "witness", "outcome"),
    [
        ([1.0, 2.0], [1.0, 2.0], RIGHT),
        ([1.0, 2e6], [1.0, 2e6 + 1], RIGHT),  # relative to the greatest number
        ([1.0, 2.0], [1.0, 2.001], WRONG),
        ([0.0], [1e-5], WRONG),
        ([np.nan], [1.0], WRONG),
        ([1.0], [np.nan], WRONG),
        ([np.inf], [np.inf], WRONG),
        ([1.0, 2.0], [1.0, 2.0, 3.0], WRONG),
    ],
)
def test_an_answer_is_right_if_it_is_near_its_witness(value, witness, outcome):
    row = judge(case(value, witness), "smoothed")
    assert row.outcome == outcome
    assert row.seconds >= 0


def test_the_row_tells_which_number_is_off():
    row = judge(case([1.0, 2.0, 3.0], [1.0, 2.5, 3.0]), "smoothed")
    assert (row.value, row.witness, row.tolerance) == (2.0, 2.5, 1e-6)
    np.testing.assert_allclose(row.deviation, 0.5 / 3.0)


def test_an_answer_that_fails_or_takes_too_long_is_wrong():
    def broken(model):
        raise RuntimeError("no answer")

    row = judge(Case("numbers", "a case", "reason", broken), "smoothed")
    assert (row.outcome, row.found) == (WRONG, "RuntimeError: no answer")
    assert judge(case(1.0, 1.0), "smoothed", slowest=0.0).outcome == WRONG


@pytest.mark.parametrize("speed", [1.2, -1.2, 0.0])
def test_the_two_witnesses_of_one_oscillator_agree_as_the_width_vanishes(speed):
    mass = Oscillator(belt_speed=speed, duration=20.0)
    apart = [
        np.abs(replace(mass, width=width).smoothed() - mass.dry()).max() for width in (1e-4, 1e-6)
    ]
    assert apart[0] < 6e-4 * np.log(1e4)
    assert apart[1] < 6e-6 * np.log(1e6)


def test_the_witnesses_of_the_amplitude_agree_with_a_decay_and_with_one_another():
    # Constant friction only shifts the rest position; the last turns are at 2 pi and at 3 pi.
    decaying = Oscillator(belt_speed=50.0, mu_static=0.5, displacement=1.5, duration=9.6)
    period = np.pi / np.sqrt(1 - 0.05**2)
    turns = np.exp(-0.05 * period * np.array([2, 3]))
    np.testing.assert_allclose(decaying.dry_amplitude(3.5), turns.sum() / 2, rtol=1e-10)
    mass = Oscillator(duration=30.0, width=1e-5)
    smooth = mass.smoothed_amplitude(10.0)
    np.testing.assert_allclose(mass.dry_amplitude(10.0), smooth, atol=6e-5 * np.log(1e5))


def test_the_witness_of_linear_chains_is_a_damped_oscillation_and_that_of_smoothed_ones():
    t, w = 7.0, np.sqrt(1 - 0.05**2)
    decay = np.exp(-0.05 * t) * (np.cos(w * t) + 0.05 / w * np.sin(w * t))
    one = linear_chain(np.eye(1), 0.05, 0.5, np.array([1.5]), np.zeros(1), t)
    np.testing.assert_allclose(one[0], 0.5 + decay, rtol=1e-13)
    assert ring(2, 0.5).tolist() == [[1.0, -1.0], [-1.0, 1.0]]
    assert ring(3, np.array([1.0, 2.0]), cyclic=False).tolist() == [
        [1.0, -1.0, 0.0], [-1.0, 3.0, -2.0], [0.0, -2.0, 2.0],
    ]  # fmt: skip
    x, v = np.array([0.3, -0.4, 1.0]), np.array([0.1, 0.2, -0.3])
    coulomb = Oscillator(belt_speed=50.0, mu_static=0.5, width=0.1, duration=t)
    np.testing.assert_allclose(
        smoothed_chain(coulomb, x, v, ring(3, 0.2)),
        linear_chain(np.eye(3) + ring(3, 0.2), 0.05, 0.5, x, v, t),
        atol=1e-9,
    )


def test_the_study_has_cases_enough_and_no_two_of_one_name():
    study = extremes_of_the_file()
    all_cases = [*mass_cases(study), *chain_cases(study)]
    names = [(c.group, c.name, model) for c in all_cases for model in c.models]
    assert len(set(names)) == len(names) >= 45


def extremes_of_the_file():
    from jaxchain.scenes.reading import load_scene

    return load_scene("extremes").scene


@pytest.mark.long
def test_stick_slip_is_right_down_to_a_width_of_1e_10_and_a_false_witness_is_found_out():
    for mass in (Oscillator(width=1e-3), Oscillator(width=1e-10)):
        row = judge(Case("width", "", "", lambda model, m=mass: single(m, model)), "smoothed")
        assert row.outcome == RIGHT, row.found

    def falsified(model):
        answer = single(Oscillator(width=1e-3), model)
        return replace(answer, witness=np.asarray(answer.witness) * (1 + 1e-4))

    assert judge(Case("width", "", "", falsified), "smoothed").outcome == WRONG


def test_a_run_saves_draws_and_reports_and_fails_if_a_case_does(tmp_path, monkeypatch):
    def made_up(study):
        good, bad = case(1.0, 1.0 + 1e-9), case(1.0, 2.0)
        return [replace(good, name="good"), replace(bad, name="bad")][: 1 if study.width else 2]

    monkeypatch.setattr(extremes, "mass_cases", made_up)
    said = []
    study = STUDY.model_copy(update={"groups": ["numbers"], "models": ["smoothed"]})
    data = extremes.run(study, tmp_path, name="mine", report=said.append)["extremes"]
    assert data["outcome"].values.tolist() == [RIGHT]
    assert {file.suffix for file in tmp_path.iterdir()} == {
        ".zarr",
        ".nc",
        ".png",
        ".pdf",
        ".html",
    }
    assert stored(tmp_path / "mine")["extremes"].attrs["title"] == "A test"
    assert "numbers: good" in said[0]
    assert "1 cases: 1 right, 0 WRONG" in said[0]
    failing = study.model_copy(update={"width": []})
    (tmp_path / "2").mkdir()
    with pytest.raises(StudyFailedError, match=r"1 of 2 cases are WRONG: numbers: bad"):
        extremes.run(failing, tmp_path / "2", name="mine", report=said.append)
    assert "numbers: bad: deviates by 5.0e-01" in said[1]
    assert stored(tmp_path / "2" / "mine")["extremes"].sizes["case"] == 2


def test_the_picture_shows_every_case_once():
    rows = [
        judge(case(1.0, 1.0), "smoothed"),
        judge(case(1.0, 1.0), "nonsmooth"),
        judge(replace(case(1.0, 3.0), group="width"), "smoothed"),
    ]
    page = draw({"extremes": from_rows([vars(row) for row in rows], "case")})
    left, right = page.axes
    assert [label.get_text() for label in left.get_yticklabels()] == [
        "numbers: a case", "width: a case",
    ]  # fmt: skip
    _, names = left.get_legend_handles_labels()
    assert set(names) == {"allowed", "smoothed", "nonsmooth", "WRONG"}
    assert right.get_xlabel() == "time (s)"
