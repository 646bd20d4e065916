"""Sweeps: the same numbers as single runs; labels, failures, input."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import numpy as np
import pytest
import xarray as xr

from jaxchain import (
    Amplitude,
    PeakTimes,
    equation_8,
    paper_chain,
    simulate,
    sweep,
)
from jaxchain.observers.base import AbstractObserver, Variable
from jaxchain.result import NAMES
from jaxchain.sweeps import SweepInterrupted

CHAIN = paper_chain(4, belt_speed=1.4)


class Last(AbstractObserver):
    """The last displacements; without labels."""

    def init(self, field, t0, t1, y0):
        return y0[0]

    def update(self, accumulator, step):
        return step.y1[0]

    def read(self, accumulator):
        return accumulator


class Named(Last):
    """With any labels."""

    name: str = eqx.field(static=True)
    dims: tuple = eqx.field(static=True, default=("oscillator",))

    def label(self, value, model):
        return {self.name: Variable(value, self.dims, "x0", "last x_n")}


OVER = {"belt_speed": [1.0, 1.4, 1.9], "excited": [0, 1, 4]}


@pytest.fixture(scope="module")
def small():
    return sweep(CHAIN, equation_8, 60.0, over=OVER, observe=Amplitude(window=20.0))


def test_every_lane_is_the_single_run(small):
    for speed in OVER["belt_speed"]:
        chain = CHAIN.with_(belt_speed=speed)
        for excited in OVER["excited"]:
            run = simulate(chain, equation_8(chain, excited), 60.0, observe=Amplitude(window=20.0))
            lane = small.sel(belt_speed=speed, excited=excited)
            np.testing.assert_allclose(lane.amplitude, run.observed, atol=1e-4)


def test_the_dataset_is_labelled_and_tells_its_origin(small, tmp_path):
    assert small.amplitude.dims == ("belt_speed", "excited", "oscillator")
    assert small.oscillator.values.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(small.energy, 0.5 * (small.amplitude**2).sum("oscillator"))
    assert small.active_count.sel(belt_speed=1.4).values.tolist() == [0, 1, 4]
    assert (small.result == 0).all()
    assert small.result.attrs["flag_meanings"].split() == list(NAMES)
    for key in ("parameters", "solver", "rtol", "versions", "observers", "t1"):
        assert key in small.attrs
    for variable in small.variables.values():
        assert "units" in variable.attrs
    small.to_netcdf(tmp_path / "s.nc", engine="h5netcdf")
    small.to_zarr(tmp_path / "s.zarr", consolidated=False)
    with xr.open_dataset(tmp_path / "s.nc", engine="h5netcdf") as back:
        xr.testing.assert_identical(back.load(), small)
    again = xr.open_zarr(tmp_path / "s.zarr", consolidated=False).load()
    xr.testing.assert_identical(again, small)


def bits(jobs, devices):
    """Amplitudes and steps of the first jobs of seven."""
    found = sweep(
        CHAIN, lambda chain: equation_8(chain, 2), 60.0, lanes=4,
        over={"belt_speed": np.linspace(0.9, 1.45, 7)[:jobs]}, devices=jax.devices()[:devices],
        observe=Amplitude(window=20.0),
    )  # fmt: skip
    assert (found.result == 0).all()
    assert found.attrs["lanes_per_device"] == found.attrs["lanes_per_device_at_end"] == 4
    return np.concatenate([found.amplitude.values, found.steps.values[:, None]], axis=1)


@pytest.mark.long
def test_the_same_lanes_give_the_same_bits_for_any_number_of_jobs_and_devices():
    seven = bits(7, 2)
    for jobs, devices in ((1, 1), (2, 2), (3, 2), (4, 1), (7, 1)):
        assert np.array_equal(bits(jobs, devices), seven[:jobs])


def test_given_lanes_stay_so_many_however_long_the_last_ones_take(monkeypatch):
    """Without `lanes`, a pool of a quarter goes on, as soon as that is worth compiling."""
    from jaxchain.sweeps import scheduler as pool

    monkeypatch.setattr(pool, "_WORTH_COMPILING", 0.0)
    monkeypatch.setattr(pool, "_FIRST_NUMBERS", 1)  # the host looks in between

    def ends(**more):
        # The last lane of four goes on: the others come to rest, and stop.
        found = sweep(
            CHAIN, lambda chain: equation_8(chain, 1), 200.0, devices=jax.devices()[:1],
            over={"damping_ratio": [0.6, 0.6, 0.6, 0.05]},
            observe=Amplitude(window=20.0, stop="quiet"), **more,
        )  # fmt: skip
        assert [NAMES[int(result)] for result in found.result] == [*["quiet"] * 3, "successful"]
        lanes = found.attrs["lanes_per_device"], found.attrs["lanes_per_device_at_end"]
        return lanes, found.amplitude.values

    (same, expected), (fewer, amplitude) = ends(lanes=4), ends()
    assert (same, fewer) == ((4, 4), (4, 1))
    np.testing.assert_allclose(amplitude, expected, atol=1e-6)


def test_results_do_not_depend_on_how_often_the_host_looks(monkeypatch):
    """Jobs that have not begun are offered again, and a lane whose records are full waits."""
    from jaxchain.sweeps import scheduler

    looks, original = [], scheduler.Pool.outcome

    def outcome(self):
        looks[-1] += 1
        return original(self)

    def found(first, seconds):
        looks.append(0)
        monkeypatch.setattr(scheduler.Pool, "outcome", outcome)
        monkeypatch.setattr(scheduler, "_FIRST_NUMBERS", first)
        monkeypatch.setattr(scheduler, "_SECONDS", seconds)
        # The first goes on to the end; the others rest, and stop: one lane takes them all.
        return sweep(
            CHAIN, equation_8, 400.0, over={"excited": [1, *13 * [0]]}, lanes=2,
            observe=Amplitude(window=20.0, stop="quiet"), devices=jax.devices()[:1],
        )  # fmt: skip

    seldom, often = found(10**9, 0.2), found(1, 0.0)
    assert 2 <= looks[0] <= 4 < looks[1]
    assert [NAMES[int(r)] for r in seldom.result] == ["successful", *["quiet"] * 13]
    for name in ("amplitude", "steps", "end_time", "result"):
        np.testing.assert_array_equal(seldom[name], often[name])


def test_of_two_hundred_lanes_one_fails_and_the_others_do_not_notice():
    """Bit for bit what they are without it."""
    damping = np.linspace(0.03, 0.08, 200)
    spoiled = damping.copy()
    spoiled[100] = -30.0

    def run(values):
        return sweep(
            paper_chain(2, 1.4), lambda chain: equation_8(chain, 1), 30.0,
            over={"damping_ratio": values}, observe=Amplitude(window=10.0), rtol=1e-5,
        )  # fmt: skip

    whole = run(damping)
    with pytest.warns(UserWarning, match="1 of 200 runs"):
        broken = run(spoiled)
    assert NAMES[int(broken["result"][100])] in ("nonfinite", "step_too_small")
    assert np.all(np.isnan(broken["amplitude"][100]))
    others = np.arange(200) != 100
    assert np.all(broken["result"].values[others] == 0)
    for name in ("amplitude", "steps", "end_time"):
        assert np.array_equal(whole[name].values[others], broken[name].values[others])


def test_an_interrupted_sweep_hands_over_what_had_ended(monkeypatch):
    from jaxchain.sweeps import scheduler
    from jaxchain.sweeps.scheduler import Pool

    ended = []
    original, waits = Pool.outcome, Pool.wait
    monkeypatch.setattr(scheduler, "_FIRST_NUMBERS", 1)  # the host looks in between

    def interrupt(self):
        jobs, record, left = original(self)
        ended.append(jobs.size)
        return jobs, record, left

    def wait(self):
        if sum(ended):
            raise KeyboardInterrupt
        return waits(self)

    monkeypatch.setattr(Pool, "outcome", interrupt)
    monkeypatch.setattr(Pool, "wait", wait)
    with pytest.raises(SweepInterrupted) as caught:
        sweep(
            CHAIN, equation_8, 60.0, over={"excited": 5 * [1, 2, 3, 4]}, lanes=2,
            observe=Amplitude(window=20.0, stop="quiet"), devices=jax.devices()[:1],
        )  # fmt: skip
    result = caught.value.dataset
    states = [NAMES[int(r)] for r in result.result]
    # Also those of the rounds that were under way.
    assert 1 <= states.count("successful") == sum(ended) < 20
    assert states.count("interrupted") == 20 - states.count("successful")
    unknown = [state == "interrupted" for state in states]
    for name in ("active_count", "steps", "rejected", "end_time"):
        assert np.isnan(result[name].values).tolist() == unknown


def test_segments_are_those_of_single_runs():
    watch, chain = [Amplitude(), PeakTimes(4), Named("last")], paper_chain(4, 1.4, 0.1)
    # A solver that compiles fast.
    options: Any = {"observe": watch, "segments": 3, "solver": dfx.Heun(), "rtol": 1e-4}
    options["max_steps"] = 1500  # of each segment
    data = sweep(chain, equation_8, 36.0, over={"excited": [0, 1, 4]}, lanes=2, **options)
    assert data.peak_time.dims == ("excited", "segment", "peak", "oscillator")
    assert data.segment.values.tolist() == [1, 2, 3]
    np.testing.assert_allclose(data.segment_end, [12.0, 24.0, 36.0])
    for excited in (1, 4):
        run = simulate(chain, equation_8(chain, excited), 36.0, **options)
        lane = data.sel(excited=excited)
        assert abs(int(lane.steps) - int(run.steps)) <= 2  # rounding differs
        for name, value in zip(("amplitude", "peak_time", "last"), run.observed, strict=True):
            np.testing.assert_allclose(lane[name], value, atol=1e-8)
    assert data.active_count.isel(excited=2).values.tolist() == [4, 4, 4]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"over": {"excited": [1], "speed": [1.0]}}, "names 'speed', which is neither"),
        (
            {"over": {"excited": [1], "set": {"width": [[1e-3]]}}},
            r"gives one value of \['width'\] for each entry .* has shape \(1,\)",
        ),
        (
            {"over": {"set": {"excited": [1], "width": [1e-3, 1e-4]}}},
            "has 2 values, but 'excited'",
        ),
        ({"over": {"excited": [1], "set": {"excited": [1]}}}, "names a parameter twice"),
        ({"over": {"excited": [1], "set": {}}}, "parameters that run along a dimension"),
        ({"over": {"width": {"excited": [1]}, "set": {"width": [1e-3]}}}, "of their own"),
        ({"over": {"set": {"excited": [1], "mu_static": [0.2]}}}, "mu_static"),
        ({"over": {"excited": [1], "width": [1e-3, -1.0]}}, "`width` must be positive"),
        ({"over": {"belt_speed": [1.0]}}, r"`initial` needs \['excited'\]"),
        ({"over": {"excited": np.zeros(20_000), "belt_speed": np.ones(1000)}}, "20000000 lanes"),
        ({"t1": -1.0}, "`t1` = -1.0 lies before"),
        ({"observe": [Amplitude(), Amplitude(window=5.0)]}, "'amplitude' as `Amplitude` does"),
        ({"observe": Last()}, "`Last`, whose value has no labels"),
        ({"observe": Named("steps")}, "names a variable 'steps' as every sweep does"),
        ({"observe": [Named("peak"), PeakTimes()]}, "'peak' as another names a dimension"),
        ({"observe": Named("last", ("oscillator", "oscillator"))}, "name each axis once"),
        ({"observe": Named("excited")}, "also the name of a result"),
    ],
)
def test_bad_input_is_named_before_anything_runs(change, message):
    arguments = {"t1": 60.0, "over": {"excited": [0]}, **change}
    with pytest.raises(ValueError, match=message):
        sweep(CHAIN, equation_8, arguments.pop("t1"), **arguments)
