"""Signals against runs of the same chain; their periods, phases and likelihood."""

import re
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxchain import StickTime, Trajectory, find_limit_cycle, paper_chain, simulate
from jaxchain.inverse import (
    Measurements,
    Signal,
    identify,
    log_likelihood,
    predict,
    profile,
)

ONE = paper_chain(1, belt_speed=1.2, width=None)
TRUE = jnp.array([1.05, 0.5, 0.55, 0.045])
TIMES = 0.3 * np.arange(400.0)


def change(chain, theta):
    return chain.with_(
        mu_static=theta[0], mu_dynamic=theta[1], v_ref=theta[2], damping_ratio=theta[3]
    )


def shown(chain, x, v, what):
    """What a run shows, from its states."""
    if what != "friction_force":
        return x if what == "displacement" else v
    w, law = v - float(chain.belt_speed), chain.law
    slides = -np.sign(w) * np.asarray(law.coefficient(np.abs(w)))
    return np.where(np.abs(w) < 1e-7, x + 2 * float(chain.damping_ratio) * v, slides)


@pytest.mark.parametrize(
    ("n", "what"),
    [
        (1, "displacement"),
        pytest.param(1, "velocity", marks=pytest.mark.long),
        (1, "friction_force"),
        pytest.param(3, "displacement", marks=pytest.mark.long),
    ],
)
def test_a_dry_signal_is_that_of_a_run_through_many_cycles(n, what: Any):
    chain = paper_chain(n, belt_speed=1.5, width=None)
    cycle, times = find_limit_cycle(chain), jnp.asarray(TIMES)
    run = simulate(
        chain, cycle.state, TIMES[-1] + 10.0, observe=Trajectory(times + 2.0), rtol=1e-11
    )
    x, v = (np.asarray(part)[:, n // 2] for part in run.observed)
    blank = Signal(times, jnp.zeros_like(times), 1.0, what)
    found = predict(chain, blank, phase=2.0 / cycle.period)
    np.testing.assert_allclose(found, shown(chain, x, v, what), atol=3e-7)


def made_up(chain, seed=0, what: Any = "displacement", noise=0.01):
    blank = Signal(TIMES, np.zeros_like(TIMES), 1.0, what)
    values = np.asarray(predict(change(chain, TRUE), blank, phase=0.37))
    error = noise * np.ptp(values) / 2
    draws = np.random.default_rng(seed).standard_normal(TIMES.size)
    return Signal(TIMES, values + error * draws, error, what)


def test_a_signal_determines_friction_and_damping_and_its_phase():
    signal, start = made_up(ONE), jnp.array([1.0, 0.45, 0.5, 0.04])
    found = identify(ONE, change, start, signal, starts=3)
    assert found.successful
    assert np.all(np.abs(found.theta - TRUE) < 4 * found.standard_errors)
    assert np.all(found.standard_errors < 0.3 * TRUE)
    assert found.phase == pytest.approx(0.37, abs=2e-3)
    assert abs(found.chi_squared - 395) < 4 * np.sqrt(2 * 395)
    # The likelihood is greatest there, and its slope is that of differences.
    best = log_likelihood(found.chain, signal)
    assert best == pytest.approx(
        np.sum(stats.norm.logpdf(found.residuals)) - TIMES.size * np.log(signal.noise[0]), abs=1e-3
    )

    def along(step):
        return log_likelihood(change(ONE, found.theta + step * found.standard_errors), signal)

    assert along(0.3) < best > along(-0.3)
    slope = jax.jvp(along, (0.02,), (1.0,))[1]
    np.testing.assert_allclose(slope, (along(0.0201) - along(0.0199)) / 2e-4, rtol=1e-4)


@pytest.mark.parametrize("width", [None, 1e-3], ids=["dry", "smoothed"])
def test_friction_pulls_back_a_mass_that_starts_faster_than_the_belt(width):
    chain, start = ONE.with_(width=width), (jnp.array([0.5]), jnp.array([2.0]))
    times = jnp.linspace(0.0, 12.0, 41)
    blank = Signal(times, jnp.zeros_like(times), 1.0, "friction_force", start=start)
    found = predict(chain, blank)
    assert found[0] < -0.5 < 0.5 < found[-1]
    x, v = (np.asarray(part)[:, 0] for part in simulate(
        chain, start, times[-1], observe=Trajectory(times), rtol=1e-11).observed)  # fmt: skip
    expected = shown(chain, x, v, "friction_force")
    if width is not None:
        expected = np.asarray(chain.friction.force(jnp.asarray(v) - chain.belt_speed))
    np.testing.assert_allclose(found, expected, atol=1e-4 if width else 3e-7)
    with pytest.raises(ValueError, match=r"`phase` is that of a limit cycle, but is 0\.3"):
        log_likelihood(chain, blank, phase=0.3)


@pytest.mark.parametrize(
    "width", [None, pytest.param(1e-3, marks=pytest.mark.long)], ids=["dry", "smoothed"]
)
def test_a_decay_determines_friction_and_damping_and_its_start(width):
    """Beyond the fold, where there is no limit cycle: sticks, slips, and comes to rest."""
    chain, true = ONE.with_(belt_speed=1.9, width=width), (jnp.array([2.2]), jnp.array([0.2]))
    times = jnp.asarray(TIMES + 3.0)
    blank = Signal(times, jnp.zeros_like(times), 1.0, start=true)
    exact = predict(change(chain, TRUE), blank)
    run = simulate(change(chain, TRUE), true, TIMES[-1], observe=Trajectory(TIMES), rtol=1e-11)
    np.testing.assert_allclose(exact, run.observed[0][:, 0], atol=3e-7)
    draws = 0.01 * np.random.default_rng(0).standard_normal(TIMES.size)
    near = true[0] + 0.1, true[1] - 0.1
    signal = Signal(times, exact + draws, 0.01, start=near)

    def law(chain, theta):
        return change(chain, jnp.array([theta[0], 0.5, 0.55, theta[1]]))

    found = identify(chain, law, jnp.array([0.97, 0.05]), signal)
    assert found.successful
    assert found.start is not None
    assert jnp.isnan(found.phase)
    low, high = found.interval(0.999)
    assert np.all((low < TRUE[jnp.array([0, 3])]) & (TRUE[jnp.array([0, 3])] < high))
    assert np.all(found.standard_errors < 0.02 * found.theta)
    np.testing.assert_allclose(jnp.concatenate(found.start), [2.2, 0.2], atol=0.03)
    assert abs(found.chi_squared - 396) < 4 * np.sqrt(2 * 396)
    with pytest.raises(ValueError, match=r"measurements\.start"):
        predict(paper_chain(2), blank)
    # The likelihood of this start, and its slope.
    best = Signal(times, signal.values, 0.01, start=found.start)
    expected = np.sum(stats.norm.logpdf(found.residuals)) - TIMES.size * np.log(0.01)
    assert log_likelihood(found.chain, best) == pytest.approx(expected, abs=1e-6)

    def along(step):
        return log_likelihood(law(chain, found.theta + step * found.standard_errors), best)

    slope = jax.jvp(along, (0.3,), (1.0,))[1]
    np.testing.assert_allclose(slope, (along(0.3001) - along(0.2999)) / 2e-4, rtol=1e-3)


def test_the_period_of_a_signal_is_that_of_its_harmonics():
    times = np.sort(np.random.default_rng(0).uniform(0.0, 300.0, 500))
    angle = 2 * np.pi * times / 6.1
    values = 2.0 + np.cos(angle) + 0.6 * np.sin(2 * angle)
    assert Signal(times, values, 0.1).period(near=5.0) == pytest.approx(6.1, rel=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("width", [None, 1e-3])
def test_features_of_a_cycle_are_those_of_a_run_with_slopes_of_differences(width):
    chain, speeds = ONE.with_(width=width), jnp.array([0.5, 1.2])
    kinds = ("periods", "means", "stick_shares")
    lab = {kind: (speeds, [1.0, 1.0], 0.1) for kind in kinds}
    lab = Measurements(**lab, harmonics=(speeds, jnp.ones((2, 5)), 0.1))
    found = predict(chain, lab)
    spectra, found = found[6:].reshape(2, 5), found[:6].reshape(3, 2)
    for k, speed in enumerate(speeds):
        own = chain.with_(belt_speed=speed)
        cycle = find_limit_cycle(own)
        times = cycle.period * jnp.arange(4000) / 4000
        watch = StickTime(), Trajectory(times)
        stick, (x, _) = simulate(own, cycle.state, cycle.period, observe=watch).observed
        expected = cycle.period, jnp.mean(x), stick[0] / cycle.period
        np.testing.assert_allclose(found[:, k], jnp.stack(expected), rtol=1e-4)
        waves = 2 * np.abs(np.fft.rfft(x[:, 0])) / times.size
        np.testing.assert_allclose(spectra[k], waves[1:6], atol=1e-5)

    def of(damping):
        return predict(chain.with_(damping_ratio=damping), lab)

    between = (of(0.05 + 1e-5) - of(0.05 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jacfwd(of)(0.05), between, rtol=1e-4, atol=1e-6)


def test_correlated_measurements_have_the_density_of_scipy_and_the_best_fit_of_gauss():
    draws = np.random.default_rng(0).standard_normal((50, 4))
    correlation = np.corrcoef(draws + draws[:, :1], rowvar=False)
    speeds, noise = [2.0, 2.5, 3.0], np.array([0.02, 0.01, 0.03, 0.01])
    values = np.array([1.2, 0.60, 0.55, 0.52])
    lab = Measurements(
        hopf=(values[0], noise[0]),
        displacements=(speeds, values[1:], noise[1:]),
        correlation=correlation,
    )

    def change(chain, theta):
        return chain.with_(mu_dynamic=theta[0], v_ref=theta[1])

    covariance = correlation * np.outer(noise, noise)
    density: Any = stats.multivariate_normal  # the checker takes `cov` for an integer
    expected = density.logpdf(values, predict(ONE, lab), covariance)
    assert log_likelihood(ONE, lab) == pytest.approx(expected, rel=1e-12)
    with pytest.warns(UserWarning, match="contradict each other"):
        found = identify(ONE, change, jnp.array([0.5, 0.5]), lab)
    # At the best fit J^T C^-1 (values - predicted) is 0, and (J^T C^-1 J)^-1 the covariance.
    slopes = jax.jacfwd(lambda theta: predict(change(ONE, theta), lab))(found.theta)
    gaps = values - np.asarray(predict(found.chain, lab))
    weighted = np.linalg.solve(covariance, slopes).T
    np.testing.assert_allclose(weighted @ gaps, 0.0, atol=1e-6 * np.abs(weighted).max())
    np.testing.assert_allclose(found.covariance, np.linalg.inv(weighted @ slopes), rtol=1e-6)
    assert found.chi_squared == pytest.approx(gaps @ np.linalg.solve(covariance, gaps), rel=1e-9)


@pytest.mark.long
def test_a_signal_of_a_smoothed_chain_is_fitted_or_said_not_to_be():
    chain, off = ONE.with_(width=1e-3), TRUE * jnp.array([0.9, 1.1, 1.1, 0.9])
    found = identify(chain, change, off, made_up(chain, 1, "velocity"))
    assert found.successful
    assert np.all(np.abs(found.theta - TRUE) < 4 * found.standard_errors)
    with pytest.warns(UserWarning, match="leaves a chi"):
        identify(chain, change, off, made_up(chain, 1, "friction_force"))


@pytest.mark.long
def test_a_profile_holds_the_truth_and_is_a_parabola_for_small_noise():
    signal = made_up(ONE, 2, noise=1e-4)
    found = identify(ONE, change, TRUE, signal)
    for place in (0, 3):
        own = profile(found, ONE, change, signal, place)
        low, high = (bound[place] for bound in found.interval())
        np.testing.assert_allclose([own.low, own.high], [low, high], rtol=1e-3)
        rise = ((own.values - found.theta[place]) / found.standard_errors[place]) ** 2
        assert np.all(np.abs(own.chi_squared - found.chi_squared - rise) < 0.02 * rise + 0.01)


def test_what_the_data_do_not_tell_apart_has_no_profile():
    lab = Measurements(hopf=(1.15, 0.01))

    def both(chain, theta):
        return chain.with_(mu_dynamic=theta[0], v_ref=theta[1])

    with pytest.warns(UserWarning, match="do not determine theta"):
        found = identify(ONE, both, jnp.array([0.5, 0.5]), lab)
    with pytest.raises(ValueError, match="`place` = 1 must be that of a number that the data"):
        profile(found, ONE, both, lab, 1)


@pytest.mark.exhaustive
@pytest.mark.parametrize("from_start", [False, True], ids=["cycle", "start"])
def test_intervals_of_signals_hold_the_truth_as_often_as_they_promise(from_start):
    """Thirty records with four unknown numbers: of 30, 27 or more with a probability of 94 %."""
    rng, covered = np.random.default_rng(3), []
    for _ in range(30):
        chain = ONE.with_(belt_speed=rng.uniform(1.2, 1.7))
        true = TRUE * (1 + 0.05 * jnp.asarray(rng.uniform(-1.0, 1.0, 4)))
        start = jnp.array([rng.uniform(0.6, 2.5)]), jnp.array([rng.uniform(-0.5, 0.5)])
        start, near, phase = (start, tuple(y + 0.1 for y in start), None) if from_start else (
            None, None, rng.uniform())  # fmt: skip
        blank = Signal(TIMES, np.zeros_like(TIMES), 1.0, start=start)
        values = predict(change(chain, true), blank, phase=phase)
        noise = 0.01 * jnp.std(values)
        values = values + noise * rng.standard_normal(TIMES.size)
        signal = Signal(TIMES, values, noise, start=near)
        found = identify(
            chain, change, true * (1 + 0.1 * rng.standard_normal(4)), signal, starts=4
        )
        low, high = found.interval()
        covered.append((low < true) & (true < high))
    print(np.sum(covered, axis=0))
    assert np.all(np.sum(covered, axis=0) >= 27)


def sliding(values, noise=0.01):
    """Displacements of a mass that slides steadily; of one shape, so that one fit is compiled."""
    speeds = jnp.array([1.3, 1.5, 1.7, 2.5])
    return Measurements(displacements=(speeds, values, noise))


def of_sliding(chain, theta):
    return chain.with_(mu_dynamic=theta[0], v_ref=theta[1])


FALLING = 0.5 + 0.5 * np.exp(-np.array([1.3, 1.5, 1.7, 2.5]) / 0.5)
ROUGH = FALLING + 0.01 * np.array([1.0, -0.5, -1.0, 0.5])


@pytest.mark.parametrize(
    ("lab", "messages"),
    [
        (sliding(ROUGH), []),
        (sliding(ROUGH - 0.6), ["leaves a chi", "edge of the domain, `mu_dynamic = 0`"]),
        (sliding(ROUGH, noise=2e-4), ["contradict each other.* number 2"]),
        (sliding(FALLING + 1e-3 * (ROUGH - FALLING)), ["noise is about 0.0011 times"]),
    ],
    ids=["right", "outside", "contradicting", "noise too great"],
)
def test_a_fit_warns_of_its_chi_squared_and_of_the_edge_of_the_domain(lab, messages):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = identify(ONE, of_sliding, jnp.array([0.45, 0.55]), lab)
    texts = [str(warning.message) for warning in caught]
    assert len(texts) == len(messages), texts
    for text, message in zip(texts, messages, strict=True):
        assert re.search(message, text), text
    edges = {name for name, there in found.at_edge.items() if there}
    assert ("mu_dynamic = 0" in edges) == (len(messages) == 2)
    of_sliding(ONE, found.theta)  # the constructor accepts it


def test_a_start_that_makes_no_chain_is_refused():
    with pytest.raises(ValueError, match=r"`start` makes no chain.*`mu_static`.*`mu_dynamic`"):
        identify(ONE, of_sliding, jnp.array([1.2, 0.5]), sliding(ROUGH))


def test_an_unknown_offset_is_the_weighted_mean_of_the_gaps():
    noise = np.array([0.1, 0.1, 0.2])
    record = Signal([0.0, 1.0, 2.0], [3.0, 4.0, 6.0], noise, offset="unknown")
    gaps = np.array([3.0, 4.0, 6.0]) - 1.0
    mean = np.average(gaps, weights=noise**-2.0)
    assert record.shift(jnp.ones(3)) == pytest.approx(mean)
    np.testing.assert_allclose(record.gaps(jnp.ones(3)), (gaps - mean) / noise)
    with pytest.raises(ValueError, match="`offset` must be None or"):
        Signal([0.0, 1.0], [1.0, 2.0], 0.1, offset=0.3)


RNG_TIMES = np.sort(np.random.default_rng(5).uniform(0.0, 100.0, 300))
WRONG = {
    "right": (lambda t, x, v: x, None),
    "sign": (lambda t, x, v: -x, "sign reversed"),
    "unit": (lambda t, x, v: 3 * x, "A factor of"),
    "velocity": (lambda t, x, v: v, 'what="velocity"'),
    "mean removed": (lambda t, x, v: x - x.mean(), 'offset="unknown"'),
    "noise": (lambda t, x, v: np.random.default_rng(1).standard_normal(t.size), "are they noise"),
}


@pytest.mark.long
def test_a_wrong_record_is_warned_of_with_the_reason_and_an_unknown_offset_is_found():
    def law(chain, theta):
        return chain.with_(mu_dynamic=theta[0], damping_ratio=theta[1], v_ref=theta[2])

    true, start = np.array([0.5, 0.05, 0.5]), jnp.array([0.55, 0.045, 0.45])
    chain, draws = paper_chain(1, belt_speed=0.8, width=None), np.random.default_rng(2)
    blanks = [Signal(RNG_TIMES, 0 * RNG_TIMES, 1.0, what) for what in ("displacement", "velocity")]
    x, v = (np.asarray(predict(chain, blank, phase=0.3)) for blank in blanks)
    x, v = (y + 0.01 * draws.standard_normal(300) for y in (x, v))
    for name, (wrong, reason) in WRONG.items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = identify(chain, law, start, Signal(RNG_TIMES, wrong(RNG_TIMES, x, v), 0.01))
        texts = " ".join(str(warning.message) for warning in caught)
        assert (reason in texts) if reason else not texts, (name, texts)
        law(chain, found.theta)  # the constructor accepts it
        assert found.theta[1] >= 0
    record = Signal(RNG_TIMES, x - x.mean(), 0.01, offset="unknown")
    found = identify(chain, law, start, record)
    assert np.all(np.abs(found.theta - true) < 4 * found.standard_errors)
    assert found.offset == pytest.approx(-x.mean(), abs=0.01)
