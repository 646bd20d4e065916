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


def test_a_method_is_its_fields():
    chain, watch = paper_chain(1, width=1e-2), Amplitude(10.0)
    given = simulate(
        chain, START, 20.0, observe=watch, method=Method(Rodas5P(), 1e-8, max_step=0.1)
    )
    alone = simulate(chain, START, 20.0, observe=watch, solver=Rodas5P(), rtol=1e-8, max_step=0.1)
    assert eqx.tree_equal(given.state, alone.state)
    assert int(given.steps) == int(alone.steps) >= 200
    swept = sweep(
        chain, START, 20.0, over={"belt_speed": [1.5]}, observe=watch, lanes=1,
        method=Method(Rodas5P(), 1e-8, max_step=0.1),
    )  # fmt: skip
    assert int(swept.steps[0]) == int(given.steps)
    with pytest.raises(ValueError, match="`method` and `rtol` are both given"):
        simulate(chain, START, 1.0, method=Method(), rtol=1e-6)
    with pytest.raises(ValueError, match="Argument `method` must be None or a `Method`"):
        Method.of(dfx.Tsit5())


@pytest.mark.parametrize(("unit", "time"), [(1e-3, 1e-2), (50.0, 1.0), (1.0, 30.0)])
def test_accuracy_picks_the_same_width_in_other_units(unit, time):
    chosen = choose_numerics(paper_chain(1, 1.3), 1e-2)
    other = choose_numerics(the_same_mass(1e-3, unit, time), 1e-2)
    np.testing.assert_allclose(other.width, unit * chosen.width, rtol=1e-12)
    np.testing.assert_allclose(other.rtol, chosen.rtol, rtol=1e-12)


def test_the_promise_of_accuracy_is_kept_by_cells():
    cells, accuracy = the_same_mass(1e-3), 1e-3
    times = 30.0
    exact = simulate(the_same_mass(None), START, times, observe=Amplitude(7.0), rtol=1e-10)
    run = simulate(cells, START, times, observe=Amplitude(7.0), accuracy=accuracy)
    error = abs(run.observed - exact.observed) / exact.observed
    assert 1e-3 * accuracy < error[0] < accuracy
    data = sweep(
        cells, START, times, over={"belt_speed": [1.3, 1.4]}, observe=Amplitude(7.0),
        accuracy=accuracy,
    )  # fmt: skip
    np.testing.assert_allclose(data.amplitude[0], run.observed, rtol=1e-4)
    with pytest.raises(ValueError, match="`accuracy` picks the width of smoothed friction"):
        simulate(MechanicalCells(1.0), START, 1.0, accuracy=accuracy)


def test_a_method_passes_through_transformations():
    chain = paper_chain(1, width=1e-2)

    def amplitude(rtol):
        how = Method(Rodas5P(), rtol)
        return simulate(chain, START, 10.0, observe=Amplitude(), method=how).observed[0]

    rtols = jnp.array([1e-6, 1e-8])
    side_by_side = jax.jit(jax.vmap(amplitude))(rtols)
    np.testing.assert_allclose(side_by_side, [amplitude(r) for r in rtols], rtol=1e-9)
