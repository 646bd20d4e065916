"""How likely each state is."""

import importlib
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.integrate import solve_ivp
from systems.double_well import Well, double_well

from jaxchain import paper_chain
from jaxchain.basins import (
    AbstractRegion,
    Box,
    Ranges,
    VibratingMasses,
    basin_shares,
    share_differences,
)
from jaxchain.basins.regions import Points
from jaxchain.basins.shares import Bars, Batch, Tally, of_replicates
from jaxchain.observers import Variable
from jaxchain.sweeps import SweepInterrupted

from .planes import Plane

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


def test_states_are_numbered_as_they_are_found_after_them_undecided_and_failed_ones():
    found = tally(batch([[2, 0], [2, 2]]), batch([[1], [2]]))
    assert [code.tolist() for code in found.codes] == [[0], [2], [1]]
    assert (found.starts, found.states) == (3, 3)
    assert found.state.tolist() == [[[1, 0, 2], [1, 1, 1]]]
    shares = found.shares(found.state, 5)
    np.testing.assert_allclose(shares, [[[1 / 3, 1 / 3, 1 / 3, 0, 0], [0, 1, 0, 0, 0]]])
    # At its end the undecided one was somewhere; the failed one was nowhere, and says no state.
    decided, failed = [[True, False, True, True]], [[False, False, False, True]]
    found = tally(batch([[2, 0, 0, -7]], decided, failed))
    assert found.state.tolist() == [[[1, 2, 0, 3]]]
    assert found.at_end.tolist() == [[[1, 0, 0, -1]]]
    np.testing.assert_allclose(found.shares(found.at_end, 4), [[[0.5, 0.25, 0, 0]]])


@pytest.mark.parametrize("even", [False, True])
def test_bars_hold_the_share_as_often_as_they_say(even):
    """Of random starts, and of grids shifted by chance, whose error is far below theirs."""
    rng, share, inside, lengths = np.random.default_rng(0), 0.3, [], []
    for _ in range(400):
        points = rng.random((16, 32))
        if even:
            shift = rng.random((16, 1)) / 32 + rng.normal(0, 0.02, (16, 1))
            points = (np.arange(32) / 32 + shift) % 1.0
        found = tally(batch((points < share).astype(int)))
        bars = found.bars(even=even)
        k = [code.tolist() for code in found.codes].index([1])
        low, middle, high = bars.low[0, k], bars.share[0, k], bars.high[0, k]
        inside.append(low <= share <= high)
        lengths.append((high - low) / 2)
        assert not even or high - middle == pytest.approx(middle - low)
    assert 0.92 <= np.mean(inside) <= 0.99
    length = np.median(lengths) / (1.96 * (share * (1 - share) / 512) ** 0.5)
    assert length < 0.5 if even else length == pytest.approx(1.0, abs=0.05)


def test_what_was_wrong_lengthens_the_bars_on_its_side():
    bars = Bars(*(np.array([[a, b]]) for a, b in ((0.4, 0.6), (0.35, 0.55), (0.45, 0.65))))
    wide = bars.widened(np.array([[0.01, 0.0]]), np.array([[0.0, 0.01]]))
    assert np.allclose(wide.low, [[0.34, 0.55]])
    assert np.allclose(wide.high, [[0.45, 0.66]])
    assert bars.widened(np.array([[np.nan] * 2]), np.array([[np.nan] * 2])).longest == bars.longest
    # A state that no start found has a bar all the same.
    bars = tally(batch(np.zeros((16, 32), int))).bars(even=True)
    assert bars.share.tolist() == [[1.0, 0.0, 0.0]]
    assert 0.99 < bars.low[0, 0] < 1.0
    assert 0.0 < bars.high[0, 1] < 0.01
    mean, reach = of_replicates(np.array([[1.0, 2.0, 3.0]]), 1)
    np.testing.assert_allclose([*mean, *reach], [2.0, 2.484], atol=1e-3)


runs = importlib.import_module("jaxchain.basins.shares")

# One mass from a box: always over belt speeds with as many lanes, so that it is one program.
ONE = paper_chain(1, width=None)


def one_mass(speeds=(1.4,), region=None, **how):
    over = {"belt_speed": list(speeds)}
    how = {"half_width": 0.05, "checked": 0, "lanes": 256} | how
    return basin_shares(ONE, Box() if region is None else region, over, **how)


@pytest.fixture(scope="module")
def shares():
    return one_mass((1.4, 1.42), half_width=0.02, checked=64)


def test_shares_of_one_mass_are_the_area_within_the_unstable_cycle(shares):
    """By SciPy; the mirror image has the same."""
    assert shares.state.values.tolist() == ["sliding", "vibrating", "undecided"]
    plane = Plane.paper(1.4)
    exact = plane.area(plane.cycle(0.9, 1.25), (-2, 2), (0, 2)) / 8
    own = shares.sel(belt_speed=1.4)
    for state, share in (("sliding", exact), ("vibrating", 1 - exact), ("undecided", 0)):
        assert own.low.sel(state=state) <= share <= own.high.sel(state=state)
    half = ((shares.high - shares.low) / 2).max()
    assert shares.attrs["longest_half_width"] == half <= 0.02
    assert np.allclose(shares.replicate_share.mean("replicate"), shares.share)
    assert shares.attrs["checked"] >= 2 * 60
    assert np.all((shares.misclassified == 0) & (shares.changed_later == 0))
    units = set(shares.variables) - {"state", "vibrating", "oscillator"}
    assert all("units" in shares[name].attrs for name in units)
    box = Box(displacement=(-2, 2), velocity=(-2, 0))
    back, ahead = one_mass((-1.4,), box, half_width=0.02, seed=5), shares.sel(belt_speed=[1.4])
    assert back.state.values.tolist() == shares.state.values.tolist()
    assert np.all((back.low.values <= ahead.high.values) & (ahead.low.values <= back.high.values))


def test_all_parameters_have_the_same_starts():
    found = one_mass((1.4, 1.41), points="random", half_width=0.02)
    change = share_differences(found, "belt_speed").sel(state="sliding")
    assert np.allclose(change.belt_speed, 1.405)
    sliding = found.sel(state="sliding")
    assert np.allclose(change.difference, sliding.share[1] - sliding.share[0])
    assert change.low[0] > 0
    # Were they drawn anew, the errors of two shares would add up.
    first, second = (sliding.high - sliding.low).values / 2
    assert 5.0 * float((change.high - change.low)[0] / 2) < np.hypot(first, second)
    # The bar of a fraction.
    p, n = float(sliding.share[0]), found.attrs["starts"]
    assert 0.99 < first / (1.96 * (p * (1 - p) / n) ** 0.5) < 1.01


def test_seeds_are_different_starts_and_a_seed_is_the_same():
    first, second, third = (one_mass(seed=seed).share.values for seed in (0, 0, 1))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, third)


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
        one_mass(half_width=0.005, replicates=4)
    kept = caught.value.dataset
    assert kept.attrs["starts"] == 4 * 32
    assert np.isclose(kept.share.sum(), 1)
    assert np.isnan(kept.misclassified)


def test_bars_that_stay_too_long_are_told():
    with pytest.warns(UserWarning, match=r"The longest bar is .*: raise `most`"):
        found = one_mass(half_width=0.001, replicates=4, most=128)
    assert found.attrs["starts"] == 128


def test_runs_without_time_to_settle_are_undecided():
    found = one_mass(t1=50.0, checked=64)
    assert found.undecided == 1
    assert found.attrs["checked"] == 0
    # Where they were is known.
    assert np.isclose(found.share_at_end.sum(), 1)
    assert found.share_at_end[0, -1] == 0


class Side(Well):
    """The well, of any stiffness; a hasty one says at once on which side of the hill it starts."""

    hasty: Array = eqx.field(converter=jnp.asarray)

    def init(self, field, t0, t1, y0):
        return y0[0], y0[0], jnp.asarray(jnp.inf)

    def update(self, accumulator, step):
        (x, v), field = step.y1, step.field
        energy = v**2 / 2 + field.stiffness * x**2 / 2 + field.cubic * x**4 / 4
        return accumulator[0], x, jnp.max(energy)

    def settled(self, accumulator):
        return self.hasty | (accumulator[2] < -1e-3)

    def label(self, value, model):
        side = jnp.where(self.hasty, value[0], value[1]) > 0
        return {
            "state": Variable(side.astype(int), ("oscillator",)),
            "decided": Variable(self.settled(value)),
            "settling_time": Variable(jnp.abs(value[0][0])),  # a number that is known
        }

    def patient(self):
        return Side(hasty=False)


class Holed(AbstractRegion):
    """Runs from half of this region fail."""

    region: Ranges
    fails: Array = eqx.field(converter=jnp.asarray)

    def dimension(self, model):
        return 2

    def start(self, model, point):
        x, v = self.region.start(model, point)
        return jnp.where(point[0] < self.fails, jnp.nan, x), v


RANGES = Ranges(([-2.0], [-1.0]), ([2.0], [1.5]))
DAMPINGS, SPRINGS, CUBICS = (0.2, 0.4), (-1.0, -0.7, -1.2), (1.0, 0.8, 1.5)
POINTS = Points(2, 4, "sobol", 0).more(32).reshape(-1, 2)  # the starts of seed 0
X, V = np.array([-2.0, -1.0])[:, None] + np.array([4.0, 2.5])[:, None] * POINTS.T


def wells(fails=0.0, *, hasty=False, t1=500.0, **how):
    """Over damping and pairs of springs, four replicates of 32 starts; one program."""
    over = {"damping": DAMPINGS, "spring": {"stiffness": SPRINGS, "cubic": CUBICS}}
    how = {"half_width": 0.5, "replicates": 4, "most": 128, "lanes": 64, "checked": 128} | how
    region = Holed(RANGES, fails)
    return basin_shares(double_well(0.1), region, over, classify=Side(hasty), t1=t1, **how)


def on_the_right(damping, k, times):
    """By SciPy, all starts together, of shape (times, starts)."""

    def rate(t, y):
        x, v = y.reshape(2, -1)
        return np.concatenate([v, -damping * v - SPRINGS[k] * x - CUBICS[k] * x**3])

    start = np.concatenate([X, V])
    run = solve_ivp(rate, (0, times[-1]), start, "DOP853", times, rtol=1e-10, atol=1e-12)
    return run.y[: X.size].T > 0


@pytest.mark.slow
def test_shares_of_two_wells_are_those_that_scipy_counts(monkeypatch):
    seen = []

    def verdicts(model, states, **how):
        seen.append((float(model.damping), float(model.cubic), len(states[0])))
        return [SimpleNamespace(verdict=f"at {float(model.damping):g}") for _ in states[0]]

    monkeypatch.setattr(runs, "verdicts", verdicts)
    found = wells(judge=True)
    assert found.share.dims == ("damping", "spring", "state")
    assert found.stiffness.dims == ("spring",)
    assert np.all(found.misclassified == 0)
    for i, damping in enumerate(DAMPINGS):
        for k in range(3):
            [right] = on_the_right(damping, k, [150.0])
            own = found.isel(damping=i, spring=k)
            assert float(own.share.sel(state="right")) == np.mean(right)
            assert float(own.share.sel(state="left")) == 1 - np.mean(right)
            for state, ended in (("right", right), ("left", ~right)):
                one = own.sel(state=state)
                at = np.flatnonzero(np.isclose(X, one.start_displacement[0], rtol=1e-12))
                np.testing.assert_allclose(V[at], one.start_velocity)
                assert ended[at].all()
                assert float(one.settling_time) == pytest.approx(np.median(abs(X[ended])))
                assert one.verdict == f"at {damping:g}"
            assert (damping, CUBICS[k], 2) in seen
    assert found.start_velocity.attrs["units"] == "1"
    assert np.all(found.verdict.sel(state="undecided") == "")


def test_runs_that_fail_are_a_state_and_no_others():
    found = wells(0.25, checked=0)
    assert sorted(found.state.values[:2].tolist()) == ["left", "right"]
    assert found.state.values[2:].tolist() == ["undecided", "failed"]
    assert np.all(found.share.sel(state="failed") == np.mean(POINTS[:, 0] < 0.25))
    assert np.allclose(found.share.sum("state"), 1)
    assert np.allclose(found.share_at_end, found.share.where(found.state != "failed", 0))


def test_what_was_decided_too_early_is_a_part_of_the_bar():
    with pytest.warns(
        UserWarning, match=r"of the starts are in another state at 4 t1, more .* at"
    ):
        found = wells(hasty=True, t1=2.5)
    bars = wells(hasty=True, t1=2.5, checked=0)
    before = X > 0
    for i, damping in enumerate(DAMPINGS):
        for k in range(3):
            after, later = on_the_right(damping, k, [2.5, 10.0])
            own, plain = found.isel(damping=i, spring=k), bars.isel(damping=i, spring=k)
            assert own.misclassified == pytest.approx(np.mean(before != after))
            assert own.changed_later == pytest.approx(np.mean(after != later))
            for state, lost in (("right", before & ~after), ("left", ~before & after)):
                gained = (before != after) & ~lost
                one, alone = own.sel(state=state), plain.sel(state=state)
                assert one.share == alone.share
                low, high = float(alone.low) - np.mean(lost), float(alone.high) + np.mean(gained)
                assert float(one.low) == pytest.approx(max(low, 0))
                assert float(one.high) == pytest.approx(min(high, 1))
    assert "of the starts are in another state" in found.attrs["warning"]


def test_what_a_share_needs_is_said(shares):
    region, wells = Ranges(([-2.0], [-2.0]), ([2.0], [2.0])), double_well(0.1)
    with pytest.raises(ValueError, match="give `classify` for other models"):
        basin_shares(wells, region)
    with pytest.raises(ValueError, match="give `above`"):
        basin_shares(wells, region, classify=VibratingMasses())
    with pytest.raises(ValueError, match=r"`t1` must be at least 20, .* but is 10"):
        basin_shares(ONE, Box(), t1=10.0)
    with pytest.raises(ValueError, match="`store` is none of `basin_shares`"):
        basin_shares(ONE, Box(), store="here.zarr")
    with pytest.raises(ValueError, match="swept dimension of at least two values"):
        share_differences(shares.isel(belt_speed=[0]), "belt_speed")
