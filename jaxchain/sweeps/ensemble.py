"""What a sweep computes, whatever runs it: a task for all lanes, a start for each, and the grid.

`prepare` makes it of what `sweep` is given, or raises before anything is compiled.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import check_concrete, check_count, check_finite, shown, to_float
from .._limits import MOST_LANES
from .._types import ScalarLike, State
from ..model.arguments import as_chain
from ..model.chain import Chain, require_smoothed
from ..model.parameters import parameter
from ..result import NAMES
from ..simulation.accuracy import (
    MAX_STEP,
    NO_ACCURACY,
    USUAL_RTOL,
    check_resolved,
    check_span,
    check_tolerances,
    choose_numerics,
    choose_solver,
    default_rtol,
    own_solver,
)
from ..simulation.event_driven import EventDriven
from ..simulation.run import build_plan, check_segments
from .axes import Axes, check_axes, check_observers, check_vary, columns_of
from .grid import Block, Grid, chunks_of
from .lanes import Task, blank_place
from .programs import shape_of
from .starts import Starts, chain_names, first, initial_names, known_again, own_chain, start_of

if TYPE_CHECKING:
    from xarray import Dataset

# Values of a parameter of `initial` that are tried one by one before a sweep.
_MOST_TRIED = 64
# Jobs whose numerics are chosen at a time.
_AT_ONCE = 100_000


@dataclass
class Ensemble:
    """A sweep that is ready to run."""

    task: Task
    starts: Starts
    axes: Axes
    accuracy: float | None = None

    @functools.cached_property
    def place(self) -> Any:
        """The shapes of a lane's place in a pool."""
        start = eqx.filter_eval_shape(start_of, self.starts, first(self.jobs(self.first_job())))
        return shape_of(blank_place, self.task, start)

    def blank_records(self, size: int) -> dict[str, Any]:
        """Host arrays for what so many jobs leave, of which nothing is known."""

        def nothing(s: jax.ShapeDtypeStruct) -> np.ndarray:
            fill = np.nan if np.issubdtype(s.dtype, np.floating) else 0
            return np.full((size, *s.shape), fill, s.dtype)

        records = jtu.tree_map(nothing, self.place.record)
        records["result"][:] = NAMES.index("interrupted")
        return records

    def jobs(self, block: Block) -> dict[str, np.ndarray]:
        """All that the jobs of a block take."""
        if self.accuracy is None:
            return block.jobs
        widths, _ = _numerics(self.starts.chain, self.starts.vary, block.jobs, self.accuracy)
        return block.jobs | {"width": widths}

    @property
    def total(self) -> int:
        """Of jobs."""
        return Grid(self.axes).total

    def first_job(self) -> Block:
        """A block of one job."""
        return Grid(self.axes, dict.fromkeys(self.axes, 1)).block((0,) * len(self.axes))

    @property
    def attrs(self) -> dict[str, Any]:
        """Where the numbers come from."""
        from .dataset import describe

        task = self.task
        swept = list(columns_of(self.axes))
        attrs = describe(
            self.starts.chain, task.plan, t0=float(task.t0), t1=float(task.t1), swept=swept
        )
        if self.starts.vary is not None:
            attrs["vary"] = shown(getattr(self.starts.vary, "__wrapped__", self.starts.vary))
        return attrs if self.accuracy is None else attrs | {"accuracy": self.accuracy}

    def dataset(self, block: Block, attrs: Mapping[str, Any]) -> Dataset:
        """The records of a block over the swept axes."""
        # pandas comes with xarray, and would double the time of `import jaxchain`.
        from .dataset import to_dataset

        task, edges = self.task, None
        if task.segments is not None:
            edges = np.asarray(task.edge(np.arange(task.segments + 1)))
        found = to_dataset(block.records, block.axes, self.starts.chain, attrs, edges)
        if self.accuracy is not None:
            about = parameter("width").attrs
            about["long_name"] += " that `accuracy` picked"
            widths = self.jobs(block)["width"].reshape(found["result"].shape)
            found["width"] = (tuple(block.axes), widths, about)
        return found


def prepare(
    chain: Any,
    initial: State | Callable[..., State],
    t1: ScalarLike,
    *,
    over: Mapping[str, Any],
    vary: Callable[..., Chain] | None = None,
    observe: Any = None,
    t0: ScalarLike = 0.0,
    solver: dfx.AbstractSolver | EventDriven | None = None,
    accuracy: float | None = None,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
    max_step: ScalarLike = MAX_STEP,
    max_steps: int | None = None,
    segments: int | None = None,
    most: int = MOST_LANES,
) -> Ensemble:
    """The sweep that these arguments of `sweep` describe, of at most so many lanes.

    **Raises:** `ValueError` for bad input.
    """
    remedy = "for other oscillators use `jax.vmap` of `simulate`, with `throw=False`."
    chain = as_chain(chain, remedy=remedy)
    check_concrete("use `jax.vmap` of `simulate`.", chain=chain, t1=t1, t0=t0, over=over)
    check_span(t0, t1)
    solver = own_solver(chain, solver)
    axes = check_axes(chain, initial, over, vary, most)
    columns = columns_of(axes)
    _check_initial(chain, initial, columns)
    check_vary(chain, vary, axes)
    smoothed = not isinstance(solver, EventDriven)
    if accuracy is not None:
        require_smoothed(chain, NO_ACCURACY)
        if rtol is not None or "width" in columns:
            raise ValueError(
                "Argument `accuracy` picks the width and `rtol`: leave out `rtol`, and `width` of "
                "`over`."
            )
        blocks = Grid(axes, chunks_of(axes, _AT_ONCE)).blocks()
        rtol = min(_numerics(chain, vary, block.jobs, accuracy)[1] for block in blocks)
    width: Any = columns.get("width", chain.width)
    speed: Any = columns.get("belt_speed", chain.belt_speed)
    tolerance: Any = rtol
    if rtol is None:
        tolerance = default_rtol(chain.n, width, speed) if smoothed else USUAL_RTOL
    check_tolerances(tolerance, atol, max_step)
    if smoothed and accuracy is None:
        check_resolved(chain.n, width, speed, tolerance, atol)
    check_segments(segments)
    observers = check_observers(observe, chain, float(t0), float(t1), segments, axes)
    check_count("max_steps", max_steps)
    absolute: Any = 0.1 * tolerance if atol is None else atol
    if solver is None:
        solver = choose_solver(_strongest(chain, columns), float(tolerance), float(max_step))
    plan = build_plan(solver, observers, tolerance, absolute, max_step, t1)
    steps = None if max_steps is None else jnp.asarray(max_steps)
    starts = Starts(chain, known_again(initial), known_again(vary))
    one = {name: values[:1] for name, values in columns.items()}
    if smoothed and accuracy is not None:
        one["width"] = np.ones(1)
    task = Task(plan, chain, to_float(t0), to_float(t1), steps, starts.varied(one), segments)
    return Ensemble(task, starts, axes, accuracy if smoothed else None)


def _numerics(
    chain: Chain,
    vary: Callable[..., Chain] | None,
    jobs: Mapping[str, np.ndarray],
    accuracy: float,
) -> tuple[np.ndarray, float]:
    """The width of every job, and one rtol for all."""
    names = [*chain_names(chain), *([] if vary is None else initial_names(vary))]
    own = {name: jnp.asarray(v) for name, v in jobs.items() if name in names}

    def of_one(values: dict[str, Any]) -> tuple[Any, Any]:
        chosen = choose_numerics(own_chain(chain, vary, values), accuracy)
        return chosen.width, chosen.rtol

    count = next(iter(jobs.values())).size
    if own:
        widths, rtols = jax.vmap(of_one)(own)
    else:
        widths, rtols = (jnp.full(count, a) for a in of_one({}))
    return np.asarray(widths), float(jnp.min(rtols))


def _check_initial(
    chain: Chain, initial: State | Callable[..., State], columns: Mapping[str, np.ndarray]
) -> None:
    """Raises what `initial` raises for a value of its own, and for a state that does not fit.

    In a compiled program all values are traced, and 30 excited masses of 20 would pass for 20.
    """
    states: list[Any] = [initial]
    if callable(initial):
        own = {name: v for name, v in columns.items() if name in initial_names(initial)}
        first = {name: jnp.asarray(values[0]) for name, values in own.items()}
        rows = [first]
        for name, values in own.items():
            different = np.unique(values) if values.ndim == 1 else values[:0]
            kept = different if different.size <= _MOST_TRIED else different[[0, -1]]
            rows += [first | {name: jnp.asarray(value)} for value in kept]
        states = [eqx.filter_eval_shape(functools.partial(initial, chain, **row)) for row in rows]
    for state in states:
        if not isinstance(state, tuple | list) or len(state) != 2:
            raise ValueError(
                "Argument `initial` must be the pair (displacement, velocity) or return it, but "
                f"that is {shown(state)}: see `excited_state`."
            )
        for name, part in zip(("displacement", "velocity"), state, strict=True):
            if not isinstance(part, jax.ShapeDtypeStruct):
                to_float(part, f"initial {name}", "see `excited_state` for initial states.")
            if jnp.shape(part) not in ((), (chain.n,)):
                raise ValueError(
                    f"Argument `initial` has a {name} of shape {jnp.shape(part)}, but the chain "
                    f"has {chain.n} masses."
                )
            if not callable(initial):
                check_finite(f"initial {name}", part, "see `excited_state` for initial states.")


def _strongest(chain: Chain, columns: Mapping[str, np.ndarray]) -> Chain:
    """The chain with the strongest coupling of the sweep, for the choice of the linear solve."""
    if "coupling" in columns:
        return chain.with_(coupling=float(np.max(columns["coupling"])))
    return chain
