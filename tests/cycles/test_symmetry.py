"""Rings that lose their symmetry: closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.oscillators import LinearRing

from jaxchain import SearchResult, continue_cycle, find_limit_cycle
from jaxchain.boundaries import continue_special
from jaxchain.cycles import cycle_symmetry, switch_cycle
from jaxchain.cycles.symmetry import finer, isotropy, label_of, ring_motions
from jaxchain.model import AbstractCells
from jaxchain.model.springs import Springs


class Ring(AbstractCells):
    """z' = (a + 2 i) z - (1 - i) |z|^2 z + K (1 + 2 i) (mean of both neighbours - z).

    For a = 1 all alike up to a disturbance cos(q n) at K = 2 / [5 (1 - cos q)].
    """

    K: jax.Array
    a: jax.Array = eqx.field(default_factory=lambda: jnp.ones(()))

    def rate(self, t, left, own, right):
        x, y = own
        R = x**2 + y**2
        dx, dy = (0.5 * (a + b) - c for a, b, c in zip(left, right, own, strict=True))
        return (
            self.a * x - 2 * y - R * (x + y) + self.K * (dx - 2 * dy),
            self.a * y + 2 * x - R * (y - x) + self.K * (dy + 2 * dx),
        )


def rotation(n, s, way=1):
    return (s + way * np.arange(n)) % n


def dihedral(n):
    return [rotation(n, s, way) for s in range(n) for way in (1, -1)]


def branches_of(cells, n, start, bounds, symmetry=None):
    """(branch of cycles that are all alike, or so, [(point, symmetry, side, other branch)])."""
    kept = symmetry or (0,) * n
    cycle = find_limit_cycle(cells, start, images=kept, mass=0)
    branch = continue_cycle(
        cycle, parameter="K", direction=-1, bounds=bounds, images=kept, max_step=0.1
    )
    found = []
    for point in branch.of_kind("symmetry breaking"):
        for i, symmetry in enumerate(point.symmetries):
            for side in (1, -1):
                other = switch_cycle(branch, point, symmetry=i, side=side, step=0.05, max_points=3)
                found.append((point, symmetry, side, other))
    return branch, found


def apart(one, other):
    """The least distance of two patterns under rotations and reflections."""
    return min(np.max(np.abs(one[at] - other)) for at in dihedral(len(one)))


def check_different(found):
    """None is a copy of another one but the halves that are said to be."""
    ends = [(symmetry, side, other.amplitude[0]) for _, symmetry, side, other in found]
    for k, (symmetry, side, pattern) in enumerate(ends):
        assert np.ptp(pattern) > 1e-2
        for other, other_side, another in ends[:k]:
            if other is symmetry and symmetry.mirrored:
                assert (side, other_side) == (-1, 1)
                # The other half at a distance that differs by the next order.
                assert apart(pattern, another) < 0.2 * np.ptp(pattern)
            else:
                assert apart(pattern, another) > 1e-3


def check_ring(found, crossings):
    for point, symmetry, _, other in found:
        assert min(abs(point.parameter - K) for K in crossings) < 1e-9
        assert point.error < 1e-9
        assert other.symmetry == symmetry.label
        # A cycle of this model turns like a rigid body: z_n(t) = z_n(0) exp(i omega t).
        for x, y, period, K in zip(*other.state, other.period, other.parameter, strict=True):
            z, omega = x + 1j * y, 2 * np.pi / period
            mean = 0.5 * (np.roll(z, 1) + np.roll(z, -1))
            rate = (1 + 2j) * z - (1 - 1j) * abs(z) ** 2 * z + K * (1 + 2j) * (mean - z)
            np.testing.assert_allclose(rate, 1j * omega * z, atol=1e-8)
            images = np.array(symmetry.images)
            np.testing.assert_allclose(z, z[images], atol=1e-12)
            if symmetry.shift is not None:  # a shift of T / k turns it by 2 pi / k
                motion, k = symmetry.shift
                later = z[np.array(motion)] * np.exp(2j * np.pi / k)
                np.testing.assert_allclose(later, z, atol=1e-8)


@pytest.mark.long
def test_a_ring_of_six_has_two_kinds_of_axes():
    start = (jnp.ones(6), jnp.zeros(6)), 2 * np.pi / 3
    branch, found = branches_of(Ring(jnp.asarray(0.83)), 6, start, (0.15, 0.85))
    check_ring(found, [2 / (5 * (1 - np.cos(2 * np.pi * k / 6))) for k in range(1, 4)])
    check_different(found)
    kinds = [sorted((s.label, s.mirrored) for s in point.symmetries) for point in branch.special]
    axes = [("D1 (axis between masses)", True), ("D1 (axis through mass 0)", True)]
    assert kinds == [axes, [("D2", False)], [("D3", True)]]


def wave(n, p, K):
    """(start, its period) of z_n = r exp(i omega t + 2 i pi p n / n), a solution of `Ring`."""
    c = np.cos(2 * np.pi * p / n)
    R, turned = 1 + K * (c - 1), np.exp(2j * np.pi * p * np.arange(n) / n)
    z, omega = np.sqrt(R) * turned, 2 + R + 2 * K * (c - 1)
    return (jnp.asarray(z.real), jnp.asarray(z.imag)), 2 * np.pi / omega


def multipliers(n, p, K):
    """Those of `wave`, of disturbances z (a exp(i q n) + b* exp(-i q n)) of z."""
    angle, (_, period) = 2 * np.pi * p / n, wave(n, p, K)
    c, rates = np.cos(angle), []
    R = 1 + K * (c - 1)
    for q in 2 * np.pi / n * np.arange(n):
        ahead, back = (K * (np.cos(q + s * angle) - c) for s in (1, -1))
        own = [[-(1 - 1j) * R] * 2, [-(1 + 1j) * R] * 2]
        rates += [*np.linalg.eigvals(own + np.diag([(1 + 2j) * ahead, (1 - 2j) * back]))]
    others = np.delete(rates, np.argmin(np.abs(rates)))  # 0 along the orbit
    return np.exp(others * period)


@pytest.mark.long
def test_a_rotating_wave_of_six_loses_half_of_its_shifts():
    # Of a disturbance (-1)^n: -2 c K (1 + 2 i), which has a zero eigenvalue at K = 1 / (1 + 4 c).
    cells = Ring(jnp.asarray(0.36))
    start = wave(6, 1, 0.36)
    symmetry = cycle_symmetry(cells, *start)
    assert symmetry == ("Z6, T/6", tuple(range(6)), False, ((5, 0, 1, 2, 3, 4), 6))
    branch, found = branches_of(cells, 6, start, (0.3, 0.38), symmetry)
    assert branch.symmetry == "Z6, T/6"
    for row, K in zip(branch.amplitude, branch.parameter, strict=True):
        np.testing.assert_allclose(row, np.sqrt(1 - 0.5 * K), rtol=1e-8)
    (point,) = branch.of_kind("symmetry breaking")
    ((label, images, mirrored, shift),) = point.symmetries
    assert (label, images, mirrored) == ("Z3, T/3", tuple(range(6)), True)
    assert shift == ((4, 5, 0, 1, 2, 3), 3)
    check_ring(found, [1 / 3])
    # Of a period, from a sixth of it.
    gaps = np.abs(branch.multipliers[0][:, None] - multipliers(6, 1, 0.36))
    assert max(np.max(np.min(gaps, axis=axis)) for axis in (0, 1)) < 1e-7
    # In two numbers: K is proportional to a.
    data = continue_special(point, second="a", max_points=5).to_dataset()
    assert np.ptp(data.a.values) > 0.3
    np.testing.assert_allclose(data.K, data.a / 3, rtol=1e-9)
    # Six turns of a cycle that is all alike close after one of them.
    (alike, period), how = wave(6, 0, 0.36), {"images": symmetry, "mass": 0, "throw": False}
    found = find_limit_cycle(cells, (alike, 6 * period), **how)
    assert found.result == SearchResult.other_kind


def test_in_a_ring_of_three_two_may_be_half_a_period_apart():
    """They swing against each other and the third is at rest: omega^2 = k + 3 eta."""
    x = jnp.array([0.0, 1.0, -1.0])
    ring = LinearRing(
        damping=jnp.zeros(3), stiffness=jnp.ones(3), springs=Springs(jnp.asarray(0.2), "cyclic"),
        x0=x, v0=0.0 * x,
    )  # fmt: skip
    found = cycle_symmetry(ring, (x, 0.0 * x), 2 * np.pi / 1.6**0.5)
    assert (found.images, found.shift) == ((0, 1, 2), ((0, 2, 1), 2))


def test_subgroups_of_a_ring_one_of_each_class():
    motions, alike = dihedral(4), (0, 0, 0, 0)
    less = {label_of(motions, *kept): kept for kept in finer(motions, alike)}
    assert less == {
        "Z1": ((0, 1, 2, 3), None),
        "D1 (axis through mass 0)": ((0, 1, 2, 1), None),
        "D1 (axis between masses)": ((0, 0, 2, 2), None),
        "D2": ((0, 1, 0, 1), None),
    }
    assert len(finer(dihedral(5), (0,) * 5)) == 2
    assert label_of(dihedral(4), alike) == "D4"
    # An antiphase state, however its masses are counted.
    for images in ((0, 1, 0, 1), (0, 3, 0, 3)):
        less = {
            label_of(motions, *kept): kept for kept in finer(motions, images, ((1, 0, 3, 2), 2))
        }
        assert less.pop("D2") == (images, None)
        assert less == {
            "Z1": ((0, 1, 2, 3), None),
            "D1 (axis through mass 0)": ((0, 1, 2, 1), None),
            "D1 (axis between masses), T/2": ((0, 1, 2, 3), ((1, 0, 3, 2), 2)),
        }
    # One mass differs: a reflection is left, and what it leaves unchanged.
    mirror = [np.arange(4), rotation(4, 0, -1)]
    assert finer(mirror, (0, 1, 2, 1)) == [((0, 1, 2, 3), None)]
    v = np.array([[0.0, 1.0, 0.0, -1.0], np.zeros(4)]) / np.sqrt(2)
    assert isotropy(mirror, (0, 1, 2, 1), v) == (((0, 1, 2, 3), None), True)


def test_a_symmetry_must_hold_at_every_phase_of_the_force():
    class Waves(AbstractCells):
        height: jax.Array

        def rate(self, t, left, own, right):
            x, v = own
            return v, self.height * jnp.sin(t) - x - 0.1 * v + left[0] - 2 * x + right[0]

        def forcing_period(self):
            return 2 * jnp.pi

    state = (jnp.zeros(4), jnp.zeros(4))
    assert len(ring_motions(Waves(jnp.ones(4)), state)) == 8
    assert len(ring_motions(Waves(jnp.array([1.0, 1.0, 1.0, 2.0])), state)) == 2
