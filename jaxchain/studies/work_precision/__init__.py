"""Error over run time, for the solvers here and for others."""
