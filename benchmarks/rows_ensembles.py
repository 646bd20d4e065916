"""Many lanes: what a sweep adds and saves, two devices, a GPU."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from timing import Skipped, compiled, in_turn, lines, runs

from jaxchain import (
    Amplitude,
    EventDriven,
    Rodas4,
    active,
    equation_8,
    paper_chain,
    simulate,
    sweep,
)

N, WIDTH, RTOL, EXCITED = 20, 1e-3, 1e-6, 10


def sweep_row(repeats: int, quick: bool) -> list[dict]:
    """The cost of `sweep` with amplitudes over `vmap(simulate)` without observers.

    Compared is the core time of a step of one lane, rejected or not. Two devices may take twice
    the core time of one, for twice as many runs.
    """
    smoothed, span = paper_chain(N, 1.5, WIDTH), 3.0 if quick else 500.0
    # Runs of each device; of few runs a sweep is mostly preparation.
    few, many = 64 if quick else 256, 5_000
    cases: dict[str, Any] = {
        f"smoothed, width {WIDTH:g}": (smoothed, Rodas4(sweeps=1), "never", few, 1.1)
    }
    if not quick:
        dry = smoothed.with_(width=None), EventDriven()
        cases |= {f"dry friction, {many} runs of each device": (*dry, "never", many, 1.1)}
        cases |= {'dry friction, 32 runs of each device, stop="quiet"': (*dry, "quiet", 32, 1.2)}
    # As many lanes as `sweep` takes by itself, with belt speeds so close that nearly all take the
    # same steps: what is compared is the machinery.
    lanes, belt_speeds = 16, (1.5, 1.5 + 1e-6)
    cpus = jax.local_devices(backend="cpu")

    def swept(chain: Any, solver: Any, stop: Any, runs: int, devices: Any) -> int:
        dataset = sweep(
            chain,
            functools.partial(equation_8, excited=EXCITED),
            span,
            over={"belt_speed": np.linspace(*belt_speeds, runs * len(devices))},
            solver=solver,
            rtol=RTOL,
            observe=Amplitude(window=0.1 * span, stop=stop),
            devices=devices,
        )
        assert dataset.attrs["lanes_per_device"] == lanes, "all sides run equally many at a time"
        return int((dataset["steps"] + dataset["rejected"]).sum())

    table = []
    for case, (chain, solver, stop, count_of_runs, bar) in cases.items():
        program, speeds = runs(chain, EXCITED, span, solver), jnp.linspace(*belt_speeds, lanes)

        # Of a side that takes a tenth of a second, the noise of the machine is all one sees.
        batches = min(64, count_of_runs // lanes)

        def plain(program: Any = program, speeds: Any = speeds, batches: int = batches) -> int:
            return sum(int(program(speeds, RTOL)[2].sum()) for _ in range(batches))

        sides: dict[str, Callable[[], int]] = {
            f"sweep, {count} device(s)": functools.partial(
                swept, chain, solver, stop, count_of_runs, cpus[:count]
            )
            for count in (1, 2)
            if count <= len(cpus)
        }
        bars = dict.fromkeys(sides, ("<=", bar))
        sides["vmap(simulate)"] = plain
        steps = pd.Series({side: run() for side, run in sides.items()})
        times = in_turn(sides, repeats, clock=time.process_time) / steps
        table += lines(f"sweep, {case}, core time of a step", times, "vmap(simulate)", bars)
    return table


def mixed_start(chain: Any, start: Any) -> Any:
    """Initial states 0 ... 15: eight that slide except for a small kick, and eight of eq. (8)."""
    excited = jnp.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 4, 6, 9, 12, 16, 20])[start]
    x, v = equation_8(chain, excited)
    return x, v + jnp.where(start < 8, 0.01 * (1 + start), 0.0)


def mixed_row(repeats: int, quick: bool) -> list[dict]:
    """A sweep of quiet and stick-slip lanes against one `vmap` of the same solver.

    The sweep ends lanes that have come to rest, which a `vmap` cannot.
    """
    chain, span = paper_chain(N, 1.5, WIDTH), 60.0 if quick else 1000.0
    belt_speeds, starts = np.linspace(0.8, 2.2, 2 if quick else 16), np.arange(16)
    grid = [jnp.asarray(axis.ravel()) for axis in np.meshgrid(belt_speeds, starts, indexing="ij")]

    def one(belt_speed: Any, start: Any) -> Any:
        lane = chain.with_(belt_speed=belt_speed)
        observe = Amplitude(window=30.0)
        run = simulate(
            lane, mixed_start(lane, start), span, observe=observe, rtol=RTOL, throw=False
        )
        return active(run.observed, belt_speed).sum()

    plain = compiled(jax.vmap(one))

    def swept() -> Any:
        return sweep(
            chain,
            mixed_start,
            span,
            over={"belt_speed": belt_speeds, "start": starts},
            observe=Amplitude(window=30.0, stop="quiet"),
            rtol=RTOL,
            devices=jax.local_devices(backend="cpu")[:1],
        )

    dataset = swept()
    different = int(np.sum(dataset["active_count"].values.ravel() != np.asarray(plain(*grid))))
    quiet = dataset["result"].attrs["flag_meanings"].split().index("quiet")
    early = int((dataset["result"] == quiet).sum())
    times = in_turn({"vmap(simulate)": lambda: plain(*grid), "sweep": swept}, repeats)
    return lines(
        f"quiet and vibrating lanes mixed, a lane of {len(grid[0])}, one device; {early} came to "
        f"rest early; active counts that differ: {different}",
        times / len(grid[0]),
        "sweep",
        {"vmap(simulate)": (">=", 3.0)},
    )


def devices_row(repeats: int, quick: bool) -> list[dict]:
    """The same sweep on one CPU device and on two."""
    devices = jax.local_devices(backend="cpu")
    if len(devices) < 2:
        raise Skipped("JAX has one CPU device here: JAX_NUM_CPU_DEVICES=2 gives it two")
    lanes, span = (8, 20.0) if quick else (512, 50.0)
    over = {"belt_speed": np.linspace(1.2, 1.4, lanes // 4), "excited": [3, 9, 14, 20]}

    def run(count: int) -> Any:
        return sweep(
            paper_chain(N, 1.5, WIDTH),
            equation_8,
            span,
            over=over,
            observe=Amplitude(window=10.0),
            rtol=RTOL,
            devices=devices[:count],
        )

    times = in_turn({"one device": lambda: run(1), "two devices": lambda: run(2)}, repeats)
    case = f"two CPU devices, {lanes} runs of tau {span:g}"
    return lines(case, times, "two devices", {"one device": (">=", 1.7)})


def gpu_row(repeats: int, quick: bool) -> list[dict]:
    """Time of a lane on a GPU, with few lanes and with many, against a CPU core."""
    try:
        gpu = jax.devices("gpu")[0]
    except RuntimeError:
        raise Skipped("JAX sees no GPU here; for one: pip install 'jaxchain[cuda]'") from None
    few, many, span = (2, (16,), 5.0) if quick else (64, (4096, 32768, 100_000), 100.0)
    lanes = {f"CPU core, {few} lanes": (jax.local_devices(backend="cpu")[0], few)}
    lanes |= {f"{gpu.device_kind}, {count} lanes": (gpu, count) for count in many}
    smoothed, table = paper_chain(N, 1.5, WIDTH), []
    for kind, chain, solver, rtol in (
        (f"smoothed, width {WIDTH:g}", smoothed, Rodas4(sweeps=1), 1e-5),
        ("dry friction", smoothed.with_(width=None), EventDriven(), 1e-6),
    ):
        sides: dict[str, Callable[[], Any]] = {}
        for name, (device, count) in lanes.items():
            # On its device, where the program then runs: not on the default one.
            speeds = jax.device_put(jnp.linspace(1.4, 1.6, count), device)
            program = runs(chain, EXCITED, span, solver, observe=Amplitude(window=0.1 * span))
            sides[name] = functools.partial(program, speeds, rtol)
        # The first and the last belt speed are the same everywhere.
        ends = [np.asarray(side()[1])[[0, -1]] for side in sides.values()]
        times = in_turn(sides, repeats) / [count for _, count in lanes.values()]
        apart = np.max(np.ptp(ends, axis=0))
        case = f"GPU, {kind}, tau {span:g}, a lane; amplitudes differ by {apart:.0e}"
        table += lines(case, times, list(sides)[1])
    return table
