import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.solvers.taylor import first_exit, value, value_and_slope

FAR = 1e100


@jax.jit
def first_of(rows, end=1.0, lower=0.0, upper=FAR, resolution=1e-13):
    """`first_exit` of polynomials that are given by rows of coefficients."""
    rows = jnp.asarray(rows, float)
    one = jnp.ones(rows.shape[0])
    end = jnp.asarray(end)
    return first_exit(list(rows.T), lower * one, upper * one, end, resolution * one)


def exits(rows, end=1.0, lower=0.0, upper=FAR):
    """The same of each polynomial alone."""
    t, out = _each(np.atleast_2d(rows), end, lower, upper)
    return np.asarray(t), np.asarray(out)[:, 0]


@jax.jit
def _each(rows, *limits):
    return jax.vmap(lambda row: first_of(row[None], *limits))(rows)


def from_roots(*roots, scale=1.0, degree=6):
    """Coefficients, lowest first, of scale prod (t - root)."""
    coefficients = scale * np.polynomial.polynomial.polyfromroots(roots)
    return np.pad(coefficients, (0, degree + 1 - coefficients.size))


def test_values_slopes_and_the_bound_of_the_curvature():
    P = np.polynomial.polynomial
    rows = np.random.default_rng(0).normal(size=(7, 5))
    both = lambda t: value_and_slope(list(jnp.asarray(rows)), t)
    computed = jax.jit(lambda t: (jax.jvp(both, (t,), (1.0,)), value(list(jnp.asarray(rows)), t)))
    ((q, slope), (rate, bend)), alone = computed(0.3)
    np.testing.assert_allclose(q, P.polyval(0.3, rows), rtol=1e-14)
    np.testing.assert_allclose(slope, P.polyval(0.3, P.polyder(rows)), rtol=1e-13)
    np.testing.assert_allclose(alone, q, rtol=1e-15)
    np.testing.assert_allclose(rate, slope, rtol=1e-13)
    np.testing.assert_allclose(bend, P.polyval(0.3, P.polyder(rows, 2)), rtol=1e-13)
    assert float(jax.jit(jax.hessian(lambda t: value([0.5, 2.0], t)))(0.3)) == 0.0  # a line


def test_exits_are_found_to_rounding():
    for root in (1e-9, 1e-3, 0.1, 0.5, 0.99):  # transversal
        t, out = _until_final(from_roots(root, 3.0, 5.0, scale=-1.0), 1.0)
        assert out, root
        assert abs(t - root) < 1e-13, root
    for late in (0.0, 1e-14, 1e-9):  # at the very end, which counts, and just behind
        for others in ((), (3.0, 5.0)):
            t, out = _until_final(from_roots(1.0 + late, *others, scale=-1.0), 1.0)
            assert t == pytest.approx(1.0, abs=1e-13)
            assert bool(out) == (late < 1e-13), (late, others)
    for gap in (1e-2, 1e-4, 1e-6):  # below zero between 0.4 and 0.4 + gap: two signs are the same
        t, out = _until_final(from_roots(0.4, 0.4 + gap, degree=6), 1.0)
        assert out, gap
        assert abs(t - 0.4) < 1e-3 * gap + 1e-12, gap
    for height in (1e-3, 1e-8, 1e-11):  # a near touch is no exit
        coefficients = from_roots(0.4, 0.4, degree=6)
        coefficients[0] += height
        assert _until_final(coefficients, 1.0) == (1.0, False), height


def test_either_edge_of_a_band():
    for sign in (1.0, -1.0):
        t, out = exits([0.0, sign, 0.1 * sign, *4 * [0.0]], 2.0, -0.5, 0.5)
        assert out
        np.testing.assert_allclose(t, (-1 + np.sqrt(1 + 0.2)) / 0.2, rtol=1e-13)


def test_the_first_of_many_polynomials_against_their_roots():
    """All stay until t, and those that are said to leave then are those whose root it is."""
    rng = np.random.default_rng(3)
    groups = rng.normal(size=(60, 20, 8)) * 0.3 ** np.arange(8)
    groups[..., 0] = np.abs(groups[..., 0])
    roots = np.array([[_first_root(row) for row in rows] for rows in groups])
    t, out = (np.asarray(a) for a in jax.jit(jax.vmap(first_of))(groups))
    first, leaves = roots.min(axis=1), out.any(axis=1)
    assert np.all(t <= np.minimum(first, 1.0) + 1e-12)
    np.testing.assert_allclose(t[leaves], first[leaves], atol=1e-12)
    assert np.array_equal(out[leaves], np.abs(roots[leaves] - first[leaves, None]) < 1e-9)
    # Steps whose searches did not end cost as much as those to an event.
    assert np.mean(leaves | (t == 1.0)) > 0.9


def _first_root(row):
    """The first root that NumPy finds between 0 and 1, or infinity."""
    roots = np.roots(row[::-1])
    real = roots[(np.abs(roots.imag) < 1e-9)].real
    return real[(real > 0) & (real < 1.0)].min(initial=np.inf)


def _moved(coefficients, start):
    """Those about another time."""
    polynomial = np.polynomial.Polynomial(coefficients)
    moved = polynomial(np.polynomial.Polynomial([start, 1.0])).coef
    return np.pad(moved, (0, len(coefficients) - len(moved)))


def _until_final(coefficients, end):
    """The search, repeated from where it got to, as successive steps repeat it."""
    start = 0.0
    for _ in range(60):
        t, out = exits(_moved(coefficients, start), end - start)
        start += float(t[0])
        if bool(out[0]) or start >= end:
            return start, bool(out[0])
    raise AssertionError("the search does not end")
