"""Programs on devices: what is padded, counted and joined, and that devices choose nothing."""

import threading
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.sweeps import programs
from jaxchain.sweeps.programs import Parts, Program, joined, map_lanes, map_on, place


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
    found, counted = [], []
    for own in (devices, devices[:1]):
        monkeypatch.setattr(jax, "local_devices", lambda own=own: own)
        counted.append([])
        found.append(map_lanes(iterated, task, columns, lanes=2, done=counted[-1].append))
    np.testing.assert_array_equal(found[0]["shifted"], columns[0] + columns[1])
    np.testing.assert_array_equal(found[0]["x"], found[1]["x"])
    assert np.unique(found[0]["x"]).size == rows
    assert [sum(counts) for counts in counted] == [rows, rows]


def test_parts_on_any_devices_do_the_same():
    devices, values = jax.local_devices()[:2], np.arange(8.0)
    for own in (devices, devices[:1], [*devices, *devices]):
        parts = Parts(own)
        tasks, dealt = parts.place(Logistic(jnp.asarray(2.0))), parts.deal({"x": values})
        doubled = joined(parts.map(lambda task, lane: task.rate * lane["x"], tasks, dealt))
        np.testing.assert_array_equal(doubled, 2.0 * values)


def test_what_was_compiled_for_one_device_is_loaded_on_the_next():
    """With the same bits, and without another compilation."""
    first, second = jax.local_devices()[:2]
    compiled = []

    def heard(event: str, duration_secs: float, **about: str | int) -> None:
        del duration_secs
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(about)

    new = float(time.time_ns())  # nor does it lie on the disk

    def run(task, x):
        return iterated(task, x, new)

    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        task, found = Logistic(jnp.asarray(3.9)), []
        for device in (first, second):
            x = jax.device_put(np.linspace(0.1, 0.4, 5), device)
            own = place(task, device)
            compiled.clear()
            found.append(map_on(run, device, own, x)["x"])
            assert found[-1].devices() == {device}
            assert len(compiled) == (device == first)
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)
    np.testing.assert_array_equal(*found)


def test_a_program_from_the_disk_is_not_moved(monkeypatch):
    """XLA cannot: what it loaded once lacks its functions when it is loaded again."""
    moved = []
    monkeypatch.setattr(programs, "_moved", lambda *a: moved.append(a))
    monkeypatch.setattr(programs, "_hits", hits := [])
    made = Program(lambda x: hits.append(threading.get_ident()) or 2.0 * x)
    for device in jax.local_devices()[:2]:
        x = jax.device_put(np.arange(3.0), device)
        np.testing.assert_array_equal(made.on(device, x)(x), [0.0, 2.0, 4.0])
    assert not moved


def test_where_jax_cannot_move_a_program_it_is_compiled_again(monkeypatch):
    monkeypatch.setattr(programs, "serialize_executable", None)
    made = Program(lambda x: 3.0 * x)
    for device in jax.local_devices()[:2]:
        x = jax.device_put(np.arange(3.0), device)
        np.testing.assert_array_equal(made.on(device, x)(x), [0.0, 3.0, 6.0])
