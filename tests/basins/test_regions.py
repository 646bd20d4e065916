"""Regions of the state space: what they are made of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.basins import Box


def test_a_box_is_that_of_the_issue_by_default_and_its_edges_are_leaves():
    box = Box()
    np.testing.assert_array_equal(box.displacement, [-2.0, 2.0])
    np.testing.assert_array_equal(box.velocity, [0.0, 2.0])
    assert box.masses is None
    assert len(jax.tree.leaves(box)) == 2
    area = jax.grad(lambda box: jnp.prod(jnp.diff(jnp.stack([box.displacement, box.velocity]))))
    np.testing.assert_allclose(area(box).velocity, [-4.0, 4.0])


def test_masses_are_a_tuple_whatever_they_were_given_as():
    for masses in ([0, 2], (0, 2), range(0, 3, 2), np.array([0, 2])):
        assert Box(masses=masses).masses == (0, 2)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"masses.*\(0, 0\)"):
        Box(masses=(0, 0))
