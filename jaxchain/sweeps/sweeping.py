"""Sweeps: one compiled program, many lanes, every device busy until the last lane is done.

`vmap` of a whole integration runs until its slowest lane ends, and quiet lanes cost as much as
vibrating ones.  Here a fixed number of lanes on every device goes on in short *rounds* of steps;
lanes that have ended hand over their results and take the next job.  A lane sees nothing of its
neighbours: its steps and rounds are the same whoever runs beside it.  How many run beside it does
matter, in the last bits: XLA compiles another program for another number of lanes, and a chaotic
lane makes another motion of it.  `lanes` fixes the program.
"""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._checks import (
    check_concrete,
    check_count,
    check_finite,
    check_flag,
    check_kind,
    shown,
    to_float,
)
from .._types import ScalarLike, State
from ..model.arguments import as_chain
from ..model.chain import Chain, require_smoothed
from ..model.parameters import parameter
from ..result import NAMES, ended_well, message
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
from .axes import check_axes, check_observers, check_vary
from .axes import jobs as jobs_of
from .lanes import Task
from .scheduler import Scheduler
from .starts import Starts, chain_names, initial_names, known_again, own_chain

if TYPE_CHECKING:
    from xarray import Dataset

# Values of a parameter of `initial` that are tried one by one before a sweep.
_MOST_TRIED = 64


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C during a sweep; `dataset` holds every lane that had ended."""

    def __init__(self, dataset: Dataset):
        super().__init__("The sweep was interrupted; `.dataset` holds the lanes that had ended.")
        self.dataset = dataset


def sweep(
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
    lanes: int | None = None,
    devices: Sequence[Any] | None = None,
    progress: bool = False,
    description: str = "sweep",
) -> Dataset:
    """Runs a chain for every combination of the values in `over`.

    **Arguments:**

    - `chain`: a `Chain`.
    - `initial`: the pair (x, v), or a function (chain, **own) -> (x, v) that JAX can trace; its
      parameters beyond the chain are taken from `over`.
    - `t1`, `t0`: dimensionless times.
    - `over`: ordered mapping from a name to a one-dimensional array: any number of the chain or of
      its friction law (`belt_speed`, `damping_ratio`, `coupling`, `width`, `mu_static`, ...), or a
      parameter of `initial` or `vary` (`excited`, a seed, ...).  Or from a dimension to a mapping
      or data frame of several of them that run along it together, such as measured sets or random
      starts: `{"sample": {"belt_speed": speeds, "x0": starts}}`; what `initial` and `vary` take
      may have further axes, of shape (samples, n), say.
    - `vary`: a function (chain, **own) -> chain that JAX can trace, for what no single number of
      the chain says, such as one random stiffness per mass (`jaxchain.mistuned_chain`); its
      parameters beyond the chain are taken from `over`, too, and `initial` sees the new chain.
    - `observe`: one observer or several (default: `Amplitude` over the last tenth of the run, or
      of each segment), also of one's own, see `AbstractObserver`.  A `Trajectory` does not fit
      into lanes; use `jax.vmap(simulate)`.
    - `segments`: cut each run into this many parts of equal length, in which observers start anew;
      what they observe has the dimension `segment` (1 ...), see `settled`.
    - `accuracy`: as for `simulate`: kept for 30 time units and by amplitudes that have settled.
      Lanes in which it may not be kept differ from those of a second sweep with four times the
      accuracy by more than it (see `choose_numerics`).  Every lane has a width of its own, `width`
      of the dataset, and all have the least of their `rtol`.
    - `solver`, `rtol`, `atol`, `max_step`, `max_steps`: as for `simulate`, the same for all lanes.
    - `lanes`: lanes at a time on each device, for the same bits again: every device runs one
      program, for just so many lanes, whatever the number of devices and of jobs.  By default as
      many as fit its cache, no more than its share of the jobs, and fewer near the end of a long
      sweep; that is fastest, but the last bits then depend on jobs, devices and the clock.
    - `devices`: default all local devices.
    - `progress`: show a progress bar; it tells of cores that lie idle.

    **Returns:** an `xarray.Dataset` with the dimensions of `over` and `oscillator` (1 ... n), see
    `sweeps/dataset.py`; what is swept along a dimension of another name is a coordinate along it.
    Failed lanes are NaN and carry their reason in `result`.  Bit for bit, no lane depends on
    *which* others run beside it, failed ones or not.  It does on *how many* do: results with other
    `lanes`, or without, agree within the tolerances while the motion is regular, and chaotic
    motions part.  The same `lanes`, on devices of the same kind and with the same versions of JAX
    and jaxchain, give the same bits.  The attributes `devices`, `device_kind`, `lanes_per_device`
    and `lanes_per_device_at_end` record them.

    **Compiled** are the runs once for all numbers, states and functions, but anew for another
    number of masses or lanes, another law, solver or observer; and, in a fraction of a second,
    what makes the starts, for each new function: `def` one `initial` before a loop of sweeps, and
    hand over what changes as a parameter of it, in `over`, instead of a new `lambda` each time (a
    `functools.partial` of the same function and numbers is not new).
    The programs of the latest eight functions are kept.

    **Raises:** `ValueError` for bad input before anything is compiled; `MemoryError` if the
    results cannot fit; `SweepInterrupted` on Ctrl-C, with what was finished.

    !!! example

        >>> import jax, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, paper_chain, sweep
        >>> result = sweep(
        ...     paper_chain(n=4), lambda chain, excited: equation_8(chain, excited), 100.0,
        ...     over={"belt_speed": [1.4, 1.5], "excited": [0, 1]}, observe=Amplitude(window=20.0),
        ... )
        >>> result.active_count.dims
        ('belt_speed', 'excited')
    """
    # pandas comes with xarray, and would double the time of `import jaxchain`.
    from .dataset import describe, to_dataset

    remedy = "for other oscillators use `jax.vmap` of `simulate`, with `throw=False`."
    chain = as_chain(chain, remedy=remedy)
    check_concrete("use `jax.vmap` of `simulate`.", chain=chain, t1=t1, t0=t0, over=over)
    check_span(t0, t1)
    solver = own_solver(chain, solver)
    _check_running(lanes, devices, progress, description)
    axes = check_axes(chain, initial, over, vary)
    jobs = jobs_of(axes)
    swept = list(jobs)
    _check_initial(chain, initial, jobs)
    check_vary(chain, vary, jobs)
    smoothed = not isinstance(solver, EventDriven)
    widths = None
    if accuracy is not None:
        require_smoothed(chain, NO_ACCURACY)
        if rtol is not None or "width" in jobs:
            raise ValueError(
                "Argument `accuracy` picks the width and `rtol`: leave out `rtol`, and `width` of "
                "`over`."
            )
        widths, rtol = _numerics(chain, vary, jobs, accuracy)
    width: Any = jobs.get("width", chain.width)
    speed: Any = jobs.get("belt_speed", chain.belt_speed)
    tolerance: Any = rtol
    if rtol is None:
        tolerance = default_rtol(chain.n, width, speed) if smoothed else USUAL_RTOL
    check_tolerances(tolerance, atol, max_step)
    if not smoothed:
        widths = None
    elif widths is not None:
        jobs["width"] = widths
    else:
        check_resolved(chain.n, width, speed, tolerance, atol)
    check_segments(segments)
    length = (float(t1) - float(t0)) / (segments or 1)
    observers = check_observers(observe, chain, length, axes)
    check_count("max_steps", max_steps)
    absolute: Any = 0.1 * tolerance if atol is None else atol
    if solver is None:
        solver = choose_solver(_strongest(chain, jobs), float(tolerance), float(max_step))
    plan = build_plan(solver, observers, tolerance, absolute, max_step, t1)
    most = None if max_steps is None else jnp.asarray(max_steps)
    starts = Starts(chain, known_again(initial), known_again(vary))
    task = Task(plan, chain, to_float(t0), to_float(t1), most, starts.varied(jobs), segments)
    runner = Scheduler(task, starts, jobs, devices, lanes)
    started = time.perf_counter()
    interrupted = False
    try:
        runner.run(progress, description)
    except KeyboardInterrupt:
        interrupted = True
    attrs = describe(chain, plan, t0=float(t0), t1=float(t1), swept=swept)
    attrs |= {
        "wall_time_s": round(time.perf_counter() - started, 3),
        "devices": ", ".join(str(d) for d in runner.devices),
        "device_kind": ", ".join(sorted({d.device_kind for d in runner.devices})),
        "lanes_per_device": runner.lanes,
        "lanes_per_device_at_end": runner.lanes_at_end,
    }
    edges = None if segments is None else np.asarray(task.edge(np.arange(segments + 1)))
    dataset = to_dataset(runner.records, axes, chain, attrs, edges)
    if widths is not None:
        about = parameter("width").attrs
        about["long_name"] += " that `accuracy` picked"
        dataset["width"] = (tuple(axes), widths.reshape(dataset["result"].shape), about)
        dataset.attrs["accuracy"] = accuracy
    if interrupted:
        raise SweepInterrupted(dataset)
    _warn_of_failures(dataset)
    return dataset


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
    chain: Chain, initial: State | Callable[..., State], jobs: Mapping[str, np.ndarray]
) -> None:
    """Raises what `initial` raises for a value of its own, and for a state that does not fit.

    In a compiled program all values are traced, and 30 excited masses of 20 would pass for 20.
    """
    states: list[Any] = [initial]
    if callable(initial):
        own = {name: v for name, v in jobs.items() if name in initial_names(initial)}
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


def _check_running(lanes: Any, devices: Any, progress: Any, description: Any) -> None:
    check_count("lanes", lanes)
    check_flag("progress", progress)
    check_kind("description", description, str, "the name of the progress bar")
    several = isinstance(devices, list | tuple) and len(devices) > 0
    if devices is not None and not (several and all(isinstance(d, jax.Device) for d in devices)):
        raise ValueError(
            "Argument `devices` must be None (all of this computer) or a list of devices, such as "
            f"`jax.devices()`, but is {shown(devices)}."
        )


def _strongest(chain: Chain, jobs: Mapping[str, np.ndarray]) -> Chain:
    """The chain with the strongest coupling of the sweep, for the choice of the linear solve."""
    if "coupling" in jobs:
        return chain.with_(coupling=float(np.max(jobs["coupling"])))
    return chain


def _warn_of_failures(dataset: Dataset) -> None:
    codes = dataset["result"].values
    for value, name in enumerate(NAMES):
        count = int(np.sum(codes == value))
        if count and not ended_well(name):
            warnings.warn(
                f"{count} of {codes.size} lanes ended with `{name}`: {message(name)}",
                stacklevel=3,
            )
