"""Commands without computation do not import JAX: checked in a fresh process."""

import json
import subprocess
import sys

from jaxchain.scenes.files import builtin_scenes

HEAVY = {
    "jax", "jaxlib", "diffrax", "equinox", "scipy", "pandas", "xarray", "matplotlib", "zarr",
    "h5netcdf", "tqdm", "jinja2",
}  # fmt: skip
# Runs commands one after the other; its last line says how each ended and what is loaded by then.
PROGRAM = """
import json, sys
import jaxchain.model.parameters  # which need none either
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


def test_help_lists_and_a_look_at_a_store_need_no_jax(tmp_path):
    units = tmp_path / "two.many.zarr"
    (units / "jaxchain").mkdir(parents=True)
    layout = '{"attributes": {"sizes": {"a": 3}, "chunks": {"a": 2}}}'
    (units / "jaxchain" / "zarr.json").write_text(layout)
    nothing, cut = tmp_path / "nothing", tmp_path / "cut"
    cut.mkdir()
    (cut / "one.toml").write_text(builtin_scenes()["quickstart"].read_text())
    (cut / "unfinished.txt").touch()
    light = [[], ["--help"], ["--version"], ["run", "--help"], ["report", "--help"], ["scenes"]]
    commands = [["status", str(tmp_path)], ["status", str(tmp_path), "--json"]]
    commands += [["status", str(cut)], ["status", str(nothing)], ["resume", str(nothing)]]
    # The last one computes: it would be seen.
    found = loaded_by(*light, *commands, ["boundary", "--n", "0"])
    assert [status for status, _ in found] == [*[0] * len(light), 0, 0, 0, 2, 2, 2]
    for _, packages in found[: len(light)]:
        assert not packages & {*HEAVY, "numpy", "pydantic"}
    for _, packages in found[:-1]:
        assert not packages & HEAVY - {"zarr"}
    assert {"jax", "jaxlib", "diffrax", "equinox"} <= found[-1][1]
