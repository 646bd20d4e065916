import numpy as np
import optax
import pytest

from jaxchain import fold_belt_speed, fold_by_descent, paper_chain


@pytest.mark.long
def test_ascent_and_secant_find_the_same_fold():
    chain = paper_chain(1, width=0.02)
    found = fold_by_descent(chain)
    assert bool(found.converged)
    np.testing.assert_allclose(found.belt_speed, fold_belt_speed(chain), rtol=3e-8)
    # It climbs: no cycle on the way is faster, and the first ones are slower.
    speeds = np.asarray(found.belt_speeds)
    assert np.nanmax(speeds) == float(found.belt_speed)
    assert np.nanmin(speeds) < float(found.belt_speed) - 1e-3


@pytest.mark.exhaustive
def test_any_optimiser_will_do_from_either_side():
    chain = paper_chain(1, width=0.02)
    sgd = optax.sgd(0.3)
    for start in (-3.5, -1.6):
        found = fold_by_descent(chain, start=start, optimiser=sgd, steps=150)
        np.testing.assert_allclose(found.belt_speed, fold_belt_speed(chain), rtol=1e-6)


def test_steps_and_tolerance_are_checked():
    with pytest.raises(ValueError, match="`steps`"):
        fold_by_descent(paper_chain(1), steps=0)
    with pytest.raises(ValueError, match="`tolerance`"):
        fold_by_descent(paper_chain(1), tolerance=0.0)
