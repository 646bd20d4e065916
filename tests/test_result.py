"""How runs end: names, codes and advice belong together."""

from jaxchain.result import NAMES, STOPPED_WELL, Result, code, message


def test_names_stand_in_the_order_of_their_codes():
    assert len(NAMES) == len(Result)
    for index, name in enumerate(NAMES):
        assert int(code(getattr(Result, name))) == index
        assert Result[getattr(Result, name)] == message(name)
    # Codes in results that were written earlier.
    assert (NAMES.index("nonfinite"), NAMES.index("interrupted")) == (6, 9)


def test_every_failure_has_advice():
    for name in NAMES:
        assert bool(message(name)) == (name != "successful")
    assert set(STOPPED_WELL) < set(NAMES)
