"""Scene files: the right ones are accepted, the wrong ones refused by key, value and remedy."""

import json
import time
from pathlib import Path

import pytest

from jaxchain.scenes import tables, wording
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.files import builtin_scenes
from jaxchain.scenes.pages.keys import meanings
from jaxchain.scenes.reading import load_scene, schema
from jaxchain.scenes.scene import Experiment
from jaxchain.scenes.values import Range

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


@pytest.fixture
def scene_file(tmp_path):
    file = tmp_path / "test.toml"
    file.write_text(SCENE, encoding="utf-8")
    return str(file)


def problems(scene_file, *overrides):
    with pytest.raises(SceneError) as error:
        load_scene(scene_file, overrides)
    return error.value.problems


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
    assert loaded.name == name
    copy = tmp_path / "my.own.toml"
    copy.write_text(builtin_scenes()[name].read_text(encoding="utf-8"), encoding="utf-8")
    assert load_scene(str(copy)).scene == loaded.scene
    assert load_scene(str(copy)).name == "my.own"


def test_fig3_holds_the_experiment_of_the_paper():
    loaded = load_scene("fig3").scene
    ladder, single = loaded.experiment["ladder"], loaded.experiment["single"]
    assert ladder.grid()["belt_speed"].tolist() == [round(1 + 0.05 * i, 2) for i in range(19)]
    assert ladder.grid()["excited"].tolist() == list(range(21))
    assert ladder.time.transient == 10000
    assert (ladder.chain.n, ladder.chain.coupling, single.chain.n) == (20, 0.01, 1)
    for experiment in (ladder, single):
        friction = experiment.chain.friction
        assert isinstance(friction, tables.ExponentialDecayTable)
        numbers = friction.model_dump(exclude={"law"})
        assert numbers == {"mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5, "width": 1e-3}
        assert experiment.chain.damping_ratio == 0.05
    speeds = single.grid()["belt_speed"]
    assert (speeds[0], speeds[-1], len(speeds)) == (0.1, 2.0, 39)


PAIR = "experiment.pair."


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("chain.damping=0.1", "chain.damping: is not a known key (did you mean `damping_ratio`?)"),
        ("chain.n=0", "chain.n: must be at least 1, but is 0"),
        ("chain.n=4.0", "chain.n: must be a whole number, but is 4.0"),
        ("chain.n=true", "chain.n: must be a whole number, but is true"),
        ("chain.damping_ratio=nan", "chain.damping_ratio: must be a finite number, but is nan"),
        ('chain.damping_ratio="x"', 'chain.damping_ratio: must be a number, but is "x"'),
        ("chain.damping_ratio={}", "chain.damping_ratio: must be a number or a list, but is a"),
        ("chain.damping_ratio=[0.1]", "chain.damping_ratio: must be one number or 4 in a list"),
        ("chain.coupling=[1,1,1,-1]", "chain.coupling[3]: must be at least 0, but is -1"),
        ("chain.coupling=[0.1,0.1]", "chain.coupling: must be one number or 4 in a list (one per"),
        ("chain.stiffness=0", "chain.stiffness: must be greater than 0, but is 0"),
        ("chain.ends=open", 'chain.ends: must be one of "cyclic", "free", but is "open"'),
        ("chain.friction.width=-1", "chain.friction.width: must be greater than 0, but is -1"),
        ("chain.friction.law=tanh", 'chain.friction.law: must be one of "exponential_decay", "'),
        ("chain.friction={}", 'chain.friction.law: is missing; allowed: "exponential_decay"'),
        (
            'chain.friction={law="exponential_decay",mu_static=1,mu_dynamic=0,v_ref=1}',
            "chain.friction.width: is missing: give it here or in `sweep`",
        ),
        (
            "chain.friction.mu_static=0.4",
            "chain.friction.mu_static: must be at least `mu_dynamic`",
        ),
        ("initial.kind=equation8", "initial.kind: must be one of"),
        ("initial.pattern=in-phase", "initial.pattern: is not a known key; allowed: "),
        ("initial.excited=5", "initial.excited: must not exceed 4 (`chain.n`), but is 5"),
        (
            "sweep.excited=[0,5]",
            "sweep.excited: must be whole numbers from 0 to 4 (`chain.n`), bu",
        ),
        (
            "sweep.excited=[0.5]",
            "sweep.excited: must be whole numbers from 0 to 4 (`chain.n`), bu",
        ),
        ("sweep.belt_speed=1.5", "sweep.belt_speed: must be a list or a range table, but is 1.5"),
        ("sweep.belt_speed=[]", "sweep.belt_speed: must not be empty"),
        ("sweep.belt_speed=[inf]", "sweep.belt_speed[0]: must be a finite number, but is inf"),
        ("sweep.belt_speed=[1,2,1]", "sweep.belt_speed: holds 1 more than once"),
        (
            "sweep.belt_speed.stop=0.5",
            "sweep.belt_speed: is empty: a step of 0.1 does not lead fr",
        ),
        ("sweep.belt_speed.count=3", "sweep.belt_speed: must have either `step` or `count`"),
        ("sweep.belt_speed={start=1,stop=2}", "sweep.belt_speed: must have either `step` or"),
        ("sweep.belt_speed={start=1,step=2}", "sweep.belt_speed.stop: is missing"),
        ("sweep.width=[0.01,0]", "sweep.width: must be greater than 0 throughout, but holds 0"),
        ("sweep.mu_dynamic=[-0.1]", "sweep.mu_dynamic: must not be negative, but holds -0.1"),
        (
            "sweep.mu_dynamic=[2]",
            "chain.friction.mu_static: must be at least `mu_dynamic` = 2, bu",
        ),
        (
            "sweep.wdith=[1]",
            "sweep.wdith: cannot be swept (did you mean `width`?); allowed: belt_",
        ),
        ("sweep.mu_viscous=[1]", "sweep.mu_viscous: cannot be swept"),
        ("time.window=3", "time.window: must hold at least one period, 6.283, but is 3"),
        ("time.transient=-1", "time.transient: must be at least 0, but is -1"),
        ("observe.stop=early", 'observe.stop: must be one of "never", "quiet", "steady", but is'),
        ('observe.quantities=["speed"]', "observe.quantities[0]: must be one of"),
        ("observe.others=[{}]", 'observe.others[0].observer: is missing; allowed: "StickTime", '),
        (
            'observe.others=[{observer="Sticktime"}]',
            'observe.others[0].observer: must be one of "StickTime", "PeakTimes", ',
        ),
        (
            'observe.others=[{observer="PeakTimes",start=1,capacty=2}]',
            "observe.others[0].capacty: is not a known key (did you mean `capacity`?)",
        ),
        (
            'observe.others=[{observer="Divergence"},{observer="Section",oscillator=5}]',
            "observe.others[1].oscillator: must lie in 1 ... 4 (`chain.n`), but is 5",
        ),
        (
            "numerics.model=rough",
            'numerics.model: must be one of "smoothed", "nonsmooth", "both", but is "rough"',
        ),
        ("numerics.solver=tsit5", "numerics.solver: must be one of"),
        ("numerics.rtol=1", "numerics.rtol: must be less than 1, but is 1"),
    ],
)
def test_a_mistake_is_reported_by_key_value_and_what_is_allowed(scene_file, override, problem):
    (found,) = problems(scene_file, PAIR + override)
    assert found.startswith(PAIR + problem)


FRICTION = PAIR + "chain.friction="


@pytest.mark.parametrize(
    ("friction", "problem"),
    [
        (
            '{law="tabulated",width=1}',
            "chain.friction: must have either `file` or `speed` and `mu`",
        ),
        ('{law="tabulated",file="nu.csv",width=1}', "chain.friction: has a `file` that cannot be"),
        ('{law="tabulated",file=3,width=1}', "chain.friction.file: must be a text in quotes, but"),
        (
            '{law="tabulated",file="mu.csv",speed=[0,1],width=1}',
            "chain.friction: must have either `file` or",
        ),
        (
            '{law="tabulated",speed=[0.1,1],mu=[1,0.5],width=1}',
            "chain.friction: the first speed must be 0, but is 0.1",
        ),
        ('{law="tabulated",speed=[0,1],mu=[1,0.5]}', "chain.friction.width: is missing"),
        ('{law="own",width=1,mu_static="x"}', "chain.friction.mu_static: must be a number, but"),
        ('{law="own",width=1,stiffness=2}', "chain.friction: cannot have the key `stiffness`, a"),
        (
            '{law="gaussian_stribeck",width=1,mu_static=1,mu_dynamic=0.5,v_ref=1}',
            "chain.friction.mu_viscous: is missing: give it here or in `sweep`",
        ),
        (
            '{law="gaussian_stribeck",width=1,mu_static=1,mu_dynamic=2,v_ref=1,mu_viscous=0}',
            "chain.friction.mu_static: must be at least `mu_dynamic` = 2, but is 1",
        ),
    ],
)
def test_a_mistake_in_a_law_is_reported_alike(scene_file, friction, problem):
    (found,) = problems(scene_file, FRICTION + friction)
    assert found.startswith(PAIR + problem)


def test_a_table_of_friction_is_read_beside_the_scene_and_kept_with_its_results(scene_file):
    Path(scene_file).with_name("mu.csv").write_text("s,mu\n0,1\n2,0.5\n", encoding="utf-8")
    loaded = load_scene(scene_file, [FRICTION + '{law="tabulated",file="mu.csv",width=0.1}'])
    experiment = loaded.scene.experiment["pair"]
    friction = experiment.chain.friction
    assert (friction.speed, friction.mu, friction.file) == ([0.0, 2.0], [1.0, 0.5], None)
    assert '"speed":[0.0,2.0],"mu":[1.0,0.5]' in experiment.model_dump_json()


def test_the_numbers_of_a_law_of_ones_own_have_any_names_and_can_be_swept(scene_file):
    loaded = load_scene(
        scene_file, [FRICTION + '{law="own",width=0.1,slope=2}', PAIR + "sweep.slope=[1, 2]"]
    )
    experiment = loaded.scene.experiment["pair"]
    assert experiment.friction_numbers() == ("slope", "width")
    assert experiment.lanes() == 16
    (found,) = problems(
        scene_file, FRICTION + '{law="own",width=0.1,slope=2}', PAIR + "sweep.solpe=[1]"
    )
    assert "sweep.solpe: cannot be swept (did you mean `slope`?)" in found


def test_all_mistakes_are_reported_at_once(scene_file):
    found = problems(scene_file, PAIR + "chain.n=0", PAIR + "time.windw=3", "titel=3", "title=3")
    assert [line.split(":")[0] for line in found] == [
        "title",
        "experiment.pair.chain.n",
        "experiment.pair.time.windw",
        "titel",
    ]


def test_a_billion_runs_are_refused_at_once_and_with_a_remedy(scene_file):
    many = "{start=0.1,stop=1.0,count=1000}"
    started = time.perf_counter()
    (found,) = problems(
        scene_file,
        f"{PAIR}sweep.belt_speed={many}",
        f"{PAIR}sweep.damping_ratio={many}",
        f"{PAIR}sweep.width={many}",
        f"{PAIR}numerics.store=false",
    )
    assert time.perf_counter() - started < 1
    assert found.startswith("experiment.pair.sweep: is 2e+09 runs (1000 belt_speed x 2 excited x ")
    assert "take fewer values" in found
    assert "numerics.store = true" in found


def test_a_store_takes_a_billion_runs_and_is_there_for_thousands(scene_file):
    many, more = "{start=0.1,stop=1.0,count=1000}", "{start=0.1,stop=1.0,count=1_000_000}"
    speeds, damping = f"{PAIR}sweep.belt_speed={many}", f"{PAIR}sweep.damping_ratio={many}"
    ratios = f"{PAIR}sweep.damping_ratio={{start=0.01,stop=0.1,count=COUNT}}"

    def experiment(*overrides):
        return load_scene(scene_file, overrides).scene.experiment["pair"]

    few, large = experiment(speeds), experiment(speeds, damping, f"{PAIR}sweep.width={many}")
    assert (few.lanes(), few.stored(), few.fits_memory()) == (2000, False, True)
    assert (large.lanes(), large.stored(), large.fits_memory()) == (2 * 10**9, True, False)
    for count, stored in ((512, False), (513, True)):
        found = experiment(ratios.replace("COUNT", str(count)))
        assert (found.lanes(), found.stored(), found.fits_memory()) == (8 * count, stored, True)
    assert experiment(f"{PAIR}numerics.store=true").stored()
    assert not experiment(ratios.replace("COUNT", "1000"), f"{PAIR}numerics.store=false").stored()
    # A long chain fits into a store that does not fit into memory.
    assert not experiment(f"{PAIR}chain.n=50_000_000", f"{PAIR}numerics.store=true").fits_memory()
    (found,) = problems(scene_file, *(f"{PAIR}sweep.{k}={more}" for k in ("belt_speed", "width")))
    assert found.startswith("experiment.pair.sweep: is 2e+12 runs")


@pytest.mark.parametrize(("stop", "step"), [(1.6, 1e9), (1.6, 0.7), (0.4, -0.7)])
def test_a_step_beyond_its_range_is_refused(scene_file, stop, step):
    speed = f"sweep.belt_speed={{start=1.0,stop={stop},step={step}}}"
    (found,) = problems(scene_file, PAIR + speed)
    assert found.startswith(f"{PAIR}sweep.belt_speed: has a step of")


@pytest.mark.parametrize("step", ["1e-9", "1e-300"])
def test_a_range_of_a_billion_values_is_refused_before_it_is_made(scene_file, step):
    (found,) = problems(scene_file, f"{PAIR}sweep.belt_speed.step={step}")
    assert "values, and 1000000 are the most" in found


def test_a_chain_too_long_for_its_sweep_is_refused(scene_file):
    (found,) = problems(scene_file, f"{PAIR}chain.n=100_000_000")
    assert "8e+08 amplitudes" in found


def test_a_single_mass_has_no_coupling(scene_file):
    found = problems(scene_file, f"{PAIR}chain.n=1", f"{PAIR}sweep.excited=[1]")
    (problem,) = found
    assert problem.startswith("experiment.pair.chain.coupling: must be left out: a single mass")


def test_a_number_may_be_swept_instead_of_given(scene_file):
    loaded = load_scene(scene_file, [PAIR + "sweep.width=[0.1]", PAIR + "sweep.v_ref=[0.5, 0.6]"])
    assert loaded.scene.experiment["pair"].lanes() == 16


def test_without_a_sweep_there_is_one_run_at_the_belt_speed_of_the_chain(scene_file):
    loaded = load_scene(
        scene_file, [PAIR + "sweep={}", PAIR + "chain.belt_speed=1.5", PAIR + "initial.excited=1"]
    )
    experiment = loaded.scene.experiment["pair"]
    assert {k: v.tolist() for k, v in experiment.grid().items()} == {"belt_speed": [1.5]}


def test_a_file_that_still_marks_a_main_experiment_is_read_as_if_it_did_not(scene_file):
    marked = load_scene(scene_file, [PAIR + "main=true"]).scene
    assert marked == load_scene(scene_file).scene
    assert "main" not in schema()["$defs"]["Experiment"]["properties"]


def test_a_file_that_is_not_there_or_not_toml_is_a_readable_error(tmp_path):
    assert problems("fig33") == [
        "is neither a file nor built in (did you mean `fig3`?); built in: "
        + ", ".join(builtin_scenes())
    ]
    assert problems(str(tmp_path)) == ["is a folder without a scene: it holds no TOML file"]
    broken = tmp_path / "broken.toml"
    broken.write_text("title = \n", encoding="utf-8")
    (found,) = problems(str(broken))
    assert found.startswith("is not valid TOML: ")
    assert "line 1" in found


@pytest.mark.parametrize("override", ["title", "=3", ".x=3", "title=a b", "title.x=3"])
def test_an_override_that_cannot_be_read_is_shown(scene_file, override):
    (found,) = problems(scene_file, override)
    assert found.startswith(f'--set "{override}": ')


@pytest.mark.parametrize(
    ("given", "values"),
    [
        ({"start": 1.0, "stop": 1.3, "step": 0.05}, [1.0, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3]),
        ({"start": 1.0, "stop": 1.14, "step": 0.05}, [1.0, 1.05, 1.1]),
        ({"start": 0.3, "stop": 0.1, "step": -0.1}, [0.3, 0.2, 0.1]),
        ({"start": 0.0, "stop": 1.0, "count": 3}, [0.0, 0.5, 1.0]),
        ({"start": 2, "stop": 2, "step": 1}, [2.0]),
    ],
)
def test_a_range_holds_exactly_the_decimals_one_would_write(given, values):
    assert Range.model_validate(given).array().tolist() == values


def test_the_schema_names_every_key_and_knows_no_null():
    text = json.dumps(schema())
    assert "null" not in text
    named = (table for tables in wording.OPTIONS.values() for table in tables.values())
    for table in (Experiment, Range, *named):
        assert all(f'"{key}"' in text for key in table.model_fields)


def test_no_example_for_python_is_told_to_readers_of_files():
    assert ">>>" in (Experiment.__doc__ or "")
    assert schema()["$defs"]["Experiment"]["description"].startswith("One sweep of a scene: ")
    assert ">>>" not in json.dumps(schema())
    told = dict(meanings(load_scene("quickstart").scene))
    assert "One sweep of a scene: " in told["experiment"]
    assert ">>>" not in "".join(told.values())


def test_the_message_of_an_error_lists_its_problems():
    assert str(SceneError("a", ["b: c", "d"])) == "scene a has 2 errors:\n  b: c\n  d"
