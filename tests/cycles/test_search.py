"""Limit cycles, stable or not, against SciPy, exact ones and finite differences."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from witnesses.smoothed import OneMass

from jaxchain import excited_state, paper_chain, simulate, steady_sliding
from jaxchain.boundaries import find_hopf_point
from jaxchain.cycles.limit_cycle import find_limit_cycle


def check_cycle(speed, x, v, period, amplitude, multiplier: Any):
    """By SciPy, from the greatest velocity: it closes.  M f = f, so tr M = 1 + the multiplier."""
    mass, start = OneMass(0.05), (float(x[0]), float(v[0]))
    end, M = mass.after(*start, float(period), speed)
    np.testing.assert_allclose(end, start, atol=1e-8)
    assert complex(multiplier) == pytest.approx(np.trace(M) - 1.0, abs=1e-5)

    def at(share):
        return mass.after(*start, share * float(period), speed)[0]

    turns = [brentq(lambda t: at(t)[1], *shares) for shares in ((0.1, 0.45), (0.55, 0.95))]
    high, low = (at(turn)[0] for turn in turns)
    assert float(amplitude[0]) == pytest.approx((high - low) / 2, abs=1e-8)


@pytest.mark.parametrize("branch", ["stable", "unstable"])
def test_one_mass_agrees_with_scipy(branch):
    cycle = find_limit_cycle(paper_chain(1, belt_speed=1.5, width=0.05), branch=branch)
    assert cycle.stable is (branch == "stable")
    assert float(cycle.residual) < 1e-9
    (x, v), (multiplier,) = cycle.state, cycle.multipliers
    check_cycle(1.5, x, v, cycle.period, cycle.amplitude, multiplier)
    assert float(cycle.trivial_defect) < 1e-7
    assert float(cycle.liouville_defect) < 1e-7
    assert float(cycle.energy) == pytest.approx(float(cycle.amplitude[0]) ** 2 / 2, rel=1e-7)
    # Cut where it is fastest: there z = asinh(w / eps) of the mass is its scaled_peak_velocity.
    scaled_peak_velocity = (float(cycle.state[1][0]) - 1.5) / 0.05
    assert float(cycle.scaled_peak_velocity[0]) == pytest.approx(scaled_peak_velocity, abs=1e-5)


def test_a_point_of_a_branch_agrees_with_scipy(smoothed_branch):
    branch, k = smoothed_branch, int(0.8 * smoothed_branch.parameter.size)
    cycle = branch.x[k], branch.v[k], branch.period[k], branch.amplitude[k]
    check_cycle(branch.parameter[k], *cycle, branch.multipliers[k, 0])
    assert abs(branch.energy[k] - branch.amplitude[k, 0] ** 2 / 2) < 1e-14


@pytest.fixture(scope="module")
def slip():
    return find_limit_cycle(paper_chain(1, belt_speed=1.5, width=0.05), branch="unstable")


@pytest.mark.long
def test_guesses_of_every_kind_lead_to_the_same_cycle(slip):
    chain = paper_chain(1, belt_speed=1.5, width=0.05)
    simulated = simulate(chain, excited_state(chain, 1), 60.0)
    stable = find_limit_cycle(chain, simulated)
    again = [
        find_limit_cycle(chain, excited_state(chain, 1)),
        find_limit_cycle(chain, (stable.state, stable.period)),
        find_limit_cycle(chain, simulated.state, period=6.3),
    ]
    for cycle in again:
        assert cycle.stable is True
        assert float(cycle.period) == pytest.approx(float(stable.period), abs=1e-9)
        np.testing.assert_allclose(cycle.state, stable.state, atol=1e-8)
    # From a neighbour, without a simulation.
    other = find_limit_cycle(chain.with_(belt_speed=1.45, width=0.04), stable)
    fresh = find_limit_cycle(chain.with_(belt_speed=1.45, width=0.04))
    assert float(other.period) == pytest.approx(float(fresh.period), abs=1e-9)
    # The unstable cycle near its Hopf point, which it branches off.
    near = chain.with_(belt_speed=1.16)
    small = find_limit_cycle(near, find_hopf_point(near, "belt_speed").guess(0.19))
    assert small.stable is False
    # A^2 = 8 (v_d - v_H) to leading order: d = 2 xi - p F' grows by 0.2 per speed, F''' = 0.4.
    predicted = np.sqrt(4.0 * (1.16 - np.log(10) / 2))
    assert float(small.amplitude[0]) == pytest.approx(predicted, rel=0.02)
    assert float(small.multipliers[0].real) > 1.0
    assert bool(slip.amplitude[0] > small.amplitude[0])


@pytest.mark.long
def test_period_and_amplitude_have_derivatives(slip):
    chain = slip.chain

    def measured(changes):
        cycle = find_limit_cycle(chain.with_(**changes), slip, mass=0, rtol=1e-12)
        return jnp.stack([cycle.period, cycle.amplitude[0], cycle.state[1][0], cycle.energy])

    point = {
        "damping_ratio": 0.05, "belt_speed": 1.5, "width": 0.05, "mu_static": 1.0,
        "mu_dynamic": 0.5, "v_ref": 0.5, "stiffness": 1.0,
    }  # fmt: skip
    point = {name: jnp.asarray(value) for name, value in point.items()}
    forward = jax.jit(jax.jacfwd(measured))(point)
    h = 2e-5
    for name in point:
        up, down = (measured({**point, name: point[name] + s * h}) for s in (1, -1))
        np.testing.assert_allclose(forward[name], (up - down) / (2 * h), rtol=2e-6, atol=4e-6)


def test_a_dry_cycle_is_found_at_every_belt_speed():
    """The guess is where the mass begins to stick; at 1.36 the first step ends before that."""
    amplitudes = []
    for speed in np.arange(1.3, 1.4, 0.01):
        found = find_limit_cycle(paper_chain(1, speed, width=None), throw=False)
        assert found.successful, speed
        assert found.residual < 1e-9
        amplitudes.append(float(found.amplitude[0]))
    assert np.max(np.abs(np.diff(amplitudes, 3))) < 1e-7


@pytest.mark.long
def test_rest_and_failure_are_reported():
    fast = paper_chain(1, belt_speed=2.5, width=0.05)
    for branch in ("stable", "unstable"):
        with pytest.raises(RuntimeError, match=r"No .* turn at a fold at 1.65931.*`guess`"):
            find_limit_cycle(fast, branch=branch)
    with pytest.raises(RuntimeError, match="comes to rest"):
        find_limit_cycle(fast, steady_sliding(fast))
    with pytest.raises(RuntimeError, match=r"end in a Hopf point at 1.15129"):
        find_limit_cycle(fast.with_(belt_speed=1.1), branch="unstable")
    # Proved: Coulomb friction feeds no vibration.
    with pytest.raises(RuntimeError, match="There is no limit cycle: damping outweighs"):
        find_limit_cycle(fast.with_(mu_dynamic=1.0))
    lost = find_limit_cycle(fast, throw=False)
    assert not bool(lost.successful)
    assert lost.stable is None
    # Rest solves the equations of a closed orbit for any period.
    resting = find_limit_cycle(
        fast, ((jnp.full(1, 0.5), jnp.full(1, 1e-4)), 6.28), mass=0, throw=False
    )
    assert not bool(resting.successful)


def test_bounds_on_a_cycle_hold_and_are_sharp():
    """Periods of vanishing vibrations are those of the modes; the belt's power bounds speeds."""
    chain = paper_chain(3, width=0.05).with_(stiffness=jnp.array([1.0, 4.0, 2.0]))
    K = np.diag([1.02, 4.02, 2.02]) - 0.01 * (np.ones((3, 3)) - np.eye(3))
    least, slow = 2 * np.pi / np.sqrt(np.linalg.eigvalsh(K)[-1]), np.ones(3)
    possible = jax.jit(lambda chain, period, speeds: chain.can_be_cycle(period, speeds))
    assert possible(chain, 1.01 * least, slow)
    assert not possible(chain, 0.99 * least, slow)
    # T (k + 2 c)^(1/2) v_d (mu_0 + ...) / (2 xi): friction no more than twice the greatest.
    power = 6.3 * np.sqrt(4.04) * 1.5 * 3 / 0.1
    for share, expected in ((0.9, True), (2.1, False)):
        assert bool(possible(chain, 6.3, np.array([1, 1, np.sqrt(share * power)]))) is expected
    undamped = chain.with_(damping_ratio=np.array([0.1, 0.0, 0.1]))
    assert possible(undamped, 6.3, 1e6 * slow)


def test_a_belt_that_runs_the_other_way_has_the_mirrored_cycle(slip):
    back = find_limit_cycle(slip.chain.with_(belt_speed=-1.5), branch="unstable")
    carried = find_limit_cycle(slip.chain, back)
    for cycle, sign in ((back, -1.0), (carried, 1.0)):
        np.testing.assert_allclose(cycle.state, sign * jnp.stack(slip.state), atol=1e-9)
        for name in ("period", "multipliers", "amplitude", "fastest", "scaled_peak_velocity"):
            np.testing.assert_allclose(getattr(cycle, name), getattr(slip, name), atol=1e-8)


def test_a_cycle_is_not_called_stable_without_proof(slip):
    assert slip.stable is False
    at_one = eqx.tree_at(lambda c: c.multipliers, slip, jnp.asarray([1.0 + 1e-9 + 0j]))
    assert at_one.stable is None
    defective = eqx.tree_at(lambda c: c.liouville_defect, slip, jnp.asarray(0.1))
    assert defective.stable is None
    unknown = eqx.tree_at(lambda c: c.multipliers, slip, jnp.asarray([jnp.nan + 0j]))
    assert unknown.stable is None
