"""Limit cycles from guesses of every kind, stable or not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._checks import (
    check_flag,
    check_one_of,
    is_traced,
    shown,
    to_float,
)
from .._types import State
from ..continuation.damped_newton import check_tolerance
from ..model.arguments import as_chain, as_images, as_mass
from ..model.chain import Chain
from ..model.initial_states import reference_site
from ..model.oscillators import AbstractOscillators
from ..model.sliding import damping_outweighs
from ..result import SearchResult
from ..simulation.accuracy import MAX_STEP, check_tolerances, fit_linear_solve
from ..simulation.run import Simulation
from ..solvers.rosenbrock import Rodas5P
from .closing import dry_limit_cycle
from .floquet import CYCLE_RTOL, check_orbit
from .guesses import (
    TRANSIENT,
    carried,
    guess_from_point,
    guess_from_simulation,
    guess_of_kind,
    most_lively,
)
from .limit_cycle import LimitCycle, solve_cycle, with_derivatives
from .reach import is_of_kind, reach_cycle
from .shooting import Shooting, packed


def find_limit_cycle(
    chain: Any,
    guess: Any = None,
    *,
    period: Any = None,
    vibrating: Any = None,
    branch: Any = "stable",
    images: Any = None,
    rtol: Any = CYCLE_RTOL,
    tolerance: Any = 1e-9,
    max_steps: Any = 30,
    throw: bool = True,
) -> LimitCycle:
    """The limit cycle near a guess, stable or not, by Newton's method at fixed belt speed.

    With smoothed friction unknowns and equations are those of `cycles/shooting.py`, the steps are
    damped by Deuflhard's natural monotonicity test, and one linearised integration gives each
    Jacobian and, in the end, the monodromy matrix.  With dry friction it is `close_orbit`, from
    event to event; the orbit is cut where the mass that vibrates is let go by the belt, or is
    fastest if it never sticks; `images` and `max_steps` have no part in it, and without a guess no
    belt speed is tried but the one asked for.

    **Arguments:**

    - `chain`: a `Chain`, or with a guess any autonomous `AbstractOscillators`.
    - `guess`: None, the vibration of one mass in which it sticks and slips (on which a simulation
      settles), or the unstable one in which it slides throughout (`branch` = "unstable"), reached
      from another belt speed if it is not found at once; a state (x, v), from which a
      simulation starts, or with `period` a point near the orbit; a pair (state, period); a
      `Simulation` (its last state); a `LimitCycle` of another chain.
    - `vibrating`: index of the mass at whose greatest velocity the orbit is cut, by default n // 2
      without a guess and else the one farthest from sliding.  Must be given under `jit`.
    - `images`: for an orbit with a symmetry, entry i is the index of the mass that i does the same
      as, see `continue_cycle`.
    - `rtol`: of the integration; `tolerance`: of the residual; `max_steps`: integrations allowed.
    - `throw`: raise an error where no cycle is found; otherwise its `result` tells.

    **Returns:** a `LimitCycle`, of the least period: an orbit gone round up to 16 times is told by
    its state after shares of the period, and solved for again.  Its state, period, amplitude and
    energy have derivatives in every number of the chain, forward and in reverse (the rest of it is
    constant); it works under `vmap` and `jit`, `throw` without effect; without a guess nothing is
    tried there but the belt speed asked for.

    **Raises:** `ValueError` for bad input; `RuntimeError`, with advice, if no cycle is found.
    Rest is never taken for a cycle.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle, paper_chain
        >>> cycle = find_limit_cycle(paper_chain(1, width=0.05))
        >>> cycle.stable, round(float(cycle.period), 6)
        (True, 6.297326)
        >>> slipping = find_limit_cycle(paper_chain(1, width=0.05), branch="unstable")
        >>> slipping.stable, bool(slipping.closeness[0] < 0)
        (False, True)
    """
    _check(chain, rtol)
    check_flag("throw", throw)
    if isinstance(chain, Chain):
        as_images(images, chain.n)
    limit = check_tolerance(tolerance, max_steps)
    frozen = lax.stop_gradient(chain)
    mass, state, period = resolve_guess(frozen, guess, period, vibrating, branch, throw)
    n = state[0].shape[0]
    if isinstance(chain, Chain) and chain.dry:
        as_images(images, n, mass)
        cycle = dry_limit_cycle(chain, mass, state, period, rtol=rtol, tolerance=tolerance)
        cycle = _keep_kind(cycle, branch) if guess is None else cycle
        if throw and not is_traced(cycle.successful) and not cycle.successful:
            raise RuntimeError(_failure(cycle) if guess is not None else _missing(frozen, branch))
        return cycle
    shooting = Shooting(
        field=frozen, rtol=rtol, mass=mass, images=as_images(images, n, mass),
        solver=fit_linear_solve(Rodas5P(), frozen, 1e-9 if is_traced(rtol) else float(rtol)),
    )  # fmt: skip
    numbers = to_float(tolerance), jnp.asarray(np.asarray(limit, dtype=int))
    start = packed(shooting, lax.stop_gradient(state), lax.stop_gradient(period))
    cycle, u = solve_cycle(shooting, start, *numbers)
    reason = ""
    if guess is None:
        cycle = _keep_kind(cycle, branch)
        if not is_traced(cycle.successful) and not cycle.successful:
            found, reason = reach_cycle(shooting, branch, *numbers)
            if found is not None:
                cycle, u = solve_cycle(shooting, packed(shooting, *found), *numbers)
    if throw and not is_traced(cycle.successful) and not cycle.successful:
        missing = _failure(cycle) if guess is not None else _missing(frozen, branch, reason)
        raise RuntimeError(missing)
    return with_derivatives(shooting, chain, cycle, u)


@eqx.filter_jit
def _keep_kind(cycle: LimitCycle, kind: str) -> LimitCycle:
    """Not `successful` unless it is of the kind that was asked for."""
    wrong = cycle.successful & ~is_of_kind(cycle, kind)
    result = SearchResult.where(wrong, SearchResult.other_kind, cycle.result)
    return replace(cycle, result=result)


def resolve_guess(
    chain: AbstractOscillators, guess: Any, period: Any, vibrating: Any, branch: Any, throw: bool
) -> tuple[int, State, Array]:
    """(mass, state on the section, period) of whatever was given."""
    check_one_of("branch", branch, ("stable", "unstable"))
    if guess is None:
        if not isinstance(chain, Chain):
            raise ValueError(
                "Argument `guess` is None, which is for a `Chain`: give a state and a period."
            )
        if period is not None:
            raise ValueError(
                f"Argument `period` is {shown(period)}, but there is no `guess`, whose period it "
                "would be: give the state, too."
            )
        mass = as_mass(chain.n, vibrating, reference_site(chain.n))
        state, period = guess_of_kind(chain, mass, branch)
        return mass, state, period
    if isinstance(guess, LimitCycle):
        check_orbit(chain, guess.state, guess.period, CYCLE_RTOL)
        mass = as_mass(guess.state[0].shape[0], vibrating, guess.mass)
        return mass, *_sound(carried(guess.state, guess.chain, chain), guess.period, throw)
    transient = TRANSIENT
    if isinstance(guess, Simulation):
        guess, transient = guess.state, 0.0
    pair = isinstance(guess, tuple | list) and len(guess) == 2
    if pair and isinstance(guess[0], tuple | list):
        guess, period = guess
    state = check_orbit(chain, guess, 1.0 if period is None else period, CYCLE_RTOL, "guess")
    n = state[0].shape[0]
    mass = as_mass(n, vibrating)
    if mass is None:
        mass = most_lively(chain, state)
    if period is None:
        state, period = guess_from_simulation(chain, state, mass, transient=transient)
    else:
        state = guess_from_point(chain, state, period, mass)
    return mass, *_sound(state, to_float(period), throw)


def _sound(state: State, period: Any, throw: bool) -> tuple[State, Any]:
    known = is_traced(state, period) or bool(jnp.isfinite(jnp.sum(state[1]) + period))
    if throw and not known:
        raise RuntimeError(
            "No vibration was found to start from: the state that was given comes to rest. See "
            "`fold_belt_speed` for the greatest belt speed of vibration, or give another `guess`."
        )
    return state, period


def _missing(chain: Any, kind: str, reason: str = "") -> str:
    if damping_outweighs(chain):
        return (
            "There is no limit cycle: damping outweighs the weakening of friction at every speed, "
            "2 xi_n > p_n F'(w), so all motions approach steady sliding."
        )
    wanted = "stick-slip cycle" if kind == "stable" else "slip cycle"
    where = reason or "neither at this belt speed nor at others, to follow it from"
    return (
        f"No {wanted} in which one mass vibrates was found: {where}. Other vibrations may exist. "
        "Offer a run that ends in one as `guess`: `find_limit_cycle(chain, simulate(chain, start, "
        "400.0))`. See `fold_belt_speed` for the greatest belt speed of this vibration and "
        "`hopf_belt_speed` for the least of the slip cycle."
    )


def _failure(cycle: LimitCycle) -> str:
    if cycle.result == SearchResult.ran_away:
        return f"No limit cycle was found near the guess. {cycle.message}"
    return (
        f"No limit cycle was found near the guess: the residual is {float(cycle.residual):.1e} "
        f"after {int(cycle.evaluations)} integrations, the greatest velocity "
        f"{float(cycle.fastest[cycle.mass]):.1e}. Start closer (a longer simulation, a "
        "`LimitCycle` at a belt speed nearby), or loosen `tolerance`. A branch of cycles may have "
        "turned at a fold."
    )


def _check(chain: Any, rtol: Any) -> None:
    as_chain(chain, AbstractOscillators)
    check_tolerances(rtol, None, MAX_STEP)
