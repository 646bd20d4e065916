"""The computation of a sweep on any engine: a common task, a start for each lane, and the grid.

- `prepare` checks the arguments of `sweep` before anything is compiled, and fixes solver,
  tolerances and observers.
- `Ensemble.dataset` labels the records of the lanes: names, units and provenance.
- `fingerprint_of` identifies the sweep of a store: all that affects the numbers, except the grid.

Variables of the dataset (… stands for the swept dimensions):

    amplitude (…, oscillator), peak_time (…, peak, oscillator), ...   what the observers `label`
    result (…)                                    outcome of the run, see its flag_meanings
    end_time, steps, rejected (…)

With `segments` there is the dimension "segment" in front of those of an observer.

Unknown values are NaN, and xarray leaves them out of means: all that a failed run observed, and
the windows of a `FrontTrack` that a run did not reach.  Counts are therefore floats; in NetCDF and
Zarr they are integers, with a `_FillValue`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import math
import os
import re
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import check_concrete, check_finite, shown, to_float
from .._types import ScalarLike, State
from ..datasets import Variable, labelled
from ..model.arguments import as_model
from ..model.entries import array_of
from ..model.model import AbstractModel
from ..model.parameters import parameter
from ..model.provenance import versions
from ..observers.amplitude import Amplitude
from ..observers.base import AbstractObserver, Step
from ..observers.samples import Trajectory
from ..result import NAMES
from ..simulation.accuracy import check_accuracy, choose_numerics
from ..simulation.dataset import describe, to_dataset
from ..simulation.method import Method, check_span, custom_solver
from ..simulation.run import check_fit, check_segments
from .axes import Axes, Block, Grid, Key, check_axes, chunks_of, columns_of, extremes
from .lanes import (
    RunStarts,
    Shapes,
    SweepTask,
    chain_of_run,
    hashable_partial,
    initial_names,
    lane_and_record,
    start_of,
)
from .programs import shape_of, shape_of_start, start_program
from .store import digest

if TYPE_CHECKING:
    from xarray import Dataset

# The variables of every sweep, for any observer.
RESULTS = ("oscillator", "segment", "segment_end", "result", "end_time", "steps", "rejected")
# The parts of this package that affect numbers, and names of results.
_CODE = (
    "_computed_once.py",
    "_internals.py",
    "datasets.py",
    "model",
    "observers",
    "solvers",
    "simulation",
    "sweeps/lanes.py",
    "result.py",
)
DEVICES = "xla_force_host_platform_device_count"


@dataclass(frozen=True)
class RunSettings:
    """The settings common to all runs of a sweep: the arguments that affect numbers."""

    model: Any  # which `prepare` checks
    initial: State | Callable[..., State]
    t1: ScalarLike
    vary: Callable[..., Any] | None = None
    observe: Any = None
    t0: ScalarLike = 0.0
    method: Method | None = None
    accuracy: float | None = None
    segments: int | None = None
    n: int | None = None  # of masses or cells; `prepare` reads it off chain and `initial`


@dataclass
class Ensemble:
    """A sweep that is ready to run: settings completed by `prepare`, and the swept values."""

    settings: RunSettings
    axes: Axes

    @property
    def n(self) -> int:
        """How many masses, or cells."""
        return self.settings.n or 1

    @functools.cached_property
    def starts(self) -> RunStarts:
        """The functions that make the start of each job."""
        settings = self.settings
        functions = hashable_partial(settings.initial), hashable_partial(settings.vary)
        return RunStarts(settings.model, *functions, self.n)

    @functools.cached_property
    def task(self) -> SweepTask:
        """The data common to all lanes."""
        settings = self.settings
        method = Method.of(settings.method)
        plan = method.plan(settings.observe, settings.t1)
        steps = None if method.max_steps is None else jnp.asarray(method.max_steps)
        varied = self.starts.varied(self.first_job().first)
        t0, t1 = to_float(settings.t0), to_float(settings.t1)
        return SweepTask(plan, settings.model, t0, t1, steps, varied, settings.segments, self.n)

    @functools.cached_property
    def shapes(self) -> Shapes:
        """The shapes of one lane."""
        start = shape_of_start(self.starts, self.first_job().first)
        return Shapes(start, *shape_of(lane_and_record, self.task, start))

    @property
    def total(self) -> int:
        """The number of jobs."""
        return Grid(self.axes, {}).block_size

    def block(self, grid: Grid, key: Key) -> Block:
        """A block of the grid with the values of its jobs, and unknown results."""
        block, settings = grid.block(key), self.settings
        if settings.accuracy is not None:
            block.jobs["width"], _ = _numerics(
                settings.model, settings.vary, block.jobs, settings.accuracy
            )
        return block

    def first_job(self) -> Block:
        """A block of one job."""
        grid = Grid(self.axes, dict.fromkeys(self.axes, 1))
        return self.block(grid, (0,) * len(self.axes))

    def blank_records(self, size: int) -> dict[str, Any]:
        """Host arrays for the results of `size` jobs, unknown so far."""

        def nothing(s: jax.ShapeDtypeStruct) -> np.ndarray:
            fill = np.nan if np.issubdtype(s.dtype, np.floating) else 0
            return np.full((size, *s.shape), fill, s.dtype)

        records = jtu.tree_map(nothing, self.shapes.record)
        records["result"][:] = NAMES.index("interrupted")
        return records

    def sample(self, lanes: int) -> Dataset:
        """The dataset of one pending job, to be run by this number of lanes."""
        block = self.first_job()
        block.records = self.blank_records(1)
        block.records["result"][:] = NAMES.index("pending")
        return self.dataset(block, self.attrs | {"lanes_per_device": lanes})

    @property
    def attrs(self) -> dict[str, Any]:
        """The provenance: everything needed to repeat the computation."""
        settings, swept = self.settings, list(columns_of(self.axes))
        t0, t1 = float(self.task.t0), float(self.task.t1)
        attrs = describe(settings.model, self.n, self.task.plan, t0=t0, t1=t1, swept=swept)
        if settings.vary is not None:
            attrs["vary"] = shown(settings.vary)
        return attrs if settings.accuracy is None else attrs | {"accuracy": settings.accuracy}

    def dataset(self, block: Block, attrs: Mapping[str, Any]) -> Dataset:
        """The records of a block over the swept axes."""
        task, edges = self.task, None
        if task.segments is not None:
            edges = np.asarray(task.edge(np.arange(task.segments + 1)))
        data = to_dataset(block.records, block.axes, self.settings.model, self.n, attrs, edges)
        if self.settings.accuracy is not None:
            row, widths = parameter("width"), block.jobs["width"].reshape(data["result"].shape)
            text = f"{row.long_name} that `accuracy` picked"
            data["width"] = labelled(Variable(widths, tuple(block.axes), row.unit, text))
        return data


def prepare(settings: RunSettings, over: Mapping[str, Any], most: int) -> Ensemble:
    """The sweep of these settings over these values, of at most `most` jobs.

    **Raises:** `ValueError` for bad input.
    """
    chain: Any = as_model(settings.model)
    initial, vary, t0, t1 = settings.initial, settings.vary, settings.t0, settings.t1
    check_concrete("use `jax.vmap` of `simulate`.", model=chain, t1=t1, t0=t0)
    check_concrete("use `jax.vmap` of `simulate`.", over=over)
    check_span(t0, t1)
    method = Method.of(settings.method)
    custom_solver(chain, method.solver)  # raises for one that does not suit
    axes = check_axes(chain, initial, over, vary, most)
    columns = columns_of(axes)
    m, n = _check_initial(chain, initial, columns)
    _check_vary(chain, vary, axes)
    accuracy, scale = settings.accuracy, chain.smallest_scale(n)
    if accuracy is not None:
        check_accuracy(chain, accuracy, method.rtol)
        if "width" in columns:
            raise ValueError("Argument `accuracy` picks the width: leave `width` out of `over`.")
        grid = Grid(axes, chunks_of(axes, 100_000))
        blocks = map(grid.block, grid.all_keys())
        rtol = min(_numerics(chain, vary, block.jobs, accuracy)[1] for block in blocks)
        method, scale = dataclasses.replace(method, rtol=rtol), None
    if scale is not None and "width" in chain.parameter_names:  # what is swept decides
        swept = columns.get("width"), columns.get("belt_speed")
        scale = tuple(b if a is None else a for a, b in zip(swept, scale, strict=True))
    method = method.checked(chain, n, scale)
    check_segments(settings.segments)
    observers = check_observers(
        settings.observe, chain, (m, n), float(t0), float(t1), settings.segments, axes
    )
    if method.solver is None:
        strongest = chain
        for name in columns:  # the strongest coupling decides the linear solve
            if "coupling" in (name, array_of(name)):
                strongest = strongest.with_(**{name: float(np.max(columns[name]))})

        def first_state() -> State:
            first = {name: jnp.asarray(values[0]) for name, values in columns.items()}
            return RunStarts(strongest, initial, vary, n).of(first).state

        method = method.suited(strongest, n, first_state, scale)
    accuracy = None if method.dry else accuracy
    complete = dataclasses.replace(
        settings, model=chain, observe=observers, method=method, accuracy=accuracy, n=n
    )
    return Ensemble(complete, axes)


def _numerics(
    model: AbstractModel,
    vary: Callable[..., Any] | None,
    jobs: Mapping[str, np.ndarray],
    accuracy: float,
) -> tuple[np.ndarray, float]:
    """The width of every job, and one rtol for all."""
    names = [] if vary is None else initial_names(vary)
    kept = {name: v for name, v in jobs.items() if name in names or model.has_parameter(name)}
    columns = {name: jnp.asarray(v) for name, v in kept.items()}

    def of_one(values: dict[str, Any]) -> tuple[Any, Any]:
        chosen = choose_numerics(chain_of_run(model, vary, values), accuracy)
        return chosen.width, chosen.rtol

    count = next(iter(jobs.values())).size
    if columns:
        widths, rtols = jax.vmap(of_one)(columns)
    else:
        widths, rtols = (jnp.full(count, a) for a in of_one({}))
    return np.asarray(widths), float(jnp.min(rtols))


def _check_initial(
    model: AbstractModel, initial: State | Callable[..., State], columns: Mapping[str, np.ndarray]
) -> tuple[int, int]:
    """Raises the errors of `initial` for its own values, and for a state of a wrong shape.

    In a compiled program all values are traced, and 30 excited masses of 20 would count as 20.

    **Returns:** the number of variables of a cell, and the number of cells.
    """
    states: list[Any] = [initial]
    if callable(initial):
        varied = {name: v for name, v in columns.items() if name in initial_names(initial)}
        first = {name: jnp.asarray(values[0]) for name, values in varied.items()}
        rows = [first] if varied else []
        for name, values in varied.items():
            different = np.unique(values) if values.ndim == 1 else values[:0]
            kept = different if different.size <= 64 else different[[0, -1]]
            rows += [first | {name: jnp.asarray(value)} for value in kept]
        states = [eqx.filter_eval_shape(functools.partial(initial, model, **row)) for row in rows]
        if not varied:
            given = hashable_partial(initial), model
            states = [shape_of(_first_state, given, programs=start_program)]
    first = states[0]
    m = len(model.variables) or (len(first) if isinstance(first, tuple | list) else 0)
    n = model.n or 1
    for state in states:
        if not isinstance(state, tuple | list) or len(state) != m:
            raise ValueError(
                f"Argument `initial` must be {model.state_in_words} or return it, but that is "
                f"{shown(state)}: see `excited_state`."
            )
        if model.n is None:
            n = max(n, *(math.prod(jnp.shape(part)) for part in state))
        for i, part in enumerate(state):
            name = model.variable(i).name
            if not isinstance(part, jax.ShapeDtypeStruct):
                to_float(part, f"initial {name}", "see `excited_state` for initial states.")
            if jnp.shape(part) not in ((), (n,)):
                raise ValueError(
                    f"Argument `initial` has a {name} of shape {jnp.shape(part)}, but the chain "
                    f"has {n} masses."
                )
            if not callable(initial):
                check_finite(f"initial {name}", part, "see `excited_state` for initial states.")
    model.dependence((jnp.zeros(n),) * m)  # raises unless there is a rate for each variable
    return m, n


def _first_state(given: tuple[Callable[..., State], AbstractModel]) -> State:
    initial, chain = given
    return initial(chain)


def _check_vary(model: AbstractModel, vary: Callable[..., Any] | None, axes: Axes) -> None:
    """Raises the errors of `vary` at the extremes of its parameters, or if it returns no chain."""
    if vary is None:
        return
    for row in extremes(axes, initial_names(vary)) or [{}]:
        varied: Any = vary(model, **row)
        if type(varied) is not type(model) or varied.n != model.n:
            of = "" if model.n is None else f" of {model.n} masses"
            raise ValueError(
                f"Argument `vary` must return a `{type(model).__name__}`{of}, but returns "
                f"{shown(varied)}."
            )


def check_observers(
    observe: Any, model: Any, size: tuple[int, int], t0: float, t1: float,
    segments: int | None, axes: Axes,
) -> list[AbstractObserver]:  # fmt: skip
    """The observers of runs over [t0, t1], whose variables must have different names."""
    length = (t1 - t0) / (segments or 1)
    if observe is None:
        observe = Amplitude(window=0.1 * length if length > 0 else None)
    observers = list(observe) if isinstance(observe, list | tuple) else [observe]
    check_fit([o for o in observers if isinstance(o, AbstractObserver)], t0, t1, segments)
    givers: dict[str, str] = dict.fromkeys(RESULTS, "every sweep")
    lengths = {"oscillator": size[1]}
    for observer in observers:
        if isinstance(observer, Trajectory):
            raise ValueError(
                "Argument `observe` is a `Trajectory`, which a sweep cannot store. Use "
                "`jax.vmap(simulate)` for trajectories of a few runs."
            )
        if not isinstance(observer, AbstractObserver):
            raise ValueError(
                "Argument `observe` must be an observer or a list of them, but holds "
                f"{shown(observer)}: see `jaxchain.observers`."
            )
        kind = f"`{type(observer).__name__}`"
        still = tuple(np.zeros(size))
        for name, variable in shape_of(_labels, (observer, model), still).items():
            if name in givers:
                raise ValueError(
                    f"Argument `observe` holds {kind}, which names a variable {name!r} as "
                    f"{givers[name]} does. Run two sweeps, or give one of them another name."
                )
            givers[name] = kind
            shape = jnp.shape(variable.values)
            named = dict(zip(variable.dims, shape, strict=False))
            agree = all(lengths.setdefault(dim, size) == size for dim, size in named.items())
            if len(named) != len(shape) or len(shape) != len(variable.dims) or not agree:
                raise ValueError(
                    f"The method `label` of {kind} gives {name!r} the dimensions {variable.dims}, "
                    f"but its shape is {shape}: name each axis once, and another length otherwise."
                )
    for name in givers.keys() & (lengths.keys() - {"oscillator"}):
        raise ValueError(
            f"Argument `observe` holds {givers[name]}, which names a variable {name!r} as another "
            "names a dimension: give one of them another name."
        )
    for name in [*axes, *(name for columns in axes.values() for name in columns)]:
        if name in givers or name in lengths:
            raise ValueError(
                f"Argument `over` names {name!r}, which is also the name of a result: give that "
                "parameter another name."
            )
    return observers


def _labels(observed: tuple[AbstractObserver, Any], state: State) -> OrderedDict[str, Variable]:
    """The variables of an observer of a chain."""
    observer, chain = observed
    value = observer.read(observer.init(chain, 0.0, 1.0, state))
    return OrderedDict(observer.label(value, chain))


def fingerprint_of(ensemble: Ensemble, lanes: int) -> dict[str, Any]:
    """Fingerprint of everything except the grid that determines a sweep's results, as JSON.

    It maps names, which an error can use, to numbers, words and digests.
    """
    task, starts, axes = ensemble.task, ensemble.starts, ensemble.axes
    chain, plan = starts.chain, task.plan
    swept = columns_of(axes)
    at_rest = ensemble.shapes.start.state
    numbers = {**chain.parameters(), "n": ensemble.n, "ends": chain.ends}
    # For example of a table: arrays are data of a program, not part of its text.
    data = [a for a in _arrays(chain) if all(a is not b for b in numbers.values())]
    solver = eqx.tree_at(lambda p: p.observers, plan, None, is_leaf=lambda a: a is None)
    return {
        "chain": {k: _value(v) for k, v in numbers.items() if k not in swept and v is not None},
        "friction": {
            "law": type(chain.given_friction or chain).__name__,
            "curve": digest(_program(_rate, chain, at_rest), *data),
        },
        "solver": _fields(solver)
        | {"code": digest(_source(getattr(plan, "solver", None)), *_arrays(solver))},
        "observers": {
            str(i): _fields(o)
            | {"code": digest(_program(_seen, o, chain, task.t0, task.t1, at_rest), *_arrays(o))}
            for i, o in enumerate(plan.observers, start=1)
        },
        "t0": float(task.t0),
        "t1": float(task.t1),
        "max_steps": None if task.max_steps is None else int(task.max_steps),
        "segments": task.segments,
        "accuracy": ensemble.settings.accuracy,
        "initial and vary": digest(
            _program(start_of, starts, ensemble.first_job().first),
            _words(task.varied),
            *_arrays((starts.initial, starts.vary)),
        ),
        "lanes": lanes,
        "dimensions": list(axes),
        "over": {dim: sorted(columns) for dim, columns in axes.items()},
        **environment_of_numbers(),
    }


def environment_of_numbers() -> dict[str, Any]:
    """Properties of this process that affect numbers: versions, our code, options of XLA."""
    return {
        "versions": {k: v for k, v in versions().items() if k != "python"},
        "code of jaxchain": code(),
        "XLA_FLAGS": flags(),
    }


def flags() -> str:
    """The options of XLA, which may change the last bits, except the number of devices."""
    words = os.environ.get("XLA_FLAGS", "").split()
    return " ".join(sorted(word for word in words if DEVICES not in word))


@functools.cache
def code() -> str:
    """A digest of the source of this package, as far as it affects numbers."""
    root = Path(__file__).parents[1]
    files = [f for part in _CODE for f in sorted((root / part).rglob("*.py")) or [root / part]]
    return digest(*(file.read_bytes() for file in files))


def _value(value: Any) -> Any:
    """A number, a few numbers, or the digest of many; a text for anything else."""
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if eqx.is_array_like(value):
        array = np.asarray(value)
        return array.tolist() if array.size <= 4 else digest(array)
    return _words(value)


def _fields(module: eqx.Module) -> dict[str, Any]:
    """The fields of a solver or an observer, so that an error can name a change."""
    fields = {
        field.name: _value(getattr(module, field.name)) for field in dataclasses.fields(module)
    }
    return {"kind": type(module).__name__, **fields}


def _words(value: Any) -> str:
    """A text without the addresses of functions, which differ between processes."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def _arrays(tree: Any) -> list[Any]:
    return [leaf for leaf in jtu.tree_leaves(tree) if eqx.is_array(leaf)]


def _source(solver: Any) -> str:
    """The source of the class of a custom solver, if it can be read."""
    texts = []
    for kind in type(solver).__mro__:
        if not kind.__module__.startswith(("jaxchain.", "diffrax.", "builtins", "abc")):
            with contextlib.suppress(OSError, TypeError):
                texts.append(inspect.getsource(kind))
    return "".join(texts)


def _force(friction: Any, speed: Any) -> Any:
    return friction.force_and_slope(speed), friction.law.mu_static


def _rate(field: Any, state: State) -> Any:
    return field(jnp.zeros(()), state)


def _seen(observer: Any, model: Any, t0: Any, t1: Any, start: State) -> Any:
    """The result of an observer for one step."""
    kept = observer.init(model, t0, t1, start)
    step = Step(model, t0, t1, start, start, lambda theta, k: start[k] + 0.0 * theta)
    kept = observer.update(kept, step)
    labels = observer.label(observer.read(kept), model)
    return observer.settled(kept), observer.rests(kept), dict(labels)


def _program(function: Callable, tree: Any, *arguments: Any) -> str:
    """The traced program of a user's function, as text.

    So a comment or a renamed variable has no effect, but a number from outside the function does.
    """
    arrays, static = eqx.partition(tree, eqx.is_array)

    def traced(arrays: Any, *arguments: Any) -> Any:
        return function(eqx.combine(arrays, static), *arguments)

    lowered = jax.jit(traced).trace(arrays, *arguments).lower(lowering_platforms=("cpu",))
    return digest(lowered.as_text())
