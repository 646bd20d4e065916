"""Which structured solver, and which linear solve, suits a chain and a tolerance."""

import numpy as np

from ._checks import is_traced
from .rosenbrock import AbstractStructuredRosenbrock, Rodas4, Rodas5P
from .structure import AbstractOscillators

# Steps beyond this length would gain nothing for a vibration of period about 2 pi.
MAX_STEP = 0.5
MOST_SWEEPS = 3


def choose_solver(
    field: AbstractOscillators, rtol: float, max_step: float = MAX_STEP
) -> AbstractStructuredRosenbrock:
    """Rodas4 down to rtol 1e-7 and Rodas5P below, with the linear solve that fits the coupling."""
    return fit_linear_solve(Rodas4() if rtol >= 1e-7 else Rodas5P(), field, rtol, max_step)


def fit_linear_solve(
    solver: AbstractStructuredRosenbrock,
    field: AbstractOscillators,
    rtol: float,
    max_step: float = MAX_STEP,
) -> AbstractStructuredRosenbrock:
    """The solver with as few sweeps as do not lengthen a run, or with the exact solve.

    Sweeps are never wrong: their bound is part of every step's error estimate.  They are slow if
    that part decides how long a step may be; here it must stay below rtol for a step as long as
    the tolerance allows a vibration.  Springs whose numbers are traced are taken for weak.
    """
    if field.springs is None:
        return solver
    if is_traced(field.springs.constant):
        return solver.with_sweeps(MOST_SWEEPS)
    # A vibration of period 2 pi takes steps of about 0.1 at 1e-6.
    step = min(max_step, 0.1 * (rtol / 1e-6) ** (1 / (solver.method_order + 1)))
    strongest = float(np.max(np.abs(field.springs.constant)))
    rho = (solver.tableau.gamma * step) ** 2 * 2.0 * strongest
    for sweeps in range(1, MOST_SWEEPS + 1):
        if solver.tableau.lag * rho ** (sweeps + 1) <= rtol * (1.0 - min(rho, 1.0)):
            return solver.with_sweeps(sweeps)
    return solver.with_sweeps(None)
