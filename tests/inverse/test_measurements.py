"""Signals and features against runs; fits against SciPy, closed forms and linear algebra."""

import re
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares
from witnesses import numbers_of
from witnesses.event_driven import vibrating_cycle

from jaxchain import StickTime, Trajectory, find_limit_cycle, paper_chain, simulate
from jaxchain.inverse import (
    Measurements,
    Signal,
    identification,
    identify,
    log_likelihood,
    measurements,
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


def blank(what: Any = "displacement", times: Any = TIMES, **more):
    return Signal(times, np.zeros_like(times), 1.0, what, **more)


def shown(chain, x, v, what):
    """What a run shows, from its states."""
    if what != "friction_force":
        return x if what == "displacement" else v
    w = v - float(chain.belt_speed)
    slides = -np.sign(w) * np.asarray(chain.law.coefficient(np.abs(w)))
    return np.where(np.abs(w) < 1e-7, x + 2 * float(chain.damping_ratio) * v, slides)


def test_a_dry_signal_is_that_of_a_run_through_many_cycles(chains):
    """From its release, with its period by SciPy."""
    chain, cycle = chains[1, None], vibrating_cycle(numbers_of(chains[1, None]))
    assert cycle is not None
    # Where static friction holds it last: 1 - 2 xi v_d.
    start, times = (np.array([0.85]), np.array([1.5])), TIMES + 2.0
    run = simulate(chain, start, TIMES[-1] + 10.0, observe=Trajectory(times), rtol=1e-11)
    x, v = (np.asarray(part)[:, 0] for part in run.observed)
    for what in ("displacement", "velocity", "friction_force"):
        found = predict(chain, blank(what), phase=2.0 / cycle.period)
        np.testing.assert_allclose(found, shown(chain, x, v, what), atol=3e-7, err_msg=what)


def test_friction_pulls_back_a_mass_that_starts_faster_than_the_belt():
    chain, start = ONE, (jnp.array([0.5]), jnp.array([2.0]))
    record = blank("friction_force", start=start)
    found = predict(chain, record)
    assert found[0] < -0.5 < 0.5 < found[40]
    run = simulate(chain, start, TIMES[-1], observe=Trajectory(TIMES), rtol=1e-11)
    x, v = (np.asarray(part)[:, 0] for part in run.observed)
    expected = shown(chain, x, v, "friction_force")
    np.testing.assert_allclose(found, expected, atol=3e-7)
    with pytest.raises(ValueError, match=r"`phase` is that of a limit cycle, but is 0\.3"):
        log_likelihood(chain, record, phase=0.3)
    with pytest.raises(ValueError, match=r"measurements\.start"):
        predict(paper_chain(2), record)


def test_a_decay_determines_friction_and_damping_and_its_start():
    """Beyond the fold, where there is no limit cycle: sticks, slips, and comes to rest."""
    chain, true = ONE.with_(belt_speed=1.9), (jnp.array([2.2]), jnp.array([0.2]))
    times = jnp.asarray(TIMES + 3.0)
    exact = predict(change(chain, TRUE), blank(times=times, start=true))
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
    (low, high), expected = found.interval(0.999), np.array([1.05, 0.045])
    assert np.all((low < expected) & (expected < high))
    assert np.all(found.standard_errors < 0.02 * found.theta)
    np.testing.assert_allclose(jnp.concatenate(found.start), [2.2, 0.2], atol=0.03)
    assert abs(found.chi_squared - 396) < 4 * np.sqrt(2 * 396)
    best = Signal(times, signal.values, 0.01, start=found.start)
    expected = np.sum(stats.norm.logpdf(found.residuals)) - TIMES.size * np.log(0.01)
    assert log_likelihood(found.chain, best) == pytest.approx(expected, abs=1e-6)


class Closed(measurements.Waveform):
    """A cycle in closed form, which compiles in seconds; that of a chain takes a minute."""

    def __init__(self, chain: Any, mass: int, what: str):
        self.chain, self.mass, self.what, self.cycle = chain, mass, what, None  # pyright: ignore[reportAttributeAccessIssue]
        self.period = 2 * jnp.pi * (1 + chain.damping_ratio)
        self.sound, self.slip, self.parts = jnp.asarray(True), jnp.ones(()), ()

    def __call__(self, shares: Any) -> Any:
        law: Any = self.chain.law
        angle = 2 * jnp.pi * shares
        return 0.8 + law.v_ref * jnp.cos(angle) + law.mu_dynamic**2 * jnp.sin(2 * angle)


def in_closed_form(theta, phase, times):
    angle = times / (1 + theta[2]) + 2 * np.pi * phase
    return 0.8 + theta[1] * np.cos(angle) + theta[0] ** 2 * np.sin(2 * angle)


def three(chain, theta):
    return chain.with_(mu_dynamic=theta[0], v_ref=theta[1], damping_ratio=theta[2])


THREE, PHASE, FIRST = np.array([0.5, 0.6, 0.045]), 0.37, jnp.array([0.4, 0.7, 0.055])
CLEAN = in_closed_form(THREE, PHASE, TIMES)
NOISY = CLEAN + 0.01 * np.random.default_rng(0).standard_normal(TIMES.size)


@pytest.fixture
def closed(monkeypatch):
    for module in (identification, measurements):
        monkeypatch.setattr(module, "Waveform", Closed)


def test_the_fit_of_a_cycle_is_that_of_scipy_with_its_errors_and_phase(closed):
    signal = Signal(TIMES, NOISY, 0.01)
    found = identify(ONE, three, FIRST, signal, starts=3)

    def gaps(p):
        return (in_closed_form(p[:3], p[3], TIMES) - NOISY) / 0.01

    first = np.array([*THREE, PHASE])
    other = least_squares(gaps, first, x_scale=first, xtol=1e-14, ftol=1e-14)
    errors = np.sqrt(np.diag(np.linalg.inv(other.jac.T @ other.jac)))
    assert found.successful
    assert np.all(abs(found.theta - other.x[:3]) < 0.02 * errors[:3])
    np.testing.assert_allclose(found.standard_errors, errors[:3], rtol=5e-3)
    assert abs(found.phase - other.x[3]) < 0.02 * errors[3]
    assert float(found.chi_squared) == pytest.approx(2 * other.cost, abs=1e-3)
    # The likelihood, at the phase that fits best, is greatest there.
    likelihood = jax.jit(lambda theta: log_likelihood(three(ONE, theta), signal))
    best = likelihood(found.theta)
    expected = np.sum(stats.norm.logpdf(found.residuals)) - TIMES.size * np.log(0.01)
    assert best == pytest.approx(expected, abs=1e-3)
    for step in (0.3, -0.3):
        assert likelihood(found.theta + step * found.standard_errors) < best
    assert log_likelihood(found.chain, signal, phase=found.phase + 0.1) < best - 100


WRONG = {
    "right": (NOISY, None),
    "sign": (-NOISY, "sign reversed"),
    "unit": (3 * NOISY, "A factor of"),
    "velocity": (np.gradient(NOISY, TIMES), 'what="velocity"'),
    "mean removed": (NOISY - NOISY.mean(), 'offset="unknown"'),
    "noise": (np.random.default_rng(1).standard_normal(TIMES.size), "are they noise"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_record_is_warned_of_with_the_reason(closed, wrong):
    values, reason = WRONG[wrong]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = identify(ONE, three, FIRST, Signal(TIMES, values, 0.01), starts=3)
    texts = " ".join(str(warning.message) for warning in caught)
    assert (reason in texts) if reason else not texts
    three(ONE, found.theta)  # the constructor accepts it
    assert found.theta[2] >= 0


def test_the_period_of_a_signal_is_that_of_its_harmonics():
    times = np.sort(np.random.default_rng(0).uniform(0.0, 300.0, 500))
    angle = 2 * np.pi * times / 6.1
    signal = Signal(times, 2.0 + np.cos(angle) + 0.6 * np.sin(2 * angle), 0.1)
    assert signal.period(near=5.0) == pytest.approx(6.1, rel=1e-4)


@pytest.mark.long
def test_features_of_a_cycle_are_those_of_a_run_with_slopes_of_differences():
    chain, speeds = ONE, jnp.array([0.5, 1.2])
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


@pytest.mark.long
def test_a_fit_to_boundaries_and_amplitudes_is_that_of_scipy_with_its_curvature():
    speeds, sliding, noise = jnp.array([0.6, 0.9, 1.2, 1.5]), jnp.array([2.0, 2.5]), 0.01

    def measured(values):
        return Measurements(
            hopf=(values[0], noise), fold=(values[1], noise),
            amplitudes=(speeds, values[2:6], noise), displacements=(sliding, values[6:], noise),
        )  # fmt: skip

    true = jnp.array([1.0, 0.5, 0.5, 0.05])
    prediction = jax.jit(lambda theta: predict(change(ONE, theta), measured(jnp.ones(8))))
    exact = prediction(true)
    known = [np.log(10.0) / 2, 1.836600972208, *(0.5 + 0.5 * np.exp(-sliding / 0.5))]
    np.testing.assert_allclose(exact[np.array([0, 1, 6, 7])], known, rtol=1e-10)
    values = exact + noise * np.random.default_rng(0).standard_normal(8)
    found = identify(ONE, change, jnp.array([1.2, 0.6, 0.7, 0.07]), measured(values))

    def residuals(theta):
        return np.asarray(prediction(jnp.asarray(theta)) - values) / noise

    other = least_squares(residuals, true, x_scale=true, diff_step=1e-5, xtol=1e-12, ftol=1e-12)
    assert found.successful
    np.testing.assert_allclose(found.theta, other.x, rtol=1e-5)
    assert float(found.chi_squared) == pytest.approx(2 * other.cost, rel=1e-6)
    covariance = np.linalg.inv(other.jac.T @ other.jac)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-2, atol=1e-8)


# Displacements of a mass that slides steadily, for `of_sliding`: one shape, so one fit.
SPEEDS = np.array([1.3, 1.5, 1.7, 2.5])
FALLING = 0.5 + 0.5 * np.exp(-SPEEDS / 0.5)
ROUGH = FALLING + 0.01 * np.array([1.0, -0.5, -1.0, 0.5])


def sliding(values, noise: Any = 0.01, correlation: Any = None):
    """Displacements of a mass that slides steadily; of one shape, so that one fit is compiled."""
    correlation = np.eye(4) if correlation is None else correlation
    return Measurements(displacements=(SPEEDS, values, noise), correlation=correlation)


def of_sliding(chain, theta):
    return chain.with_(mu_dynamic=theta[0], v_ref=theta[1])


NEAR = jnp.array([0.45, 0.55])


def test_correlated_measurements_have_the_density_of_scipy_and_the_best_fit_of_gauss():
    draws = np.random.default_rng(0).standard_normal((50, 4))
    correlation = np.corrcoef(draws + draws[:, :1], rowvar=False)
    noise, values = np.array([0.02, 0.01, 0.03, 0.01]), ROUGH
    lab = sliding(values, noise, correlation)
    covariance = correlation * np.outer(noise, noise)
    density: Any = stats.multivariate_normal  # the checker takes `cov` for an integer
    expected = density.logpdf(values, FALLING, covariance)
    assert jax.jit(log_likelihood)(ONE, lab) == pytest.approx(expected, rel=1e-12)
    found = identify(ONE, of_sliding, NEAR, lab)
    # At the best fit J^T C^-1 (values - predicted) is 0, and (J^T C^-1 J)^-1 the covariance.
    mu, v = map(float, found.theta)
    decay = np.exp(-SPEEDS / v)
    gaps = values - (mu + (1 - mu) * decay)
    slopes = np.stack([1 - decay, (1 - mu) * decay * SPEEDS / v**2], axis=1)
    weighted = np.linalg.solve(covariance, slopes).T
    np.testing.assert_allclose(weighted @ gaps, 0.0, atol=1e-6 * np.abs(weighted).max())
    expected = np.linalg.inv(weighted @ slopes)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6)
    errors = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found.standard_errors, errors, rtol=1e-6)
    np.testing.assert_allclose(found.correlation, expected / np.outer(errors, errors), rtol=1e-6)
    lower, upper = found.interval(0.9)
    np.testing.assert_allclose((upper + lower) / 2, found.theta, rtol=1e-12)
    np.testing.assert_allclose((upper - lower) / 2, 1.644854 * found.standard_errors, rtol=1e-6)
    with pytest.raises(ValueError, match="`confidence` must be between"):
        found.interval(95)
    assert found.chi_squared == pytest.approx(gaps @ np.linalg.solve(covariance, gaps), rel=1e-9)


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
        found = identify(ONE, of_sliding, NEAR, lab)
    texts = [str(warning.message) for warning in caught]
    assert len(texts) == len(messages), texts
    for text, message in zip(texts, messages, strict=True):
        assert re.search(message, text), text
    edges = {name for name, there in found.at_edge.items() if there}
    assert ("mu_dynamic = 0" in edges) == (len(messages) == 2)
    of_sliding(ONE, found.theta)  # the constructor accepts it


def test_a_profile_is_that_of_all_other_numbers_fitted_anew():
    """For each v_ref the best mu_dynamic is linear: the profile is no parabola."""
    lab = sliding(ROUGH)
    own = profile(identify(ONE, of_sliding, NEAR, lab), ONE, of_sliding, lab, 1, points=21)

    def least(v):
        decay = np.exp(-SPEEDS / v)
        rest = np.linalg.lstsq((1 - decay)[:, None] / 0.01, (ROUGH - decay) / 0.01, rcond=None)[1]
        return float(rest[0])

    there = np.asarray(own.values) > 0.05
    expected = [least(v) for v in np.asarray(own.values)[there]]
    np.testing.assert_allclose(np.asarray(own.chi_squared)[there], expected, rtol=1e-6)
    fine = np.linspace(own.low - 0.1, own.high + 0.1, 2001)
    within = fine[[least(v) - float(own.least) < stats.chi2.ppf(0.95, 1) for v in fine]]
    np.testing.assert_allclose([own.low, own.high], [within[0], within[-1]], atol=2e-3)


def test_what_the_data_do_not_tell_apart_is_named_and_has_no_profile():
    """v_H = v0 ln[(mu_st - mu_d) / (2 xi v0)] alone: v0 makes up for any damping."""
    lab = Measurements(hopf=(1.15, 0.01), displacements=([5.0], [0.5], 0.01))

    def law(chain, theta):
        return chain.with_(
            mu_dynamic=theta["mu"], damping_ratio=theta["xi"][0], v_ref=theta["xi"][1]
        )

    start = {"mu": 0.4, "xi": jnp.array([0.06, 0.5])}
    with pytest.warns(UserWarning, match=r"theta\['xi'\]\[0\], theta\['xi'\]\[1\]"):
        found = identify(ONE, law, start, lab)
    assert found.determined.tolist() == [True, False, False]
    assert float(found.standard_errors["mu"]) == pytest.approx(0.01, rel=1e-3)
    assert np.isinf(found.standard_errors["xi"]).all()
    assert np.isnan(found.correlation[1, 2])
    assert float(found.condition) > 1e6
    with pytest.raises(ValueError, match="`place` = 1 must be that of a number that the data"):
        profile(found, ONE, law, lab, 1)
    # Much damping: no Hopf point, so nothing to start from.
    with pytest.raises(ValueError, match="`start` predicts no vibration"):
        identify(ONE, law, {"mu": 0.4, "xi": jnp.array([0.8, 0.5])}, lab)
    with pytest.raises(ValueError, match=r"`start` makes no chain.*`mu_static`.*`mu_dynamic`"):
        identify(ONE, law, {**start, "mu": 1.2}, lab)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "at least one measurement"),
        ({"harmonics": ([1.0], np.ones((1, 40)), 0.1)}, "at most 32 harmonics, but has 40"),
        (
            {"periods": ([1.0, 2.0], [6.0, 6.0], 0.1), "correlation": np.ones((2, 2))},
            "`correlation` must be symmetric and positive definite",
        ),
    ],
)
def test_bad_measurements_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        Measurements(**arguments)


def test_an_unknown_offset_is_the_weighted_mean_of_the_gaps():
    noise = np.array([0.1, 0.1, 0.2])
    record = Signal([0.0, 1.0, 2.0], [3.0, 4.0, 6.0], noise, offset="unknown")
    gaps = np.array([3.0, 4.0, 6.0]) - 1.0
    mean = np.average(gaps, weights=noise**-2.0)
    assert record.shift(jnp.ones(3)) == pytest.approx(mean)
    np.testing.assert_allclose(record.gaps(jnp.ones(3)), (gaps - mean) / noise)
    with pytest.raises(ValueError, match="`offset` must be None or"):
        Signal([0.0, 1.0], [1.0, 2.0], 0.1, offset=0.3)
