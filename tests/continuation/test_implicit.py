import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxchain.continuation.implicit import attach_derivative

NUMBERS = {"a": jnp.asarray(2.0), "b": jnp.asarray([3.0, 0.5]), "n": 4}


def residual(u, numbers):
    """u0^2 a - b0 = 0 and u1 - u0 b1 = 0, within a loop that nothing can go back through."""
    _, one = lax.while_loop(lambda c: c[0] < 3 * u[0], lambda c: (c[0] + 1.0, c[1]), (0.0, 1.0))
    return jnp.stack(
        [one * u[0] ** 2 * numbers["a"] - numbers["b"][0], u[1] - u[0] * numbers["b"][1]]
    )


def exact(numbers):
    root = jnp.sqrt(numbers["b"][0] / numbers["a"])
    return jnp.stack([root, root * numbers["b"][1]])


def with_numbers(function, **options):
    """`function` of (a, b0, b1): attached to the solution, unless it is `exact`."""

    def of(z):
        numbers = {**NUMBERS, "a": z[0], "b": z[1:]}
        if function is exact:
            return exact(numbers)
        return attach_derivative(residual, exact(numbers), numbers, **options)

    return of


def test_derivatives_are_those_of_the_closed_form():
    """Forward, in reverse, in a batch, and second ones."""
    points = jnp.array([[2.0, 3.0, 0.5], [0.7, 1.3, -2.0]])

    def all_of(f):
        both = jax.vmap(lambda z: (f(z), jax.jacrev(f)(z), jax.jacfwd(jax.jacrev(f))(z)))
        return *jax.jit(both)(points), jax.jit(jax.vmap(jax.jacfwd(f)))(points)

    found, expected = (all_of(with_numbers(f)) for f in (residual, exact))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_a_function_with_first_derivatives_only_refuses_second_ones():
    """Without a solution its derivative is NaN."""

    def f(a):
        return with_numbers(residual, once="once only")(jnp.array([a, 3.0, 0.5]))[0]

    slope = jax.jit(jax.grad(f))
    assert np.isfinite(slope(2.0))
    assert np.isnan(slope(-2.0))
    with pytest.raises(RuntimeError, match="once only"):
        jax.hessian(f)(2.0)
