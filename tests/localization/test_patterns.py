"""Locked patterns of phases against closed forms, simulations and cycles of the whole chain."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Chain, ExponentialDecay, TanhFriction, find_limit_cycle, paper_chain
from jaxchain.cycles.averaging import one_mass
from jaxchain.localization import (
    LockedPattern,
    PhaseModel,
    block_sites,
    locked_patterns,
    pattern_guess,
    phase_model,
    rotating_wave,
)
from jaxchain.model.initial_states import excited_block

# H(s) = a cos s - b sin s, and what sliding neighbours do.
A, B, QUIET = -0.5, 0.2, 0.03


@pytest.fixture(scope="module")
def model():
    """Made up, with H of one harmonic, so that locked patterns have closed forms."""
    zero = jnp.zeros(1)
    return PhaseModel(
        chain=paper_chain(8, width=0.05), state=(zero, zero), period=jnp.asarray(2 * np.pi),
        displacement=jnp.array([0.0, 1.0 + 0j]), interaction=jnp.array([0.0, A + 1j * B]),
        quiet=jnp.asarray(QUIET),
    )  # fmt: skip


def test_each_neighbour_pulls_and_those_that_slide_are_counted(model):
    ahead = lambda s: A * np.cos(s) - B * np.sin(s)  # what one that is s ahead does
    rates = eqx.filter_jit(model.rates)
    expected = [ahead(-0.7) + QUIET, ahead(0.7) + ahead(1.4), ahead(-1.4) + QUIET]
    np.testing.assert_allclose(rates(np.array([0.3, -0.4, 1.0])), expected)
    np.testing.assert_allclose(rates(np.zeros(1)), 2 * QUIET)
    np.testing.assert_allclose(rates(np.zeros(8)), 2 * A)  # the ring has no ends


def test_two_masses_lock_in_phase_or_alternate(model):
    """The difference s of their phases obeys s' = omega eta_c 2 b sin s."""
    patterns = locked_patterns(model, 2)
    assert [round(p.order) for p in patterns] == [-1, 1]
    np.testing.assert_allclose([p.growth for p in patterns], [-2 * B * 0.01, 2 * B * 0.01])
    np.testing.assert_allclose([p.rate for p in patterns], [QUIET - A, QUIET + A])


def test_three_masses_lock_where_the_middle_one_is_ahead(model):
    """The mirrored pattern 0, s, 0: a cos s + 3 b sin s = q, which has two solutions."""
    patterns, rates = locked_patterns(model, 3), eqx.filter_jit(model.rates)
    for pattern in patterns:
        np.testing.assert_allclose(rates(pattern.phases), pattern.rate, atol=1e-9)
    growths = [p.growth for p in patterns]
    assert growths == sorted(growths)
    turned = {tuple(np.round(np.cos(np.diff(p.phases)), 4)) for p in patterns}
    assert len(turned) == len(patterns)  # no two are alike
    mirrored = [p for p in patterns if p.mirrored]
    assert len(mirrored) == 2
    for pattern in mirrored:
        s = pattern.phases[1]
        assert A * np.cos(s) + 3 * B * np.sin(s) == pytest.approx(QUIET, abs=1e-9)
    # Nearly in quadrature where friction hardly holds phases together, at 0 or pi never.
    assert all(abs(np.sin(p.phases[1])) > 0.1 for p in mirrored)


def test_rotating_waves_of_a_ring_are_known_in_closed_form(model):
    """Growth of a disturbance of wavenumber q: 2 b cos(step) (1 - cos q) eta_c."""
    for turns in (0, 1, 4):
        wave = rotating_wave(model, turns)
        step = 2 * np.pi * turns / 8
        growth = [2 * B * np.cos(step) * (1 - np.cos(2 * np.pi * q / 8)) for q in range(1, 8)]
        assert wave.growth == pytest.approx(0.01 * max(growth), abs=1e-12)
        assert wave.rate == pytest.approx(2 * A * np.cos(step))
    assert rotating_wave(model, 4).growth < 0 < rotating_wave(model, 0).growth


@pytest.mark.parametrize("block", ["forward", "centred"])
def test_the_sites_of_a_block_are_those_that_are_excited(block):
    for k in (1, 4, 9):
        mask = np.asarray(excited_block(10, k, block))
        sites = block_sites(10, k, block)
        assert sorted(sites) == np.flatnonzero(mask).tolist()
        np.testing.assert_array_equal(np.diff(sites) % 10, 1)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"coupling": None}, "coupling"),
        ({"ends": "free"}, "ring"),
        ({"stiffness": np.array([1.0, 1, 1, 2])}, "equal masses"),
        ({"n": 2}, "three"),
    ],
)
def test_chains_without_a_phase_model_are_refused(changes, named):
    friction = TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 0.05)
    numbers = {"n": 4, "friction": friction, "belt_speed": 1.5, "coupling": 0.01}
    with pytest.raises(ValueError, match=named):
        phase_model(Chain(**(numbers | changes)))


@pytest.fixture(scope="module")
def real():
    return phase_model(paper_chain(5, belt_speed=1.4, width=0.02).with_(coupling=2e-3))


@pytest.mark.exhaustive
def test_the_pull_is_what_a_shaken_mass_feels(real):
    """The period of one mass that a weak force x(t + s) shakes, by its own cycle's shooting.

    A spring of constant g to a copy of itself, ahead by s, adds g x(theta + s): of s = 0 that is
    a change of stiffness by -g, and the period follows from a search for the cycle.
    """
    chain = real.chain
    alone = one_mass(chain, 0)
    springs, g = [float(alone.stiffness) - sign * 1e-4 for sign in (1, -1)], 1e-4
    periods = [float(find_limit_cycle(alone.with_(stiffness=k)).period) for k in springs]
    change = -(periods[0] - periods[1]) / (2 * g * float(real.period))
    assert float(real.pull(jnp.zeros(()))) == pytest.approx(change, rel=1e-2)


@pytest.mark.exhaustive
def test_cycles_of_the_whole_chain_lie_near_locked_patterns(real):
    """And their disturbances grow as the phases do, to first order in the coupling."""
    chain = real.chain
    for pattern in locked_patterns(real, 2):
        state, period = pattern_guess(real, pattern.phases)
        cycle = find_limit_cycle(chain, state, period=period, mass=2)
        assert float(cycle.period) == pytest.approx(float(period), abs=3e-3)
        np.testing.assert_allclose(cycle.state[0], state[0], atol=0.08)
        growths = np.log(np.abs(cycle.multipliers)) / float(cycle.period)
        assert np.min(np.abs(growths - pattern.growth)) < 0.3 * abs(pattern.growth)
        assert (np.max(growths) > 0) == (pattern.growth > 0)


def test_the_images_of_a_block_are_the_symmetry_of_its_pattern():
    def images(*phases, n=8):
        return LockedPattern(np.array(phases), 0.0, 0.0).images(n)

    assert images(0.0) == [0, 7, 6, 5, 4, 5, 6, 7]
    assert images(0.0, 0.0) == [7, 6, 5, 4, 4, 5, 6, 7]
    assert images(0.0, np.pi) is None
    assert images(0.0, 1.0, 0.0) == [0, 7, 6, 5, 4, 5, 6, 7]
    assert images(*np.zeros(8)) == [4] * 8
    assert images(*(np.pi * np.arange(8))) == [4, 5] * 4
    assert images(*(np.pi / 4 * np.arange(8))) is None
