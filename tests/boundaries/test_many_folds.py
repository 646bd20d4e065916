"""Folds of many sets: those of the search for one, independent of their neighbours."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from wild_sets import WILD, wild_chain, wild_sets

from jaxchain import fold_belt_speed, paper_chain
from jaxchain.boundaries import fold_belt_speeds
from jaxchain.result import SEARCH_NAMES

ONE = paper_chain(1)
# The paper's set, one that has no fold, one with friction that weakens fast, a wide one.
SETS = np.array(
    [[0.05, 0.5, 0.5, 1e-3], [0.6, 0.5, 0.5, 1e-3], [0.05, 0.5, 0.1, 1e-3], [0.05, 0.5, 0.5, 0.01]]
)


def folds_of(sets, **options):
    return fold_belt_speeds(ONE, over={"sample": dict(zip(WILD, sets.T, strict=True))}, **options)


def tame_sets(seed, count):
    rng = np.random.default_rng(seed)
    return SETS[0] * rng.uniform(0.9, 1.1, (count, 4))


@pytest.fixture(scope="module")
def found():
    return folds_of(SETS)


def test_the_folds_of_a_few_sets_and_why_one_has_none(found):
    speeds = found.fold_belt_speed.values
    np.testing.assert_allclose(speeds[[0, 3]], [1.831129820, 1.792456], rtol=3e-7)
    names = found.result.flag_meanings.split()
    assert [names[code] for code in found.result.values] == [
        "successful", "no_fold", "successful", "successful"
    ]  # fmt: skip
    np.testing.assert_array_equal(np.isnan(speeds), [False, True, False, False])
    np.testing.assert_array_equal(np.isnan(found.period), [False, True, False, False])
    assert names[:-1] == list(SEARCH_NAMES)


def test_no_set_knows_of_its_neighbours(found):
    """Bit for bit: in another order, alone, and as one more than a device takes at a time."""
    order = [2, 0, 3, 1]
    np.testing.assert_array_equal(
        folds_of(SETS[order]).fold_belt_speed, found.fold_belt_speed[order]
    )
    np.testing.assert_array_equal(folds_of(SETS[2:3]).fold_belt_speed, found.fold_belt_speed[2:3])


def test_it_is_labelled_like_a_sweep(found):
    assert found.fold_belt_speed.dims == ("sample",)
    assert set(found.coords) == set(WILD)
    assert found.damping_ratio.attrs["long_name"] == "damping ratio xi"
    assert all("units" in variable.attrs for variable in found.variables.values())
    assert found.attrs["mass"] == 0


def test_a_belt_speed_has_no_part_in_it():
    with pytest.raises(ValueError, match="'belt_speed', on which a fold does not depend"):
        fold_belt_speeds(ONE, over={"belt_speed": [1.0, 2.0]})


def test_it_refuses_to_be_traced():
    with pytest.raises(ValueError, match="`chain` is traced"):
        jax.grad(
            lambda xi: fold_belt_speeds(ONE.with_(damping_ratio=xi), over={"v_ref": [0.5]}).sum()
        )(0.05)


@pytest.mark.long
@pytest.mark.parametrize("sets", [tame_sets(3, 13), wild_sets(3, 30)], ids=["tame", "wild"])
def test_they_are_those_of_the_search_for_one(sets):
    single = jax.jit(lambda numbers: fold_belt_speed(wild_chain(numbers)))
    expected = np.array([single(jnp.asarray(numbers)) for numbers in sets])
    speeds = folds_of(sets).fold_belt_speed
    np.testing.assert_array_equal(np.isnan(speeds), np.isnan(expected))
    np.testing.assert_allclose(speeds, expected, rtol=1e-10)


INTERRUPTED = """
import os, signal, threading
import jaxchain
import numpy as np
jaxchain.configure(devices=1)
from jaxchain.boundaries import fold_belt_speeds
from jaxchain.sweeps import SweepInterrupted
one = jaxchain.paper_chain(1)
fold_belt_speeds(one, over={"damping_ratio": [0.05]})  # compiled
threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    fold_belt_speeds(one, over={"damping_ratio": np.linspace(0.04, 0.06, 20_000)})
except SweepInterrupted as caught:
    found = caught.dataset
    ended = found.result != found.result.flag_meanings.split().index("interrupted")
    assert 0 < ended.sum() < 20_000
    assert (np.isfinite(found.fold_belt_speed) == ended).all()
    print("kept")
"""


@pytest.mark.long
def test_ctrl_c_keeps_what_was_found():
    run = [sys.executable, "-c", INTERRUPTED]
    done = subprocess.run(run, capture_output=True, text=True, timeout=300)
    assert done.stdout.strip() == "kept", (done.returncode, done.stderr)
