from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxchain import Rodas5P, paper_chain
from jaxchain.cycles.shooting import Shooting


def shooting(n=3, mass=1, images=None, parameter="belt_speed", width=0.05):
    images = tuple(range(n)) if images is None else images
    return Shooting(
        field=paper_chain(n, width=width), rtol=1e-9, solver=Rodas5P(), mass=mass,
        images=images, parameter=parameter,
    )  # fmt: skip


def test_unpack_undoes_pack_on_the_section_where_the_mass_has_its_greatest_velocity():
    problem = shooting()

    @jax.jit
    def there_and_back(u, speed):
        field, state, period = problem.unpack(u, speed)
        return state, period, field(0.0, state)[1], problem.pack(state, period, speed)

    u = np.array([0.4, 0.5, 1.3, -1.2, 1.1, np.log(6.2)])
    state, period, acceleration, again = there_and_back(u, 1.4)
    np.testing.assert_allclose(again, u, rtol=1e-12)
    assert abs(float(acceleration[1])) < 1e-14
    np.testing.assert_allclose(period, 6.2, rtol=1e-14)
    np.testing.assert_allclose(state[1][1], 1.4 + 0.05 * np.sinh(-1.2), rtol=1e-14)


@pytest.mark.parametrize("parameter", ["belt_speed", "period"])
def test_an_orbit_that_goes_round_three_times_begins_again_with_a_third(parameter):
    """Of a family the period is the parameter as well."""
    problem = shooting(parameter=parameter)
    u = np.array([0.4, 0.5, 1.3, -1.2, 1.1, np.log(18.6)])
    p = 18.6 if parameter == "period" else 1.4
    assert problem.with_least_period(u, p, SimpleNamespace(times_round=1)) is None
    start = problem.with_least_period(u, p, SimpleNamespace(times_round=3))
    assert start is not None
    np.testing.assert_allclose(start.u, [*u[:-1], np.log(6.2)], rtol=1e-14)
    assert start.p == pytest.approx(6.2 if parameter == "period" else 1.4)
