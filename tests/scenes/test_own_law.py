"""A friction law of one's own, from a file that is named on the command line."""

import pytest

from jaxchain import cli
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.own_law import load_law, make_law

LAWS = """
import jax.numpy as jnp
from jaxchain.model import AbstractFrictionLaw


class Rational(AbstractFrictionLaw):
    mu_static: float
    decay: float
    lift: float = 0.0

    def coefficient(self, speed):
        return self.lift + (self.mu_static - self.lift) / (1.0 + self.decay * speed)


class Linear(Rational):
    def coefficient(self, speed):
        return self.mu_static - self.decay * speed


class Half(AbstractFrictionLaw):
    mu_static: float


number = 3
"""
SCENE = """
title = "A test"

[experiment.pair]
chain = { n = 2, damping_ratio = 0.05, friction = { law = "own", mu_static = 1.0, decay = 0.5, \
width = 1e-2 } }
initial = { kind = "equation_8" }
sweep = { belt_speed = [1.0], excited = [2], decay = [0.4, 0.5] }
time = { transient = 0.5, window = 6.5 }
"""


@pytest.fixture
def laws(tmp_path):
    file = tmp_path / "my_laws.py"
    file.write_text(LAWS, encoding="utf-8")
    return file


@pytest.fixture
def scene(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(SCENE, encoding="utf-8")
    return str(file)


def test_a_class_of_a_file_is_a_law(laws):
    law = load_law(f"{laws}:Rational", "test")
    assert law.__name__ == "Rational"
    assert make_law(law, {"mu_static": 1.0, "decay": 0.5}).coefficient(2.0) == 0.5
    assert make_law(law, {"mu_static": 1.0, "decay": 0.5, "lift": 0.1}).coefficient(2.0) == 0.55


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ("{}", "must look like FILE.py:CLASS"),
        ("{}:", "must look like FILE.py:CLASS"),
        ("nowhere.py:Rational", "there is no file nowhere.py"),
        ("{}:Ratoinal", "has no class Ratoinal (did you mean `Rational`?); laws there: Rational,"),
        ("{}:number", "number is not a subclass of `jaxchain.model.AbstractFrictionLaw`"),
        ("{}:jnp", "jnp is not a subclass"),
    ],
)
def test_what_is_no_law_is_refused_in_words(laws, given, problem):
    given = given.format(laws)
    with pytest.raises(SceneError) as error:
        load_law(given, "test")
    (found,) = error.value.problems
    assert found.startswith(f'--law "{given}": ')
    assert problem in found


def test_a_file_that_fails_or_is_no_python_is_refused(tmp_path):
    for name, text, problem in (
        ("broken.py", "1 / 0", "fails: ZeroDivisionError: division by zero"),
        ("mu.csv", "0,1", "is no Python file"),
    ):
        (tmp_path / name).write_text(text, encoding="utf-8")
        with pytest.raises(SceneError, match=problem):
            load_law(f"{tmp_path / name}:Law", "test")


@pytest.mark.parametrize(
    ("name", "numbers", "problem"),
    [
        ("Rational", {"mu_static": 1.0}, "chain.friction.decay: is missing, a field of Rational"),
        (
            "Rational",
            {"mu_static": 1.0, "decay": 0.5, "lfit": 0.1},
            r"chain.friction.lfit: is no field of Rational \(did you mean `lift`\?\); its fields:",
        ),
        ("Half", {"mu_static": 1.0}, "Half cannot be made: .*coefficient"),
        ("Linear", {"mu_static": 1.0, "decay": 0.5}, "negative at the speed 2"),
    ],
)
def test_numbers_that_do_not_make_the_law_are_named(laws, name, numbers, problem):
    with pytest.raises(ValueError, match=problem):
        make_law(load_law(f"{laws}:{name}", "test"), numbers)


def test_the_command_runs_a_scene_with_it(laws, scene, tmp_path, capsys):
    folder = tmp_path / "results"
    arguments = ["run", scene, "--output", str(folder), "--no-plot"]
    assert cli.main([*arguments, "--law", f"{laws}:Rational"]) == 0
    assert "Rational" in capsys.readouterr().out
    assert (folder / "own.nc").exists()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], 'chain.friction.law: is "own", so the law must be named on the command line: --law'),
        (["--law", "{}:Linear"], "experiment.pair: Friction law `Linear` is negative at the"),
        (["--law", "{}:Half"], "chain.friction.decay: is no field of Half"),
        (["--law", "{}:Nothing"], "has no class Nothing"),
    ],
)
def test_the_command_says_what_is_wrong_before_it_runs_anything(
    laws, scene, tmp_path, capsys, arguments, problem
):
    folder = tmp_path / "results"
    arguments = [argument.format(laws) for argument in arguments]
    assert cli.main(["run", scene, "--output", str(folder), *arguments]) == 2
    assert problem in capsys.readouterr().err
    assert not folder.exists()


def test_a_study_takes_no_law(laws, tmp_path, capsys):
    arguments = ["run", "boundaries", "--law", f"{laws}:Rational", "--output", str(tmp_path / "r")]
    assert cli.main(arguments) == 2
    assert "--law: is for scenes, and this is a study" in capsys.readouterr().err
