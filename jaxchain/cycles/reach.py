"""A cycle reached along its branch, from a belt speed at which one is easily found.

Near a fold the stick-slip cycle and the slip cycle are close to each other: averaging knows of no
slip cycle there, a simulation may not settle within its time, and Newton's method may end on the
other one.  Along the branch there is no such doubt.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from .._types import State
from ..model.chain import Chain
from ..observers.quantities import active
from .averaging import cycle_speed, greatest_speed, one_mass
from .branches import NoBranchError, continue_cycle
from .guesses import guess_of_kind
from .limit_cycle import LimitCycle, solve_cycle
from .shooting import Shooting, packed

# Belt speeds to begin at: of slip cycles those at which averaging has amplitudes of such shares of
# the belt speed, of stick-slip cycles such shares of the one that is asked for.
_RATIOS = (0.95, 0.85, 0.7, 0.5, 0.3)
_SHARES = (0.97, 0.9, 1.1, 0.8, 1.2, 1.3, 0.7, 0.6, 0.5)
# By how much the closeness at a fold may differ from what is known of it.
_DOUBT = 0.3


class Reached(NamedTuple):
    """(state, period) of the cycle, or None, and why not."""

    guess: tuple[State, Array] | None
    reason: str


@eqx.filter_jit
def is_of_kind(cycle: LimitCycle, kind: str) -> Bool[Array, ""]:
    """Whether one mass vibrates, on the side of the fold that was asked for, as far as it shows.

    Where vibration spreads, a run from one mass ends with several.
    Slip cycles ("unstable") have a real multiplier beyond 1, which passes through 1 at the fold.
    A stick-slip cycle ("stable") of a chain may have one, too, with the symmetry of its neighbours
    lost, but its mass comes closer to the belt's speed than that of a fold, s = max w / eps =
    ln(eps / v_d) / 4 - 1.
    """
    multipliers = cycle.multipliers
    beyond = (jnp.imag(multipliers) == 0) & (jnp.real(multipliers) > 1.0 + cycle.uncertainty)
    grows, n, chain = jnp.any(beyond), cycle.fastest.shape[0], cast(Chain, cycle.chain)
    alone = jnp.sum(active(cycle.amplitude, chain.belt_speed)) <= 1
    if kind == "unstable":
        return alone & grows
    if n == 1:
        return ~grows
    if chain.dry:
        return alone & (cycle.closeness[cycle.mass] == 0)
    eps = jnp.broadcast_to(chain.width, (n,))[cycle.mass]
    fold = 0.25 * jnp.log(eps / jnp.maximum(jnp.abs(chain.belt_speed), eps)) - 1.0
    return alone & ~(grows & (cycle.closeness[cycle.mass] < fold + _DOUBT))


def reach_cycle(shooting: Shooting, kind: str, tolerance: Array, limit: Array) -> Reached:
    """The cycle of one mass, of `kind`, at the belt speed of `shooting.field`, from elsewhere.

    On the host.  The reason says where the branch turns or ends if it does not get there.
    """
    chain: Any = shooting.field
    goal, along = abs(float(chain.belt_speed)), float(chain.belt_direction())
    ended = ""
    for speed in _speeds(chain, shooting.mass, kind, goal):
        there = chain.with_(belt_speed=along * speed)
        state, period = guess_of_kind(there, shooting.mass, kind)
        if not bool(jnp.isfinite(jnp.sum(state[1]) + period)):
            continue
        own = Shooting(
            field=there, rtol=shooting.rtol, solver=shooting.solver, mass=shooting.mass,
            images=shooting.images,
        )  # fmt: skip
        cycle, _ = solve_cycle(own, packed(own, state, period), tolerance, limit)
        if not bool(cycle.successful & is_of_kind(cycle, kind)):
            continue
        found, ended = _follow(cycle, shooting, goal, along)
        if found is not None:
            return Reached(found, "")
        if ended:
            break
    return Reached(None, ended)


def _speeds(chain: Chain, mass: int, kind: str, goal: float) -> list[float]:
    """Where to begin, the nearest first."""
    if kind == "stable":
        return [share * goal for share in _SHARES]
    alone = one_mass(chain, mass)
    highest = greatest_speed(alone)
    ratios = jnp.asarray(_RATIOS)
    speeds = np.asarray(lax.map(lambda ratio: cycle_speed(alone, ratio, highest), ratios))
    known = [float(speed) for speed in speeds[np.isfinite(speeds)] if speed > 0]
    return sorted(known, key=lambda speed: abs(speed - goal))


def _follow(
    cycle: LimitCycle, shooting: Shooting, goal: float, along: float
) -> tuple[tuple[State, Array] | None, str]:
    """The cycle at the belt speed `goal`; if the branch does not get there, why."""
    begin = abs(float(cast(Chain, cycle.chain).belt_speed))
    ahead = 1.0 if goal > begin else -1.0
    bounds = sorted((along * goal, along * (goal - 2.0 * ahead * abs(goal - begin) - ahead)))
    farthest = begin

    def turned(speed: float, _: Any) -> bool:
        nonlocal farthest
        back = ahead * (abs(speed) - farthest) < 0
        farthest = abs(speed)
        return back

    try:
        branch = continue_cycle(
            cycle, direction=int(along * ahead), bounds=(bounds[0], bounds[1]),
            images=shooting.images, rtol=float(shooting.rtol), stop=turned,
        )  # fmt: skip
    except NoBranchError:
        return None, ""
    if branch.ended == "left_bounds" and branch.parameter[-1] == along * goal:
        state = jnp.asarray(branch.x[-1]), jnp.asarray(branch.v[-1])
        return (state, jnp.asarray(branch.period[-1])), ""
    for point in branch.special:
        if point.kind in ("fold", "hopf"):
            what = "turn at a fold" if point.kind == "fold" else "end in a Hopf point"
            return None, (
                f"the cycles of this kind, followed from belt speed {along * begin:.6g}, {what} "
                f"at {point.parameter:.6g}"
            )
    return None, ""
