"""Mistuned chains and their linear modes: closed forms, NumPy, perturbation theory, one lane."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import truncnorm

from jaxchain import Chain, equation_8, paper_chain, sweep
from jaxchain.localization.mistuning import (
    linear_modes,
    localization_length,
    mistuned_chain,
    mistuned_stiffness,
)
from jaxchain.observers.quantities import participation_ratio
from jaxchain.sweeps.lanes import chain_of_run


def test_participation_ratio_in_closed_form():
    """Masses at rest do not count, so that all are padded with zeros."""
    expected = [
        ([0.0, 1.7, 0.0, 0.0], 1.0),
        ([0.3] * 7, 7.0),
        ([0.0, -2.0, 2.0], 2.0),
        ([-0.3] * 7, 7.0),
        ([0.0, 0.0], 0.0),
        ([1e-160, 1e-160, 0.0], 2.0),  # the fourth powers underflow
        ([2.0, 1.0], 25.0 / 17.0),
    ]
    amplitude = np.array([a + [0.0] * (7 - len(a)) for a, _ in expected])
    found = participation_ratio(jnp.asarray(amplitude))
    np.testing.assert_allclose(found, [ratio for _, ratio in expected], rtol=1e-14)


@pytest.mark.parametrize("distribution", ["uniform", "normal"])
def test_disorder_is_a_standard_deviation(distribution):
    k = np.asarray(mistuned_stiffness(3, 200_000, 0.1, distribution))
    assert abs(k.mean() - 1.0) < 4 * 0.1 / 200_000**0.5
    # The error of a standard deviation is at most sigma / sqrt(2 n) for these.
    assert abs(k.std() - 0.1) < 4 * 0.1 / 400_000**0.5
    kurtosis = np.mean((k - 1.0) ** 4) / 0.1**4
    assert abs(kurtosis - {"uniform": 1.8, "normal": 3.0}[distribution]) < 0.05
    farthest = {"uniform": 3.0**0.5, "normal": 4.0}[distribution] * 0.1
    assert np.abs(k - 1.0).max() <= farthest * (1 + 1e-2)
    assert np.abs(k - 1.0).max() > 0.98 * farthest
    if distribution == "normal":  # without the tails, which matter less than chance
        draws = jax.random.truncated_normal(jax.random.key(3), -4.0, 4.0, k.shape, float)
        np.testing.assert_allclose((k - 1.0) / 0.1, draws / truncnorm(-4, 4).std(), atol=1e-12)


def test_a_seed_is_one_chain_whatever_the_disorder_and_the_neighbours():
    seeds = jnp.arange(50)
    many = np.asarray(jax.jit(jax.vmap(lambda s: mistuned_stiffness(s, 20, 0.05)))(seeds))
    np.testing.assert_allclose(many[17], mistuned_stiffness(17, 20, 0.05), rtol=1e-15)

    @jax.jit
    def others(key):
        slope = jax.jacfwd(lambda d: mistuned_stiffness(17, 20, d))(0.02)
        return mistuned_stiffness(key, 20, 0.05), mistuned_stiffness(17, 20, 0.1), slope

    by_key, twice, slope = others(jax.random.key(17))
    np.testing.assert_allclose(many[17], by_key, rtol=1e-15)
    np.testing.assert_allclose((twice - 1.0) / 0.1, (many[17] - 1.0) / 0.05, rtol=1e-12)
    assert len(np.unique(many[:, 0])) == 50
    np.testing.assert_allclose(slope, (twice - 1.0) / 0.1, rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((0, 5, -0.1), "disorder"),
        ((0, 5, 0.6), "lets a stiffness be zero"),
        ((0, 5, 0.3, "normal"), "less than 0.25"),
        ((0, 5, np.nan), "disorder"),
        ((0, 5, 0.1, "cauchy"), "distribution"),
        ((0.5, 5, 0.1), "seed"),
        (([1, 2], 5, 0.1), "seed"),
        ((0, 0, 0.1), "`n`"),
        ((0, 5, [0.1, 0.2]), "disorder"),
    ],
)
def test_impossible_mistuning_is_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        mistuned_stiffness(*arguments)


def test_modes_of_the_tuned_ring_in_closed_form():
    modes = linear_modes(paper_chain(20))
    q = 2 * np.pi * np.arange(20) / 20
    np.testing.assert_allclose(
        modes.frequency**2, np.sort(1.0 + 0.02 * (1 - np.cos(q))), rtol=1e-13
    )
    ratio = np.asarray(modes.participation_ratio)
    np.testing.assert_allclose(ratio[[0, -1]], 20.0, rtol=1e-9)  # uniform, and alternating
    generic = [1, 2, 3, 4, 5, 6, 7, 8, 11, 12, 13, 14, 15, 16, 17, 18]  # without q = pi / 2
    np.testing.assert_allclose(ratio[generic], 2 * 20 / 3, rtol=1e-6)


@pytest.mark.parametrize("ends", ["cyclic", "free"])
def test_modes_of_a_mistuned_chain_by_numpy(ends):
    law = paper_chain().friction
    k = np.asarray(mistuned_stiffness(5, 8, 0.03))
    c = np.linspace(0.01, 0.03, 8 if ends == "cyclic" else 7)
    chain = Chain(8, law, 1.0, coupling=c, stiffness=k, ends=ends)
    matrix = np.diag(k)
    for i, spring in enumerate(c):
        j = (i + 1) % 8
        matrix[[i, j], [i, j]] += spring
        matrix[[i, j], [j, i]] -= spring
    square, columns = np.linalg.eigh(matrix)
    modes = jax.jit(linear_modes)(chain)
    np.testing.assert_allclose(modes.frequency, np.sqrt(square), rtol=1e-12)
    np.testing.assert_allclose(np.abs(modes.shape), np.abs(columns.T), atol=1e-10)
    np.testing.assert_allclose(modes.participation_ratio, 1 / np.sum(columns**4, 0), rtol=1e-9)
    np.testing.assert_allclose(modes.return_probability, np.sum(columns**4, 1), rtol=1e-9)


def test_strongly_mistuned_modes_by_perturbation_theory():
    # To first order in eta_c, u_j = e_j - sum eta_c / (k_j - k_n) e_n over both neighbours n.
    k = np.array([1.0, 1.3, 0.8, 1.5, 0.6, 1.15])
    modes = linear_modes(paper_chain(6).with_(stiffness=k, coupling=1e-4))
    to_neighbours = 1 / (k - np.roll(k, 1)) ** 2 + 1 / (k - np.roll(k, -1)) ** 2
    expected = 1 + 2 * 1e-8 * to_neighbours[np.argsort(k)]
    np.testing.assert_allclose(modes.participation_ratio - 1, expected - 1, rtol=1e-2)


@pytest.mark.parametrize(
    ("position", "sine_squared", "anomaly"), [(0.0, 1.0, 105.045 / 96), (0.3, 0.91, 1.0)]
)
def test_localization_length_for_little_disorder(position, sine_squared, anomaly):
    # Anderson's box of width W: 96 V^2 sin^2 q / W^2, in the middle 105.045 V^2 / W^2.
    found = jax.jit(lambda d: localization_length(d, 0.01, position, length=400_000))(0.002)
    expected = anomaly * 8 * 0.01**2 * sine_squared / 0.002**2
    np.testing.assert_allclose(found, expected, rtol=0.06)


def test_localization_length_for_great_disorder_and_none():
    # Sites on their own: gamma = <ln |sigma u / eta_c|>, here ln(sqrt(3) sigma / eta_c) - 1.
    found = localization_length(0.1, 1e-5, length=200_000)
    np.testing.assert_allclose(1 / found, np.log(3**0.5 * 1e4) - 1, rtol=2e-3)
    # Only the ratio of the two counts.
    np.testing.assert_allclose(
        localization_length(0.02, 0.02), localization_length(0.005, 0.005), rtol=1e-12
    )
    assert localization_length(0.0, 0.01, length=100) == np.inf
    with pytest.raises(ValueError, match="coupling"):
        localization_length(0.1, 0.0)


def ladder(chain):
    return equation_8(chain, 2)


def test_the_chain_of_a_lane_has_its_own_numbers_first_and_is_varied_then():
    values = {"seed": jnp.asarray(3), "disorder": 0.1, "belt_speed": 1.2, "excited": 2}
    chain = chain_of_run(paper_chain(4), mistuned_chain, values | {"stiffness": 2.0})
    assert float(chain.belt_speed) == 1.2
    np.testing.assert_array_equal(chain.stiffness, 2.0 * mistuned_stiffness(3, 4, 0.1))
    assert chain_of_run(chain, None, {"excited": 2}) is chain


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"over": {"seed": [1]}}, r"`vary` needs \['disorder'\]"),
        ({"over": {"seed": [1], "disorder": [0.1, 0.6]}}, "lets a stiffness be zero"),
        ({"over": {"seed": [1], "disorder": [0.1], "age": [3]}}, "`initial` or `vary`"),
        ({"vary": lambda chain, seed: chain.n, "over": {"seed": [1]}}, "must return a `Chain`"),
        ({"vary": lambda chain: paper_chain(5), "over": {"belt_speed": [1]}}, "of 4 masses"),
    ],
)
def test_a_sweep_that_cannot_vary_so_is_refused(changes, text):
    arguments = {"vary": mistuned_chain, "over": {"seed": [1], "disorder": [0.1]}} | changes
    with pytest.raises(ValueError, match=text):
        sweep(paper_chain(4), ladder, 5.0, **arguments)
