"""Where a system may start."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxchain import paper_chain, steady_sliding
from jaxchain.basins import Ball, Box, Gaussian, Ranges, Sampler
from jaxchain.basins.regions import Points, check_region
from jaxchain.model import LuGre

CHAIN = paper_chain(3, belt_speed=1.5, width=None)
SLIDING = np.asarray(steady_sliding(CHAIN)[0])


def states(region, count=4096, chain=CHAIN):
    points = np.random.default_rng(0).random((count, region.dimension(chain)))
    x, v = jax.vmap(lambda point: region.start(chain, point))(jnp.asarray(points))
    return np.asarray(x), np.asarray(v)


def test_a_box_is_filled_evenly():
    x, v = states(Box(displacement=(-2, 1), velocity=(0, 3)))
    for values, edges in ((x, (-2, 1)), (v, (0, 3))):
        for own in values.T:
            low, high = edges
            assert scipy.stats.kstest(own, scipy.stats.uniform(low, high - low).cdf).pvalue > 0.01
    assert abs(np.corrcoef(np.hstack([x, v]).T) - np.eye(6)).max() < 0.06


@pytest.mark.parametrize(
    "region", [Box(masses=(1,)), Ball(0.5, masses=(1,)), Gaussian(0.5, 0.5, masses=(1,))]
)
def test_masses_that_are_not_pushed_slide(region):
    x, v = states(region, 100)
    assert np.all(x[:, [0, 2]] == SLIDING[[0, 2]])
    assert np.all(v[:, [0, 2]] == 0)
    assert np.ptp(x[:, 1]) > 0.1
    assert np.ptp(v[:, 1]) > 0.1
    with pytest.raises(ValueError, match="`masses` must be"):
        region.dimension(paper_chain(1))


def test_a_ball_is_filled_evenly():
    x, v = states(Ball(0.5))
    y = np.hstack([x - SLIDING, v])
    share = (np.linalg.norm(y, axis=1) / 0.5) ** 6
    assert scipy.stats.kstest(share, "uniform").pvalue > 0.01
    # All directions alike.
    assert np.abs(y.mean(0)).max() < 0.01
    spread = np.cov(y.T)
    assert np.allclose(spread, np.eye(6) * np.trace(spread) / 6, atol=2e-3)


def test_a_gaussian_scatters_about_sliding():
    x, v = states(Gaussian(displacement=0.5, velocity=2.0))
    for values, spread in (((x - SLIDING) / 0.5, 1.0), (v, 2.0)):
        for own in values.T:
            assert scipy.stats.kstest(own, scipy.stats.norm(0, spread).cdf).pvalue > 0.01


def test_the_corners_of_the_cube_are_finite():
    for region in (Box(), Ball(1.0), Gaussian(1.0, 1.0)):
        for corner in (0.0, 1.0):
            point = jnp.full(region.dimension(CHAIN), corner)
            assert all(np.isfinite(part).all() for part in region.start(CHAIN, point))


def test_starts_have_derivatives_in_the_edges():
    def start(high):
        return Box(displacement=(-2.0, high)).start(CHAIN, jnp.full(6, 0.25))[0][0]

    assert jax.grad(start)(2.0) == 0.25


PAIRS = r"make the pair \(displacement, velocity\) of shape \(3,\)"


def test_a_sampler_must_make_states():
    none: Any = lambda chain, point: point  # noqa: E731
    with pytest.raises(ValueError, match=PAIRS):
        check_region(Sampler(none, 2), CHAIN)
    with pytest.raises(ValueError, match=PAIRS):
        check_region(Sampler(lambda chain, point: (point, point), 2), CHAIN)
    check_region(Sampler(lambda chain, point: (point, point), 3), CHAIN)


def test_ranges_fill_a_box_between_two_states_of_any_cell():
    low, high = ([-1.0, 0.0], [2.0, 2.0], [5.0, 0.5]), ([1.0, 3.0], [2.0, 4.0], [6.0, 0.5])
    region, cells = Ranges(low, high), LuGre()
    assert check_region(region, cells) == 2
    points = np.random.default_rng(0).random((1000, region.dimension(cells)))
    starts = jax.vmap(lambda point: region.start(cells, point))(jnp.asarray(points))
    for part, a, b in zip(starts, low, high, strict=True):
        np.testing.assert_allclose(np.min(part, axis=0), a, atol=0.02)
        np.testing.assert_allclose(np.max(part, axis=0), b, atol=0.02)
        np.testing.assert_allclose(np.mean(part, axis=0), np.add(a, b) / 2, atol=0.07)
    corner = jax.grad(
        lambda top: jnp.sum(Ranges(([0.0],), (top,)).start(cells, jnp.full(1, 0.3))[0])
    )
    np.testing.assert_allclose(corner(jnp.ones(1)), 0.3)


@pytest.mark.parametrize(
    ("low", "high", "match"),
    [
        (3.0, ([1.0], [1.0]), "`low` must be a state"),
        ((), (), "`low` must be a state"),
        ((["a"],), ([1.0],), "`low`"),
        (([np.nan],), ([1.0],), "`low`"),
        (([0.0],), ([0.0],), "low < high"),
        (([0.0, 2.0],), ([1.0, 1.0],), "low <= high"),
        (([0.0],), ([1.0, 1.0],), "arrays of one shape"),
        (([0.0], [0.0]), ([1.0],), "arrays of one shape"),
    ],
)
def test_ranges_that_are_none_are_refused(low, high, match):
    with pytest.raises(ValueError, match=match):
        Ranges(low, high)


def test_a_region_that_does_not_fit_the_cells_is_refused():
    with pytest.raises(ValueError, match="must make the tuple"):
        check_region(Ranges(([0.0], [0.0]), ([1.0], [1.0])), LuGre())
    for region in (Box(), Ball(1.0), Gaussian(1.0, 1.0)):
        with pytest.raises(ValueError, match=r"`Chain`.*`Ranges` and `Sampler`"):
            check_region(region, LuGre())
    with pytest.raises(ValueError, match="make the pair"):
        check_region(Ranges(([0.0],), ([1.0],)), CHAIN)


@pytest.mark.parametrize("kind", ["sobol", "random"])
def test_points_go_on_where_they_stopped_and_replicates_differ(kind):
    once = Points(3, 4, kind, 7).more(64)
    again = Points(3, 4, kind, 7)
    assert np.array_equal(once, np.concatenate([again.more(16), again.more(48)], axis=1))
    assert once.shape == (4, 64, 3)
    assert once.min() >= 0
    assert once.max() < 1
    assert len(np.unique(once[:, 0, 0])) == 4
    assert not np.array_equal(once, Points(3, 4, kind, 8).more(64))


def test_sobol_points_fill_the_cube_more_evenly():
    def worst(kind):
        means = Points(2, 16, kind, 0).more(256).mean(axis=1)
        return np.abs(means - 0.5).max()

    assert worst("sobol") < 0.1 * worst("random")
