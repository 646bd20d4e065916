import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxchain.continuation import attach_derivative


def residual(u, numbers):
    """u0^2 a - b0 = 0 and u1 - u0 b1 = 0, within a loop that nothing can go back through."""
    _, one = lax.while_loop(lambda c: c[0] < 3 * u[0], lambda c: (c[0] + 1.0, c[1]), (0.0, 1.0))
    return jnp.stack(
        [one * u[0] ** 2 * numbers["a"] - numbers["b"][0], u[1] - u[0] * numbers["b"][1]]
    )


def solved(numbers, **options):
    root = jnp.sqrt(numbers["b"][0] / numbers["a"])
    return attach_derivative(
        residual, jnp.stack([root, root * numbers["b"][1]]), numbers, **options
    )


def exact(numbers):
    root = jnp.sqrt(numbers["b"][0] / numbers["a"])
    return jnp.stack([root, root * numbers["b"][1]])


NUMBERS = {"a": jnp.asarray(2.0), "b": jnp.asarray([3.0, 0.5]), "n": 4}


def test_forward_and_reverse_derivatives_are_those_of_the_closed_form():
    for numbers in (NUMBERS,):
        tree, expected = (
            eqx.filter_jit(eqx.filter_grad(lambda n, f=f: jnp.sum(f(n) ** 2)))(numbers)
            for f in (solved, exact)
        )
        np.testing.assert_allclose(tree["a"], expected["a"], rtol=1e-12)
        np.testing.assert_allclose(tree["b"], expected["b"], rtol=1e-12)
        assert tree["n"] is None
    tangent = jax.jit(jax.jacfwd(lambda a: solved({**NUMBERS, "a": a})))(2.0)
    np.testing.assert_allclose(tangent, -exact(NUMBERS) / 4.0, rtol=1e-12)


@pytest.mark.long
def test_second_derivatives_and_batches():
    def f(a):
        return solved({**NUMBERS, "a": a})[0]

    np.testing.assert_allclose(jax.hessian(f)(2.0), 0.75 * exact(NUMBERS)[0] / 4.0, rtol=1e-12)
    a = jnp.linspace(1.0, 3.0, 5)
    slopes = jax.jit(jax.vmap(jax.grad(f)))(a)
    np.testing.assert_allclose(slopes, -0.5 * jnp.sqrt(3.0) * a**-1.5, rtol=1e-12)


def test_a_function_with_first_derivatives_only_refuses_second_ones():
    def f(a):
        return solved({**NUMBERS, "a": a}, once="once only")[0]

    assert np.isfinite(jax.grad(f)(2.0))
    with pytest.raises(RuntimeError, match="once only"):
        jax.hessian(f)(2.0)


def test_no_solution_gives_nan():
    nan = jnp.full(2, jnp.nan)
    slope = jax.grad(lambda a: attach_derivative(residual, nan, {**NUMBERS, "a": a})[0])(2.0)
    assert np.isnan(slope)
