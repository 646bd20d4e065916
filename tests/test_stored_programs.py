"""Programs that the next process need not trace."""

import os
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxchain._program_folder as programs
from jaxchain import hopf_belt_speed, paper_chain
from jaxchain._stored_programs import _code, stored_jit
from jaxchain.model.friction import AbstractFrictionLaw, ExponentialDecay

traced = []


def scaled(numbers, by, *, shift=0):
    """What is to be stored; arrays and what is none go in and come out."""
    traced.append(by)
    return {"sum": numbers["x"] * by + shift, "told": (by, None)}


def greeting(x):
    traced.append("greeting")
    return jax.pure_callback(lambda x: np.asarray(x) + 1.0, x, x)


def orbit(x):
    return jax.lax.fori_loop(0, 20, lambda _, x: x - 0.1 * jnp.exp(-jnp.sin(x)), x)


def through(law, speed):
    traced.append("law")
    return law.coefficient(speed)


class OwnLaw(AbstractFrictionLaw):
    """A law of a user, whose code may change."""

    mu_static: float
    mu_dynamic: float
    v_ref: float

    def coefficient(self, speed: Any) -> Any:
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) / (1.0 + speed / self.v_ref)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "folder", str(tmp_path))
    traced.clear()
    return tmp_path


def stored(folder):
    return sorted(path.name for path in folder.glob("*-program"))


X = jnp.arange(3.0)


def test_what_is_stored_is_not_traced_again_and_gives_the_same(folder):
    first = stored_jit(scaled)({"x": X}, 2, shift=1.0)
    assert traced == [2]
    assert len(stored(folder)) == 1
    # As in another process: nothing of the first one is known.
    run = stored_jit(scaled)
    for _ in range(2):
        again = run({"x": X}, 2, shift=1.0)
        assert traced == [2]
        assert again["told"] == first["told"] == (2, None)
        assert np.array_equal(again["sum"], first["sum"])
    assert np.array_equal(first["sum"], 2 * X + 1.0)


def test_what_may_decide_a_program_makes_another_one(folder, monkeypatch):
    def count(*args, **named):
        stored_jit(scaled)(*args, **named)
        return len(stored(folder))

    assert count({"x": X}, 2) == 1
    assert count({"x": X + 1.0}, 2) == 1
    assert count({"x": X}, 2.0) == 2
    assert count({"x": X[:2]}, 2) == 3
    assert count({"x": X.astype(jnp.float32)}, 2) == 4
    assert count({"x": X, "y": X}, 2) == 5
    assert count({"x": X}, by=2) == 6
    with jax.default_matmul_precision("highest"):
        assert count({"x": X}, 2) == 7
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " ")
    assert count({"x": X}, 2) == 8
    monkeypatch.setattr("jaxchain._stored_programs._code", lambda room: "a later version")
    assert count({"x": X}, 2) == 9


def test_each_line_of_the_code_counts(tmp_path):
    (tmp_path / "room").mkdir()
    code = set()
    for name, text in (("room/a.py", "1"), ("room/a.py", "2"), ("b.py", ""), ("b.txt", "")):
        (tmp_path / name).write_text(text)
        _code.cache_clear()
        code.add(_code(str(tmp_path)))
    assert len(code) == 3


def test_one_program_for_each_structure_also_within_a_process(folder):
    run = stored_jit(scaled)
    assert run({"x": X}, 1)["sum"].dtype == run({"x": X}, 1.0)["sum"].dtype
    assert run({"x": jnp.arange(3)}, 1)["sum"].dtype == int
    assert run({"x": jnp.arange(3)}, 1.0)["sum"].dtype == float
    assert run({"x": X}, 1)["told"][0] == 1
    assert isinstance(run({"x": X}, 1)["told"][0], int)
    assert len(stored(folder)) == 4


def test_transformations_go_the_ordinary_way(folder):
    run = stored_jit(scaled)
    assert float(jax.grad(lambda x: run({"x": x}, 3)["sum"])(1.0)) == 3.0
    assert np.array_equal(jax.vmap(lambda x: run({"x": x}, 3)["sum"])(X), 3 * X)
    assert np.array_equal(jax.jit(lambda x: run({"x": x}, 3)["sum"])(X), 3 * X)
    assert stored(folder) == []


def test_without_a_folder_nothing_is_stored(folder, monkeypatch):
    monkeypatch.setattr(programs, "folder", None)
    assert np.array_equal(stored_jit(scaled)({"x": X}, 2)["sum"], 2 * X)
    assert stored(folder) == []


@pytest.mark.parametrize(
    ("name", "value"), [("jax_enable_compilation_cache", False), ("jax_disable_jit", True)]
)
def test_nor_if_jax_is_told_to_keep_nothing_or_to_be_slow(folder, name, value):
    before = getattr(jax.config, name)
    jax.config.update(name, value)
    try:
        assert np.array_equal(stored_jit(scaled)({"x": X}, 2)["sum"], 2 * X)
    finally:
        jax.config.update(name, before)
    assert stored(folder) == []


def test_an_array_on_another_device_stays_there(folder):
    other = jax.devices()[-1]
    assert other != jax.devices()[0]
    found = stored_jit(scaled)({"x": jax.device_put(X, other)}, 2)
    assert found["sum"].devices() == {other}
    assert stored(folder) == []


def test_what_is_found_may_be_taken_to_another_device(folder):
    for _ in range(2):
        found = stored_jit(scaled)({"x": X}, 2)["sum"]
        assert np.array_equal(found + jax.device_put(X, jax.devices()[-1]), 3 * X)


def test_code_of_a_user_is_traced_anew_in_each_process(folder):
    numbers = {"mu_static": 0.2, "mu_dynamic": 0.1, "v_ref": 0.5}
    for law, count in ((OwnLaw(**numbers), 0), (ExponentialDecay(**numbers), 1)):
        found = [float(stored_jit(through)(law, X)[0]) for _ in range(2)]
        assert found[0] == found[1] == pytest.approx(0.2)
        assert len(stored(folder)) == count


def test_a_program_that_calls_the_host_is_not_stored(folder):
    assert np.array_equal(stored_jit(greeting)(X), X + 1.0)
    assert stored(folder) == []


@pytest.mark.parametrize("harm", [lambda b: b[:-9], lambda b: b"", lambda b: b[:80] + b[81:]])
def test_a_file_that_was_cut_short_is_made_anew(folder, harm):
    stored_jit(scaled)({"x": X}, 2)
    (name,) = stored(folder)
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(harm(whole))
    assert np.array_equal(stored_jit(scaled)({"x": X}, 2)["sum"], 2 * X)
    assert traced == [2, 2]
    stored_jit(scaled)({"x": X}, 2)
    assert traced == [2, 2]


def test_a_folder_that_cannot_be_written_in_does_no_harm(folder, monkeypatch):
    monkeypatch.setattr(programs, "folder", str(folder / "gone"))
    assert np.array_equal(stored_jit(scaled)({"x": X}, 2)["sum"], 2 * X)


UNEQUAL = """
import sys
import jax, jaxchain, numpy
jaxchain.configure(cache=sys.argv[1])
from jaxchain import hopf_belt_speed, paper_chain
traced = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **about: "jaxpr_trace" in event and traced.append(about.get("fun_name"))
)
chain = paper_chain(n=2).with_(damping_ratio=numpy.array([0.04, 0.06]))
print(float(hopf_belt_speed(chain)).hex(), any("_speed" in str(name) for name in traced))
"""


@pytest.mark.long
def test_another_process_finds_linear_algebra_too(tmp_path):
    """JAX looks for LAPACK when it lowers a call of it: without that the process would end."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    said = []
    for _ in range(2):
        command = [sys.executable, "-c", UNEQUAL, str(tmp_path)]
        done = subprocess.run(
            command, capture_output=True, text=True, env=env | {"JAX_PLATFORMS": "cpu"}
        )
        assert done.returncode == 0, done.stderr
        said.append(done.stdout.split())
    (first, new), (second, newly) = said
    assert (new, newly) == ("True", "False")
    assert first == second
    chain = paper_chain(n=2).with_(damping_ratio=np.array([0.04, 0.06]))
    assert float.fromhex(first) == pytest.approx(float(hopf_belt_speed(chain)), rel=1e-12)


def test_what_jax_has_kept_itself_is_compiled_anew(folder):
    """What XLA has read from a disk loses its functions when it is written there again."""

    def run():
        return stored_jit(orbit)(X)

    first = run()
    for name in stored(folder):
        (folder / name).unlink()
    for _ in range(2):
        assert np.array_equal(run(), first)
