"""The `jaxchain` command: what it prints, what it writes, and that it loses nothing."""

import errno
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest.mock import MagicMock

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from synthetic import recorded_sweep, stored

import jaxchain
from jaxchain import SearchResult, cli
from jaxchain.basins import SlidingBasin, single_mass
from jaxchain.boundaries import ranges
from jaxchain.cli import main
from jaxchain.result import NAMES
from jaxchain.scenes import running
from jaxchain.scenes.files import builtin_scenes
from jaxchain.scenes.folder import MARKER, Results, unfinished, was_cut_off
from jaxchain.scenes.scene import load_scene
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
    monkeypatch.setattr(running, "sweep", recorded_sweep(calls))
    return calls


def test_results_are_never_overwritten_and_the_last_line_opens_them(
    workplace, made_up_sweep, capsys
):
    for folder in ("it's here", "it's here-2"):
        assert main(["run", "two.toml", "--no-plot", "--output", "it's here"]) == 0
        said = capsys.readouterr()
        *_, files, last = said.out.splitlines()
        assert files == f"results in {folder}: report.html, two.toml, two.zarr"
        with eval(last.removeprefix("open with "), {"xarray": xr}) as tree:
            assert set(tree.children) == {"first", "second"}
    assert said.err.splitlines() == [
        "jaxchain: it's here is in use",
        "jaxchain: the results go to it's here-2",
    ]


def test_a_folder_of_results_is_run_again_as_it_was(workplace, made_up_sweep, monkeypatch, capsys):
    """Of what was computed with overrides, once as it was and once with an override more."""
    monkeypatch.setattr(cli, "configure", configured := MagicMock())
    Path("two.toml").write_text(SCENE.partition("[experiment.second]")[0], encoding="utf-8")
    changes = [
        "numerics.lanes=2", "sweep.displacement=[1.0]", "chain.friction.mu_dynamic=0.4",
        "numerics.max_steps=99", "observe.stop=steady",
    ]  # fmt: skip
    sets = [f"--set=experiment.first.{change}" for change in changes]
    assert main(["run", "two.toml", *sets, "--no-plot", "--quiet"]) == 0
    configured.assert_called_with(cache=True)
    before = {p: p.read_bytes() for p in Path("results/two").rglob("*") if p.is_file()}
    Path("two.toml").unlink()
    assert main(["run", "results/two", "--no-plot", "--quiet"]) == 0
    first, second = made_up_sweep
    for key in ("chain", "observe", "t1", "lanes", "method"):
        assert eqx.tree_equal(first[key], second[key]), key
    assert (float(first["chain"].law.mu_dynamic), first["lanes"]) == (0.4, 2)
    assert (first["method"].max_steps, first["observe"][0].stop) == (99, "steady")
    np.testing.assert_equal(first["over"], second["over"])
    one, other = (stored(Path("results", name, "two"))["first"] for name in ("two", "two-2"))
    assert one.attrs["definition"] == other.attrs["definition"]
    with xr.open_datatree("results/two-2/two.zarr") as tree:
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


# Arguments, and a part of what is said of them.
REFUSED = {
    "resume two.toml": "must be a folder of results to continue.* `jaxchain run`",
    "resume sweep.zarr": "for a store made in Python repeat the same `sweep`",
    f"status {'x' * 300}": "is neither a store nor a folder that contains one",
    "run empty": "is a folder without a scene: it holds no TOML file",
    f"run two.toml --law {'x' * 300}.py:A": "there is no file xxx",
    "run two.toml --output two.toml/b": "cannot write into .*: Not a directory",
    **{f"run two.toml --output '{name}'": f'results/mine, but is "{re.escape(name)}"'
       for name in ("", ".", "/", "a/..")},
    "run two.toml --set experiment.first.chain.friction.width=1e-7":
        "scene two has an error:   experiment.first.numerics: Arguments `rtol`.*Use `rtol` = ",
    "scenes nothing": "is neither a file nor built in",
    "report nowhere": "`folder` must be a folder of results, but nowhere is none",
    "run two.toml --workers 2": "needs Dask: pip install 'jaxchain.dask.'",
    "run two.toml --netcdf": "--netcdf needs h5netcdf: pip install 'jaxchain.netcdf.'",
    "--completion bash": "needs shtab: pip install 'jaxchain.completion.'",
    "boundary --n 0": "`n` must be an integer of at least 1",
    "basins --velocity 1 0": "`velocity` must be .low, high.",
    "basins --mu-static 0.1": "`mu_static` must be at least",
}  # fmt: skip


@pytest.mark.parametrize("arguments", REFUSED)
def test_what_cannot_be_done_ends_with_2_and_the_reason(
    workplace, found, monkeypatch, capsys, arguments
):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda package: None)
    Path("empty").mkdir()
    Path("sweep.zarr").mkdir()
    try:
        status = main(shlex.split(arguments))
    except SystemExit as done:
        status = done.code
    said = capsys.readouterr()
    assert (status, said.out, found) == (2, "", [])
    assert re.search(REFUSED[arguments], said.err.replace("\n", " "))
    assert not list(Path(".").glob("results/*"))


def test_a_figure_that_fails_costs_no_data(workplace, made_up_sweep, monkeypatch, capsys):
    def broken(datasets):
        raise RuntimeError("no ink")

    monkeypatch.setattr(running, "figure", broken)
    assert main(["run", "two.toml"]) == 1
    assert "the results are in results/two, but" in capsys.readouterr().err
    found = stored(Path("results/two/two"))
    assert found["second"].sizes["belt_speed"] == found["first"].sizes["displacement"] == 2


def status_of(capsys, *words):
    """What `jaxchain status` prints."""
    capsys.readouterr()
    assert main(["status", "results/two", *words]) == 0
    return capsys.readouterr().out


@pytest.mark.usefixtures("usual_signals")
def test_a_signal_keeps_finished_runs(workplace, made_up_sweep, monkeypatch, capsys):
    whole = running.sweep

    def stopped(chain, initial, t1, *, over, **options):
        data = whole(chain, initial, t1, over=over, **options)
        if chain.n == 3:
            data["result"][1, 1] = NAMES.index("interrupted")
            data["energy"][1, 1] = np.nan
            try:
                os.kill(os.getpid(), signal.SIGTERM)
            except KeyboardInterrupt:
                raise SweepInterrupted(data) from None
        return data

    monkeypatch.setattr(running, "sweep", stopped)
    assert main(["run", "two.toml"]) == 130
    said = capsys.readouterr()
    assert said.err == (
        "jaxchain: interrupted\njaxchain: what was finished is in results/two: "
        "`jaxchain resume results/two` goes on with it\n"
    )
    assert "5 successful, 1 interrupted" in said.out
    found = stored(Path("results/two/two"))
    assert found["first"].result.sum() == 0
    assert int(found["second"].energy.isnull().sum()) == 1
    assert was_cut_off(Path("results/two"))
    assert "Missing: second." in Path("results/two/report.html").read_text(encoding="utf-8")
    run = {"folder": "results/two", "saved": ["first"], "missing": ["second"]}
    cut = run | {"under_way": False, "cut_off": True}
    assert json.loads(status_of(capsys, "--json")) == {"run": cut, "stores": []}
    assert status_of(capsys).splitlines() == [
        "results/two: the run was cut off",
        "  saved         first",
        "  missing       second",
        "  `jaxchain resume results/two` goes on with it",
    ]
    assert main(["run", "two.toml", "--no-plot", "--output", "results/two"]) == 130
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert first.startswith("jaxchain: the run in results/two was cut off: `jaxchain resume ")
    assert second == "jaxchain: the results go to results/two-2"
    monkeypatch.setattr(running, "sweep", whole)
    assert main(["resume", "results/two", "--no-plot"]) == 0
    assert "saved already: first\n" in capsys.readouterr().out
    assert int(stored(Path("results/two/two"))["second"].energy.isnull().sum()) == 0
    assert not Path("results/two", MARKER).exists()
    ended = "results/two: the run has ended\n  saved         first, second\n"
    assert status_of(capsys).startswith(ended)
    with unfinished(Path("results/two"), "two"):
        assert "the run is under way" in status_of(capsys)


def test_results_that_do_not_fit_are_saved_elsewhere(
    workplace, made_up_sweep, monkeypatch, capsys
):
    path = Path("tmp").absolute()  # from Python 3.12 on the folders in it have whole paths anyway
    path.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(path))

    def full(self, name):
        raise OSError(errno.ENOSPC, "No space left on device")

    write = Results._write
    monkeypatch.setattr(
        Results,
        "_write",
        lambda self, name: (full if self.folder.name == "two" else write)(self, name),
    )
    assert main(["run", "two.toml", "--quiet"]) == 1
    first, second, *_ = capsys.readouterr().err.splitlines()
    message = "cannot write `first` into results/two: No space left on device."
    assert first.startswith(f"jaxchain: {message} What was saved")
    (store,) = path.glob("jaxchain-*/two.zarr")
    assert second == f"jaxchain: `first` is saved in {store} instead"
    assert not Path("results/two").exists()
    assert list(stored(store.with_suffix(""))) == ["first"]


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


@pytest.fixture
def found(monkeypatch):
    """Replaces the search of `jaxchain boundary`, without a fold; lists the chains asked for."""
    requested = []
    values = {
        "hopf": 1.2, "fold": np.nan, "highest": np.nan, "width": 0.0, "hopf_dry": 1.2,
        "hopf_dry_error": 1e-12, "fold_dry": 1.85, "fold_dry_error": 1e-10, "fold_limit": np.nan,
        "fold_limit_error": np.nan,
    }  # fmt: skip
    speeds = {name: jnp.asarray(value) for name, value in values.items()}

    def search(chain, *, error_bars):
        assert error_bars
        requested.append(chain)
        mass, result = chain.n // 2, SearchResult.successful
        return ranges.StabilityRange(result=result, mass=mass, **speeds)

    monkeypatch.setattr(ranges, "stability_range", search)
    return requested


def test_boundary_prints_one_object_with_null_for_missing_numbers(workplace, found, capsys):
    assert main(["boundary", "--json", "--n", "3", "--width", "0.02", "--v-ref=0.4"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["hopf"], told["fold"], told["fold_dry"]) == (1.2, None, 1.85)
    assert set(told["missing"]) == {"fold", "fold_limit"}
    assert "at this width" in told["missing"]["fold"]
    assert (told["parameters"]["n"], told["parameters"]["v_ref"]) == (3, 0.4)
    (chain,) = found
    assert (chain.n, float(chain.width), float(chain.law.v_ref)) == (3, 0.02, 0.4)


def test_basins_prints_one_object(found, workplace, monkeypatch, capsys):
    boxes = []

    def search(chain, box):
        """With dry friction there is a cycle, smoothed there is none."""
        boxes.append((chain.dry, box.displacement.tolist()))
        numbers = (0.25, 1.1, 1.2) if chain.dry else (1.0, np.inf, np.inf)
        named = dict(zip(("share", "up", "down"), map(jnp.asarray, numbers), strict=True))
        one, other = jnp.ones(1), jnp.asarray(np.nan)
        rest = {"area": other, "state": (one, one), "period": other, "gap": other}
        return SlidingBasin(**named, **rest, result=SearchResult.successful)

    monkeypatch.setattr(single_mass, "sliding_basin", search)
    arguments = ["--width", "0.01", "--belt-speed=-1.78", "--displacement", "-1", "0.5"]
    assert main(["basins", "--json", *arguments]) == 0
    told = json.loads(capsys.readouterr().out)
    assert set(told["missing"]) == {"fold", "blow_up", "blow_down"}
    assert "every motion ends in steady sliding" in told["missing"]["blow_up"]
    assert told["fold"] is told["blow_up"] is None
    assert (told["share"], told["share_dry"], told["fold_dry"]) == (1.0, 0.25, 1.85)
    assert (told["blow_up_dry"], told["blow_down_dry"]) == (1.1, 1.2)
    assert told["box"] == {"displacement": [-1.0, 0.5], "velocity": [0.0, 2.0]}
    assert told["parameters"]["belt_speed"] == -1.78
    (chain,) = found
    assert (chain.n, float(chain.width)) == (1, 0.01)
    assert boxes == [(False, [-1.0, 0.5]), (True, [-1.0, 0.5])]
    assert main(["basins"]) == 0
    said = capsys.readouterr().out
    assert "belt speed 1.5, starts with -2 <= x <= 2 and 0 <= v <= 2" in said
    assert re.search(r"^share +1\.000000000 +0\.250000000", said, re.MULTILINE)


def test_without_a_command_it_prints_its_help(workplace, capsys):
    assert main([]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("usage: jaxchain")
    for option, told in ("--help", said.out), ("--version", f"jaxchain {jaxchain.__version__}\n"):
        with pytest.raises(SystemExit) as stopped:
            main([option])
        assert (stopped.value.code, capsys.readouterr().out) == (0, told)


@pytest.mark.long
def test_compiled_programs_are_kept_in_the_cache_folder_by_default(workplace):
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
    env |= {"XDG_CACHE_HOME": str(workplace / "cache")}
    command = [sys.executable, "-m", "jaxchain", "run", "two.toml", "--no-plot", "--quiet"]
    for more, kept in ((["--no-cache"], False), ([], True)):
        subprocess.run([*command, *more], env=env, check=True)
        assert any((workplace / "cache").rglob("jaxlib-*/*-cache")) is kept
