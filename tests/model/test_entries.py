"""Entries of arrays, and factors of further matrices, as parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import paper_chain
from jaxchain.model import ExponentialDecay, MechanicalCells

KF = np.array([[0.0, -1.0], [0.0, 0.0]])


def pads(**parts):
    return MechanicalCells(
        [[2.0, 0.5], [0.5, 1.0]], **{"damping": 0.1, "plus": {"friction": KF}, **parts}
    )


def test_entries_are_set_one_by_one():
    cells = pads(mass=[[1.0, 0.1], [0.1, 2.0]], force=[0.1, 0.2], frequency=1.0)
    changed = cells.with_(**{"stiffness[0, 1]": 0.3, "mass[1,0]": 0.2, "force[1]": 0.7})
    np.testing.assert_array_equal(changed.stiffness, [[2.0, 0.3], [0.5, 1.0]])
    np.testing.assert_array_equal(changed.mass, [[1.0, 0.2], [0.2, 2.0]])  # stays symmetric
    np.testing.assert_array_equal(changed.force, [0.1, 0.7])
    assert float(changed.value_of("force[1]")) == 0.7
    chain = paper_chain(3, damping_ratio=jnp.full(3, 0.05)).with_(**{"damping_ratio[2]": 0.2})
    np.testing.assert_array_equal(chain.damping_ratio, [0.05, 0.05, 0.2])
    rate = lambda k: pads().with_(**{"stiffness[0, 1]": k})(0.0, (jnp.ones(1),) * 4)[2][0]
    assert float(jax.jit(jax.grad(rate))(0.3)) == -1.0


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"stifness[0, 1]": 1.0}, "did you mean `stiffness`"),
        ({"stiffness[0]": 1.0}, r"`stiffness\[0\]` must name an entry.*shape \(2, 2\)"),
        ({"stiffness[0, 2]": 1.0}, r"the last one is `stiffness\[1, 1\]`"),
        ({"damping[0]": 1.0}, "`damping` is one number in this model"),
        ({"stiffness[0, 1]": 1.0, "stiffness[0,1]": 2.0}, "names an entry twice"),
        ({"friction": [1.0, 2.0]}, "`friction` must be one number"),
    ],
)
def test_wrong_names_are_refused(changes, names):
    with pytest.raises(ValueError, match=names):
        pads().with_(**changes)


def test_factors_multiply_matrices_of_any_size():
    """Small matrices are written out entry by entry, large ones are arrays."""
    rates = jax.jit(lambda cells, y: cells.with_(friction=0.3, speed=0.5)(0.0, y))
    for d in (2, 7):
        rng = np.random.default_rng(d)
        K, Kf, Df, A, C, Cf = rng.normal(size=(6, d, d))
        M = np.eye(d) + A @ A.T
        plus = {"friction": Kf, "speed": {"damping": Df, "stiffness": Kf.T, "coupling": Cf}}
        cells = MechanicalCells(K, mass=M, coupling=C, plus=plus, damping=0.2)
        q, v = rng.normal(size=(2, d, 3))
        found = rates(cells, (*q, *v))
        bend = 2.0 * q - np.roll(q, 1, 1) - np.roll(q, -1, 1)
        forces = (K + 0.3 * Kf + 0.5 * Kf.T) @ q + (0.2 * np.eye(d) + 0.5 * Df) @ v
        forces = forces + (C + 0.5 * Cf) @ bend
        np.testing.assert_allclose(found[d:], -np.linalg.solve(M, forces), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("parts", "names"),
    [
        ({"plus": {"stiffness": KF}}, "names of its own.*`stiffness`"),
        ({"friction": ExponentialDecay(1.0, 0.5, 0.5)}, "`friction`"),
        ({"plus": {"friction": {"spring": KF}}}, "must be the matrix that is added"),
        ({"plus": {"friction": np.ones((3, 3))}}, "must be one number, or of shape"),
    ],
)
def test_bad_factors_are_refused(parts, names):
    with pytest.raises(ValueError, match=names):
        pads(**parts)
