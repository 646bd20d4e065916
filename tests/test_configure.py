"""`jaxchain.configure`: in processes of their own, as JAX is set up once in each."""

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import jaxlib.version
import pytest

import jaxchain
from jaxchain._configure import _TRIED, cores

THRESHOLD = "xla_cpu_small_while_loop_byte_threshold"
OPTIONS = f"{THRESHOLD}=1000000000,xla_cpu_disable_new_fusion_emitters=true"
# Only of jaxlibs that were tried: each process here shows that they know the word.
KNOWN = jaxlib.version.__version_info__[:2] <= _TRIED
WIDTH = " --xla_cpu_prefer_vector_width=512" if KNOWN else ""
WHOLE = f"--xla_backend_extra_options={OPTIONS}{WIDTH}"
TELL = """
import json, os, warnings
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    {code}
import jax
print(json.dumps({{
    "flags": os.environ.get("XLA_FLAGS"), "x64": jax.config.jax_enable_x64,
    "cache": jax.config.jax_compilation_cache_dir,
    "devices": len(jax.devices()), "said": [str(one.message) for one in said],
}}))
"""


@functools.cache
def told(code, **environment):
    """The settings of JAX after `code`."""
    ours = ("XLA_FLAGS", "JAX_ENABLE_X64", "JAX_NUM_CPU_DEVICES", "JAX_COMPILATION_CACHE_DIR")
    env = {k: v for k, v in os.environ.items() if k not in ours}
    env |= {"JAX_PLATFORMS": "cpu", **environment}
    code = TELL.format(code="\n    ".join(code.splitlines()))
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def test_importing_changes_nothing_and_one_call_sets_everything():
    untouched = {"flags": None, "x64": False, "cache": None, "devices": 1, "said": []}
    assert told("import jaxchain") == untouched
    # Also after `import jax`; a second call says nothing, nor one after something is computed.
    code = "import jax\nimport jaxchain\njaxchain.configure()\njaxchain.configure()"
    later = "\njax.numpy.ones(3).sum()\njaxchain.configure()"
    wanted = {"flags": WHOLE, "x64": True, "cache": None, "devices": cores(), "said": []}
    assert told(code + later) == wanted


def test_each_part_can_be_left_out():
    code = "import jaxchain\njaxchain.configure(bits=None, devices=0, whole_loops=False)"
    assert told(code) == told("import jaxchain")
    assert told("import jaxchain\njaxchain.configure(devices=3)")["devices"] == 3


def test_settings_of_the_user_stay(tmp_path):
    own_flags = "--xla_cpu_enable_fast_math=false --xla_backend_extra_options=xla_cpu_use_mlir=1"
    code = "import jaxchain\njaxchain.configure(cache=True)"
    found = told(
        code, XLA_FLAGS=own_flags, JAX_NUM_CPU_DEVICES="3", JAX_COMPILATION_CACHE_DIR="/nowhere"
    )
    assert found["flags"] == f"{own_flags},{OPTIONS}{WIDTH}"
    narrow = "--xla_cpu_prefer_vector_width=256"
    assert (
        told(code, XLA_FLAGS=narrow)["flags"] == f"{narrow} --xla_backend_extra_options={OPTIONS}"
    )
    assert found["devices"] == 3
    assert found["cache"] == "/nowhere"
    own_flags = (
        f"--xla_force_host_platform_device_count=4 --xla_backend_extra_options={THRESHOLD}=7"
    )
    found = told(code, XLA_FLAGS=own_flags, XDG_CACHE_HOME=str(tmp_path))
    assert found["flags"] == own_flags
    assert found["devices"] == 4
    assert Path(found["cache"]).parent == tmp_path / "jaxchain"
    # By an earlier call.
    code = "import jaxchain\njaxchain.configure(devices=3)\njaxchain.configure()"
    assert told(code)["devices"] == 3


def test_called_too_late_it_names_the_settings_without_effect():
    late = "import jax\nimport jaxchain\njax.numpy.ones(3).sum()\n"
    found = told(late + "jaxchain.configure(devices=3)")
    (said,) = found["said"]
    assert "(`whole_loops`) and the number of devices (`devices`) could not be set" in said
    assert "before the first computation" in said
    assert found["x64"]  # which can be set at any time
    assert found["flags"] is None
    assert told(late + "jaxchain.configure(devices=1, whole_loops=False)")["said"] == []
    (said,) = told(late + "jaxchain.configure(devices=0)")["said"]
    assert "so small loops compiled whole (`whole_loops`) could not be set" in said


def test_a_folder_that_cannot_be_written_in_is_left_out(tmp_path):
    file = tmp_path / "file"
    file.touch()
    found = told(f"import jaxchain\njaxchain.configure(cache={str(file)!r})")
    assert found["cache"] is None
    (said,) = found["said"]
    assert f"cannot be kept in '{file}' (`cache`): Not a directory" in said


@pytest.mark.long
def test_a_second_process_compiles_nothing_and_its_results_are_the_same_to_the_last_bit(tmp_path):
    code = f"""import jax, jaxchain
jaxchain.configure(devices=0, cache={str(tmp_path)!r})
misses = []
jax.monitoring.register_event_listener(
    lambda event, **_: misses.append(event) if event.endswith("cache_misses") else None)
chain = jaxchain.paper_chain(3, 1.5, 1e-2)
run = jaxchain.simulate(chain, jaxchain.excited_state(chain, 1), 10.0)
warnings.warn(f"{{len(misses)}} {{[float(x).hex() for part in run.state for x in part]}}")"""
    first, second = told(code)["said"][0], told(code + "\n")["said"][0]
    assert int(first.split()[0]) > 0
    assert second == "0 " + first.split(" ", 1)[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"bits": 32}, "`bits` must be 64"),
        ({"devices": -1}, "`devices` must be a number of devices"),
        ({"devices": 10**30}, "`devices` must be a number of devices"),
        ({"devices": True}, "`devices` must be a number of devices"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        jaxchain.configure(**arguments)
