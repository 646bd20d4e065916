"""Branches of dry cycles: SciPy with events, closed forms, and searches for single cycles."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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
    np.testing.assert_array_equal(np.diff(branch.parameter) > 0, np.arange(hopf.index) < turn)


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


@pytest.mark.long
def test_a_forced_response_gains_two_stops_at_an_onset():
    period = 2 * np.pi / 0.9
    settled, *_ = Events(forced()).run([0.0, 0.0], 42 * period)
    state = tuple(jnp.asarray(settled)[:, None])
    how = {"parameter": "frequency", "direction": -1, "bounds": (0.7, 2.0)}
    branch = continue_cycle(forced(), state, period, **how)
    assert branch.amplitude[0, 0] == pytest.approx(2.42023635, abs=5e-9)
    (onset,) = branch.special
    assert onset.kind == "stick onset"
    for k in (onset.index, -1):
        end, half, releases, start = scipy_at(forced(), branch, k)
        assert len(releases) == (0 if k == onset.index else 2)
        np.testing.assert_allclose(end, start, atol=1e-9)
        np.testing.assert_allclose(half, branch.amplitude[k, 0], atol=1e-9)
    assert branch.parameter[-1] == 0.7
    assert branch.ended == "left_bounds"


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
    branch = continue_cycle(*start, direction=-1)
    assert branch.ended == "belt_speed = 0"
    assert not branch.special
    assert 0 < branch.parameter[-1] < 0.02


OWN = {"high": lambda c: c.amplitude[0] - 1.5, "fast": lambda c: c.multipliers[0].real - 1.8}


def test_special_points_and_events_of_ones_own_are_found(dry_branch):
    branch = continue_cycle(*at_start(dry_branch), events=OWN)
    high, fast = branch.of_kind("high"), branch.of_kind("fast")
    assert len(high) == 2  # as it sticks, and as it slides
    for point in high:
        np.testing.assert_allclose(point.amplitude, 1.5, atol=1e-9)
        assert point.refined
        assert point.error < 1e-8
    assert fast
    assert all(abs(point.multipliers[0] - 1.8) < 1e-6 for point in fast)
    with pytest.raises(ValueError, match="uses more of a cycle than `state`, `period`"):
        continue_special(fast[0], "damping_ratio")
    with pytest.raises(ValueError, match="must have names of its own"):
        continue_cycle(*at_start(dry_branch), events={"fold": OWN["high"]})


@pytest.mark.long
def test_events_of_ones_own_are_followed():
    high = continue_cycle(find_limit_cycle(paper_chain(1, 1.2, None)), events=OWN).of_kind("high")
    curve = continue_special(high[0], "damping_ratio", max_points=4)
    assert np.ptp(curve.second) > 1e-3
    np.testing.assert_allclose(curve.amplitude[:, 0], 1.5, atol=1e-9)


def test_a_branch_ends_as_asked_and_keeps_what_it_has(dry_branch, monkeypatch):
    k = dry_branch.of_kind("grazing fold")[0].index - 4
    chain = paper_chain(1, dry_branch.parameter[k], None)
    start = chain, tuple(jnp.asarray(part[k]) for part in dry_branch.state), dry_branch.period[k]
    some = continue_cycle(*start, max_points=9)
    assert (some.ended, len(some.parameter)) == ("max_points", 9)
    assert some.of_kind("grazing fold")[0].parameter == pytest.approx(DRY_FOLD, abs=1e-11)

    def interrupt(count, point):
        if point.extra.speed < 1.8:
            raise KeyboardInterrupt

    part = continue_cycle(*start, progress=interrupt)
    assert part.ended == "interrupted"
    assert part.of_kind("grazing fold")

    def pressed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(branches, "change_at", pressed)  # between two sequences of phases
    cut = continue_cycle(*start)
    assert (cut.ended, cut.special) == ("interrupted", ())


def check_curve_and_slope(point, model, names, on_the_curve):
    """A curve in two numbers, by the multipliers of searches, and dp/d(damping) of the point."""
    curve = continue_special(point, names[1], max_points=4)
    for k in (0, 2, -2):
        there = model.with_(**dict(zip(names, (curve.first[k], curve.second[k]), strict=True)))
        state = tuple(jnp.asarray(part[k]) for part in curve.state)
        if model.forcing_period() is not None:  # it begins at an event, a search at the time 0
            state = simulate(there, state, curve.period[k], t0=curve.unknowns[k][2]).state
        mu = find_limit_cycle(there, (state, curve.period[k])).multipliers
        assert np.min(np.abs(on_the_curve(mu))) < 1e-6

    def value(added):
        damping = "damping" if names[1] == "damping" else "damping_ratio"
        changed = model.with_(**{damping: getattr(model, damping) + added})
        return find_special_cycle(point, changed).value

    near = [float(value(step)) for step in (1e-5, -1e-5)]
    assert float(jax.grad(value)(0.0)) == pytest.approx((near[0] - near[1]) / 2e-5, rel=1e-6)


@pytest.mark.long
def test_period_doublings_and_tori_of_dry_cycles_have_multipliers_on_the_unit_circle():
    """The multipliers of single searches, which differentiate an event-driven run."""
    well = MechanicalCells(
        -1.0, damping=0.25, local_force=lambda x, v: (-(x[0] ** 3),), friction=Coulomb(0.02),
        force=0.2, frequency=1.0,
    )  # fmt: skip
    start = simulate(well, (jnp.ones(1), jnp.zeros(1)), 160 * np.pi)
    branch = continue_cycle(find_limit_cycle(well, start), parameter="force", bounds=(0.1, 0.6))
    doubling = branch.of_kind("period doubling")[0]
    check_curve_and_slope(doubling, well, ("force", "damping"), lambda mu: mu + 1.0)
    chain = paper_chain(3, belt_speed=1.5, width=None)
    cycle = find_limit_cycle(chain, simulate(chain, equation_8(chain, 1), 3000.0))
    torus = continue_cycle(cycle, direction=-1, bounds=(1.36, 2.0)).of_kind("torus")[0]
    names = "belt_speed", "coupling"
    check_curve_and_slope(torus, chain, names, lambda mu: np.abs(mu[np.imag(mu) > 0]) - 1.0)


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
