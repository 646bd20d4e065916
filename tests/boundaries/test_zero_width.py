"""The limit of width 0 and its error bar: exact series, and the direct dry fold as a witness."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import paper_chain
from jaxchain.boundaries.limit import _unless_free, extrapolate
from jaxchain.boundaries.ranges import stability_range

WIDTHS = 1e-3 * 2.0 ** np.arange(6)


def series(e, coefficients):
    log = np.log(1 / e)
    terms = [np.ones_like(e), e * log, e, e**1.5, (e * log) ** 2, e**2 * log]
    return sum(c * t for c, t in zip(coefficients, terms, strict=False))


def test_an_exact_series_is_found_again():
    expected = np.array([1.8, -0.4, -4.0, 3.0, 1.0, -2.0])
    for count, scale in ((4, 1.0), (5, 0.3), (6, 1.0)):
        widths = WIDTHS[:count][::-1].copy()  # in any order
        found = extrapolate(series(widths / scale, expected[:count]), widths, scale=scale)
        np.testing.assert_allclose(found.coefficients, expected[:count], rtol=1e-5)
        np.testing.assert_allclose(found.value, expected[0], rtol=1e-12)


def test_the_bar_holds_for_other_functions():
    """Functions of eps ln(eps) and eps^(1/2) that are no finite series."""
    for count in (4, 6, 8):
        widths = 5e-4 * 2.0 ** np.arange(count)
        shift = 0.25 * widths * np.log(30 / widths)
        for values, truth in (
            (np.sqrt(2.0 - shift), np.sqrt(2.0)),
            (np.exp(-3.0 * shift + widths**1.5), 1.0),
            (1.0 / (1.0 + shift + 2.0 * widths), 1.0),
        ):
            found = extrapolate(values, widths)
            wrong = abs(found.value - truth)
            assert 1e-13 < wrong < found.error < 1e-3, count
            assert found.error < 1e3 * wrong
            assert found.error < 0.1 * abs(values[0] - truth)


def test_it_is_linear_in_the_values_and_transforms():
    values = jnp.asarray(series(WIDTHS, [1.8, -0.4, -4.0, 3.0, 1.0, -2.0]))
    limit = jax.jit(lambda y: extrapolate(y, WIDTHS).value)
    slope = jax.grad(limit)(values)
    np.testing.assert_allclose(slope @ values, limit(values), rtol=1e-10)
    np.testing.assert_allclose(jnp.sum(slope), 1.0, rtol=1e-9)
    # Lanes of their own widths; one that is not known harms no other.
    both = jax.vmap(extrapolate)(
        jnp.stack([values, values.at[2].set(jnp.nan)]), jnp.stack([jnp.asarray(WIDTHS)] * 2)
    )
    np.testing.assert_allclose(both.value[0], 1.8, rtol=1e-12)
    assert jnp.isnan(both.value[1])
    assert jnp.isnan(both.error[1])


def test_a_mass_that_stays_out_of_the_layer_has_the_bar_of_a_straight_line():
    """s falls like 1 / width, so w has a limit; the fold at the least width is off by its bar."""
    widths = np.array([4e-3, 1e-3, 1.3e-2, 4e-2])
    folds = 1.8 + 0.3 * widths
    parts = map(jnp.asarray, (folds, -1e-2 / widths, widths))
    found = _unless_free(extrapolate(folds, widths), *parts)
    assert float(found.value) == folds[1]
    assert float(found.error) == pytest.approx(0.3 * 1e-3, rel=1e-4)


@pytest.mark.long
def test_the_bar_holds_for_folds_of_dry_friction():
    """The paper's set, one whose friction does not weaken, and two others."""
    names = ("damping_ratio", "mu_static", "mu_dynamic", "v_ref")
    sets = np.array([[0.05, 1.0, 0.5, 0.5], [0.05, 1.0, 1.0, 0.5], [0.12, 0.7, 0.3, 0.3],
                     [0.02, 1.3, 0.6, 0.9]])  # fmt: skip
    found = jax.jit(jax.vmap(lambda p: stability_range(
        paper_chain(1).with_(**dict(zip(names, p, strict=True))), error_bars=True)
    ))(sets)  # fmt: skip
    known = np.isfinite(found.fold_limit) & np.isfinite(found.fold_dry)
    np.testing.assert_array_equal(known, [True, False, True, True])
    wrong, bar = np.abs(found.fold_limit - found.fold_dry)[known], found.fold_limit_error[known]
    assert np.all(wrong <= bar)
    assert np.median(bar / found.fold_dry[known]) < 1e-5
    assert np.median(wrong / found.fold_dry[known]) < 1e-6
    # At the chain's own width, 1e-3, all are biased, by far more than the bar.
    assert np.all((found.fold_limit - found.fold)[known] > 100 * bar)
    np.testing.assert_allclose(found.fold[0], 1.831129820, rtol=1e-8)  # by continuation
