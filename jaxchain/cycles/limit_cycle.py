"""A limit cycle: its equations solved, its multipliers, its derivatives.

Newton's method, one linearised integration a step, and of what it finds the least period.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .._final import final
from .._types import State
from ..continuation.damped_newton import Factors, Iterate, ending, factorise
from ..continuation.implicit import attach_derivative
from ..model.chain import Chain
from ..model.oscillators import AbstractOscillators
from ..observers.amplitude import Amplitude
from ..observers.quantities import energy
from ..result import Outcome, SearchResult
from .floquet import floquet_multipliers, liouville_defect
from .least_period import close_orbit_once, greatest_gap
from .shooting import Shooting
from .variational import Period, flow, linearised_period

# A step that is shorter is rounding.
_FINE = 1e-11
# A mass that moves less rests.
LEAST_VELOCITY = 1e-6
# A trivial multiplier or a determinant that is off by more says that M is not to be believed.
_WORST_DEFECT = 1e-3
# Shares of the belt's speed at which mu is sampled; by how much its greatest value may exceed
# that of the samples, and by what share a period may fall short of the least one.
_SHARES, _BETWEEN, _ROUNDING = np.linspace(0.0, 1.0, 33), 2.0, 1e-6


@final
class LimitCycle(Outcome):
    """A periodic orbit.

    - `state`, `period`: the orbit is cut where mass `mass` moves fastest in the direction of the
      belt; the period is the least one.
    - `residual`: the gap after a period over the size of the orbit, or over the greatest velocity
      of that mass, velocities measured in the width where it sticks.  `result`: successful if it
      is a cycle.
    - `multipliers`: the 2n - 1 Floquet multipliers other than 1, the greatest modulus first.
    - `trivial_defect`: |M f - f| / |f| for f = (x', v'), which must be 0; `liouville_defect`: see
      there, NaN for dry friction; both were measured on this orbit.
    - `amplitude`: half peak-to-peak of each displacement; `fastest`: each greatest velocity in the
      direction of the belt.
    - `evaluations`: integrations of the linearised system it took; `chain`: whose cycle it is.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle, paper_chain
        >>> cycle = find_limit_cycle(paper_chain(1, belt_speed=1.5, width=1e-2))
        >>> cycle.stable, bool(cycle.residual < 1e-9), round(float(cycle.period), 4)
        (True, True, 6.3095)
        >>> x, v = cycle.state
        >>> x.shape, cycle.amplitude.shape, cycle.multipliers.shape
        ((1,), (1,), (1,))
        >>> slipping = find_limit_cycle(cycle.chain, branch="unstable")
        >>> bool(slipping.closeness[0] < cycle.closeness[0])  # farther from the belt's speed
        True
    """

    chain: AbstractOscillators
    state: State
    period: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    multipliers: Complex[Array, " others"]
    trivial_defect: Float[Array, ""]
    liouville_defect: Float[Array, ""]
    amplitude: Float[Array, " n"]
    fastest: Float[Array, " n"]
    evaluations: Int[Array, ""]
    mass: int = eqx.field(static=True)

    @property
    def closeness(self) -> Float[Array, " n"]:
        """max w / eps of each mass: one that never reaches the belt's speed has it below zero.

        With dry friction -inf for that one, and 0 for one that sticks.
        """
        along = self.chain.belt_direction()
        switching = self.chain.switching(0.0, along * self.fastest)
        if switching is None:
            return jnp.full_like(self.fastest, jnp.nan)
        w = along * switching[0]
        return jnp.where(w == 0, 0.0, w / switching[1])

    @property
    def energy(self) -> Float[Array, ""]:
        """E = 1/2 sum A_n^2."""
        return energy(self.amplitude)

    @property
    def uncertainty(self) -> Float[Array, ""]:
        """Of the multipliers, as far as the two defects tell."""
        defect = self.trivial_defect + jnp.nan_to_num(self.liouville_defect)
        return 1e-8 + 10.0 * (defect + self.residual)

    @property
    def stability_margin(self) -> Float[Array, ""]:
        """1 - the greatest modulus of a multiplier: negative for an unstable cycle."""
        return 1.0 - jnp.abs(self.multipliers[0])

    @property
    def stable(self) -> bool | None:
        """Whether disturbances die out; None if that is not known: no cycle, a defect, or |mu| = 1
        within its uncertainty.  Of one cycle, not of a batch."""
        uncertainty, margin = float(self.uncertainty), float(self.stability_margin)
        sound = bool(self.successful) and uncertainty < _WORST_DEFECT
        if not sound or not abs(margin) > uncertainty:
            return None
        return margin > 0


def can_be_cycle(
    field: AbstractOscillators, period: Any, speed: Float[Array, " n"]
) -> Bool[Array, ""]:
    """Whether a cycle of `field` can have this period, and masses as fast as `speed`.

    For a `Chain`, x'' + 2 xi x' + K x = p F(x' - v_d), two means over a period T tell:

    - Friction and damping depend on v_n alone, so that the mean of v_n' times them is 0, and with
      L the greatest eigenvalue of K: <v'^T v'> = <v^T K v> <= L <v^T v>.  v has no mean, so that
      <v^T v> <= (T / 2 pi)^2 <v'^T v'> (Wirtinger's inequality): T >= 2 pi / L^(1/2).
    - Friction does work on a mass only between rest and the belt's speed, at most p M |v_d| with M
      the greatest mu up to there.  Damping takes as much: 2 xi <v^T v> <= sum_n p_n M_n |v_d|, xi
      the least xi_n > 0.  Each v_n passes through 0: max v_n^2 <= T <|v_n v_n'|>
      <= T L^(1/2) <v^T v>.  Without damping, or with negative damping, nothing bounds v.

    Always true for other oscillators, whose forces are not bounded here.
    """
    if not isinstance(field, Chain):
        return jnp.asarray(True)
    n, belt = field.n, jnp.abs(field.belt_speed)
    stiffest = field.stiffness_diagonal(n)
    if field.springs is not None:
        stiffest = stiffest + field.springs.strength(n)  # Gershgorin's bound
    frequency = jnp.sqrt(jnp.max(stiffest))
    mu = jax.vmap(lambda share: field.law.coefficient(jnp.full(n, share * belt)))(_SHARES)
    mu = jnp.maximum(_BETWEEN * jnp.max(mu, axis=0), field.law.mu_static)
    work = belt * jnp.sum(field.load * mu * jnp.ones(n))
    damping = 2.0 * jnp.min(field.damping_ratio)
    slow = damping * jnp.max(speed**2) <= period * frequency * work
    return (period * frequency >= (1.0 - _ROUNDING) * 2.0 * jnp.pi) & ((damping <= 0) | slow)


def is_trusted(
    multipliers: Complex[Array, " others"], defect: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether the disturbance along the orbit comes back as it was, as that of a cycle does.

    An error of that disturbance grows as any other does.
    """
    growth = 1.0 + jnp.max(jnp.nan_to_num(jnp.abs(multipliers)))  # those not resolved are small
    return defect <= _WORST_DEFECT * growth  # false for NaN


@eqx.filter_jit
def solve_cycle(
    shooting: Shooting, start: Array, tolerance: Array, limit: Array
) -> tuple[LimitCycle, Array]:
    """(the cycle, its unknowns u) near u = `start`; nothing in here is to be differentiated."""
    found = search_cycle(shooting, start, tolerance, limit)
    field, state, period = shooting.unpack(found.u)
    whole = found.aux
    # In the shooting equations velocities count by their distance from the belt's: a fast orbit
    # that decays, or a piece of one, is closed there.  So the gap counts as a share of the
    # orbit's size, too.
    left = jnp.max(jnp.abs(jnp.stack(whole.end) - jnp.stack(state)))
    residual = jnp.fmax(greatest_gap(found), left / whole.returned.farthest)
    direction = jnp.concatenate(field(0.0, state))
    floquet = floquet_multipliers(whole.monodromy, direction)
    speed = field.belt_direction() * state[1][shooting.mass]
    moves = (whole.fastest[shooting.mass] > LEAST_VELOCITY) & (speed > 0)
    possible = can_be_cycle(field, period, whole.fastest)
    closed = (residual <= tolerance) & is_trusted(floquet.multipliers, floquet.defect)
    result = ending(found, closed, limit)
    result = SearchResult.where(closed & ~moves, SearchResult.at_rest, result)
    result = SearchResult.where(whole.complete & ~possible, SearchResult.ran_away, result)
    cycle = LimitCycle(
        chain=field,
        state=state,
        period=period,
        residual=residual,
        result=result,
        multipliers=floquet.multipliers,
        trivial_defect=floquet.defect,
        liouville_defect=liouville_defect(whole.monodromy, whole.trace_integral),
        amplitude=whole.amplitude,
        fastest=whole.fastest,
        evaluations=found.evaluations,
        mass=shooting.mass,
    )
    return cycle, found.u


@eqx.filter_jit
def with_derivatives(
    shooting: Shooting, chain: AbstractOscillators, cycle: LimitCycle, u: Array
) -> LimitCycle:
    """`cycle` with its derivatives in the numbers of `chain`."""
    held = eqx.tree_at(lambda s: s.field, shooting, chain)
    unknowns = jnp.concatenate([u, cycle.amplitude])
    unknowns = attach_derivative(_residual, unknowns, held)
    _, state, period = held.unpack(unknowns[: u.shape[0]])
    return eqx.tree_at(
        lambda c: (c.chain, c.state, c.period, c.amplitude),
        cycle,
        (chain, state, period, unknowns[u.shape[0] :]),
    )


def _residual(unknowns: Float[Array, " m"], shooting: Shooting) -> Float[Array, " m"]:
    """The equations of the cycle and of its amplitudes."""
    n = len(shooting.images)
    u, amplitude = unknowns[:-n], unknowns[-n:]
    field, state, period = shooting.unpack(u)
    end, _, (seen,) = flow(
        field, state, period, rtol=shooting.rtol, solver=shooting.solver, observers=[Amplitude()]
    )
    return jnp.concatenate([shooting.gap(u, end), seen - amplitude])


def search_cycle(shooting: Shooting, start: Array, tolerance: Array, limit: Array) -> Iterate:
    """The search for a closed orbit near u = `start`; `aux` is its `Period`."""
    weights = jnp.full(start.shape, start.shape[0] ** -0.5)

    def linearise(u: Array) -> tuple[Array, Factors, Period]:
        field, state, period = shooting.unpack(u)
        whole = linearised_period(field, state, period, rtol=shooting.rtol, solver=shooting.solver)
        by_u, by_end = jax.jacfwd(shooting.gap, argnums=(0, 1))(u, whole.end)

        def orbit(u: Array) -> Array:
            _, (x, v), period = shooting.unpack(u)
            return jnp.concatenate([x, v, period[None]])

        slope = jax.jacfwd(orbit)(u)
        direction = jnp.concatenate(field(0.0, whole.end))
        end = whole.monodromy @ slope[:-1] + direction[:, None] * slope[-1:]
        jacobian = by_u + jnp.concatenate(by_end, axis=1) @ end
        return shooting.gap(u, whole.end), factorise(jacobian, weights), whole

    return close_orbit_once(
        linearise, start, weights, limit=limit, fine=_FINE,
        closed=lambda now: greatest_gap(now) <= tolerance,
        state_at=lambda u: shooting.unpack(u)[1],
        shortened=lambda u, times: u.at[-1].add(-jnp.log(times)),
    )  # fmt: skip
