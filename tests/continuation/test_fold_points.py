"""Folds as roots: closed forms, a thousand lanes, derivatives, and points that are not folds."""

import jax
import jax.numpy as jnp
import numpy as np
from systems.normal_forms import bratu, cycles, hysteresis, looped, pitchfork

from jaxchain.continuation.fold_points import fold_point, fold_residual
from jaxchain.continuation.implicit import attach_derivative


def cubic(u, p, a):
    """Folds at u^2 = a/3, p = (2 a / 3) u, for a > 0."""
    return u**3 - a * u + p


def test_folds_of_closed_form_and_crossings_that_are_none():
    """Of residuals that go forward only; where branches cross nothing turns."""
    cases = [
        (looped(hysteresis), None, (-0.5, -0.4), (-(3**-0.5), -2 / 27**0.5)),
        (cycles, 0.8, (0.5, -0.1), (0.4, -0.16)),
        (pitchfork, 1e-3, (-0.1, 0.03), (-(5e-4 ** (1 / 3)), 3 * 5e-4 ** (2 / 3))),
    ]
    for residual, args, start, fold in cases:
        found = fold_point(residual, [start[0]], start[1], args)
        assert found.successful, residual
        np.testing.assert_allclose(found.u, fold[0], atol=1e-11)
        np.testing.assert_allclose(found.p, fold[1], atol=1e-14)
    for start in (0.1, 1e-3, 0.0):
        assert not fold_point(pitchfork, [start], start, 0.0).successful, start


def test_a_thousand_lanes_with_and_without_a_fold_and_its_derivative():
    def fold(a):
        found = fold_point(cubic, jnp.array([0.5]), 0.4, a)
        z = jnp.append(found.u, found.p)
        height = attach_derivative(fold_residual(cubic), z, (a, found.borders))[1]
        return height, found.successful

    a = jnp.linspace(-1.0, 3.0, 1000)
    (height, exists), slope = jax.jit(jax.vmap(jax.value_and_grad(fold, has_aux=True)))(a)
    np.testing.assert_array_equal(exists, a > 0)
    there, height, slope = (np.asarray(part)[a > 0] for part in (a, height, slope))
    np.testing.assert_allclose(np.abs(height), 2 * (there / 3) ** 1.5, rtol=1e-12)
    np.testing.assert_allclose(np.abs(slope), (there / 3) ** 0.5, rtol=1e-11)


def test_the_null_vector_and_the_scale_of_rows():
    m = 6
    u = np.sin(np.pi * np.arange(1, m + 1) / (m + 1))
    rows = 10.0 ** np.random.default_rng(0).uniform(-3, 3, m)
    plain, scaled = (fold_point(bratu, u, 3.5, r) for r in (np.ones(m), rows))
    assert plain.successful
    assert scaled.successful
    np.testing.assert_allclose(scaled.p, plain.p, rtol=1e-12)
    np.testing.assert_allclose(np.abs(scaled.slope), np.abs(plain.slope), rtol=1e-9)
    slope = jax.jacfwd(bratu)(plain.u, plain.p, np.ones(m))
    assert np.max(np.abs(slope @ plain.null)) < 1e-9 * np.max(np.abs(slope))
    np.testing.assert_allclose(np.linalg.norm(plain.null), 1.0)
    # The second singular value, the witness: F_u is singular there and nowhere near.
    singular = np.linalg.svd(slope, compute_uv=False)
    assert singular[-1] < 1e-9 * singular[0] < singular[-2]
