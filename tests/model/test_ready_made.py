"""The ready-made models against their published numbers, closed forms and SciPy."""
# pyright: reportArgumentType=false

import inspect
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
from jaxchain.observers import PeakTimes

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


# The right-hand sides once more, from the formulas of the docstrings; `d` is the sum of the
# differences of the first number to both neighbours.


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


def pendulums(p, t, y, sides):
    """Springs between bobs, without the force that they have where all pendulums hang."""
    angle, v = y
    bob = p.length * np.array([np.sin(angle), 1 - np.cos(angle)])  # from where it hangs
    along, up = p.coupling * sides(bob)
    up = up - 1 - p.amplitude * p.frequency**2 * np.cos(p.frequency * t)
    return v, (along * np.cos(angle) + up * np.sin(angle)) / p.length - p.damping * v


BY_HAND = {
    ModeCoupling: mode_coupling, LuGre: lugre, RateAndState: rate_and_state,
    Duffing: duffing, VanDerPol: van_der_pol, BurridgeKnopoff: burridge_knopoff,
}  # fmt: skip
CLASSES = [*BY_HAND, Pendulums]


def rate_by_hand(cells, t, y):
    """All rates of a state of shape (m, n)."""

    def sides(a):
        left, right = np.roll(a, 1, -1), np.roll(a, -1, -1)
        if cells.ends == "free":
            left[..., 0], right[..., -1] = a[..., 0], a[..., -1]
        return left + right - 2 * a

    numbers = {name: np.asarray(value) for name, value in cells.parameters().items()}
    p = SimpleNamespace(law=getattr(cells, "law", None), **numbers)
    if isinstance(cells, Pendulums):
        return np.stack(pendulums(p, t, y, sides))
    return np.stack(BY_HAND[type(cells)](p, t, y, sides(y[0])))


@pytest.mark.parametrize("cls", CLASSES)
def test_rates_are_those_of_the_formulas(cls):
    for n, ends in ((3, "cyclic"), (5, "free")):
        for static in ({"law": "aging"}, {"law": "slip"}) if cls is RateAndState else ({},):
            cells = some(cls, n, ends=ends, **static)
            y = np.random.default_rng(1).normal(size=(len(cells.components), n))
            found = jax.jit(lambda y, cells=cells: jnp.stack(cells(0.7, tuple(y))))(y)
            wanted, case = rate_by_hand(cells, 0.7, y), f"{n} {ends} {static}"
            np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-12, err_msg=case)


def test_a_lugre_block_sticks_and_slips_with_the_period_of_the_table():
    watch = PeakTimes(capacity=5)
    maxima = simulate(LuGre(), (jnp.zeros(1),) * 3, 30.0, rtol=1e-10, observe=watch).observed
    assert np.diff(np.asarray(maxima)[:, 0])[-2] == pytest.approx(6.36272, abs=1e-5)


NUMBERS = {"mass": 0.02, "speed": 1.3, "normal_stress": 10.0, "direct_effect": 0.5,
           "evolution_effect": 0.9, "slip_length": 0.7, "reference_friction": 0.6,
           "reference_speed": 0.4}  # fmt: skip


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

    critical = 10.0 * (0.9 - 0.5) / 0.7 * (1 + 0.02 * 1.3**2 / (10.0 * 0.5 * 0.7))
    rates, jacobian = linearised(critical)
    np.testing.assert_allclose(rates, 0.0, atol=1e-12)
    values: Any = np.linalg.eigvals(jacobian)
    pair = values[np.abs(values.imag) > 0]
    np.testing.assert_allclose(pair.real, 0, atol=1e-9)
    square = (critical * 1.3 / 0.7) / (0.02 * 1.3 / 0.7 + 10.0 * 0.5 / 1.3)
    np.testing.assert_allclose(np.abs(pair.imag), np.sqrt(square), rtol=1e-9)
    for share, sign in ((0.99, 1), (1.01, -1)):
        values = np.linalg.eigvals(linearised(share * critical)[1])
        assert np.real(values).max() * sign > 1e-3


@pytest.mark.parametrize("cls", CLASSES)
def test_with_changes_one_number(cls):
    cells = some(cls, 2)
    for name, value in cells.parameters().items():
        changed = cells.with_(**{name: 0.9 * np.asarray(value)}).parameters()
        for other, number in cells.parameters().items():
            factor = 0.9 if other == name else 1.0
            np.testing.assert_array_equal(changed[other], factor * np.asarray(number))


def test_a_fault_switches_at_the_velocity_of_its_blocks():
    fault, v = BurridgeKnopoff(FRICTION, speed=0.3, coupling=2.0, ends="free"), jnp.ones(5)
    velocities, width = fault.switching(0.0, v)
    np.testing.assert_array_equal(velocities, v)
    assert width == 1e-2
