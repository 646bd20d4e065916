"""One integration against other solvers, each with its cheapest tolerance at equal error."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from peers import CompiledRing, cvode, heyoka, lsoda
from timing import FINE, cheapest, compiled, error_of, in_turn, lines, runs

from jaxchain import Amplitude, EventDriven, Rodas4, Rodas5P, equation_8, paper_chain
from jaxchain.solvers import SwitchingController

# The paper's chain of twenty with nine excited, at a width where it is stiff.
N, EXCITED, BELT_SPEED, WIDTH = 20, 9, 1.3, 1e-4
# So many runs of twenty masses `sweep` computes at the same time on a core.
BATCH = 16


def structured(chain: Any, belt_speeds: Any, span: float) -> dict[str, Callable[[float], Any]]:
    """Both structured solvers, with the one Jacobi sweep that `simulate` takes for this coupling.

    As functions of rtol that return the end state.
    """

    def solve(program: Callable[..., Any], rtol: float) -> Any:
        return program(belt_speeds, rtol)[0]

    lanes = jnp.ndim(belt_speeds) == 1
    return {
        type(solver).__name__: partial(solve, runs(chain, EXCITED, span, solver, lanes=lanes))
        for solver in (Rodas4(sweeps=1), Rodas5P(sweeps=1))
    }


def stock_terms(solver: dfx.AbstractSolver) -> Any:
    """The equations as diffrax takes them, with the chain as its argument."""

    def linear(t: Any, y: Any, chain: Any) -> Any:
        x, v = y
        return v, chain.restoring_force(x)

    def friction(t: Any, y: Any, chain: Any) -> Any:
        x, v = y
        return jnp.zeros_like(x), chain.local_force(t, x, v)

    if isinstance(solver, dfx.KenCarp4):  # implicit for the stiff friction, explicit for the rest
        return dfx.MultiTerm(dfx.ODETerm(linear), dfx.ODETerm(friction))
    return dfx.ODETerm(lambda t, y, chain: chain(t, y))


def stock(solver: dfx.AbstractSolver, chain: Any, span: float, switching: bool) -> Any:
    """Compiled runs by diffrax: (rtol, gains (p, i) of the step-size control) -> end state.

    By diffrax alone, or with jaxchain's `SwitchingController` around its controller.
    """

    def solve(rtol: Any, gains: Any) -> Any:
        p, i = gains
        controller: Any = dfx.PIDController(rtol=rtol, atol=0.1 * rtol, pcoeff=p, icoeff=i)
        solution: Any = dfx.diffeqsolve(
            stock_terms(solver),
            solver,
            t0=0.0,
            t1=span,
            dt0=None,
            y0=equation_8(chain, EXCITED),
            args=chain,
            stepsize_controller=SwitchingController(controller, chain)
            if switching
            else controller,
            adjoint=dfx.ForwardMode(),
            max_steps=None,
            throw=False,
        )
        return jax.tree.map(lambda y: y[0], solution.ys)

    return compiled(solve)


def stock_row(repeats: int, quick: bool) -> list[dict]:
    """The structured solver against the fastest stock diffrax solver."""
    chain, span = paper_chain(N, BELT_SPEED, WIDTH), 2.0 if quick else 30.0
    own = structured(chain, BELT_SPEED, span)
    reference = own["Rodas5P"](1e-12)
    names = ("Tsit5",) if quick else ("Tsit5", "Dopri8", "Kvaerno3", "Kvaerno5", "KenCarp4")

    def fastest(switching: bool) -> tuple[str, Callable[[], Any]]:
        solvers = {}
        for name in names:
            program = stock(getattr(dfx, name)(), chain, span, switching)
            for gains, control in (((0.0, 1.0), "I"), ((0.4, 0.3), "PI")):
                label = f"{name} ({control}{' and switching' if switching else ''} control)"
                solvers[label] = partial(lambda gains, run, rtol: run(rtol, gains), gains, program)
        return cheapest(solvers, reference, 1e-4)

    sides = dict([fastest(False), fastest(True), cheapest(own, reference, 1e-4)])
    plain, _, jaxchain = sides
    times = in_turn(sides, repeats)
    return lines(
        "fastest stock diffrax solver, error <= 1e-4", times, jaxchain, {plain: (">=", 40)}
    )


def lsoda_row(repeats: int, quick: bool) -> list[dict]:
    """Against LSODA and CVODE with compiled right side and Jacobian, one lane and 64."""
    chain, span, bar = paper_chain(N, BELT_SPEED, WIDTH), 2.0 if quick else 30.0, 1e-6
    ring, initial = CompiledRing(N), equation_8(chain, EXCITED)
    own = structured(chain, BELT_SPEED, span)
    reference = own["Rodas5P"](1e-12)
    peers = {"LSODA": lsoda, "CVODE": cvode}
    sides = dict(
        cheapest({name: peer(ring, chain, initial, span)}, reference, bar, FINE)
        for name, peer in peers.items()
    )
    sides |= [cheapest(own, reference, bar, FINE)]
    first, _, jaxchain = sides
    times = in_turn(sides, repeats)
    table = lines("LSODA and CVODE, error <= 1e-6, one lane", times, jaxchain, {first: (">=", 5)})

    belt_speeds = jnp.linspace(1.2, 1.4, 2 if quick else 64)
    own = structured(chain, belt_speeds, span)
    reference = own["Rodas5P"](1e-12)
    chains = [chain.with_(belt_speed=speed) for speed in belt_speeds.tolist()]
    loop = [lsoda(ring, lane, equation_8(lane, EXCITED), span) for lane in chains]

    def by_lsoda(rtol: float) -> np.ndarray:
        return np.stack([run(rtol) for run in loop], axis=1)

    tight = [rtol for rtol in FINE if rtol < 1e-7]  # none passes earlier
    sides = dict(
        [
            cheapest({"LSODA in a loop": by_lsoda}, reference, bar, tight),
            cheapest(own, reference, bar, FINE),
        ]
    )
    first, jaxchain = sides
    times = in_turn(sides, max(repeats // 2, min(repeats, 3))) / len(chains)
    case = f"LSODA, error <= 1e-6, a lane of {len(chains)}"
    return table + lines(case, times, jaxchain, {first: (">=", 15)})


def heyoka_row(repeats: int, quick: bool) -> list[dict]:
    """True dry friction against heyoka, core time of a time unit: one mass, N = 20, 64 lanes."""
    import heyoka as hy

    batch, span = hy.recommended_simd_size(), 20.0 if quick else 1000.0
    table = _against_heyoka(repeats, 1, 1.5, span, {"heyoka": 1}, 1.0)
    if not quick:
        table += _against_heyoka(repeats, 20, 1.5, span, {"heyoka": 1}, 2.5)
        peers = {f"heyoka, batches of {batch}": batch, "heyoka in a loop": 1}
        table += _against_heyoka(repeats, 20, jnp.linspace(1.4, 1.6, 64), span, peers, 2.0)
    return table


def _against_heyoka(
    repeats: int, n: int, belt_speeds: Any, span: float, peers: dict[str, int], bar: float
) -> list[dict]:
    chain, excited, lanes = paper_chain(n, 1.5, width=None), max(1, n // 2), jnp.size(belt_speeds)
    error = 1e-4  # what jaxchain's usual rtol, 1e-6, leaves over this span; motions are regular
    tolerances = [10.0 ** (-k / 2) for k in range(6, 17)]
    batches: dict[str, int | None] = {"EventDriven": None}
    if lanes > 1:
        batches[f"EventDriven, batches of {BATCH}"] = BATCH
    programs = {
        name: runs(chain, excited, span, EventDriven(), lanes=lanes > 1, batch=batch)
        for name, batch in batches.items()
    }

    def own(rtol: float, program: Any) -> Any:
        return program(belt_speeds, rtol)[0]

    ours = {name: partial(own, program=each) for name, each in programs.items()}
    solvers = {name: heyoka(chain, belt_speeds, excited, span, k) for name, k in peers.items()}
    reference = next(iter(ours.values()))(1e-12)
    second = error_of(next(iter(solvers.values()))(1e-15), reference)
    sides = dict(cheapest({k: peer}, reference, error, tolerances) for k, peer in solvers.items())
    sides |= [cheapest({k: each}, reference, error, tolerances) for k, each in ours.items()]
    times = in_turn(sides, repeats, clock=time.process_time) / (lanes * span)
    return lines(
        f"dry friction, heyoka, error <= 1e-4, N = {n}, {excited} excited, a lane of {lanes}, "
        f"core time of a time unit; two references differ by {second:.0e}",
        times,
        list(sides)[-1],
        {next(iter(sides)): (">=", bar)},
    )


def dry_row(repeats: int, quick: bool) -> list[dict]:
    """Smoothed friction against true dry friction, both by jaxchain, 64 lanes."""
    lanes, span = (2, 20.0) if quick else (64, 1000.0)
    smoothed, belt_speeds = paper_chain(N, 1.5, 1e-3), jnp.linspace(1.4, 1.6, lanes)
    observe = Amplitude(window=0.1 * span)
    by_steps = runs(smoothed, 10, span, Rodas4(sweeps=1), observe=observe)
    by_events = runs(smoothed.with_(width=None), 10, span, EventDriven(), observe=observe)
    # The loosest tolerance that is right at this width, and one that errs a thousand times less.
    sides = {
        "smoothed, width 1e-3, rtol 1e-4": lambda: by_steps(belt_speeds, 1e-4),
        "event-driven, rtol 1e-6": lambda: by_events(belt_speeds, 1e-6),
    }
    first, second = (side()[1] for side in sides.values())
    apart = jnp.max(jnp.abs(first - second), axis=-1)
    times = in_turn(sides, repeats) / lanes
    return lines(
        f"dry or smoothed, N = {N}, tau {span:g}, a lane of {lanes}; amplitudes differ by "
        f"{jnp.median(apart):.1e} (median lane), {apart.max():.1e} (worst)",
        times,
        list(sides)[1],
        {next(iter(sides)): (">=", 1.0)},
    )
