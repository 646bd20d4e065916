"""A chain, a state, a mass and a symmetry are handed on, or refused by name and value."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import paper_chain
from jaxchain.model.arguments import as_chain, as_images, as_mass, as_state

CHAIN = paper_chain(3)


def test_valid_values_are_returned():
    assert as_chain(CHAIN) is CHAIN
    x, v = as_state(CHAIN, (np.array([1, 2, 3]), np.zeros(3)))
    np.testing.assert_array_equal(x, [1.0, 2.0, 3.0])
    assert x.dtype == v.dtype == jnp.float64
    assert as_state(CHAIN, (jnp.ones((2, 3)), jnp.ones((2, 3))), batch=True)[1].shape == (2, 3)
    assert (as_mass(3, None, 1), as_mass(3, np.int64(2), 1), as_mass(3, None)) == (1, 2, None)
    assert as_images(None, 3, 0) == (0, 1, 2)
    assert as_images(np.array([1, 1, 2]), 3, 2) == (1, 1, 2)


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: as_chain(3), "`chain` must be a `Chain`, but is 3: make"),
        (lambda: as_chain(None, remedy="use it."), "but is None: use it.$"),
        (lambda: as_chain(eqx.tree_at(lambda c: c.belt_speed, CHAIN, jnp.float32(1.0))), "64-bit"),
        (lambda: as_state(CHAIN, jnp.ones(3)), "`initial` must be the pair"),
        (
            lambda: as_state(CHAIN, (jnp.ones(2), jnp.ones(2)), "state"),
            "`state` has .*for 3 masses",
        ),
        (lambda: as_state(CHAIN, (jnp.ones(3), jnp.ones(2))), r"shape \(3,\): use `jax.vmap`"),
        (lambda: as_state(CHAIN, (jnp.ones(3),) * 2, batch=True), r"shape \(states, 3\)"),
        (lambda: as_state(CHAIN, (jnp.ones(3), jnp.full(3, jnp.nan))), "velocity` must be finite"),
        (lambda: as_mass(3, 3), r"in 0 ... 2, but is 3: it is the index of a mass"),
        (lambda: as_mass(3, True), "but is True"),
        (lambda: as_images((1, 1, 2), 3, 0), r"mass 0 \(`mass`\) among them"),
        (lambda: as_images((0, 1), 3, 0), "for each of 3 masses"),
        (lambda: as_images((1, 2, 2), 3, 2), "`images` must name"),
    ],
)
def test_invalid_values_are_refused(check, message):
    with pytest.raises(ValueError, match=message):
        check()
