"""The law of the error over the width: fitted, inverted, and left where it does not hold."""

import numpy as np
import pytest

from jaxchain.studies.crosscheck.bias import LEAST_POINTS, WORST, Law, fit_law, width_for

WIDTHS = np.logspace(-5, -1, 13)


@pytest.mark.parametrize(
    ("a", "b"), [(-0.5, -1.2), (0.3, 0.0), (-0.2, 4.0), (0.7, -18.0), (1e-6, 2.0), (0.0, -3.0)]
)
def test_a_law_is_found_again_and_inverted(a, b):
    error = Law(a, b).error(WIDTHS)
    law = fit_law(WIDTHS[::-1], error[::-1])  # in any order
    assert [law.a, law.b] == pytest.approx([a, b], abs=1e-9)
    assert law.worst < 1e-9
    assert law.widest == pytest.approx(0.1)
    for accuracy in (1e-2, 1e-3, 1e-4):
        width = law.width_for(accuracy)
        assert abs(law.error(width)) == pytest.approx(accuracy, rel=1e-5)
        finer = np.geomspace(1e-3, 1.0, 200) * width
        assert np.all(np.abs(law.error(finer)) <= accuracy * (1 + 1e-5))


def test_only_where_it_holds():
    """A correction of higher order is left out with the widths at which it is felt."""
    law = Law(-0.5, -1.2)
    error = law.error(WIDTHS) * (1 + WIDTHS**0.5)
    found = fit_law(WIDTHS, error)
    assert found.widest < 0.1
    assert found.worst <= WORST
    assert found.a == pytest.approx(law.a, rel=0.06)
    # Beyond it the width is read off the errors themselves.
    assert found.width_for(0.1) > found.widest
    width = width_for(WIDTHS, error, found, 0.1)
    assert abs(law.error(width)) * (1 + width**0.5) == pytest.approx(0.1, rel=0.02)


def test_unknown_errors_are_left_out():
    law = Law(-0.5, -1.2)
    error = law.error(WIDTHS)
    error[0], error[-3:] = 1e-9, np.nan  # what numerics decide; what has died
    found = fit_law(WIDTHS, error, floor=1e-8)
    assert [found.a, found.b] == pytest.approx([law.a, law.b], rel=1e-9)
    assert found.widest == WIDTHS[-4]
    # Where nothing vibrates nothing is right.
    assert width_for(WIDTHS, error, found, 0.9) == WIDTHS[-4]


def test_too_few_errors_make_no_law():
    error = np.full(WIDTHS.size, np.nan)
    error[: LEAST_POINTS - 1] = Law(-0.5, -1.2).error(WIDTHS[: LEAST_POINTS - 1])
    law = fit_law(WIDTHS, error)
    assert np.isnan(law.a)
    assert np.isnan(law.width_for(1e-3))
    assert width_for(WIDTHS, error, law, 1e-3) == WIDTHS[LEAST_POINTS - 2]
    assert np.isnan(width_for(WIDTHS, error, law, 1e-7))


def test_errors_that_are_small_everywhere_allow_every_width():
    assert width_for(WIDTHS, 1e-6 * WIDTHS, Law(1.0, 0.0, widest=1e-3), 0.01) == 0.1
