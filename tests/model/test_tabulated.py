from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator

from jaxchain.cycles.averaging import one_mass
from jaxchain.model.chain import Chain
from jaxchain.model.friction import AbstractFrictionLaw, TanhFriction
from jaxchain.model.tabulated import TabulatedFriction
from jaxchain.model.units import Scales
from jaxchain.observers.samples import Trajectory
from jaxchain.simulation import Method, simulate
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.sweeps.ensemble import describe
from jaxchain.sweeps.sweeping import sweep

SPEED = [0.0, 0.2, 0.5, 0.8, 1.2, 2.0]
MU = [1.0, 0.8, 0.75, 0.6, 0.52, 0.5]


def law():
    return TabulatedFriction(SPEED, MU)


def chain(n=1, friction=None, **more):
    friction = friction or law()
    return Chain(n, TanhFriction(friction, 1e-3), belt_speed=1.0, damping_ratio=0.02, **more)


def test_the_curve_is_the_shape_preserving_one():
    speeds = np.linspace(0.0, 2.0, 101)
    np.testing.assert_allclose(
        law().coefficient(speeds), PchipInterpolator(SPEED, MU)(speeds), rtol=1e-14
    )
    np.testing.assert_allclose(law().coefficient(np.array(SPEED)), MU, rtol=1e-15)


def test_its_slope_does_not_jump_before_the_last_speed_and_is_0_beyond():
    slope = jax.vmap(jax.grad(law().coefficient))
    knots = np.array(SPEED[1:-1])
    np.testing.assert_allclose(slope(knots - 1e-9), slope(knots + 1e-9), atol=1e-7)
    np.testing.assert_array_equal(slope(np.array([2.0, 3.0, 50.0])), 0.0)
    assert law().coefficient(50.0) == 0.5


def test_friction_at_rest_is_the_first_value():
    assert law().mu_static == 1.0
    assert law().coefficient(0.0) == 1.0


def test_speeds_of_any_shape():
    speeds = np.linspace(0.0, 2.5, 12).reshape(3, 4)
    flat = law().coefficient(speeds.ravel())
    np.testing.assert_array_equal(law().coefficient(speeds), flat.reshape(3, 4))


def test_it_is_read_from_a_file(tmp_path):
    file = tmp_path / "mu.csv"
    np.savetxt(file, np.transpose([SPEED, MU]), delimiter=",", header="speed,mu", comments="")
    np.testing.assert_array_equal(TabulatedFriction.from_csv(file).pieces, law().pieces)


def test_a_file_of_a_rig_has_speeds_in_m_per_s_and_may_lack_friction_at_rest(tmp_path):
    file = tmp_path / "mu.csv"
    rig = Scales.from_dimensional(2.0, 2.0, 200.0, None, 10.0)  # the unit of speed is 0.5 m/s
    file.write_text("0.25, 0.7\n0.5, 0.6\n")
    law = TabulatedFriction.from_csv(file, scales=rig, mu_static=1.0)
    np.testing.assert_allclose(law.table, [[0.0, 0.5, 1.0], [1.0, 0.7, 0.6]], rtol=1e-15)
    with pytest.raises(ValueError, match=r"first speed is 0\.25: give .* as `mu_static`\.$"):
        TabulatedFriction.from_csv(file)
    file.write_text("0, 0.9\n0.25, 0.7\n")
    assert TabulatedFriction.from_csv(file, mu_static=0.9).mu_static == 0.9
    with pytest.raises(ValueError, match=r"`mu_static` is 1\.0, but .* has the friction 0\.9 at"):
        TabulatedFriction.from_csv(file, mu_static=1.0)


def test_an_invalid_table_is_refused():
    with pytest.raises(ValueError, match="`speed` and `mu` are no friction law: the first speed"):
        TabulatedFriction([0.1, 1.0], [1.0, 0.5])
    with pytest.raises(ValueError, match="cannot be traced: make the law before"):
        jax.jit(lambda mu: TabulatedFriction([0.0, 1.0], mu).pieces)(jnp.array([1.0, 0.5]))


def test_a_chain_keeps_its_table_through_changes_and_gives_it_to_every_mass():
    ring = chain(5, coupling=0.01, stiffness=np.linspace(1.0, 1.4, 5)).with_(width=1e-4)
    for kept in (ring, one_mass(ring, 3)):
        own: Any = kept.law
        np.testing.assert_array_equal(own.pieces, law().pieces)
    assert "pieces" not in ring.parameters()
    with pytest.raises(ValueError, match="does not know"):
        ring.with_(pieces=1.0)


def test_a_dataset_says_from_which_table_it_comes():
    plan = Method(EventDriven(), 1e-6, 1e-7, 0.5).plan([], 1.0)
    attrs = describe(chain(), 1, plan, t0=0.0, t1=1.0, swept=["belt_speed"])
    assert str(SPEED) in attrs["parameters"]
    assert str(MU) in attrs["parameters"]


@pytest.mark.long
def test_a_sweep_says_from_which_table_it_comes():
    data = sweep(chain(), (jnp.array([0.5]), jnp.zeros(1)), 0.5, over={"belt_speed": [1.0, 1.2]})
    assert str(SPEED) in data.attrs["parameters"]
    assert str(MU) in data.attrs["parameters"]


# From beyond the last speed of the table to just before the mass would stick.
START, END = (0.55, -1.2), 2.2


def initial():
    return tuple(jnp.array([value]) for value in START)


def slid(start, t1, kinks):
    """One mass that slides behind the belt, by a fine solver that stops where it passes a kink."""
    curve = PchipInterpolator(SPEED, MU)

    def motion(t, y):
        return [y[1], -y[0] - 0.04 * y[1] + curve(min(1.0 - y[1], SPEED[-1]))]

    def passes(speed):
        def event(t, y):
            return 1.0 - y[1] - speed

        event.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
        return event

    t, y, count = 0.0, np.array(start), 0
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    while t < t1:
        step = solve_ivp(motion, (t, min(t + 1e-6, t1)), y, **options)  # off the kink
        t, y = step.t[-1], step.y[:, -1]
        step = solve_ivp(
            motion, (t, t1), y, events=[passes(speed) for speed in kinks], max_step=0.1, **options
        )
        t, y, count = step.t[-1], step.y[:, -1], count + (step.status == 1)
        assert 1.0 - y[1] > 0
    return y, count


def test_an_event_driven_step_ends_where_the_pieces_of_the_curve_meet():
    expected, kinks = slid(START, END, SPEED[1:])
    assert kinks == 4
    own = chain()
    for rtol, bound in ((1e-6, 1e-5), (1e-12, 1e-10)):
        end = simulate(own, initial(), END, solver=EventDriven(), rtol=rtol, atol=0.1 * rtol).state
        np.testing.assert_allclose(np.ravel(end), expected, atol=bound)


def test_without_its_knots_it_costs_steps_not_truth():
    """A law that says that its pieces meet nowhere: the error of each step finds where they do."""

    class Unsaid(AbstractFrictionLaw):
        mu_static: Any

        @property
        def knots(self):
            return ()

        def coefficient(self, speed: Any) -> Any:
            return law().coefficient(speed)

    expected, _ = slid(START, END, SPEED[1:])
    own = chain(friction=Unsaid(MU[0]))
    run = simulate(own, initial(), END, solver=EventDriven(), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(np.ravel(run.state), expected, atol=1e-5)
    assert run.rejected > 5


@pytest.mark.long
def test_dry_and_smoothed_agree_to_their_width():
    own = chain().with_(width=1e-5)
    times = jnp.linspace(0.0, 30.0, 31)
    options = {"observe": Trajectory(times), "rtol": 1e-9}
    dry = simulate(own, initial(), 30.0, solver=EventDriven(), **options).observed
    smoothed = simulate(own, initial(), 30.0, **options).observed
    np.testing.assert_allclose(dry, smoothed, atol=1e-3)


@pytest.mark.long
def test_derivatives_pass_through_the_knots():
    def end(stretch):
        x, v = initial()
        options = {"solver": EventDriven(), "rtol": 1e-12, "atol": 1e-13}
        return simulate(chain(), (x * stretch, v), END, **options).state[0][0]

    _, slope = jax.jvp(end, (1.0,), (1.0,))
    h = 1e-5
    np.testing.assert_allclose(slope, (end(1.0 + h) - end(1.0 - h)) / (2 * h), rtol=1e-6)
