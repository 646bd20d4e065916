"""A limit cycle: its equations solved, its multipliers, its derivatives.

Newton's method, one linearised integration a step, and of what it finds the least period.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

from .._stored_programs import stored_jit
from .._types import State
from ..continuation.damped_newton import Factors, Iterate, ending, factorise
from ..continuation.implicit import attach_derivative
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


class LimitCycle(Outcome):
    """A periodic orbit.

    - `state`, `period`: the orbit is cut where mass `mass` moves fastest in the direction of the
      belt; the period is the least one.
    - `residual`: the gap after a period over the greatest velocity of that mass; in the layer in
      which it sticks, of velocity over the width.  `result`: successful if it is a cycle.
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

    def _rows(self) -> dict[str, Any]:
        return {
            "belt speed": getattr(self.chain, "belt_speed", None),
            "period": self.period,
            "amplitude": self.amplitude,
            "multipliers": self.multipliers,
            "trivial defect": self.trivial_defect,
            "gap after a period": self.residual,
            "mass": self.mass,
        }

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


@stored_jit
def solve_cycle(
    shooting: Shooting, start: Array, tolerance: Array, limit: Array
) -> tuple[LimitCycle, Array]:
    """(the cycle, its unknowns u) near u = `start`; nothing in here is to be differentiated."""
    found = search_cycle(shooting, start, tolerance, limit)
    field, state, period = shooting.unpack(found.u)
    whole, residual = found.aux, greatest_gap(found)
    direction = jnp.concatenate(field(0.0, state))
    floquet = floquet_multipliers(whole.monodromy, direction)
    speed = field.belt_direction() * state[1][shooting.mass]
    moves = (whole.fastest[shooting.mass] > LEAST_VELOCITY) & (speed > 0)
    closed = (residual <= tolerance) & jnp.isfinite(floquet.defect)
    result = ending(found, closed, limit)
    result = SearchResult.where(closed & ~moves, SearchResult.at_rest, result)
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


@stored_jit
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
