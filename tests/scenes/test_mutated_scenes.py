"""Thousands of broken scenes: each a clear error or a valid run."""

import pytest
from mutated_scenes import built, fault_of, judge, means_nothing, mutants

from jaxchain.scenes.files import SceneError
from jaxchain.scenes.running import run_scene
from jaxchain.scenes.scene import LoadedScene

SEED, FEW, COUNT = 14, 300, 1000
pytestmark = pytest.mark.filterwarnings("ignore:.*If it is in SI units")


def judged(folder, seed, count, first=0):
    """The mutants that were accepted, as loaded; asserts that all others were refused in words."""
    accepted, faults, refused = [], [], 0
    for number, mutant in enumerate(mutants(seed, count, first), first):
        verdict = judge(mutant, folder)
        refused += verdict.loaded is None
        if verdict.fault:
            faults.append(
                (number, mutant.base, mutant.mistakes, verdict.fault, verdict.text[:200])
            )
        elif verdict.loaded is not None:
            accepted.append((number, verdict.loaded))
    assert not faults, f"of the mutants of seed {seed}: {faults[:5]}"
    assert refused > 0.6 * count
    assert len(accepted) > 0.05 * count
    return accepted


def assert_meaning(accepted):
    """Every chain can be made, and has forces; or is refused in words, too."""
    faults, made = [], 0
    for number, loaded in accepted:
        try:
            pairs = built(loaded)
        except SceneError as error:
            wrong = fault_of(str(error), error.problems, 0.0)
            faults += [(number, wrong)] if wrong else []
            continue
        made += bool(pairs)
        faults += [(number, wrong) for pair in pairs if (wrong := means_nothing(*pair))]
    assert not faults
    # What does not fit the model is refused only here.
    assert made > 0.5 * len(accepted)


def test_hundreds_of_mutants_are_refused_in_words_or_valid(tmp_path):
    accepted = judged(tmp_path, SEED, FEW)
    assert_meaning(accepted[:10])


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_thousands_of_mutants_are_refused_in_words_or_mean_something(seed, tmp_path):
    assert_meaning(judged(tmp_path, seed, 3 * COUNT))


def tiny(experiment):
    """A short experiment of two values of each number at most, and of no more than 3000 steps."""
    time = {"transient": min(experiment.time.transient, 3.0), "window": 7.0}
    return experiment.model_copy(
        update={
            "time": experiment.time.model_copy(update=time),
            "sweep": {name: own[:2].tolist() for name, own in experiment.grid().items()},
            "numerics": experiment.numerics.model_copy(update={"max_steps": 3000, "lanes": 2}),
        }
    )


@pytest.mark.long
def test_scenes_that_are_accepted_run(tmp_path):
    for number, loaded in judged(tmp_path, 7, COUNT)[:8]:
        parts = {name: tiny(part) for name, part in loaded.scene.experiment.items()}
        short = LoadedScene(loaded.name, loaded.scene.model_copy(update={"experiment": parts}))
        folder = tmp_path / f"results-{number}"
        folder.mkdir()
        try:
            data = run_scene(short, folder, plot=False, report=lambda text: None)
        except SceneError:
            continue
        assert set(parts) <= set(data)
