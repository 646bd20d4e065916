"""Rows about one integration: against stock diffrax, LSODA and CVODE."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.bench.equal_error import FINE, TOLERANCES, Setting, cheapest, scan
from jaxchain.bench.peers import CompiledRing, PeerMissingError, cvode, lsoda
from jaxchain.bench.timing import Row, comparison, compiled, in_turn
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.simulation.accuracy import choose_solver
from jaxchain.simulation.run import simulate
from jaxchain.solvers.rosenbrock import Rodas5P
from jaxchain.solvers.step_control import SwitchingController

N, EXCITED, BELT_SPEED, WIDTH, SPAN = 20, 9, 1.3, 1e-4, 30.0
# A setting this many times slower than the best one is not worth its measurement.
_HOPELESS = 5.0


def problem(belt_speed: float = BELT_SPEED) -> tuple[Chain, Any]:
    """The chain of twenty of the paper with nine excited, at a width where it is stiff."""
    chain = paper_chain(N, belt_speed, WIDTH)
    return chain, equation_8(chain, EXCITED)


def structured(chain: Chain, solver: Any) -> Callable[[Any, Any], Any]:
    """The state (x, v) at the end as a function of (belt speed, rtol)."""

    def solve(belt_speed: Any, rtol: Any) -> Any:
        own = chain.with_(belt_speed=belt_speed)
        initial = equation_8(own, EXCITED)
        return simulate(own, initial, SPAN, solver=solver, rtol=rtol, throw=False).state

    return solve


def stock_terms(solver: dfx.AbstractSolver) -> Any:
    """The equations as diffrax takes them, with the chain as its argument."""

    def field(t: Any, y: Any, chain: Chain) -> Any:
        return chain(t, y)

    def linear(t: Any, y: Any, chain: Chain) -> Any:
        x, v = y
        return v, chain.restoring_force(x)

    def friction(t: Any, y: Any, chain: Chain) -> Any:
        x, v = y
        return jnp.zeros_like(x), chain.local_force(t, x, v)

    split = isinstance(solver, dfx.AbstractImplicitSolver) and isinstance(
        solver.term_structure, type(dfx.MultiTerm[tuple[dfx.AbstractTerm, dfx.AbstractTerm]])
    )
    if split:  # an IMEX method: the stiff friction implicitly, the rest explicitly
        return dfx.MultiTerm(dfx.ODETerm(linear), dfx.ODETerm(friction))
    return dfx.ODETerm(field)


def stock(solver: dfx.AbstractSolver, *, switching: bool = False) -> Callable[..., Any]:
    """The same by diffrax, also of the gains (p, i) of the step-size controller.

    By diffrax alone, or with `SwitchingController` around its controller.
    """

    terms = stock_terms(solver)

    def solve(chain: Chain, initial: Any, rtol: Any, gains: tuple[Any, Any]) -> Any:
        controller: Any = dfx.PIDController(
            rtol=rtol, atol=0.1 * rtol, pcoeff=gains[0], icoeff=gains[1]
        )
        if switching:
            controller = SwitchingController(controller, chain)
        solution: Any = dfx.diffeqsolve(
            terms, solver, 0.0, SPAN, None, initial, chain,
            stepsize_controller=controller, adjoint=dfx.ForwardMode(), max_steps=None, throw=False,
        )  # fmt: skip
        return jax.tree.map(lambda y: y[0], solution.ys)

    return solve


def _own_solvers(chain: Chain) -> list[Any]:
    """Both structured methods with the linear solve that `simulate` chooses for this chain."""
    return [choose_solver(chain, 1e-6), choose_solver(chain, 1e-9)]


def _own_settings(
    chain: Chain,
    belt_speeds: Any,
    reference: Any,
    bar: float,
    tolerances: Sequence[float] = TOLERANCES,
) -> list[Setting]:
    """Settings of the structured solvers, for one belt speed or, by vmap, for several."""
    settings = []
    for solver in _own_solvers(chain):
        solve = structured(chain, solver)
        if jnp.ndim(belt_speeds) == 1:
            solve = jax.vmap(solve, in_axes=(0, None))
        program, seconds = compiled(solve, belt_speeds, 1e-6)
        settings += scan(
            type(solver).__name__, lambda rtol, p=program: p(belt_speeds, rtol), reference, bar,
            compile_seconds=seconds, tolerances=tolerances,
        )  # fmt: skip
    return settings


def _reference(chain: Chain, belt_speeds: Any) -> Any:
    solve = structured(chain, Rodas5P())
    solve = jax.vmap(solve, in_axes=(0, None)) if jnp.ndim(belt_speeds) == 1 else solve
    program, _ = compiled(solve, belt_speeds, 1e-12)
    return program(belt_speeds, 1e-12)


def _stock_settings(reference: Any, bar: float, *, switching: bool) -> list[Setting]:
    """Settings of the stock diffrax solvers, with and without memory in the step-size control."""
    chain, initial = problem()
    settings: list[Setting] = []
    solvers = (dfx.Tsit5(), dfx.Dopri8(), dfx.Kvaerno3(), dfx.Kvaerno5(), dfx.KenCarp4())
    for solver in solvers:
        solve = stock(solver, switching=switching)
        program, seconds = compiled(solve, chain, initial, 1e-6, (0.0, 1.0))
        for gains, name in (((0.0, 1.0), "I"), ((0.4, 0.3), "PI")):
            best = min((s.seconds for s in settings), default=np.inf)
            control = f"{name} and switching control" if switching else f"{name} control"
            settings += scan(
                f"{type(solver).__name__} ({control})",
                lambda rtol, p=program, g=gains: p(chain, initial, rtol, g), reference, bar,
                give_up=_HOPELESS * best, compile_seconds=seconds,
            )  # fmt: skip
    return settings


def stock_row(repeats: int) -> list[Row]:
    """Against the fastest stock diffrax solver at equal error: as it is, and with our control."""
    bar = 1e-4
    chain, _ = problem()
    reference = _reference(chain, chain.belt_speed)
    own = cheapest(_own_settings(chain, chain.belt_speed, reference, bar))
    plain = cheapest(_stock_settings(reference, bar, switching=False))
    helped = cheapest(_stock_settings(reference, bar, switching=True))
    times = in_turn({"plain": plain.run, "helped": helped.run, "jaxchain": own.run}, repeats)
    title = "fastest stock diffrax solver"
    return [
        comparison(
            "stock", name + " / jaxchain, error <= 1e-4", times, (side, "jaxchain"),
            labels=(str(peer), str(own)), bar=least,
            note=f"compiled in {peer.compile_seconds:.1f} s (stock) and "
            f"{own.compile_seconds:.1f} s",
        )
        for side, peer, name, least in (
            ("plain", plain, title, 100.0),
            ("helped", helped, title + " with SwitchingController", None),
        )
    ]  # fmt: skip


def lsoda_row(repeats: int) -> list[Row]:
    """Against LSODA (and CVODE) with compiled right side and Jacobian, one lane and 64."""
    bar = 1e-6
    title = "LSODA / jaxchain, error <= 1e-6, "
    chain, initial = problem()
    try:
        ring = CompiledRing(N)
    except PeerMissingError as missing:
        return [Row("lsoda", title + "1 and 64 lanes", note=str(missing))]
    reference = _reference(chain, chain.belt_speed)
    peer = cheapest(
        scan("LSODA", lsoda(ring, chain, initial, SPAN), reference, bar, tolerances=FINE)
    )
    own = cheapest(_own_settings(chain, chain.belt_speed, reference, bar, FINE))
    sides = {"LSODA": peer.run, "jaxchain": own.run}
    note = f"compiled in {own.compile_seconds:.1f} s (jaxchain)"
    other = None
    try:
        other = cheapest(
            scan("CVODE", cvode(ring, chain, initial, SPAN), reference, bar, tolerances=FINE)
        )
        sides["CVODE"] = other.run
    except PeerMissingError as missing:
        note += f"\nCVODE: {missing}"
    times = in_turn(sides, repeats)
    rows = [
        comparison(
            "lsoda", title + "1 lane", times, ("LSODA", "jaxchain"),
            labels=(str(peer), str(own)), bar=5.0, note=note,
        )
    ]  # fmt: skip
    if other is not None:
        rows.append(
            comparison(
                "lsoda", "CVODE / jaxchain, error <= 1e-6, 1 lane", times, ("CVODE", "jaxchain"),
                labels=(str(other), str(own)),
            )
        )  # fmt: skip
    rows.append(_lsoda_lanes(ring, max(3, repeats // 2), bar, title))
    return rows


def _lsoda_lanes(ring: CompiledRing, repeats: int, bar: float, title: str, lanes: int = 64) -> Row:
    belt_speeds = jnp.linspace(1.2, 1.4, lanes)
    chain, _ = problem()
    reference = _reference(chain, belt_speeds)
    own = cheapest(_own_settings(chain, belt_speeds, reference, bar, FINE))
    runs = [lsoda(ring, *problem(speed), SPAN) for speed in belt_speeds.tolist()]

    def loop(rtol: float) -> np.ndarray:
        return np.stack([run(rtol) for run in runs], axis=1)

    # The scan starts where a single lane passes at the earliest.
    tight = [rtol for rtol in FINE if rtol < 1e-7]
    peer = cheapest(scan("LSODA in a loop", loop, reference, bar, tolerances=tight))
    times = in_turn({"LSODA": peer.run, "jaxchain": own.run}, repeats)
    return comparison(
        "lsoda", title + f"a lane of {lanes}", times, ("LSODA", "jaxchain"),
        labels=(str(peer), str(own) + ", vmap"), lanes=lanes, bar=15.0,
        note=f"compiled in {own.compile_seconds:.1f} s (jaxchain)",
    )  # fmt: skip
