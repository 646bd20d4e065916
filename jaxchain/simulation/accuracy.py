"""The choice of solver, linear solve, width and tolerance for a chain and an accuracy."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from .._checks import check_number, check_positive_number, is_traced, shown
from .._final import final
from .._limits import LEAST_ACCURACY, LEAST_ATOL, LEAST_RTOL, MOST_ACCURACY
from .._printing import PrintedAsCall
from .._types import State
from ..model.arguments import as_chain
from ..model.cells import AbstractCells, AbstractField
from ..model.chain import Chain
from ..model.oscillators import AbstractOscillators
from ..solvers.rosenbrock import AbstractStructuredRosenbrock, Rodas4, Rodas5P
from .event_driven import EventDriven

# Longer steps have no advantage for a vibration of period about 2 pi.
MAX_STEP = 0.5
MOST_SWEEPS = 3


def check_span(t0: ArrayLike, t1: ArrayLike) -> None:
    """Raises `ValueError` unless concrete times t0 <= t1 are finite."""
    check_number("t0", t0, "it is a dimensionless time.")
    check_number("t1", t1, "it is a dimensionless time.")
    if not is_traced(t0, t1) and float(np.asarray(t1)) < float(np.asarray(t0)):
        raise ValueError(
            f"Argument `t1` = {t1} lies before `t0` = {t0}: dry friction cannot be integrated "
            "backward in time. Exchange them."
        )


def check_tolerances(rtol: ArrayLike, atol: ArrayLike | None, max_step: ArrayLike) -> None:
    """Raises `ValueError` for bad tolerances or step limits."""
    check_positive_number("rtol", rtol, "1e-6 is usual.")
    check_positive_number("max_step", max_step, "0.5 is usual, where a period is about 2 pi.")
    if not is_traced(rtol) and not LEAST_RTOL <= float(np.asarray(rtol)) < 1:
        raise ValueError(
            f"Argument `rtol` must be at least {LEAST_RTOL:g} and below 1, but is {rtol}: 64-bit "
            "floats hold 16 digits; 1e-6 is usual."
        )
    if atol is not None:
        check_positive_number("atol", atol, "a tenth of `rtol` is usual.")
        if not is_traced(atol) and float(np.asarray(atol)) < LEAST_ATOL:
            raise ValueError(
                f"Argument `atol` must be at least {LEAST_ATOL:g}, but is {atol}: a tenth of "
                "`rtol` is usual."
            )


def custom_solver(chain: Any, solver: Any) -> Any:
    """`solver`, or `EventDriven()` if none is given and friction is dry; otherwise None."""
    # Solvers that split the right-hand side into several terms have other term structures.
    suits = isinstance(solver, dfx.AbstractAdaptiveSolver) and isinstance(
        solver.term_structure, type
    )
    if solver is not None and not suits and not isinstance(solver, EventDriven):
        raise ValueError(
            "Argument `solver` must be None, `Rodas4()`, `Rodas5P()`, `EventDriven()` or another "
            "diffrax solver for one term that estimates its errors, but is "
            f"{shown(solver)}{_instead(solver)}"
        )
    if not chain.dry or isinstance(solver, EventDriven):
        return solver
    if solver is None:
        return EventDriven()
    raise ValueError(
        f"Argument `solver` is {shown(solver)}, but `chain` has dry friction, which only "
        "`EventDriven()` integrates: leave out `solver`, or smooth the friction, "
        "`chain.with_(width=1e-3)`."
    )


def _instead(solver: Any) -> str:
    """The end of an error: what was probably meant."""
    if isinstance(solver, type) and issubclass(solver, EventDriven | dfx.AbstractSolver):
        return f": give an object of it, `{solver.__name__}()`."
    name = solver if isinstance(solver, str) else ""
    if name in ("Rodas4", "Rodas5P", "EventDriven"):
        return f": give the solver itself, `{name}()`, not its name."
    return ": leave it out, and one that suits the chain is taken."


def check_adjoint(adjoint: Any) -> None:
    """Raises `ValueError` for an unsupported `adjoint`."""
    kinds = dfx.ForwardMode | dfx.RecursiveCheckpointAdjoint
    if adjoint is not None and not isinstance(adjoint, kinds):
        raise ValueError(
            "Argument `adjoint` must be None, `diffrax.ForwardMode()` or "
            f"`diffrax.RecursiveCheckpointAdjoint()`, but is {shown(adjoint)}. None serves "
            "derivatives of both kinds."
        )


def choose_solver(
    field: AbstractField, rtol: float, max_step: float = MAX_STEP, state: State | None = None
) -> AbstractStructuredRosenbrock:
    """Rodas4 down to rtol 1e-7 and Rodas5P below, with the linear solve that fits the coupling."""
    solver = Rodas4() if rtol >= 1e-7 else Rodas5P()
    return fit_linear_solve(solver, field, rtol, max_step, state)


def fit_linear_solve(
    solver: AbstractStructuredRosenbrock,
    field: AbstractField,
    rtol: float,
    max_step: float = MAX_STEP,
    state: State | None = None,
) -> AbstractStructuredRosenbrock:
    """The solver with the fewest sweeps that do not slow down a run, or with the exact solve.

    Sweeps are safe, because their error bound is part of the error estimate of each step.  They
    are slow if this part limits the step; here it must stay below rtol for a step as long as the
    tolerance allows for a vibration.  Traced springs are assumed to be weak.  For `AbstractCells`
    the coupling is measured at `state`; if it is traced, the solve is exact.
    """
    # A vibration of period 2 pi takes steps of about 0.1 at 1e-6.
    step = min(max_step, 0.1 * (rtol / 1e-6) ** (1 / (solver.method_order + 1)))
    if isinstance(field, AbstractCells):
        if state is None or is_traced(field, state):
            return solver.with_sweeps(None)
        rho = float(_contraction(field, state, solver.tableau.gamma * step))
    elif not isinstance(field, AbstractOscillators) or field.springs is None:
        return solver
    elif is_traced(field.springs.constant):
        return solver.with_sweeps(MOST_SWEEPS)
    else:
        strongest = float(np.max(np.abs(field.springs.constant)))
        rho = (solver.tableau.gamma * step) ** 2 * 2.0 * strongest
    for sweeps in range(1, MOST_SWEEPS + 1):
        if solver.tableau.lag * rho ** (sweeps + 1) <= rtol * (1.0 - min(rho, 1.0)):
            return solver.with_sweeps(sweeps)
    return solver.with_sweeps(None)


@eqx.filter_jit
def _contraction(cells: AbstractCells, state: State, step: float) -> Array:
    """By which a sweep contracts at a state, for a step of this length; 0 without neighbours."""
    rho = cells.linearised(0.0, state).jacobian.shift(1.0 / step).solver(1).contraction
    return jnp.zeros(()) if rho is None else rho


USUAL_RTOL = 1e-6
# The remedy if `accuracy`, the error of smoothing, is given for a dry chain.
NO_ACCURACY = "give `rtol` instead of `accuracy`, which picks a width, or "
# The greatest tolerance on a velocity is width / (`_LAYER` sqrt(n)), and by default it is smaller
# by a factor of `_CLEAN` / `_LAYER`; n counts up to `_NORM_MASSES` (see `check_resolved`).
_CLEAN, _LAYER, _NORM_MASSES = 3.0, 1.0, 20
# Both are smaller by this factor for stock solvers: explicit ones err by hundreds of tolerances.
_STOCK = 10.0


def _margin(solver: Any) -> float:
    own = solver is None or isinstance(solver, AbstractStructuredRosenbrock)
    return 1.0 if own else _STOCK


def default_rtol(n: int, width: Any, belt_speed: Any, solver: Any = None) -> Any:
    """1e-6, or less where a width is so narrow that a sticking mass needs it.

    width / [3 sqrt(min(n, 20)) (|v_d| + 0.1)], for the least width and the greatest speed;
    a tenth of that for a stock `solver`.
    """
    traced = is_traced(width, belt_speed)
    xp: Any = jnp if traced else np
    width, belt_speed = (a if traced else np.asarray(a) for a in (width, belt_speed))
    speed = xp.max(xp.abs(belt_speed)) + 0.1
    needed = xp.min(width) / (_margin(solver) * _CLEAN * min(n, _NORM_MASSES) ** 0.5 * speed)
    rtol = xp.minimum(USUAL_RTOL, needed)
    return lax.stop_gradient(rtol) if traced else float(rtol)


# The ratio of the error of smoothing to `_bias` that one in fifty exceeds; measured on 160 random
# chains of six masses, widths 0.03 to 1e-5, against dry friction.
_WORST = 6.0
# The error of integration is at most some 5 rtol, so at this share of the width it is small beside
# that of smoothing.
_RTOL_PER_WIDTH = 0.1


@final
class Numerics(PrintedAsCall, eqx.Module):
    """The choice of `choose_numerics`: a regularization width, a tolerance and a solver.

    - `width`: eps, a speed in units of x0 omega_n; `rtol`: the relative tolerance of the steps.
    - `solver`: a `Rodas4` or `Rodas5P`, with a number of Jacobi sweeps that suits the coupling.

    See `choose_numerics` for an example.
    """

    width: Array
    rtol: Array
    solver: AbstractStructuredRosenbrock = eqx.field(static=True)


def choose_numerics(chain: Chain, accuracy: Any) -> Numerics:
    """The cheapest smoothed computation with an error of at most `accuracy`.

    The error is relative to dry friction and to the greatest amplitude of the run.

    **Promised:**

    - for 30 time units from the start, some five periods: every displacement and velocity, and so
      every amplitude;
    - at any later time: settled amplitudes, those that agree within `accuracy` in four successive
      windows of at least 20 time units each (see `settled`).

    Of 1000 random chains of two to six masses with couplings up to 0.05, run for 400 time units at
    accuracies of 0.1, 1e-2 and 1e-3, at most four at each accuracy broke the first promise, by a
    factor of up to 6.4.  The second one was broken by 21, 1 and 0 of them, whose smoothed chain
    had settled on another state than the dry one.

    **Not promised:** later states, because errors of the period add up; and later amplitudes that
    still change, while a mass starts or stops vibrating, while amplitudes beat, or for irregular
    motion.  There the chain amplifies every disturbance, and smoothing shifts the time at which a
    mass starts or stops vibrating.  8 % of the same runs had such a window (15 % above the Hopf
    speed, 2 % below), with errors of up to 110 times `accuracy`, and 2 % (4 % at 0.1) ended in
    one.  A tenth of `accuracy` takes 40 % more steps and leaves 1 %.  A second run with four times
    the accuracy reveals them: where the two differ by more than `accuracy`, the error may be
    greater (of 1000 last windows this missed 0 at 1e-3 and 2 at 1e-2).  `EventDriven()` has no
    width.

    The smoothed force is smaller than the dry one by

        dF = (eps s / 2) [ln(4 mu_st / (eps s)) + 1],    s = |mu'(0)|,

    at its maximum, and its transitions take times of order eps.  So the error is a measured
    multiple of (dF + eps) / A, with A^2 = v_d^2 + (mu_st - mu(2 v_d))^2 / 4 as an estimate of the
    amplitude.

    **Arguments:** `accuracy`, between 1e-8 and 0.3.

    **Returns:** a `Numerics`.

    **Raises:** `ValueError` for anything else.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.simulation import choose_numerics
    >>> chosen = choose_numerics(paper_chain(), accuracy=1e-2)
    >>> print(f"width {float(chosen.width):.1e}, rtol {float(chosen.rtol):.1e}, {chosen.solver}")
    width 4.2e-04, rtol 2.8e-05, Rodas4(sweeps=1)
    """
    as_chain(chain)
    check_number("accuracy", accuracy, "1e-3 is 0.1 %.")
    if not is_traced(accuracy) and not LEAST_ACCURACY <= float(accuracy) <= MOST_ACCURACY:
        raise ValueError(
            f"Argument `accuracy` must lie between {LEAST_ACCURACY:g} and {MOST_ACCURACY:g}, but "
            f"is {accuracy}: it is a relative error. For less error use `EventDriven()`, which "
            "has no width."
        )
    law = chain.law
    load = jnp.max(chain.load)
    zero = jnp.zeros_like(jnp.asarray(law.mu_static, float))
    _, slope = jax.jvp(law.coefficient, (zero,), (jnp.ones_like(zero),))
    slope = load * jnp.maximum(jnp.max(jnp.abs(slope)), 1e-12)
    mu = load * jnp.max(law.mu_static)
    # Masses slide at up to twice the belt's speed.
    drop = load * jnp.max(law.mu_static - law.coefficient(2.0 * jnp.abs(chain.belt_speed)))
    amplitude = jnp.sqrt(chain.belt_speed**2 + (drop / 2) ** 2)
    allowed = accuracy * jnp.maximum(amplitude, 1e-3 * mu) / _WORST

    def shorter(_: Any, width: Array) -> Array:
        # allowed = dF + eps, solved for the eps outside the logarithm: contracts strongly.
        logarithm = jnp.log(jnp.maximum(4.0 * mu / (width * slope), 1.0))
        return allowed / (1.0 + 0.5 * slope * (logarithm + 1.0))

    width = lax.fori_loop(0, 30, shorter, jnp.asarray(allowed, float))
    rtol = _RTOL_PER_WIDTH * width / jnp.maximum(jnp.abs(chain.belt_speed), 1.0)
    solver = choose_solver(chain, 1e-9 if is_traced(rtol) else float(rtol))
    return Numerics(*lax.stop_gradient((width, rtol)), solver)


def check_resolved(
    n: int,
    width: ArrayLike,
    belt_speed: ArrayLike,
    rtol: ArrayLike,
    atol: ArrayLike | None,
    solver: Any = None,
) -> None:
    """Raises `ValueError` if the tolerance on velocities is too coarse for the width.

    A mass sticks with |w| < eps, about.  If the tolerance on its velocity, atol + rtol |v_d|, is
    greater, it need not stick where it should; up to there the error of a run is a few times its
    tolerance (see `SwitchingController`).  The norm of the error is a mean over masses, so one of
    n masses may have sqrt(n) times the tolerance; the norm limits n to 20.
    """
    if is_traced(width, belt_speed, rtol, atol):
        return
    per_speed = np.max(np.abs(np.asarray(belt_speed)))
    least, rtol = float(np.min(np.asarray(width))), float(np.asarray(rtol))
    allowed = least / (_margin(solver) * _LAYER * min(n, _NORM_MASSES) ** 0.5)
    given = 0.1 * rtol if atol is None else float(np.asarray(atol))
    if given + rtol * per_speed <= allowed:
        return
    tighter = allowed / (per_speed + 0.1) / 3
    remedies = [f"a width of {3 * (given + rtol * per_speed) / allowed * least:.0e}"]
    if tighter >= LEAST_RTOL:
        remedies.insert(0, f"`rtol` = {tighter:.0e} (`atol` a tenth of it)")
    raise ValueError(
        f"Arguments `rtol` = {rtol:g} and `atol` = {given:g} are too loose for a regularization "
        f"width of {least:g} at a belt speed of {per_speed:g}: errors of that size in a velocity "
        f"release sticking masses. Use {', or '.join(remedies)}, or dry "
        "friction, a width of None."
    )
