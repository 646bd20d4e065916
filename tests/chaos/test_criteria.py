"""The criteria of a verdict: exponents, tori, and ensembles with noise."""

from typing import Any

import numpy as np
import pytest

from jaxchain.chaos.classification import (
    Criteria,
    Evidence,
    _on_orbit,
    classify,
    judge_exponents,
    judge_torus,
)
from jaxchain.cycles.limit_cycle import ClosedOrbit

FORCED: dict[str, Any] = {"width": 5e-5, "forcing_period": 5.0}


def run_of(kind="open", noise=0.0, exponents=(), width=1e-3, **more):
    values = np.asarray(exponents, float)
    bounds = {"low": values - width, "high": values + width, "smooth": values}
    return Evidence(noise, 0, kind=kind, time=1e4, exponents=values, **(bounds | more))


def test_exponents_decide_only_with_their_whole_interval():
    narrow: dict[str, Any] = {"width": 5e-5}
    for verdict, exponents, more in (
        ("chaos", (2e-3, 0.0), {}),
        ("open", (5e-4, 0.0), {}),
        ("torus", (1e-5, 0.0), narrow),
        # One zero exponent belongs to any flow.
        ("open", (0.0, -1e-4), narrow),
        ("cycle", (0.0, -5e-4), narrow),
        ("open", (1e-5, 0.0), narrow | {"drift": 0.1}),
        ("open", (1e-5, 0.0), narrow | {"novelty": 0.5}),
        ("open", (), {}),
        ("open", (np.nan, np.nan), {}),
        ("cycle", (1e-5, -1e-3), narrow),
        ("open", (-1e-3, -2e-3), narrow),
        # None of a forced motion does.
        ("cycle", (-1e-3, -2e-3), FORCED),
        ("torus", (1e-5, -1e-3), FORCED),
        ("torus", (1e-5,), FORCED),
        ("open", (-1e-4, -1e-3), FORCED),
        ("chaos", (1e-3, -1e-3), FORCED),
        ("open", (1e-5, -1e-3), FORCED | {"novelty": 0.5}),
    ):
        given: dict[str, Any] = {"exponents": exponents, **more}
        assert judge_exponents(run_of(**given), Criteria()) == verdict, given
    slow = run_of("cycle", exponents=(-1e-3, -2e-3), forcing_period=5.0, locked_at=500.0)
    assert slow.relaxation_time == 1e3


def test_a_torus_is_seen_by_an_ensemble_of_smooth_averages():
    runs = [run_of(exponents=(e, -e)) for e in (1e-5, 2e-5, 3e-5)]
    assert judge_torus(runs, Criteria())
    assert not judge_torus(runs[:1], Criteria())
    scattered = [run_of(exponents=(e, 0.0)) for e in (1e-5, 9e-5, 3e-4)]
    assert not judge_torus(scattered, Criteria())
    third = [run_of(exponents=(1e-5, -3e-4)) for _ in range(3)]
    assert not judge_torus(third, Criteria())
    # A force has no exponent: one is enough.
    narrow: dict[str, Any] = {"width": 5e-5}
    for more, is_torus in ((FORCED, True), (narrow, False)):
        runs = [run_of(exponents=(e, -1e-3), **more) for e in (1e-5, 2e-5, 3e-5)]
        assert judge_torus(runs, Criteria()) is is_torus


@pytest.mark.parametrize(
    ("kinds", "noisy", "verdict", "undisturbed", "depends"),
    [
        ("cycle", ["cycle", "cycle"], "periodic", "periodic", False),
        ("rest", ["rest", "rest"], "steady sliding", "steady sliding", False),
        ("chaos", ["chaos", "chaos"], "chaotic", "chaotic", False),
        ("torus", ["torus", "torus"], "quasi-periodic", "quasi-periodic", False),
        ("unstable", ["chaos", "chaos"], "chaotic", "periodic", True),
        ("unstable", ["cycle", "cycle"], "periodic", "periodic", True),
        ("cycle", ["cycle", "chaos"], "transient", "periodic", True),
        ("chaos", ["chaos", "open"], "transient", "chaotic", True),
        ("nonfinite", ["nonfinite", "nonfinite"], "failed", "failed", False),
        ("cycle", ["cycle", "nonfinite"], "failed", "periodic", True),
        ("nonfinite", ["cycle", "cycle"], "periodic", "failed", True),
        ("open", ["open", "nonfinite"], "failed", "transient", True),
    ],
)
def test_the_verdict_is_that_of_the_strongest_noise(kinds, noisy, verdict, undisturbed, depends):
    values = {"unstable": (2e-3, 0.0), "cycle": (0.0, -1e-3)}

    def make(kind, noise):
        exponents = () if kind == "rest" else values.get(kind, (2e-3, 0.0))
        return run_of(kind, noise, exponents, width=1e-6, locked_at=500.0)

    found = classify([make(kinds, 0.0), *(make(kind, 1e-3) for kind in noisy)])
    assert (found.verdict, found.undisturbed, found.depends_on_noise) == (
        verdict, undisturbed, depends
    )  # fmt: skip
    assert bool(found.remedy) == (verdict in ("transient", "failed"))
    if "nonfinite" in (kinds, *noisy):
        assert "failed (nonfinite)" in found.reason
    if verdict == "failed":
        assert "`nonfinite`: The state or a value" in found.remedy
    assert found.longest == 1e4
    assert "3 runs" in found.reason
    if verdict == "chaotic":
        assert "mean life" in found.reason
        assert found.lead.kind == "chaos"


def test_runs_that_would_have_locked_by_now_are_on_another_attractor():
    def classified(locked_at):
        never = [run_of("torus", 1e-3, (0.0, 0.0)) for _ in range(4)]
        return classify([run_of("cycle", 1e-3, (0.0, -1e-3), locked_at=locked_at), *never])

    found = classified(200.0)
    assert found.verdict == "several attractors"
    assert found.shares == {"periodic": 0.2, "quasi-periodic": 0.8}
    assert not found.remedy
    # By chance, the first of five events has come by then with a probability of 5 * 500 / 40500.
    late = classified(500.0)
    assert late.verdict == "transient"
    assert late.shares == found.shares
    assert classified(np.nan).verdict == "transient"


def test_an_unresolved_exponent_is_reported_as_a_bound():
    unseen = run_of(
        "cycle", exponents=(0.0, np.nan), low=np.array([0.0, -np.inf]),
        high=np.array([0.0, -4.0]), locked_at=500.0,
    )  # fmt: skip
    assert np.isnan(unseen.relaxation_time)
    assert unseen.longest_relaxation_time == 0.25
    assert "relaxation time below 0.25 (not resolved)" in classify([unseen]).reason
    # Of a run that locks while exponents are measured it is below everything else.
    late = run_of(exponents=(0.0, np.nan), width=1e-6)
    assert judge_exponents(late, Criteria()) == "cycle"


def test_every_multiplier_may_have_the_error_of_the_trivial_one():
    """(ln mu)' = 1 / mu, so that small ones have rates of greater error."""
    mu, period, defect = np.array([0.5, 1e-2]), 6.0, 1e-5
    rates = np.log(mu) / period
    no: Any = None
    known: Any = {"period": period, "multipliers": mu, "defect": defect, "resolution": 1e-9}
    orbit = ClosedOrbit(state=no, gap=no, distance=no, returned=no, evaluations=no, **known)
    found = _on_orbit(Evidence(0.0, 0), orbit, True, 500.0)
    assert found.kind == "cycle"
    np.testing.assert_allclose(found.exponents, [0.0, *rates])
    errors = defect / period * np.array([1.0, *1 / mu])
    np.testing.assert_allclose(found.high - found.exponents, errors, rtol=1e-9)
    np.testing.assert_allclose(found.exponents - found.low, errors, rtol=1e-9)
    # One that sticking erases, and one below the resolution.
    orbit = orbit._replace(multipliers=np.array([0.0, np.nan]))
    np.testing.assert_allclose(orbit.exponents, [-np.inf, np.nan])
    np.testing.assert_allclose(orbit.highest_exponents, [-np.inf, np.log(1e-9) / period])
