"""Initial states against eq. (8) and eq. (10) of the paper."""

import jax.numpy as jnp
import numpy as np

from jaxchain import equation_8, equation_10, excited_state, paper_chain, steady_sliding
from jaxchain.model.initial_states import excited_block

CHAIN = paper_chain(20, belt_speed=1.5)
SLIDING = 0.5 + 0.5 * np.exp(-3.0)


def members(mask):
    return (np.flatnonzero(mask) + 1).tolist()


def test_blocks_hold_oscillator_11_and_grow_as_documented():
    assert members(excited_block(20, 0)) == []
    assert members(excited_block(20, 12)) == [1, 2, *range(11, 21)]
    assert members(excited_block(20, 3, "centred")) == [10, 11, 12]
    assert members(excited_block(20, 4, "centred")) == [9, 10, 11, 12]


def test_equation_8_pulls_excited_masses_out_of_phase():
    x, v = equation_8(CHAIN, 2)
    expected = np.full(20, SLIDING)
    expected[10] += -2.0  # n = 11 is odd
    expected[11] += 2.0
    np.testing.assert_allclose(x, expected, rtol=1e-14)
    assert not v.any()
    np.testing.assert_allclose(equation_8(CHAIN, 0)[0], steady_sliding(CHAIN)[0])


def test_the_two_readings_of_equation_10_differ_in_the_sign_of_friction():
    for sign, how in ((-1, {"reading": "as_printed"}), (1, {})):
        x, v = equation_10(CHAIN, 1, **how)
        np.testing.assert_allclose(x[0], sign * SLIDING, rtol=1e-14)
        np.testing.assert_allclose(x[10], -2 + sign * SLIDING, rtol=1e-14)
        assert np.all(np.asarray(v) == 0.56)


def test_free_choice_of_masses_pattern_amplitude_and_velocity():
    mask = jnp.zeros(20, bool).at[jnp.array([3, 7])].set(True)
    x, v = excited_state(CHAIN, mask, amplitude=0.5, velocity=-0.1, pattern="in-phase")
    expected = SLIDING + 0.5 * np.asarray(mask)
    np.testing.assert_allclose(x, expected, rtol=1e-14)
    assert np.all(np.asarray(v) == -0.1)
