"""Folds as roots of the bordered system: closed forms, derivatives, the null vectors."""

import jax
import jax.numpy as jnp
import numpy as np
from systems.normal_forms import bratu, looped

from jaxchain.continuation.damped_newton import newton
from jaxchain.continuation.fold_points import fold_residual, null_vectors
from jaxchain.continuation.implicit import attach_derivative


def fold(residual, z, args):
    """([u; p] of the fold near z, with derivatives in `args`; whether the search found one)."""
    slope = jax.jacfwd(lambda u: residual(u, z[-1], args))(z[:-1])
    equations, args = fold_residual(residual), (args, null_vectors(slope))
    root = newton(equations, z, args)
    return attach_derivative(equations, root.value, args), root.successful


# Through a loop, so that it has forward derivatives only.
CUBIC = looped(lambda u, p, a: u**3 - a * u + p)


def test_a_thousand_lanes_with_and_without_a_fold_and_its_derivative():
    """Folds at u^2 = a / 3, p = (2 a / 3) u, for a > 0."""

    def height(a):
        z, found = fold(CUBIC, jnp.array([0.5, 0.4]), a)
        return z[1], (z[0], found)

    a = np.linspace(-1.0, 3.0, 1000)
    (p, (u, found)), slope = jax.jit(jax.vmap(jax.value_and_grad(height, has_aux=True)))(a)
    np.testing.assert_array_equal(found, a > 0)
    a, u, p, slope = (np.asarray(part)[a > 0] for part in (a, u, p, slope))
    np.testing.assert_allclose(u**2, a / 3, rtol=1e-10)
    np.testing.assert_allclose(p, 2 * a / 3 * u, rtol=1e-10)
    np.testing.assert_allclose(np.abs(p), 2 * (a / 3) ** 1.5, rtol=1e-12)
    np.testing.assert_allclose(slope, u, rtol=1e-10)


def test_the_matrix_is_singular_at_a_fold_whatever_the_scale_of_rows():
    m = 6
    start = np.append(np.sin(np.pi * np.arange(1, m + 1) / (m + 1)), 3.5)
    scales = 10.0 ** np.random.default_rng(0).uniform(-3, 3, m)
    search = jax.jit(lambda rows: fold(bratu, start, rows))
    (plain, found), (scaled, found_again) = search(np.ones(m)), search(scales)
    assert found
    assert found_again
    np.testing.assert_allclose(scaled, plain, rtol=1e-9)
    # The singular values, the witness: F_u is singular there and nowhere near.
    slope = jax.jit(jax.jacfwd(bratu))(plain[:-1], plain[-1], np.ones(m))
    singular = np.linalg.svd(slope, compute_uv=False)
    assert singular[-1] < 1e-9 * singular[0] < singular[-2]
