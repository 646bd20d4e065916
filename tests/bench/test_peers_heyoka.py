"""heyoka solves the same problem: states, and the number of landings on the belt."""

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import EventDriven, equation_8, paper_chain, simulate
from jaxchain.bench.peers import PeerMissingError
from jaxchain.bench.peers_heyoka import DryRing, heyoka, heyoka_lanes, simd_width
from jaxchain.bench.rows_heyoka import heyoka_row
from jaxchain.model import on_the_belt
from jaxchain.observers import AbstractObserver


class Landings(AbstractObserver):
    """How often a mass comes to the belt's speed, whether it sticks then or not."""

    def init(self, field, t0, t1, y0):
        return jnp.zeros((), int)

    def update(self, accumulator, step: Any):
        (_, before), (_, after) = step.y0, step.y1
        lands = (before != step.field.belt_speed) & (after == step.field.belt_speed)
        return accumulator + jnp.sum(lands)

    def read(self, accumulator):
        return accumulator


@jax.jit
def reference(chain, initial, t1):
    solver = EventDriven(8)
    return simulate(chain, initial, t1, observe=Landings(), solver=solver, rtol=1e-12, throw=False)


def end(run):
    return np.stack(run.state)


def wild_case():
    """Masses that stick for moments, pass through w = 0 either way and are torn off either way."""
    chain = paper_chain(4, belt_speed=0.1, width=None).with_(coupling=0.4)
    x, v = np.random.default_rng(3).normal(size=(2, 4))
    return chain, (jnp.asarray(4.0 * x), jnp.asarray(2.0 * v))


def cycle_case():
    chain = paper_chain(1, belt_speed=1.5, width=None)
    return chain, equation_8(chain, 1)


def belt_case():
    chain = paper_chain(1, belt_speed=1.0, width=None)
    return chain, on_the_belt(chain)


@pytest.fixture
def integrator():
    return pytest.importorskip("heyoka")


@pytest.mark.usefixtures("integrator")
@pytest.mark.parametrize(
    "case", [cycle_case, belt_case, pytest.param(wild_case, marks=pytest.mark.long)]
)
def test_the_peer_comes_to_the_same_state_by_as_many_landings(case):
    chain, initial = case()
    run = reference(chain, initial, 20.0)
    assert int(run.observed) >= 3
    ring = DryRing(chain, 1e-15)
    x, v = (np.asarray(part) for part in initial)
    found = ring.run(float(chain.belt_speed), (x, v), 20.0)[..., 0]
    np.testing.assert_allclose(found, end(run), atol=1e-9)
    assert ring.landings == int(run.observed)
    assert ring.events > ring.landings  # some of them stick, and are torn off again


@pytest.mark.usefixtures("integrator")
def test_a_second_run_knows_nothing_of_the_first():
    chain, initial = cycle_case()
    run = heyoka(chain, initial, 20.0)
    np.testing.assert_array_equal(run(1e-6), run(1e-6))


@pytest.mark.usefixtures("integrator")
@pytest.mark.parametrize("width", [1, 2])
def test_lanes_in_batches_come_to_the_same_states_each(width):
    chain, _ = cycle_case()
    belt_speeds = [1.4, 1.5, 1.6, 1.7]
    chains = [chain.with_(belt_speed=speed) for speed in belt_speeds]
    starts = [equation_8(own, 1) for own in chains]
    initial = jax.tree.map(lambda *parts: jnp.stack(parts), *starts)
    found = heyoka_lanes(chain, belt_speeds, initial, 20.0, width)(1e-15)
    expected = [end(reference(*lane, 20.0)) for lane in zip(chains, starts, strict=True)]
    np.testing.assert_allclose(found, np.stack(expected, axis=1), atol=1e-9)


@pytest.mark.usefixtures("integrator")
def test_chains_and_batches_that_the_peer_cannot_run_are_refused():
    chain = paper_chain(4, width=None)
    with pytest.raises(ValueError, match="normal load"):
        DryRing(chain.with_(normal_load=1.0), 1e-6)
    with pytest.raises(ValueError, match="multiple of 2"):
        heyoka_lanes(chain, [1.4, 1.5, 1.6], equation_8(chain, 1), 1.0, 2)


def test_without_heyoka_the_row_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "heyoka", None)
    with pytest.raises(PeerMissingError):
        simd_width()
    (row,) = heyoka_row(1)
    assert "pip install 'jaxchain[peers]'" in row.note
    assert row.met is None
