"""Where to begin the search for a limit cycle.

Every guess is (state, period) with the state at the greatest velocity of the vibrating mass in the
direction of the belt, where `Shooting` cuts the orbit.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._checks import (
    check_nonnegative,
    check_number,
    check_positive_number,
    is_traced,
    to_float,
)
from .._types import State
from ..model.arguments import as_chain, as_mass, as_state
from ..model.chain import Chain, steady_sliding
from ..model.initial_states import reference_site, release_state
from ..model.oscillators import AbstractOscillators
from ..model.sliding import sliding_damping, stiffness_matrix
from ..observers.section import Section
from ..simulation.accuracy import choose_solver, own_solver
from ..simulation.run import Simulation, simulate
from .averaging import gain, one_mass

Guess = tuple[State, Array]
# For which a simulation runs before it is looked at.
TRANSIENT = 200.0
_PEAKS = 12
# Of the returns to the section, the first is taken that is nearly as good as the best.
_AS_GOOD, _GOOD = 2.0, 1e-3
_RATIOS = np.concatenate([np.geomspace(1e-3, 0.3, 24), np.linspace(0.32, 1.0, 35)])


def _watched(chain: Any, state: State, t1: Any, watch: Section) -> Simulation:
    """A run in which a sticking mass errs by little in units of the width, as Newton needs."""
    rtol: Any = 1e-8
    if isinstance(chain, Chain) and not chain.dry:
        width = lax.stop_gradient(chain.width)
        # Each operation of JAX on numbers is a program to be compiled.
        of, width = (jnp, width) if is_traced(width) else (np, np.asarray(width))
        rtol = of.clip(1e-4 * of.min(width), 1e-11, 1e-7)
    solver = own_solver(chain, None) or choose_solver(chain, 1e-8)
    return simulate(chain, state, t1, observe=watch, solver=solver, rtol=rtol, throw=False)


def most_lively(chain: AbstractOscillators, state: State) -> int:
    """The mass farthest from sliding, which is taken for the vibrating one; n // 2 if traced."""
    x, v = state
    if is_traced(chain, state):
        return reference_site(x.shape[0])
    rest = steady_sliding(chain)[0] if isinstance(chain, Chain) else jnp.zeros_like(x)
    return int(jnp.argmax((x - rest) ** 2 + v**2))


def guess_from_simulation(
    chain: AbstractOscillators,
    state: State,
    vibrating: int | None = None,
    *,
    transient: Any = 0.0,
    duration: Any = 40.0,
) -> Guess:
    """A point of the orbit on which `state` settles, and its period.

    Integrates for `transient`, then for `duration`, and looks at the states in which mass
    `vibrating` (by default the one farthest from sliding) is fastest in the direction of the belt:
    the period is the time since the one that is most like the last of them, as a whole.  Of an
    orbit that is not yet settled it may be a multiple; `find_limit_cycle` looks for the least.

    **Returns:** (state, period), NaN where the mass has not two such maxima: it rests, or moves
    too slowly for `duration`.  Works under `jit` and `vmap`, `vibrating` being given.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import excited_state, paper_chain
    >>> from jaxchain.cycles import guess_from_simulation
    >>> chain = paper_chain(1, width=0.05)
    >>> _, period = guess_from_simulation(chain, excited_state(chain, 1))
    >>> round(float(period), 2)
    6.3
    """
    as_chain(chain, AbstractOscillators)
    state = as_state(chain, state, "state")
    check_number("transient", transient, "200 is usual.")
    check_nonnegative("transient", transient, "200 is usual.")
    check_positive_number("duration", duration, "40 is some six periods.")
    mass = as_mass(state[0].shape[0], vibrating)
    mass = most_lively(chain, state) if mass is None else mass
    watch = Section(mass, _PEAKS, transient, of="velocity")
    run = _watched(chain, state, transient + duration, watch)
    return _last_turn(*lax.stop_gradient(run.observed))


@eqx.filter_jit
def _last_turn(times: Array, xs: Array, vs: Array) -> Guess:
    """The last state, and the time since the one that is most like it."""
    last = jnp.sum(jnp.isfinite(times)) - 1
    before = last - 1 - jnp.arange(_PEAKS - 1)  # one return ago, two, ...
    gaps = [jnp.linalg.norm(part[before] - part[last][None], axis=1) for part in (xs, vs)]
    distance = jnp.where(before >= 0, gaps[0] + gaps[1], jnp.inf)
    size = jnp.linalg.norm(vs[last])
    at = before[jnp.argmax(distance <= _AS_GOOD * jnp.min(distance) + _GOOD * size)]
    period = jnp.where(last >= 1, times[last] - times[at], jnp.nan)
    return (xs[last], vs[last]), period


def guess_from_point(
    chain: AbstractOscillators, state: State, period: Any, vibrating: int
) -> State:
    """The point of an orbit of known period at which mass `vibrating` is fastest along the belt.

    Nothing is integrated if `state` is such a point; NaN if there is none.
    """
    if not is_traced(chain, state):
        along = chain.belt_direction()
        acceleration, velocity = chain(0.0, state)[1][vibrating], along * state[1][vibrating]
        # A mass that sticks is accelerated by little, but by more than this.
        if velocity > 0 and abs(acceleration) < 1e-9 * velocity:
            return state
    # A little more, for an orbit that begins at the maximum.
    watch = Section(vibrating, _PEAKS, of="velocity")
    run = _watched(chain, state, 1.05 * to_float(period), watch)
    _, xs, vs = lax.stop_gradient(run.observed)
    speeds = chain.belt_direction() * vs[:, vibrating]
    fastest = jnp.argmax(jnp.where(jnp.isnan(speeds), -jnp.inf, speeds))
    return xs[fastest], vs[fastest]


def carried(state: State, before: AbstractOscillators, after: AbstractOscillators) -> State:
    """A state of the field `before`, for `after`: a mass that sticks goes with the belt.

    Where the belt runs the other way it is the mirror image.
    """
    turned = before.belt_direction() * after.belt_direction()
    x, v = (turned * part for part in state)
    old, new = before.switching(0.0, turned * v), after.switching(0.0, v)
    if old is None or new is None:
        return x, v
    sticks = jnp.abs(old[0]) <= 10.0 * old[1]
    wider = new[1] / jnp.where(old[1] > 0, old[1], 1.0)
    return x, jnp.where(sticks, v - new[0] + turned * old[0] * wider, v)


@eqx.filter_jit
def slip_guess(chain: Chain, vibrating: int) -> Guess:
    """The unstable cycle of a mass that slides throughout, to first harmonic; NaN for none.

    Its amplitude A < v_d is where averaged friction begins to feed more than damping takes (see
    `cycles/averaging.py`); the other masses move as its springs shake them, linearised about
    sliding: (K - omega^2 + i omega D) u = 0 in their rows.
    """
    alone, speed = one_mass(chain, vibrating), jnp.abs(chain.belt_speed)
    ratios = jnp.asarray(_RATIOS)
    values = lax.map(lambda ratio: gain(alone, ratio, speed), ratios)
    rises = (values[:-1] <= 0) & (values[1:] > 0)
    at = jnp.argmax(rises)
    share = -values[at] / (values[at + 1] - values[at])
    ratio = ratios[at] + share * (ratios[at + 1] - ratios[at])
    amplitude = jnp.where(jnp.any(rises), ratio * speed, jnp.nan) * chain.belt_direction()
    omega = jnp.sqrt(alone.stiffness)
    x, _ = steady_sliding(chain)
    damping = jnp.broadcast_to(sliding_damping(chain, speed), (chain.n,))
    A = stiffness_matrix(chain) - jnp.diag(omega**2 - 1j * omega * damping)
    unit = jnp.zeros(chain.n).at[vibrating].set(1.0)
    own = unit[:, None] > 0
    right = jnp.where(unit > 0, 1.0, -A[:, vibrating])
    shape = jnp.linalg.solve(jnp.where(own, jnp.diag(unit), jnp.where(own.T, 0.0, A)), right)
    # v_j = A cos(omega t), hence x_n = Re[-i u_n exp(i omega t)] A / omega.
    moved = amplitude / omega * jnp.real(-1j * shape)
    return (x + moved, amplitude * jnp.real(shape)), 2 * jnp.pi / omega


def guess_of_kind(chain: Chain, vibrating: int, kind: str) -> Guess:
    """A guess of the stick-slip cycle ("stable") or of the slip cycle ("unstable") of one mass."""
    if kind == "unstable":
        return slip_guess(chain, vibrating)
    released = release_state(chain, vibrating)
    return guess_from_simulation(chain, released, vibrating, transient=TRANSIENT)
