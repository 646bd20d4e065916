"""Bounds that several submodules share.  This module does not need JAX."""

# Most runs of a sweep in memory, and of one in a store.
MOST_LANES, MOST_STORED = 10**7, 10**12
# An experiment of a scene with more runs uses a store, unless the scene sets `store`.
MOST_UNSTORED = 4096
# Below this, error estimates consist of rounding errors, or their squares underflow.
LEAST_RTOL, LEAST_ATOL = 1e-15, 1e-30
# Relative error of smoothed friction against dry friction.
LEAST_ACCURACY, MOST_ACCURACY = 1e-8, 0.3
# The least positive number, and the greatest count: anything beyond is a typing error.
LEAST_POSITIVE, MOST_COUNT = 1e-300, 10**9
# Most processes of a local cluster.
MOST_WORKERS = 10_000
