"""Numbers, names and lists of scene files: within bounds that errors name."""

from decimal import Decimal

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from jaxchain._limits import MOST_LANES
from jaxchain.scenes import scene, values
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.values import Range, distinct
from jaxchain.studies import _tables
from jaxchain.sweeps import axes

PAIR = "experiment.ladder."
TRILLION = "1" + "0" * 30


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("numerics.max_steps=" + TRILLION, "numerics.max_steps: must be at most 1000000000000000"),
        ("numerics.lanes=" + TRILLION, f"numerics.lanes: must be at most {MOST_LANES}, but is 1"),
        ("numerics.rtol=1e-300", "numerics.rtol: must be at least 1e-15, but is 1e-300"),
        ("numerics.atol=1e-300", "numerics.atol: must be at least 1e-30, but is 1e-300"),
        ("numerics.max_step=1e-300", "numerics.max_step: must be at least 1e-06, but is 1e-300"),
        ("chain.n=" + TRILLION, "chain.n: must be at most 100000000, but is 1000"),
        ("chain.friction.v_ref=5e-324", "chain.friction.v_ref: must be at least 1e-15, but is 5e"),
        ("chain.damping_ratio=1e300", "chain.damping_ratio: must be at most 1e+15 in size, but"),
        (
            "chain.damping_ratio=-5e-324",
            "chain.damping_ratio: must be 0 or at least 1e-15 in size",
        ),
        ("sweep.belt_speed=[1e300]", "sweep.belt_speed[0]: must be at most 1e+15 in size"),
        ("sweep.belt_speed={start=1,stop=2,count=" + TRILLION + "}", "sweep.belt_speed: would be"),
        ("time.transient=1e300", "time.transient: must be at most 1e+09 in size, but is 1e+300"),
        ("observe.repeats=" + TRILLION, "observe.repeats: must be at most 1000000, but is 1000"),
        (
            "observe.others=[{observer='PeakTimes',capacity=1000000}]",
            "observe.others[0]: would keep 4.62e+08 numbers of 77 runs of 6 masses, and 1e+08 are",
        ),
        (
            "observe.others=[{observer='FrontTrack',windows=100}]",
            "observe.others[0].windows: would be parts of 5.5 time units, and 12.57, two periods,",
        ),
        (
            "observe.others=[{observer='Divergence'},{observer='Divergence'}]",
            "observe: must have no two `others` of one kind, but has two `Divergence`",
        ),
        ('description="a\\u0007"', "description: must not hold the character '\\x07', which"),
    ],
)
def test_a_number_beyond_its_bound_is_refused_with_the_bound(override, problem):
    with pytest.raises(SceneError) as error:
        load_scene("quickstart", [PAIR + override])
    (found,) = error.value.problems
    assert found.startswith(PAIR + problem)


ESCAPES = ["../../../esc", "a/b", "", ".", "..", "-x", "a b", "ü", "x" * 65, "a\n", "_x"]


@pytest.mark.parametrize("name", ESCAPES)
def test_names_of_groups_hold_letters_digits_and_dashes_only(name):
    adapter = TypeAdapter(values.Name)
    assert adapter.validate_python("x-1_B") == "x-1_B"
    with pytest.raises(ValidationError):
        adapter.validate_python(name)


@pytest.mark.parametrize(("scene", "table"), [("fig3", "experiment")])
def test_experiments_ensembles_and_cases_are_named_so(scene, table):
    for name, said in [
        ("/a/b", "must be named by letters, digits, `-` and `_`"),
        ("x" * 65, "must be a name of at most 64 characters, but has 65"),
    ]:
        with pytest.raises(SceneError) as error:
            load_scene(scene, [f"{table}.{name}={{}}"])
        assert any(said in problem for problem in error.value.problems)


def test_the_most_lanes_have_one_home():
    for module in (axes, scene, _tables):
        assert module.MOST_LANES is MOST_LANES
    assert not hasattr(values, "MOST_LANES")


@pytest.mark.parametrize(
    ("given", "said"),
    [([1.0, 2.0, 1.0], "holds 1 more than once"), (["a", "a"], 'holds "a" more than once')],
)
def test_a_list_must_not_hold_a_value_twice(given, said):
    with pytest.raises(ValueError, match=said):
        distinct(given)
    different = given[:2] if given[0] != given[1] else given[:1]
    assert distinct(different) is different


@pytest.mark.parametrize(
    ("start", "stop", "step"),
    [
        (0.1, 0.9, 1e-4), (1.0, 2.0, 0.05), (-3.7, 5.1, 0.011), (2.0, -1.5, -0.007),
        (1e-9, 1e-6, 1e-9), (1e14, 2e14, 1e13), (0.3, 0.31, 7e-4), (1e-15, 1.0, 0.001),
    ],
)  # fmt: skip
def test_the_steps_of_a_range_are_those_of_decimals(start, stop, step):
    own = Range(start=start, stop=stop, step=step).array()
    exact = [float(Decimal(repr(start)) + i * Decimal(repr(step))) for i in range(own.size)]
    assert own.tolist() == exact


def test_a_range_of_the_most_values_is_made():
    count = values.MOST_VALUES
    assert np.array_equal(
        Range(start=0.0, stop=1.0, count=count).array(), np.linspace(0.0, 1.0, count)
    )
