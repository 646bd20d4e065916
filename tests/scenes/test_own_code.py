"""A friction law or an observer of one's own, from a file that is named on the command line."""

import numpy as np
import pytest
from synthetic import stored

from jaxchain import Chain, cli, excited_state, simulate
from jaxchain.model.friction import Coulomb, TanhFriction
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.own_code import load_law, load_observer, make_law, make_observer

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
        ("script.py", "raise SystemExit(0)", "script.py fails: SystemExit: 0"),
        ("mu.csv", "0,1", "is no Python file"),
    ):
        (tmp_path / name).write_text(text, encoding="utf-8")
        with pytest.raises(SceneError, match=problem):
            load_law(f"{tmp_path / name}:Law", "test")


def test_code_that_ends_the_program_is_a_failure(laws, scene, tmp_path, capsys):
    late = laws.with_name("late.py")
    stops = "def coefficient(self, speed):\n        raise SystemExit(0)\n"
    late.write_text(
        "from jaxchain.model import AbstractFrictionLaw\nclass Rational(AbstractFrictionLaw):\n"
        f"    mu_static: float\n    decay: float\n    {stops}",
        encoding="utf-8",
    )
    arguments = ["run", scene, "--output", str(tmp_path / "out"), "--law", f"{late}:Rational"]
    assert cli.main(arguments) == 1
    assert "your own code ended the run (SystemExit: 0)" in capsys.readouterr().err


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
    # The copy of the law is there to be read: it runs only if it is named again.
    again = ["run", str(folder), "--output", str(tmp_path / "again"), "--no-plot", "--quiet"]
    assert cli.main(again) == 2
    assert "so the law must be named on the command line: --law" in capsys.readouterr().err
    assert not (tmp_path / "again").exists()
    assert cli.main([*again, "--law", f"{folder / laws.name}:Rational"]) == 0
    one, other = (stored(tmp_path / name / "own")["pair"] for name in ("results", "again"))
    assert one.equals(other)
    assert (tmp_path / "again" / laws.name).read_text(encoding="utf-8") == LAWS


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
    arguments = ["run", "ladder", "--law", f"{laws}:Rational", "--output", str(tmp_path / "r")]
    assert cli.main(arguments) == 2
    assert "--law: is for scenes, and this is a study" in capsys.readouterr().err


OBSERVERS = """
import jax.numpy as jnp
from jaxchain.observers import AbstractObserver, Variable


class Overtaking(AbstractObserver):
    factor: float = 1.0

    def init(self, field, t0, t1, y0):
        return jnp.zeros_like(y0[0])

    def update(self, accumulator, step):
        faster = step.y1[1] > self.factor * step.field.belt_speed
        return accumulator + jnp.where(faster, step.t1 - step.t0, 0.0)

    def read(self, accumulator):
        return accumulator

    def label(self, value, chain):
        return {"overtaking": Variable(value, ("oscillator",), "1 / omega_n", "time in front")}
"""
OBSERVED = """
title = "A test"

[experiment.pair]
chain = { n = 2, damping_ratio = 0.05, coupling = 0.01, friction = { law = "coulomb", \
mu_dynamic = 0.5, width = 1e-2 } }
initial = { kind = "excited", excited = 1, displacement = 0.0, velocity = 3.0 }
sweep = { belt_speed = [1.0, 2.0] }
time = { transient = 0.5, window = 6.5 }
"""
NAMED = 'observe = {{ others = [{{ observer = "own", name = "Overtaking", {} }}] }}\n'


@pytest.fixture
def observers(tmp_path):
    file = tmp_path / "my_observers.py"
    file.write_text(OBSERVERS, encoding="utf-8")
    return file


def _observed(tmp_path, more=""):
    file = tmp_path / "seen.toml"
    file.write_text(OBSERVED + more, encoding="utf-8")
    return ["run", str(file), "--output", str(tmp_path / "results"), "--no-plot", "--quiet"]


@pytest.mark.parametrize(
    ("more", "factor"),
    [
        pytest.param("", 1.0, id="alone", marks=pytest.mark.long),
        pytest.param(NAMED.format("factor = 1.5"), 1.5, id="named"),
    ],
)
def test_a_scene_has_what_an_own_observer_saw(observers, tmp_path, more, factor):
    arguments = _observed(tmp_path, more)
    assert cli.main([*arguments, "--observer", f"{observers}:Overtaking"]) == 0
    data = stored(tmp_path / "results" / "seen")["pair"]
    assert data.overtaking.dims == ("belt_speed", "oscillator")
    assert data.overtaking.attrs == {"long_name": "time in front", "units": "1 / omega_n"}
    own = make_observer(
        load_observer(f"{observers}:Overtaking", "test"), {"factor": factor}, "observe"
    )
    for speed in (1.0, 2.0):
        chain = Chain(2, TanhFriction(Coulomb(0.5), 1e-2), speed, 0.05, 0.01)
        start = excited_state(chain, 1, amplitude=0.0, velocity=3.0)
        alone = simulate(chain, start, 7.0, observe=own, rtol=1e-6).observed
        np.testing.assert_allclose(data.overtaking.sel(belt_speed=speed), alone, rtol=1e-9)
        assert np.max(alone) > 0.3 or speed * factor == 3.0  # as fast as the kick


@pytest.mark.parametrize(
    ("more", "given", "problem"),
    [
        (
            NAMED.format(""),
            [],
            "observe.others[0].name: is `Overtaking`, so this observer must be",
        ),
        (
            NAMED.format("fcator = 2"),
            ["{}:Overtaking"],
            "observe.others[0].fcator: is no field of Overtaking (did you mean `factor`?)",
        ),
        ("", ["{}:Nothing"], "has no class Nothing; observers there: Overtaking"),
        ("", ["{}:jnp"], "jnp is not a subclass of `jaxchain.observers.AbstractObserver`"),
    ],
)
def test_what_is_wrong_with_an_own_observer_is_said_before_anything_runs(
    observers, tmp_path, capsys, more, given, problem
):
    options = [word for text in given for word in ("--observer", text.format(observers))]
    more = more.replace(",  }", " }")
    assert cli.main([*_observed(tmp_path, more), *options]) == 2
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "results").exists()


def test_a_law_is_no_observer(laws):
    with pytest.raises(SceneError, match=r"--observer .* is not a subclass"):
        load_observer(f"{laws}:Rational", "test")
