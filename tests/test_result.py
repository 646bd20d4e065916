"""How runs end: names, codes and advice belong together."""

import numpy as np

from jaxchain.result import NAMES, Result, code, ended_well, message


def test_names_stand_in_the_order_of_their_codes():
    assert len(NAMES) == len(Result)
    for index, name in enumerate(NAMES):
        assert int(code(getattr(Result, name))) == index
        said = message(name)
        assert Result[getattr(Result, name)] == (f"{name}: {said}" if said else name)
    # Codes in results that were written earlier.
    assert (NAMES.index("nonfinite"), NAMES.index("interrupted")) == (6, 9)


def test_every_failure_has_advice():
    for name in NAMES:
        assert bool(message(name)) == (name != "successful")


def test_runs_that_ended_well_are_told_in_every_form():
    well = [name for name in NAMES if ended_well(name)]
    assert well == ["successful", "quiet", "steady"]
    codes = np.arange(len(NAMES))
    assert [NAMES[i] for i in codes[ended_well(codes)]] == well
    assert [name for name in NAMES if ended_well(getattr(Result, name))] == well
