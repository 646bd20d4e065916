"""How likely each state is."""

import importlib

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from systems.double_well import Well, by_scipy, double_well

from jaxchain import equation_8, paper_chain, simulate, steady_sliding, sweep
from jaxchain.basins import (
    AbstractClassifier,
    Box,
    Gaussian,
    Ranges,
    Sampler,
    VibratingMasses,
    basin_shares,
    share_differences,
)
from jaxchain.basins.regions import Points
from jaxchain.basins.shares import Bars, Batch, Tally, of_replicates
from jaxchain.model import LuGre, VanDerPol
from jaxchain.observers import Variable
from jaxchain.sweeps import SweepInterrupted

CHAIN = paper_chain(2, width=None)


def batch(vibrating, decided=None, failed=None):
    """One parameter: which of two masses vibrate, by their number, over (replicate, start)."""
    count = np.asarray(vibrating)[None]
    yes, no = np.ones(count.shape, bool), np.zeros(count.shape, bool)
    return Batch(
        count[..., None], yes if decided is None else np.asarray(decided)[None],
        no if failed is None else np.asarray(failed)[None], np.zeros(count.shape),
    )  # fmt: skip


def tally(*batches):
    found = Tally(VibratingMasses(), CHAIN)
    for own in batches:
        found.add(own)
    return found


def test_states_are_numbered_as_they_are_found():
    found = tally(batch([[2, 0], [2, 2]]), batch([[1], [2]]))
    assert [code.tolist() for code in found.codes] == [[0], [2], [1]]
    assert found.starts == 3
    assert found.states == 3
    assert found.state.tolist() == [[[1, 0, 2], [1, 1, 1]]]
    shares = found.shares(found.state, 5)
    assert np.allclose(shares, [[[1 / 3, 1 / 3, 1 / 3, 0, 0], [0, 1, 0, 0, 0]]])


def test_what_is_undecided_or_failed_is_a_state_of_its_own():
    decided, failed = [[True, False, True, True]], [[False, False, False, True]]
    found = tally(batch([[2, 0, 0, 2]], decided, failed))
    assert found.state.tolist() == [[[1, 2, 0, 3]]]
    # At its end the undecided one was somewhere; the failed one was nowhere.
    assert found.at_end.tolist() == [[[1, 0, 0, -1]]]
    assert np.allclose(found.shares(found.at_end, 4), [[[0.5, 0.25, 0, 0]]])
    both = tally(batch([[2, 0], [0, 0]], [[True, False]] * 2))
    assert np.allclose(both.bars(even=True).share.sum(1), 1)


def test_what_a_failed_run_says_is_no_state():
    found = tally(batch([[-7, 2]], failed=[[True, False]]), batch([[-7, -7]], failed=[[True] * 2]))
    assert [code.tolist() for code in found.codes] == [[2]]
    assert found.state.tolist() == [[[2, 0, 2, 2]]]


def test_bars_of_random_starts_hold_the_share_as_often_as_they_say():
    rng, covered, share = np.random.default_rng(0), 0, 0.3
    for _ in range(400):
        found = tally(batch((rng.random((16, 32)) < share).astype(int)))
        bars = found.bars(even=False)
        k = [code.tolist() for code in found.codes].index([1])
        covered += bars.low[0, k] <= share <= bars.high[0, k]
    assert 0.92 <= covered / 400 <= 0.98


def test_bars_of_sequences_hold_the_share_as_often_as_they_say():
    # In each replicate a grid, shifted by chance: an error far below that of random points.
    rng, covered, lengths, share = np.random.default_rng(0), 0, [], 0.3
    for _ in range(400):
        phases = (np.arange(32) + rng.random((16, 1))) / 32 + rng.normal(0, 0.02, (16, 1))
        found = tally(batch(((phases % 1.0) < share).astype(int)))
        bars = found.bars(even=True)
        k = [code.tolist() for code in found.codes].index([1])
        covered += bars.low[0, k] <= share <= bars.high[0, k]
        lengths.append((bars.high - bars.low)[0, k] / 2)
    assert 0.92 <= covered / 400 <= 0.99
    assert np.median(lengths) < 0.5 * 1.96 * (share * (1 - share) / 512) ** 0.5


def test_a_state_that_no_start_found_has_a_bar_all_the_same():
    bars = tally(batch(np.zeros((16, 32), int))).bars(even=True)
    assert bars.share.tolist() == [[1.0, 0.0, 0.0]]
    assert 0.99 < bars.low[0, 0] < 1.0
    assert 0.0 < bars.high[0, 1] < 0.01


def test_what_was_wrong_lengthens_the_bars_on_its_side():
    bars = Bars(*(np.array([[a, b]]) for a, b in ((0.4, 0.6), (0.35, 0.55), (0.45, 0.65))))
    wide = bars.widened(np.array([[0.01, 0.0]]), np.array([[0.0, 0.01]]))
    assert np.allclose(wide.low, [[0.34, 0.55]])
    assert np.allclose(wide.high, [[0.45, 0.66]])
    assert bars.widened(np.array([[np.nan] * 2]), np.array([[np.nan] * 2])).longest == bars.longest


def test_replicates_give_a_mean_and_its_interval():
    mean, reach = of_replicates(np.array([[1.0, 2.0, 3.0]]), 1)
    assert mean == 2.0
    assert np.allclose(reach, 2.484, atol=1e-3)


runs = importlib.import_module("jaxchain.basins.shares")

ONE = paper_chain(1, belt_speed=1.5, width=None)
SPEEDS = [1.4, 1.42]


@pytest.fixture(scope="module")
def shares():
    return basin_shares(ONE, Box(), {"belt_speed": SPEEDS}, half_width=0.01)


def test_shares_are_those_of_plain_runs(shares):
    # 2^12 random starts, run to t = 600 without any decision.
    rng = np.random.default_rng(3)
    x, v = rng.uniform(-2, 2, (4096, 1)), rng.uniform(0, 2, (4096, 1))
    runs = sweep(
        ONE, lambda chain, x, v: (x, v), 600.0,
        over={"belt_speed": SPEEDS, "start": {"x": x, "v": v}},
    )  # fmt: skip
    died = (runs.amplitude.isel(oscillator=0) < 0.5).mean("start")
    error = 4.0 * (0.25 / 4096) ** 0.5
    assert np.all(np.abs(shares.share.sel(state="sliding") - died) < error)


def test_what_is_said_of_shares_agrees(shares):
    assert shares.state.values.tolist() == ["sliding", "vibrating", "undecided"]
    assert shares.vibrating.values[:2].tolist() == [0, 1]
    assert np.isnan(shares.vibrating[2])
    assert np.allclose(shares.share.sum("state"), 1)
    assert np.all((shares.low <= shares.share) & (shares.share <= shares.high))
    half = ((shares.high - shares.low) / 2).max()
    assert half <= 0.01
    assert shares.attrs["longest_half_width"] == half
    assert np.allclose(shares.replicate_share.mean("replicate"), shares.share)
    assert np.array_equal(shares.undecided, shares.share.sel(state="undecided"))
    assert np.all(shares.undecided == 0)
    assert np.all(shares.misclassified == 0)
    assert shares.attrs["checked"] >= 2 * 60
    assert np.all(shares.changed_later == 0)
    for name in shares.variables:
        assert name in ("state", "vibrating", "oscillator") or "units" in shares[name].attrs


def test_a_start_of_each_state_leads_there(shares):
    for speed in SPEEDS:
        for state, vibrates in (("sliding", False), ("vibrating", True)):
            own = shares.sel(belt_speed=speed, state=state)
            parts = own["start_displacement"], own["start_velocity"]
            start = tuple(jnp.asarray(part.values) for part in parts)
            run = simulate(ONE.with_(belt_speed=speed), start, 1000.0, observe=VibratingMasses())
            assert bool(run.observed.vibrates[0]) == vibrates
            assert own.settling_time < run.t
    assert np.all(np.isnan(shares.start_displacement.sel(state="undecided")))


def test_all_parameters_have_the_same_starts():
    over = {"belt_speed": [1.4, 1.41]}
    found = basin_shares(ONE, Box(), over, points="random", half_width=0.02, checked=0)
    change = share_differences(found, "belt_speed").sel(state="sliding")
    assert np.allclose(change.belt_speed, 1.405)
    sliding = found.sel(state="sliding")
    assert np.allclose(change.difference, sliding.share[1] - sliding.share[0])
    assert change.low[0] > 0
    # Were they drawn anew, the errors of two shares would add up.
    first, second = (sliding.high - sliding.low).values / 2
    assert 5.0 * float((change.high - change.low)[0] / 2) < np.hypot(first, second)


def test_what_was_counted_before_ctrl_c_is_kept(monkeypatch):
    real, rounds = runs.sweep, []

    def interrupted(*arguments, **how):
        found = real(*arguments, **how)
        rounds.append(found)
        if len(rounds) == 2:
            raise SweepInterrupted(found)
        return found

    monkeypatch.setattr(runs, "sweep", interrupted)
    with pytest.raises(SweepInterrupted) as caught:
        basin_shares(ONE, Box(), half_width=0.005, replicates=4)
    kept = caught.value.dataset
    assert kept.attrs["starts"] == 4 * 32
    assert np.isclose(kept.share.sum(), 1)
    assert np.isnan(kept.misclassified)


def test_bars_that_stay_too_long_are_told():
    with pytest.warns(UserWarning, match=r"The longest bar is .*: raise `most`"):
        found = basin_shares(ONE, Box(), half_width=0.001, replicates=4, most=128, checked=0)
    assert found.attrs["starts"] == 128
    with pytest.raises(ValueError, match="`store` is none of `basin_shares`"):
        basin_shares(ONE, Box(), store="here.zarr")


@pytest.mark.long
def test_states_are_judged_on_demand():
    over = {"belt_speed": [1.4, 1.9]}
    found = basin_shares(ONE, Box(), over, half_width=0.1, checked=0, judge=True)
    assert found.verdict.sel(state="sliding").values.tolist() == [
        "steady sliding",
        "steady sliding",
    ]
    assert found.verdict.sel(state="vibrating").values.tolist() == ["periodic", ""]


@pytest.mark.long
def test_seeds_are_different_starts_and_a_seed_is_the_same():
    first, second, third = (
        basin_shares(ONE, Box(), half_width=0.05, seed=seed, checked=0).share.values
        for seed in (0, 0, 1)
    )
    assert np.array_equal(first, second)
    assert not np.array_equal(first, third)


@pytest.mark.long
def test_random_starts_have_the_bar_of_a_fraction():
    found = basin_shares(ONE, Box(), points="random", half_width=0.02, checked=0)
    p, n = float(found.share[0]), found.attrs["starts"]
    binomial = 1.96 * (p * (1 - p) / n) ** 0.5
    assert 0.99 < float(found.high[0] - found.low[0]) / 2 / binomial < 1.01


@pytest.mark.long
def test_rotated_patterns_are_equally_likely():
    chain = paper_chain(3, belt_speed=1.5, width=None)
    region = Box(displacement=(-2, 2), velocity=(0, 2))
    found = basin_shares(
        chain, region, points="random", half_width=0.02, classify=VibratingMasses(by="masses"),
        t1=300.0, checked=0, seed=1,
    )  # fmt: skip
    for count in (1, 2):
        own = found.share.values[found.vibrating == count] * found.attrs["starts"]
        assert len(own) == 3
        assert scipy.stats.chisquare(own).pvalue > 0.05
    ring = basin_shares(
        chain, region, points="random", half_width=0.02, classify=VibratingMasses(by="ring"),
        t1=300.0, checked=0, seed=1,
    )  # fmt: skip
    count = found.share.groupby("vibrating").sum()
    assert np.allclose(ring.share[:-1], count)
    assert len(ring.state) == 5


@pytest.mark.long
def test_some_masses_may_be_pushed():
    chain = paper_chain(3, belt_speed=1.6, width=None)
    found = basin_shares(
        chain, Gaussian(1.0, 1.0, masses=[0]), half_width=0.05, t1=300.0, checked=0,
        classify=VibratingMasses(by="masses"),
    )  # fmt: skip
    assert set(found.state.values) == {"sliding", "1 vibrates", "undecided"}


def test_runs_without_time_to_settle_are_undecided():
    found = basin_shares(ONE, Box(), t1=50.0, half_width=0.05)
    assert found.undecided == 1
    assert found.attrs["checked"] == 0
    # Where they were is known.
    assert np.isclose(found.share_at_end.sum(), 1)
    assert found.share_at_end[-1] == 0


def test_no_state_is_known_before_the_first_window_has_ended():
    with pytest.raises(ValueError, match=r"`t1` must be at least 20, .* but is 10"):
        basin_shares(ONE, Box(), t1=10.0)


def test_runs_that_fail_are_a_state_and_no_others():
    def at(chain, point):
        x, v = steady_sliding(chain)
        return jnp.where(point[0] < 0.5, jnp.nan, x), v

    found = basin_shares(
        ONE, Sampler(at, 1), half_width=0.1, checked=0, classify=VibratingMasses(by="masses")
    )
    assert found.state.values.tolist() == ["sliding", "undecided", "failed"]
    assert np.allclose(found.share, [0.5, 0, 0.5], atol=0.02)
    assert np.allclose(found.share_at_end, [0.5, 0, 0], atol=0.02)


class Hasty(AbstractClassifier):
    """Takes the sign of the velocity, at the start or, if it is patient, at the end."""

    waits: bool = False

    def init(self, field, t0, t1, y0):
        return y0[1]

    def update(self, accumulator, step):
        return step.y1[1] if self.waits else accumulator

    def settled(self, accumulator):
        return jnp.asarray(not self.waits)

    def read(self, accumulator):
        return accumulator

    def label(self, value, model):
        return {
            "state": Variable((value > 0).astype(int), ("oscillator",)),
            "decided": Variable(jnp.asarray(True)),
            "settling_time": Variable(jnp.zeros(())),
        }

    def patient(self):
        return Hasty(waits=True)

    def name(self, code, model):
        return "forward" if code[0] else "back"


class Clock(Hasty):
    """In another state after some time, whatever moves."""

    def update(self, accumulator, step):
        return jnp.where(step.t1 > 3.0, -1.0, jnp.ones_like(accumulator))

    def patient(self):
        return Clock(waits=True)


@pytest.mark.long
def test_shares_that_change_by_more_than_their_bars_say_so():
    with pytest.warns(UserWarning, match="^100% of .* at 4 t1, more .* at t1 = 1,"):
        found = basin_shares(ONE, Box(), classify=Clock(), t1=1.0, half_width=0.2, checked=8)
    assert found.changed_later == 1.0
    assert "of the starts are in another state" in found.attrs["warning"]


@pytest.mark.long
def test_what_was_decided_too_early_is_a_part_of_the_bar():
    # A quarter of a period turns most velocities round.
    box = Box(displacement=(0.6, 2.0), velocity=(0.1, 1.0))
    found = basin_shares(ONE, box, classify=Hasty(), t1=2.0, half_width=0.05)
    assert (
        found.state.values.tolist() == ["forward", "undecided", "back"] or found.misclassified > 0
    )
    assert found.misclassified > 0.8
    forward = found.sel(state="forward")
    assert forward.share == 1
    assert forward.low < 0.2
    assert found.high.sel(state="back") > 0.8
    assert found.share.sel(state="back") == 0


def test_dimensions_of_the_result_are_no_parameters():
    with pytest.raises(ValueError, match="dimensions of the result are called so"):
        basin_shares(ONE, Box(), {"state": [1.0]})
    with pytest.raises(ValueError, match="neither a number of the chain"):
        basin_shares(ONE, Box(), {"speed": [1.0]})


def test_differences_need_neighbours(shares):
    with pytest.raises(ValueError, match="swept dimension of at least two values"):
        share_differences(shares, "state")
    with pytest.raises(ValueError, match="swept dimension of at least two values"):
        share_differences(shares.isel(belt_speed=[0]), "belt_speed")
    with pytest.raises(ValueError, match="dataset of `basin_shares`"):
        share_differences(None, "belt_speed")  # pyright: ignore[reportArgumentType]


@pytest.mark.long
def test_several_dimensions_and_numbers_that_run_together():
    over = {"belt_speed": [1.4, 1.5], "set": {"damping_ratio": [0.05, 0.06], "v_ref": [0.5, 0.5]}}
    found = basin_shares(ONE, Box(), over, half_width=0.05)
    assert found.share.dims == ("belt_speed", "set", "state")
    assert found.damping_ratio.dims == ("set",)
    assert np.all(found.share.sel(state="sliding").diff("set") > 0)
    assert np.all(found.share.sel(state="sliding").diff("belt_speed") > 0)


@pytest.mark.long
def test_shares_of_a_smoothed_chain():
    found = basin_shares(ONE.with_(width=1e-2), Box(), half_width=0.05, t1=300.0, checked=0)
    dry = basin_shares(ONE, Box(), half_width=0.05, checked=0)
    assert np.abs(found.share[0] - dry.share[0]) < 0.05


def test_a_belt_that_runs_the_other_way_has_the_mirrored_shares(shares):
    ahead = shares.sel(belt_speed=1.4)
    box = Box(displacement=(-2, 2), velocity=(-2, 0))
    back = basin_shares(ONE.with_(belt_speed=-1.4), box, half_width=0.01, checked=0, seed=5)
    assert back.state.values.tolist() == shares.state.values.tolist()
    assert np.all((back.low <= ahead.high) & (ahead.low <= back.high))


@pytest.mark.long
def test_equation_8_states_under_all_pushes_of_nothing():
    # A region that is a point: one state, its share known for certain but for the sample's size.
    region = Sampler(lambda chain, point: equation_8(chain, 2), 1)
    chain = paper_chain(6, belt_speed=1.5, width=None)
    found = basin_shares(chain, region, replicates=4, half_width=0.05, t1=200.0, checked=4)
    assert found.state.values.tolist() == ["2 vibrate", "undecided"]
    assert found.share[0] == 1


WELLS = Ranges(([-2.0], [-2.0]), ([2.0], [2.0]))


@pytest.mark.slow
def test_shares_of_two_wells_are_those_that_scipy_counts():
    how = {"classify": Well(), "t1": 500.0, "half_width": 0.5, "replicates": 4, "most": 128}
    found = basin_shares(double_well(0.1), WELLS, {"damping": [0.2, 0.4]}, **how)
    points = Points(2, 4, "sobol", 0).more(32).reshape(-1, 2)  # the same starts
    for damping in (0.2, 0.4):
        right = [by_scipy(damping, 4.0 * point - 2.0)[0] > 0 for point in points]
        share = found.share.sel(damping=damping)
        assert float(share.sel(state="right")) == np.mean(right)
        assert float(share.sel(state="left")) == 1 - np.mean(right)
    first = found.sel(damping=0.4, state="right")
    start = [float(first[f"start_{name}"][0]) for name in ("displacement", "velocity")]
    assert by_scipy(0.4, start)[0] > 0
    assert found.start_velocity.attrs["units"] == "1"


@pytest.mark.long
def test_the_verdicts_on_the_wells_are_equilibria():
    how = {"classify": Well(), "t1": 500.0, "half_width": 0.5, "replicates": 4, "most": 128}
    found = basin_shares(double_well(0.2), WELLS, judge=True, **how)
    assert found.verdict.values.tolist() == ["steady sliding", "steady sliding", ""]


@pytest.mark.long
def test_cells_that_vibrate_are_counted_above_an_amplitude():
    """Van der Pol's oscillator runs to 0 from within its unstable cycle if mu < 0."""
    cells = VanDerPol(jnp.array([-0.5, 0.5]))
    region = Ranges(([-1.0, 0.1], [-1.0, 0.1]), ([1.0, 1.0], [1.0, 1.0]))
    found = basin_shares(
        cells, region, classify=VibratingMasses(by="masses", above=1.0), t1=200.0, checked=4,
        half_width=0.5, replicates=4, most=128,
    )  # fmt: skip
    assert found.state.values.tolist() == ["2 vibrates", "undecided"]
    assert found.share.values.tolist() == [1.0, 0.0]


def test_what_a_share_needs_of_other_models_is_said():
    with pytest.raises(ValueError, match="give `classify` for other models"):
        basin_shares(double_well(0.1), WELLS)
    with pytest.raises(ValueError, match="give `above`"):
        basin_shares(double_well(0.1), WELLS, classify=VibratingMasses())
    with pytest.raises(ValueError, match="must make the tuple"):
        basin_shares(LuGre(), WELLS, classify=Well())
