"""Scene files: the right ones are accepted, the wrong ones refused by key, value and remedy."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from pydantic import TypeAdapter, ValidationError

from jaxchain.scenes import tables
from jaxchain.scenes.building import build
from jaxchain.scenes.files import MOST_SHOWN, SceneError, builtin_scenes
from jaxchain.scenes.scene import load_scene, schema
from jaxchain.scenes.tables import Range

SCENE = """
title = "A test"

[experiment.pair]
chain = { n = 4, damping_ratio = 0.05, coupling = 0.01, friction = { law = "exponential_decay", \
mu_static = 1.0, mu_dynamic = 0.5, v_ref = 0.5, width = 1e-2 } }
initial = { kind = "equation_8" }
sweep = { belt_speed = { start = 1.0, stop = 1.3, step = 0.1 }, excited = [0, 2] }
time = { transient = 50.0, window = 20.0 }

[experiment.pair.observe]
stop = "quiet"
"""
PAIR = "experiment.pair."


@pytest.fixture
def scene_file(tmp_path):
    file = tmp_path / "test.toml"
    file.write_text(SCENE, encoding="utf-8")
    return str(file)


def error_of(scene_file, *overrides):
    """What is refused as the scene is read, or as its parts are built, before anything runs."""
    with pytest.raises(SceneError) as error:
        build(load_scene(scene_file, overrides))
    return error.value


def test_a_scene_is_named_after_its_file_and_swept_in_its_order(scene_file):
    loaded = load_scene(scene_file)
    experiment = loaded.scene.experiment["pair"]
    assert loaded.name == "test"
    assert list(experiment.grid()) == ["belt_speed", "excited"]
    assert experiment.grid()["belt_speed"].tolist() == [1.0, 1.1, 1.2, 1.3]
    assert experiment.grid()["excited"].dtype == int
    assert experiment.lanes() == 8


@pytest.mark.parametrize("name", builtin_scenes())
def test_every_built_in_scene_is_valid_and_so_is_a_copy_of_it(name, tmp_path):
    loaded = load_scene(name)
    copy = tmp_path / "my.own.toml"
    copy.write_text(builtin_scenes()[name].read_text(encoding="utf-8"), encoding="utf-8")
    again = load_scene(str(copy))
    assert (again.scene, loaded.name, again.name) == (loaded.scene, name, "my.own")


def test_fig3_holds_the_experiment_of_the_paper():
    ladder: Any = load_scene("fig3").scene.experiment["ladder"]
    assert ladder.grid()["belt_speed"].tolist() == [round(1 + 0.05 * i, 2) for i in range(19)]
    assert ladder.grid()["excited"].tolist() == list(range(21))
    assert ladder.time.transient == 10000
    assert (ladder.chain.n, ladder.chain.coupling, ladder.chain.damping_ratio) == (20, 0.01, 0.05)
    numbers = {"mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5, "width": 1e-3}
    assert ladder.chain.friction.model_dump() == {"law": "exponential_decay", **numbers}


# What is changed, and the beginning of what is reported.
MISTAKES = r"""
chain.damping=0.1 -> chain.damping: is not a known key (did you mean `damping_ratio`?)
chain.n=0 -> chain.n: must be at least 1, but is 0
chain.damping_ratio=-5e-324 -> chain.damping_ratio: must be 0 or at least 1e-15 in siz
chain.coupling=[1,1,1,-1] -> chain.coupling[3]: must be at least 0, bu
chain.ends=open -> chain.ends: must be 'cyclic' or 'free', but is "open"
chain.friction.law=tanh -> chain.friction.law: must be one of "exponential_decay", "
sweep.belt_speed=1.5 -> sweep.belt_speed: must be a list or a range table, but is 1.5
sweep.belt_speed=[] -> sweep.belt_speed: List should have at least 1 item
sweep.belt_speed=[1,2,1] -> sweep.belt_speed: holds 1.0 more than once
sweep.belt_speed.stop=0.5 -> sweep.belt_speed: is empty: a step of 0.1 does not lead fr
sweep.belt_speed={start=1.0,stop=0.4,step=-0.7} -> sweep.belt_speed: has a step of -0.7
sweep.belt_speed={start=1,stop=1,count=2} -> sweep.belt_speed: has two equal ends: `cou
sweep.belt_speed.step=1e-9 -> sweep.belt_speed: would be 3e+08 values, and 1000000 are
observe.stop=early -> observe.stop: must be 'never', 'quiet' or 'steady', but is "earl
observe.others=[{observer="PeakTimes",start=1,capacty=2}] -> observe.others[0].capacty: is not a k
description="a\u0007" -> description: must not hold the character '\x07', which
chain.damping_ratio=[0.1] -> chain.damping_ratio: must be one number or one per mass, of shape (4,)
chain.friction={law="exponential_decay",mu_static=1,mu_dynamic=0,v_ref=1} -> chain.friction.width:
chain.friction.mu_static=0.4 -> chain.friction.mu_static: must be at least `mu_dynamic`
chain.n=100_000_000 -> observe: would keep 8e+08 numbers of 8 runs
initial={kind="excited",oscillators=[1,5]} -> initial.oscillators: must lie in 1 ... 4 (`n`), but i
sweep.excited=[0,5] -> sweep.excited: must lie in 0 ... 4, but is 5
sweep.width=[0.01,0] -> sweep.width: must be positive and finite, but is 0.0: 1e-3 is usual
sweep.mu_dynamic=[2] -> chain.friction.mu_static: must be at least `mu_dynamic` = 2.0, bu
sweep.wdith=[1] -> sweep.wdith: is neither a number of the chain nor a parameter of `initial` or `v
time.window=3 -> time.window: must hold at least one period, 6.283, but is 3
observe.others=[{observer="Divergence"},{observer="Section",oscillator=5}] -> observe.others[1].os
observe.others=[{observer='Divergence'},{observer='Divergence'}] -> observe: holds `Divergence`, wh
observe.others=[{observer='FrontTrack',windows=7}] -> observe.others[0].windows: would be parts of
chain.friction={law="tabulated",file="nu.csv",width=1} -> chain.friction: has a `file` t
chain.friction={law="tabulated",speed=[0.1,1],mu=[1,0.5],width=1} -> chain.friction: Arguments `spe
chain.n=1 -> chain.coupling: must be left out: a single mass (`n` = 1)
model={kind="LuGre",n=2} -> chain: cannot stand beside `model`
initial={excited=1} -> initial.kind: must be one of "equation_8", "equation_10", "excited", but is
initial={kind="excited",oscillators=[1,2],excited=1} -> initial.oscillators: cannot stand beside `e
observe.others=[{observer="StickTime",window=1000}] -> observe.others[0]: holds `StickTime(window=1
chain.friction={law="gaussian_stribeck",width=1,mu_static=1,mu_dynamic=0.5,v_ref=1} -> chain.frict
"""


def test_a_mistake_is_reported_with_key_value_and_allowed_values(scene_file):
    wrong = []
    for mistake in MISTAKES.strip().splitlines():
        override, _, problem = mistake.partition(" -> ")
        found = error_of(scene_file, PAIR + override).problems
        wrong += [] if len(found) == 1 and found[0].startswith(PAIR + problem) else [found]
    assert not wrong


def test_a_table_of_friction_is_read_beside_the_scene_and_kept_with_its_results(scene_file):
    Path(scene_file).with_name("mu.csv").write_text("s,mu\n0,1\n2,0.5\n", encoding="utf-8")
    law = f'{PAIR}chain.friction={{law="tabulated",file="mu.csv",width=0.1}}'
    experiment: Any = load_scene(scene_file, [law]).scene.experiment["pair"]
    friction: Any = experiment.chain.friction
    assert (friction.speed, friction.mu, friction.file) == ([0.0, 2.0], [1.0, 0.5], None)
    assert '"speed":[0.0,2.0],"mu":[1.0,0.5]' in experiment.model_dump_json()


def test_all_mistakes_are_reported_at_once(scene_file):
    error = error_of(scene_file, PAIR + "chain.n=0", PAIR + "time.windw=3", "titel=3", "title=3")
    assert {line.split(":")[0] for line in error.problems} == {
        "title", "experiment.pair.chain.n", "experiment.pair.time.windw", "titel",
    }  # fmt: skip
    assert str(SceneError("a", ["b: c", "d"])) == "scene a has 2 errors:\n  b: c\n  d"


def test_a_billion_runs_are_refused_at_once_and_with_a_remedy(scene_file):
    many = "{start=0.1,stop=1.0,count=1000}"
    sweeps = [f"{PAIR}sweep.{name}={many}" for name in ("belt_speed", "damping_ratio", "width")]
    started = time.perf_counter()
    (message,) = error_of(scene_file, *sweeps, f"{PAIR}numerics.store=false").problems
    assert time.perf_counter() - started < 1
    begins = "experiment.pair.sweep: is 2e+09 runs (1000 belt_speed x 2 excited x "
    assert message.startswith(begins)
    assert "take fewer values" in message


def test_a_store_takes_a_billion_runs_and_is_used_for_thousands(scene_file):
    many = "{start=0.1,stop=1.0,count=1000}"
    speeds, damping = f"{PAIR}sweep.belt_speed={many}", f"{PAIR}sweep.damping_ratio={many}"

    def experiment(*overrides):
        loaded = load_scene(scene_file, overrides)
        one = loaded.scene.experiment["pair"]
        return one.lanes(), one.stored(), build(loaded)["pair"].fits_memory

    assert experiment(speeds) == (2000, False, True)
    assert experiment(speeds, damping, f"{PAIR}sweep.width={many}") == (2 * 10**9, True, False)
    for count, stored in ((512, False), (513, True)):
        ratios = f"{PAIR}sweep.damping_ratio={{start=0.01,stop=0.1,count={count}}}"
        assert experiment(ratios)[1] == stored
    peaks = f"{PAIR}observe.others=[{{observer='PeakTimes',capacity=1000000}}]"
    (message,) = error_of(scene_file, speeds, peaks).problems
    assert "observe.others[0]: would keep 8e+09 numbers of 2000 runs of 4 masses" in message


def test_experiments_have_names_of_groups_that_do_not_meet(scene_file):
    adapter = TypeAdapter(tables.Name)
    assert adapter.validate_python("x-1_B") == "x-1_B"
    for name in ["../../../esc", "a/b", "", "..", "-x", "a b", "ü", "x" * 65, "a\n", "_x"]:
        with pytest.raises(ValidationError):
            adapter.validate_python(name)
    table = SCENE.partition("[experiment.pair]")[2]
    for ending, message in (("dry", "runs of the other model"), ("cycles", "cycles")):
        second = table.replace("[experiment.pair.", f"[experiment.pair_{ending}.")
        text = f"{SCENE}[experiment.pair_{ending}]{second}"
        Path(scene_file).write_text(text, encoding="utf-8")
        assert f"is where the {message} of `pair` may go: rename it" in str(error_of(scene_file))


@pytest.mark.parametrize(
    ("given", "values"),
    [
        ({"start": 1.0, "stop": 1.3, "step": 0.05}, [1.0, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3]),
        ({"start": 1.0, "stop": 1.14, "step": 0.05}, [1.0, 1.05, 1.1]),
        ({"start": 0.3, "stop": 0.1, "step": -0.1}, [0.3, 0.2, 0.1]),
        ({"start": 0.0, "stop": 1.0, "count": 3}, [0.0, 0.5, 1.0]),
    ],
)
def test_a_range_holds_exactly_the_decimals_one_would_write(given, values):
    assert Range.model_validate(given).array().tolist() == values


def test_the_schema_has_the_fields_of_the_classes_without_null_and_python():
    text, parts = json.dumps(schema()), schema()["$defs"]
    assert "null" not in text
    assert ">>>" not in text
    for kind in (*tables.LAWS.values(), *tables.READY_MADE.values(), *tables.OBSERVERS.values()):
        keys = parts[f"{kind.__name__}Table"]["properties"]
        functions = {name for name, of in get_type_hints(kind).items() if "Callable" in str(of)}
        assert {field.name for field in dataclasses.fields(kind)} - functions <= set(keys)
        assert not functions & set(keys)  # a scene contains no code
        assert all(key.get("description") or name == "ends" for name, key in keys.items())
    bristles = parts["LuGreTable"]["properties"]["bristle_stiffness"]
    assert (bristles["default"], bristles["description"]) == (1e5, "sigma0")


def test_a_model_of_kind_chain_is_the_same_as_a_chain(scene_file):
    text = SCENE.replace("chain = { n", 'model = { kind = "Chain", n')
    Path(scene_file).with_name("other.toml").write_text(text, encoding="utf-8")
    other = build(load_scene(str(Path(scene_file).with_name("other.toml"))))["pair"]
    one = build(load_scene(scene_file))["pair"]
    assert str(one.model) == str(other.model)
    assert (one.observe, one.variables) == (other.observe, other.variables)


def test_thousands_of_mistakes_are_a_screen(scene_file):
    keys = ", ".join(f"k{i} = 1" for i in range(2001))
    values = ", ".join(["-1"] * 10_001)
    for wrong in (f"time={{{keys}}}", f"chain.coupling=[{values}]"):
        error = error_of(scene_file, PAIR + wrong)
        assert len(str(error).splitlines()) <= MOST_SHOWN + 2
        assert str(error).endswith("more")


def test_an_error_is_printable_and_short_whatever_the_file_holds(scene_file):
    long = f"{'k' * 5000}=1"
    text = str(error_of(scene_file, "a\x1b[31mb=1", f"title={'[' * 9}{']' * 9}", long))
    assert text.replace("\n", "").isprintable()
    assert '"a\\u001b[31mb": is not a known key' in text
    assert "... (50" in text
    assert len(text) < 4000


def test_a_number_may_be_swept_instead_of_given_and_one_run_needs_no_sweep(scene_file):
    loaded = load_scene(scene_file, [PAIR + "sweep.width=[0.1]", PAIR + "sweep.v_ref=[0.5, 0.6]"])
    assert loaded.scene.experiment["pair"].lanes() == 16
    one = [PAIR + "sweep={}", PAIR + "chain.belt_speed=1.5", PAIR + "initial.excited=1"]
    grid = load_scene(scene_file, one).scene.experiment["pair"].grid()
    assert {name: values.tolist() for name, values in grid.items()} == {"belt_speed": [1.5]}
