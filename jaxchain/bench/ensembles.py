"""Rows about many lanes: a mixed sweep against plain vmap, and two devices against one."""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain._types import State
from jaxchain.bench.timing import Bar, Row, compiled, in_turn
from jaxchain.chain import Chain, paper_chain
from jaxchain.choice import choose_solver
from jaxchain.ensemble import sweep
from jaxchain.measures import active
from jaxchain.amplitude import Amplitude
from jaxchain.simulate import simulate
from jaxchain.states import equation_8

N, WIDTH, RTOL = 20, 1e-3, 1e-6


def mixed_start(chain: Chain, start: Any) -> State:
    """Initial states 0 ... 15: eight that rest but for a small kick, and eight of eq. (8)."""
    excited = jnp.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 4, 6, 9, 12, 16, 20])[start]
    x, v = equation_8(chain, excited)
    return x, v + jnp.where(start < 8, 0.01 * (1 + start), 0.0)


def mixed_row(repeats: int, speeds: int = 32, span: float = 100.0) -> list[Row]:
    """`sweep` against one `vmap` of the same solver: a mix of quiet and stick-slip lanes."""
    chain = paper_chain(N, 1.5, WIDTH)
    belt_speeds = np.linspace(0.8, 2.2, speeds)
    solver = choose_solver(chain, RTOL)
    observe = Amplitude(window=30.0)
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
            observe=observe, rtol=RTOL, devices=device,
        )  # fmt: skip

    start = time.perf_counter()
    dataset = swept()
    first = time.perf_counter() - start
    labels, steps = plain(*flat)
    different = int(np.sum(dataset["active_count"].values.ravel() != np.asarray(labels)))
    uneven = lanes * float(jnp.max(steps)) / float((dataset["steps"] + dataset["rejected"]).sum())
    times = in_turn({"vmap": lambda: plain(*flat), "sweep": swept}, repeats)
    return [
        Row(
            "mixed",
            f"vmap(diffeqsolve) / sweep, {lanes} lanes, one device",
            {f"{name}, a lane": sample.per(lanes) for name, sample in times.items()},
            times["vmap"].over(times["sweep"]),
            bar=Bar("at least", 3.0),
            note=f"tau {span:g}, belt speeds 0.8 to 2.2; labels (active counts) that differ: "
            f"{different}; slowest lane / mean lane, in steps: {uneven:.3g}\n"
            f"compiled in {seconds:.1f} s (vmap) and "
            f"{max(0.0, first - times['sweep'].median):.1f} s",
        )
    ]


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
    return [
        Row(
            "devices",
            title,
            times,
            times["one device"].over(times["two devices"]),
            bar=Bar("at least", 1.7),
            note=f"tau {span:g}, width {WIDTH:g}; compiled in {compile_seconds[0]:.1f} s and "
            f"{compile_seconds[1]:.1f} s",
        )
    ]
