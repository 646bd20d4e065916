"""Level crossings: polynomials, whose zeros are known, and their slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Coulomb, equation_8, paper_chain, simulate, sweep
from jaxchain.model import MechanicalCells
from jaxchain.observers import Crossings

# x'' = 6 t + 12, so that x = (t + 6) (t + 2) (t - 2) from x(-8) on; without friction, and with
# none at a contact, which is integrated by events.
FREE = MechanicalCells(0.0, force=lambda t: 6.0 * t + 12.0)
DRY = MechanicalCells(
    0.0, friction=Coulomb(0.0), normal_load=0.0, force=lambda t: 6.0 * t + 12.0
)  # fmt: skip
START = jnp.array([-120.0]), jnp.array([92.0])


@pytest.mark.parametrize(
    ("cells", "error"), [(DRY, 1e-12), pytest.param(FREE, 1e-10, marks=pytest.mark.long)]
)
def test_zeros_and_the_maximum_of_a_cubic(cells, error):
    watch = (
        Crossings(capacity=5), Crossings(0.0, "up", capacity=5),
        Crossings(0.0, "down", component=1, capacity=2),
        Crossings(16.0, "down", of=lambda t, y: t**2 + 0.0 * y[0][0], capacity=2),
    )  # fmt: skip
    run = simulate(cells, START, 3.0, t0=-8.0, rtol=1e-12, observe=watch)
    nan = np.nan
    expected = [-6.0, -2.0, 2.0, nan, nan], [-6.0, 2.0, nan, nan, nan], [-2 - 4 / 3**0.5, nan]
    for (times, *_), zeros in zip(run.observed, (*expected, [-4.0, nan]), strict=True):
        np.testing.assert_allclose(times, zeros, atol=error)
    _, x, v = run.observed[0]
    np.testing.assert_allclose(x[:3, 0], 0.0, atol=100 * error)
    np.testing.assert_allclose(v[:3, 0], [32.0, -16.0, 32.0], atol=100 * error)


def test_two_crossings_within_one_long_step_and_their_slopes():
    """From t = -4 to 3 in steps as long as the tolerance allows: at -2 and 2."""

    @jax.jit
    def found(level):
        start = jnp.array([24.0]), jnp.array([-4.0])
        watch = Crossings(level, capacity=3)
        run = simulate(DRY, start, 3.0, t0=-4.0, max_step=20.0, rtol=1e-10, observe=watch)
        times, _, v = run.observed
        return jnp.append(times[:2], v[:2, 0]), run.steps

    values, steps = found(0.0)
    assert int(steps) <= 4
    np.testing.assert_allclose(values[:2], [-2.0, 2.0], atol=1e-12)
    # dt / dlevel = 1 / x', dv / dlevel = x'' / x'.
    slopes = jax.jacfwd(lambda level: found(level)[0])(0.0)
    np.testing.assert_allclose(slopes, [-1 / 16, 1 / 32, 0.0, 24 / 32], atol=1e-10)


def test_only_those_from_the_start_on_count_and_a_sweep_names_them():
    chain = paper_chain(2, 1.0, None)
    watch = Crossings(0.5, "up", oscillator=1, capacity=2, start=30.0)
    data = sweep(chain, equation_8, 50.0, over={"excited": [2, 0]}, observe=watch)
    assert data.crossing_time.dims == ("excited", "crossing")
    times = data.crossing_time.values[0]
    assert np.all((times >= 30.0) & (times < 50.0))
    np.testing.assert_allclose(data.crossing_displacement.values[0, :, 1], 0.5, atol=1e-9)
