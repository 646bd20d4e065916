"""A custom friction law, model or observer, from a file that is named on the command line."""

import shutil
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import recorded_sweep, stored

from jaxchain import Amplitude, StickTime, cli, steady_sliding
from jaxchain.model import Contact, MechanicalCells, Stop, drives
from jaxchain.model.friction import Coulomb, StaticKinetic, TanhFriction
from jaxchain.model.ready_made import BurridgeKnopoff
from jaxchain.scenes import running
from jaxchain.scenes.building import Custom, build, load_law, load_model, load_observer
from jaxchain.scenes.files import SceneError
from jaxchain.scenes.scene import load_scene

CODE = """
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


class Ends(Rational):
    def coefficient(self, speed):
        raise SystemExit(0)


number = 3
"""
SCENE = """
title = "A test"

[experiment.pair]
chain = { n = 2, damping_ratio = 0.05, friction = { law = "custom", mu_static = 1.0, decay = 0.5, \
width = 1e-2 } }
initial = { kind = "equation_8" }
sweep = { belt_speed = [1.0], excited = [2], decay = [0.4, 0.5] }
time = { transient = 0.5, window = 6.5 }
"""


@pytest.fixture
def laws(tmp_path):
    file = tmp_path / "my_laws.py"
    file.write_text(CODE, encoding="utf-8")
    return file


@pytest.fixture
def scene(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(SCENE, encoding="utf-8")
    return str(file)


def built(scene, *changes, **custom) -> Any:
    """The parts of the only experiment of a scene with these changes."""
    (name,) = load_scene(scene).scene.experiment
    loaded = load_scene(scene, [f"experiment.{name}.{text}" for text in changes])
    return build(loaded, Custom(**custom))[name]


def differences(table, scene, **custom):
    """Of lines "change -> part of the message" those whose refusal does not say this."""
    wrong = []
    for line in table.strip().splitlines():
        change, _, problem = line.partition(" -> ")
        with pytest.raises(SceneError) as error:
            built(scene, *change.split(" & "), **custom)
        found = "\n".join(error.value.problems)
        if problem not in found or "\nexperiment." not in f"\n{found}":
            wrong.append(f"{change}: {found}")
    return wrong


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ("{}", "must look like FILE.py:CLASS"),
        ("{}:Ratoinal", "has no class Ratoinal (did you mean `Rational`?); it has: Rational,"),
        ("{}:number", "number is not a subclass of `jaxchain.model.AbstractFrictionLaw`"),
        ("broken.py:Law", "fails: ZeroDivisionError: division by zero"),
        ("script.py:Law", "script.py fails: SystemExit: 0"),
    ],
)
def test_what_is_no_law_is_refused_in_words(laws, given, problem, monkeypatch):
    monkeypatch.chdir(laws.parent)
    for name, text in ("broken.py", "1 / 0"), ("script.py", "raise SystemExit(0)"):
        Path(name).write_text(text, encoding="utf-8")
    given = given.format(laws)
    with pytest.raises(SceneError) as error:
        load_law(given, "test")
    (found,) = error.value.problems
    assert found.startswith(f'--law "{given}": ')
    assert problem in found


@pytest.fixture
def calls(monkeypatch):
    """The arguments of every sweep, which computes nothing."""
    calls = []
    monkeypatch.setattr(running, "sweep", recorded_sweep(calls))
    return calls


def test_the_command_runs_a_scene_with_it(laws, scene, tmp_path, capsys, calls, monkeypatch):
    folder = tmp_path / "results"
    arguments = ["run", scene, "--output", str(folder), "--no-plot"]
    assert cli.main([*arguments, "--law", f"{laws}:Rational"]) == 0
    # The copy of the law is there to be read: it runs only if it is named again.
    again = ["run", str(folder), "--output", str(tmp_path / "again"), "--no-plot", "--quiet"]
    assert cli.main(again) == 2
    assert "so the law must be named on the command line: --law" in capsys.readouterr().err
    assert not (tmp_path / "again").exists()
    assert cli.main([*again, "--law", f"{folder / laws.name}:Rational"]) == 0
    for call in calls:
        assert str(call["chain"].law) == "Rational(mu_static=1, decay=0.4, lift=0)"
        assert call["over"]["decay"].tolist() == [0.4, 0.5]
    assert (tmp_path / "again" / laws.name).read_text(encoding="utf-8") == CODE
    monkeypatch.undo()  # a law whose code ends the program is a failure
    assert cli.main([*arguments, "--law", f"{laws}:Ends"]) == 1
    assert "your own code ended the run (SystemExit: 0)" in capsys.readouterr().err


WRONG_LAWS = """
chain.friction={law='custom',width=1,mu_static=1,decay=1,lfit=1} -> lfit: is not a field of \
Rational (did you mean `lift`?); its fields: mu_static
chain.friction={law='custom',width=1,decay=1} -> mu_static: is missing
"""


def test_what_is_wrong_with_a_law_is_said_before_anything_runs(laws, scene):
    kinds = {name: load_law(f"{laws}:{name}", "test") for name in ("Rational", "Linear")}
    assert not differences(WRONG_LAWS, scene, law=kinds["Rational"])
    below = "time.window=7 -> chain.friction: Friction law `Linear` is negative at the speed 2"
    assert not differences(below, scene, law=kinds["Linear"])


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
OBSERVED = "observe.others=[{{observer='custom',name='Overtaking'{}}}]"


def test_a_scene_is_observed_by_an_own_observer(scene, laws, tmp_path, calls):
    file, folder = tmp_path / "my_observers.py", tmp_path / "results"
    file.write_text(OBSERVERS, encoding="utf-8")
    change = f"--set=experiment.pair.{OBSERVED.format(', factor=1.5')}"
    named = ["--observer", f"{file}:Overtaking", "--law", f"{laws}:Rational"]
    arguments = ["run", scene, change, "--output", str(folder), "--no-plot", "--quiet", *named]
    assert cli.main(arguments) == 0
    usual, own = calls[0]["observe"]
    assert [type(one).__name__ for one in (usual, own)] == ["Amplitude", "Overtaking"]
    assert float(own.factor) == 1.5
    assert (folder / file.name).exists()
    given: dict[str, Any] = {"law": load_law(f"{laws}:Rational", "test")}
    problem = "others[0].name: is `Overtaking`, so this observer must be"
    assert not differences(f"{OBSERVED.format('')} -> {problem}", scene, **given)
    given["observers"] = {"Overtaking": load_observer(f"{file}:Overtaking", "test")}
    problem = "fcator: is not a field of Overtaking (did you mean `factor`?)"
    assert not differences(f"{OBSERVED.format(',fcator=2')} -> {problem}", scene, **given)


def test_every_solver_of_a_scene_exists():
    for name in ("Rodas5P", "Bosh3", "Tsit5", "Dopri5", "Dopri8", "Kvaerno3", "Kvaerno5"):
        methods = built("quickstart", f"numerics.solver={name}", "numerics.rtol=1e-7").methods
        assert type(methods["smoothed"].solver).__name__ == name


@pytest.mark.parametrize(
    ("initial", "displacements", "velocity"),
    [
        ('{ kind = "equation_8", excited = 2 }', [0, 2, -2], 0),
        ('{ kind = "equation_10", excited = 2, block = "centred" }', [-2, 2, 0], 0.56),
        ('{ kind = "excited", excited = 3, pattern = "in-phase", velocity = 0.1 }', [2] * 3, 0.1),
    ],
)
def test_initial_states_are_those_asked_for(initial, displacements, velocity):
    changes = ["chain.n=3", f"initial={initial}", "sweep={belt_speed=[1.0]}"]
    parts = built("quickstart", *changes)
    x, v = parts.initial(parts.model)
    np.testing.assert_allclose(x - steady_sliding(parts.model)[0], displacements, atol=1e-15)
    np.testing.assert_array_equal(v, np.full(3, velocity))


def test_masses_of_observers_are_counted_from_one():
    section = "{observer='Section',oscillator=2}"
    track = "{observer='FrontTrack',windows=2,middle=2}"
    samples = "{observer='Samples',interval=1,capacity=2,oscillators=[3]}"
    reset = "chain.n=3", "initial={kind='equation_8',excited=1}", "sweep={belt_speed=[1.0]}"
    parts = built("quickstart", *reset, f"observe.others=[{section},{samples},{track}]")
    _, at, seen, front = parts.observe
    assert (at.oscillator, seen.oscillators, front.middle) == (1, (2,), 1)


CELLS = """
import jax
from jaxchain.model import AbstractCells


class TwoModes(AbstractCells):
    friction: jax.Array
    stiffness: jax.Array
    cubic: jax.Array = 1.0
    components = ("x", "y", "x'", "y'")

    def rate(self, t, left, own, right):
        x, y, vx, vy = own
        pull = 0.05 * (left[0] - 2 * x + right[0]) - self.cubic * x**3
        return vx, vy, pull - self.stiffness * x - (0.5 - self.friction) * y, -0.5 * x - y


class LuGre(TwoModes):
    pass
"""
MODES = """
title = "Two modes"

[experiment.modes]
model = { kind = "TwoModes", n = 2, stiffness = [2.0, 2.5] }
initial = { x = [0.5, 0.1], 1 = 0.2 }
sweep = { friction = [0.5, 1.5], x = [0.3] }
time = { transient = 8.0, window = 7.0 }
observe = { component = "y" }
numerics = { store = true, lanes = 2 }
"""


@pytest.fixture
def modes(tmp_path):
    """The file of the classes, and that of the scene."""
    code, scene = tmp_path / "my_cells.py", tmp_path / "modes.toml"
    code.write_text(CELLS, encoding="utf-8")
    scene.write_text(MODES, encoding="utf-8")
    return code, str(scene)


def test_a_scene_of_ones_own_cells_is_the_sweep_of_them(modes, tmp_path, monkeypatch):
    code, scene = modes
    calls, folder = [], tmp_path / "results"

    def sweep(*arguments, **options):
        calls.append((arguments, options))
        assert (folder / "my_cells.py").read_text(encoding="utf-8") == CELLS
        assert load_scene(str(folder)).scene == load_scene(scene).scene
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "sweep", sweep)
    arguments = ["run", scene, "--output", str(folder), "--model", f"{code}:TwoModes"]
    assert cli.main(arguments) == 130
    (((cells, start, t1), how),) = calls
    assert str(cells) == "TwoModes(friction=0.5, stiffness=[2, 2.5], cubic=1)"
    np.testing.assert_array_equal(start(cells, x=0.3), [[0.3] * 2, [0.2] * 2, [0, 0], [0, 0]])
    assert how["over"]["friction"].tolist() == [0.5, 1.5]
    (amplitude,) = how["observe"]
    assert (amplitude.window, amplitude.component, t1) == (7.0, 1, 15.0)
    assert (how["lanes"], how["method"].rtol, how["store"].name) == (2, 1e-6, "modes.modes.zarr")


WRONG_CELLS = """
model.kind='Paris' -> model.kind: is `Paris`, so this class must be named on the
model.kind='LuGer' -> FILE.py:LuGer (did you mean `LuGre`?); ready-made are
model.cubc=2 -> model.cubc: is not a field of TwoModes (did you mean `cubic`?); its fields:
model.stiffness=[1, 2, 3] -> model.stiffness: must be one number or 2 in a list
model.friction={law='coulomb'} -> model.friction.mu_dynamic: is missing: give it here
initial.z=1 -> initial.z: is not a number of a cell; it has: 0, 1, 2, 3, x, y, x', y'
initial.y=1 -> initial.y: is given twice, by name and by number: leave one out
sweep.frictoin=[1] -> sweep.frictoin: is neither a number of the chain nor
observe.component='z' -> observe.component: is not a number of a cell; it has: 0, 1
observe.stop='quiet' -> observe.stop: must be "never" or "steady", but is "quiet", which needs a
observe.others=[{observer='StickTime'}] -> observe.others[0]: `StickTime` needs masses
observe.others=[{observer='Section',oscillator=3}] -> must lie in 1 ... 2 (`n`)
numerics.model='dry' -> numerics.model: The event-driven solver needs a `Chain`, or `Mechanical
"""


def test_what_cells_cannot_have_is_refused_with_its_key(modes):
    code, scene = modes
    kinds = {name: load_model(f"{code}:{name}", "test") for name in ("TwoModes", "LuGre")}
    two = {"TwoModes": kinds["TwoModes"]}
    assert not differences(WRONG_CELLS, scene, models=two)
    with pytest.raises(SceneError, match="--model: LuGre is a ready-made class"):
        build(load_scene(scene), Custom(models=kinds))
    with pytest.raises(SceneError, match=r'no experiment has `model.kind` = "TwoModes"'):
        built("quickstart", models=two)


def test_ready_made_cells_are_made_from_their_tables(modes):
    friction = "{law='coulomb', mu_dynamic=0.5, width=0.1}"
    table = (
        f"model={{kind='BurridgeKnopoff', n=2, speed=[0.1,0.2], ends='free', friction={friction}}}"
    )
    reset = "initial={stretch=0.1}", "sweep={width=[0.2, 0.3], coupling=[2]}", "observe={}"
    parts = built(modes[1], table, *reset)
    made, start = parts.model, parts.initial
    smoothed = TanhFriction(Coulomb(0.5), 0.2)
    wanted = BurridgeKnopoff(smoothed, jnp.array([0.1, 0.2]), coupling=2.0, ends="free")
    assert str(made) == str(wanted)
    np.testing.assert_array_equal(start(made), [[0.1, 0.1], [0.0, 0.0]])
    numbers = "mass=1,stiffness=1,speed=1,normal_stress=1,direct_effect=1,evolution_effect=1"
    more = "slip_length=1,reference_friction=0,law='slip'"
    table = f"model={{kind='RateAndState', n=2, {numbers}, {more}}}"
    peaks = "{observer='PeakTimes', component='log velocity'}"
    sweep_ = "sweep={component_1=[0.5]}", f"observe={{component='log age', others=[{peaks}]}}"
    parts = built(modes[1], table, "initial={'log velocity'=2}", *sweep_)
    cells, start, (amplitude, times) = parts.model, parts.initial, parts.observe
    assert (cells.law, amplitude.component, times.component) == ("slip", 2, 1)
    np.testing.assert_array_equal(start(cells)[1], [2.0, 2.0])
    np.testing.assert_array_equal(start(cells, component_1=0.5)[1], [0.5, 0.5])


BLOCKS = """
title = "Two blocks on a third one, on a belt that goes to and fro"

[experiment.blocks.model]
kind = "MechanicalCells"
stiffness = [[2.0, -0.3, -0.2], [-0.3, 1.1, 0.0], [-0.2, 0.0, 1.4]]
mass = [2.0, 0.8, 0.7]
damping = 0.02
names = ["a", "b", "c"]
force = { file = "push.csv", period = 9.0 }
plus = { softer = [[0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]] }

[[experiment.blocks.model.contacts]]
direction = [1, 0, 0]
friction = { law = "static_kinetic", mu_static = 0.5, mu_kinetic = 0.3 }
normal_load = 3.0
belt_speed = { t = [0.0, 5.0, 9.0], values = [0.4, 0.6, 0.4], period = 9.0, kind = "linear" }

[[experiment.blocks.model.contacts]]
direction = [-1, 1, 0]
friction = { law = "static_kinetic", mu_static = 0.4, mu_kinetic = 0.25 }

[[experiment.blocks.model.stops]]
direction = [0, 0, 1]
gap = 0.2
restitution = 0.5

[experiment.blocks.initial]
b = 0.1

[experiment.blocks.sweep]
"contacts[1].normal_load" = [0.8, 1.2]
"stops[0].restitution" = [0.5, 0.9]
softer = [0.3]

[experiment.blocks.time]
transient = 2.0
window = 4.0

[experiment.blocks.observe]
component = "b"
others = [{ observer = "StickTime", contact = 1 }]
"""
PUSH = [[0.0, 0.5, 0.4], [0.1, -0.5, 0.3], [0.0, 0.2, -0.4]]


def blocks() -> MechanicalCells:
    """The model of the scene, with the first of its swept loads, in Python."""
    belt = drives.Table([0.0, 5.0, 9.0], [0.4, 0.6, 0.4], 9.0, "linear")
    contacts = [
        Contact((1, 0, 0), StaticKinetic(0.5, 0.3), 3.0, belt),
        Contact((-1, 1, 0), StaticKinetic(0.4, 0.25), 0.8),
    ]
    return MechanicalCells(
        [[2.0, -0.3, -0.2], [-0.3, 1.1, 0.0], [-0.2, 0.0, 1.4]], mass=[2.0, 0.8, 0.7],
        damping=0.02, names=["a", "b", "c"], force=drives.Table([0.0, 3.0, 6.0], PUSH, 9.0),
        plus={"softer": jnp.diag(jnp.array([0.1, 0.0, 0.0]))}, contacts=contacts,
        stops=[Stop((0, 0, 1), 0.2, 0.5)], n=1,
    )  # fmt: skip


@pytest.fixture
def blocks_scene(tmp_path):
    rows = [f"{t}, {', '.join(map(str, row))}" for t, row in zip((0, 3, 6), PUSH, strict=True)]
    (tmp_path / "push.csv").write_text("\n".join(["time, a, b, c", *rows]), encoding="utf-8")
    file = tmp_path / "blocks.toml"
    file.write_text(BLOCKS, encoding="utf-8")
    return str(file)


def test_a_scene_of_cells_with_contacts_and_stops_is_the_sweep_of_that_model(
    blocks_scene, tmp_path, calls
):
    folder = tmp_path / "results"
    arguments = ["run", blocks_scene, "--output", str(folder), "--no-plot", "--quiet"]
    assert cli.main(arguments) == 0
    # The copy of the scene needs no file of the signal.
    (tmp_path / "push.csv").unlink()
    kept = load_scene(str(folder)).scene.experiment["blocks"].cells.force
    assert (kept.file, kept.values) == (None, PUSH)
    shutil.rmtree(folder / "blocks.zarr")
    assert cli.main(["resume", str(folder), "--no-plot", "--quiet"]) == 0
    start = [[0.0], [0.1], [0.0], [0.0], [0.0], [0.0]]
    for call in calls:
        assert eqx.tree_equal(call["chain"], blocks())
        np.testing.assert_array_equal(call["initial"](call["chain"]), start)
        assert {name: values.tolist() for name, values in call["over"].items()} == {
            "contacts[1].normal_load": [0.8, 1.2],
            "stops[0].restitution": [0.5, 0.9],
            "softer": [0.3],
        }
        assert call["observe"] == [Amplitude(window=4.0, component=1), StickTime(contact=1)]
        method = call["method"]
        assert (method.rtol, method.max_step, call["t1"]) == (1e-6, 0.5, 6.0)
    assert len(calls) == 2
    assert stored(folder / "blocks")["blocks"].attrs["model"] == "dry"


def test_a_width_smooths_the_friction_of_contacts(blocks_scene):
    law = "friction={law='coulomb',mu_dynamic=0.3,width=0.1}"
    table = f"model.contacts=[{{direction=[1,0,0],{law}}}]"
    over = "model.stops=[{direction=[1,0,0],gap=9}]", "sweep={'contacts[0].width'=[0.2,0.3]}"
    with pytest.raises(SceneError, match=r"model\.stops: needs dry friction"):
        built(blocks_scene, table, *over)
    head, _, tail = BLOCKS.partition("[[experiment.blocks.model.stops]]")
    text = head + tail[tail.index("[experiment.blocks.initial]") :]
    Path(blocks_scene).write_text(text, encoding="utf-8")
    more = "observe.others=[{observer='PeakTimes'}]", "numerics.model=both"
    parts = built(blocks_scene, table, over[1], *more)
    assert float(parts.model.contacts[0].width) == 0.2
    assert not parts.methods["smoothed"].dry
    assert parts.methods["dry"].dry


WRONG_BLOCKS = """
model.contacts=[{direction=[1,0],friction={law='coulomb',mu_dynamic=0.3}}] -> model.contacts[0]\
.direction: must have an entry for each of the 3 displacements
model.contacts=[{direction=[1,0,0],friction={law='coulomb',mu_dynamic=0.3},normal_load=-1}] & \
observe.others=[{observer='PeakTimes'}] -> contacts[0].normal_load: must be zero or positive, and
model.mass=[[1,0],[0,1]] -> model.mass: must be one number, or of shape (3,), (3, 3)
model.force={file='x.csv'} -> model.force: has a `file` that cannot be read
model.force={file='blocks.toml'} -> must be numbers, a time and its values, but is
model.plus={x={mas=1}} -> model.plus.x: must be the matrix that is added to
sweep={'contacts[1].normal_lod'=[1]} -> sweep."contacts[1].normal_lod": is neither a number of
sweep={'contacts[1].normal_load'=[-1]} -> sweep."contacts[1].normal_load": must be zero or positive
sweep={width=[0.1]} -> sweep.width: has dry friction, but this is for smoothed
numerics.model=both -> numerics.model: must be "dry": no friction has a `width`
numerics.solver=Tsit5 -> numerics.solver: is a Tsit5, but `model` has dry friction
observe.others=[{observer='StickTime',contact=2}] -> contact: = 2 must be less than
"""


def test_what_contacts_and_drives_cannot_be_is_refused_with_its_key(blocks_scene):
    assert not differences(WRONG_BLOCKS, blocks_scene)
