"""What a step is made of and how far it is from C, long chains, and what an import costs."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax import lax
from step_in_c import CompiledMethod
from timing import compiled, in_turn, lines, runs

from jaxchain import Rodas4, equation_8, paper_chain

N, EXCITED, BELT_SPEED, WIDTH = 20, 9, 1.3, 1e-4


def size_row(repeats: int, quick: bool) -> list[dict]:
    """Cost of one oscillator and step, from short chains to long ones."""
    sizes, work, h = (200, 2000), 20_000, 0.01
    if not quick:
        sizes, work = (200, 2000, 20_000, 200_000), 4_000_000  # oscillators x steps
    sides: dict[str, Callable[[], Any]] = {}
    for n in sizes:
        chain = paper_chain(n, BELT_SPEED, 1e-3)

        def solve(chain: Any, initial: Any, t1: Any) -> Any:
            return dfx.diffeqsolve(
                dfx.ODETerm(chain),
                Rodas4(sweeps=1),
                t0=0.0,
                t1=t1,
                dt0=h,
                y0=initial,
                stepsize_controller=dfx.ConstantStepSize(),
                adjoint=dfx.ForwardMode(),
                max_steps=None,
                throw=False,
            ).ys

        arguments = chain, equation_8(chain, n // 3), h * (work // n)
        sides[f"N = {n}"] = partial(compiled(solve), *arguments)
    first, last = f"N = {sizes[0]}", f"N = {sizes[-1]}"
    case = "Rodas4 with constant steps, one oscillator and step"
    return lines(case, in_turn(sides, repeats) / work, first, {last: ("<=", 1.5)})


def plain_steps(solver: Any) -> Callable[..., Any]:
    """(chain, state, h, count) -> the state after `count` steps with nothing around them."""

    def run(chain: Any, state: Any, h: Any, count: Any) -> Any:
        term: Any = dfx.ODETerm(chain)

        def body(_: Any, carry: Any) -> Any:
            y, worst = carry
            y, error, _, _, _ = solver.step(term, 0.0, h, y, None, None, False)
            # The error estimate is part of a step; unused it would be compiled away.
            return y, worst + error[0] ** 2 + error[1] ** 2

        return lax.fori_loop(0, count, body, (state, jnp.zeros_like(state[0])))

    return run


def friction_alone(stages: int) -> Callable[..., Any]:
    """(chain, state, h, count) -> all friction that `count` steps evaluate, and nothing else."""

    def run(chain: Any, state: Any, h: Any, count: Any) -> Any:
        x, v = state
        body = lambda _, v: v + h * chain.local_force(0.0, x, v)
        return lax.fori_loop(0, count * stages, body, v)

    return run


def profile_row(repeats: int, quick: bool) -> list[dict]:
    """Shares of a step, found by leaving parts out, and the same arithmetic in C."""
    return _profile(repeats, 1, quick) + ([] if quick else _profile(repeats, 64, quick))


def _profile(repeats: int, lanes: int, quick: bool) -> list[dict]:
    chain, solver, h = paper_chain(N, BELT_SPEED, WIDTH), Rodas4(sweeps=1), 0.02
    speeds = jnp.linspace(BELT_SPEED, BELT_SPEED + 0.1, lanes)
    span, count = 3.0 if quick else 30.0, 100 if quick else max(50, 4000 // lanes)
    states = jax.vmap(lambda speed: equation_8(chain.with_(belt_speed=speed), EXCITED))(speeds)

    def batched(function: Any, chain: Any = chain) -> Callable[[int], Any]:
        def run(speed: Any, state: Any, steps: Any) -> Any:
            return function(chain.with_(belt_speed=speed), state, h, steps)

        if lanes == 1:
            program, state = compiled(run), jax.tree.map(lambda part: part[0], states)
            return lambda steps: program(speeds[0], state, steps)
        program = compiled(jax.vmap(run, in_axes=(0, 0, None)))
        return lambda steps: program(speeds, states, steps)

    alone = plain_steps(solver)
    parts = {
        "step alone": batched(alone),
        "step without springs": batched(alone, chain.with_(coupling=None)),
        "friction alone": batched(friction_alone(len(solver.tableau.c))),
    }
    chains = [chain.with_(belt_speed=speed) for speed in speeds.tolist()]
    for name, flags in (("step in C", ()), ("step in C, -ffast-math", ("-ffast-math",))):
        in_c = CompiledMethod(chains, solver, *flags)
        parts[name] = lambda steps, in_c=in_c: in_c.steps(steps, h, *states)
        expected = np.reshape(jax.tree.leaves(parts["step alone"](50)[0]), (2, lanes, N))
        np.testing.assert_allclose(parts[name](50), expected, atol=1e-8)
    program = runs(chain, EXCITED, span, solver, lanes=lanes > 1)
    whole = partial(program, speeds if lanes > 1 else speeds[0], 1e-6)
    sides = {"simulate": whole} | {name: partial(part, count) for name, part in parts.items()}
    # All lanes of `simulate` go on until the slowest ends.
    steps = pd.Series(count, index=list(sides))
    steps["simulate"] = int(np.max(whole()[2]))
    times = in_turn(sides, repeats) / (steps * lanes)
    return lines(f"parts of a step, N = {N}, a lane of {lanes}", times, "step alone")


def import_row(repeats: int, quick: bool) -> list[dict]:
    """What comes before the first result: imports beyond jax and diffrax, and the command."""
    timed = "import time, diffrax, jax; start = time.perf_counter(); {}; "
    timed += "print(time.perf_counter() - start)"

    def run(*arguments: str) -> str:
        command = [sys.executable, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    def inside(code: str) -> float:
        return float(run("-c", timed.format(code)).split()[-1])

    def whole(argument: str) -> float:
        start = time.perf_counter()
        run("-m", "jaxchain", argument)
        return time.perf_counter() - start

    def measured(measure: Callable[[str], float], *arguments: str) -> pd.DataFrame:
        rounds = [{name: measure(name) for name in arguments} for _ in range(repeats + 1)]
        return pd.DataFrame(rounds[1:])  # the first one may have to compile the package's files

    imports = measured(inside, "import jaxchain", "from jaxchain import simulate")
    table = lines("beyond jax and diffrax", imports, None, {"import jaxchain": ("<=", 0.05)})
    commands = measured(whole, "--help", "scenes").add_prefix("jaxchain ")
    return table + lines("without JAX", commands, None, dict.fromkeys(commands, ("<=", 0.3)))
