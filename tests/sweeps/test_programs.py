"""Programs on devices: padding, counting, joining, and independence of the devices."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import serialize_executable

from jaxchain.sweeps import programs
from jaxchain.sweeps.programs import Program, map_lanes


class Logistic(eqx.Module):
    """x -> r x (1 - x), chaotic: two programs that round differently part within 100 steps."""

    rate: jax.Array


def iterated(task, start, shift):
    def step(_, x):
        return task.rate * x * (1.0 - x) + 1e-9 * jnp.sin(x)

    return {"x": jax.lax.fori_loop(0, 200, step, start), "shifted": start + shift}


@pytest.mark.parametrize("rows", [1, 4, 5])
def test_every_row_is_computed_once_whatever_the_number_of_devices(rows, monkeypatch):
    columns = [np.linspace(0.1, 0.4, rows), np.arange(float(rows))]
    task, devices = Logistic(jnp.asarray(3.9)), jax.local_devices()
    assert len(devices) > 1
    results, counted = [], []
    for own in (devices, devices[:1]):
        monkeypatch.setattr(jax, "local_devices", lambda own=own: own)
        counted.append([])
        results.append(map_lanes(iterated, task, columns, lanes=2, done=counted[-1].append))
    np.testing.assert_array_equal(results[0]["shifted"], columns[0] + columns[1])
    np.testing.assert_array_equal(results[0]["x"], results[1]["x"])
    assert np.unique(results[0]["x"]).size == rows
    assert [sum(counts) for counts in counted] == [rows, rows]


@pytest.mark.parametrize("movable", ["moved", "from the disk", "refused by JAX"])
def test_what_was_compiled_for_one_device_is_loaded_on_the_next(movable, monkeypatch):
    """With the same bits, and without another compilation, where JAX can do that."""
    compiled, new = [], float(time.time_ns())  # which does not lie in a cache

    def traced(x):
        if movable == "from the disk":  # what XLA loaded once, it cannot move
            programs._listen("/jax/compilation_cache/cache_hits")
        return jax.lax.fori_loop(0, 200, lambda _, x: 3.9 * x * (1.0 - x), x) + new

    def listen(event: str, duration_secs: float, **about: str | int) -> None:
        del duration_secs, about
        compiled.extend([event] * (event == "/jax/core/compile/backend_compile_duration"))

    if movable == "refused by JAX":
        monkeypatch.setattr(serialize_executable, "serialize", None)
    made, results = Program(traced), []
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for device in jax.local_devices()[:2]:
            x = jax.device_put(np.linspace(0.1, 0.4, 5), device)
            results.append(made.on(device, x)(x))
            assert results[-1].devices() == {device}
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    np.testing.assert_array_equal(*results)
    assert (len(compiled) == 1) == (movable == "moved")
