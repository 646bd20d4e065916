"""Recurrence in a record of windows: sections, tori, phases, symmetries."""

import numpy as np

from jaxchain.chaos.classification import (
    RunRecord,
    mean_periods,
    novelty,
    phases,
    recurrence,
    reflections,
    symmetry_defect,
)


def made_up(delays, periods, windows=20, length=50.0, wander=0.0):
    """A record of cosines with given delays and periods of their maxima."""
    delays, periods = np.asarray(delays, float), np.asarray(periods, float)
    n = len(delays)
    peaks = np.full((windows, 16, n), np.nan)
    points, times = np.full((windows, 5, 2 * n), np.nan), np.full((windows, 5), np.nan)
    for w in range(windows):
        for i in range(n):
            first = np.ceil((w * length - delays[i]) / periods[i])
            own = delays[i] + periods[i] * np.arange(first, first + 20)
            own = own[own < (w + 1) * length][:16]
            peaks[w, : len(own), i] = own
        times[w] = peaks[w, :5, 0]
        angle = 2 * np.pi * (times[w][:, None] - delays) / periods
        points[w] = np.concatenate([np.cos(angle), -np.sin(angle)], axis=1)
        points[w] += wander * w
    return RunRecord(
        t=length * (1.0 + np.arange(windows)), amplitude=np.ones((windows, n)), peaks=peaks,
        point_times=times, points=points,
    )  # fmt: skip


def test_a_recurring_section_is_distinguished_from_one_that_drifts():
    still = recurrence(made_up([0.0, 1.0], [6.25, 6.25]), scale=1.0)
    np.testing.assert_allclose(
        [still.returns, still.period, still.spread], [1, 6.25, 0], atol=1e-12
    )
    # The second mass needs two maxima of the first.
    double = recurrence(made_up([0.0, 1.0], [6.25, 12.5]), scale=1.0)
    found = double.returns, double.period, double.spread
    np.testing.assert_allclose(found, [2, 12.5, 0], atol=1e-12)
    drifting = recurrence(made_up([0.0, 1.0], [6.25, 6.25 * 1.017]), scale=1.0)
    assert drifting.spread > 0.5
    creeping = recurrence(made_up([0.0, 1.0], [6.25, 6.25], wander=1e-3), scale=1.0)
    np.testing.assert_allclose(creeping.spread, 9e-3, rtol=1e-6)


def test_a_torus_comes_back_and_a_drift_does_not():
    torus = made_up([0.0, 1.0], [6.25, 6.25 * 1.017], windows=80)
    assert novelty(torus) < 0.1
    # A seventh of a cycle in all.
    drift = made_up([0.0, 1.0], [6.25, 6.25 * (1 + 2e-4)], windows=80)
    assert novelty(drift) > 0.4
    assert novelty(made_up([0.0, 1.0], [6.25, 6.25])) < 1.0


def test_phases_count_cycles_and_slips():
    record = made_up([0.0, 1.0, 2.0], [6.25, 6.25, 6.2])
    turned = phases(record, [0, 1, 2])
    np.testing.assert_allclose(turned[:, 1] - turned[0, 1], 0.0, atol=1e-12)
    gained = turned[-1, 2] - turned[0, 2]
    # 950 time units later it is ahead by 950 (1 / 6.2 - 1 / 6.25) cycles.
    np.testing.assert_allclose(gained, 950 * (1 / 6.2 - 1 / 6.25), atol=0.01)
    np.testing.assert_allclose(mean_periods(record, [0, 1, 2]), [6.25, 6.25, 6.2], rtol=1e-12)


def test_reflections_keep_the_block():
    block = np.zeros(6, bool)
    block[[5, 0, 1]] = True
    (image,) = reflections(block, "cyclic")
    assert image.tolist() == [0, 5, 4, 3, 2, 1]
    assert reflections(block, "free") == []
    assert len(reflections(np.ones(6, bool), "cyclic")) == 6


def test_the_defect_of_a_symmetry_is_the_delay_of_mirror_images():
    active = np.array([False, True, True, True, False])
    delays = np.array([0.0, 1.0, 0.0, 1.0, 0.0])
    same = symmetry_defect(made_up(delays, np.full(5, 6.25)), active, 6.25)
    np.testing.assert_allclose(same, 0.0, atol=1e-12)
    delays[1] += 0.05
    off = symmetry_defect(made_up(delays, np.full(5, 6.25)), active, 6.25)
    np.testing.assert_allclose(off, 0.05 / 6.25, rtol=1e-9)
    # Two masses half a period apart are mirror images half a period later.
    pair_of_masses = np.array([True, True, False, False, False])
    record = made_up([0.1, 3.225, 0, 0, 0], np.full(5, 6.25))
    shifted = symmetry_defect(record, pair_of_masses, 6.25)
    np.testing.assert_allclose(shifted, 0.0, atol=1e-12)
