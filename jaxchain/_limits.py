"""Bounds that several submodules share.  This module does not need JAX."""

# Runs of one sweep in memory, and of one in a store.
MOST_LANES, MOST_STORED = 10**7, 10**12
# Of an experiment of a scene: with more it goes into a store, unless it says otherwise.
MOST_UNSTORED = 4096
# Below this a step is judged by rounding errors alone, or by squares that underflow.
LEAST_RTOL, LEAST_ATOL = 1e-15, 1e-30
# Of smoothed friction against true dry friction, relative.
LEAST_ACCURACY, MOST_ACCURACY = 1e-8, 0.3
# The least positive number, and the greatest count: whatever is more is a slip of the pen.
LEAST_POSITIVE, MOST_COUNT = 1e-300, 10**9
# Processes of a cluster of one's own.
MOST_WORKERS = 10_000
