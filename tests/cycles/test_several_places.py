"""Branches of cycles with impacts, and with several contacts: closed form, and searches."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root

from jaxchain import continue_cycle, find_limit_cycle, simulate
from jaxchain.model import Contact, MechanicalCells, StaticKinetic, Stop

XI, OMEGA, GAP, RESTITUTION = 0.05, 0.8, 0.5, 0.7
PERIOD, OMEGA_D = 2 * np.pi / OMEGA, np.sqrt(1 - XI**2)
# The cells move by nanometres, at some kilohertz; the closed form is in these units.
LENGTH, TIME = 1e-9, 1e-4
SIZES, FORCE = np.array([LENGTH, LENGTH / TIME]), LENGTH / TIME**2
HITS = MechanicalCells(
    TIME**-2, damping=2 * XI / TIME, force=0.81 * FORCE, frequency=OMEGA / TIME,
    stops=[Stop(1.0, GAP * LENGTH, RESTITUTION)],
)  # fmt: skip


def flown(force, t0, x, v, time):
    """The state a time after (t0, x, v) in free flight."""
    response = force / (1 - OMEGA**2 + 2j * XI * OMEGA)

    def forced(t):
        wave = response * np.exp(1j * OMEGA * t)
        return wave.real, (1j * OMEGA * wave).real

    (p, q), (after, rate) = forced(t0), forced(t0 + time)
    x, v = x - p, v - q
    c, s = np.cos(OMEGA_D * time), np.sin(OMEGA_D * time)
    x, v = x * c + (v + XI * x) / OMEGA_D * s, v * c - (x + XI * v) / OMEGA_D * s
    return np.exp(-XI * time) * np.array([x, v]) + [after, rate]


def one_impact(force, guess):
    """(time, velocity) of the impact of an orbit with one in a period."""

    def gap(u):
        return flown(force, u[0], GAP, -RESTITUTION * u[1], PERIOD) - [GAP, u[1]]

    return root(gap, guess, tol=1e-14).x


@pytest.mark.parametrize("direction", [1, pytest.param(-1, marks=pytest.mark.long)])
def test_an_orbit_with_impacts_is_that_in_closed_form_up_to_a_grazing(direction, compiled):
    impact = one_impact(0.81, [7.5, 1.8])

    def at_zero(force, impact):
        time = PERIOD - impact[0] % PERIOD
        return flown(force, impact[0], GAP, -RESTITUTION * impact[1], time)

    start = tuple(jnp.asarray(part)[None] for part in at_zero(0.81, impact) * SIZES)
    branch = continue_cycle(HITS, start, PERIOD * TIME, parameter="force", direction=direction)
    near = impact
    assert len(branch.parameter) >= 3
    for force, *state in zip(branch.parameter / FORCE, *branch.state, strict=True):
        near = one_impact(force, near)
        found = np.ravel(state) / SIZES
        np.testing.assert_allclose(found, at_zero(force, near), atol=1e-10)
    end = branch.special[-1]
    assert (end.kind, end.refined) == ("grazing", True)
    # The equations of the special cycle are compiled once, not for each step of Newton's method.
    assert compiled.count("jit(_linearise)") == 1
    force = float(end.parameter) / FORCE
    if direction == -1:  # the impact becomes a touch: the amplitude without the stop is the gap
        assert force == pytest.approx(GAP * abs(1 - OMEGA**2 + 2j * XI * OMEGA), rel=1e-10)
    else:  # a second maximum touches the stop
        times, near = np.linspace(0.02, 0.98, 40_001) * PERIOD, one_impact(force, near)
        x = flown(force, near[0], GAP, -RESTITUTION * near[1], times)[0]
        assert np.max(x[times > 1.0]) == pytest.approx(GAP, abs=1e-8)


@pytest.mark.long
def test_friction_and_two_stops_go_on_as_searches_find_them():
    """An impact turns a contact round at once: a phase of no length."""
    law, stops = StaticKinetic(0.3, 0.2), [Stop(1.0, 0.6, 0.3), Stop(-1.0, 0.4, 0.7)]
    rubs = MechanicalCells(
        1.0, damping=0.05, friction=law, belt_speed=0.3, force=0.9, frequency=0.8, stops=stops
    )
    run = simulate(rubs, (jnp.full(1, 0.1), jnp.full(1, 0.1)), 400.0)
    branch = continue_cycle(find_limit_cycle(rubs, run), parameter="force", max_points=20)
    events = [event for event, *_ in branch.orbit.sequence]
    assert events.count("at once") == 2
    force = float(branch.parameter[-1])
    assert force > 1.0
    last = tuple(part[-1] for part in branch.state)
    found = find_limit_cycle(rubs.with_(force=force), (last, branch.period[-1]))
    np.testing.assert_allclose(branch.multipliers[-1], found.multipliers, atol=1e-7)
    np.testing.assert_allclose(np.concatenate(last), np.concatenate(found.state), atol=1e-8)


@pytest.mark.long
def test_two_blocks_on_a_belt_go_on_as_searches_find_them():
    contacts = [
        Contact((1, 0), StaticKinetic(0.4, 0.25), 1.0, 0.15),
        Contact((0, 1), StaticKinetic(0.35, 0.2), 1.2, 0.15),
    ]
    blocks = MechanicalCells([[1.0, -0.3], [-0.3, 1.4]], damping=0.02, contacts=contacts)
    run = simulate(blocks, tuple(jnp.full((4, 1), 0.1)), 400.0)
    name = "contacts[0].mu_kinetic"
    branch = continue_cycle(find_limit_cycle(blocks, run), parameter=name, max_points=6)
    assert [point.kind for point in branch.special][:1] == ["two events"]
    last, value = tuple(part[-1] for part in branch.state), float(branch.parameter[-1])
    found = find_limit_cycle(blocks.with_(**{name: value}), (last, branch.period[-1]))
    assert float(found.period) == pytest.approx(float(branch.period[-1]), abs=1e-7)
    leading = np.abs(found.multipliers).max()
    assert leading == pytest.approx(np.abs(branch.multipliers[-1]).max(), rel=1e-5)


@pytest.mark.long
def test_a_branch_ends_where_an_impact_meets_a_contact_that_would_slide():
    """The force passes the static limit just before the impact, where it has no maximum."""
    rubs = MechanicalCells(
        1.86, damping=0.098, friction=StaticKinetic(0.373, 0.274), normal_load=0.7485,
        belt_speed=0.157, force=0.892, frequency=0.7265, stops=[Stop(1.0, 0.4727, 0.7794)],
    )  # fmt: skip
    run = simulate(rubs, (jnp.full(1, 0.1), jnp.full(1, 0.1)), 120 * np.pi / 0.7265)
    found = find_limit_cycle(rubs, run)
    branch = continue_cycle(found, parameter="mu_kinetic", direction=-1, bounds=(0.1, 0.274))
    assert 0.14 < branch.parameter[-1] < 0.2
    assert branch.special[-1].kind == "release"
    for value, period, *state in zip(branch.parameter, branch.period, *branch.state, strict=True):
        y = tuple(jnp.asarray(part) for part in state)
        end = simulate(rubs.with_(mu_kinetic=value), y, period, rtol=1e-12).state
        np.testing.assert_allclose(np.ravel(end), np.ravel(y), atol=1e-9)
