"""One table of the numbers is used by everything that lists them; a missing one is noticed."""

import dataclasses
import inspect
import json

import numpy as np
import pytest

from jaxchain import (
    Chain,
    TanhFriction,
    WeakeningStrengthening,
    steady_sliding,
    sweep,
)
from jaxchain.model import friction
from jaxchain.model.parameters import CHAIN, FRICTION, PARAMETERS
from jaxchain.scenes.scene import schema

N = 3
LAW = friction.AbstractFrictionLaw
USUAL = {name: row.usual or 0.1 for name, row in PARAMETERS.items()}


SMOOTHED = {name: row for name, row in PARAMETERS.items() if name != "mu_kinetic"}
LAWS_OWN = [name for name in SMOOTHED if name in FRICTION and name != "width"]


def chain_of(**changes):
    own: dict = {name: USUAL[name] for name in CHAIN}
    if "mu_kinetic" in changes:  # which no smoothed law has
        law = friction.StaticKinetic(1.0, 0.5)
        return Chain(N, law, **own).with_(**changes)
    law = WeakeningStrengthening(**{k: USUAL[k] for k in LAWS_OWN})
    return Chain(N, TanhFriction(law, USUAL["width"]), **own).with_(**changes)


def fields(kind):
    return {field.name for field in dataclasses.fields(kind)}


def test_every_number_stands_in_the_table_and_every_row_is_one():
    """Of a chain and of the shipped laws; and each is a key of scenes."""
    arguments = set(inspect.signature(Chain.__init__).parameters)
    assert arguments - {"self", "n", "friction", "ends"} == set(CHAIN)
    assert fields(Chain) - {"n", "friction", "springs"} | {"coupling"} == set(CHAIN)
    found = [kind for _, kind in inspect.getmembers(friction, inspect.isclass)]
    laws = [k for k in found if issubclass(k, LAW) and not inspect.isabstract(k)]
    assert len(laws) >= 3
    assert set.union(*map(fields, laws)) | {"width"} == set(FRICTION)
    parts = schema()["$defs"]
    assert set(parts["ChainTable"]["properties"]) == {"n", "friction", "ends", *CHAIN}
    law = parts["WeakeningStrengtheningTable"]["properties"]
    assert set(law) == {"law", "width", *LAWS_OWN}


def test_every_number_is_changed_by_its_name():
    assert set(chain_of().parameters()) == set(SMOOTHED)
    for name, usual in USUAL.items():
        chain = chain_of(**{name: usual})
        before, after = chain.parameters(), chain.with_(**{name: 0.9 * usual}).parameters()
        assert {k for k, v in after.items() if v != before[k]} == {name}


@pytest.mark.parametrize(("ends", "springs"), [("cyclic", N), ("free", N - 1)])
def test_there_are_as_many_numbers_as_masses_or_springs(ends, springs):
    for row in CHAIN.values():
        count = {"mass": N, "spring": springs}[row.per]
        changes = {"ends": ends, row.name: np.full(count, USUAL[row.name])}
        assert chain_of(**changes).parameters()[row.name].shape == (count,)
        changes[row.name] = np.full(count + 1, USUAL[row.name])
        with pytest.raises(ValueError, match=rf"`{row.name}` must .* shape \({count + 1},\)"):
            chain_of(**changes)


def test_every_number_may_be_swept_and_has_words_and_a_unit_in_the_dataset():
    chain = chain_of()
    over = {name: [USUAL[name]] for name in SMOOTHED}
    data = sweep(chain, steady_sliding(chain), 0.0, over=over, rtol=1e-6)
    for name, row in SMOOTHED.items():
        assert data[name].attrs == {"long_name": row.long_name, "units": row.unit}
    parameters = json.loads(data.attrs["parameters"])
    assert {name for name, value in parameters.items() if value == "swept"} == set(SMOOTHED)
