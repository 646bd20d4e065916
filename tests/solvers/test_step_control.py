"""SwitchingController: fewer steps at no greater error, with any solver, and never in the way."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import (
    EventDriven,
    Rodas4,
    equation_8,
    paper_chain,
    simulate,
)
from jaxchain.model.oscillators import AbstractOscillators
from jaxchain.solvers import SwitchingController


def pid(rtol: Any = 1e-6, **kwargs: Any) -> dfx.PIDController:
    return dfx.PIDController(rtol=rtol, atol=0.1 * rtol, **kwargs)


def solve(field, solver, controller, y0, t1, t0=0.0, **kwargs) -> Any:
    terms: Any = dfx.ODETerm(field)
    options = {"max_steps": None, "adjoint": dfx.ForwardMode(), **kwargs}
    return dfx.diffeqsolve(
        terms, solver, t0, t1, None, y0, stepsize_controller=controller, **options
    )


def stiff_run(solver, switching, span=30.0):
    """(state, steps, rejected steps) of the ring of twenty, of belt speeds and a tolerance."""

    def run(belt_speed, rtol):
        chain = paper_chain(20, belt_speed, width=1e-4)
        controller: Any = pid(rtol, dtmax=0.5)
        controller = SwitchingController(controller, chain) if switching else controller
        out = solve(chain, solver, controller, equation_8(chain, 9), span)
        stats = out.stats
        return jnp.stack(out.ys)[:, 0], stats["num_steps"], stats["num_rejected_steps"]

    return jax.jit(jax.vmap(run, in_axes=(0, None)))


SPEEDS = jnp.linspace(1.2, 1.4, 4)


def test_the_error_is_that_of_the_tolerance_however_loose():
    """Also where the tolerance on a velocity is a third of the width; sqrt(20) times for one."""
    plain, switching = (stiff_run(Rodas4(1), control) for control in (False, True))
    exact = plain(SPEEDS, 1e-11)[0]
    for rtol in (1e-4, 1e-5, 1e-6):
        assert np.max(np.abs(switching(SPEEDS, rtol)[0] - exact)) <= 4 * rtol
    assert np.all(np.max(np.abs(plain(SPEEDS, 1e-4)[0] - exact), axis=(1, 2)) > 0.1)
    # Fewer steps, and fewer that are rejected.
    (_, steps, rejected), (_, own_steps, own_rejected) = (
        run(SPEEDS, rtol) for run, rtol in ((plain, 1e-6), (switching, 1e-5))
    )
    assert own_steps.sum() <= 0.85 * steps.sum()
    assert own_rejected.sum() <= 0.7 * rejected.sum()


def next_step(field, w0, w1, *, t=1.0, h=0.1, error=0.0, kept=True, bend=0.0, **constants: Any):
    """The step after one of length h from w0 to w1; PID control alone would take ten times h.

    In between w = w0 + (w1 - w0) s / h + bend s (s - h).
    """
    v0, v1 = (float(field.belt_speed) + np.asarray(w) for w in (w0, w1))
    x0, x1 = np.zeros(2), h * (v0 + v1) / 2 - bend * h**3 / 6
    was_kept, start, end = adapted(
        field, 1, t, t + h, (x0, v0), (x1, v1), (x0, x0 + error), **constants
    )
    assert bool(was_kept) == kept
    return end - start


def adapted(field, direction, t0, t1, y0, y1, errors, **constants: Any):
    """(Whether the step from t0 to t1 is kept, where the next one starts and ends.)"""
    times, one = (np.float64(t0), np.float64(t1)), np.float64(1.0)
    memory = one, one, np.asarray(False)
    found = _adapted(direction, constants, field, *times, y0, y1, errors, memory)
    return [np.asarray(a) for a in found]


@eqx.filter_jit
def _adapted(direction, constants, field, t0, t1, y0, y1, errors, memory):
    controller = SwitchingController(pid(), field, **constants).wrap(direction)
    return controller.adapt_step_size(t0, t1, y0, y1, None, errors, 4.0, memory)[:3]


def test_the_next_step_is_bounded_by_the_first_mass_to_switch():
    chain = paper_chain(2, belt_speed=1.3, width=1e-2)
    # a = 1 and 4: the layer's edge is 0.446 and 0.0615 away.
    assert next_step(chain, [-0.6, -0.7], [-0.5, -0.3]) == pytest.approx((0.3 - 0.054) / 4)
    # Within the layer, at a = 0.5.
    assert next_step(chain, [0.09, 9.0], [0.04, 9.0]) == pytest.approx(0.03 / 0.5)
    own: Any = {"near": 2.0, "landing": 1.0, "crossing": 0.5}
    assert next_step(chain, [0.09, 9.0], [0.04, 9.0], **own) == pytest.approx(0.03 / 0.5)
    assert next_step(chain, [0.06, 9.0], [0.01, 9.0], **own) == pytest.approx(0.005 / 0.5)
    # At a = 20, of a step that is kept and of one that is not: a fifth, of PID control alone.
    assert next_step(chain, [-2.3, 9.0], [-0.3, 9.0]) == pytest.approx((0.3 - 0.054) / 20)
    rejected = next_step(chain, [-2.3, 9.0], [-0.3, 9.0], error=1.0, kept=False)
    assert rejected == pytest.approx(0.02)


def test_all_other_motions_are_left_alone():
    chain = paper_chain(2, belt_speed=0.0, width=1e-2)
    for w0, w1 in (
        ([-0.2, 0.3], [-0.3, 0.4]),  # both move away
        ([0.0, 0.0], [0.0, 0.0]),  # both rest on the belt
        ([-1e-6, 0.0], [-1e-6 - 1e-18, 0.0]),  # creeping under a growing force
        ([-1e-6, -1e-200], [-1e-6 + 1e-18, -1e-250]),  # under a falling one: no bound in reach
        ([-0.3, 0.1], [0.2, -0.3]),  # both have just passed
    ):
        assert next_step(chain, w0, w1) == pytest.approx(1.0)


@pytest.mark.parametrize("bend", [0.4, -2.0])
def test_the_way_to_the_layer_follows_the_curvature_of_the_velocity(bend):
    # w = 0.6 - s + bend s (s - 0.1) after s = 0.1: |w| = 0.054 is a root.
    chain, h = paper_chain(2, belt_speed=1.3, width=1e-2), 0.1
    after = next_step(chain, [0.6, 9.0], [0.5, 9.0], h=h, bend=bend)
    s = h + after
    assert 0.6 - s + bend * s * (s - h) == pytest.approx(0.054)
    assert abs(after - 0.446) > 0.05  # without it


def test_the_error_of_a_mass_counts_more_while_it_leaves_the_belt():
    chain = paper_chain(2, belt_speed=1.3, width=1e-2)
    away, slow = [-0.025, -9.0], [-0.02, -9.0]
    # A change by 0.005 in 0.1, where friction accelerates by 1: its error counts ten times.
    next_step(chain, slow, away, error=1e-6, kept=False)
    next_step(chain, away, slow, error=1e-6)
    next_step(chain, slow, away, error=1e-7)
    next_step(chain.with_(normal_load=0.2), slow, away, error=5e-7)
    next_step(chain, [-0.001, -9.0], [-0.006, -9.0], error=1e-6)  # still held
    next_step(chain, [-0.10, -9.0], [-0.105, -9.0], error=1e-6)  # released
    next_step(chain, [-0.02, -9.0], [-0.07, -9.0], error=1e-6)  # fast


class MovingBelt(AbstractOscillators):
    """Masses on a belt that gains speed."""

    acceleration: jax.Array
    springs: None = None

    def local_force(self, t, x, v):
        return -jnp.tanh((v - self.acceleration * t) / 0.01)

    def stiffness_diagonal(self, n):
        return jnp.ones(())

    def switching(self, t, v):
        return v - self.acceleration * t, jnp.asarray(0.01)


@pytest.mark.parametrize("direction", [1, -1])
def test_a_surface_that_moves_is_met_where_it_will_be(direction):
    # The masses keep their velocity; the belt, gaining speed 0.5 in a time unit, comes to meet
    # them, and backward in time leaves them.
    y = np.zeros(2), np.full(2, direction * 0.8)  # w = 0.3 direction at t0
    errors = (np.zeros(2),) * 2
    _, begin, end = adapted(
        MovingBelt(acceleration=jnp.asarray(0.5)), direction, 1.0, 1.1, y, y, errors
    )
    # In either direction |w| shrinks at 0.5 from 0.25 after the step.
    assert end - begin == pytest.approx((0.25 - 0.054) / 0.5)


def test_a_sticking_mass_does_not_stall_the_run():
    # It starts exactly at the belt's speed, sticks until its spring pulls it off, and comes back.
    chain = paper_chain(1, 1.3, 1e-8)
    y0 = jnp.array([-0.9]), jnp.array([1.3])
    plain, own = (
        solve(chain, Rodas4(), controller, y0, 30.0, max_steps=100_000)
        for controller in (pid(dtmax=0.5), SwitchingController(pid(dtmax=0.5), chain))
    )
    assert int(own.stats["num_steps"]) <= 2.2 * int(plain.stats["num_steps"])
    # Without the control the error is 1.3.
    dry = simulate(chain, y0, 30.0, solver=EventDriven(order=6), rtol=1e-9)
    np.testing.assert_allclose(np.stack(own.ys)[:, 0], np.stack(dry.state), atol=5e-4)
