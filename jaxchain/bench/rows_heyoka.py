"""Rows about true dry friction against heyoka, a Taylor integrator with events, at equal error."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxchain.bench.equal_error import Setting, cheapest, error_of, scan
from jaxchain.bench.peers import PeerMissingError
from jaxchain.bench.peers_heyoka import heyoka, heyoka_lanes, simd_width
from jaxchain.bench.timing import Row, comparison, compiled, in_turn
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate

# What jaxchain's usual rtol, 1e-6, leaves over this span; all motions are regular.
ERROR, SPAN = 1e-4, 1000.0
BELT_SPEED, BELT_SPEEDS = 1.5, (1.4, 1.6)
TOLERANCES = tuple(10.0 ** (-k / 2) for k in range(6, 17))  # 10^-3 ... 10^-8
_TIGHTEST = 1e-15


def problem(n: int) -> tuple[Chain, int]:
    """The paper's chain with dry friction, and how many are excited: one mass, or half of many."""
    return paper_chain(n, BELT_SPEED, width=None), max(1, n // 2)


def own(chain: Chain, excited: int, belt_speeds: Any, t1: float) -> Callable[[float], Any]:
    """The state (x, v) at t1 as a function of rtol, which chooses the order and is compiled for.

    Of one belt speed or, by vmap, of several.
    """
    programs: dict[float, Callable] = {}

    def solve(rtol: float) -> Any:
        def one(belt_speed: Any) -> Any:
            lane = chain.with_(belt_speed=belt_speed)
            initial = equation_8(lane, excited)
            run = simulate(lane, initial, t1, solver=EventDriven(), rtol=rtol, throw=False)
            return run.state

        if rtol not in programs:
            many = jnp.ndim(belt_speeds) == 1
            programs[rtol], _ = compiled(jax.vmap(one) if many else one, belt_speeds)
        return programs[rtol](belt_speeds)

    return solve


def heyoka_row(repeats: int) -> list[Row]:
    """One mass; twenty, ten of them excited; and 64 such lanes, each on one core."""
    try:
        width = simd_width()
    except PeerMissingError as missing:
        return [
            Row("heyoka", "heyoka / jaxchain, dry friction, 1 and 64 lanes", note=str(missing))
        ]
    return [
        _one_lane(repeats, n=1, bar=1.7),
        _one_lane(repeats, n=20, bar=2.5),
        _many_lanes(max(3, repeats // 2), n=20, lanes=64, width=width, bar=3.5),
    ]


def _one_lane(repeats: int, n: int, bar: float) -> Row:
    chain, excited = problem(n)
    masses = "one mass" if n == 1 else f"N = {n}, {excited} excited"
    return _compare(
        repeats,
        f"{masses}, one lane",
        {"heyoka": heyoka(chain, equation_8(chain, excited), SPAN)},
        own(chain, excited, chain.belt_speed, SPAN),
        bar,
    )


def _many_lanes(repeats: int, n: int, lanes: int, width: int, bar: float) -> Row:
    chain, excited = problem(n)
    belt_speeds = jnp.linspace(*BELT_SPEEDS, lanes)
    initial = jax.vmap(lambda speed: equation_8(chain.with_(belt_speed=speed), excited))
    start, speeds = initial(belt_speeds), belt_speeds.tolist()
    return _compare(
        repeats,
        f"N = {n}, {excited} excited, a lane of {lanes}",
        {
            f"heyoka, batches of {width}": heyoka_lanes(chain, speeds, start, SPAN, width),
            "heyoka in a loop": heyoka_lanes(chain, speeds, start, SPAN, 1),
        },
        own(chain, excited, belt_speeds, SPAN),
        bar,
        lanes,
    )


def _compare(
    repeats: int,
    title: str,
    peers: dict[str, Callable[[float], Any]],
    solve: Callable[[float], Any],
    bar: float,
    lanes: int = 1,
) -> Row:
    """Core time, the first of the peers against jaxchain, each with its best tolerance."""
    reference = solve(1e-12)
    second = error_of(next(iter(peers.values()))(_TIGHTEST), reference)
    settings: dict[str, Setting] = {
        name: cheapest(scan(name, peer, reference, ERROR, tolerances=TOLERANCES))
        for name, peer in peers.items()
    }
    settings["jaxchain"] = cheapest(
        scan("EventDriven", solve, reference, ERROR, tolerances=TOLERANCES)
    )
    sides = {name: setting.run for name, setting in settings.items()}
    times = in_turn(sides, repeats, clock=time.process_time)
    first = next(iter(peers))
    note = f"core time of a time unit and lane; tau {SPAN:g}; references differ by {second:.0e}"
    for name in list(peers)[1:]:
        per_lane = times[name].per(lanes * SPAN)
        note += f"\n{settings[name]}: {1e6 * per_lane.median:.3g} us"
    return comparison(
        "heyoka", f"heyoka / jaxchain, dry friction, error <= 1e-4, {title}", times,
        (first, "jaxchain"), labels=[str(settings[side]) for side in (first, "jaxchain")],
        lanes=round(lanes * SPAN), bar=bar, note=note,
    )  # fmt: skip
