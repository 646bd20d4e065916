"""Which friction does a record allow?  Samples of the posterior, and whether they are right.

The displacement of one mass of dry friction in its limit cycle, with noise, determines its dynamic
coefficient of friction and its reference speed.  NUTS of numpyro samples both, and the phase at
the first time, from `log_likelihood`.  Each chain starts near the best fit, off by one and a half
standard errors at random, and moves in the metric of its covariance.  The samples are right if,
over many made-up records whose truths are drawn from the prior, the rank of the truth among the
samples is uniform (Talts et al., Validating Bayesian inference algorithms with simulation-based
calibration, 2018).

Prints the p-value of uniform ranks for each number, and how many samples diverged; of four long
chains for the first record, how many diverged, split R-hat, the number of independent samples that
they are worth, and their time with compiling.  Draws the ranks and the posterior of the first
record with the interval of `identify`.  Needs numpyro, as `pip install '.[inference]'`.  An hour
beside other programs:

    python examples/studies/posterior.py
"""

import functools
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro
from _common import BLUE, GREY, VERMILION, kept, letters, options
from numpyro import distributions as dist
from numpyro.diagnostics import effective_sample_size, split_gelman_rubin
from numpyro.infer import MCMC, NUTS, init_to_value
from scipy.stats import chisquare

import jaxchain as jc
from jaxchain.inverse import Signal, identify, log_likelihood, predict
from jaxchain.plotting import save_figure

FULL = {"records": 100, "warmup": 150, "samples": 480, "depth": 6}
QUICK = {"records": 2, "warmup": 3, "samples": 60, "depth": 1}
LONG = {"records": 4, "warmup": 300, "samples": 1000, "depth": 8}  # four times the first one
THIN, BINS = 10, 7  # neighbouring samples are not independent; each bin holds as many ranks
NOISE, TIMES = 0.02, 0.5 * np.arange(40.0)
LOW, HIGH = np.array([0.40, 0.45, 0.2]), np.array([0.60, 0.65, 0.8])  # of the prior
NAMES = (
    r"dynamic coefficient $\mu_d$ (–)",
    r"reference speed $\tilde v_0$ (–)",
    "phase (periods)",
)


def change(chain, theta):
    return chain.with_(mu_dynamic=theta[0], v_ref=theta[1])


def with_numbers(theta):
    return change(jc.paper_chain(1, 1.2, width=None), theta)


def record(values):
    return Signal(TIMES, values, NOISE)


def model(values):
    theta = numpyro.sample("theta", dist.Uniform(LOW, HIGH).to_event(1))
    fit = log_likelihood(with_numbers(theta), record(values), phase=theta[2])
    numpyro.factor("signal", fit)


def unit(u):
    """theta for a point in the coordinates of the sampler, the logits of shares of the prior."""
    return LOW + (HIGH - LOW) * jax.nn.sigmoid(u)


def best_fit(values):
    """The best fit in the sampler's coordinates, its covariance, and the interval of theta."""
    middle = jnp.asarray(0.5 * (LOW + HIGH))
    fit = identify(with_numbers(middle), change, middle[:2], record(values))
    share = jnp.clip((jnp.append(fit.theta, fit.phase % 1.0) - LOW) / (HIGH - LOW), 0.02, 0.98)

    def scaled(u):
        return predict(with_numbers(unit(u)), record(values), phase=unit(u)[2]) / NOISE

    u = jax.scipy.special.logit(share)
    slopes, prior = jax.jacfwd(scaled)(u), jnp.diag(2.0 * share * (1.0 - share))
    return u, jnp.linalg.inv(slopes.T @ slopes + prior), jnp.stack(fit.interval())


@functools.cache
def sampler(warmup, samples, depth):
    """A function of (key, values): samples of (3,), which diverged, interval of the fit."""

    @jax.jit
    @jax.vmap
    def run(key, values):
        u, covariance, interval = best_fit(values)
        away = 1.5 * jnp.linalg.cholesky(covariance) @ jax.random.normal(key, u.shape)
        kernel = NUTS(
            model, dense_mass=True, inverse_mass_matrix=covariance, adapt_mass_matrix=False,
            max_tree_depth=depth, forward_mode_differentiation=True,
            init_strategy=init_to_value(values={"theta": unit(u + away)}),
        )  # fmt: skip
        chains = MCMC(kernel, num_warmup=warmup, num_samples=samples, progress_bar=False)
        chains.run(jax.random.split(key)[0], values)
        return chains.get_samples()["theta"], chains.get_extra_fields()["diverging"], interval

    return run


def study(records, **numbers):
    """(truths, values, samples, which diverged, intervals, seconds) of made-up records."""
    keys = jax.random.split(jax.random.key(1), 3)
    truths = jax.random.uniform(keys[0], (records, 3), minval=LOW, maxval=HIGH)
    exact = jax.vmap(lambda t: predict(with_numbers(t), record(0.0 * TIMES), phase=t[2]))(truths)
    values = exact + NOISE * jax.random.normal(keys[1], exact.shape)
    start = time.perf_counter()
    found = sampler(**numbers)(jax.random.split(keys[2], records), values)
    found = jax.tree.map(np.asarray, (truths, values, *found))
    return *found, time.perf_counter() - start


def long_chains(values, records, **numbers):
    """Prints what several chains for one record are worth."""
    keys, start = jax.random.split(jax.random.key(2), records), time.perf_counter()
    found = sampler(**numbers)(keys, jnp.tile(jnp.asarray(values), (records, 1)))
    samples, diverged, _ = map(np.asarray, found)
    seconds = time.perf_counter() - start
    print(f"{records} chains in {seconds:.0f} s, {diverged.sum()} of {diverged.size} diverged")
    worth, ratios = effective_sample_size(samples), split_gelman_rubin(samples)
    for name, each, ratio in zip(NAMES, worth, ratios):
        print(f"{name}: worth {each:.0f} samples, R-hat {ratio:.3f}")


def main():
    quick, folder = options(__file__, __doc__)
    s = QUICK if quick else FULL
    truths, values, samples, diverged, intervals, seconds = kept(
        folder / "records.pickle", s, lambda: study(**s)
    )
    print(f"{len(truths)} records in {seconds:.0f} s, {diverged.mean():.2%} of samples diverged")
    long_chains(values[0], **(QUICK if quick else LONG))
    few = samples[:, ::THIN]
    ranks = (few < truths[:, None]).sum(axis=1)
    edges = np.linspace(-0.5, few.shape[1] + 0.5, BINS + 1)
    low, high = intervals[0]
    page, panels = plt.subplots(2, 3, figsize=(7.0, 4.0))
    expected = len(ranks) / BINS
    usual = expected + 2 * np.sqrt(expected) * np.array([-1, 1])
    for i, name in enumerate(NAMES):
        counts, _ = np.histogram(ranks[:, i], edges)
        print(f"{name}: ranks {counts}, p = {chisquare(counts).pvalue:.2f}")
        above, below = panels[:, i]
        above.bar(range(1, BINS + 1), counts, color=BLUE, width=0.8)
        above.axhline(expected, color=GREY)
        above.axhspan(*usual, color=GREY, alpha=0.3, zorder=0)
        above.set(xlabel=f"seventh of the ranks\n{name}", ylabel="records")
        below.hist(samples[0, :, i], 20, color=BLUE)
        below.axvline(truths[0, i], color=VERMILION)
        if i < 2:
            below.axvspan(float(low[i]), float(high[i]), color=GREY, alpha=0.3, zorder=0)
        below.set(xlabel=name, ylabel="samples")
    letters(panels)
    save_figure(page, folder / "posterior")


if __name__ == "__main__":
    main()
