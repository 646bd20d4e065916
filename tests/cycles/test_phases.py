"""Cycles of dry friction as sequences of phases."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.orbits import closed_orbit

from jaxchain import Coulomb
from jaxchain.cycles.phases import OTHER_EVENTS, peak, turning_point
from jaxchain.cycles.reading_phases import phases_from, phases_of, slip_phases
from jaxchain.kinds.event import Event
from jaxchain.kinds.fold import Fold
from jaxchain.kinds.multipliers import PeriodDoubling, Torus
from jaxchain.model import MechanicalCells


def test_the_peak_of_a_cubic():
    rng = np.random.default_rng(3)
    v0, v1, a, b = rng.normal(size=(4, 200))
    a[:3], b[:3] = [0.0, 1.0, -1.0], [0.0, 1.0, -1.0]
    v1[1:3] = v0[1:3] + a[1:3]  # straight lines
    t = np.linspace(0, 1, 2001)[:, None]
    # Hermite's polynomials.
    rise, start, end = t * t * (3 - 2 * t), t * (1 - t) ** 2, t * t * (t - 1)
    dense = np.max(v0 * (1 - rise) + v1 * rise + a * start + b * end, axis=0)
    top = jax.jit(peak)(v0, v1, a, b)
    np.testing.assert_allclose(top, dense, atol=2e-6)


def test_the_events_of_a_cycle_and_their_other_order(chains, dry_cycle):
    chain, cycle = chains[1, None], dry_cycle
    phases: Any
    phases, u = phases_of(chain, cycle.state, cycle.period, "stick onset", 0)
    # A mass that sticks forgets exactly where it came from.
    assert complex(cycle.multipliers[0]) == 0
    assert phases.sequence == [("landing", 0, -1.0), ("release", 0, -1.0)]
    assert np.asarray(phases.modes).tolist() == [[-1], [0]]
    assert jnp.sum(u[-2:]) == pytest.approx(float(cycle.period), rel=1e-12)
    assert phases.swapped(1) is None  # both are events of one mass
    landing, release = phases.sequence
    events, modes = [landing, ("peak", 1, 0.0), release], [[-1, -1], [0, -1], [0, -1]]
    two: Any = phases_from(chain, modes, events, (0, "stick onset", -1), 2, [1, 1, 1], [0, 0, 0])
    other = two.swapped(1)
    assert other.sequence[:2] == [("peak", 1, 0.0), ("landing", 0, -1.0)]
    assert other.modes.tolist() == [[-1, -1], [-1, -1], [0, -1]]
    assert np.asarray(other.special).tolist() == [1, *np.asarray(two.special).tolist()[1:]]
    assert eqx.tree_equal(other.swapped(1), two)


def test_every_curve_of_dry_cycles_ends_where_its_sequence_changes():
    cells = MechanicalCells(1.0, damping=0.1, friction=Coulomb(1.0), belt_speed=0.5)
    orbit, _ = slip_phases(cells, tuple(jnp.zeros((2, 1))), 6.0, 0, False)
    for kind in (Fold(), PeriodDoubling(), Torus(), Event("one", abs)):
        assert {*OTHER_EVENTS} <= {*kind.curve_tests(orbit)}, kind
        assert {*OTHER_EVENTS} <= {*kind.curve_ends(orbit)}, kind


def test_the_turning_point_of_a_polynomial_of_degree_5_is_its_extreme():
    h, polynomial = 0.7, np.polynomial.Polynomial([0.3, 1.0, -0.4, -1.1, 0.6, -0.5])
    ends = [polynomial.deriv(k)(t) if k else polynomial(t) for t in (0.0, h) for k in range(3)]
    found = jax.jit(turning_point)(*(np.array([part]) for part in (*ends, h)))
    (turn,) = (r.real for r in polynomial.deriv().roots() if abs(r.imag) < 1e-9 and 0 < r.real < h)
    assert float(found[0]) == pytest.approx(polynomial(turn), abs=1e-12)


def test_a_cycle_that_a_verdict_closes_has_multipliers_of_exactly_zero(dry_cycle):
    orbit = closed_orbit(dry_cycle.chain, dry_cycle.state, dry_cycle.period)
    np.testing.assert_array_equal(orbit.multipliers, [0.0])
