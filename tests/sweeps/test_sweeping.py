"""Sweeps: the same numbers as single runs; labels, failures, input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from jaxchain import (
    Amplitude,
    EventDriven,
    PeakTimes,
    Trajectory,
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


def bits(jobs, devices, lanes=4, solver=None):
    """Amplitudes and steps of the first jobs of seven."""
    speeds = np.linspace(0.9, 1.45, 7)[:jobs]
    found = sweep(
        CHAIN, lambda chain: equation_8(chain, 2), 60.0, over={"belt_speed": speeds},
        observe=Amplitude(window=20.0), lanes=lanes, devices=jax.devices()[:devices],
        solver=solver,
    )  # fmt: skip
    assert (found.result == 0).all()
    assert found.attrs["lanes_per_device"] == found.attrs["lanes_per_device_at_end"] == lanes
    return np.concatenate([found.amplitude.values, found.steps.values[:, None]], axis=1)


@pytest.mark.long
@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(None, id="smoothed"),
        pytest.param(EventDriven(), id="dry"),
    ],
)
def test_the_same_lanes_give_the_same_bits_for_any_number_of_jobs_and_devices(solver):
    seven = bits(7, 2, solver=solver)
    for jobs, devices in ((1, 1), (2, 2), (3, 1), (3, 2), (4, 1), (4, 2), (7, 1)):
        assert np.array_equal(bits(jobs, devices, solver=solver), seven[:jobs])


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


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(None, id="smoothed"),
        pytest.param(EventDriven(), id="dry", marks=pytest.mark.long),
    ],
)
def test_of_a_thousand_lanes_one_fails_and_999_do_not_notice(solver):
    """Bit for bit what they are without it."""
    damping = np.linspace(0.03, 0.08, 1000)
    spoiled = damping.copy()
    spoiled[500] = -30.0

    def run(values):
        return sweep(
            paper_chain(2, 1.4), lambda chain: equation_8(chain, 1), 30.0, solver=solver,
            over={"damping_ratio": values}, observe=Amplitude(window=10.0), rtol=1e-5,
        )  # fmt: skip

    whole = run(damping)
    with pytest.warns(UserWarning, match="1 of 1000 runs"):
        broken = run(spoiled)
    assert NAMES[int(broken["result"][500])] in ("nonfinite", "step_too_small")
    assert np.all(np.isnan(broken["amplitude"][500]))
    others = np.arange(1000) != 500
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
            CHAIN, equation_8, 60.0, over={"excited": 4 * [0, 1, 2, 3, 4]},
            observe=Amplitude(window=20.0), lanes=2, devices=jax.devices()[:1],
        )  # fmt: skip
    result = caught.value.dataset
    states = [NAMES[int(r)] for r in result.result]
    # Also those of the rounds that were under way.
    assert 1 <= states.count("successful") == sum(ended) < 20
    assert states.count("interrupted") == 20 - states.count("successful")
    unknown = [state == "interrupted" for state in states]
    for name in ("active_count", "steps", "rejected", "end_time"):
        assert np.isnan(result[name].values).tolist() == unknown


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(None, id="smoothed"),
        pytest.param(EventDriven(), id="dry", marks=pytest.mark.long),
    ],
)
def test_segments_are_those_of_single_runs(solver):
    watch = [Amplitude(), PeakTimes(4), Named("last")]
    options = {"observe": watch, "segments": 3, "solver": solver, "max_steps": 400}
    data = sweep(CHAIN, equation_8, 36.0, over={"excited": [0, 1, 4]}, lanes=2, **options)
    assert data.peak_time.dims == ("excited", "segment", "peak", "oscillator")
    assert data.segment.values.tolist() == [1, 2, 3]
    np.testing.assert_allclose(data.segment_end, [12.0, 24.0, 36.0])
    for excited in (1, 4):
        run = simulate(CHAIN, equation_8(CHAIN, excited), 36.0, **options)
        lane = data.sel(excited=excited)
        # Rounding differs from one program to the other.
        assert abs(int(lane.steps) - int(run.steps)) <= 5
        for name, value in zip(("amplitude", "peak_time", "last"), run.observed, strict=True):
            np.testing.assert_allclose(lane[name], value, atol=1e-3)
    assert data.active_count.isel(excited=2).values.tolist() == [4, 4, 4]


@pytest.mark.long
def test_parameters_go_together_along_one_dimension():
    """Measured sets and states of shape (samples, n), beside a product."""
    starts = np.linspace(-1.0, 1.0, 12).reshape(3, 4)
    together = {"belt_speed": [1.2, 1.4, 1.6], "mu_static": [0.6, 0.8, 1.0], "x0": starts}
    data = sweep(
        CHAIN, lambda chain, x0, v0: (x0, v0 + 0 * x0), 5.0,
        over={"sample": together, "v0": [0.0, 0.5]}, observe=Named("last"), solver=EventDriven(),
    )  # fmt: skip
    assert data["last"].dims == ("sample", "v0", "oscillator")
    assert data.mu_static.dims == ("sample",)
    assert data.x0.dims == ("sample", "oscillator")
    assert data.belt_speed.attrs["units"] == "x0 omega_n"
    chain = CHAIN.with_(belt_speed=1.6, mu_static=1.0)
    run = simulate(chain, (starts[2], np.full(4, 0.5)), 5.0, observe=Last(), solver=EventDriven())
    np.testing.assert_allclose(data["last"].isel(sample=2, v0=1), run.observed, atol=1e-6)
    # A data frame and a dataset are mappings of columns, too.
    for table in (pd.DataFrame({"v0": [0.0, 0.5]}), xr.Dataset({"v0": ("row", [0.0, 0.5])})):
        own = sweep(
            CHAIN, lambda chain, v0: (jnp.ones(4), v0), 5.0, over={"set": table},
            observe=Named("last"), solver=EventDriven(),
        )  # fmt: skip
        assert own["last"].sizes == {"set": 2, "oscillator": 4}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"over": {}}, "must name at least one quantity"),
        ({"over": {"excited": [1], "speed": [1.0]}}, "names 'speed', which is neither"),
        ({"over": {"excited": []}}, "must be a non-empty array"),
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
        ({"over": {"excited": [1], "belt_speed": [1.0, float("nan")]}}, "must be finite"),
        ({"over": {"excited": [1], "width": [1e-3, -1.0]}}, "`width` must be positive"),
        ({"over": {"belt_speed": [1.0]}}, r"`initial` needs \['excited'\]"),
        ({"over": {"excited": np.zeros(20_000), "belt_speed": np.ones(1000)}}, "20000000 lanes"),
        ({"t1": -1.0}, "`t1` = -1.0 lies before"),
        ({"lanes": 0}, "`lanes` must be None or an integer"),
        ({"observe": [Amplitude(), Amplitude(window=5.0)]}, "'amplitude' as `Amplitude` does"),
        ({"observe": Trajectory(jnp.ones(1))}, r"Use `jax.vmap\(simulate\)`"),
        ({"observe": Last()}, "`Last`, whose value has no labels"),
        ({"observe": Named("steps")}, "names a variable 'steps' as every sweep does"),
        ({"observe": [Named("peak"), PeakTimes()]}, "'peak' as another names a dimension"),
        ({"observe": Named("last", ("oscillator", "oscillator"))}, "name each axis once"),
        ({"observe": Named("excited")}, "also the name of a result"),
        ({"observe": 3}, "must be an observer or a list of them, but holds 3"),
        ({"segments": 0}, "`segments` must be None or an integer"),
    ],
)
def test_bad_input_is_named_before_anything_runs(change, message):
    arguments = {"t1": 60.0, "over": {"excited": [0]}, **change}
    with pytest.raises(ValueError, match=message):
        sweep(CHAIN, equation_8, arguments.pop("t1"), **arguments)
