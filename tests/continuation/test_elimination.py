import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import lu_factor

from jaxchain.continuation.elimination import factor, solve, substitute


def test_as_lapack():
    """At the sizes of both ways to loop."""
    for m in (40, 60):
        rng = np.random.default_rng(m)
        scales = 10.0 ** rng.uniform(-3, 3, (m, 1))
        matrix = jnp.asarray(scales * rng.normal(size=(m, m)))
        right = jnp.asarray(rng.normal(size=(m, 2)))
        (lu, pivots), x = jax.jit(lambda a, b: (f := factor(a), substitute(f, b)))(matrix, right)
        wanted, order = lu_factor(matrix)
        np.testing.assert_array_equal(pivots, order)
        greatest = float(jnp.max(jnp.abs(wanted)))
        np.testing.assert_allclose(lu, wanted, rtol=1e-9, atol=1e-9 * greatest)
        x = np.asarray(x)
        left = np.abs(np.asarray(matrix) @ x - np.asarray(right))
        bound = np.abs(np.asarray(matrix)) @ np.abs(x) + 1.0
        assert np.all(left <= 1e-13 * m * bound), m


def test_a_loop_with_a_solve_is_compiled_whole():
    def body(x):
        return solve(jnp.outer(x, x) + jnp.eye(3), x[:, None])[:, 0]

    def program(x):
        return jax.lax.while_loop(lambda x: jnp.max(x) > 0.1, body, x)

    text = str(jax.jit(program).lower(jnp.ones(3)).compile().as_text())
    assert "custom-call" not in text
    assert "scatter" not in text
