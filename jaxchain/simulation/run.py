"""One run of a chain."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from .._checks import (
    check_count,
    check_flag,
    is_traced,
    shown,
    to_float,
)
from .._derivatives import both_ways
from .._printing import Sketch
from .._types import Given, ScalarLike, State, StateLike
from ..model.arguments import as_model, as_state
from ..model.model import AbstractModel
from ..observers.base import AbstractObserver
from ..observers.samples import Trajectory
from ..result import NAMES, Printed, Result, code, ended_well, message
from .accuracy import Numerics, check_accuracy, choose_numerics
from .dataset import Origin, run_dataset
from .event_driven import EventDriven
from .method import Method, check_span, custom_solver
from .plan import CHECKPOINTS, AbstractPlan, Progress

if TYPE_CHECKING:
    from xarray import Dataset


def _is_observer(x: Any) -> bool:
    return isinstance(x, AbstractObserver | Trajectory)


class Simulation(Printed, eqx.Module):
    """The result of a run.

    - `t`: the time at which it ended; earlier than `t1` if it stopped early or failed.
    - `state`: (x, v) at that time.
    - `observed`: the values of the observers in `observe`, in the same structure.
    - `result`: see `Result`; `outcome` is its name, such as "successful".
    - `steps`, `rejected`: accepted and rejected steps.
    - `numerics`: the width, tolerance and solver that `accuracy` chose, or None.
    - `origin`: the arguments of the run, for `to_dataset`.

    See `simulate` for an example.
    """

    t: Float[Array, ""]
    state: State
    observed: Any
    result: Result
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    numerics: Numerics | None = None
    origin: Origin = eqx.field(static=True, default=Origin())

    def _instead(self) -> dict[str, str]:
        return {"origin": ""}

    def _sketch(self) -> Sketch | None:
        """The first variable: over time of a `Trajectory`, otherwise of each mass at the end."""
        if self.origin.chain is None:  # traced when it was made
            return None
        name = self.origin.chain.variable(0).name
        observed = self.origin.treedef.flatten_up_to(self.observed)
        for observer, value in zip(self.origin.observers, observed, strict=True):
            if isinstance(observer, Trajectory):
                first = np.reshape(value[0], (-1, self.state[0].size))
                return Sketch("time", name, [(observer.times, first)])
        if self.state[0].size < 2:
            return None
        masses = np.arange(1, self.state[0].size + 1)
        return Sketch("oscillator", f"{name} at the end", [(masses, self.state[0])])

    def to_dataset(self) -> Dataset:
        """The run as an `xarray.Dataset`, with the names, units and attributes of `sweep`.

        It holds what the observers `label`, the last state (`end_displacement`, `end_velocity`; of
        other cells `end_<component>`), and `result`, `end_time`, `steps` and `rejected`; of a
        `Trajectory` `displacement` and `velocity` (or the components) over `time`.  With
        `segments` observed values have the dimension `segment`.

        **Raises:** `ValueError` for a run made within `jit`, `vmap` or `grad` (use `sweep` for
        many runs), for an observer without `label`, and for two that name one variable.

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, paper_chain, simulate
        >>> chain = paper_chain(3)
        >>> run = simulate(chain, equation_8(chain, 1), 50.0, observe=Amplitude(window=20.0))
        >>> data = run.to_dataset()
        >>> data.amplitude.dims, data.amplitude.attrs["units"], data.attrs["t1"]
        (('oscillator',), 'x0', 50.0)
        """
        if self.origin.chain is None or is_traced(self.t) or np.ndim(self.t):
            raise ValueError(
                "`Simulation.to_dataset` is for one run that `simulate` returned outside of "
                "`jit`, `vmap` and `grad`: use `sweep` for many runs, whose result is a dataset."
            )
        return run_dataset(self.origin, self)

    @property
    def outcome(self) -> str:
        """The name of the result of one run (not of a batch), see `jaxchain.Result`."""
        return NAMES[int(code(self.result))]


def simulate(
    model: AbstractModel,
    initial: Given[StateLike],
    t1: ScalarLike,
    *,
    t0: ScalarLike = 0.0,
    observe: PyTree = None,
    method: Method | None = None,
    solver: dfx.AbstractSolver | EventDriven | None = None,
    accuracy: Given[ScalarLike | None] = None,
    rtol: ArrayLike | None = None,
    atol: ArrayLike | None = None,
    max_step: ArrayLike | None = None,
    max_steps: int | None = None,
    segments: int | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    throw: bool = True,
) -> Simulation:
    """Integrates a chain from (x, v) = `initial` at t0 to t1, and evaluates observers.

    **Arguments:**

    - `model`: a `Chain`, `AbstractOscillators` or `AbstractCells`.
    - `initial`: the pair (x, v), both of shape (n,); see `excited_state`, `equation_8`.  Of other
      cells a tuple of m arrays of shape (n,).
    - `t1`, `t0`: dimensionless times, t1 >= t0.
    - `observe`: an observer (`Amplitude`, `PeakTimes`, `Section`, `Trajectory`) or any nested
      tuple, list or dict of them.  Nothing else is computed or stored.
    - `method`: how the run is integrated, see `Method`; or its fields `solver`, `rtol`, `atol`,
      `max_step` and `max_steps` (of each segment) as arguments of their own.
    - `accuracy`: the allowed error against dry friction, relative to the greatest amplitude.  It
      holds for 30 time units from the start, and later for amplitudes that have `settled`; while
      masses start or stop vibrating, the error may be a hundred times greater (see
      `choose_numerics`).  It determines the width, `rtol` and the default solver, which `numerics`
      reports.
    - `segments`: the number of parts of equal length.  Observers start anew in each part, and
      their values are stacked along a first axis.
    - `adjoint`: the default works with `jvp`, `jacfwd`, `grad` and `jacrev`, in bounded memory for
      any length of run: some states are kept, and the steps between them are computed again.  A
      gradient costs as much as a few runs for any number of parameters; the cost of `jacfwd` grows
      with their number, and is less for a few of them.
      `diffrax.RecursiveCheckpointAdjoint(checkpoints=...)` keeps that number of states;
      `diffrax.ForwardMode()` works with `jvp` and `jacfwd` only.  For second derivatives use
      `jax.hessian`, or `jacfwd` twice.  With smoothed friction, both kinds of derivatives use the
      steps of the plain run: the first 32,768, or `max_steps` if it is given (8 bytes each).
      Later steps are chosen again in reverse mode, which costs digits at tight tolerances.
    - `throw`: raise an error if the run fails; otherwise check `result`.

    **Returns:** a `Simulation`: the last time and state, the observed values, and the result.

    **Raises:** `ValueError` for bad input before anything is compiled; `RuntimeError` with advice
    if the run fails and `throw` is set.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, active, equation_8, paper_chain, simulate
        >>> chain = paper_chain(n=20, belt_speed=1.5)
        >>> run = simulate(chain, equation_8(chain, 1), 200.0, observe=Amplitude(window=50.0))
        >>> int(active(run.observed, 1.5).sum())
        1
    """
    as_model(model)
    method = Method.of(
        method, solver=solver, rtol=rtol, atol=atol, max_step=max_step, max_steps=max_steps
    )
    solver = custom_solver(model, method.solver)
    check_adjoint(adjoint)
    check_flag("throw", throw)
    check_span(t0, t1)
    check_segments(segments)
    numerics = None
    if accuracy is not None:
        check_accuracy(model, accuracy, method.rtol)
        numerics = choose_numerics(model, accuracy)
        if not isinstance(solver, EventDriven):
            model = model.with_(width=numerics.width)
            solver = numerics.solver if solver is None else solver
        method = dataclasses.replace(method, solver=solver, rtol=numerics.rtol)
    initial = as_state(model, initial, t0=t0)
    method = method.suited(model, initial[0].shape[0], initial)
    leaves, treedef = jtu.tree_flatten(observe, is_leaf=_is_observer)
    for leaf in leaves:
        if not _is_observer(leaf):
            raise ValueError(
                "Argument `observe` must hold observers (`Amplitude`, `PeakTimes`, `Section`, "
                f"`Trajectory`), but holds {shown(leaf)}: see `jaxchain.observers`."
            )
        if isinstance(leaf, Trajectory):
            _check_trajectory(leaf, t0, t1, segments)
    observers = [o for o in leaves if isinstance(o, AbstractObserver)]
    check_fit(observers, t0, t1, segments)
    plan = method.plan(observers, t1)
    trajectories = [o for o in leaves if isinstance(o, Trajectory)]
    out, values = _run(
        plan, model, initial, to_float(t0), to_float(t1), trajectories,
        method.max_steps, segments, adjoint,
    )  # fmt: skip
    if throw:
        out, values = _raise_on_failure(out, values)
    observed_values = iter(values[0])
    trajectory_values = iter(values[1])
    observed = jtu.tree_unflatten(
        treedef,
        [
            next(trajectory_values) if isinstance(o, Trajectory) else next(observed_values)
            for o in leaves
        ],
    )
    origin = Origin()
    if not is_traced(out, plan, model, leaves, t0, t1):
        origin = Origin(model, leaves, treedef, plan, float(t0), float(t1), segments)
    return Simulation(
        out.t, out.state, observed, out.result, out.steps, out.rejected,
        None if method.dry else numerics, origin,
    )  # fmt: skip


def check_adjoint(adjoint: Any) -> None:
    """Raises `ValueError` for an unsupported `adjoint`."""
    kinds = dfx.ForwardMode | dfx.RecursiveCheckpointAdjoint
    if adjoint is not None and not isinstance(adjoint, kinds):
        raise ValueError(
            "Argument `adjoint` must be None, `diffrax.ForwardMode()` or "
            f"`diffrax.RecursiveCheckpointAdjoint()`, but is {shown(adjoint)}. None serves "
            "derivatives of both kinds."
        )


@eqx.filter_jit
def _run(
    plan: AbstractPlan,
    model: AbstractModel,
    initial: State,
    t0: Array,
    t1: Array,
    trajectories: list[Trajectory],
    max_steps: int | None,
    segments: int | None,
    adjoint: dfx.AbstractAdjoint | None,
) -> tuple[Progress, tuple[list, list]]:
    fits = jnp.all(jnp.asarray([_fits(o, t0, t1, segments) for o in plan.observers], bool))

    def begin(end: Array) -> Progress:
        progress = plan.begin(model, initial, t0, end)
        # Traced times cannot be refused, so the run is marked.
        result = Result.where(progress.running & ~fits, Result.bad_span, progress.result)
        return eqx.tree_at(lambda p: p.result, progress, result)

    def read(progress: Progress) -> list:
        # A run that does not begin has NaN: an amplitude of 0 would look like rest.
        return jtu.tree_map(
            lambda a: jnp.where(fits, a, jnp.nan) if eqx.is_inexact_array(a) else a,
            plan.read(progress),
        )

    if segments is None:
        progress = begin(t1)
        times = [o.times for o in trajectories]
        progress, saved = _advance(plan, model, progress, t1, times, max_steps, adjoint)
        return progress, (read(progress), saved)

    def segment(progress: Progress, ends: tuple[Array, Array]) -> tuple[Progress, list]:
        start, end = ends
        fresh = [o.init(model, start, end, progress.state) for o in plan.observers]
        progress = eqx.tree_at(lambda p: p.accumulators, progress, fresh)
        progress, _ = _advance(plan, model, progress, end, [], max_steps, adjoint, segments)
        return progress, read(progress)

    edges = t0 + (t1 - t0) * jnp.arange(segments + 1) / segments
    progress = begin(edges[1])
    progress, values = lax.scan(segment, progress, (edges[:-1], edges[1:]))
    return progress, (values, [])


def _fits(observer: AbstractObserver, t0: Any, t1: Any, segments: int | None) -> Any:
    """Whether the run, or its last segment, contains the observed part."""
    return observer.fits(t1 - (t1 - t0) / (segments or 1), t1)


def check_fit(observers: list[AbstractObserver], t0: Any, t1: Any, segments: int | None) -> None:
    """Raises `ValueError` if an observer's window is longer than the run, or than a segment."""
    if is_traced(t0, t1):
        return
    t0, t1 = float(t0), float(t1)
    for observer in observers:
        fits = _fits(observer, t0, t1, segments)
        if not is_traced(fits) and not fits:
            part = "the run" if segments is None else f"each of {segments} segments of the run"
            raise ValueError(
                f"Argument `observe` holds `{observer!r}`, which does not fit into {part} from "
                f"t = {t0:g} to {t1:g}: give a shorter `window`, a `start` before the end, or a "
                "later `t1`."
            )


# The observed values of each segment are kept.
MOST_SEGMENTS = 10**6
# The most bytes of the kept states, and of the ends of steps.
_KEPT = 2**26
# The number of stored ends of steps if `max_steps` does not bound it.
_RECORDED = 2**15


def _advance(
    plan: AbstractPlan, model: AbstractModel, progress: Progress, t1: Array, times: list,
    max_steps: int | None, adjoint: dfx.AbstractAdjoint | None, parts: int = 1,
) -> tuple[Progress, list]:  # fmt: skip
    """`plan.advance`, with derivatives of both kinds if `adjoint` is None."""

    def go(adjoint: dfx.AbstractAdjoint, recorded: int | None = None) -> Any:
        def run(args: Any) -> tuple[Progress, list]:
            plan, model, progress, t1, times = args
            return plan.advance(
                model, progress, t1, max_steps=max_steps, times=times, adjoint=adjoint,
                recorded=recorded,
            )  # fmt: skip

        return run

    args = plan, model, progress, t1, times
    if adjoint is None or (
        isinstance(adjoint, dfx.RecursiveCheckpointAdjoint)
        and adjoint.checkpoints is None
        and max_steps is None
    ):
        size = sum(leaf.nbytes for leaf in jtu.tree_leaves(progress))
        checkpoints = min(CHECKPOINTS, max(_KEPT // (parts * size), 32))
        adjoint = dfx.RecursiveCheckpointAdjoint(checkpoints=checkpoints)
    recorded = min(_RECORDED if max_steps is None else max_steps, _KEPT // (8 * parts))
    forward = dfx.ForwardMode()
    return both_ways(go(forward), go(adjoint, recorded), args, go(forward, recorded))


def check_segments(segments: Any) -> None:
    """Raises `ValueError` unless it is None or a number of segments."""
    check_count("segments", segments, MOST_SEGMENTS, "it is the number of parts of a run.")


def _check_trajectory(trajectory: Trajectory, t0: Any, t1: Any, segments: int | None) -> None:
    times = trajectory.times
    if segments is not None:
        raise ValueError(
            "A `Trajectory` cannot be observed together with `segments`: its times lie in several "
            "of them. Leave out `segments`."
        )
    if is_traced(times, t0, t1):
        return
    ts = np.asarray(times)
    if ts[0] < float(t0) or ts[-1] > float(t1):
        raise ValueError(
            f"Argument `observe` has a `Trajectory` whose times must lie within [{float(t0)}, "
            f"{float(t1)}], but they run from {ts[0]} to {ts[-1]}."
        )


def _raise_on_failure(progress: Progress, values: Any) -> tuple[Progress, Any]:
    value = code(progress.result)
    if is_traced(value):
        # Both, because a caller may use the observed values alone.
        return progress.result.error_if((progress, values), ~ended_well(value))
    name = NAMES[int(value)]
    if not ended_well(name):
        raise RuntimeError(
            f"The run ended at t = {float(progress.t):.6g} with `{name}`: {message(name)}"
        )
    return progress, values
