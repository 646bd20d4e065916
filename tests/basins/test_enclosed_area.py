"""Areas within boxes, of circles, against calculus."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from jaxchain.basins.enclosed_area import area_of_step

BOXES = (
    (-2.0, 2.0, -2.0, 2.0), (-0.5, 0.7, -0.2, 0.9), (-2.0, 0.3, 0.0, 2.0),
    (-0.9, 0.2, -1.5, -0.3), (0.1, 0.9, 0.2, 0.8), (1.2, 1.5, 0.0, 2.0), (-1.0, 1.0, -1.0, 1.0),
)  # fmt: skip


@jax.jit
def area(radius, box):
    """Of a circle, in 96 steps that begin anywhere."""
    times = jnp.linspace(0.0, 2.0 * jnp.pi, 97) + 0.1
    x, v = radius * jnp.sin(times), radius * jnp.cos(times)
    points = jnp.stack([x, v, -x], axis=1)
    step = lambda a, b: area_of_step(a, b, times[1] - times[0], box[:2], box[2:])  # noqa: E731
    return jnp.sum(jax.vmap(step)(points[:-1], points[1:]))


def exact(radius, box):
    a, b, c, d = box

    def height(x):
        half = np.sqrt(max(radius**2 - x**2, 0.0))
        return np.clip(half, c, d) - np.clip(-half, c, d)

    corners = [s * np.sqrt(radius**2 - e**2) for e in (c, d) if abs(e) < radius for s in (-1, 1)]
    inside = [x for x in corners if max(a, -radius) < x < min(b, radius)]
    ends = sorted([max(a, -radius), *inside, min(b, radius)])
    pairs = itertools.pairwise(ends)
    return sum(quad(height, *pair, epsabs=1e-13)[0] for pair in pairs if pair[0] < pair[1])


@pytest.mark.parametrize("box", BOXES)
def test_the_area_of_a_circle_in_a_box_is_that_of_calculus(box):
    """The last box touches the circle with all four edges."""
    assert float(area(1.0, jnp.asarray(box))) == pytest.approx(exact(1.0, box), abs=1e-11)


@pytest.mark.parametrize("box", BOXES[1:-1])
def test_it_has_its_derivatives_in_the_edges_and_in_the_curve(box):
    by_radius, by_box = jax.grad(area, (0, 1))(1.0, jnp.asarray(box))
    small = 1e-6
    for k in range(4):
        moved = small * np.eye(4)[k]
        slope = (exact(1.0, box + moved) - exact(1.0, box - moved)) / (2.0 * small)
        assert float(by_box[k]) == pytest.approx(slope, abs=1e-8)
    slope = (exact(1.0 + small, box) - exact(1.0 - small, box)) / (2.0 * small)
    assert float(by_radius) == pytest.approx(slope, abs=1e-8)
