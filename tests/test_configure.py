"""`jaxchain.configure`: as JAX is set up once in each process, in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jaxlib.version
import pytest

import jaxchain
from jaxchain import _configure, _internals
from jaxchain._configure import _TRIED, cores

THRESHOLD = "xla_cpu_small_while_loop_byte_threshold"
OPTIONS = f"{THRESHOLD}=1000000000,xla_cpu_disable_new_fusion_emitters=true"
# Only of jaxlibs that were tried: the process here shows that they know the word.
KNOWN = jaxlib.version.__version_info__[:2] <= _TRIED
WIDTH = " --xla_cpu_prefer_vector_width=512" if KNOWN else ""
WHOLE = f"--xla_backend_extra_options={OPTIONS}{WIDTH}"
MOVED = "jaxchain.front_speed moved to jaxchain.localization.front_speed"
PROGRAM = """
import json, os, sys, warnings
import jaxchain

dir(jaxchain)
jaxchain.boundaries
heavy = {"jax", "jaxlib", "equinox", "diffrax", "numpy", "scipy", "matplotlib"}
found = {"loaded": sorted(heavy & sys.modules.keys())}
try:
    from jaxchain import front_speed
except ImportError as error:
    found["moved"] = str(error)
import jax

def note(name, **how):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        if name != "untouched":
            jaxchain.configure(**how)
    found[name] = {
        "flags": os.environ.get("XLA_FLAGS"), "x64": jax.config.jax_enable_x64,
        "cache": jax.config.jax_compilation_cache_dir,
        "devices": jax.config.jax_num_cpu_devices, "said": [str(one.message) for one in said],
    }

note("untouched")
note("left out", bits=None, devices=0, whole_loops=False)
note("everything")
note("again")
note("three", devices=3)
note("still three")
found["in use"] = len(jax.devices()), float(jax.numpy.ones(3).sum())
note("later")
note("late", devices=4)
del os.environ["XLA_FLAGS"]
note("late and bare", devices=4)
note("nothing to do", devices=3, whole_loops=False)
print(json.dumps(found))
"""


def test_importing_changes_nothing_and_one_call_sets_everything():
    ours = ("XLA_FLAGS", "JAX_ENABLE_X64", "JAX_NUM_CPU_DEVICES", "JAX_COMPILATION_CACHE_DIR")
    env = {k: v for k, v in os.environ.items() if k not in ours} | {"JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["loaded"], found["moved"]) == ([], MOVED)
    untouched = {"flags": None, "x64": False, "cache": None, "devices": -1, "said": []}
    assert found["untouched"] == found["left out"] == untouched
    wanted = {"flags": WHOLE, "x64": True, "cache": None, "devices": cores(), "said": []}
    assert found["everything"] == found["again"] == wanted
    three = wanted | {"devices": 3}
    assert found["three"] == found["still three"] == found["later"] == three
    assert found["in use"] == [3, 3.0]
    (said,) = found["late"]["said"]
    assert "so the number of devices (`devices`) could not be set: call" in said
    (said,) = found["late and bare"]["said"]
    assert "(`whole_loops`) and the number of devices (`devices`) could not be set" in said
    assert "before the first computation" in said
    assert found["late and bare"]["flags"] is None
    assert found["nothing to do"]["said"] == []


@pytest.fixture
def untouched(monkeypatch):
    """A process in which nothing is set up: the settings that JAX is given, by name."""
    for name in {"XLA_FLAGS", *os.environ}:
        if name.startswith(("XLA_FLAGS", "JAX_")):
            monkeypatch.delenv(name, raising=False)
    given = {}
    config = SimpleNamespace(
        jax_num_cpu_devices=-1, jax_compilation_cache_dir=None, update=given.__setitem__,
        jax_persistent_cache_min_compile_time_secs=1.0,
        jax_persistent_cache_min_entry_size_bytes=0,
    )  # fmt: skip
    monkeypatch.setattr(jax, "config", config)
    monkeypatch.setattr(_configure, "has_computed", lambda: False)
    monkeypatch.setattr(_internals, "forget_cache", lambda: None)
    return given


@pytest.mark.parametrize(
    ("own", "flags"),
    [
        ("--xla_backend_extra_options=xla_cpu_use_mlir=1", f"{{}},{OPTIONS}{WIDTH}"),
        ("--xla_cpu_prefer_vector_width=256", f"{{}} --xla_backend_extra_options={OPTIONS}"),
        (f"--xla_backend_extra_options={THRESHOLD}=7", "{}"),
    ],
)
def test_options_of_the_user_stay(own, flags, untouched, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", own)
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", "3")
    jaxchain.configure()
    assert os.environ["XLA_FLAGS"] == flags.format(own)
    assert untouched == {"jax_enable_x64": True}


def test_programs_are_kept_where_the_user_wants_them(untouched, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jaxchain.configure(cache=True)
    assert Path(untouched.pop("jax_compilation_cache_dir")).parent == tmp_path / "jaxchain"
    assert untouched["jax_persistent_cache_min_compile_time_secs"] == 0.0
    (tmp_path / "file").touch()
    with pytest.warns(UserWarning, match=r"cannot be kept in '.*/file' \(`cache`\): Not a dir"):
        jaxchain.configure(cache=str(tmp_path / "file"))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/nowhere")
    jaxchain.configure(cache=True)
    assert "jax_compilation_cache_dir" not in untouched
