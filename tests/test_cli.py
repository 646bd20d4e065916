"""The `jaxchain` command: what it prints, what it writes, and that it loses nothing."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import get_args

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
import zarr
from synthetic import results, stored

import jaxchain
from jaxchain import paper_chain, steady_sliding
from jaxchain.boundaries import overview
from jaxchain.cli import main
from jaxchain.result import NAMES
from jaxchain.scenes import building, running
from jaxchain.scenes.files import builtin_scenes
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.storage import listing
from jaxchain.scenes.tables import Solver
from jaxchain.scenes.wording import LAWS
from jaxchain.sweeps import SweepInterrupted

SCENE = """
title = "Two experiments"

[experiment.first]
chain = { n = 1, damping_ratio = 0.05, friction = { law = "coulomb", mu_dynamic = 0.5, \
width = 0.1 } }
initial = { kind = "excited", excited = 1 }
sweep = { belt_speed = [1.0, 1.5], displacement = [0.5, 1.0] }
time = { transient = 10.0, window = 10.0 }

[experiment.second]
description = "A ring of three"
chain = { n = 3, damping_ratio = 0.05, coupling = 0.01, friction = { law = "exponential_decay", \
mu_static = 1.0, mu_dynamic = 0.5, v_ref = 0.5, width = 0.1 } }
initial = { kind = "equation_8" }
sweep = { belt_speed = [1.0, 1.5], excited = [0, 1, 3] }
time = { transient = 10.0, window = 10.0 }
observe = { quantities = ["energy", "active_count"] }
"""


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder with a scene file, as the current one; no cache is written to the user's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "two.toml").write_text(SCENE, encoding="utf-8")
    return tmp_path


@pytest.fixture
def made_up_sweep(monkeypatch):
    """Replaces the computation; returns a list of the arguments of every call."""
    calls = []

    def sweep(chain, initial, t1, *, over, **options):
        calls.append({"chain": chain, "initial": initial, "t1": t1, "over": over, **options})
        axes = {name: np.asarray(values) for name, values in over.items()}
        shape = tuple(map(len, axes.values()))
        return results(axes, np.ones(shape, int), chain.n)

    monkeypatch.setattr(running, "sweep", sweep)
    return calls


@pytest.mark.slow
def test_a_scene_becomes_datasets_a_figure_and_a_summary(workplace, capsys):
    assert main(["run", "two.toml", "--output", "out"]) == 0
    files = {file.name for file in Path("out").iterdir()}
    assert files == {"report.html", "two.toml", "two.zarr", "two.nc", "two.png", "two.pdf"}
    found = stored(Path("out/two"))
    ring, one = found["second"], found["first"]
    assert ring.energy.dims == ("belt_speed", "excited")
    assert ring.excited.values.tolist() == [0, 1, 3]
    assert "amplitude" not in ring
    assert ring.energy.sel(belt_speed=1.5, excited=0) < 1e-9 < ring.energy.sel(excited=3).min()
    assert ring.attrs["title"] == "Two experiments"
    assert json.loads(ring.attrs["definition"])["chain"]["n"] == 3
    assert one.amplitude.dims == ("belt_speed", "displacement", "oscillator")
    # Without weakening the vibration dies, slower than it is measured here.
    assert np.all(one.amplitude.sel(displacement=1.0) > one.amplitude.sel(displacement=0.5))
    printed = capsys.readouterr()
    assert "second: A ring of three" in printed.out
    assert "6 (2 belt_speed x 3 excited)" in printed.out
    assert (
        "results in out: report.html, two.nc, two.pdf, two.png, two.toml, two.zarr" in printed.out
    )


def test_results_are_never_overwritten(workplace, made_up_sweep, capsys):
    for folder in ("two", "two-2", "two-3"):
        assert main(["run", "two.toml", "--no-plot"]) == 0
        assert Path("results", folder, "two.zarr").exists()
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "jaxchain: results/two is in use, the results go to results/two-2",
        "jaxchain: results/two is in use, the results go to results/two-3",
    ]


def test_an_empty_folder_is_used_and_a_file_in_the_way_is_not_touched(workplace, made_up_sweep):
    Path("empty").mkdir()
    Path("file").write_text("mine", encoding="utf-8")
    assert main(["run", "two.toml", "--output", "empty", "--no-plot"]) == 0
    assert main(["run", "two.toml", "--output", "file", "--no-plot"]) == 0
    for folder in (Path("empty"), Path("file-2")):
        files = {file.name for file in folder.iterdir()}
        assert files == {"report.html", "two.toml", "two.zarr", "two.nc"}
    assert Path("file").read_text(encoding="utf-8") == "mine"


def test_every_experiment_is_a_group_and_the_root_says_whose_they_are(workplace, made_up_sweep):
    assert main(["run", "two.toml", "--no-plot"]) == 0
    root = zarr.open_consolidated("results/two/two.zarr", mode="r")
    assert root.attrs["title"] == "Two experiments"
    assert set(root.group_keys()) == {"first", "second"}
    assert not list(root.array_keys())
    for name, data in stored(Path("results/two/two")).items():
        assert data.attrs["experiment"] == name


def test_what_was_run_is_written_before_anything_is_computed(workplace, monkeypatch):
    def stopped(*arguments, **options):
        assert listing(Path("results/two")) == ["two.toml"]
        assert load_scene("results/two").scene.experiment["first"].time.window == 7.0
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "sweep", stopped)
    assert main(["run", "two.toml", "--set", "experiment.first.time.window=7"]) == 130
    # A run that has saved nothing leaves nothing.
    assert not Path("results/two").exists()


def test_a_folder_of_results_is_run_again_bit_for_bit(workplace, capsys):
    """Of what was computed with overrides, once as it was and once with an override more."""
    Path("two.toml").write_text(SCENE.partition("[experiment.second]")[0], encoding="utf-8")
    changes = ["numerics.lanes=2", "sweep.displacement=[1.0]", "chain.friction.mu_dynamic=0.4"]
    sets = [f"--set=experiment.first.{change}" for change in changes]
    assert main(["run", "two.toml", *sets, "--no-plot", "--quiet"]) == 0
    before = {p: p.read_bytes() for p in Path("results/two").rglob("*") if p.is_file()}
    Path("two.toml").unlink()
    assert main(["run", "results/two", "--no-plot", "--quiet"]) == 0
    one, other = (stored(Path("results", name, "two"))["first"] for name in ("two", "two-2"))
    assert one.sizes == other.sizes
    assert one.attrs["definition"] == other.attrs["definition"]
    for key, values in one.variables.items():
        assert values.values.tobytes() == other[key].values.tobytes(), key
    with xr.open_datatree("results/two-2/two.nc") as tree:
        assert tree.attrs["command"] == "jaxchain run results/two --no-plot --quiet"
        assert tree.attrs["started"] <= tree.attrs["ended"]
        assert json.loads(tree.attrs["versions"])["jaxchain"] == jaxchain.__version__
    more = "--set=experiment.first.sweep.belt_speed=[1.5]"
    assert main(["run", "results/two-2/two.toml", more, "--no-plot", "--quiet"]) == 0
    third = stored(Path("results/two-3/two"))["first"]
    assert third.belt_speed.values.tolist() == [1.5]
    assert third.displacement.values.tolist() == [1.0]
    assert before == {p: p.read_bytes() for p in before}
    assert main(["scenes", "results/two-3"]) == 0
    assert capsys.readouterr().out == Path("results/two-3/two.toml").read_text(encoding="utf-8")


LAW = """
from jaxchain.model import AbstractFrictionLaw


class Mine(AbstractFrictionLaw):
    mu_dynamic: float

    @property
    def mu_static(self):
        return self.mu_dynamic

    def coefficient(self, speed):
        return self.mu_dynamic + 0.0 * speed
"""


def test_a_law_in_the_place_of_that_of_the_scene_is_asked_for_again(
    workplace, made_up_sweep, capsys
):
    Path("two.toml").write_text(SCENE.partition("[experiment.second]")[0], encoding="utf-8")
    Path("laws.py").write_text(LAW, encoding="utf-8")
    assert main(["run", "two.toml", "--law", "laws.py:Mine", "--no-plot", "--quiet"]) == 0
    own = {"law": "own", "mu_dynamic": 0.5, "width": 0.1}
    assert load_scene("results/two").scene.experiment["first"].chain.friction.model_dump() == own
    data = stored(Path("results/two/two"))["first"]
    assert json.loads(data.attrs["definition"])["chain"]["friction"] == own
    assert main(["run", "results/two", "--no-plot", "--quiet"]) == 2
    assert "must be named on the command line: --law" in capsys.readouterr().err
    again = ["run", "results/two", "--no-plot", "--quiet", "--law", "results/two/laws.py:Mine"]
    assert main(again) == 0
    assert Path("results/two-2/laws.py").read_text(encoding="utf-8") == LAW


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["resume", "two.toml"],
            "two.toml .*must be a folder of results, .* `jaxchain run`",
        ),
        (["resume", "quickstart"], "must be a folder of results"),
        (["resume", "/"], "is a folder without a scene"),
        (["resume", "x" * 300], "must be a folder of results"),
        (["status", "/"], "^jaxchain: / is no store, and no folder that holds one"),
        (["status", "x" * 300], "is no store, and no folder that holds one"),
        (["status", "odd.zarr"], "is no store, and no folder that holds one"),
        (["run", "two.toml", "--law", f"{'x' * 300}.py:A"], "there is no file xxx"),
    ],
)
def test_what_is_no_folder_of_results_is_a_readable_error(workplace, capsys, arguments, said):
    Path("odd.zarr/jaxchain").mkdir(parents=True)
    Path("odd.zarr/jaxchain/zarr.json").write_text('{"a": 1}')
    assert main(arguments) == 2
    assert re.search(said, capsys.readouterr().err.replace("\n", " "))


def test_a_folder_without_a_scene_is_a_readable_error(workplace, capsys):
    Path("empty").mkdir()
    assert main(["run", "empty"]) == 2
    assert "is a folder without a scene: it holds no TOML file" in capsys.readouterr().err


def test_a_run_ends_with_a_line_that_opens_what_it_found(workplace, made_up_sweep, capsys):
    assert main(["run", "two.toml", "--no-plot", "--output", "it's here"]) == 0
    *_, files, last = capsys.readouterr().out.splitlines()
    line, more = last.removeprefix("open with ").split("; ")
    assert files == "results in it's here: report.html, two.nc, two.toml, two.zarr"
    assert more == "two.nc holds the same"
    for code in (line, line.replace(".zarr", ".nc")):
        with eval(code, {"xarray": xr}) as tree:
            assert set(tree.children) == {"first", "second"}


def test_what_the_scene_says_reaches_the_sweep(workplace, made_up_sweep):
    arguments = [
        "experiment.second.numerics.rtol=1e-8",
        "experiment.second.numerics.max_steps=99",
        "experiment.second.observe.stop=steady",
        "experiment.second.chain.ends=free",
        "experiment.second.chain.coupling=[0.01,0.02]",
        "experiment.second.sweep.width=[0.2,0.1]",
    ]
    assert main(["run", "two.toml", "--no-plot", *(f"--set={a}" for a in arguments)]) == 0
    call = made_up_sweep[1]
    assert (call["rtol"], call["atol"], call["max_steps"], call["t1"]) == (1e-8, None, 99, 20.0)
    (observer,) = call["observe"]
    assert (observer.stop, observer.window) == ("steady", 10.0)
    chain = call["chain"]
    assert (chain.n, chain.ends, float(chain.width)) == (3, "free", 0.2)
    np.testing.assert_array_equal(chain.coupling, [0.01, 0.02])
    assert call["over"]["width"].tolist() == [0.2, 0.1]


@pytest.mark.parametrize(
    ("initial", "displacements", "velocity"),
    [
        ('{ kind = "equation_8", excited = 2 }', [0, 2, -2], 0),
        ('{ kind = "equation_10", excited = 2, block = "centred" }', [-2, 2, 0], 0.56),
        ('{ kind = "excited", oscillators = [1, 3], displacement = 0.5 }', [-0.5, 0, -0.5], 0),
        (
            '{ kind = "excited", excited = 3, pattern = "in-phase", velocity = 0.1 }',
            [2, 2, 2],
            0.1,
        ),
    ],
)
def test_initial_states_are_those_asked_for(workplace, initial, displacements, velocity):
    overrides = [f"initial={initial}", "sweep={belt_speed=[1.0]}"]
    loaded = load_scene("two.toml", [f"experiment.second.{text}" for text in overrides])
    experiment = loaded.scene.experiment["second"]
    chain = building.build_chain(experiment)
    x, v = building.build_initial(experiment)(chain)
    np.testing.assert_allclose(x - steady_sliding(chain)[0], displacements, atol=1e-15)
    np.testing.assert_array_equal(v, np.full(3, velocity))


def test_a_wrong_scene_ends_with_2_and_no_traceback(workplace, capsys):
    assert main(["run", "two.toml", "--set", "experiment.first.chain.n=-1"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == (
        "jaxchain: scene two.toml has an error:\n"
        "  experiment.first.chain.n: must be at least 1, but is -1\n"
    )
    assert not Path("results").exists()


def test_a_width_that_the_tolerance_cannot_see_ends_with_2_and_the_remedy(workplace, capsys):
    assert main(["run", "two.toml", "--set", "experiment.first.chain.friction.width=1e-7"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        "jaxchain: scene two has an error:\n  experiment.first: Arguments `rtol`"
    )
    assert "Use `rtol` = " in said
    assert not Path("results/two").exists()


def test_quiet_prints_nothing(workplace, made_up_sweep, capsys):
    assert main(["run", "two.toml", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_a_figure_that_fails_costs_no_data(workplace, made_up_sweep, monkeypatch, capsys):
    def broken(datasets):
        raise RuntimeError("no ink")

    monkeypatch.setattr(running, "figure", broken)
    assert main(["run", "two.toml"]) == 1
    assert "the results are in results/two, but" in capsys.readouterr().err
    found = stored(Path("results/two/two"))
    assert found["second"].sizes["belt_speed"] == found["first"].sizes["displacement"] == 2


def test_ctrl_c_keeps_what_was_finished(workplace, made_up_sweep, monkeypatch, capsys):
    whole = running.sweep

    def stopped(chain, initial, t1, *, over, **options):
        data = whole(chain, initial, t1, over=over, **options)
        if chain.n == 3:
            data["result"][1, 1] = NAMES.index("interrupted")
            data["energy"][1, 1] = np.nan
            raise SweepInterrupted(data)
        return data

    monkeypatch.setattr(running, "sweep", stopped)
    assert main(["run", "two.toml"]) == 130
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    assert said.err == "jaxchain: interrupted; what was finished is in results/two\n"
    assert "5 successful, 1 interrupted" in said.out
    assert "failed" not in said.out
    found = stored(Path("results/two/two"))
    assert found["first"].result.sum() == 0
    assert int(found["second"].energy.isnull().sum()) == 1


def test_ctrl_c_before_anything_is_finished_leaves_no_folder(workplace, monkeypatch):
    def stopped(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "sweep", stopped)
    assert main(["run", "two.toml"]) == 130
    assert not Path("results/two").exists()


@pytest.mark.usefixtures("usual_signals")
def test_what_asks_the_process_to_end_is_answered_as_ctrl_c_is(
    workplace, made_up_sweep, monkeypatch, capsys
):
    whole = running.sweep

    def stopped(chain, initial, t1, *, over, **options):
        if chain.n == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return whole(chain, initial, t1, over=over, **options)

    monkeypatch.setattr(running, "sweep", stopped)
    assert main(["run", "two.toml", "--quiet"]) == 143
    said = "jaxchain: interrupted; what was finished is in results/two\n"
    assert capsys.readouterr() == ("", said)
    assert xr.open_zarr("results/two/two.zarr", group="first").result.sum() == 0


@pytest.mark.parametrize(("room", "what"), [(1000, "two.toml"), (6000, "first")])
def test_results_that_can_be_written_nowhere_are_a_readable_error(
    workplace, made_up_sweep, monkeypatch, capsys, room, what
):
    Path("tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", "tmp")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))  # Python ignores the signal
    try:
        status = main(["run", "two.toml", "--quiet"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert status == 1
    first, then, second, last = capsys.readouterr().err.splitlines()
    assert first == (
        f"jaxchain: cannot write `{what}` into results/two: File too large. What was saved there "
        "before stays whole: nothing."
    )
    assert "the results go to tmp/jaxchain-" in then
    assert f"cannot write `{what}` into tmp/jaxchain-" in second
    assert last == f"jaxchain: stopped: `{what}` could not be saved"
    assert len(made_up_sweep) == (what == "first")
    assert not Path("results/two").exists()
    assert not list(Path("tmp").glob("*/*"))


def test_a_folder_that_cannot_be_made_is_a_readable_error(workplace, made_up_sweep, capsys):
    Path("file").write_text("", encoding="utf-8")
    assert main(["run", "two.toml", "--output", "file/below"]) == 2
    assert "cannot create file/below: Not a directory" in capsys.readouterr().err


@pytest.mark.parametrize("folder", ["", " ", ".", "..", "/", "a/.."])
def test_a_folder_without_a_name_of_its_own_is_refused(workplace, folder, capsys):
    with pytest.raises(SystemExit) as done:
        main(["run", "two.toml", "--output", folder])
    assert done.value.code == 2
    said = f'must name a folder of its own, such as results/mine, but is "{folder}"'
    assert said in capsys.readouterr().err
    assert not Path("results").exists()


def test_scenes_lists_shows_and_describes(workplace, capsys):
    assert main(["scenes"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [
        *builtin_scenes()
    ]
    assert main(["scenes", "quickstart"]) == 0
    shown = capsys.readouterr().out
    Path("mine.toml").write_text(shown, encoding="utf-8")
    assert load_scene("mine.toml").scene == load_scene("quickstart").scene
    assert main(["scenes", "--schema"]) == 0
    assert json.loads(capsys.readouterr().out)["title"] == "Scene"
    assert main(["scenes", "nothing"]) == 2


def test_every_solver_of_a_scene_exists():
    for name in get_args(Solver):
        assert (building.build_solver(name, paper_chain(), 1e-6, 0.5) is None) == (name == "auto")


def test_every_law_of_a_scene_takes_the_numbers_of_its_class():
    # A table has points instead of numbers, and a law of one's own whatever numbers it takes.
    assert set(LAWS) == {*building.LAWS, "tabulated", "own"}
    for name, law in building.LAWS.items():
        fields = law.__dataclass_fields__
        assert set(LAWS[name].model_fields) - {"law", "width"} == set(fields)


def replace_search(monkeypatch, fold, fold_limit, fold_limit_error):
    """Replaces the search of `jaxchain boundary`; a list of the chains that were asked for."""
    asked = []
    values = (1.2, 1.2, 1e-12, fold, 1.85, 1e-10, fold_limit, fold_limit_error)

    def search(chain):
        asked.append(chain)
        return overview.Boundaries(*map(jnp.asarray, values), mass=chain.n // 2)

    monkeypatch.setattr(overview, "hopf_and_fold", search)
    return asked


@pytest.fixture
def found(monkeypatch):
    return replace_search(monkeypatch, np.nan, np.nan, np.nan)


def test_boundary_prints_one_object_with_null_for_what_is_missing(workplace, found, capsys):
    assert main(["boundary", "--json", "--n", "3", "--width", "0.02", "--v-ref=0.4"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["hopf"], told["fold"], told["fold_nonsmooth"]) == (1.2, None, 1.85)
    assert told["fold_nonsmooth_error"] == 1e-10
    assert told["fold_limit"] is told["fold_limit_error"] is None
    assert set(told["missing"]) == {"fold", "fold_limit"}
    assert "at this width" in told["missing"]["fold"]
    assert told["parameters"] == {
        "n": 3, "width": 0.02, "damping_ratio": 0.05, "coupling": 0.01, "mu_static": 1.0,
        "mu_dynamic": 0.5, "v_ref": 0.4,
    }  # fmt: skip
    (chain,) = found
    assert (chain.n, float(chain.law.v_ref)) == (3, 0.4)


def test_boundary_without_options_is_one_mass_of_the_paper(workplace, found, capsys):
    assert main(["boundary"]) == 0
    (chain,) = found
    assert (chain.n, chain.coupling, float(chain.width)) == (1, None, 1e-3)
    said = capsys.readouterr().out
    assert "1.850000000 ± 1e-10" in said
    assert "fold: no fold was found" in said
    assert "moves the fold" not in said


def test_in_words_every_boundary_has_its_value_its_limit_and_its_bar(
    workplace, monkeypatch, capsys
):
    replace_search(monkeypatch, 1.8, 1.8501, 1e-3)
    assert main(["boundary"]) == 0
    lines = capsys.readouterr().out.splitlines()
    hopf, fold = (next(line for line in lines if line.startswith(k)) for k in ("Hopf", "fold"))
    assert "1.200000000" in hopf
    assert "± 1e-12" in hopf
    assert "1.800000000" in fold
    assert "1.850000000 ± 1e-10" in fold
    assert "From 1.2000 to 1.8500 it depends on the start" in lines[4]
    assert "-2.7 %" in lines[5]


def test_ctrl_c_ends_boundary_without_a_traceback(workplace, monkeypatch, capsys):
    def stopped(chain):
        raise KeyboardInterrupt

    monkeypatch.setattr(overview, "hopf_and_fold", stopped)
    assert main(["boundary"]) == 130
    assert capsys.readouterr() == ("", "jaxchain: interrupted\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--width", "-1"], "`width` must be positive"),
        (["--damping-ratio", "nan"], "`damping_ratio` must be finite"),
        (["--n", "0"], "`n` must be an integer of at least 1"),
        (["--coupling", "0.1"], "one mass has no neighbours"),
        (["--mu-static", "0.1"], "`mu_static` must be at least"),
    ],
)
def test_a_bad_number_of_boundary_ends_with_2_and_names_it(
    workplace, found, capsys, arguments, said
):
    assert main(["boundary", *arguments]) == 2
    printed = capsys.readouterr()
    assert said in printed.err
    assert printed.out == ""
    assert found == []


def test_without_a_command_it_prints_its_help(capsys):
    assert main([]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("usage: jaxchain")
    assert not said.err
    with pytest.raises(SystemExit):
        main(["--help"])
    assert capsys.readouterr().out == said.out


def test_it_tells_its_version(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out == f"jaxchain {jaxchain.__version__}\n"


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"]])
def test_help_shows_an_example_that_is_understood(arguments, workplace, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    shown = [line.split("  ")[0].split() for line in lines if line.startswith("jaxchain run ")]
    assert ["jaxchain", "run", "quickstart"] in shown
    for _, _, scene, *options in shown:
        load_scene(scene, [b for a, b in pairwise(options) if a == "--set"])
        for folder in (b for a, b in pairwise(options) if a == "--output"):
            Path(folder).mkdir()
            text = builtin_scenes()[scene].read_text(encoding="utf-8")
            Path(folder, f"{scene}.toml").write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    "arguments",
    [[], ["run"], ["resume"], ["status"], ["scenes"], ["boundary"], ["basins"]],
)
def test_help_is_there(arguments, capsys):
    with pytest.raises(SystemExit) as done:
        main([*arguments, "--help"])
    assert done.value.code == 0
    assert "usage: jaxchain" in capsys.readouterr().out


@pytest.mark.long
def test_the_package_can_be_run_as_a_module():
    command = [sys.executable, "-m", "jaxchain", "scenes"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "fig3" in done.stdout


@pytest.mark.long
def test_compiled_programs_are_kept_in_the_cache_folder_unless_told_otherwise(workplace):
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
    env |= {"XDG_CACHE_HOME": str(workplace / "cache")}
    command = [sys.executable, "-m", "jaxchain", "run", "two.toml", "--no-plot", "--quiet"]
    for more, kept in ((["--no-cache"], False), ([], True)):
        subprocess.run([*command, *more], env=env, check=True)
        assert any((workplace / "cache").rglob("jaxlib-*/*-cache")) is kept
