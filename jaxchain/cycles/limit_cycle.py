"""A limit cycle: its equations solved, its multipliers, its derivatives.

Newton's method, one linearised integration a step, and of what it finds the least period.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from .._types import State
from ..continuation.damped_newton import Factors, factorise, size
from ..continuation.implicit import attach_derivative
from ..model.oscillators import AbstractOscillators
from ..observers.amplitude import Amplitude
from ..observers.quantities import energy
from .floquet import floquet_multipliers, liouville_defect
from .shooting import Shooting
from .variational import Period, linearised_period, watched_flow

_LEAST_DAMPING, _FINE = 2.0**-10, 1e-11
# A mass that moves less rests.
_LEAST_VELOCITY = 1e-6
# A trivial multiplier or a determinant that is off by more says that M is not to be believed.
_WORST_DEFECT = 1e-3


class LimitCycle(eqx.Module):
    """A periodic orbit.

    - `state`, `period`: the orbit is cut where mass `mass` moves fastest in the direction of the
      belt; the period is the least one.
    - `residual`: the gap after a period over the greatest velocity of that mass; in the layer in
      which it sticks, of velocity over the width.  `converged`: whether it is a cycle.
    - `multipliers`: the 2n - 1 Floquet multipliers other than 1, the greatest modulus first.
    - `trivial_defect`: |M f - f| / |f| for f = (x', v'), which must be 0; `liouville_defect`: see
      there; both were measured on this orbit.
    - `amplitude`: half peak-to-peak of each displacement; `fastest`: each greatest velocity in the
      direction of the belt.
    - `evaluations`: integrations of the linearised system it took.
    """

    chain: AbstractOscillators
    state: State
    period: Float[Array, ""]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]
    multipliers: Complex[Array, " others"]
    trivial_defect: Float[Array, ""]
    liouville_defect: Float[Array, ""]
    amplitude: Float[Array, " n"]
    fastest: Float[Array, " n"]
    evaluations: Int[Array, ""]
    mass: int = eqx.field(static=True)

    @property
    def closeness(self) -> Float[Array, " n"]:
        """max w / eps of each mass: one that never reaches the belt's speed has it below zero."""
        along = self.chain.belt_direction()
        switching = self.chain.switching(0.0, along * self.fastest)
        if switching is None:
            return jnp.full_like(self.fastest, jnp.nan)
        return along * switching[0] / switching[1]

    @property
    def energy(self) -> Float[Array, ""]:
        """E = 1/2 sum A_n^2."""
        return energy(self.amplitude)

    @property
    def uncertainty(self) -> Float[Array, ""]:
        """Of the multipliers, as far as the two defects tell."""
        return 1e-8 + 10.0 * (self.trivial_defect + self.liouville_defect + self.residual)

    @property
    def stability_margin(self) -> Float[Array, ""]:
        """1 - the greatest modulus of a multiplier: negative for an unstable cycle."""
        return 1.0 - jnp.abs(self.multipliers[0])

    @property
    def stable(self) -> bool | None:
        """Whether disturbances die out; None if that is not known: no cycle, a defect, or |mu| = 1
        within its uncertainty.  Of one cycle, not of a batch."""
        uncertainty, margin = float(self.uncertainty), float(self.stability_margin)
        sound = bool(self.converged) and uncertainty < _WORST_DEFECT
        if not sound or not abs(margin) > uncertainty:
            return None
        return margin > 0


@eqx.filter_jit
def solve_cycle(
    shooting: Shooting, start: Array, tolerance: Array, limit: Array
) -> tuple[LimitCycle, Array]:
    """(the cycle, its unknowns u) near u = `start`; nothing in here is to be differentiated."""
    found = search_cycle(shooting, start, tolerance, limit)
    field, state, period = shooting.unpack(found.u)
    flow = found.period
    direction = jnp.concatenate(field(0.0, state))
    floquet = floquet_multipliers(flow.monodromy, direction)
    speed = field.belt_direction() * state[1][shooting.mass]
    moves = (flow.fastest[shooting.mass] > _LEAST_VELOCITY) & (speed > 0)
    cycle = LimitCycle(
        chain=field,
        state=state,
        period=period,
        residual=found.residual,
        converged=(found.residual <= tolerance) & moves & jnp.isfinite(floquet.defect),
        multipliers=floquet.multipliers,
        trivial_defect=floquet.defect,
        liouville_defect=liouville_defect(flow.monodromy, flow.trace_integral),
        amplitude=flow.amplitude,
        fastest=flow.fastest,
        evaluations=found.count,
        mass=shooting.mass,
    )
    return cycle, found.u


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
    end, _, (seen,) = watched_flow(
        field, state, period, rtol=shooting.rtol, solver=shooting.solver, observers=[Amplitude()]
    )
    return jnp.concatenate([shooting.gap(u, end), seen - amplitude])


class Search(eqx.Module):
    u: Float[Array, " m"]  # the best
    step: Float[Array, " m"]  # Newton's from there
    length: Float[Array, ""]
    factors: Factors
    damping: Float[Array, ""]
    period: Period
    residual: Float[Array, ""]
    refused: Bool[Array, ""]
    count: Int[Array, ""]


class _Round(eqx.Module):
    best: Search
    start: Float[Array, " m"]  # of the next search
    goes_on: Bool[Array, ""]


def search_cycle(shooting: Shooting, start: Array, tolerance: Array, limit: Array) -> Search:
    """Newton's method as in `jaxchain.newton`, with one integration in one place to compile.

    It goes on within the tolerance, until a step helps no more.  An orbit that has come back after
    a share of its period is then searched for with this share (of `limit` integrations, too), and
    kept if it is the same one: it was gone round more than once.
    """
    weights = jnp.full(start.shape, start.shape[0] ** -0.5)

    def linearised(u: Array) -> tuple[Period, Array, Array]:
        field, state, period = shooting.unpack(u)
        flow = linearised_period(field, state, period, rtol=shooting.rtol, solver=shooting.solver)
        by_u, by_end = jax.jacfwd(shooting.gap, argnums=(0, 1))(u, flow.end)

        def orbit(u: Array) -> Array:
            _, (x, v), period = shooting.unpack(u)
            return jnp.concatenate([x, v, period[None]])

        slope = jax.jacfwd(orbit)(u)
        direction = jnp.concatenate(field(0.0, flow.end))
        end = flow.monodromy @ slope[:-1] + direction[:, None] * slope[-1:]
        jacobian = by_u + jnp.concatenate(by_end, axis=1) @ end
        return flow, shooting.gap(u, flow.end), jacobian

    def going(now: Search) -> Array:
        fine = now.length <= _FINE * (1.0 + size(now.u, weights))
        spent = now.refused & (now.residual <= tolerance)
        hopeful = (now.damping >= _LEAST_DAMPING) & (now.count < limit)
        return hopeful & ~fine & ~spent & ~jnp.isnan(now.length)

    def body(now: Search) -> Search:
        u = now.u + now.damping * now.step
        flow, r, jacobian = linearised(u)
        factors = factorise(jacobian, weights)
        step = -factors.solve(r)
        length = size(step, weights)
        # At the start every u is better than nothing, unless the integration fails.
        simplified = size(now.factors.solve(r), weights)
        better = (simplified < (1.0 - now.damping / 4.0) * now.length) & jnp.isfinite(length)
        first = now.count == 0
        taken = Search(
            u, step, length, factors, jnp.where(first, 1.0, jnp.minimum(1.0, 4.0 * now.damping)),
            flow, jnp.max(jnp.abs(r)), jnp.asarray(False), now.count + 1,
        )  # fmt: skip
        halved = eqx.tree_at(
            lambda s: (s.damping, s.refused, s.count, s.length),
            now,
            (now.damping / 2.0, jnp.asarray(True), now.count + 1,
             jnp.where(first, jnp.nan, now.length)),
        )  # fmt: skip
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), taken, halved)

    nothing = eqx.filter_eval_shape(linearised, start)[0]
    nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), nothing)
    infinite = jnp.asarray(jnp.inf)

    def from_guess(start: Array) -> Search:
        return Search(
            start, jnp.zeros_like(start), infinite, factorise(jnp.eye(start.shape[0]), weights),
            jnp.ones(()), nothing, infinite, jnp.asarray(False), jnp.zeros((), int),
        )  # fmt: skip

    def round_(now: _Round) -> _Round:
        found = lax.while_loop(going, body, from_guess(now.start))
        count = now.best.count + found.count
        returned = found.period.returned
        states = (shooting.unpack(u)[1] for u in (now.best.u, found.u))
        closed = found.residual <= tolerance
        good = (now.best.count == 0) | (closed & returned.same(*states))
        best = jax.tree.map(lambda a, b: jnp.where(good, a, b), found, now.best)
        best = eqx.tree_at(lambda s: s.count, best, count)
        times = returned.times_round
        shorter = found.u.at[-1].add(-jnp.log(times))
        return _Round(best, shorter, good & closed & (times > 1))

    first = _Round(from_guess(start), start, jnp.asarray(True))
    return lax.while_loop(lambda now: now.goes_on, round_, first).best
