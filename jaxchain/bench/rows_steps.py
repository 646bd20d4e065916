"""Rows about what a step is made of, and what an import costs."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxchain.bench.compiled_step import compiled_steps
from jaxchain.bench.peers import PeerMissingError
from jaxchain.bench.rows_solvers import BELT_SPEED, EXCITED, SPAN, WIDTH, N
from jaxchain.bench.timing import Bar, Row, Sample, compiled, in_turn, show_seconds
from jaxchain.model.chain import paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.model.oscillators import AbstractOscillators
from jaxchain.simulation.accuracy import choose_solver
from jaxchain.simulation.run import simulate

_STEP = 0.02
# What an import costs an interpreter that has imported jax and diffrax.
_IMPORT = """
import time, diffrax, jax
start = time.perf_counter()
{}
print(time.perf_counter() - start)
"""


def import_row(repeats: int) -> list[Row]:
    """What stands before the first result: imports, and the command that needs no JAX."""

    def seconds(code: str) -> float:
        return float(_run("-c", _IMPORT.format(code)).split()[-1])

    def whole(argument: str) -> float:
        start = time.perf_counter()
        _run("-m", "jaxchain", argument)
        return time.perf_counter() - start

    def sample(measure: Callable[[str], float], what: str) -> Sample:
        measure(what)  # the first one may have to compile the package's files
        return Sample(tuple(measure(what) for _ in range(repeats)))

    door, one = (sample(seconds, c) for c in ("import jaxchain", "from jaxchain import simulate"))
    usage, scenes = (sample(whole, argument) for argument in ("--help", "scenes"))
    return [
        Row(
            "import",
            "import jaxchain beyond jax and diffrax",
            {"import jaxchain": door, "from jaxchain import simulate": one},
            door,
            unit="s",
            bar=Bar("at most", 0.05),
        ),
        Row(
            "import",
            "the command without JAX: jaxchain --help, jaxchain scenes",
            {"jaxchain --help": usage, "jaxchain scenes": scenes},
            max(usage, scenes, key=lambda found: found.median),
            unit="s",
            bar=Bar("at most", 0.3),
        ),
    ]


def _run(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise PeerMissingError(f"failed: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout


def plain_steps(solver: Any) -> Callable[..., Any]:
    """(field, state, h, count) -> `count` steps of length h and nothing around them."""

    def run(field: AbstractOscillators, state: Any, h: Any, count: Any) -> Any:
        term: Any = dfx.ODETerm(field)  # pyright: ignore[reportArgumentType]

        def body(_: Any, carry: Any) -> Any:
            y, worst = carry
            y, error, _, _, _ = solver.step(term, 0.0, h, y, None, None, False)
            # The error estimate is part of a step; unused it would be compiled away.
            return y, worst + error[0] ** 2 + error[1] ** 2

        return lax.fori_loop(0, count, body, (state, jnp.zeros_like(state[0])))

    return run


def friction_alone(stages: int) -> Callable[..., Any]:
    """(field, state, h, count) -> all friction that `count` steps evaluate, and nothing else."""

    def run(field: AbstractOscillators, state: Any, h: Any, count: Any) -> Any:
        x, v = state

        def body(_: Any, v: Any) -> Any:
            return v + h * field.local_force(0.0, x, v)

        return lax.fori_loop(0, count * stages, body, v)

    return run


def _shares(seconds: Mapping[str, float]) -> str:
    """What the parts of a step cost, in per cent of a step of `simulate`."""
    total, step = seconds["simulate"], seconds["step alone"]
    force = seconds["friction alone"]
    springs = step - seconds["step without springs"]
    parts = {
        "friction": force,
        "springs and linear solve": springs,
        "sums of stages": step - springs - force,
        "controller, error norm, loop": total - step,
    }
    return ", ".join(f"{name} {100 * part / total:.0f} %" for name, part in parts.items())


def profile_row(repeats: int) -> list[Row]:
    """Shares of a step, found by leaving parts out, and the same arithmetic in C."""
    return [_profile(repeats, 1), _profile(repeats, 64)]


def _profile(repeats: int, lanes: int) -> Row:
    belt_speeds = jnp.linspace(BELT_SPEED, BELT_SPEED + 0.1, lanes)
    chain = paper_chain(N, BELT_SPEED, WIDTH)
    solver = choose_solver(chain, 1e-6)
    assert solver.sweeps is not None, "the paper's coupling is weak"
    many = eqx.filter_vmap(lambda speed: chain.with_(belt_speed=speed))(belt_speeds)
    states = jax.vmap(lambda c: equation_8(c, EXCITED))(many)

    def batched(function: Callable, field: Any, *arguments: Any) -> tuple[Callable, float]:
        if lanes > 1:
            axes = (0, 0, *(None for _ in arguments))
            return compiled(jax.vmap(function, in_axes=axes), field, states, *arguments)
        field, state = jax.tree.map(lambda leaf: leaf[0], (field, states))
        program, seconds = compiled(function, field, state, *arguments)
        return lambda _, __, *rest: program(field, state, *rest), seconds

    def adaptive(field: Any, state: Any) -> Any:
        run = simulate(field, state, SPAN, solver=solver, rtol=1e-6, throw=False)
        return run.steps + run.rejected

    count = max(50, 4000 // lanes)
    whole, seconds = batched(adaptive, many)
    # All lanes go on until the slowest ends.
    taken = int(np.max(whole(many, states)))
    uncoupled = eqx.filter_vmap(lambda speed: chain.with_(belt_speed=speed, coupling=None))
    alone, friction = plain_steps(solver), friction_alone(len(solver.tableau.c))
    parts = {
        "step alone": (alone, many),
        "step without springs": (alone, uncoupled(belt_speeds)),
        "friction alone": (friction, many),
    }
    sides: dict[str, Callable[[], object]] = {"simulate": lambda: whole(many, states)}
    counts = {"simulate": taken}
    for name, (function, field) in parts.items():
        program, _ = batched(function, field, _STEP, count)
        sides[name] = lambda p=program, f=field: p(f, states, _STEP, count)
        counts[name] = count
    note = ""
    try:
        chains = [chain.with_(belt_speed=speed) for speed in belt_speeds.tolist()]
        for name, fast in (("the step in C", False), ("the step in C, -ffast-math", True)):
            loop = compiled_steps(chains, solver.tableau, solver.sweeps, fast)
            sides[name] = lambda loop=loop: loop(count, _STEP, *states)
            counts[name] = count
    except PeerMissingError as missing:
        note = f"C: {missing}\n"
    times = {
        name: sample.per(counts[name] * lanes) for name, sample in in_turn(sides, repeats).items()
    }
    note += _shares({name: sample.median for name, sample in times.items()})
    if "the step in C" in times:
        of_oscillator = show_seconds(times["the step in C"].median / N)
        note += f"\nC: -O3 -march=native, {of_oscillator} an oscillator and step"
    return Row(
        "profile",
        f"step alone / the step in C, a lane of {lanes}",
        times,
        times["step alone"].over(times["the step in C"]) if "the step in C" in times else None,
        note=note + f"\ncompiled in {seconds:.1f} s",
    )
