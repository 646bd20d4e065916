"""Where a system may start."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxchain import paper_chain
from jaxchain.basins import Ball, Box, Gaussian, Ranges, Sampler
from jaxchain.basins.regions import Points, check_region
from jaxchain.model import LuGre

CHAIN, CELLS = paper_chain(3, belt_speed=1.5, width=None), LuGre()
SLIDING = 0.5 + 0.5 * np.exp(-3.0)
LOW, HIGH = ([-1.0, 0.0], [2.0, 2.0], [5.0, 0.5]), ([1.0, 3.0], [2.0, 4.0], [6.0, 0.5])
REGIONS = {
    "box": (Box(displacement=(-2, 1), velocity=(0, 3)), CHAIN),
    "ball": (Ball(0.5), CHAIN),
    "gaussian": (Gaussian(displacement=0.5, velocity=2.0), CHAIN),
    "ranges": (Ranges(LOW, HIGH), CELLS),
    "one of a box": (Box(masses=(1,)), CHAIN),
    "one of a ball": (Ball(0.5, masses=(1,)), CHAIN),
    "one of a gaussian": (Gaussian(0.5, 0.5, masses=(1,)), CHAIN),
}


@pytest.fixture(scope="module")
def made():
    """The states of 4096 random points, after two corners of the cube; all in one program."""
    rng = np.random.default_rng(0)
    cubes = {}
    for name, (region, model) in REGIONS.items():
        dimension = region.dimension(model)
        corners = np.repeat([[0.0], [1.0]], dimension, axis=1)
        cubes[name] = np.concatenate([corners, rng.random((4096, dimension))])

    @jax.jit
    def starts(regions, cubes):
        def of(name, cube):
            return jax.vmap(lambda point: regions[name][0].start(regions[name][1], point))(cube)

        return {name: of(name, cube) for name, cube in cubes.items()}

    states = starts(REGIONS, cubes)
    # Normal numbers of the corners are finite.
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
    return {name: [np.asarray(part[2:]) for part in state] for name, state in states.items()}


def test_regions_have_their_distributions(made):
    x, v = made["box"]
    for own, low, high in zip([*x.T, *v.T], [-2] * 3 + [0] * 3, [1] * 3 + [3] * 3, strict=True):
        assert scipy.stats.kstest(own, scipy.stats.uniform(low, high - low).cdf).pvalue > 0.01
    assert abs(np.corrcoef(np.hstack([x, v]).T) - np.eye(6)).max() < 0.06
    x, v = made["gaussian"]
    for own, spread in zip([*(x - SLIDING).T, *v.T], [0.5] * 3 + [2.0] * 3, strict=True):
        assert scipy.stats.kstest(own, scipy.stats.norm(0, spread).cdf).pvalue > 0.01
    x, v = made["ball"]
    y = np.hstack([x - SLIDING, v])
    share = (np.linalg.norm(y, axis=1) / 0.5) ** 6
    assert scipy.stats.kstest(share, "uniform").pvalue > 0.01
    # All directions alike.
    assert np.abs(y.mean(0)).max() < 0.01
    spread = np.cov(y.T)
    assert np.allclose(spread, np.eye(6) * np.trace(spread) / 6, atol=2e-3)
    for part, a, b in zip(made["ranges"], LOW, HIGH, strict=True):
        np.testing.assert_allclose(np.min(part, axis=0), a, atol=0.02)
        np.testing.assert_allclose(np.max(part, axis=0), b, atol=0.02)
        np.testing.assert_allclose(np.mean(part, axis=0), np.add(a, b) / 2, atol=0.07)


@pytest.mark.parametrize("kind", ["box", "ball", "gaussian"])
def test_masses_that_are_not_pushed_slide(made, kind):
    x, v = made[f"one of a {kind}"]
    np.testing.assert_allclose(x[:, [0, 2]], SLIDING, rtol=1e-15)
    assert np.all(v[:, [0, 2]] == 0)
    assert np.ptp(x[:, 1]) > 0.1
    assert np.ptp(v[:, 1]) > 0.1
    with pytest.raises(ValueError, match="`masses` must be"):
        REGIONS[f"one of a {kind}"][0].dimension(paper_chain(1))


def test_starts_have_derivatives_in_the_edges():
    def start(high):
        in_box = Box(displacement=(-2.0, high)).start(CHAIN, jnp.full(6, 0.25))[0][0]
        return in_box + 10.0 * Ranges(([0.0],), (high[None],)).start(CELLS, jnp.full(1, 0.3))[0][0]

    assert float(jax.jit(jax.grad(start))(jnp.asarray(2.0))) == pytest.approx(3.25)


def test_a_region_that_does_not_fit_is_refused():
    pairs = r"make the pair \(displacement, velocity\) of shape \(3,\)"
    none: Any = lambda chain, point: point
    for sampler in (Sampler(none, 2), Sampler(lambda chain, point: (point, point), 2)):
        with pytest.raises(ValueError, match=pairs):
            check_region(sampler, CHAIN)
    assert check_region(Sampler(lambda chain, point: (point, point), 3), CHAIN) == 3
    assert check_region(REGIONS["ranges"][0], CELLS) == 2
    with pytest.raises(ValueError, match="must make the tuple"):
        check_region(Ranges(([0.0], [0.0]), ([1.0], [1.0])), CELLS)
    for region in (Box(), Ball(1.0), Gaussian(1.0, 1.0)):
        with pytest.raises(ValueError, match=r"`Chain`.*`Ranges` and `Sampler`"):
            check_region(region, CELLS)
    with pytest.raises(ValueError, match="low <= high"):
        Ranges(([0.0, 2.0],), ([1.0, 1.0],))


@pytest.mark.parametrize("kind", ["sobol", "random"])
def test_points_go_on_where_they_stopped_and_replicates_differ(kind):
    once = Points(3, 4, kind, 7).more(64)
    again = Points(3, 4, kind, 7)
    assert np.array_equal(once, np.concatenate([again.more(16), again.more(48)], axis=1))
    assert once.shape == (4, 64, 3)
    assert 0 <= once.min() < once.max() < 1
    assert len(np.unique(once[:, 0, 0])) == 4
    assert not np.array_equal(once, Points(3, 4, kind, 8).more(64))


def test_sobol_points_fill_the_cube_more_evenly():
    def worst(kind):
        means = Points(2, 16, kind, 0).more(256).mean(axis=1)
        return np.abs(means - 0.5).max()

    assert worst("sobol") < 0.1 * worst("random")
