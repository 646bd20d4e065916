"""Rows about many lanes: a mixed sweep against plain vmap, two devices, true dry friction."""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain._types import State
from jaxchain.bench.timing import Row, comparison, compiled, in_turn
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.quantities import active
from jaxchain.result import NAMES
from jaxchain.simulation.accuracy import choose_solver
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.sweeps.sweeping import sweep

N, WIDTH, RTOL = 20, 1e-3, 1e-6


def mixed_start(chain: Chain, start: Any) -> State:
    """Initial states 0 ... 15: eight that rest but for a small kick, and eight of eq. (8)."""
    excited = jnp.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 4, 6, 9, 12, 16, 20])[start]
    x, v = equation_8(chain, excited)
    return x, v + jnp.where(start < 8, 0.01 * (1 + start), 0.0)


def mixed_row(repeats: int, speeds: int = 16, span: float = 1000.0) -> list[Row]:
    """`sweep` against one `vmap` of the same solver: a mix of quiet and stick-slip lanes.

    The sweep ends lanes that have come to rest, which a `vmap` cannot.
    """
    chain = paper_chain(N, 1.5, WIDTH)
    belt_speeds = np.linspace(0.8, 2.2, speeds)
    solver = choose_solver(chain, RTOL)
    observe = Amplitude(window=30.0)
    settling = Amplitude(window=30.0, stop="quiet")
    grid = jnp.meshgrid(jnp.asarray(belt_speeds), jnp.arange(16), indexing="ij")
    flat = [g.ravel() for g in grid]
    lanes = flat[0].size

    def one(belt_speed: Any, start: Any) -> Any:
        own = chain.with_(belt_speed=belt_speed)
        run = simulate(
            own, mixed_start(own, start), span, observe=observe, solver=solver, rtol=RTOL,
            throw=False,
        )  # fmt: skip
        return active(run.observed, belt_speed).sum(), run.steps + run.rejected

    plain, seconds = compiled(jax.vmap(one), *flat)
    device = jax.local_devices(backend="cpu")[:1]

    def swept() -> Any:
        return sweep(
            chain, mixed_start, span, over={"belt_speed": belt_speeds, "start": np.arange(16)},
            observe=settling, rtol=RTOL, devices=device,
        )  # fmt: skip

    start = time.perf_counter()
    dataset = swept()
    first = time.perf_counter() - start
    labels, steps = plain(*flat)
    different = int(np.sum(dataset["active_count"].values.ravel() != np.asarray(labels)))
    uneven = lanes * float(jnp.max(steps)) / float((dataset["steps"] + dataset["rejected"]).sum())
    quiet = int(np.sum(dataset["result"].values == NAMES.index("quiet")))
    times = in_turn({"vmap": lambda: plain(*flat), "sweep": swept}, repeats)
    note = (
        f"tau {span:g}, belt speeds 0.8 to 2.2; labels (active counts) that "
        f"differ: {different}; {quiet} lanes came to rest early; slowest lane / mean "
        f"lane, in steps: {uneven:.3g}\n"
        f"compiled in {seconds:.1f} s (vmap) and "
        f"{max(0.0, first - times['sweep'].median):.1f} s"
    )
    title = f"vmap(diffeqsolve) / sweep, {lanes} lanes, one device"
    return [comparison("mixed", title, times, list(times), lanes=lanes, bar=3.0, note=note)]


def devices_row(repeats: int, lanes: int = 512, span: float = 50.0) -> list[Row]:
    """The same sweep on one CPU device and on two."""
    title = f"one CPU device / two, {lanes} lanes"
    devices = jax.local_devices(backend="cpu")
    if len(devices) < 2:
        note = "skipped, JAX has one CPU device here: JAX_NUM_CPU_DEVICES=2 gives it two"
        return [Row("devices", title, note=note)]
    chain = paper_chain(N, 1.5, WIDTH)
    belt_speeds = np.linspace(1.2, 1.4, lanes // 4)

    def run(count: int) -> object:
        return sweep(
            chain, equation_8, span, over={"belt_speed": belt_speeds, "excited": [3, 9, 14, 20]},
            observe=Amplitude(window=10.0), rtol=RTOL, devices=devices[:count],
        )  # fmt: skip

    sides = {"one device": lambda: run(1), "two devices": lambda: run(2)}
    first = {}
    for name, side in sides.items():
        first[name] = time.perf_counter()
        side()
        first[name] = time.perf_counter() - first[name]
    times = in_turn(sides, repeats)
    compile_seconds = [max(0.0, first[k] - times[k].median) for k in sides]
    note = (
        f"tau {span:g}, width {WIDTH:g}; compiled in {compile_seconds[0]:.1f} s and "
        f"{compile_seconds[1]:.1f} s"
    )
    return [comparison("devices", title, times, list(times), bar=1.7, note=note)]


def dry_row(repeats: int, lanes: int = 64, span: float = 1000.0) -> list[Row]:
    """True dry friction, event by event, against smoothed friction on the same lanes."""
    chain = paper_chain(N, 1.5, WIDTH)
    belt_speeds = jnp.linspace(1.4, 1.6, lanes)

    def integrate(solver: Any, rtol: float) -> tuple[Any, float]:
        def one(belt_speed: Any) -> Any:
            own = chain.with_(belt_speed=belt_speed)
            run = simulate(
                own, equation_8(own, 10), span, observe=Amplitude(window=100.0), solver=solver,
                rtol=rtol, throw=False,
            )  # fmt: skip
            return run.observed, run.steps + run.rejected

        return compiled(jax.vmap(one), belt_speeds)

    # The loosest tolerance that is right at this width, and one that errs a thousand times less.
    sides = {
        "smoothed, rtol 1e-5": integrate(choose_solver(chain, 1e-5), 1e-5),
        "event-driven, rtol 1e-6": integrate(EventDriven(), 1e-6),
    }
    smoothed, dry = sides
    results = {name: program(belt_speeds) for name, (program, _) in sides.items()}
    times = in_turn({k: lambda p=p: p(belt_speeds) for k, (p, _) in sides.items()}, repeats)
    apart = jnp.max(jnp.abs(results[smoothed][0] - results[dry][0]), axis=-1)
    steps = " and ".join(f"{float(jnp.mean(n)) / span:.1f}" for _, n in results.values())
    seconds = " and ".join(f"{seconds:.1f}" for _, seconds in sides.values())
    title = f"smoothed, width {WIDTH:g} / true dry friction, {lanes} lanes, tau {span:g}"
    note = (
        f"N {N}, ten excited; steps a time unit {steps}; amplitudes differ by "
        f"{float(jnp.median(apart)):.1e} (median lane), {float(jnp.max(apart)):.1e} (worst)\n"
        f"compiled in {seconds} s"
    )
    return [comparison("dry", title, times, list(times), lanes=lanes, bar=1.0, note=note)]
