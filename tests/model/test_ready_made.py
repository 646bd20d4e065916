"""The ready-made models against their published numbers, closed forms and SciPy."""
# pyright: reportArgumentType=false

import inspect
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain import ExponentialDecay, TanhFriction, simulate
from jaxchain.model import (
    BurridgeKnopoff,
    Duffing,
    LuGre,
    ModeCoupling,
    Pendulums,
    RateAndState,
    VanDerPol,
)
from jaxchain.observers import PeakTimes, Trajectory

FRICTION = TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 1e-2)


def some(cls, n, **static):
    """The model with different numbers in each cell, but one frequency, amplitude and so on."""
    rng = np.random.default_rng(n)
    numbers = {}
    for name, parameter in inspect.signature(cls).parameters.items():
        if name in ("frequency", "amplitude"):
            numbers[name] = float(rng.uniform(0.5, 2.0))
        elif name == "friction" and cls is BurridgeKnopoff:
            numbers[name] = FRICTION
        elif parameter.default not in ("cyclic", "aging"):
            numbers[name] = rng.uniform(0.5, 2.0, n)
    return cls(**numbers, **static)


# The right-hand sides once more, one cell at a time, from the formulas of the docstrings; `d` is
# the sum of the differences of the first number to both neighbours.


def mode_coupling(p, t, y, d):
    x, y, vx, vy = y
    along = -p.damping_x * vx - p.stiffness_x * x - p.cubic * x**3 + p.coupling * d
    along -= (p.stiffness_xy - p.friction * p.contact_stiffness) * y
    return vx, vy, along, -p.damping_y * vy - p.stiffness_xy * x - p.stiffness_y * y


def lugre(p, t, y, d):
    u, v, force = y
    z = force / p.bristle_stiffness
    drop = p.static_force - p.coulomb_force
    g = p.coulomb_force + drop * np.exp(-((v / p.stribeck_speed) ** 2))
    dz = v - p.bristle_stiffness * abs(v) * z / g
    friction = p.bristle_stiffness * z + p.bristle_damping * dz + p.viscosity * v
    dv = (p.stiffness * u - friction - p.coupling * d) / p.mass
    return p.speed - v, dv, p.bristle_stiffness * dz


def rate_and_state(p, t, y, d):
    u, v, age = y[0], np.exp(y[1]), np.exp(y[2])
    friction = p.reference_friction + p.direct_effect * np.log(v / p.reference_speed)
    friction += p.evolution_effect * np.log(p.reference_speed * age / p.slip_length)
    dv = (p.stiffness * u - p.coupling * d - p.normal_stress * friction) / p.mass
    ratio = v * age / p.slip_length
    d_age = 1 - ratio if p.law == "aging" else -ratio * np.log(ratio)
    return p.speed - v, dv / v, d_age / age


def duffing(p, t, y, d):
    x, v = y
    force = p.force * np.cos(p.frequency * t) - p.damping * v - p.stiffness * x - p.cubic * x**3
    return v, (force + p.coupling * d) / p.mass


def van_der_pol(p, t, y, d):
    x, v = y
    return v, p.mu * (1 - x**2) * v - x + p.coupling * d


def burridge_knopoff(p, t, y, d):
    u, v = y
    friction = -(0.5 + 0.5 * np.exp(-abs(v) / 0.5)) * np.tanh(v / 1e-2)
    return p.speed - v, (p.stiffness * u - p.coupling * d + friction) / p.mass


def pendulums(p, t, angle, lengths):
    """Of three neighbouring pendulums (angles, lengths): the force on the bob in the middle.

    Springs between bobs, without the force that they have where all pendulums hang.
    """
    displacement = [
        length * np.array([np.sin(a), -np.cos(a)])
        for a, length in zip(angle, lengths, strict=True)
    ]
    hangs = [length * np.array([0.0, -1.0]) for length in lengths]
    gravity = 1 + p.amplitude * p.frequency**2 * np.cos(p.frequency * t)
    force = gravity * np.array([0.0, -1.0])
    for k in (0, 2):
        force = force + p.coupling * ((displacement[k] - displacement[1]) - (hangs[k] - hangs[1]))
    return force @ [np.cos(angle[1]), np.sin(angle[1])] / lengths[1]


BY_HAND = {
    ModeCoupling: mode_coupling, LuGre: lugre, RateAndState: rate_and_state,
    Duffing: duffing, VanDerPol: van_der_pol, BurridgeKnopoff: burridge_knopoff,
}  # fmt: skip
CLASSES = [*BY_HAND, Pendulums]


def one_of(cells, n, k):
    """The numbers of cell k of n."""
    numbers = {
        name: np.broadcast_to(np.asarray(value), (n,))[k]
        for name, value in cells.parameters().items()
    }
    return SimpleNamespace(law=getattr(cells, "law", None), **numbers)


def rate_by_hand(cells, t, y):
    """All rates of a state of shape (m, n)."""
    n = y.shape[1]
    rates = np.zeros_like(y)
    for k in range(n):
        before, behind = (k - 1) % n, (k + 1) % n
        if cells.ends == "free":
            before, behind = max(k - 1, 0), min(k + 1, n - 1)
        one = one_of(cells, n, k)
        if isinstance(cells, Pendulums):
            at = [before, k, behind]
            lengths = np.broadcast_to(np.asarray(cells.length), (n,))
            push = pendulums(one, t, y[0, at], lengths[at])
            rates[:, k] = y[1, k], push - one.damping * y[1, k]
        else:
            d = y[0, before] + y[0, behind] - 2 * y[0, k]
            rates[:, k] = BY_HAND[type(cells)](one, t, y[:, k], d)
    return rates


@pytest.mark.parametrize("cls", CLASSES)
def test_rates_are_those_of_the_formulas(cls):
    for n, ends in ((3, "cyclic"), (5, "free")):
        for static in ({"law": "aging"}, {"law": "slip"}) if cls is RateAndState else ({},):
            cells = some(cls, n, ends=ends, **static)
            y = np.random.default_rng(1).normal(size=(len(cells.components), n))
            found = jax.jit(lambda y, cells=cells: jnp.stack(cells(0.7, tuple(y))))(y)
            wanted, case = rate_by_hand(cells, 0.7, y), f"{n} {ends} {static}"
            np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-12, err_msg=case)


@eqx.filter_jit
def pulled(block, start, t1, times):
    """(maxima and states of a run of a LuGre block); one program for all of its numbers."""
    watch = PeakTimes(capacity=5), Trajectory(times)
    return simulate(block, start, t1, rtol=1e-10, observe=watch).observed


def test_a_lugre_block_sticks_and_slips_with_the_period_of_scipy_and_of_the_table():
    block, rest = LuGre(), (jnp.zeros(1),) * 3
    maxima, _ = pulled(block, rest, jnp.asarray(30.0), jnp.linspace(0.0, 30.0, 16))
    period = np.diff(maxima[:, 0])[-2]
    assert abs(period - 6.36272) < 1e-5

    def rate(t, y):  # with the deflection z itself
        u, v, z = y
        g = 1.0 + 0.5 * np.exp(-((v / 0.001) ** 2))
        dz = v - 1e5 * abs(v) * z / g
        return 0.1 - v, 2 * u - 1e5 * z - np.sqrt(1e5) * dz - 0.4 * v, dz

    def top(t, y):
        return 0.1 - y[1]

    vars(top).update(direction=-1)
    tight = {"method": "Radau", "rtol": 1e-9, "atol": 1e-12}
    times = solve_ivp(rate, (0, 30), [0, 0, 0], events=top, **tight).t_events[0]
    np.testing.assert_allclose(period, np.diff(times)[-2], rtol=1e-6)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_force_of_dahls_bristles_depends_on_the_path_alone(direction):
    block = LuGre(2.0, 2.0, 0.5 * direction, 10.0, 0.0, 0.3, coulomb_force=0.8, static_force=0.8)
    start = (jnp.array([1.5 * direction]), jnp.array([0.2 * direction]), jnp.array([0.4]))
    times = jnp.linspace(0.0, 1.5, 16)
    _, states = pulled(block, start, jnp.asarray(1.5), times)
    u, v, force = (np.asarray(part)[:, 0] for part in states)
    assert np.all(v * direction > 0)
    path = direction * (0.5 * direction * np.asarray(times) - (u - u[0]))
    assert path[-1] > 0.5
    limit = 0.8 * direction
    expected = limit + (0.4 - limit) * np.exp(-10.0 * path / 0.8)
    np.testing.assert_allclose(force, expected, atol=1e-9)


NUMBERS = {"mass": 0.02, "speed": 1.3, "normal_stress": 10.0, "direct_effect": 0.5,
           "evolution_effect": 0.9, "slip_length": 0.7, "reference_friction": 0.6,
           "reference_speed": 0.4}  # fmt: skip


CRITICAL = 10.0 * (0.9 - 0.5) / 0.7 * (1 + 0.02 * 1.3**2 / (10.0 * 0.5 * 0.7))


@pytest.mark.parametrize("law", ["aging", "slip"])
def test_steady_sliding_loses_stability_at_the_stiffness_of_rice_and_ruina(law):
    @jax.jit
    def linearised(stiffness):
        """(rates and Jacobian at steady sliding)."""
        block = RateAndState(stiffness=stiffness, law=law, **NUMBERS)
        stress = 10.0 * (0.6 + (0.5 - 0.9) * np.log(1.3 / 0.4))
        rest = stress / stiffness, np.log(1.3), np.log(0.7 / 1.3)
        rest = tuple(jnp.asarray(part, float)[None] for part in rest)
        return jnp.stack(block(0.0, rest)), block.jacobian(0.0, rest)

    rates, jacobian = linearised(CRITICAL)
    np.testing.assert_allclose(rates, 0.0, atol=1e-12)
    eigenvalues: Any = np.linalg.eigvals
    values = eigenvalues(jacobian)
    pair = values[np.abs(values.imag) > 0]
    np.testing.assert_allclose(pair.real, 0, atol=1e-9)
    square = (CRITICAL * 1.3 / 0.7) / (0.02 * 1.3 / 0.7 + 10.0 * 0.5 / 1.3)
    np.testing.assert_allclose(np.abs(pair.imag), np.sqrt(square), rtol=1e-9)
    assert np.max(eigenvalues(linearised(0.99 * CRITICAL)[1]).real) > 1e-3
    assert np.max(eigenvalues(linearised(1.01 * CRITICAL)[1]).real) < -1e-3


# Driven and self-excited oscillators.


def multipliers(amplitudes):
    """Floquet's, of the flat state of four alternating pendulums."""
    length = 1.0 + 0.25 * (-1.0) ** jnp.arange(4)

    # The flat state itself does not bound the steps.
    @jax.jit
    def monodromy(amplitude):
        ring = Pendulums(length, amplitude, frequency=3.5, damping=0.1, coupling=1.0)

        def flow(y):
            end = simulate(ring, (y[:4], y[4:]), 2 * np.pi / 3.5, rtol=1e-9).state
            return jnp.concatenate(end)

        return jax.jacfwd(flow)(jnp.zeros(8))

    return [np.linalg.eigvals(monodromy(a)) for a in amplitudes]


@pytest.mark.long
def test_flat_pendulums_have_the_multipliers_of_scipy_and_the_published_amplitude():
    n, a, w = 4, 0.05, 3.5
    length = 1 + 0.25 * (-1.0) ** np.arange(n)

    def rate(t, y):
        angle, v = y.reshape(2, n, 2 * n)
        x = length[:, None] * angle
        # Springs pull in proportion to the horizontal distance of the bobs.
        force = np.roll(x, 1, 0) + np.roll(x, -1, 0) - 2 * x
        force -= (1 + a * w**2 * np.cos(w * t)) * angle
        return np.stack([v, force / length[:, None] - 0.1 * v]).ravel()

    tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    y = solve_ivp(rate, (0, 2 * np.pi / w), np.eye(2 * n).ravel(), **tight).y[:, -1]
    expected = np.linalg.eigvals(y.reshape(2 * n, 2 * n))
    below, above = 0.03993, 0.03995
    found, *near = multipliers([a, below, above])
    np.testing.assert_allclose(np.sort(np.abs(found)), np.sort(np.abs(expected)), atol=1e-7)
    # The published ring of 32 loses stability by a wave that fits into one of 4, too.
    low, high = (np.max(np.abs(m)) - 1 for m in near)
    assert low < 0 < high
    critical = below - low * (above - below) / (high - low)
    assert abs(critical - 0.03994278) < 1e-7


# Input.


def test_with_changes_one_number():
    for cls in CLASSES:
        cells = some(cls, 2)
        for name, value in cells.parameters().items():
            changed = cells.with_(**{name: 0.9 * np.asarray(value)}).parameters()
            for other, number in cells.parameters().items():
                factor = 0.9 if other == name else 1.0
                np.testing.assert_array_equal(changed[other], factor * np.asarray(number))
        with pytest.raises(ValueError, match=r"does not know \['nothing'\]"):
            cells.with_(nothing=1.0)


def test_a_fault_switches_at_the_velocity_of_its_blocks():
    fault, v = BurridgeKnopoff(FRICTION, speed=0.3, coupling=2.0, ends="free"), jnp.ones(5)
    velocities, width = fault.switching(0.0, v)
    np.testing.assert_array_equal(velocities, v)
    assert width == 1e-2
