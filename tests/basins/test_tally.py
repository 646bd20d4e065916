"""Counting how runs ended, and what that says of the shares."""

import numpy as np

from jaxchain import paper_chain
from jaxchain.basins import VibratingMasses
from jaxchain.basins.tally import Bars, Batch, Tally, of_replicates

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
    rng, held, share = np.random.default_rng(0), 0, 0.3
    for _ in range(400):
        found = tally(batch((rng.random((16, 32)) < share).astype(int)))
        bars = found.bars(even=False)
        k = [code.tolist() for code in found.codes].index([1])
        held += bars.low[0, k] <= share <= bars.high[0, k]
    assert 0.92 <= held / 400 <= 0.98


def test_bars_of_sequences_hold_the_share_as_often_as_they_say():
    # In each replicate a grid, shifted by chance: an error far below that of random points.
    rng, held, lengths, share = np.random.default_rng(0), 0, [], 0.3
    for _ in range(400):
        places = (np.arange(32) + rng.random((16, 1))) / 32 + rng.normal(0, 0.02, (16, 1))
        found = tally(batch(((places % 1.0) < share).astype(int)))
        bars = found.bars(even=True)
        k = [code.tolist() for code in found.codes].index([1])
        held += bars.low[0, k] <= share <= bars.high[0, k]
        lengths.append((bars.high - bars.low)[0, k] / 2)
    assert 0.92 <= held / 400 <= 0.99
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
