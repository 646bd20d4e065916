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


def test_every_row_is_computed_once_whatever_the_number_of_devices(monkeypatch):
    task, devices = Logistic(jnp.asarray(3.9)), jax.local_devices()
    assert len(devices) > 1
    for rows in (1, 4, 5):
        columns = [np.linspace(0.1, 0.4, rows), np.arange(float(rows))]
        results, counted = [], []
        for own in (devices, devices[:1]):
            monkeypatch.setattr(jax, "local_devices", lambda own=own: own)
            counts = []
            results.append(map_lanes(iterated, task, columns, lanes=2, done=counts.append))
            counted.append(sum(counts))
        np.testing.assert_array_equal(results[0]["shifted"], columns[0] + columns[1])
        np.testing.assert_array_equal(results[0]["x"], results[1]["x"])
        assert np.unique(results[0]["x"]).size == rows
        assert counted == [rows, rows]


@pytest.mark.parametrize("movable", ["moved", "from the disk", "refused by JAX"])
def test_what_was_compiled_for_one_device_is_loaded_on_the_next(movable, compiled, monkeypatch):
    """With the same bits, and without another compilation, where JAX can do that."""
    new = float(time.time_ns())  # which does not lie in a cache

    def traced(x):
        if movable == "from the disk":  # what XLA loaded once, it cannot move
            programs._listen("/jax/compilation_cache/cache_hits")
        return jax.lax.fori_loop(0, 200, lambda _, x: 3.9 * x * (1.0 - x), x) + new

    if movable == "refused by JAX":
        monkeypatch.setattr(serialize_executable, "serialize", None)
    made, results = Program(traced), []
    for device in jax.local_devices()[:2]:
        x = jax.device_put(np.linspace(0.1, 0.4, 5), device)
        results.append(made.on(device, x)(x))
        assert results[-1].devices() == {device}
    np.testing.assert_array_equal(*results)
    assert (len(compiled) == 1) == (movable == "moved")
