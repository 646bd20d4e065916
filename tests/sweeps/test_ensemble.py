"""Sweeps: labels of results, and detection of every change that affects numbers."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from stores import OVER, small

import jaxchain
from jaxchain import (
    Amplitude,
    Chain,
    EventDriven,
    Method,
    PeakTimes,
    equation_8,
    paper_chain,
)
from jaxchain.model import AbstractFrictionLaw
from jaxchain.observers.base import AbstractObserver, Variable
from jaxchain.result import NAMES
from jaxchain.sweeps import ensemble as module
from jaxchain.sweeps.ensemble import RunSettings, fingerprint_of, prepare, to_dataset
from jaxchain.sweeps.store import differences

CHAIN = paper_chain(2, belt_speed=1.4, width=None)
SPEEDS = {"belt_speed": [1.0, 1.2]}
FACTOR = 1.0


class Law(AbstractFrictionLaw):
    """Of one's own."""

    mu_static: float = 1.0

    def coefficient(self, speed):
        return jnp.asarray(self.mu_static / (1.0 + speed))


class Other(Law):
    def coefficient(self, speed):
        return jnp.asarray(self.mu_static / (1.0 + 2.0 * speed))


class Mine(AbstractObserver):
    function: Callable = eqx.field(static=True)
    factor: float = 1.0

    def init(self, field, t0, t1, y0):
        return y0[0]

    def update(self, accumulator, step):
        return self.function(step.y1[0]) * self.factor * FACTOR

    def read(self, accumulator):
        return accumulator

    def label(self, value, model):
        return {"mine": Variable(value, ("oscillator",))}


def own(law):
    return Chain(2, law, belt_speed=1.4, coupling=0.01)


def start(constant):
    """A function that holds a number, an array of NumPy or one of JAX."""
    return lambda chain: (jnp.zeros(chain.n) + constant, jnp.zeros(chain.n))


def loose(constant):
    return lambda chain: chain.with_(damping_ratio=constant)


def smoothed(**changes):
    return {"model": paper_chain(2, belt_speed=1.4, width=1e-2)} | changes


def numbers(scale):
    return scale * np.arange(1.0, 3.0)


# Before, after, and what has changed.
CHANGES = {
    "rtol": ({"rtol": 1e-6}, {"rtol": 1e-7}, r"solver.rtol was 1e-06 and is 1e-07"),
    "max_step": ({}, {"max_step": 0.1}, r"solver.max_step was 0.5 and is 0.1"),
    "t1": ({}, {"t1": 21.0}, r"t1 was 20.0 and is 21.0"),
    "steps": ({}, {"max_steps": 900}, r"max_steps was absent and is 900"),
    "segments": ({}, {"segments": 2}, r"segments was absent and is 2"),
    "lanes": ({}, {"lanes": 5}, r"lanes was 4 and is 5"),
    "accuracy": (
        smoothed(accuracy=1e-2), smoothed(accuracy=1e-3), r"accuracy was 0.01 and is 0.001"
    ),
    "solver's setting": (
        {"solver": EventDriven()}, {"solver": EventDriven(order=8)}, r"solver"
    ),
    "n": ({}, {"model": paper_chain(3, 1.4, None)}, r"chain.n was 2 and is 3"),
    "chain number": (
        {}, {"model": CHAIN.with_(damping_ratio=0.04)}, r"damping_ratio was 0.05 and is 0.04"
    ),
    "many masses": (
        {"model": paper_chain(9).with_(stiffness=np.linspace(1.0, 1.1, 9))},
        {"model": paper_chain(9).with_(stiffness=np.linspace(1.0, 1.2, 9))},
        r"chain.stiffness has changed",
    ),
    "own law": ({"model": own(Law())}, {"model": own(Other())}, r"friction.curve has changed"),
    "smoothed": ({}, smoothed(), r"chain.width was absent and is 0.01"),
    "another observer": (
        {}, {"observe": [Amplitude(window=6.0), PeakTimes(3)]},
        r"observers.1.window was 5.0 and is 6.0;.*observers.2.kind was absent",
    ),
    "observer's number": (
        {"observe": Mine(abs)}, {"observe": Mine(abs, 2.0)}, r"observers.1.factor was 1.0 and is 2"
    ),
    "observer's function": (
        {"observe": Mine(lambda x: x)}, {"observe": Mine(lambda x: -x)},
        r"observers.1.code has changed",
    ),
    **{
        f"captured {kind.__name__}": (
            {"initial": start(kind(1.0)), "over": SPEEDS},
            {"initial": start(kind(2.0)), "over": SPEEDS}, r"initial and vary has changed",
        )
        for kind in (float, jnp.asarray, numbers)
    },
    "vary": ({"vary": loose(0.1)}, {"vary": loose(0.2)}, r"initial and vary has changed"),
    "vary's choice": (
        {"vary": lambda chain: eqx.tree_at(lambda c: c.stiffness, chain, chain.damping_ratio)},
        {"vary": lambda chain: eqx.tree_at(lambda c: c.stiffness, chain, chain.belt_speed)},
        r"initial and vary has changed",
    ),
    "dimension": (
        {}, {"over": OVER | {"mu_static": [1.0]}}, r"over.mu_static was absent and is"
    ),
    "together": (
        {"over": {"excited": OVER["excited"], "set": {"belt_speed": [1.0]}}},
        {"over": {"excited": OVER["excited"], "set": {"belt_speed": [1.0], "width": [1e-2]}},
         **smoothed()},
        r"over.set was \['belt_speed'\] and is \['belt_speed', 'width'\]",
    ),
}  # fmt: skip


def known(lanes=4, over=OVER, **changes):
    """By what a store would know such a sweep."""
    given: Any = {"model": CHAIN, "initial": equation_8, "t1": 20.0}
    fields = ("solver", "rtol", "atol", "max_step", "max_steps")
    method = Method(**{name: changes.pop(name) for name in fields if name in changes})
    given |= {"observe": Amplitude(window=5.0), "method": method}
    return fingerprint_of(prepare(RunSettings(**(given | changes)), over, 10**6), lanes)


@pytest.fixture(scope="module")
def usual():
    return known()


@pytest.mark.parametrize("change", CHANGES)
def test_what_decides_a_number_is_seen_when_it_changes(usual, change):
    before, after, message = CHANGES[change]
    first = known(**before) if before else usual
    assert re.search(message, "; ".join(differences(first, known(**after))))


def test_the_tolerance_that_accuracy_picks_is_the_tightest_of_all_blocks(monkeypatch):
    smooth: Any = smoothed(accuracy=1e-2)
    whole, chunks_of = known(**smooth)["solver"], module.chunks_of
    monkeypatch.setattr(module, "chunks_of", lambda axes, size: chunks_of(axes, 1))
    assert known(**smooth)["solver"] == whole


def test_so_is_other_code_of_the_package_of_a_library_or_behind_an_observer(usual, monkeypatch):
    before = known(observe=Mine(abs))
    monkeypatch.setitem(globals(), "FACTOR", 2.0)
    assert differences(before, known(observe=Mine(abs))) == ["observers.1.code has changed"]
    newer = module.versions() | {"jax": "99.0", "python": "4"}
    monkeypatch.setattr(module, "code", lambda: "sha256 other")
    monkeypatch.setattr(module, "versions", lambda: newer)
    found = "; ".join(differences(usual, known()))
    assert re.search(r"versions.jax was .* and is 99.0; code of jaxchain has changed", found)


def test_what_decides_nothing_may_change(usual):
    change: Any
    for change in (
        {"initial": lambda chain, excited: equation_8(chain, excited)},  # under another name
        {"model": CHAIN.with_(belt_speed=3.0)},  # which is swept
        {"over": OVER | {"belt_speed": [1.0, 7.0]}},  # a store compares the values itself
        {"t1": 20},
    ):
        assert differences(usual, known(**change)) == []
    # The same, made anew.
    for make in (
        lambda: {"initial": start(numbers(1.0)), "over": SPEEDS},
        lambda: {"model": own(Law()), "observe": Mine(abs), "vary": loose(0.1)},
    ):
        assert differences(known(**make()), known(**make())) == []


def test_a_store_names_what_has_changed(tmp_path):
    over, message = OVER | {"excited": [0, 2, 1]}, r"over\['excited'\] has other values of excited"
    small(tmp_path / "a.zarr")
    for change, words in (({"over": over}, message), ({"t1": 21.0}, "t1 was 20.0 and is 21.0")):
        with pytest.raises(ValueError, match=f"belongs to another sweep: {words}") as caught:
            small(tmp_path / "a.zarr", **change)
        assert str(caught.value).endswith(
            "Sweep as before, with values added at the end of a dimension at most, or give "
            "another `store`."
        )


def test_all_of_the_package_that_a_lane_runs_is_in_the_code_version():
    root = Path(jaxchain.__file__).parent
    covered = {
        file
        for part in module._CODE
        for file in ([root / part] if part.endswith(".py") else (root / part).rglob("*.py"))
    }
    assert all(file.exists() for file in covered)
    assert {root / "result.py", root / "sweeps/lanes.py", root / "solvers/rosenbrock.py"} < covered


COUNTS = ("active_count", "steps", "rejected")


def test_counts_are_integers_on_disk_and_missing_again_when_read(tmp_path):
    """Of a lane that ended well, one that failed, and one that was interrupted."""
    chain = paper_chain(4)
    values = np.full((3, 4), np.nan)
    values[0] = 1.5, 1.5, 0.1, 0.0
    observed = jax.vmap(lambda one: Amplitude(window=20.0).label(one, chain))(values)
    records = {
        "result": np.array([NAMES.index(r) for r in ("successful", "nonfinite", "interrupted")]),
        "end_time": np.array([60.0, 7.0, np.nan]),
        "steps": np.array([300, 200, 0]),
        "rejected": np.array([30, 10, 0]),
        "observed": jax.tree.map(np.asarray, observed),
    }
    three = to_dataset(records, {"excited": {"excited": np.arange(3)}}, chain, chain.n, {})
    three.to_netcdf(tmp_path / "r.nc", engine="h5netcdf")
    three.to_zarr(tmp_path / "r.zarr", consolidated=False)
    kinds: Any = (("r.nc", {"engine": "h5netcdf"}), ("r.zarr", {"consolidated": False}))
    for name, options in kinds:
        with xr.open_dataset(tmp_path / name, mask_and_scale=False, **options) as raw:
            assert all(np.issubdtype(raw[count].dtype, np.integer) for count in COUNTS)
            assert all(raw[count].attrs["_FillValue"] == -1 for count in COUNTS)
        with xr.open_dataset(tmp_path / name, **options) as again:
            xr.testing.assert_identical(again.load(), three)
