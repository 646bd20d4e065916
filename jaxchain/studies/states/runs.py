"""The runs of the study `states`: from their starts to the end, a stretch of time at a go.

All states go on together, on every device a share.  What an observer keeps is read after each
stretch of a few periods and begun anew, so that its store, which every step touches, stays small;
amplitudes are of the whole window.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from jaxchain._checks import require_x64, to_float
from jaxchain._progress import progress_bar
from jaxchain.model.chain import Chain
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.base import AbstractObserver
from jaxchain.observers.samples import Samples
from jaxchain.observers.section import PeakTimes
from jaxchain.result import NAMES, ended_well
from jaxchain.scenes.building import build_chain, build_initial, build_solver
from jaxchain.simulation.accuracy import check_resolved, choose_solver
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import build_plan, simulate
from jaxchain.studies.states.phases import join_peaks, join_samples
from jaxchain.studies.states.table import PhasePlots, States, TimeSeries
from jaxchain.sweeps.ensemble import describe, to_dataset
from jaxchain.sweeps.lanes import Lane, Starts, Task, read_lane, start_lane
from jaxchain.sweeps.sweeping import SweepInterrupted

from .parts import Parts, joined

# Of the fastest mode.  A vibrating mass has one maximum in a period, which is longer than this.
STRETCH_PERIODS, CAPACITY = 10, 16


def run_states(
    part: States,
    model: str,
    *,
    peaks_from: float | None = None,
    phase_plots: PhasePlots | None = None,
    progress: bool = False,
    description: str = "states",
) -> xr.Dataset:
    """Runs all states to the end of the window.

    **Arguments:** `model`, "smoothed" or "nonsmooth"; `peaks_from`, the time from which peaks are
    kept (None: none are); `phase_plots`, which displacements are kept (None: none).

    **Returns:** over `excited`: what `sweep` returns with an `Amplitude` of the window, and, where
    asked for, `peak_time` (excited, peak, oscillator) in order, NaN behind the last, and
    `displacement` (excited, time, mass) in single precision.

    **Raises:** `ValueError` for a width too small for the tolerance; `SweepInterrupted` on Ctrl-C,
    with the peaks and samples by then.
    """
    require_x64()
    begun = time.perf_counter()
    chain, counts = build_chain(part), part.grid()["excited"]
    end = part.time.transient + part.time.window
    numerics, solver, initial = part.numerics, _solver(part, model, chain), build_initial(part)
    stages = [*_stages(part, chain, peaks_from, phase_plots)]

    def task(observers: list[AbstractObserver]) -> Task:
        atol = 0.1 * numerics.rtol if numerics.atol is None else numerics.atol
        plan = build_plan(solver, observers, numerics.rtol, atol, numerics.max_step, end)
        return Task(plan, chain, to_float(0.0), to_float(end))

    parts, order = _deal(len(counts), numerics.lanes)
    mine = np.array([np.flatnonzero(order == i)[0] for i in range(len(counts))])

    def on_all(function: Callable, task: Task, *lanes: Sequence) -> list:
        return parts.map(function, parts.place(task), *lanes)

    def everywhere(value: float) -> list:
        return parts.deal(np.full(order.size, value))

    amplitude = stages[0][1][0]
    own = task([amplitude])
    values = parts.deal({"excited": counts[order]})
    starts = parts.starts(parts.place(Starts(chain, initial)), values)
    lanes = on_all(start_lane, own, starts)
    found: dict[type, list] = {PeakTimes: [], Samples: []}
    interrupted = False
    with progress_bar(
        total=round(end), desc=description, unit="time unit", show=progress,
        bar_format="{desc}: {percentage:3.0f}%|{bar}| [{elapsed}<{remaining}]",
    ) as bar:  # fmt: skip
        try:
            for start, observers, ends in stages:
                own = task(observers)
                lanes = on_all(_watch, own, lanes, everywhere(start))
                for until in ends.tolist():
                    lanes, seen = zip(
                        *on_all(_advance, own, lanes, everywhere(until)), strict=True
                    )
                    for observer, value in zip(observers[1:], joined(seen)[1:], strict=True):
                        kept = [a[mine] for a in jax.tree.leaves(value)]
                        found[type(observer)].append(kept)
                    bar.update(round(until) - bar.n)
        except KeyboardInterrupt:
            interrupted = True
    records = joined(on_all(read_lane, own, lanes))
    own_names = amplitude.label(jnp.zeros(chain.n), chain)
    records["observed"] = {name: records["observed"][name] for name in own_names}
    records = jax.tree.map(lambda a: a[mine], records)
    failed = ~ended_well(records["result"])
    if interrupted:
        records["result"][~failed] = NAMES.index("interrupted")
    attrs = describe(chain, own.plan, t0=0.0, t1=end, swept=["excited"])
    attrs |= {
        "wall_time_s": round(time.perf_counter() - begun, 3),
        "devices": ", ".join(str(device) for device in parts.devices),
        "belt_speed": float(chain.belt_speed),
        "transient": part.time.transient,
        "window": part.time.window,
    }
    data = to_dataset(records, {"excited": {"excited": counts}}, chain, attrs)
    if found[PeakTimes]:
        join_peaks(data, found[PeakTimes], failed)
    if found[Samples] and phase_plots is not None:
        join_samples(data, found[Samples], phase_plots, failed)
    if interrupted:
        raise SweepInterrupted(data)
    return data


def time_series(part: States, model: str, table: TimeSeries) -> xr.Dataset:
    """One state, every mass: `displacement`, `velocity` and `sticking` (time, oscillator)."""
    chain, count = build_chain(part), int(part.grid()["excited"][0])
    capacity = math.floor((table.stop - table.start) / table.interval + 1e-6) + 1
    numerics, start = part.numerics, build_initial(part)(chain, excited=count)
    run = simulate(
        chain, start, table.stop, observe=Samples(table.interval, capacity, start=table.start),
        solver=_solver(part, model, chain), rtol=numerics.rtol, atol=numerics.atol,
        max_step=numerics.max_step,
    )  # fmt: skip
    times, x, v = (np.asarray(a) for a in run.observed)
    # True dry friction holds a mass at the belt's speed to rounding; otherwise as `StickTime`.
    slowest = 1e-9 if model == "nonsmooth" else np.asarray(chain.stick_speed())
    holds = np.asarray(jax.vmap(chain.unheld_force)(*run.observed[1:])) <= 1e-9
    sticking = (np.abs(v - float(chain.belt_speed)) <= slowest) & holds
    dims = ("time", "oscillator")
    return xr.Dataset(
        {"displacement": (dims, x), "velocity": (dims, v), "sticking": (dims, sticking)},
        coords={"time": times, "oscillator": np.arange(1, chain.n + 1)},
        attrs={"excited": count, "belt_speed": float(chain.belt_speed)},
    )


def _solver(part: States, model: str, chain: Chain) -> Any:
    numerics = part.numerics
    if model == "nonsmooth":
        return EventDriven()
    check_resolved(chain.n, chain.width, chain.belt_speed, numerics.rtol, numerics.atol)
    named = build_solver(numerics.solver, chain, numerics.rtol, numerics.max_step)
    return choose_solver(chain, numerics.rtol, numerics.max_step) if named is None else named


def _shortest(chain: Chain) -> float:
    """2 pi / omega of the fastest mode that the chain may have (Gershgorin)."""
    coupling = 0.0 if chain.coupling is None else float(np.max(np.asarray(chain.coupling)))
    stiffest = float(np.max(np.asarray(chain.stiffness))) + 4.0 * coupling
    return 2.0 * math.pi / math.sqrt(stiffest)


def _deal(count: int, lanes: int | None) -> tuple[Parts, np.ndarray]:
    """Parts, and which state each lane runs: neighbours, of equal cost, in different parts.

    As in `sweep`: so many `lanes` on one device at a time, or a share on each device.
    """
    devices = jax.local_devices()[:count]
    number = len(devices) if lanes is None else -(-count // lanes)
    each = -(-count // number)
    order = np.arange(each * number) % count
    parts = Parts([devices[i % len(devices)] for i in range(number)])
    return parts, order.reshape(each, number).T.ravel()


def _stages(
    part: States, chain: Chain, peaks_from: float | None, phase_plots: PhasePlots | None
) -> Iterator[tuple[float, list[AbstractObserver], np.ndarray]]:
    """Of each stage: when it begins, what is observed in it, when its stretches end.

    Nothing is observed before somebody asks for it.
    """
    end, stretch = part.time.transient + part.time.window, STRETCH_PERIODS * _shortest(chain)
    watch: list[tuple[float, AbstractObserver]] = [(0.0, Amplitude(window=part.time.window))]
    if peaks_from is not None:
        watch.append((peaks_from, PeakTimes(CAPACITY)))
    if phase_plots is not None:
        begin = end - (phase_plots.duration or part.time.window)
        room = math.ceil(stretch / phase_plots.interval) + 2
        masses = tuple(number - 1 for number in phase_plots.oscillators)
        watch.append((begin, Samples(phase_plots.interval, room, masses, begin)))
    edges = sorted({end, *(begin for begin, _ in watch)})
    for start, stop in itertools.pairwise(edges):
        count = math.ceil((stop - start) / stretch - 1e-9)
        ends = start + (stop - start) * np.arange(1, count + 1) / count
        yield start, [own for begin, own in watch if begin <= start], ends


def _watch(task: Task, lane: Lane, now: Array) -> Lane:
    """The lane with fresh stores for all that is observed but amplitudes."""
    chain, progress = task.own_chain(lane.own), lane.progress
    fresh = [o.init(chain, now, task.t1, progress.state) for o in task.plan.observers[1:]]
    accumulators = [progress.accumulators[0], *fresh]
    return Lane(lane.own, eqx.tree_at(lambda p: p.accumulators, progress, accumulators))


def _advance(task: Task, lane: Lane, until: Array) -> tuple[Lane, list]:
    """The lane at the end of a stretch, and what was observed in it."""
    chain = task.own_chain(lane.own)
    progress, _ = task.plan.advance(chain, lane.progress, until, max_steps=None)
    seen = task.plan.read(progress)
    return _watch(task, Lane(lane.own, progress), until), seen
