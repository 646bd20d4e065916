"""What every study's table refuses: counts without bounds, values twice, numbers beyond sense.

And that every table, and every key in it, says what it means.
"""

import pytest

from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene, schema
from jaxchain.scenes.registry import studies, study_table
from jaxchain.scenes.scene import Scene

MANY = "1" + "0" * 30


def problems(study, *overrides):
    with pytest.raises(SceneError) as error:
        load_scene(study, overrides)
    return error.value.problems


def whole_numbers(part, definitions, path=""):
    """Every place of a table where a whole number may stand, with its schema."""
    part = definitions.get(part.get("$ref", "").rpartition("/")[2], part)
    if part.get("type") == "integer":
        yield path, part
    # The length of a range is looked at as a whole.
    if part.get("title") == "Range":
        return
    inside = [*part.get("anyOf", []), *part.get("oneOf", []), part.get("items", {})]
    inside += part.get("patternProperties", {}).values()
    more = part.get("additionalProperties")
    inside += [more] if isinstance(more, dict) else []
    for own in filter(None, inside):
        yield from whole_numbers(own, definitions, path)
    for key, own in part.get("properties", {}).items():
        yield from whole_numbers(own, definitions, f"{path}.{key}")


@pytest.mark.parametrize("table", [Scene, *map(study_table, studies())])
def test_every_whole_number_has_a_greatest_value(table):
    whole = table.model_json_schema()
    found = list(whole_numbers(whole, whole.get("$defs", {})))
    assert found
    assert not [key for key, part in found if "maximum" not in part]


@pytest.mark.parametrize("table", [Scene, *map(study_table, studies())])
def test_every_table_and_every_key_says_what_it_means(table):
    whole = schema(table)
    parts = {"": whole, **whole.get("$defs", {})}
    told = {name: part for name, part in parts.items() if "properties" in part}
    assert any(part["properties"] for part in told.values())
    tables = [name for name, part in told.items() if not part.get("description", "").strip()]
    keys = [
        f"{name}.{key}"
        for name, part in told.items()
        for key, own in part["properties"].items()
        if not own.get("description", "").strip()
    ]
    assert not [*tables, *keys], "without a docstring below the attribute, or of the class"


@pytest.mark.parametrize(
    ("study", "override", "problem"),
    [
        ("mistuning", "rtol=1e-300", "rtol: must be at least 1e-15, but is 1e-300"),
        ("mistuning", f"base.masses={MANY}", "base.masses: must be at most 1000, but is"),
        ("mistuning", f"locking.chains={MANY}", "locking.chains: must be at most 100000, but"),
        ("mistuning", "locking.disorder=[0.1,0.1]", "locking.disorder: holds 0.1 more than"),
        ("mistuning", "ensemble.one.belt_speed=[-1.0]", "ensemble.one.belt_speed[0]: must be g"),
        (
            "mistuning", "ensemble.one.chains=100000 ensemble.one.coupling=[0.01,0.02,0.03,0.04]",
            "ensemble.one: would be 5.6e+06 runs of 20 masses (4 couplings x 2 belt speeds x 7",
        ),
        ("mistuning", "locking.window=1e8", "locking.window: would keep 2.7e+11 maxima, and 1e"),
        ("mistuning", "ensemble.locking={}", "ensemble.locking.start: is missing"),
        ("fronts", "rtol=1e-300", "rtol: must be at least 1e-15, but is 1e-300"),
        (
            "fronts", "speed.belt_speed=[-1.0,1.0]",
            "speed.belt_speed: must be greater than 0 throughout, but holds -1",
        ),
        ("fronts", "speed.belt_speed=[1.0,1.0]", "speed.belt_speed: holds 1 more than once"),
        ("fronts", "pinning.coupling=[0.1,0.1]", "pinning.coupling: holds 0.1 more than once"),
        ("fronts", "speed.time=1e300", "speed.time: must be at most 1e+09, but is 1e+300"),
        (
            "fronts", "speed.belt_speed={start=1.0,stop=2.0,count=1000000}",
            "speed: would be 4e+06 runs of 64 masses",
        ),
        ("boundaries", f"coupling.masses={MANY}", "coupling.masses: must be at most 1000, but"),
        ("boundaries", "mu_static.start=0.1", "mu_static.start: must be at least `base.mu_dyn"),
    ],
)  # fmt: skip
def test_what_is_beyond_a_bound_or_stands_twice_is_refused(study, override, problem):
    assert any(found.startswith(problem) for found in problems(study, *override.split(" ")))
