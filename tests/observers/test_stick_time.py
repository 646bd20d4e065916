"""How long masses stick: between the steps of a run, beside neighbours that move.

Motions are given, so that what friction must hold is written out in NumPy. Runs with dry friction
are in tests/model/test_contacts.py and test_drives.py.
"""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Chain, ExponentialDecay, StickTime, TanhFriction
from jaxchain.model import Contact, Coulomb, MechanicalCells

LAW = ExponentialDecay(1.0, 0.5, 0.5)
TIMES = np.linspace(0.0, 12.0, 120_001)


def waves(numbers, n, xp):
    """t -> numbers of n cells, each with a phase of its own; the later half are velocities."""
    k, i = np.arange(numbers)[:, None], np.arange(n)
    size, phase = 0.4 + 0.3 * np.cos(3.0 * k + i), 2.0 * k + 1.3 * i
    return lambda t: tuple(size[j] * xp.cos(1.1 * t + phase[j]) for j in range(numbers))


def three_masses():
    """(the chain, whether each mass sticks at TIMES): with free ends, all numbers different."""
    k, c, p = np.array([1.0, 1.3, 0.8]), np.array([0.3, 0.1]), np.array([0.4, 0.6, 0.5])
    friction = TanhFriction(LAW, 0.1)
    chain = Chain(3, friction, 0.2, 0.05, c, stiffness=k, normal_load=p, ends="free")
    x, v = waves(2, 3, np)(TIMES[:, None])
    pull = np.pad(c * np.diff(x), ((0, 0), (1, 1)))
    force = np.diff(pull) - k * x - 0.1 * v
    slow = np.abs(v - 0.2) <= friction.stick_speed()
    return chain, slow & (np.abs(force) <= p)


def three_contacts():
    """The same of contacts: two blocks on a third one, on a belt that goes to and fro."""
    K = np.array([[2.0, -0.3, -0.2], [-0.3, 1.1, 0.0], [-0.2, 0.0, 1.4]])
    M, E = np.diag([2.0, 0.8, 0.7]), np.array([[1, 0, 0], [-1, 1, 0], [-1, 0, 1.0]])
    loads, force = np.array([0.9, 0.5, 0.4]), np.array([0.0, 0.5, 0.4])
    laws = [LAW.with_(width=0.1), Coulomb(0.4).with_(width=0.2), Coulomb(0.3).with_(width=0.3)]
    belts = (lambda t: 0.1 * jnp.sin(2.1 * t)), 0.0, 0.0
    parts = [Contact(*row) for row in zip(E, laws, loads, belts, strict=True)]
    cells = MechanicalCells(K, mass=M, damping=0.02, contacts=parts, force=force, frequency=0.7)
    t = TIMES
    q, v = np.split(np.stack([part[:, 0] for part in waves(6, 1, np)(t[:, None])]), 2)
    belt, turn = 0.1 * np.sin(2.1 * t), 0.21 * np.cos(2.1 * t)
    w = E @ v - np.stack([belt, 0.0 * t, 0.0 * t])
    mu = [0.5 + 0.5 * np.exp(-np.abs(w[0]) / 0.5), 0.4, 0.3]
    friction = [
        -p * m * np.tanh(u / width)
        for p, m, u, width in zip(loads, mu, w, (0.1, 0.2, 0.3), strict=True)
    ]
    sticks = []
    for i, e in enumerate(E):
        h = force[:, None] * np.cos(0.7 * t) - K @ q - 0.02 * v
        h = h + sum(np.outer(E[j], friction[j]) for j in range(3) if j != i)
        rate = e @ np.linalg.solve(M, h) - (turn if i == 0 else 0.0)
        held = np.abs(rate / (e @ np.linalg.solve(M, e))) <= loads[i] * laws[i].law.mu_static
        sticks.append(held & (np.abs(w[i]) <= laws[i].stick_speed()))
    return cells, np.stack(sticks, axis=1)


@pytest.mark.parametrize("case", [three_masses, three_contacts])
def test_the_time_is_the_share_of_times_at_which_friction_holds_a_mass(case, follow):
    """Neighbours pull with their force at that time, contacts have the friction of the others."""
    field, sticks = case()
    several = case is three_contacts
    # The shorter windows begin while one sticks, within a step.
    pairs = ((10.45, 0), (12.0, 2)) if several else ((9.45, 0), (12.0, 0))
    watch = [StickTime(window, contact) for window, contact in pairs]
    found = follow(watch, field, waves(6, 1, jnp) if several else waves(2, 3, jnp), TIMES[::1000])
    assert np.all((sticks.mean(axis=0) > 0.05) & (sticks.mean(axis=0) < 0.6))
    for (window, _), one, time in zip(pairs, watch, found, strict=True):
        share = sticks[-round(window * 10_000) - 1 :].mean(axis=0)
        wanted = window * (share[[one.contact]] if several else share)
        np.testing.assert_allclose(time, wanted, atol=2e-3)
