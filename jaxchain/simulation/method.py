"""How runs are integrated: the solver, its linear solve, tolerances and steps, in one place."""

from collections.abc import Callable
from typing import Any, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from .._checks import (
    check_count,
    check_kind,
    check_number,
    check_positive_number,
    is_traced,
    shown,
)
from .._limits import LEAST_ATOL, LEAST_RTOL
from .._printing import PrintedAsCall
from .._types import Given, ScalarLike, State
from ..model.cells import AbstractCells
from ..model.model import AbstractModel
from ..model.oscillators import AbstractOscillators
from ..observers.base import AbstractObserver
from ..solvers.rosenbrock import AbstractStructuredRosenbrock, Rodas4, Rodas5P
from .event_driven import EventDriven
from .plan import AbstractPlan
from .smoothed import SmoothedPlan

Solver: TypeAlias = dfx.AbstractSolver | EventDriven
Start: TypeAlias = State | Callable[[], State]  # or what makes it, called only if it is needed
# Longer steps have no advantage for a vibration of period about 2 pi.
MAX_STEP = 0.5
MOST_SWEEPS = 3


USUAL_RTOL = 1e-6


class Method(PrintedAsCall, eqx.Module):
    """How runs are integrated: a solver, its tolerances and its steps.

    Functions that run a model take the fields as arguments of their own, or all of them as
    `method=Method(...)`.  What is None is chosen for the model:

    - `solver`: `EventDriven()` for dry friction, else `Rodas4()` down to a tolerance of 1e-7 and
      `Rodas5P()` below.  Smoothed friction also works with any diffrax solver for one term, and
      with `EventDriven()`, which ignores the width.
    - `rtol`: the relative tolerance of a step, 1e-6, or less where friction changes its sign
      within a narrow width: width / [3 sqrt(min(n, 20)) (|v_d| + 0.1)].
    - `atol`: the absolute one, rtol / 10, in the units of `MechanicalCells`, see its `sizes`.
    - `max_step`: the longest step, 0.5 (dimensionless time; a period is about 2 pi), of
      `MechanicalCells` times 1 / sqrt(k/m) of the contact, or without one of what is slowest.
    - `max_steps`: the greatest number of steps, accepted or rejected; without it no limit.

    **Raises:** `ValueError` for impossible numbers when a run begins; for tolerances on a velocity
    that are too coarse for the width of friction; for a solver that does not suit the model.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Method, equation_8, paper_chain, simulate
        >>> chain, precise = paper_chain(1, width=1e-2), Method(rtol=1e-9)
        >>> run = simulate(chain, equation_8(chain, 1), 10.0, method=precise)
        >>> precise.suited(chain, 1)
        Method(solver=Rodas5P, rtol=1e-09, atol=1e-10, max_step=0.5)
    """

    solver: Solver | None = None
    rtol: Given[ScalarLike | None] = None
    atol: Given[ScalarLike | None] = None
    max_step: Given[ScalarLike | None] = None
    max_steps: int | None = eqx.field(static=True, default=None)

    @classmethod
    def of(cls, method: Any, **fields: Any) -> "Method":
        """`method`, or the one of these fields, of which those that are not given are None."""
        given = {name: value for name, value in fields.items() if value is not None}
        if method is None:
            return cls(**given)
        check_kind("method", method, Method, "None or a `Method`", "such as `Method(rtol=1e-9)`.")
        if given:
            raise ValueError(
                f"Arguments `method` and `{next(iter(given))}` are both given: put it into the "
                f"method, `Method({', '.join(f'{name}=...' for name in given)})`."
            )
        return method

    @property
    def dry(self) -> bool:
        """Whether it integrates dry friction, by events."""
        return isinstance(self.solver, EventDriven)

    def checked(self, model: AbstractModel, n: int, scale: Any = ()) -> "Method":
        """With tolerances and steps for this model of n cells, and `EventDriven()` if it is dry.

        **Arguments:** `scale`: what takes the place of `model.smallest_scale(n)` in a sweep.
        """
        solver = custom_solver(model, self.solver)
        if isinstance(solver, EventDriven):
            scale = None
        elif scale == ():
            scale = model.smallest_scale(n)
        time, unit, _ = model.natural_scales()
        rtol = default_rtol(n, scale, solver, unit) if self.rtol is None else self.rtol
        max_step = MAX_STEP * time if self.max_step is None else self.max_step
        check_tolerances(rtol, self.atol, max_step)
        check_resolved(n, scale, rtol, self.atol, solver, unit)
        check_count("max_steps", self.max_steps)
        atol = 0.1 * rtol if self.atol is None else self.atol
        return Method(solver, rtol, atol, max_step, self.max_steps)

    def suited(
        self, model: AbstractModel, n: int, start: "Start | None" = None, scale: Any = ()
    ) -> "Method":
        """`checked`, and with the solver that suits the model, from a state of it."""
        method = self.checked(model, n, scale)
        if method.solver is not None:
            return method
        rtol, max_step = _concrete(method.rtol, 1e-6), _concrete(method.max_step, MAX_STEP)
        solver = choose_solver(model, rtol, max_step, start)
        return Method(solver, method.rtol, method.atol, method.max_step, method.max_steps)

    def plan(self, observers: list[AbstractObserver], t1: ScalarLike) -> AbstractPlan:
        """The plan of a run to t1 by this method, which is `suited`."""
        solver: Any = self.solver
        if isinstance(solver, EventDriven):
            tight = _concrete(self.rtol, 1e-6)
            return solver.plan(observers, self.rtol, self.atol, self.max_step, tight)
        return SmoothedPlan(
            solver=solver, observers=observers, rtol=self.rtol, atol=self.atol,
            max_step=self.max_step, t1=t1,
        )  # fmt: skip


def _concrete(value: Any, default: float) -> float:
    """A concrete number to choose a method; for a traced one the default."""
    return default if is_traced(value) else float(value)


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


def custom_solver(model: Any, solver: Any) -> Any:
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
    if not model.dry or isinstance(solver, EventDriven):
        return solver
    if solver is None:
        return EventDriven()
    raise ValueError(
        f"Argument `solver` is {shown(solver)}, but `model` has dry friction, which only "
        "`EventDriven()` integrates: leave out `solver`, or smooth the friction, "
        "`model.with_(width=1e-3)`."
    )


def _instead(solver: Any) -> str:
    """The end of an error: what was probably meant."""
    if isinstance(solver, type) and issubclass(solver, EventDriven | dfx.AbstractSolver):
        return f": give an object of it, `{solver.__name__}()`."
    name = solver if isinstance(solver, str) else ""
    if name in ("Rodas4", "Rodas5P", "EventDriven"):
        return f": give the solver itself, `{name}()`, not its name."
    return ": leave it out, and one that suits the chain is taken."


def choose_solver(
    field: AbstractModel, rtol: float, max_step: float | None = None, state: Start | None = None
) -> AbstractStructuredRosenbrock:
    """Rodas4 down to rtol 1e-7 and Rodas5P below, with the linear solve that fits the coupling."""
    solver = Rodas4() if rtol >= 1e-7 else Rodas5P()
    return fit_linear_solve(solver, field, rtol, max_step, state)


def fit_linear_solve(
    solver: AbstractStructuredRosenbrock,
    field: AbstractModel,
    rtol: float,
    max_step: float | None = None,
    state: Start | None = None,
) -> AbstractStructuredRosenbrock:
    """The solver with the fewest sweeps that do not slow down a run, or with the exact solve.

    Sweeps are safe, because their error bound is part of the error estimate of each step.  They
    are slow if this part limits the step; here it must stay below rtol for a step as long as the
    tolerance allows for a vibration.  Traced springs are assumed to be weak.  For `AbstractCells`
    the coupling is measured at `state`; if it is traced, the solve is exact.
    """
    # A vibration of period 2 pi takes steps of about 0.1 at 1e-6.
    time = _concrete(field.natural_scales()[0], 1.0)
    step = 0.1 * time * (rtol / 1e-6) ** (1 / (solver.method_order + 1))
    step = min(MAX_STEP * time if max_step is None else max_step, step)
    if isinstance(field, AbstractCells):
        state = state() if callable(state) else state
        if state is None or is_traced(field, state):
            return solver.with_sweeps(None)
        rho = float(_contraction(field, state, jnp.asarray(solver.tableau.gamma * step)))
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
def _contraction(cells: AbstractCells, state: State, step: Float[Array, ""]) -> Array:
    """By which a sweep contracts at a state, for a step of this length; 0 without neighbours."""
    rho = cells.linearised(0.0, state).jacobian.shift(1.0 / step).solver(1).contraction
    return jnp.zeros(()) if rho is None else rho


# The greatest tolerance on a velocity is width / (`_LAYER` sqrt(n)), and by default it is smaller
# by a factor of `_CLEAN` / `_LAYER`; n counts up to `_NORM_MASSES` (see `check_resolved`).
_CLEAN, _LAYER, _NORM_MASSES = 3.0, 1.0, 20
# Both are smaller by this factor for stock solvers: explicit ones err by hundreds of tolerances.
_STOCK = 10.0


def _margin(solver: Any) -> float:
    own = solver is None or isinstance(solver, AbstractStructuredRosenbrock)
    return 1.0 if own else _STOCK


Scale: TypeAlias = tuple[Any, Any] | None  # (width, speed), see `AbstractModel.smallest_scale`


def default_rtol(n: int, scale: Scale, solver: Any = None, unit: Any = 1.0) -> Any:
    """1e-6, or less where a width is so narrow that a sticking mass needs it.

    width / [3 sqrt(min(n, 20)) (|v_d| + 0.1 V)], for the least width and the greatest speed, V the
    natural velocity; a tenth of that for a stock `solver`.
    """
    if scale is None:
        return USUAL_RTOL
    width, belt_speed = scale
    traced = is_traced(width, belt_speed, unit)
    xp: Any = jnp if traced else np
    width, belt_speed, unit = (a if traced else np.asarray(a) for a in (width, belt_speed, unit))
    speed = xp.max(xp.abs(belt_speed)) + 0.1 * unit
    needed = xp.min(width) / (_margin(solver) * _CLEAN * min(n, _NORM_MASSES) ** 0.5 * speed)
    rtol = xp.minimum(USUAL_RTOL, needed)
    return lax.stop_gradient(rtol) if traced else float(rtol)


def check_resolved(
    n: int, scale: Scale, rtol: ArrayLike, atol: ArrayLike | None, solver: Any, unit: Any
) -> None:
    """Raises `ValueError` if the tolerance on velocities is too coarse for the width.

    A mass sticks with |w| < eps, about.  If the tolerance on its velocity, atol V + rtol |v_d|, is
    greater, it need not stick where it should; up to there the error of a run is a few times its
    tolerance (see `SwitchingController`).  The norm of the error is a mean over masses, so one of
    n masses may have sqrt(n) times the tolerance; the norm limits n to 20.
    """
    if scale is None or is_traced(scale, rtol, atol, unit):
        return
    width, belt_speed = scale
    per_speed = np.max(np.abs(np.asarray(belt_speed)))
    least, rtol = float(np.min(np.asarray(width))), float(np.asarray(rtol))
    allowed = least / (_margin(solver) * _LAYER * min(n, _NORM_MASSES) ** 0.5)
    given = 0.1 * rtol if atol is None else float(np.asarray(atol))
    unit = float(unit)
    if given * unit + rtol * per_speed <= allowed:
        return
    tighter = allowed / (per_speed + 0.1 * unit) / 3
    remedies = [f"a width of {3 * (given * unit + rtol * per_speed) / allowed * least:.0e}"]
    if tighter >= LEAST_RTOL:
        remedies.insert(0, f"`rtol` = {tighter:.0e} (`atol` a tenth of it)")
    raise ValueError(
        f"Arguments `rtol` = {rtol:g} and `atol` = {given:g} are too loose for a regularization "
        f"width of {least:g} at a belt speed of {per_speed:g}: errors of that size in a velocity "
        f"release sticking masses. Use {', or '.join(remedies)}, or dry "
        "friction, a width of None."
    )
