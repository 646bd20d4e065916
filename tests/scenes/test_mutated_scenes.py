"""Thousands of broken scenes: each a clear error or a valid run."""

import pytest
from mutated_scenes import built, fault_of, judge, means_nothing, mutants

from jaxchain.scenes.files import SceneError

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
