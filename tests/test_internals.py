"""The parts of JAX and equinox that may change: all in one module, and dispensable."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxchain import _internals

ROOT = Path(_internals.__file__).parent
PRIVATE = re.compile(
    r"jax\._src|jax\.interpreters|jax\.experimental|jax\.extend|equinox\.internal|str\(jax\.make_jaxpr"
)

# A run of each kind, with derivatives forward.
RUNS = """
import jax, jax.numpy as jnp, jaxchain

def numbers(width, solver):
    chain = jaxchain.paper_chain(2, 1.2, width)
    start = jaxchain.excited_state(chain, 1)

    def run(belt_speed):
        now = chain.with_(belt_speed=belt_speed)
        return jnp.concatenate(jaxchain.simulate(now, start, 3.0, solver=solver).state)

    along = lambda belt_speed: jax.jvp(run, (belt_speed,), (1.0,))
    return [part.tolist() for part in jax.jit(jax.vmap(along))(jnp.array([1.1, 1.2]))]

found = [numbers(0.05, jaxchain.Rodas4()), numbers(None, jaxchain.EventDriven(6))]
"""
WITHOUT = """
import builtins, json
real = builtins.__import__

def without(name, globals=None, *how):
    own = globals and globals.get("__name__") == "jaxchain._internals"
    private = "jax._src", "jax.experimental", "jax.interpreters", "jax.extend", "equinox"
    if own and name.startswith(private):
        raise ImportError(name)
    return real(name, globals, *how)

builtins.__import__ = without
import jax
jax.config.update("jax_enable_x64", True)
"""


def test_no_other_module_uses_them():
    files = [f for f in ROOT.rglob("*.py") if f.name != "_internals.py"]
    assert len(files) > 100
    found = {
        str(file.relative_to(ROOT)): uses
        for file in files
        if (uses := PRIVATE.findall(file.read_text(encoding="utf-8")))
    }
    assert not found


def test_this_version_of_jax_has_them_all():
    """Where one is gone, this fails, and the library goes on with its fallback."""
    assert not _internals.missing
    program = jax.make_jaxpr(jax.nn.softplus)(1.0)
    (step,) = program.jaxpr.eqns
    assert _internals.name_of_program(step.params["jaxpr"]) == "softplus"
    assert _internals.uses_operation(program, "log1p")
    assert not _internals.uses_operation(program, "tanh")


@pytest.mark.long
@pytest.mark.slow
def test_without_them_runs_and_forward_derivatives_are_the_same():
    tell = "\nprint(json.dumps([jaxchain._internals.missing, found]))"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", WITHOUT + RUNS + tell],
        env=os.environ | {"JAX_PLATFORMS": "cpu"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    missing, found = json.loads(done.stdout)
    assert {"arrays computed once", "derivatives in both modes", "Taylor mode"} <= set(missing)
    here: dict = {}
    exec(RUNS, here)
    np.testing.assert_allclose(found, here["found"], rtol=1e-9, atol=1e-11)
