"""Level crossings: polynomials, whose zeros are known, and their slopes."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import Coulomb, EventDriven, paper_chain, simulate
from jaxchain.model import MechanicalCells
from jaxchain.observers import Crossings

# x'' = 6 t + 12, so that x = (t + 6) (t + 2) (t - 2) from x(-8) on; with no friction at its
# contact, it is integrated by events, in steps as long as the tolerance allows.
DRY = MechanicalCells(
    0.0, friction=Coulomb(0.0), normal_load=0.0, force=lambda t: 6.0 * t + 12.0
)  # fmt: skip


@jax.jit
def seen(level, start, t0):
    """(all that is observed until t = 3, its derivatives by the level, the number of steps)."""

    def observed(level):
        watch = (
            Crossings(level, capacity=5),
            # The speed of the belt, at which steps end: a step may begin and end on it.
            Crossings(0.0, component=1, capacity=3),
            Crossings(0.0, "down", of=lambda t, y: t * y[0][0], capacity=2, start=-3.0),
        )
        how = {"solver": EventDriven(5), "rtol": 1e-12, "max_step": 20.0}
        run = simulate(DRY, start, 3.0, t0=t0, observe=watch, **how)
        return run.observed, run.steps

    return jax.jvp(observed, (level,), (1.0,), has_aux=True)


def test_zeros_and_the_maximum_of_a_cubic_and_their_slopes():
    start = jnp.array([-120.0]), jnp.array([92.0])
    values, slopes, _ = seen(0.0, start, -8.0)
    nan, r = np.nan, (16 / 3) ** 0.5
    expected = [-6.0, -2.0, 2.0, nan, nan], [-2 - r, -2 + r, nan], [0.0, nan]
    for (times, *_), zeros in zip(values, expected, strict=True):
        np.testing.assert_allclose(times, zeros, atol=1e-12)
    _, x, v = values[0]
    np.testing.assert_allclose(x[:3, 0], 0.0, atol=1e-10)
    np.testing.assert_allclose(v[:3, 0], [32.0, -16.0, 32.0], atol=1e-10)
    # dt / dlevel = 1 / x', dv / dlevel = x'' / x'.
    np.testing.assert_allclose(slopes[0][0][:3], [1 / 32, -1 / 16, 1 / 32], atol=1e-10)
    np.testing.assert_allclose(slopes[0][2][:3, 0], [-24 / 32, 0.0, 24 / 32], atol=1e-10)
    # Two crossings within one step: from t = -4 on there are four at most.
    values, _, steps = seen(0.0, (jnp.array([24.0]), jnp.array([-4.0])), -4.0)
    assert int(steps) <= 4
    np.testing.assert_allclose(values[0][0][:2], [-2.0, 2.0], atol=1e-12)
    named = Crossings(capacity=2).label(values[1], paper_chain(1))
    dimensions = {name: variable.dims for name, variable in named.items()}
    assert dimensions["crossing_time"] == ("crossing",)
    assert dimensions["crossing_velocity"] == ("crossing", "oscillator")
