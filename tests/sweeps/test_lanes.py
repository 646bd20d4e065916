"""Lanes on every device: what is padded, counted and joined, and that devices choose nothing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.sweeps.lanes import Parts, joined, map_lanes


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


def test_parts_of_one_device_and_a_part_of_several_do_the_same():
    devices, values = jax.local_devices()[:2], np.arange(8.0)
    for groups in ([devices], [[d] for d in devices], [devices[:1]] * 4):
        parts = Parts(groups)
        tasks, dealt = parts.place(Logistic(jnp.asarray(2.0))), parts.deal({"x": values})
        doubled = joined(parts.map(lambda task, lane: task.rate * lane["x"], tasks, dealt))
        np.testing.assert_array_equal(doubled, 2.0 * values)
