"""The row about what `sweep` adds to the runs themselves, measured against `vmap(simulate)`."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.bench.timing import Bar, Row, compiled, in_turn
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.observers.amplitude import Amplitude
from jaxchain.simulation.accuracy import choose_solver
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.sweeps.sweeping import sweep

N, WIDTH, RTOL, EXCITED = 20, 1e-3, 1e-6, 10
# So close that all lanes take the same steps but for a few: what is compared is the machinery.
BELT_SPEEDS = (1.5, 1.5 + 1e-6)
# As many as `sweep` takes by itself, and how many times as many runs there are.
LANES, ROUNDS = 32, 8


def plain(chain: Chain, solver: Any, span: float) -> tuple[Callable[[], Any], float]:
    """`vmap(simulate)` of one device's lanes with no observer: a run, which returns its steps."""
    belt_speeds = jnp.linspace(*BELT_SPEEDS, LANES)

    def one(belt_speed: Any) -> Any:
        own = chain.with_(belt_speed=belt_speed)
        run = simulate(own, equation_8(own, EXCITED), span, solver=solver, rtol=RTOL, throw=False)
        return run.state, run.steps + run.rejected

    program, seconds = compiled(jax.vmap(one), belt_speeds)
    return lambda: int(program(belt_speeds)[1].sum()), seconds


def swept(chain: Chain, solver: Any, span: float, devices: Sequence[Any]) -> int:
    """The same by `sweep`, amplitudes and all, of many more runs than there are lanes."""
    dataset = sweep(
        chain, functools.partial(equation_8, excited=EXCITED), span, solver=solver, rtol=RTOL,
        over={"belt_speed": np.linspace(*BELT_SPEEDS, ROUNDS * LANES * len(devices))},
        observe=Amplitude(window=0.1 * span), devices=devices,
    )  # fmt: skip
    assert dataset.attrs["lanes_per_device"] == LANES, "both sides run equally many at a time"
    return int((dataset["steps"] + dataset["rejected"]).sum())


def sweep_row(repeats: int, span: float = 500.0) -> list[Row]:
    """Core time of a step and lane, smoothed and nonsmooth, on one device and on two.

    Steps are accepted and rejected ones.  Two devices may take twice the core time of one, for
    twice as many runs.
    """
    smoothed = paper_chain(N, BELT_SPEEDS[0], WIDTH)
    rows = _rows(
        repeats, span, f"smoothed, width {WIDTH:g}", smoothed, choose_solver(smoothed, RTOL)
    )
    return rows + _rows(repeats, span, "nonsmooth", smoothed.with_(width=None), EventDriven())


def _rows(repeats: int, span: float, friction: str, chain: Chain, solver: Any) -> list[Row]:
    devices = jax.local_devices(backend="cpu")
    run, seconds = plain(chain, solver, span)
    sides: dict[str, Callable[[], int]] = {"vmap": run}
    for name, count in (("one device", 1), ("two devices", 2)):
        if count <= len(devices):
            sides[name] = functools.partial(swept, chain, solver, span, devices[:count])
    steps = {name: side() for name, side in sides.items()}
    times = {
        name: sample.per(steps[name])
        for name, sample in in_turn(sides, repeats, clock=time.process_time).items()
    }
    note = (
        f"core time of a step and lane; N {N}, {EXCITED} excited, tau {span:g}; {LANES} lanes on "
        f"each device, {ROUNDS} times as many runs; compiled in {seconds:.1f} s (vmap)"
    )
    title = f"sweep with Amplitude / vmap(simulate) without, {friction}, "
    rows = [
        Row(
            "sweep",
            title + name,
            {f"sweep, {name}": times[name], "vmap(simulate), one device": times["vmap"]},
            times[name].over(times["vmap"]),
            bar=Bar("at most", 1.15),
            note=note,
        )
        for name in list(sides)[1:]
    ]
    if len(devices) < 2:
        skipped = "skipped, JAX has one CPU device here: JAX_NUM_CPU_DEVICES=2 gives it two"
        rows.append(Row("sweep", title + "two devices", note=skipped))
    return rows
