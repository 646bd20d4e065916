import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.solvers.taylor import first_exit, greatest_curvature, value, value_and_slope

FAR = 1e100


def exits(rows, end=1.0, lower=0.0, upper=FAR, resolution=1e-13):
    """`first_exit` of polynomials given by rows of coefficients, repeated until it is final."""
    coefficients = [jnp.asarray(c, float) for c in np.transpose(np.atleast_2d(rows))]
    n = coefficients[0].shape[0]
    one = jnp.ones(n)
    return first_exit(coefficients, lower * one, upper * one, jnp.asarray(end), resolution * one)


def from_roots(*roots, scale=1.0, degree=6):
    """Coefficients, lowest first, of scale prod (t - root)."""
    coefficients = scale * np.polynomial.polynomial.polyfromroots(roots)
    return np.pad(coefficients, (0, degree + 1 - coefficients.size))


def test_values_and_slopes():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(7, 5))
    q, slope = value_and_slope(list(jnp.asarray(rows)), 0.3)
    np.testing.assert_allclose(q, np.polynomial.polynomial.polyval(0.3, rows), rtol=1e-14)
    derivative = np.polynomial.polynomial.polyder(rows)
    np.testing.assert_allclose(
        slope, np.polynomial.polynomial.polyval(0.3, derivative), rtol=1e-13
    )
    assert np.array_equal(value(list(jnp.asarray(rows)), 0.3), q)


def test_curvature_is_a_bound():
    rows = np.random.default_rng(1).normal(size=(8, 50))
    bound = greatest_curvature(list(jnp.asarray(rows)), 0.7)
    second = np.polynomial.polynomial.polyder(rows, 2)
    values = np.abs(np.polynomial.polynomial.polyval(np.linspace(0, 0.7, 200), second))
    assert np.all(values.max(axis=1) <= bound * (1 + 1e-12))


@pytest.mark.parametrize("root", [1e-9, 1e-3, 0.1, 0.5, 0.99])
def test_a_transversal_exit_is_found_to_rounding(root):
    t, out = _until_final(from_roots(root, 3.0, 5.0, scale=-1.0), 1.0)
    assert out
    assert abs(t - root) < 1e-13


@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6])
def test_two_crossings_inside_one_step_are_not_missed(gap):
    """w dips below zero between 0.4 and 0.4 + gap: the sign at the end of the step is the same."""
    coefficients = from_roots(0.4, 0.4 + gap, degree=5)
    t, out = _until_final(coefficients, 1.0)
    assert out
    assert abs(t - 0.4) < 1e-3 * gap + 1e-12


@pytest.mark.parametrize("height", [1e-3, 1e-8, 1e-11])
def test_a_near_touch_is_no_exit(height):
    coefficients = from_roots(0.4, 0.4, degree=5)
    coefficients[0] += height
    t, out = _until_final(coefficients, 1.0)
    assert not out
    assert t == 1.0


def test_either_edge_of_a_band():
    up, down = [0.0, 1.0, 0.1, 0.0], [0.0, -1.0, -0.1, 0.0]
    t, out = exits([up, down], end=2.0, lower=-0.5, upper=0.5)
    assert np.all(out)
    expected = (-1 + np.sqrt(1 + 0.2)) / 0.2
    np.testing.assert_allclose(t, expected, rtol=1e-13)


def test_random_polynomials_against_their_roots():
    """The first exit of 2000 polynomials is the first root that NumPy finds, or there is none."""
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(2000, 8)) * 0.4 ** np.arange(8)
    rows[:, 0] = np.abs(rows[:, 0])
    found = []
    for row in rows:
        roots = np.roots(row[::-1])
        real = roots[(np.abs(roots.imag) < 1e-9)].real
        real = real[(real > 0) & (real < 1.0)]
        found.append(real.min() if real.size else np.inf)
    found = np.array(found)
    t, out = (np.asarray(a) for a in exits(rows))
    # What is declared is right, and what is not yet decided lies before the root.
    np.testing.assert_allclose(t[out], found[out], atol=1e-9)
    assert np.all(t[~out] <= np.minimum(found[~out], 1.0))
    # Most searches end in one call, or an integration would take many steps to an event.
    assert np.mean(out | (t == 1.0)) > 0.9


def test_it_can_be_batched():
    rows = jnp.asarray([from_roots(0.3, 2.0), from_roots(0.6, 2.0)])

    def one(row):
        t, out = first_exit(list(row[:, None]), jnp.zeros(1), jnp.full(1, FAR), jnp.asarray(1.0),
                            jnp.full(1, 1e-13))  # fmt: skip
        return t[0], out[0]

    t, out = jax.vmap(one)(rows)
    np.testing.assert_allclose(t, [0.3, 0.6], rtol=1e-13)
    assert np.all(out)


def _until_final(coefficients, end):
    """The search, repeated from where it got to, as successive steps repeat it."""
    start = 0.0
    polynomial = np.polynomial.Polynomial(coefficients)
    for _ in range(60):
        shifted = polynomial(np.polynomial.Polynomial([start, 1.0])).coef
        t, out = exits(shifted, end=end - start)
        start += float(t[0])
        if bool(out[0]) or start >= end:
            return start, bool(out[0])
    raise AssertionError("the search does not end")
