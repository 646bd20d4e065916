import jax
import numpy as np

from jaxchain import Chain, ExponentialDecay, TanhFriction, paper_chain
from jaxchain.cycles.averaging import fold_guess, gain, greatest_speed, speed_scale
from jaxchain.model import GaussianStribeck, TabulatedFriction


def test_the_gain_is_the_work_of_friction_and_damping_in_a_period():
    chain = paper_chain(1, width=0.05)
    theta = (np.arange(4000) + 0.5) * (2 * np.pi / 4000)
    v = 1.2 * np.cos(theta)
    force = -(0.5 + 0.5 * np.exp(-2 * np.abs(v - 1.5))) * np.tanh((v - 1.5) / 0.05)
    work = np.mean(force * v) - 2 * 0.05 * np.mean(v**2)
    np.testing.assert_allclose(jax.jit(gain)(chain, 0.8, 1.5), work / 1.2, atol=1e-8)


def test_where_friction_falls_and_weakens_most_bounds_speeds_and_widths():
    law = ExponentialDecay(1.0, 0.5, 0.5)
    bump = TabulatedFriction([0.0, 0.5, 1.0, 1.5], [0.2, 1.0, 0.6, 0.4])
    narrow = GaussianStribeck(1.0, 0.5, 0.1, 0.0)
    plain, bumpy, bell = (
        Chain(1, TanhFriction(own, 1e-3), 1.0, 0.05) for own in (law, bump, narrow)
    )
    # 2 mu_st / xi at rest; 2 (1 - 0.4) / xi where friction falls most.
    greatest, scale = jax.jit(greatest_speed), jax.jit(speed_scale)
    np.testing.assert_allclose([greatest(plain), greatest(bumpy)], [40.0, 24.0], rtol=2e-4)
    # 2 mu_st over the greatest -mu': 0.5 / 0.5 at rest, and 0.5 sqrt(2 / e) / 0.1.
    expected = 2.0, 2.0 / (5.0 * np.sqrt(2.0 / np.e))
    np.testing.assert_allclose([scale(plain, 9.0), scale(bell, 9.0)], expected, rtol=1e-3)
    assert scale(plain, 1.5) == 1.5


def test_the_guess_is_near_the_fold_and_says_when_there_is_none():
    guess = jax.jit(fold_guess)
    speed, scaled_peak_velocity, exists = guess(paper_chain(1, width=0.05))
    assert bool(exists)
    np.testing.assert_allclose([speed, scaled_peak_velocity], [1.659307, -1.8023], rtol=0.1)
    np.testing.assert_allclose(speed, 1.659307, rtol=5e-3)
    assert not bool(guess(paper_chain(1, width=0.35))[2])
