"""Confidence intervals against those of SciPy, and against how often they hold the truth."""

import numpy as np
import scipy.stats

from jaxchain._statistics import mean_interval, student_reach, wilson


def test_the_interval_of_a_mean_holds_the_truth_in_95_of_100_cases():
    draws = np.random.default_rng(1).normal(1.0, 2.0, (4, 4000))
    low, high = mean_interval(draws)
    assert 0.94 < np.mean((low < 1.0) & (high > 1.0)) < 0.96
    expected = scipy.stats.t(3).interval(0.99)
    np.testing.assert_allclose([-student_reach(0.99, 3), student_reach(0.99, 3)], expected)


def test_intervals_against_scipy():
    for hits, total in ((0, 10), (3, 10), (1000, 1000), (417, 1000)):
        expected = scipy.stats.binomtest(hits, total).proportion_ci(method="wilson")
        np.testing.assert_allclose(wilson(hits, total), expected, atol=1e-12)
    assert np.all(np.isnan(wilson(0, 0)))
