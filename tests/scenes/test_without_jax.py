"""Commands without computation do not import JAX: checked in a fresh process."""

import json
import subprocess
import sys

import pytest

from jaxchain.scenes.files import builtin_scenes

HEAVY = {
    "jax", "jaxlib", "diffrax", "equinox", "scipy", "pandas", "xarray", "matplotlib", "zarr",
    "h5netcdf", "tqdm", "jinja2",
}  # fmt: skip
# Runs commands one after the other; its last line says how each ended and what is loaded by then.
PROGRAM = """
import json, sys
from jaxchain.cli import main
ended = []
for arguments in json.loads(sys.argv[1]):
    try:
        status = main(arguments)
    except SystemExit as done:
        status = done.code
    ended.append([status, sorted({name.partition(".")[0] for name in sys.modules})])
print()
print(json.dumps(ended))
"""


def loaded_by(*commands):
    """Exit status of each of some `jaxchain` commands, and the packages loaded by then."""
    program = [sys.executable, "-c", PROGRAM, json.dumps(commands)]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    return [(status, set(found)) for status, found in json.loads(done.stdout.splitlines()[-1])]


def test_help_and_the_list_of_scenes_do_not_even_check():
    commands = ([], ["--help"], ["--version"], ["run", "--help"], ["resume", "--help"], ["scenes"])
    commands += (["report", "--help"],)
    for status, packages in loaded_by(*commands):
        assert status == 0
        assert not packages & {*HEAVY, "numpy", "pydantic"}


def test_scenes_are_checked_and_described_without_jax():
    commands = [["scenes", name] for name in builtin_scenes()]
    commands += [["scenes", "--schema"]]
    for command, (status, packages) in zip(commands, loaded_by(*commands), strict=True):
        assert status == 0, command
        assert not packages & HEAVY, command
        assert "pydantic" in packages


@pytest.mark.parametrize(
    "wrong",
    [
        ["fig3", "--set", "experiment.single.chain.n=-1"],
        ["fig3", "--set", "nothing=1"],
        ["no_such_scene"],
    ],
)
def test_what_is_wrong_is_refused_without_jax(wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ((status, packages),) = loaded_by(["run", *wrong])
    assert status == 2
    assert not packages & HEAVY
    assert not list(tmp_path.iterdir())


def test_a_look_at_a_store_needs_no_jax(tmp_path):
    units = tmp_path / "two.many.zarr"
    (units / "jaxchain").mkdir(parents=True)
    layout = '{"attributes": {"sizes": {"a": 3}, "chunks": {"a": 2}}}'
    (units / "jaxchain" / "zarr.json").write_text(layout)
    nothing, cut = tmp_path / "nothing", tmp_path / "cut"
    cut.mkdir()
    (cut / "one.toml").write_text(builtin_scenes()["quickstart"].read_text())
    (cut / "unfinished.txt").touch()
    commands = [["status", str(tmp_path)], ["status", str(tmp_path), "--json"]]
    commands += [["status", str(cut)], ["status", str(nothing)], ["resume", str(nothing)]]
    found = loaded_by(*commands)
    assert [status for status, _ in found] == [0, 0, 0, 2, 2]
    for _, packages in found:
        assert not packages & HEAVY - {"zarr"}


def test_what_computes_would_be_seen():
    ((_, packages),) = loaded_by(["boundary", "--n", "0"])
    assert {"jax", "jaxlib", "diffrax", "equinox"} <= packages
