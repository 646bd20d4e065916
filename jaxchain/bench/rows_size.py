"""The row about long chains: what an oscillator and a step cost, whatever the number of masses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx

from jaxchain.bench.rows_solvers import BELT_SPEED
from jaxchain.bench.timing import Bar, Row, Sample, compiled, in_turn
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.simulation.accuracy import choose_solver


def size_row(repeats: int, sizes: Sequence[int] = (200, 2000, 20_000, 200_000)) -> list[Row]:
    """Cost of one oscillator and step, from short chains to long ones."""
    h, work = 0.01, 4_000_000  # oscillators x steps
    sides: dict[str, Callable[[], object]] = {}
    compile_seconds = []
    for n in sizes:
        chain = paper_chain(n, BELT_SPEED, 1e-3)
        initial = equation_8(chain, n // 3)
        solver = choose_solver(chain, 1e-6)

        def solve(chain: Chain, initial: Any, t1: Any, solver: Any = solver) -> Any:
            return dfx.diffeqsolve(
                dfx.ODETerm(chain), solver, 0.0, t1, h, initial,  # pyright: ignore
                stepsize_controller=dfx.ConstantStepSize(), adjoint=dfx.ForwardMode(),
                max_steps=None, throw=False,
            ).ys  # fmt: skip

        t1 = h * max(1, work // n)
        program, seconds = compiled(solve, chain, initial, t1)
        compile_seconds.append(seconds)
        sides[f"N = {n}"] = lambda p=program, c=chain, y=initial, t=t1: p(c, y, t)
    times = in_turn(sides, repeats)
    costs = {
        f"N = {n}, one oscillator and step": times[f"N = {n}"].per(n * max(1, work // n))
        for n in sizes
    }
    samples: list[Sample] = list(costs.values())
    return [
        Row(
            "size",
            f"cost at N = {sizes[-1]} / N = {sizes[0]}",
            costs,
            samples[-1].over(samples[0]),
            bar=Bar("at most", 1.5),
            note="Rodas4, constant steps, a third of the masses excited; compiled in "
            + ", ".join(f"{s:.1f}" for s in compile_seconds)
            + " s",
        )
    ]
