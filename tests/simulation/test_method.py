"""`Method`: the rules of solvers, tolerances and steps, for every model."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import EventDriven, ExponentialDecay, Method, TanhFriction, paper_chain, simulate
from jaxchain.model import MechanicalCells
from jaxchain.simulation import choose_numerics

LAW = ExponentialDecay(1.0, 0.5, 0.5)
START = jnp.array([1.8]), jnp.array([0.1])


def the_same_mass(width, unit=1.0, time=1.0):
    """The paper's mass as cells, with velocities in other units and times in another one."""
    friction = LAW.with_(v_ref=0.5 * unit)
    friction = friction if width is None else TanhFriction(friction, width * unit)
    load = unit / time  # x0 omega_n = P / sqrt(k m) with m = 1 and k = 1 / time^2
    return MechanicalCells(
        time**-2, damping=0.1 / time, friction=friction, belt_speed=1.3 * unit, normal_load=load
    )


def test_a_chain_and_the_same_mass_as_cells_are_run_alike():
    chain, cells = paper_chain(1, 1.3, 1e-6), the_same_mass(1e-6)
    one, other = (Method().suited(model, 1, START) for model in (chain, cells))
    assert one.rtol == other.rtol == pytest.approx(1e-6 / 3 / 1.4)
    assert type(one.solver) is type(other.solver)
    with pytest.raises(ValueError, match="too loose for a regularization width of 1e-06"):
        simulate(cells, START, 1.0, rtol=1e-5)
    assert isinstance(Method().suited(the_same_mass(None), 1).solver, EventDriven)
    with pytest.raises(ValueError, match="`method` and `rtol` are both given"):
        simulate(chain, START, 1.0, method=Method(), rtol=1e-6)


def test_accuracy_picks_the_same_width_in_other_units():
    chosen = choose_numerics(paper_chain(1, 1.3), 1e-2)
    for unit, time in ((1e-3, 1e-2), (50.0, 1.0), (1.0, 30.0)):
        other = choose_numerics(the_same_mass(1e-3, unit, time), 1e-2)
        np.testing.assert_allclose(other.width, unit * chosen.width, rtol=1e-12)
        np.testing.assert_allclose(other.rtol, chosen.rtol, rtol=1e-12)
