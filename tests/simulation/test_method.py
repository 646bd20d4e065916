"""`Method`: the rules of solvers, tolerances and steps, for every model."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import (
    Amplitude,
    EventDriven,
    ExponentialDecay,
    Method,
    Rodas5P,
    TanhFriction,
    paper_chain,
    simulate,
    sweep,
)
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
    for model in (chain, cells):
        with pytest.raises(ValueError, match="too loose for a regularization width of 1e-06"):
            simulate(model, START, 1.0, rtol=1e-5)
        with pytest.raises(ValueError, match="too loose"):
            sweep(model, START, 1.0, over={"width": [1e-2, 1e-6]}, rtol=1e-5)
    assert isinstance(Method().suited(the_same_mass(None), 1).solver, EventDriven)


@pytest.mark.long
def test_a_method_is_its_fields_also_where_they_are_traced():
    chain, watch = paper_chain(1, width=1e-2), Amplitude(10.0)

    def run(rtol):
        how = Method(Rodas5P(), rtol, max_step=0.1)
        return simulate(chain, START, 20.0, observe=watch, method=how)

    given = run(1e-8)
    alone = simulate(chain, START, 20.0, observe=watch, solver=Rodas5P(), rtol=1e-8, max_step=0.1)
    assert eqx.tree_equal(given.state, alone.state)
    assert int(given.steps) == int(alone.steps) >= 200
    rtols = jnp.array([1e-6, 1e-8])
    side_by_side = jax.jit(jax.vmap(lambda rtol: run(rtol).observed))(rtols)
    np.testing.assert_allclose(side_by_side, [run(r).observed for r in rtols], rtol=1e-9)
    swept = sweep(
        chain, START, 20.0, over={"belt_speed": [1.5]}, observe=watch, lanes=1,
        method=Method(Rodas5P(), 1e-8, max_step=0.1),
    )  # fmt: skip
    assert int(swept.steps[0]) == int(given.steps)
    with pytest.raises(ValueError, match="`method` and `rtol` are both given"):
        simulate(chain, START, 1.0, method=Method(), rtol=1e-6)
    with pytest.raises(ValueError, match="Argument `method` must be None or a `Method`"):
        Method.of(dfx.Tsit5())


def test_accuracy_picks_the_same_width_in_other_units():
    chosen = choose_numerics(paper_chain(1, 1.3), 1e-2)
    for unit, time in ((1e-3, 1e-2), (50.0, 1.0), (1.0, 30.0)):
        other = choose_numerics(the_same_mass(1e-3, unit, time), 1e-2)
        np.testing.assert_allclose(other.width, unit * chosen.width, rtol=1e-12)
        np.testing.assert_allclose(other.rtol, chosen.rtol, rtol=1e-12)


@pytest.mark.long
def test_the_promise_of_accuracy_is_kept_by_a_sweep_of_cells():
    cells, accuracy, speeds = the_same_mass(1e-3), 1e-3, (1.3, 1.4)
    data = sweep(
        cells, START, 30.0, over={"belt_speed": list(speeds)}, observe=Amplitude(7.0),
        accuracy=accuracy,
    )  # fmt: skip
    for speed, found in zip(speeds, data.amplitude, strict=True):
        exact = simulate(
            the_same_mass(None).with_(belt_speed=speed), START, 30.0, observe=Amplitude(7.0),
            solver=EventDriven(6), rtol=1e-10,
        ).observed  # fmt: skip
        error = abs(found - exact) / exact
        assert 1e-3 * accuracy < error[0] < accuracy, speed
    with pytest.raises(ValueError, match="`accuracy` picks the width of smoothed friction"):
        simulate(MechanicalCells(1.0), START, 1.0, accuracy=accuracy)
