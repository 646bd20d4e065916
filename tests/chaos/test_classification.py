"""Verdicts on systems whose motion is known, the two traps among them, and their parts."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import EventDriven, equation_8, paper_chain, simulate
from jaxchain.chaos.classification import verdict, verdicts
from jaxchain.chaos.criteria import (
    Criteria,
    classify,
    judge_exponents,
    judge_torus,
    pooled,
)
from jaxchain.chaos.poincare import (
    Record,
    join,
    mean_periods,
    novelty,
    phases,
    recurrence,
    reflections,
    symmetry_defect,
)
from jaxchain.chaos.records import Evidence
from jaxchain.cycles.closing import close_orbit
from jaxchain.model.oscillators import AbstractOscillators
from jaxchain.model.springs import Springs
from jaxchain.result import Result


class Rayleigh(AbstractOscillators):
    """x'' + k x + springs = gain (v - v^3 / (3 top^2)) + repel (v - v of the other mass).

    Of one mass, v is van der Pol's oscillator of amplitude 2 top.
    """

    gain: jax.Array
    top: jax.Array
    stiffness: jax.Array
    springs: Springs
    repel: jax.Array

    def local_force(self, t, x, v):
        return self.gain * (v - v**3 / (3.0 * self.top**2))

    def stiffness_diagonal(self, n):
        return self.stiffness + self.springs.row_sum(n)

    def __call__(self, t, y, args=None):
        x, v = y
        force = self.local_force(t, x, v) + self.repel * (v - v[::-1])
        return v, force + self.restoring_force(x)

    def divergence(self, t, y):
        return jnp.sum(self.gain * (1.0 - (y[1] / self.top) ** 2) + self.repel)


def pair(gain: Any = 0.3, top: Any = 1.0, stiffness=(1.0, 1.0), repel=0.0, spring=0.0):
    gain, top = (jnp.broadcast_to(jnp.asarray(a, float), (2,)) for a in (gain, top))
    springs = Springs(jnp.asarray(spring), "free")
    return Rayleigh(
        gain=gain, top=top, stiffness=jnp.asarray(stiffness), repel=jnp.asarray(repel),
        springs=springs,
    )  # fmt: skip


# One program serves all pairs.
SETTINGS = {
    "solver": dfx.Tsit5(), "rtol": 1e-7, "seeds": 2, "lanes": 3, "first": 1000.0,
    "longest": 1000.0, "exponent_time": 2000.0, "count": 2, "exponent_runs": 2,
}  # fmt: skip


def start(x=(2.0, -1.0), v=(0.0, 0.0)):
    return jnp.asarray(x), jnp.asarray(v)


def made_up(delays, periods, windows=20, length=50.0, wander=0.0):
    """A record of cosines with given delays and periods of their maxima."""
    delays, periods = np.asarray(delays, float), np.asarray(periods, float)
    n = len(delays)
    peaks = np.full((windows, 16, n), np.nan)
    points, times = np.full((windows, 5, 2 * n), np.nan), np.full((windows, 5), np.nan)
    for w in range(windows):
        for i in range(n):
            first = np.ceil((w * length - delays[i]) / periods[i])
            own = delays[i] + periods[i] * np.arange(first, first + 20)
            own = own[own < (w + 1) * length][:16]
            peaks[w, : len(own), i] = own
        times[w] = peaks[w, :5, 0]
        angle = 2 * np.pi * (times[w][:, None] - delays) / periods
        points[w] = np.concatenate([np.cos(angle), -np.sin(angle)], axis=1)
        points[w] += wander * w
    return Record(
        t=length * (1.0 + np.arange(windows)), amplitude=np.ones((windows, n)), peaks=peaks,
        point_times=times, points=points, state=(np.zeros(n), np.zeros(n)),
        result=Result.successful,
    )  # fmt: skip


def test_a_section_that_comes_back_is_told_from_one_that_creeps_or_drifts():
    still = recurrence(made_up([0.0, 1.0], [6.25, 6.25]), scale=1.0)
    assert still.returns == 1
    assert still.spread < 1e-12
    np.testing.assert_allclose(still.period, 6.25)
    # The second mass needs two maxima of the first.
    double = recurrence(made_up([0.0, 1.0], [6.25, 12.5]), scale=1.0)
    assert (double.returns, round(double.period, 9)) == (2, 12.5)
    assert double.spread < 1e-12
    drifting = recurrence(made_up([0.0, 1.0], [6.25, 6.25 * 1.017]), scale=1.0)
    assert drifting.spread > 0.5
    creeping = recurrence(made_up([0.0, 1.0], [6.25, 6.25], wander=1e-3), scale=1.0)
    np.testing.assert_allclose(creeping.spread, 9e-3, rtol=1e-6)


def test_a_torus_comes_back_and_a_drift_does_not():
    torus = made_up([0.0, 1.0], [6.25, 6.25 * 1.017], windows=80)
    assert novelty(torus) < 0.1
    # A seventh of a cycle in all.
    drift = made_up([0.0, 1.0], [6.25, 6.25 * (1 + 2e-4)], windows=80)
    assert novelty(drift) > 0.4
    assert novelty(made_up([0.0, 1.0], [6.25, 6.25])) < 1.0


def test_phases_count_cycles_and_slips():
    record = made_up([0.0, 1.0, 2.0], [6.25, 6.25, 6.2])
    turned = phases(record, [0, 1, 2])
    np.testing.assert_allclose(turned[:, 1] - turned[0, 1], 0.0, atol=1e-12)
    gained = turned[-1, 2] - turned[0, 2]
    # 950 time units later it is ahead by 950 (1 / 6.2 - 1 / 6.25) cycles.
    np.testing.assert_allclose(gained, 950 * (1 / 6.2 - 1 / 6.25), atol=0.01)
    np.testing.assert_allclose(mean_periods(record, [0, 1, 2]), [6.25, 6.25, 6.2], rtol=1e-12)
    twice = join([record, record])
    assert twice.amplitude.shape == (40, 3)
    assert twice.t.shape == (40,)


def test_reflections_keep_the_block():
    block = np.zeros(6, bool)
    block[[5, 0, 1]] = True
    (image,) = reflections(block, "cyclic")
    assert image.tolist() == [0, 5, 4, 3, 2, 1]
    assert reflections(block, "free") == []
    assert len(reflections(np.ones(6, bool), "cyclic")) == 6


def test_the_defect_of_a_symmetry_is_the_delay_of_mirror_images():
    active = np.array([False, True, True, True, False])
    delays = np.array([0.0, 1.0, 0.0, 1.0, 0.0])
    same = symmetry_defect(made_up(delays, np.full(5, 6.25)), active, 6.25)
    np.testing.assert_allclose(same, 0.0, atol=1e-12)
    delays[1] += 0.05
    off = symmetry_defect(made_up(delays, np.full(5, 6.25)), active, 6.25)
    np.testing.assert_allclose(off, 0.05 / 6.25, rtol=1e-9)
    # Two masses half a period apart are mirror images half a period later.
    pair_of_masses = np.array([True, True, False, False, False])
    record = made_up([0.1, 3.225, 0, 0, 0], np.full(5, 6.25))
    shifted = symmetry_defect(record, pair_of_masses, 6.25)
    np.testing.assert_allclose(shifted, 0.0, atol=1e-12)


def run_of(kind="open", noise=0.0, exponents=(), width=1e-3, **more):
    values = np.asarray(exponents, float)
    bounds = {"low": values - width, "high": values + width, "smooth": values}
    return Evidence(noise, 0, kind=kind, time=1e4, exponents=values, **(bounds | more))


def test_exponents_decide_only_with_their_whole_interval():
    limits = Criteria()
    assert judge_exponents(run_of(exponents=(2e-3, 0.0)), limits) == "chaos"
    assert judge_exponents(run_of(exponents=(5e-4, 0.0)), limits) == "open"
    assert judge_exponents(run_of(exponents=(1e-5, 0.0), width=5e-5), limits) == "torus"
    # One zero exponent belongs to any flow.
    assert judge_exponents(run_of(exponents=(0.0, -1e-4), width=5e-5), limits) == "open"
    assert judge_exponents(run_of(exponents=(0.0, -5e-4), width=5e-5), limits) == "cycle"
    drifting = run_of(exponents=(1e-5, 0.0), width=5e-5, drift=0.1)
    assert judge_exponents(drifting, limits) == "open"
    new = run_of(exponents=(1e-5, 0.0), width=5e-5, novelty=0.5)
    assert judge_exponents(new, limits) == "open"
    assert judge_exponents(run_of(), limits) == "open"
    assert judge_exponents(run_of(exponents=(np.nan, np.nan)), limits) == "open"


def test_a_torus_is_seen_by_an_ensemble_of_smooth_averages():
    runs = [run_of(exponents=(e, -e)) for e in (1e-5, 2e-5, 3e-5)]
    assert judge_torus(runs, Criteria())
    assert not judge_torus(runs[:1], Criteria())
    scattered = [run_of(exponents=(e, 0.0)) for e in (1e-5, 9e-5, 3e-4)]
    assert not judge_torus(scattered, Criteria())
    third = [run_of(exponents=(1e-5, -3e-4)) for _ in range(3)]
    assert not judge_torus(third, Criteria())
    # The interval of a mean holds the truth in 95 % of cases.
    draws = np.random.default_rng(1).normal(1.0, 2.0, (4, 4000))
    low, high = pooled(draws)
    assert 0.94 < np.mean((low < 1.0) & (high > 1.0)) < 0.96


@pytest.mark.parametrize(
    ("kinds", "noisy", "verdict", "undisturbed", "depends"),
    [
        ("cycle", ["cycle", "cycle"], "periodic", "periodic", False),
        ("rest", ["rest", "rest"], "at rest", "at rest", False),
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
        assert "`nonfinite`: The state is NaN" in found.remedy
    assert found.longest == 1e4
    assert "3 runs" in found.reason
    if verdict == "chaotic":
        assert "mean life" in found.reason
        assert found.lead.kind == "chaos"


def test_what_sticking_annihilates_relaxes_at_once():
    gone = run_of("cycle", exponents=(0.0, -np.inf), locked_at=500.0)
    assert gone.relaxation_time == gone.longest_relaxation_time == 0.0
    assert "relaxation time 0;" in classify([gone]).reason + ";"


def test_what_is_not_resolved_is_told_as_a_bound():
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


@pytest.mark.long
def test_the_multiplier_of_a_single_sticking_mass_is_zero():
    chain, start = paper_chain(n=1, belt_speed=1.5), (jnp.array([2.2]), jnp.zeros(1))
    orbit = close_orbit(chain, start, 6.26, solver=EventDriven())
    assert float(orbit.gap) < 1e-10
    assert complex(orbit.multipliers[0]) == 0
    assert float(orbit.exponents[0]) == float(orbit.highest_exponents[0]) == -np.inf


@pytest.mark.long
@pytest.mark.parametrize(("solver", "told"), [(EventDriven(), "time 0;"), (None, "time below 0.")])
def test_the_verdict_on_a_single_sticking_mass_has_no_number_of_rounding(solver, told):
    chain, start = paper_chain(n=1, width=1e-2), (jnp.array([2.2]), jnp.zeros(1))
    found = verdict(chain, start, solver=solver, first=500.0, longest=1000.0, seeds=1)
    assert found.verdict == "periodic"
    assert told in found.reason + ";"
    assert not np.isfinite(found.lead.exponents[1])
    assert found.lead.high[1] < -1.0


def test_runs_without_exponents_go_with_those_that_have_them():
    measured = run_of("chaos", 1e-3, (2e-3, 0.0), width=1e-4)
    assert classify([run_of("open"), measured, run_of("open", 1e-3)]).verdict == "chaotic"
    # But not with those that have locked.
    locked = run_of("cycle", 1e-3, (0.0, -1e-3), locked_at=500.0)
    found = classify([run_of("open"), locked, run_of("open", 1e-3)])
    assert found.verdict == "transient"
    assert "1 of 2 runs have ended" in found.remedy
    assert locked.relaxation_time == 1e3


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"seeds": 0}, "`seeds`"),
        ({"first": 0.0}, "`first`"),
        ({"longest": 10.0}, "`longest` = 10"),
        ({"noise": (-1.0,)}, "`noise`"),
        ({"count": 1.5}, "`count`"),
        ({"initials": jnp.ones(3)}, "the pair"),
        ({"initials": (jnp.ones(3), jnp.ones(3))}, "(states, n)"),
        ({"initials": (jnp.ones((1, 2)), jnp.full((1, 2), jnp.nan))}, "initial velocity"),
        ({"initials": (jnp.full((1, 2), jnp.inf), jnp.ones((1, 2)))}, "initial displacement"),
        ({"longest": np.nan}, "`longest`"),
        ({"rtol": 0.0}, "`rtol`"),
    ],
)
def test_bad_input_is_named(wrong, match):
    initials = wrong.pop("initials", (jnp.ones((1, 2)), jnp.zeros((1, 2))))
    with pytest.raises(ValueError) as error:
        verdicts(pair(), initials, **wrong)
    assert match in str(error.value)


@pytest.mark.parametrize(
    ("initial", "match"),
    [
        ((jnp.full(1, jnp.nan), jnp.zeros(1)), "initial displacement"),
        ((jnp.ones(2), jnp.zeros(2)), "2 masses, but the chain has 1"),
        (jnp.ones(3), "the pair"),
    ],
)
def test_a_state_that_is_none_gets_no_verdict(initial, match):
    with pytest.raises(ValueError, match=match):
        verdict(paper_chain(n=1), initial)


@pytest.mark.long
def test_two_masses_that_know_nothing_of_each_other_are_quasi_periodic():
    found = verdict(pair(stiffness=(1.0, 1.7)), start(), **SETTINGS)
    assert found.verdict == "quasi-periodic", found.reason
    lead = found.lead
    np.testing.assert_allclose(lead.smooth[:2], 0.0, atol=1e-5)
    assert lead.slips > 10


@pytest.mark.long
def test_masses_that_lock_slowly_are_first_transient_and_then_periodic():
    # Phases attract at a rate of about 2 repel / 2 = 4e-4: not within 1000.
    slow = pair(repel=-4e-4)
    short = verdict(slow, start(v=(0.0, 1.0)), **SETTINGS)
    assert short.verdict == "transient", short.reason
    assert "longer" in short.remedy
    longer = verdict(slow, start(v=(0.0, 1.0)), **(SETTINGS | {"longest": 16000.0}))
    assert longer.verdict == "periodic", longer.reason
    lead = longer.lead
    assert 4000 <= lead.time <= 16000
    np.testing.assert_allclose(lead.exponents[1], -4e-4, rtol=0.1)
    np.testing.assert_allclose(lead.relaxation_time, 2500, rtol=0.1)


@pytest.mark.long
def test_a_symmetric_start_on_an_unstable_orbit_is_found_out():
    # Equal masses stay equal; each is pushed away from the other.
    apart = pair(repel=0.008)
    found = verdict(apart, start(x=(2.0, 2.0)), **(SETTINGS | {"longest": 8000.0}))
    assert found.depends_on_noise
    assert found.undisturbed == "periodic"
    assert found.verdict == "periodic"  # the other orbit, on which they move against each other
    clean = found.runs[0]
    assert clean.kind == "unstable"
    # Noise of 1e-8 needs longer than that of 1e-3, and is given its time.
    assert all(run.kind == "cycle" for run in found.runs[1:])
    assert found.runs[1].time > clean.time
    # Two masses apart by a small d: d'' + d = gain (1 - v^2) d' + 2 repel d'; a phase difference
    # grows at the rate repel, to first order.
    np.testing.assert_allclose(clean.exponents[0], 0.008, rtol=0.1)
    turned = found.runs[-1].delays[1] - found.runs[-1].delays[0]
    np.testing.assert_allclose(abs(turned - round(turned)), 0.5, atol=1e-3)


@pytest.mark.long
def test_a_driven_oscillator_is_chaotic():
    # v of mass 1 is van der Pol's v'' - 5 (1 - v^2) v' + v = 5 cos(2.466 t); mass 2 drives it.
    frequency, spring, swing = 2.466, 0.01, 5.0 / 2.466 / 0.01
    chain = pair(
        gain=(5.0, 0.05), top=(1.0, 0.5 * swing * frequency), spring=spring,
        stiffness=(1.0 - spring, frequency**2 - spring),
    )  # fmt: skip
    found = verdict(chain, start(x=(0.1, swing), v=(0.1, 0.0)), **SETTINGS)
    assert found.verdict == "chaotic", found.reason
    assert found.lead.low[0] > 0.01


def _disturbance(chain, orbit, returns):
    """What a difference of mirror images grows to, per time unit, followed by two runs."""
    x, v = orbit.state
    push = jnp.zeros(chain.n).at[1].set(1e-5).at[3].set(-1e-5)
    left = []
    for count in (1, 1 + returns):
        run = simulate(chain, (x + push, v), count * orbit.period, solver=EventDriven(), rtol=1e-9)
        left.append(run.state[0][1] - run.state[0][3])
    return jnp.log(jnp.abs(left[1] / left[0])) / (returns * orbit.period)


@pytest.mark.long
def test_the_multipliers_of_a_symmetric_dry_orbit_hold_though_its_masses_stick_together():
    chain = paper_chain(n=5, belt_speed=1.5)
    x, v = equation_8(chain, jnp.array([False, True, True, True, False]))
    run = simulate(chain, (x, v), 1500.0, solver=EventDriven(), rtol=1e-9)
    orbit = close_orbit(chain, run.state, 6.2275, solver=EventDriven())
    assert float(orbit.gap) < 1e-10
    assert float(orbit.defect) < 1e-6
    x, _ = orbit.state
    np.testing.assert_allclose(x[1], x[3], atol=1e-9)
    assert float(orbit.exponents[0]) > 1e-3
    np.testing.assert_allclose(_disturbance(chain, orbit, 60), orbit.exponents[0], rtol=0.05)
