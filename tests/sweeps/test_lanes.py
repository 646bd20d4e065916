"""Starts of lanes: the results of the user's functions, and their compiled programs."""

import functools
import gc
import weakref
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Amplitude, equation_8, paper_chain, sweep
from jaxchain.localization import mistuned_chain
from jaxchain.sweeps import programs as programs_of_lanes
from jaxchain.sweeps.lanes import RunStarts, chain_of_run
from jaxchain.sweeps.programs import KEPT_STARTS, program, start_program, starter

CHAIN = paper_chain(2, belt_speed=1.4, width=0.1)


def run(initial, vary=None, **over):
    return sweep(
        CHAIN, initial, 2.0, vary=vary, over={name: np.asarray(v) for name, v in over.items()},
        observe=Amplitude(window=1.0), solver=dfx.Heun(), rtol=1e-3, lanes=2,
        devices=jax.devices()[:1],
    )  # fmt: skip


def programs():
    """How many have been compiled: large ones, and small ones for the starts."""
    return program.cache_info().misses, start_program.cache_info().misses


def test_a_partial_of_the_same_function_and_numbers_compiles_nothing():
    def initial(chain, size, k) -> Any:
        return size * k, 0.0

    def amplitude(*args, **kwargs):
        return run(functools.partial(initial, *args, **kwargs), k=[1.0, 2.0]).amplitude.values

    once = amplitude(size=0.1)
    large, small = programs()
    np.testing.assert_array_equal(amplitude(size=0.1), once)
    assert programs() == (large, small)
    assert not np.array_equal(amplitude(size=0.2), once)
    assert programs() == (large, small + 1)
    # What can be changed in place is never taken for the same.
    size = np.asarray(0.1)
    np.testing.assert_array_equal(amplitude(size=size), once)
    size[...] = 0.2
    assert not np.array_equal(amplitude(size=size), once)


def test_the_programs_of_few_functions_are_kept(monkeypatch):
    """JAX lets go of what it compiled, and of the functions with all that they hold."""
    assert start_program.cache_info().maxsize == KEPT_STARTS
    few = functools.lru_cache(maxsize=2, typed=True)(start_program.__wrapped__)
    monkeypatch.setattr(programs_of_lanes, "start_program", few)
    alive, values = [], {"k": jnp.arange(2.0)}
    for factor in range(1, 5):

        def initial(chain, k, factor=factor) -> Any:
            return factor * k, 0.0

        alive.append(weakref.ref(initial))
        start = starter(jax.devices()[0], RunStarts(CHAIN, initial, n=CHAIN.n), values)
        assert start(values).state[0].tolist() == [[0.0] * 2, [factor] * 2]
    del initial, start  # pyright: ignore[reportPossiblyUnboundVariable]
    gc.collect()
    assert sum(function() is not None for function in alive) <= 2


def faster(chain, u):
    return chain.with_(belt_speed=u, mu_static=1.0 + u)


@pytest.mark.parametrize(
    ("vary", "new"),
    [
        pytest.param(lambda chain, u: mistuned_chain(chain, u, 0.1), 1, id="each mass"),
        pytest.param(faster, 2, id="two numbers"),
        pytest.param(lambda chain, u: chain, 0, id="nothing"),
    ],
)
def test_what_vary_leaves_as_it_is_stays_one_number_for_all_lanes(vary, new):
    """A number that every lane has to itself costs time."""
    chain = paper_chain(4, width=None)
    jobs = {"u": np.array([1, 2]), "damping_ratio": np.array([0.05, 0.06])}
    starts = RunStarts(chain, equation_8(chain, 1), vary, chain.n)
    varied = starts.varied({name: jnp.asarray(values[0]) for name, values in jobs.items()})
    assert varied is not None
    assert varied.sources.count(None) == new
    row = {name: jnp.asarray(values[1]) for name, values in jobs.items()}
    start = starts.of(row)
    made = varied.make(chain.with_(**start.numbers.numbers), start.numbers.new)
    assert eqx.tree_equal(made, chain_of_run(chain, vary, row))
