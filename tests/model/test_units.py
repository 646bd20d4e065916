from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Chain, ExponentialDecay, TanhFriction
from jaxchain.model import AbstractFrictionLaw, TabulatedFriction
from jaxchain.model.units import Quantity, Scales

# mass [kg], damping [N s/m], stiffness [N/m], coupling stiffness [N/m], normal load [N]: a brake
# pad segment, and a microscope cantilever.
BODIES = [(0.12, 3.0, 4.0e6, 5.0e4, 300.0), (1.0e-11, 1.0e-9, 0.2, 1.0e-4, 1.0e-8)]
QUANTITIES = get_args(Quantity)


def test_every_quantity_is_counted_in_its_unit():
    units: dict[Any, float] = {
        "displacement": 0.05, "velocity": 0.5, "time": 0.1, "force": 10.0, "frequency": 10.0,
    }  # fmt: skip
    assert set(QUANTITIES) == set(units)
    scales = Scales.from_dimensional(2.0, 2.0, 200.0, 2.0, 10.0)
    for quantity, unit in units.items():
        np.testing.assert_allclose(scales.to_dimensional(3.0, quantity), 3.0 * unit, rtol=1e-15)
        np.testing.assert_allclose(scales.to_dimensionless(3.0, quantity), 3.0 / unit, rtol=1e-15)


@pytest.mark.parametrize("body", BODIES)
def test_a_body_in_si_units_and_back(body):
    # eq. (3) and (5) for one mass between two others at rest, with F = mu P.
    m, c, k, k_c, load = body
    scales = Scales.from_dimensional(*body)
    assert scales.coupling is not None
    x, v, mu = 0.7, -0.4, 0.6
    acceleration = mu - 2.0 * scales.damping_ratio * v - x - scales.coupling * 2.0 * x
    x_si = scales.to_dimensional(x, "displacement")
    v_si = scales.to_dimensional(v, "velocity")
    acceleration_si = (mu * load - c * v_si - k * x_si - k_c * 2.0 * x_si) / m
    per_time = scales.unit("velocity") / scales.unit("time")
    np.testing.assert_allclose(acceleration_si / per_time, acceleration, rtol=1e-12)
    parameters = scales.parameters()
    for name, returned, given in zip(parameters._fields, parameters, body, strict=True):
        assert returned is not None
        np.testing.assert_allclose(returned, given, rtol=1e-14, err_msg=name)


def test_a_rig_in_si_units_is_a_chain_in_one_call():
    law = ExponentialDecay(1.0, 0.5, v_ref=0.25)
    table = TabulatedFriction([0.0, 0.25, 0.5], [1.0, 0.7, 0.6])
    rig: dict[str, Any] = {"mass": 2.0, "damping": 2.0, "stiffness": 200.0, "normal_load": 10.0}
    chain, _ = Chain.from_si(
        3, TanhFriction(law, 0.005), 0.75, coupling_stiffness=2.0, ends="free", **rig
    )
    expected = Chain(
        3, TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 0.01), 1.5, 0.05, 0.01, ends="free"
    )
    assert jax.tree.structure(chain) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(chain), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)
    own: Any = Chain.from_si(1, table, 0.75, **rig)[0].law
    np.testing.assert_allclose(own.table, [[0.0, 0.5, 1.0], [1.0, 0.7, 0.6]])
    with pytest.raises(ValueError, match=r"`friction` is a `Own`, .* convert them by `Scales"):
        Chain.from_si(1, Own(jnp.asarray(1.0)), 0.75, **rig)


class Own(AbstractFrictionLaw):
    mu_static: jax.Array

    def coefficient(self, speed):
        return self.mu_static + 0.0 * speed
