"""Branches of dry cycles: SciPy with events, closed forms, and searches for single cycles."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq, fsolve
from witnesses.cells import Events

from jaxchain import (
    Chain,
    Coulomb,
    ExponentialDecay,
    StaticKinetic,
    continue_cycle,
    continue_special,
    equation_8,
    find_limit_cycle,
    hopf_belt_speed,
    paper_chain,
    simulate,
)
from jaxchain.boundaries import find_special_cycle
from jaxchain.cycles import branches
from jaxchain.cycles.sequences import _consistent, _Part
from jaxchain.model import MechanicalCells

LAW = ExponentialDecay(1.0, 0.5, 0.5)
# By shooting with SciPy, see tests/boundaries/test_grazing.py.
DRY_FOLD = 1.836600972208


def forced(frequency=0.9, force: Any = 1.5):
    """x'' + x'/10 + x + sign x' = F cos(omega t)."""
    return MechanicalCells(
        1.0, damping=0.1, friction=Coulomb(1.0), force=force, frequency=frequency
    )


def scipy_at(model, branch, k):
    """(state a period later, half amplitude, releases) of point k by SciPy, and that state."""
    witness = Events(model.with_(**{branch.name: branch.parameter[k]}))
    start = np.concatenate([part[k] for part in branch.state])
    end, high, low, releases = witness.run(start, branch.period[k])
    return end, (high - low) / 2, releases, start


def test_a_branch_goes_from_sticking_over_the_fold_to_the_hopf_point(dry_branch):
    """The derivative of mu is -2 xi at the Hopf point: v = ln(10) / 2."""
    branch = dry_branch
    assert [point.kind for point in branch.special] == ["grazing fold", "hopf"]
    fold, hopf = branch.special
    assert fold.parameter == pytest.approx(DRY_FOLD, abs=1e-11)
    assert hopf.parameter == pytest.approx(np.log(10) / 2, abs=1e-10)
    assert fold.refined
    assert hopf.refined
    assert abs(hopf.parameter - np.log(10) / 2) < hopf.error < 1e-8
    sticks = np.arange(len(branch.parameter)) <= fold.index
    np.testing.assert_array_equal(branch.scaled_peak_velocity, np.where(sticks, 0.0, -np.inf))
    np.testing.assert_array_equal(branch.unstable, np.where(sticks, 0, 1))
    assert np.all(branch.multipliers[sticks] == 0)  # exactly
    assert branch.ended == "stopped"
    assert "amplitude vanishes" in branch.message
    turn = np.argmax(branch.parameter)
    assert abs(turn - fold.index) <= 1
    assert hopf.index == len(branch.parameter) - 1
    assert np.all(np.diff(branch.parameter[: turn + 1]) > 0)
    assert np.all(np.diff(branch.parameter[turn + 1 :]) < 0)
    data = branch.to_dataset()
    assert data.special_kind.values.tolist() == ["grazing fold", "hopf"]
    np.testing.assert_array_equal(data.stable, branch.unstable == 0)
    assert data.attrs["ended"] == "stopped"


def test_without_its_stick_a_mass_goes_on_to_the_other_side():
    """Behind the belt, stick, ahead of it, stick: the first stick is gone."""
    modes, events = (-1.0, 0.0, 1.0, 0.0), ("landing", "release") * 2
    signs = (1.0, 1.0, -1.0, -1.0)
    parts = [
        _Part((mode,), 1.0, ((event, 0, sign),))
        for mode, event, sign in zip(modes, events, signs, strict=True)
    ]
    left = [parts[k] for k in (0, 2, 3)]
    assert _consistent(left, parts, {(1, 0)}) == left


def test_each_point_is_the_cycle_that_a_search_finds_and_scipy_runs(dry_branch):
    branch, cells = dry_branch, MechanicalCells(1.0, damping=0.1, friction=LAW, belt_speed=0.2)
    for share in (0.0, 0.6, 0.93):
        k = int(share * len(branch.parameter))
        end, half, _, start = scipy_at(cells, branch, k)
        # Slip cycles multiply errors.
        np.testing.assert_allclose(end, start, atol=1e-10, err_msg=str(share))
        np.testing.assert_allclose(half, branch.amplitude[k, 0], rtol=1e-9)
        state = tuple(jnp.asarray(part[k]) for part in branch.state)
        there = paper_chain(1, branch.parameter[k], None)
        found = find_limit_cycle(there, (state, branch.period[k]))
        np.testing.assert_allclose(found.period, branch.period[k], rtol=1e-11)
        np.testing.assert_allclose(found.amplitude, branch.amplitude[k], rtol=1e-9)
        np.testing.assert_allclose(found.multipliers, branch.multipliers[k], atol=1e-7)


def onset_gaps(z, force, omega):
    """Of (x, F cos(phi), F sin(phi)) at the beginning of a half period of sliding."""
    A = np.zeros((5, 5))  # of (x, v, F cos, F sin, 1)
    A[0, 1], A[1] = 1.0, [-1.0, -0.1, 1.0, 0.0, 1.0]
    A[2, 3], A[3, 2] = -omega, omega
    y = expm(A * np.pi / omega) @ [z[0], 0.0, z[1], z[2], 1.0]
    return [y[0] + z[0], y[1], z[1] - z[0] + 1.0, np.hypot(z[1], z[2]) - force]


@pytest.mark.long
def test_static_and_kinetic_friction_vibrate_up_to_where_a_release_just_returns_to_the_belt():
    """By the matrix exponential from the release, x = mu_s - 2 xi v_d, v = v_d."""
    mu_s, mu_k, xi = 1.1, 0.5, 0.05
    chain = Chain(1, StaticKinetic(mu_s, mu_k), 0.3, xi)
    A = np.array([[0.0, 1.0], [-1.0, -2 * xi]])

    def after(t, speed):  # x - mu_k and v
        return expm(A * t) @ [mu_s - 2 * xi * speed - mu_k, speed]

    # v = v_d and v' = 0 again.
    def grazes(z):
        return after(z[1], z[0])[1] - z[0], A[1] @ after(z[1], z[0])

    at: Any = fsolve(grazes, (0.66, 5.8))
    branch = continue_cycle(find_limit_cycle(chain))
    fold, *_ = branch.special
    assert fold.kind == "fold"
    assert fold.parameter == pytest.approx(at[0], abs=1e-10)
    slip = brentq(lambda t: after(t, 0.3)[1] - 0.3, 3.0, 5.5, xtol=1e-14)
    stuck = (mu_s - mu_k - 2 * xi * 0.3 - after(slip, 0.3)[0]) / 0.3
    assert float(branch.period[0]) == pytest.approx(slip + stuck, abs=1e-9)
    assert np.isnan(hopf_belt_speed(chain))  # sliding is stable at every speed


@pytest.mark.long
def test_a_forced_response_gains_two_stops_at_an_onset():
    """The onset from the matrix exponential; it slides for half a period up to there."""
    period = 2 * np.pi / 0.9
    settled, high, low, _ = Events(forced()).run([0.0, 0.0], 42 * period)
    _, high, low, _ = Events(forced()).run(settled, period)
    assert (high - low) / 2 == pytest.approx(2.42023635, abs=5e-9)
    state = tuple(jnp.asarray(settled)[:, None])
    how = {"parameter": "frequency", "direction": -1, "bounds": (0.7, 2.0)}
    branch = continue_cycle(forced(), state, period, **how)
    assert branch.amplitude[0, 0] == pytest.approx((high - low) / 2, abs=1e-9)
    (onset,) = branch.special
    assert onset.kind == "stick onset"
    for k in (onset.index, -1):
        end, half, releases, start = scipy_at(forced(), branch, k)
        assert len(releases) == (0 if k == onset.index else 2)
        np.testing.assert_allclose(end, start, atol=1e-9)
        np.testing.assert_allclose(half, branch.amplitude[k, 0], atol=1e-9)
    assert branch.parameter[-1] == 0.7
    assert branch.ended == "left_bounds"
    # Den Hartog's limit: it is followed in a second number.
    curve = continue_special(onset, "force", max_points=4)
    assert np.ptp(curve.second) > 0.01
    z: Any = [2.0, 1.0, -1.1, onset.parameter + 1e-3]
    for k in np.argsort(np.abs(curve.second - 1.5)):  # from the known one on
        omega, force, guess = curve.first[k], curve.second[k], z
        z = fsolve(lambda z, F=force: onset_gaps(z[:3], F, z[3]), guess, xtol=1e-13)
        assert omega == pytest.approx(z[3], abs=1e-9), force


def at_start(branch, **numbers):
    """(the model, the state and period of the first cycle of a branch)."""
    chain = paper_chain(1, branch.parameter[0], None).with_(**numbers)
    return chain, tuple(jnp.asarray(part[0]) for part in branch.state), branch.period[0]


@pytest.mark.long
def test_a_branch_ends_where_a_parameter_leaves_its_domain_or_the_belt_stops(dry_branch):
    start = at_start(dry_branch)
    branch = continue_cycle(*start, parameter="mu_dynamic", direction=-1)
    assert (branch.ended, branch.parameter[-1]) == ("stopped", 0.0)
    assert "mu_dynamic = 0, the end of its domain" in branch.message
    assert np.all(np.isfinite(branch.amplitude))
    cut = continue_cycle(*start, parameter="mu_dynamic", direction=-1, bounds=(0.2, 1.0))
    assert (cut.ended, cut.parameter[-1]) == ("left_bounds", 0.2)
    branch = continue_cycle(*start, direction=-1)
    assert branch.ended == "belt_speed = 0"
    assert not branch.special
    assert 0 < branch.parameter[-1] < 0.02


def test_special_points_and_events_of_ones_own_are_found_and_followed(dry_branch):
    own = {"high": lambda c: c.amplitude[0] - 1.5, "fast": lambda c: c.multipliers[0].real - 1.8}
    branch = continue_cycle(*at_start(dry_branch), events=own)
    high, fast = branch.of_kind("high"), branch.of_kind("fast")
    assert len(high) == 2  # as it sticks, and as it slides
    for point in high:
        np.testing.assert_allclose(point.amplitude, 1.5, atol=1e-9)
        assert point.refined
        assert point.error < 1e-8
    assert fast
    assert all(abs(point.multipliers[0] - 1.8) < 1e-6 for point in fast)
    curve = continue_special(high[0], "damping_ratio", max_points=4)
    assert np.ptp(curve.second) > 1e-3
    np.testing.assert_allclose(curve.amplitude[:, 0], 1.5, atol=1e-9)
    with pytest.raises(ValueError, match="uses more of a cycle than `state`, `period`"):
        continue_special(fast[0], "damping_ratio")
    with pytest.raises(ValueError, match="must have names of its own"):
        continue_cycle(*at_start(dry_branch), events={"fold": own["high"]})


@pytest.mark.long
def test_period_doublings_of_dry_cycles_are_those_of_scipy():
    """x'' + c x' - x + x^3 + mu sign x' = F cos t: 1 + tr M + det M = 0, by differences."""
    model = MechanicalCells(
        -1.0, damping=0.25, local_force=lambda x, v: (-(x[0] ** 3),), friction=Coulomb(0.02),
        force=0.2, frequency=1.0,
    )  # fmt: skip
    start = simulate(model, (jnp.ones(1), jnp.zeros(1)), 160 * np.pi)
    branch = continue_cycle(find_limit_cycle(model, start), parameter="force", bounds=(0.1, 0.6))
    curve = continue_special(branch.of_kind("period doubling")[0], "damping", max_points=4)
    assert curve.kind == "period doubling"
    assert len(curve.first) == 7
    for k in (0, 3, -1):

        def run(y: Any, t0: Any, t1, force=curve.first[k], damping=curve.second[k]):
            while t0 < t1:  # from one reversal to the next, where it does not stick
                push = force * np.cos(t0) + y[0] - y[0] ** 3
                sign = np.sign(y[1]) if abs(y[1]) > 1e-10 else np.sign(push)

                def rate(t, y, sign=sign) -> Any:
                    x, v = y
                    return [v, force * np.cos(t) + x - x**3 - damping * v - 0.02 * sign]

                def reversal(t, y) -> Any:
                    return y[1]

                stop: Any = reversal
                stop.terminal, stop.direction = True, -sign
                step: Any = solve_ivp(
                    rate, (t0, t1), y, method="DOP853", rtol=1e-12, atol=1e-13, events=stop
                )
                t0, y = step.t[-1], step.y[:, -1]
            return y

        t0 = curve.unknowns[k][2]
        y = run(np.array([part[k][0] for part in curve.state]), t0, t0 + 0.5)
        t0, t1 = t0 + 0.5, t0 + 0.5 + 2 * np.pi
        np.testing.assert_allclose(run(y, t0, t1), y, atol=1e-8)
        shifts = 1e-5 * np.eye(2)
        M = np.array([(run(y + d, t0, t1) - run(y - d, t0, t1)) / 2e-5 for d in shifts]).T
        assert 1 + np.trace(M) + np.linalg.det(M) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.long
def test_tori_of_dry_cycles_have_multipliers_on_the_unit_circle():
    """The multipliers of single searches, which differentiate an event-driven run."""
    chain = paper_chain(3, belt_speed=1.5, width=None)
    cycle = find_limit_cycle(chain, simulate(chain, equation_8(chain, 1), 3000.0))
    point = continue_cycle(cycle, direction=-1, bounds=(1.36, 2.0)).of_kind("torus")[0]
    curve = continue_special(point, "coupling", max_points=4)
    for k in (0, 2, -2):
        there = chain.with_(belt_speed=curve.first[k], coupling=curve.second[k])
        state = tuple(jnp.asarray(part[k]) for part in curve.state)
        mu = find_limit_cycle(there, (state, curve.period[k])).multipliers
        assert np.min(np.abs(np.abs(mu[np.imag(mu) > 0]) - 1.0)) < 1e-7

    def speed(damping):
        return find_special_cycle(point, chain.with_(damping_ratio=damping)).value

    slope = jax.grad(speed)(jnp.asarray(0.05))
    near = [float(speed(0.05 + step)) for step in (1e-5, -1e-5)]
    assert float(slope) == pytest.approx((near[0] - near[1]) / 2e-5, rel=1e-6)


def test_a_branch_ends_as_asked_and_keeps_what_it_has(dry_branch, monkeypatch):
    k = dry_branch.of_kind("grazing fold")[0].index - 4
    chain = paper_chain(1, dry_branch.parameter[k], None)
    start = chain, tuple(jnp.asarray(part[k]) for part in dry_branch.state), dry_branch.period[k]
    some = continue_cycle(*start, max_points=9)
    assert (some.ended, len(some.parameter)) == ("max_points", 9)
    assert some.of_kind("grazing fold")[0].parameter == pytest.approx(DRY_FOLD, abs=1e-11)
    stopped = continue_cycle(*start, stop=lambda p, cycle: bool(cycle.speed < 1.5))
    assert (stopped.ended, stopped.of_kind("hopf")) == ("stopped", ())

    def interrupt(count, point):
        if point.extra.speed < 1.5:
            raise KeyboardInterrupt

    part = continue_cycle(*start, progress=interrupt)
    assert part.ended == "interrupted"
    assert part.of_kind("grazing fold")

    def pressed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(branches, "change_at", pressed)  # between two sequences of phases
    cut = continue_cycle(*start)
    assert (cut.ended, cut.special) == ("interrupted", ())


TWO = MechanicalCells([[1.0, 0.3], [0.3, 2.0]], damping=0.1, friction=LAW, belt_speed=0.5)


@pytest.mark.long
@pytest.mark.parametrize("width", [None, 0.01])
def test_special_cycles_of_ones_own_and_onsets_have_derivatives(width):
    chain = paper_chain(1, belt_speed=1.2, width=width)
    own = {"high": lambda c: c.amplitude[0] - 1.5}
    high = continue_cycle(find_limit_cycle(chain), events=own).of_kind("high")[0]

    def speed(damping):
        return find_special_cycle(high, chain.with_(damping_ratio=damping)).value

    slope = jax.grad(speed)(jnp.asarray(0.05))
    near = [float(speed(0.05 + step)) for step in (1e-5, -1e-5)]
    assert float(slope) == pytest.approx((near[0] - near[1]) / 2e-5, rel=1e-6)


@pytest.mark.long
def test_a_cell_of_two_displacements_is_scipys_along_its_branch():
    start = simulate(TWO, tuple(jnp.zeros((4, 1))), 400.0)
    branch = continue_cycle(find_limit_cycle(TWO, start), bounds=(0.3, 2.0))
    kinds = [point.kind for point in branch.special]
    assert kinds
    for k in np.linspace(0, len(branch.parameter) - 1, 5).astype(int):
        end, half, _, start = scipy_at(TWO, branch, k)
        np.testing.assert_allclose(end, start, atol=1e-8)
        np.testing.assert_allclose(half, branch.amplitude[k, 0], atol=1e-8)
