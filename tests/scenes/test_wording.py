"""The words for what is wrong: every key, every missing one, and never more than a screen."""

import pytest

from jaxchain.scenes.errors import MOST_SHOWN, SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.wording import as_written


def error_of(scene, *overrides):
    with pytest.raises(SceneError) as error:
        load_scene(scene, overrides)
    return error.value


def problems(scene, *overrides):
    return error_of(scene, *overrides).problems


def test_what_is_missing_is_told_of_beside_what_is_wrong():
    chain = "experiment.single.chain"
    found = problems(
        "fig3",
        f"{chain}.n=0",
        f"{chain}.friction={{law='coulomb', mu_dynamc=1}}",
        "experiment.single.initial={kind='excited'}",
        "experiment.ladder.chain={}",
        "experiment.ladder.time.windw=3",
        "experiment.ladder.sweep.belt_speed=[1, 1]",
        "experiment.a/b={}",
    )
    told = {line.split(":")[0] for line in found}
    assert {
        f"{chain}.n", f"{chain}.friction.mu_dynamic", f"{chain}.friction.mu_dynamc",
        f"{chain}.friction.width", "experiment.single.initial.excited",
        "experiment.ladder.chain.n", "experiment.ladder.chain.friction",
        "experiment.ladder.time.windw", "experiment.ladder.sweep.belt_speed",
        'experiment."a/b"',
    } <= told  # fmt: skip


@pytest.mark.parametrize(
    ("key", "value", "first", "last"),
    [
        ("chain.coupling", "-1", "coupling[0]: must be at least 0, but is -1",
         "chain.coupling[...]: 99998 more are wrong alike"),
        pytest.param(
            "sweep.belt_speed", "'x'", "belt_speed[0]: must be a number, but is \"x\"",
            "sweep.belt_speed[...]: 99998 more are wrong alike", marks=pytest.mark.long,
        ),
        ("observe.quantities", "'x'", "quantities[0]: must be one of ",
         "observe.quantities[...]: 99998 more are wrong alike"),
    ],
)  # fmt: skip
def test_a_hundred_thousand_wrong_entries_are_three_and_a_count(key, value, first, last):
    key = f"experiment.ladder.{key}"
    error = error_of("quickstart", f"{key}=[{', '.join([value] * 100_001)}]")
    assert len(error.problems) == 4
    assert first in error.problems[0]
    assert last in error.problems[-1]


def test_twenty_thousand_unknown_keys_are_three_and_a_count_and_different_ones_a_screen():
    keys = ", ".join(f"k{i} = 1" for i in range(20_001))
    error = error_of("quickstart", f"experiment.ladder.time={{{keys}}}")
    assert error.problems[-1] == "experiment.ladder.time: 19998 more keys are not known"
    error = error_of("quickstart", f"experiment.ladder.sweep={{{keys}}}")
    assert len(str(error)) < 100_000
    assert len(str(error).splitlines()) == MOST_SHOWN + 2
    assert str(error).endswith("more")


def in_ladder(*overrides):
    return [f"experiment.ladder.{own}" for own in overrides]


def test_what_several_keys_show_is_told_of_beside_what_one_shows():
    found = problems(
        "quickstart",
        *in_ladder(
            "sweep.excited=[0,5]", "chain.n=4", "time.windw=3", "observe.stop='early'",
            "numerics.rtol=2",
        ),
    )  # fmt: skip
    told = {line.split(":")[0].removeprefix("experiment.ladder.") for line in found}
    assert told == {"sweep.excited", "time.windw", "observe.stop", "numerics.rtol"}
    found = problems("quickstart", *in_ladder("chain.coupling=[0.1,0.1]", "time.windw=3"))
    assert found[0].startswith("experiment.ladder.chain.coupling: must be one number or 6 in a li")
    assert found[1].startswith("experiment.ladder.time.windw: is not a known key")


@pytest.mark.parametrize("values", ["[0.0, 1.0]", "[-1.0]", "[-1, 0]"])
def test_a_swept_stiffness_that_has_no_period_is_refused(values):
    (found,) = problems("quickstart", f"experiment.ladder.sweep.stiffness={values}")
    assert found.startswith("experiment.ladder.sweep.stiffness: must be greater than 0 throughou")


@pytest.mark.parametrize(
    ("scene", "override", "said"),
    [
        ("fig3", "experiment.ladder.time.WINDOW=9", "time.WINDOW: is not a known key (did you me"),
        (
            "fig3", "experiment.ladder.sweep={law='x', observer=[1], Width={}}",
            "sweep.law: must be a list or a range table, but is \"x\"",
        ),
        ("fig3", "experiment.ladder.chain.friction.law=[1]", "law: must be one of \"expon"),
    ],
)  # fmt: skip
def test_an_error_names_the_key_its_value_and_what_is_allowed(scene, override, said):
    assert said in "\n".join(problems(scene, override))


def test_an_error_is_printable_and_short_whatever_the_file_holds():
    error = error_of("quickstart", "a\x1b[31mb=1", f"title={'[' * 9}{']' * 9}", f"{'k' * 999}=1")
    text = str(error)
    assert text.replace("\n", "").isprintable()
    assert '"a\\x1b[31mb": is not a known key' in text
    assert f"{'k' * 80}... (999 characters): is not a known key" in text
    assert len(text) < 2000


def test_values_are_shown_as_they_are_written_unless_they_are_long():
    assert as_written(10**39) == str(10**39)
    assert as_written(-(10**40)) == "a whole number of 41 digits"
    assert as_written(2**20000) == "a whole number of 6021 digits"
    assert as_written("x" * 100) == f'"{"x" * 80}... (100 characters)"'
    assert as_written("\x00") == '"\\x00"'
    assert as_written(5e-324) == "5e-324"
