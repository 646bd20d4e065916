"""Curves of special points against closed forms, SciPy and single searches."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain import (
    ExponentialDecay,
    StickTime,
    continue_cycle,
    continue_special,
    equation_8,
    find_limit_cycle,
    fold_belt_speed,
    paper_chain,
    simulate,
    steady_sliding,
)
from jaxchain.boundaries import find_fold, find_hopf_point, find_special_cycle, special_curves
from jaxchain.model import AbstractCells, Duffing, GaussianStribeck, MechanicalCells

# The generalised Hopf point of one mass of the paper at width 0.05: (belt speed, damping ratio).
MEETING = 0.268344380439181, 0.291637020981561


class BogdanovTakens(AbstractCells):
    """x' = y, y' = a + b x + x^2 - x y: Hopf points x = 0 at a = 0 of frequency sqrt(-b)."""

    a: jax.Array
    b: jax.Array

    def rate(self, t, left, own, right):
        x, y = own
        return y, self.a + self.b * x + x**2 - x * y


class Driven(AbstractCells):
    """z' = (1 + i (3 + delta) - |z|^2) z + F exp(3 i t): cycles of constant R = |z|^2.

    F^2 = R [(1 - R)^2 + delta^2]; a torus where R = 1/2 and delta > 1/2, of the frequency
    (delta^2 - 1/4)^(1/2); a fold where 3 R^2 - 4 R + 1 + delta^2 = 0.
    """

    delta: jax.Array
    force: jax.Array

    def forcing_period(self):
        return 2 * np.pi / 3.0

    def rate(self, t, left, own, right):
        x, y = own
        grows, frequency = 1.0 - x**2 - y**2, 3.0 + self.delta
        return (
            grows * x - frequency * y + self.force * jnp.cos(3.0 * t),
            grows * y + frequency * x + self.force * jnp.sin(3.0 * t),
        )


def numbers(*values):
    return tuple(map(jnp.asarray, values))


def at_rest(m):
    return (jnp.zeros(1),) * m


def fold_of(chain):
    return continue_cycle(find_limit_cycle(chain)).of_kind("fold")[0]


@pytest.mark.long
def test_hopf_points_end_where_their_frequency_is_zero(monkeypatch):
    """An interrupted curve says so, and does not go on in the other direction."""
    point = find_hopf_point(BogdanovTakens(*numbers(0.05, -1.0)), "a", at_rest(2))
    curve = continue_special(point, "b", bounds={"b": (-2, 2)})
    assert curve.ended == ("left_bounds", "Bogdanov-Takens")
    assert curve.second[0] == -2.0
    np.testing.assert_allclose(curve.first, 0.0, atol=1e-12)
    np.testing.assert_allclose(curve.period[:-1], 2 * np.pi / np.sqrt(-curve.second[:-1]))
    (end,) = curve.of_kind("Bogdanov-Takens")
    assert (end.first, end.second) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert end.index == len(curve.first) - 2

    def interrupt(count, point):
        if count == 5:
            raise KeyboardInterrupt

    follow = partial(special_curves.continue_branch, progress=interrupt)
    monkeypatch.setattr(special_curves, "continue_branch", follow)
    curve = continue_special(point, "b", bounds={"b": (-2, 2)})
    assert (curve.ended, len(curve.second)) == (("interrupted", "interrupted"), 5)
    assert "Interrupted from the keyboard" in curve.message
    with pytest.raises(KeyboardInterrupt):
        continue_special(point, "b", bounds={"b": (-2, 2)}, keep_part=False)


def test_the_hopf_curve_of_a_chain_has_its_speeds_slopes_and_generalised_hopf_point():
    chain = paper_chain(1, width=0.05)
    point = find_hopf_point(chain, "belt_speed", at_rest(2))
    bounds = {"belt_speed": (0.2, 1.3), "damping_ratio": (0.01, 1.0)}
    curve = continue_special(point, "damping_ratio", bounds=bounds)
    assert curve.ended == ("left_bounds", "left_bounds")
    assert sorted(curve.first[[0, -1]]) == pytest.approx([0.2, 1.3], abs=1e-9)

    def slope(v):  # of mu tanh
        direction, mu = np.tanh(v / 0.05), 0.5 + 0.5 * np.exp(-2 * v)
        return -np.exp(-2 * v) * direction + mu * (1 - direction**2) / 0.05

    np.testing.assert_allclose(curve.second, -slope(curve.first) / 2, atol=1e-9)
    (meeting,) = curve.of_kind("generalised Hopf")
    assert (meeting.first, meeting.second) == pytest.approx(MEETING, abs=1e-10)
    assert curve.second[meeting.index] < meeting.second < curve.second[meeting.index + 1]
    # From beyond that point, which then lies behind the start.
    beyond = chain.with_(belt_speed=0.25, damping_ratio=0.3)
    point = find_hopf_point(beyond, "belt_speed", at_rest(2))
    curve = continue_special(point, "damping_ratio", bounds=bounds)
    (meeting,) = curve.of_kind("generalised Hopf")
    assert curve.second[meeting.index] < meeting.second < curve.second[meeting.index + 1]
    # There mu tanh has no third derivative, and the Lyapunov coefficient changes its sign.
    h = 1e-3
    third = (slope(MEETING[0] + h) - 2 * slope(MEETING[0]) + slope(MEETING[0] - h)) / h**2
    assert third == pytest.approx(0.0, abs=1e-3)
    with pytest.raises(RuntimeError, match="No Hopf point in `belt_speed` was found near `guess`"):
        find_hopf_point(chain.with_(damping_ratio=9.0), "belt_speed", at_rest(2))


class Slaved(AbstractCells):
    """z' = (a + i) z + b |z|^2 z with y' = c y + R, so that y = -R / c along changes l1."""

    a: jax.Array
    b: jax.Array
    c: jax.Array

    def rate(self, t, left, own, right):
        x, v, y = own
        R = x**2 + v**2
        grows = self.a + self.b * R + y
        return grows * x - v, grows * v + x, self.c * y + R


@pytest.mark.long
def test_the_lyapunov_coefficient_of_several_numbers_is_that_of_the_normal_form():
    """2 (b - 1 / c) jumps through infinity at c = 0, and is zero at c = 1 / b alone.

    Modes that cross together have none.
    """
    chain = paper_chain(3)
    point = find_hopf_point(chain, "belt_speed", steady_sliding(chain), frequency=1.03**0.5)
    assert np.isnan(point.lyapunov_coefficient)
    for b, c in ((-1.0, -4.0), (-1.5, -0.5)):
        point = find_hopf_point(Slaved(*numbers(0.1, b, c)), "a", at_rest(3))
        # z = sqrt(2) w in the coordinates of <q, q> = 1, and R = 2 |w|^2.
        assert float(point.lyapunov_coefficient) == pytest.approx(2.0 * (b - 1 / c), rel=1e-12)
    curve = continue_special(point, "c", bounds={"c": (-1.0, 1.0)}, max_step=0.2)
    (zero,) = curve.of_kind("generalised Hopf")
    assert zero.second == pytest.approx(-1.0 / 1.5, abs=1e-9)
    assert np.isfinite(zero.error)


def smooth_orbit(chain, v, state, period, sign=-1.0):
    """SciPy's slip cycle of one mass: (gaps, greatest w, the multiplier by Liouville)."""
    law, xi = chain.law, float(chain.damping_ratio)

    def rate(t, y):
        s = sign * (y[1] - v)
        mu, slope = (float(f(s)) for f in (law.coefficient, jax.grad(law.coefficient)))
        return [y[1], -2 * xi * y[1] - y[0] - sign * mu, -2 * xi - slope]

    run = solve_ivp(
        rate, (0.0, period), [*state, 0.0], method="DOP853", rtol=1e-12, atol=1e-13, max_step=0.1
    )
    return run.y[:2, -1] - state, np.max(run.y[1]) - v, np.exp(run.y[2, -1])


@pytest.mark.long
def test_a_dry_fold_curve_passes_from_grazing_to_smooth_folds():
    chain = paper_chain(1, friction=GaussianStribeck(1.0, 0.5, 0.5, 0.0))
    curves = [
        continue_special(find_fold(chain.with_(v_ref=v)), "v_ref", bounds={"v_ref": (0.5, 1.3)})
        for v in (0.6, 1.1)
    ]
    assert [curve.kind for curve in curves] == ["grazing fold", "fold"]
    meetings = [curve.of_kind("degenerate grazing")[0] for curve in curves]
    assert meetings[0].second == pytest.approx(meetings[1].second, abs=1e-10)
    assert meetings[0].first == pytest.approx(meetings[1].first, abs=1e-10)
    for curve in curves:
        assert curve.ended == ("left_bounds", "left_bounds")
        grazes = [kind == "grazing fold" for kind in curve.kinds]
        away = np.abs(curve.second - meetings[0].second) > 1e-9
        assert np.array_equal(np.array(grazes)[away], (curve.second < meetings[0].second)[away])
        folds = jax.vmap(lambda q: fold_belt_speed(chain.with_(v_ref=q)))(curve.second)
        np.testing.assert_allclose(curve.first, folds, atol=1e-9)
        for k in (0, len(grazes) // 2, -1):
            there, state = chain.with_(v_ref=curve.second[k]), [p[k, 0] for p in curve.state]
            gaps, highest, multiplier = smooth_orbit(there, curve.first[k], state, curve.period[k])
            np.testing.assert_allclose(gaps, 0.0, atol=1e-9)
            assert highest == pytest.approx(0.0, abs=1e-9) if grazes[k] else highest < -1e-3
            assert multiplier > 1.01 if grazes[k] else multiplier == pytest.approx(1, abs=1e-7)
    # There the cycle that grazes has the multiplier 1.
    u = meetings[0].unknowns
    there = chain.with_(v_ref=meetings[0].second)
    _, highest, multiplier = smooth_orbit(there, meetings[0].first, u[:2], u[2])
    assert (highest, multiplier) == pytest.approx((0.0, 1.0), abs=1e-8)
    assert curves[0].to_dataset().point_kind.values.tolist() == list(curves[0].kinds)


@pytest.mark.long
def test_a_curve_ends_with_the_name_of_the_number_that_vanishes(dry_fold):
    """The amplitude of a slip cycle is about the belt speed."""
    curve = continue_special(dry_fold, "mu_dynamic")
    assert curve.ended == ("mu_dynamic = 0", "belt_speed = 0")
    assert "It ends where belt_speed = 0." in curve.message
    assert 0.0 <= curve.first[-1] < 1e-6
    assert np.all(curve.first[:-1] > 0)
    assert np.all(curve.second >= 0)
    assert not curve.special  # what is seen at a belt speed of 1e-8 is rounding
    some = curve.second[5:-5:7]
    folds = jax.jit(jax.vmap(lambda q: fold_belt_speed(dry_fold.chain.with_(mu_dynamic=q))))(some)
    np.testing.assert_allclose(curve.first[5:-5:7], folds, atol=1e-9)
    with pytest.raises(ValueError, match="`kind`"):
        find_special_cycle((dry_fold.state, dry_fold.period), dry_fold.chain, kind="fold", mass=0)
    smoothed = dry_fold.chain.with_(width=0.01)
    with pytest.raises(ValueError, match="needs dry friction"):
        find_special_cycle((dry_fold.state, dry_fold.period), smoothed, kind="release")
    with pytest.raises(ValueError, match="a search that failed"):
        continue_special(find_fold(dry_fold.chain.with_(damping_ratio=2.0)), "v_ref")


@pytest.mark.long
def test_at_a_release_the_force_just_reaches_the_static_limit():
    law = ExponentialDecay(1.0, 0.5, 0.5)
    cells = MechanicalCells(
        1.0, damping=0.1, friction=law, belt_speed=0.2, force=0.2, frequency=2.5
    )
    forcing_periods, step = 3, 2 * np.pi / 2.5
    settled = simulate(cells, (jnp.ones(1), jnp.zeros(1)), 60 * forcing_periods * step).state
    start = settled, forcing_periods * step
    point = find_special_cycle(start, cells, kind="release", mass=0, parameter="force")
    # SciPy's slip phase, then x grows linearly and r = F cos(omega t) - v_d / 10 - x.
    phases: Any = point.orbit
    assert [event for event, _, _ in phases.sequence] == ["landing", "turn", "release"]
    x, v, t, *lengths, force = map(float, point.unknowns)

    def rate(t, y):
        mu = 0.5 + 0.5 * np.exp(-(0.2 - y[1]) / 0.5)
        return [y[1], force * np.cos(2.5 * t) - 0.1 * y[1] - y[0] + mu]

    run = solve_ivp(rate, (t, t + lengths[0]), [x, v], method="DOP853", rtol=1e-12, atol=1e-13)
    landed, t = run.y[0, -1], t + lengths[0]
    assert run.y[1, -1] == pytest.approx(0.2, abs=1e-9)
    turn, end = t + lengths[1], t + lengths[1] + lengths[2]
    for time in (turn, end):
        r = force * np.cos(2.5 * time) - 0.02 - landed - 0.2 * (time - t)
        assert r == pytest.approx(-1.0, abs=1e-9)
    assert -2.5 * force * np.sin(2.5 * turn) == pytest.approx(0.2, abs=1e-9)
    assert (landed + 0.2 * (end - t), 0.2) == pytest.approx((x, v), abs=1e-9)


@pytest.mark.long
def test_another_mass_sticks_beyond_its_grazing_through_a_change_of_order():
    chain = paper_chain(2, width=None, belt_speed=0.6).with_(
        coupling=0.1, damping_ratio=jnp.array([0.05, 0.3])
    )
    cycle = find_limit_cycle(chain, simulate(chain, equation_8(chain, 1), 300.0), mass=0)
    point = find_special_cycle(cycle, kind="grazing", mass=1, parameter="coupling")
    # A belt that runs the other way.
    back = chain.with_(belt_speed=-0.6)
    other = tuple(-part for part in cycle.state), cycle.period
    mirrored = find_special_cycle(other, back, kind="grazing", mass=1, parameter="coupling")
    assert float(mirrored.value) == pytest.approx(float(point.value), abs=1e-10)
    curve = continue_special(point, "belt_speed", bounds={"belt_speed": (0.3, 2.0)})
    assert curve.ended == ("left_bounds", "another stick onset")
    # The peak of mass 1 comes before or after an event of mass 0.
    (swap,) = curve.of_kind("two events")
    for k in (swap.index - 2, swap.index + 3):
        there = chain.with_(belt_speed=curve.second[k])
        state = tuple(jnp.asarray(part[k]) for part in curve.state)
        for change, expected in ((-1e-4, False), (1e-4, True)):
            changed = there.with_(coupling=curve.first[k] + change)
            run = simulate(changed, state, 300.0)
            stuck = simulate(changed, run.state, 30.0, observe=StickTime()).observed
            assert bool(stuck[1] > 0) == expected


@pytest.mark.long
def test_folds_end_in_the_generalised_hopf_point():
    fold = fold_of(paper_chain(1, belt_speed=1.5, width=0.05))
    curve = continue_special(fold, "damping_ratio", bounds={"damping_ratio": (0.04, 1.0)})
    assert curve.ended == ("left_bounds", "generalised Hopf")
    assert (curve.first[-1], curve.second[-1]) == pytest.approx(MEETING, abs=1e-9)
    assert curve.amplitude[-1, 0] == 0.0
    # The amplitude falls with the square root of the distance, so the last folds lie close by.
    assert curve.amplitude[-2, 0] < 5e-3
    assert np.all(np.diff(curve.amplitude[:, 0]) < 0)
    again = curve.at(4)
    assert float(again.value) == pytest.approx(curve.first[4], abs=1e-10)
    with pytest.raises(ValueError, match="amplitude is 0"):
        curve.at(-1)
    data = curve.to_dataset()
    assert data.damping_ratio.attrs["units"] == "1"
    assert data.special_kind.values.tolist() == ["generalised Hopf"]
    assert data.attrs["ended_last"] == "generalised Hopf"


@pytest.mark.long
def test_folds_and_tori_of_driven_cells_are_those_of_the_closed_form():
    cells = Driven(*numbers(0.3, 1.2))
    cycle = find_limit_cycle(cells, (jnp.array([0.5]), jnp.zeros(1)))
    branch = continue_cycle(cycle, parameter="force", direction=-1, bounds=(0.1, 2.0))
    curve = continue_special(branch.of_kind("fold")[0], "delta", bounds={"delta": (0.1, 1.0)})
    R = np.sum([part[:, 0] ** 2 for part in curve.state], axis=0)
    np.testing.assert_allclose(3 * R**2 - 4 * R + 1 + curve.second**2, 0.0, atol=1e-8)
    np.testing.assert_allclose(curve.first**2, R * ((1 - R) ** 2 + curve.second**2), atol=1e-8)
    (cusp,), (meeting,) = curve.of_kind("cusp"), curve.of_kind("1:1")
    assert (cusp.first, cusp.second) == pytest.approx(((8 / 27) ** 0.5, 3**-0.5), abs=1e-9)
    assert (meeting.first, meeting.second) == pytest.approx((0.5, 0.5), abs=1e-9)

    cycle = find_limit_cycle(cells.with_(delta=0.8), (jnp.array([0.5]), jnp.zeros(1)))
    branch = continue_cycle(cycle, parameter="force", direction=-1, bounds=(0.2, 2.0))
    curve = continue_special(branch.of_kind("torus")[0], "delta", bounds={"delta": (0.1, 2.0)})
    assert sorted(curve.ended) == ["1:1", "left_bounds"]
    np.testing.assert_allclose(curve.first, np.sqrt((0.25 + curve.second**2) / 2), atol=1e-9)
    (end,) = curve.of_kind("1:1")
    assert (end.first, end.second) == pytest.approx((0.5, 0.5), abs=1e-9)
    angle = 2 * np.pi / 3  # of the frequency 1 after a period: multipliers exp(+-2 pi i / 3)
    assert curve.of_kind("1:3")[0].second == pytest.approx(
        (0.25 + (1.5 * angle / np.pi) ** 2) ** 0.5
    )
    # Slopes: F^2 = (1/4 + delta^2) / 2, so dF/d(delta) = delta / (2 F).
    p, q = curve.first[5], curve.second[5]
    slope = jax.grad(lambda d: curve.at(5, cells.with_(delta=d)).value)(q)
    assert float(slope) == pytest.approx(q / (2 * p), abs=1e-8)


@pytest.mark.long
def test_period_doublings_are_those_of_scipy():
    cells = Duffing(force=0.25, frequency=1.2, damping=0.3, stiffness=-1.0, cubic=1.0)
    cycle = find_limit_cycle(cells, (jnp.ones(1), jnp.zeros(1)))
    branch = continue_cycle(cycle, parameter="force", bounds=(0.2, 0.4))
    curve = continue_special(
        branch.of_kind("period doubling")[0], "frequency", bounds={"frequency": (1.0, 1.5)}
    )
    assert curve.ended == ("left_bounds", "left_bounds")
    for k in range(0, len(curve.first), 5):
        force, omega = curve.first[k], curve.second[k]

        def rate(t, y, force=force, omega=omega):
            x, v, *M = y
            a, b, c, d = M
            pull = 1.0 - 3.0 * x**2
            drive = force * np.cos(omega * t) - 0.3 * v + x - x**3
            return [v, drive, b, pull * a - 0.3 * b, d, pull * c - 0.3 * d]

        start = [part[k, 0] for part in curve.state]
        end = solve_ivp(
            rate, (0.0, 2 * np.pi / omega), [*start, 1, 0, 0, 1], method="DOP853", rtol=1e-12,
            atol=1e-13,
        ).y[:, -1]  # fmt: skip
        np.testing.assert_allclose(end[:2], start, atol=1e-9)
        multipliers = np.linalg.eigvals(end[2:].reshape(2, 2))
        assert np.min(abs(multipliers + 1.0)) < 1e-8
