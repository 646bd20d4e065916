"""The approaches that the study of work and precision compares: each a function of width and rtol.

An approach integrates a ring for one belt speed or for several and returns the end states, shape
(2, lanes, n): displacements and velocities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.model.chain import Chain
from jaxchain.model.initial_states import equation_8
from jaxchain.simulation.accuracy import Numerics, fit_linear_solve
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.solvers.rosenbrock import Rodas4, Rodas5P
from jaxchain.studies.work_precision.peers import CompiledRing, cvode, lsoda, radau

EVENTS = "event-driven"
OWN = {"Rodas4": Rodas4(), "Rodas5P": Rodas5P()}
STOCK = ("Tsit5", "Dopri8", "Kvaerno3", "Kvaerno5", "KenCarp4")
COMPILED = {"LSODA": lsoda, "Radau": radau, "CVODE": cvode}  # one lane after the other
# Orders of the series of the event-driven solver, down to a tolerance.
_ORDERS = ((1e-7, 9), (0.0, 15))

# (width, rtol) -> end states.
Solve: TypeAlias = Callable[[float, float], np.ndarray]


@dataclass(frozen=True)
class Problem:
    """A ring, eq. (8) with some masses excited, for belt speeds of shape (lanes,)."""

    chain: Chain
    excited: int
    belt_speeds: tuple[float, ...]
    duration: float

    @property
    def lanes(self) -> int:
        """How many runs it is, one for each belt speed."""
        return len(self.belt_speeds)

    def own(self, belt_speed: Any, **changes: Any) -> tuple[Chain, Any]:
        """The chain of one lane and its initial state."""
        chain = self.chain.with_(belt_speed=belt_speed, **changes)
        return chain, equation_8(chain, self.excited)


def prepare(name: str, problem: Problem) -> Solve:
    """The approach, ready to run.

    **Raises:** `PeerMissingError` if what it needs is not installed.
    """
    if name in COMPILED:
        return _one_by_one(COMPILED[name], problem)
    if name == EVENTS:
        programs = [(least, _own(problem, EventDriven(order))) for least, order in _ORDERS]
        return lambda width, rtol: next(p for least, p in programs if rtol >= least)(width, rtol)
    if name in OWN:
        # The sweeps that the tightest tolerance needs cost the loosest next to nothing.
        return _own(problem, fit_linear_solve(OWN[name], problem.chain, 1e-9))
    return _stock(problem, getattr(dfx, name)())


def truth(problem: Problem) -> np.ndarray:
    """The end states with true dry friction, to some 1e-12."""
    return _own(problem, EventDriven(18))(1e-3, 1e-13)


def by_accuracy(problem: Problem) -> Callable[[float], tuple[np.ndarray, Numerics]]:
    """`simulate(..., accuracy=...)`: the end states, and what it picked for each lane."""

    def one(belt_speed: Any, accuracy: Any) -> Any:
        chain, initial = problem.own(belt_speed)
        run = simulate(chain, initial, problem.duration, accuracy=accuracy, throw=False)
        return run.state, run.numerics

    program = _over_lanes(one, problem)

    def solve(accuracy: float) -> tuple[np.ndarray, Numerics]:
        state, numerics = program(accuracy)
        return np.stack(state), numerics

    return solve


def _over_lanes(one: Callable[..., Any], problem: Problem) -> Callable[..., Any]:
    speeds = jnp.asarray(problem.belt_speeds)
    program = jax.jit(lambda *numbers: jax.vmap(lambda speed: one(speed, *numbers))(speeds))
    return lambda *numbers: jax.block_until_ready(program(*numbers))


def _own(problem: Problem, solver: Any) -> Solve:
    """Through `simulate`."""

    def one(belt_speed: Any, width: Any, rtol: Any) -> Any:
        chain, initial = problem.own(belt_speed, width=width)
        return simulate(
            chain, initial, problem.duration, solver=solver, rtol=rtol, throw=False
        ).state

    program = _over_lanes(one, problem)
    return lambda width, rtol: np.stack(program(width, rtol))


def stock_terms(solver: dfx.AbstractSolver) -> Any:
    """The equations as diffrax takes them, with the chain as its argument."""

    def linear(t: Any, y: Any, chain: Chain) -> Any:
        x, v = y
        return v, chain.restoring_force(x)

    def friction(t: Any, y: Any, chain: Chain) -> Any:
        x, v = y
        return jnp.zeros_like(x), chain.local_force(t, x, v)

    if isinstance(solver, dfx.KenCarp4):  # implicit for the stiff friction, explicit for the rest
        return dfx.MultiTerm(dfx.ODETerm(linear), dfx.ODETerm(friction))
    return dfx.ODETerm(lambda t, y, chain: chain(t, y))


def _stock(problem: Problem, solver: dfx.AbstractSolver) -> Solve:
    """By diffrax alone, as one would without this package."""

    terms = stock_terms(solver)

    def one(belt_speed: Any, width: Any, rtol: Any) -> Any:
        chain, initial = problem.own(belt_speed, width=width)
        solution: Any = dfx.diffeqsolve(
            terms, solver, 0.0, problem.duration, None, initial, chain,
            stepsize_controller=dfx.PIDController(rtol=rtol, atol=0.1 * rtol),
            adjoint=dfx.ForwardMode(), max_steps=None, throw=False,
        )  # fmt: skip
        return jax.tree.map(lambda y: y[0], solution.ys)

    program = _over_lanes(one, problem)
    return lambda width, rtol: np.stack(program(width, rtol))


def _one_by_one(peer: Callable[..., Any], problem: Problem) -> Solve:
    ring = CompiledRing(problem.chain.n)

    @cache
    def runs(width: float) -> list[Callable[[float], np.ndarray]]:
        return [
            peer(ring, *problem.own(speed, width=width), problem.duration)
            for speed in problem.belt_speeds
        ]

    runs(1e-3)  # complains at once if something is missing
    return lambda width, rtol: np.stack([run(rtol) for run in runs(width)], axis=1)
