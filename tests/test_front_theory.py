"""The theory of fronts against Bessel functions, linear solves and SciPy's integrator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _front_theory import (
    death_belt_speed,
    growth_coupling,
    spreading_speed,
)
from scipy.integrate import solve_ivp
from scipy.special import i1, jv

from jaxchain.boundaries.fold import fold_belt_speed
from jaxchain.model import growth_rate
from jaxchain.model.chain import paper_chain


def test_linear_spreading_against_bessel_functions():
    """The exact solution of x_n' = s x_n - (i eta / 2) (x_{n-1} + x_{n+1}) from one mass."""
    eta, growth = 0.01, 0.012
    u = float(spreading_speed(eta, growth))
    times = np.array([4000.0, 8000.0])
    positions = []
    for t in times:
        n = np.arange(int(eta * t), int(2 * u * t))
        # Logarithms, because the growth alone overflows; jv of a large order underflows late.
        size = growth * t + np.log(np.maximum(np.abs(jv(n, eta * t)), 1e-300))
        known = np.abs(jv(n, eta * t)) > 1e-290
        last = np.flatnonzero(known & (size > 0))[-1]
        share = size[last] / (size[last] - size[last + 1])
        positions.append(n[last] + share)
    # t^(-1/2) of the front's tail: u t - ln t / (2 arcosh(u / eta)).
    slope = (positions[1] - positions[0] + 0.5 * np.log(2.0) / np.arccosh(u / eta)) / 4000.0
    np.testing.assert_allclose(slope, u, rtol=1e-3)
    assert np.isnan(spreading_speed(eta, -1e-3))


def test_growth_is_that_of_the_hopf_bifurcation():
    """s = [(mu_st - mu_d) / v_0 exp(-v_d / v_0) - 2 xi] / 2."""
    found = [
        growth_rate(paper_chain(1), jnp.asarray(speed)) for speed in (1.0, 0.5 * np.log(10.0))
    ]
    np.testing.assert_allclose(found, [0.5 * (np.exp(-2.0) - 0.1), 0.0], atol=1e-12)


@pytest.mark.long
def test_the_last_mass_of_a_block_dies_where_its_springs_take_too_much():
    one = paper_chain(1, width=None)
    both = jax.jit(jax.vmap(lambda eta: death_belt_speed(one, eta, -0.0034, fold_belt_speed)))
    alone, coupled = both(jnp.array([1e-9, 0.01]))
    np.testing.assert_allclose(alone, 1.836600972, rtol=1e-6)
    # What quiet masses take: driven at one end, 60 of them, by a linear solve.
    eta, speed = 0.01, float(coupled)
    damping = 0.5 * (0.1 - np.exp(-speed / 0.5))
    matrix = np.diag(np.full(60, damping - 0.0034j)) + 0.5j * eta * (
        np.eye(60, k=1) + np.eye(60, k=-1)
    )
    first = np.linalg.solve(matrix, -0.5j * eta * np.eye(60)[0])[0]
    leak = -np.real(-0.5j * eta * first)
    # Of a damping that much greater averaging, without higher harmonics, gives the fold to 1 %.
    ratio = np.linspace(0.3, 1.0, 50)
    slow = np.linspace(1.5, 1.9, 400)[:, None]
    gain = 0.5 * np.exp(-slow / 0.5) * i1(ratio * slow / 0.5) / (ratio * slow)
    fold = slow[(gain > 0.05 + 0.5 * eta + leak).any(1)].max()
    np.testing.assert_allclose(speed, fold, rtol=0.01)
    assert 1.68 < speed < 1.71


@pytest.mark.long
def test_a_quiet_neighbour_is_drawn_in_where_its_low_response_ends():
    chain = paper_chain(1, 1.3)
    detuning, amplitude, cosine = -0.0096, 1.42, -1.0
    threshold = float(growth_coupling(chain, detuning, amplitude, cosine))

    def most(eta):
        def slope(_, u):
            a = u[:6] + 1j * u[6:]
            r = np.maximum(np.abs(a), 1e-9)
            damping = 0.05 - 0.5 * np.exp(-1.3 / 0.5) * i1(r / 0.5) / r
            padded = np.concatenate([[amplitude], a, [0.0]])
            rate = -(damping + 1j * (detuning - 0.5 * eta * cosine)) * a
            rate = rate - 0.5j * eta * (padded[:-2] + padded[2:])
            return np.concatenate([rate.real, rate.imag])

        out = solve_ivp(slope, (0, 1500), np.zeros(12), rtol=1e-7, max_step=5.0,
                        events=_at_belt)  # fmt: skip
        return out.status == 1

    def _at_belt(_, u):
        return np.hypot(u[0], u[6]) - 1.3

    _at_belt.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    assert not most(0.97 * threshold)
    assert most(1.03 * threshold)
