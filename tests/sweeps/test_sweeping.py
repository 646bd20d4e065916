"""Sweeps: the same numbers as single runs; labels, failures, input."""

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import numpy as np
import pytest
import xarray as xr

from jaxchain import Amplitude, PeakTimes, Trajectory, equation_8, paper_chain, simulate, sweep
from jaxchain.model import ModeCoupling
from jaxchain.observers.base import AbstractObserver, Variable
from jaxchain.result import NAMES
from jaxchain.sweeps import SweepInterrupted, scheduler

# The sweeps of most tests share the program of four such lanes.
CHAIN, WATCH = paper_chain(4, belt_speed=1.4), Amplitude(window=20.0, stop="quiet")


def swept(over, t1=60.0, initial: Any = equation_8, **more):
    given = {"observe": WATCH, "lanes": 4, "devices": jax.devices()[:1]} | more
    return sweep(CHAIN, initial, t1, over=over, **given)


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


COUNTED = "steps", "rejected"
OVER = {"belt_speed": [1.0, 1.4, 1.9], "excited": [0, 1, 4]}


@pytest.fixture(scope="module")
def small():
    return swept(OVER)


def test_every_lane_is_the_single_run_also_as_a_dataset(small, tmp_path):
    """A run has the variables and attributes of a sweep, of a trajectory a time axis as well."""
    times = np.linspace(0.0, 20.0, 5)
    watch = {"a": WATCH, "path": Trajectory(times)}
    for speed, excited in ((1.0, 1), (1.4, 4), (1.9, 1)):
        chain = CHAIN.with_(belt_speed=speed)
        run = simulate(chain, equation_8(chain, excited), 60.0, observe=watch)
        lane = small.sel(belt_speed=speed, excited=excited)
        np.testing.assert_allclose(lane.amplitude, run.observed["a"], atol=1e-4)
    one, lane = run.to_dataset(), lane.drop_vars(["belt_speed", "excited"])
    assert set(lane.data_vars) < set(one.data_vars)
    for name in lane.data_vars:
        assert one[name].dims == lane[name].dims
        words = [{k: str(v) for k, v in data[name].attrs.items()} for data in (one, lane)]
        assert words[0] == words[1]
        # Rounding differs, so that a step more may be taken.
        np.testing.assert_allclose(
            one[name], lane[name], rtol=0, atol=2 if name in COUNTED else 1e-4
        )
    assert small.attrs.keys() - one.attrs.keys() <= {
        "wall_time_s", "devices", "device_kind", "lanes_per_device", "lanes_per_device_at_end"
    }  # fmt: skip
    for name in ("t0", "t1", "rtol", "atol", "solver"):
        assert one.attrs[name] == small.attrs[name]
    one.to_netcdf(tmp_path / "run.nc")
    assert xr.open_dataset(tmp_path / "run.nc").amplitude.attrs["units"] == "x0"
    assert one.displacement.dims == ("time", "oscillator")
    np.testing.assert_array_equal(one.time, times)
    np.testing.assert_array_equal(one.velocity, run.observed["path"][1])
    np.testing.assert_array_equal(one.end_displacement, run.state[0])
    units = [one[name].attrs["units"] for name in ("time", "displacement", "end_velocity")]
    assert units == ["1 / omega_n", "x0", "x0 omega_n"]


def test_cells_name_their_variables_and_two_observers_of_one_name_are_refused():
    cells = ModeCoupling(2.0, 1.0, 0.5, contact_stiffness=1.0, friction=0.3)
    watch = path, _ = Trajectory(np.zeros(1)), Amplitude()
    run = simulate(cells, (np.ones(1),) * 4, 1.0, observe=watch, solver=dfx.Heun())
    assert {"x", "x'", "end_x"} <= set(map(str, run.to_dataset().data_vars))
    twice = dataclasses.replace(run.origin, observers=(path, path))
    twice = dataclasses.replace(run, observed=2 * run.observed[:1], origin=twice)
    with pytest.raises(ValueError, match=r"several observers that name .*x"):
        twice.to_dataset()


def test_the_dataset_is_labelled_and_tells_its_origin(small, tmp_path):
    assert small.amplitude.dims == ("belt_speed", "excited", "oscillator")
    assert small.oscillator.values.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(small.energy, 0.5 * (small.amplitude**2).sum("oscillator"))
    assert small.active_count.sel(belt_speed=1.4).values.tolist() == [0, 1, 4]
    assert small.result.attrs["flag_meanings"].split() == list(NAMES)
    for key in ("parameters", "solver", "rtol", "versions", "observers", "t1"):
        assert key in small.attrs
    for variable in small.variables.values():
        assert "units" in variable.attrs
    small.to_netcdf(tmp_path / "s.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "s.nc", engine="h5netcdf") as back:
        xr.testing.assert_identical(back.load(), small)


def test_given_lanes_stay_so_many_however_long_the_last_ones_take(monkeypatch):
    """Without `lanes`, a pool of a quarter goes on, as soon as that is worth compiling."""
    monkeypatch.setattr(scheduler, "_WORTH_COMPILING", 0.0)
    monkeypatch.setattr(scheduler, "_FIRST_NUMBERS", 1)  # the host looks in between

    def ends(lanes):
        # The last lane of four goes on: the others come to rest, and stop.
        over = {"damping_ratio": [0.6, 0.6, 0.6, 0.05]}
        found = swept(over, 200.0, lambda chain: equation_8(chain, 1), lanes=lanes)
        assert [NAMES[int(result)] for result in found.result] == [*["quiet"] * 3, "successful"]
        lanes = found.attrs["lanes_per_device"], found.attrs["lanes_per_device_at_end"]
        return lanes, found.amplitude.values

    (same, expected), (fewer, amplitude) = ends(4), ends(None)
    assert (same, fewer) == ((4, 4), (4, 1))
    np.testing.assert_allclose(amplitude, expected, atol=1e-6)


def test_results_do_not_depend_on_how_often_the_host_looks(monkeypatch):
    """Jobs that have not begun are offered again, and a lane whose records are full waits."""
    looks, original = [], scheduler.Pool.outcome

    def outcome(self):
        looks[-1] += 1
        return original(self)

    def found(first, seconds):
        looks.append(0)
        monkeypatch.setattr(scheduler.Pool, "outcome", outcome)
        monkeypatch.setattr(scheduler, "_FIRST_NUMBERS", first)
        monkeypatch.setattr(scheduler, "_SECONDS", seconds)
        # The first three go on to the end; the others rest, and stop: one lane takes them all.
        return swept({"excited": [1, 1, 1, *13 * [0]]}, 400.0)

    seldom, often = found(10**9, 0.2), found(1, 0.0)
    assert 2 <= looks[0] <= 4 < looks[1]
    assert [NAMES[int(r)] for r in seldom.result] == [*3 * ["successful"], *["quiet"] * 13]
    for name in ("amplitude", "steps", "end_time", "result"):
        np.testing.assert_array_equal(seldom[name], often[name])


def test_of_forty_lanes_one_fails_and_the_others_do_not_notice():
    """Bit for bit what they are without it."""
    damping = np.linspace(0.03, 0.08, 40)
    spoiled = damping.copy()
    spoiled[20] = -30.0
    run = lambda values: swept({"damping_ratio": values}, 30.0, lambda chain: equation_8(chain, 1))
    whole = run(damping)
    with pytest.warns(UserWarning, match="1 of 40 runs"):
        broken = run(spoiled)
    assert NAMES[int(broken["result"][20])] in ("nonfinite", "step_too_small")
    assert np.all(np.isnan(broken["amplitude"][20]))
    others = np.arange(40) != 20
    assert np.all(broken["result"].values[others] == 0)
    for name in ("amplitude", "steps", "end_time"):
        assert np.array_equal(whole[name].values[others], broken[name].values[others])


def test_an_interrupted_sweep_hands_over_what_had_ended(monkeypatch):
    ended = []
    original, waits = scheduler.Pool.outcome, scheduler.Pool.wait
    monkeypatch.setattr(scheduler, "_FIRST_NUMBERS", 1)  # the host looks in between

    def interrupt(self):
        jobs, record, left = original(self)
        ended.append(jobs.size)
        return jobs, record, left

    def wait(self):
        if sum(ended):
            raise KeyboardInterrupt
        return waits(self)

    monkeypatch.setattr(scheduler.Pool, "outcome", interrupt)
    monkeypatch.setattr(scheduler.Pool, "wait", wait)
    with pytest.raises(SweepInterrupted) as caught:
        swept({"excited": 5 * [1, 2, 3, 4]})
    result = caught.value.dataset
    states = [NAMES[int(r)] for r in result.result]
    # Also those of the rounds that were under way.
    assert 1 <= states.count("successful") == sum(ended) < 20
    assert states.count("interrupted") == 20 - states.count("successful")
    unknown = [state == "interrupted" for state in states]
    for name in ("active_count", "steps", "rejected", "end_time"):
        assert np.isnan(result[name].values).tolist() == unknown


def test_segments_and_realisations_are_those_of_single_runs():
    """Numbers of each mass run along realisations."""
    rng, chain = np.random.default_rng(0), paper_chain(3, 1.4, 0.1)
    start = equation_8(chain, 2)
    # A solver that compiles fast.
    options: Any = {"segments": 3, "solver": dfx.Heun(), "rtol": 1e-4}
    options |= {"max_steps": 1500, "observe": [Amplitude(), Named("last")]}  # of each segment
    over = {
        "stiffness": rng.uniform(0.9, 1.1, (3, 3)), "damping_ratio": rng.uniform(0, 0.1, (3, 3)),
        "belt_speed": [1.4, 1.5],
    }  # fmt: skip
    data = sweep(chain, start, 36.0, over=over, lanes=2, **options)
    assert data.stiffness.dims == data.damping_ratio.dims == ("realisation", "oscillator")
    assert data.amplitude.dims == ("realisation", "belt_speed", "segment", "oscillator")
    assert data.segment.values.tolist() == [1, 2, 3]
    np.testing.assert_allclose(data.segment_end, [12.0, 24.0, 36.0])
    for k in range(3):
        numbers = {name: over[name][k] for name in ("stiffness", "damping_ratio")}
        run = simulate(chain.with_(belt_speed=1.5, **numbers), start, 36.0, **options)
        lane = data.isel(realisation=k, belt_speed=1)
        assert abs(int(lane.steps) - int(run.steps)) <= 2  # rounding differs
        for name, value in zip(("amplitude", "last"), run.observed, strict=True):
            np.testing.assert_allclose(lane[name], value, atol=1e-8)


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
        ({"over": {"belt_speed": [1.0]}}, r"`initial` needs \['excited'\]"),
        ({"over": {"excited": np.zeros(20_000), "belt_speed": np.ones(1000)}}, "20000000 lanes"),
        ({"observe": [Amplitude(), Amplitude(window=5.0)]}, "'amplitude' as `Amplitude` does"),
        ({"observe": Last()}, "`Last`, whose value has no labels"),
        ({"observe": Named("steps")}, "names a variable 'steps' as every sweep does"),
        ({"observe": [Named("peak"), PeakTimes()]}, "'peak' as another names a dimension"),
        ({"observe": Named("last", ("oscillator", "oscillator"))}, "name each axis once"),
        ({"observe": Named("excited")}, "also the name of a result"),
    ],
)
def test_bad_input_is_named_before_anything_runs(change, message):
    with pytest.raises(ValueError, match=message):
        sweep(CHAIN, equation_8, 60.0, **{"over": {"excited": [0]}, **change})
