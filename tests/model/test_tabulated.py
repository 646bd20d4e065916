from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from witnesses import one_mass

from jaxchain.cycles.averaging import one_mass as one_of
from jaxchain.model.chain import Chain
from jaxchain.model.friction import TanhFriction
from jaxchain.model.tabulated import TabulatedFriction
from jaxchain.model.units import Scales
from jaxchain.simulation import simulate
from jaxchain.simulation.event_driven import EventDriven

SPEED = [0.0, 0.2, 0.5, 0.8, 1.2, 2.0]
MU = [1.0, 0.8, 0.75, 0.6, 0.52, 0.5]


def law():
    return TabulatedFriction(SPEED, MU)


def chain(n=1, friction=None, **more):
    friction = friction or law()
    return Chain(n, TanhFriction(friction, 1e-3), belt_speed=1.0, damping_ratio=0.02, **more)


def test_the_curve_is_the_shape_preserving_one():
    speeds = np.linspace(0.0, 2.0, 104)
    curve = jax.jit(lambda speed: law().coefficient(speed))
    found = curve(speeds)
    np.testing.assert_allclose(found, PchipInterpolator(SPEED, MU)(speeds), rtol=1e-14)
    np.testing.assert_array_equal(curve(speeds.reshape(8, 13)), found.reshape(8, 13))
    np.testing.assert_allclose(curve(np.array(SPEED)), MU, rtol=1e-15)
    assert law().mu_static == curve(0.0) == 1.0
    # Its slope does not jump before the last speed, and is 0 beyond.
    slope = jax.jit(jax.vmap(jax.grad(law().coefficient)))
    knots = np.array(SPEED[1:-1])
    np.testing.assert_allclose(slope(knots - 1e-9), slope(knots + 1e-9), atol=1e-7)
    np.testing.assert_array_equal(slope(np.array([2.0, 3.0, 50.0, 60.0])), 0.0)
    assert curve(50.0) == 0.5


def test_a_file_of_a_rig_has_speeds_in_m_per_s_and_may_lack_friction_at_rest(tmp_path):
    file = tmp_path / "mu.csv"
    rig = Scales.from_dimensional(2.0, 2.0, 200.0, None, 10.0)  # the unit of speed is 0.5 m/s
    file.write_text("0.25, 0.7\n0.5, 0.6\n")
    law = TabulatedFriction.from_csv(file, scales=rig, mu_static=1.0)
    np.testing.assert_allclose(law.table, [[0.0, 0.5, 1.0], [1.0, 0.7, 0.6]], rtol=1e-15)
    with pytest.raises(ValueError, match=r"first speed is 0\.25: give .* as `mu_static`\.$"):
        TabulatedFriction.from_csv(file)
    file.write_text("0, 0.9\n0.25, 0.7\n")
    with pytest.raises(ValueError, match=r"`mu_static` is 1\.0, but .* has the friction 0\.9 at"):
        TabulatedFriction.from_csv(file, mu_static=1.0)


def test_a_chain_keeps_its_table_through_changes_and_gives_it_to_every_mass():
    ring = chain(5, coupling=0.01, stiffness=np.linspace(1.0, 1.4, 5)).with_(width=1e-4)
    for kept in (ring, one_of(ring, 3)):
        own: Any = kept.law
        np.testing.assert_array_equal(own.pieces, law().pieces)
    assert "pieces" not in ring.parameters()


# From beyond the last speed of the table to just before the mass would stick.
START, END = (0.55, -1.2), 2.2


def initial():
    return tuple(jnp.array([value]) for value in START)


def slid():
    """(x, v) at the end of one mass that slides behind the belt, in whose frame x = X + t."""
    curve = PchipInterpolator(SPEED, MU)
    ((piece, sign),) = one_mass.integrate(
        lambda t, x, w: -(x + t) - 0.04 * (w + 1.0), lambda s: curve(min(s, SPEED[-1])), 1.0,
        (START[0], START[1] - 1.0), END,
    )  # fmt: skip
    assert sign == -1.0
    assert np.min(-piece.y[1]) < SPEED[2] < SPEED[-1] < np.max(-piece.y[1])  # passes the kinks
    return piece.y[0, -1] + END, piece.y[1, -1] + 1.0


def test_an_event_driven_step_ends_where_the_pieces_of_the_curve_meet():
    expected = slid()

    @jax.jit
    def end(stretch, rtol):
        def state(stretch):
            x, v = initial()
            options = {"solver": EventDriven(8), "rtol": rtol, "atol": 0.1 * rtol}
            return jnp.concatenate(simulate(chain(), (x * stretch, v), END, **options).state)

        return jax.jvp(state, (stretch,), (1.0,))

    for rtol, bound in ((1e-6, 1e-5), (1e-12, 1e-10)):
        np.testing.assert_allclose(end(1.0, rtol)[0], expected, atol=bound)
    difference = (end(1.0 + 1e-5, 1e-12)[0] - end(1.0 - 1e-5, 1e-12)[0]) / 2e-5
    np.testing.assert_allclose(end(1.0, 1e-12)[1], difference, rtol=1e-6)
