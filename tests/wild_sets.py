"""Random sets of numbers for searches, over decades."""

import numpy as np

from jaxchain import paper_chain

WILD = ("damping_ratio", "mu_dynamic", "v_ref", "width")


def wild_sets(seed, count):
    """Random (xi, mu_d / mu_st, v_ref, width) from far apart, shape (count, 4)."""
    rng = np.random.default_rng(seed)

    def logarithmic(low, high):
        return np.exp(rng.uniform(np.log(low), np.log(high), count))

    xi, ratio, v_ref = logarithmic(0.01, 0.3), rng.uniform(0.2, 0.9, count), logarithmic(0.02, 1.5)
    return np.stack([xi, ratio, v_ref, logarithmic(1e-9, 0.2)], axis=1)


def steep_sets(seed, count, least=0.003):
    """The same with a steep weakening of friction: multipliers up to 1e17, or 1e50 for 0.001."""
    rng, sets = np.random.default_rng(seed), wild_sets(seed, count)
    sets[:, 2] = np.exp(rng.uniform(np.log(least), np.log(0.05), count))
    sets[:, 3] = sets[:, 2] * np.exp(rng.uniform(np.log(1e-6), np.log(1e-2), count))
    return sets


def wild_chain(numbers):
    return paper_chain(1).with_(**dict(zip(WILD, numbers, strict=True)))
