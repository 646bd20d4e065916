"""Compiled programs kept for the next process, in processes of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import jaxchain._program_folder as programs

RUN = """
import json, sys, warnings
import jax, jaxchain
from jax import monitoring
counts = {}
def count(event, *_, **__):
    counts[event.rpartition("/")[2]] = counts.get(event.rpartition("/")[2], 0) + 1
monitoring.register_event_listener(count)
if "late" in sys.argv:
    jax.numpy.ones(3).sum()
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    jaxchain.configure(devices=0, whole_loops="late" not in sys.argv, cache=sys.argv[1])
numbers = []
if "settings" not in sys.argv:
    from jaxchain import excited_state, paper_chain, simulate
    for width in (1e-2, None):
        chain = paper_chain(3, 1.5, width)
        run = simulate(chain, excited_state(chain, 1), 10.0)
        numbers += [float(x).hex() for part in run.state for x in part]
print(json.dumps({
    "numbers": numbers, "kept": counts.get("cache_hits", 0),
    "compiled": counts.get("cache_misses", 0), "said": [str(one.message) for one in said],
    "folder": jax.config.jax_compilation_cache_dir,
    "least": [jax.config.jax_persistent_cache_min_compile_time_secs,
              jax.config.jax_persistent_cache_min_entry_size_bytes],
}))
"""


def start(*arguments, **environment):
    """A process that computes a little with compiled programs kept in a folder."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    return subprocess.Popen(
        [sys.executable, "-c", RUN, *map(str, arguments)], stdout=subprocess.PIPE, text=True,
        env=env | {"JAX_PLATFORMS": "cpu", **environment},
    )  # fmt: skip


def end(process):
    told, _ = process.communicate()
    assert process.returncode == 0
    return json.loads(told)


@pytest.mark.long
def test_a_second_process_compiles_nothing_and_its_results_are_the_same_to_the_last_bit(tmp_path):
    first = end(start(tmp_path))
    assert first["compiled"] > 0
    stored = len(list(Path(first["folder"]).glob("*-program")))
    assert stored >= 4  # which are not asked for in JAX's own cache
    second = end(start(tmp_path))
    assert second["compiled"] == 0
    assert second["kept"] == first["kept"] + first["compiled"] - stored
    assert second["numbers"] == first["numbers"]
    # Without small loops compiled whole all is another program, kept also if JAX was used before.
    assert end(start(tmp_path, "late"))["compiled"] > 0
    assert end(start(tmp_path, "late"))["compiled"] == 0


@pytest.mark.long
def test_processes_at_once_and_torn_files_do_no_harm(tmp_path):
    found = [end(process) for process in [start(tmp_path) for _ in range(3)]]
    assert found[0]["numbers"] == found[1]["numbers"] == found[2]["numbers"]
    for file in Path(found[0]["folder"]).iterdir():
        file.write_bytes(file.read_bytes()[:100])
    again = end(start(tmp_path))
    assert again["numbers"] == found[0]["numbers"]
    assert again["kept"] == 0


def test_a_folder_that_cannot_be_written_in_is_left_out(tmp_path):
    file = tmp_path / "file"
    file.touch()
    found = end(start(file, "settings"))
    assert found["folder"] is None
    (said,) = found["said"]
    assert f"cannot be kept in '{file}' (`cache`): Not a directory" in said


def test_what_the_user_has_chosen_of_it_stays(tmp_path):
    mine = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "mine"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1",
    }
    found = end(start(tmp_path / "other", "settings", **mine))
    assert found["folder"] == mine["JAX_COMPILATION_CACHE_DIR"]
    assert found["least"] == [1.0, -1]
    assert not (tmp_path / "other").exists()


def test_each_version_and_each_kind_of_cpu_has_a_folder_of_its_own(monkeypatch):
    import jaxlib.version

    assert programs._cpu()
    own = programs._machine()
    assert own == programs._machine()
    assert f"jaxlib-{jaxlib.version.__version__}-" in own
    with monkeypatch.context() as patch:
        patch.setattr(jaxlib.version, "__version__", "0.0.1")
        assert programs._machine() != own
    monkeypatch.setattr(programs, "_cpu", lambda: "another one")
    assert programs._machine() != own
