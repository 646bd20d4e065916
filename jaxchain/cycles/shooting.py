"""Periodic orbits as solutions of equations: flow, section, coordinates.

Shooting requires that a state returns after a period.  Two choices keep it well conditioned at
every width of the smoothed friction:

- *The section.* The orbit is cut at the greatest velocity of one vibrating mass j in the direction
  of the belt.  There its acceleration vanishes, which determines x_j and replaces a phase
  condition.
- *The coordinates* are relative to the belt, w_n = v_n - v_d = sign(v_d) eps sinh z_n.  Within
  |w| < eps, where a mass sticks, z is |w| / eps; outside it is a logarithm.  The layer in which a
  smoothed fold happens, of thickness O(eps) in v, has thickness O(1) in z_j, which is the
  "greatest w / eps along the orbit".

Unknowns u = (x_n for n != j, z_n for all n, ln T): 2n numbers, for 2n equations (return of x and
of of z).  If forces depend on displacement other than by -K x, x_j is not explicit: it is one more
unknown, in its place among the x_n, and its acceleration at the cut is one more equation.  The
same holds for other cells, whose m variables are all unknown; z replaces their variable `contact`.

An orbit with x_motion[n](t + T / k) = x_n(t), a `shift`, returns after T / k already, moved.

Without damping an orbit is one of a family, and its return determines one number less: energy is
conserved, so that if all else returns, the greatest velocity does.  Its gap gives way to an
equation for the period, which is the parameter of the family.

A forced orbit is cut at t = 0, and its period is a multiple of that of the force: the m N
variables are the only unknowns, and their return gives the only equations.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from .._checks import to_float
from .._types import State
from ..continuation.branch import SpecialPoint
from ..continuation.damped_newton import Iterate, Linearise, begin, newton_steps, size, where
from ..kinds.hopf import Hopf
from ..kinds.kind import AbstractKind, Unknowns
from ..kinds.multipliers import PeriodDoubling, SymmetryBreaking, Torus
from ..model.model import AbstractModel
from ..model.oscillators import AbstractOscillators
from ..observers.amplitude import Amplitude
from ..solvers.rosenbrock import AbstractStructuredRosenbrock
from .floquet import is_trusted, orbit_multipliers
from .orbit import AbstractOrbit, Cycles, Rows, SeenCycle, SpecialRows, Start
from .symmetry import (
    CycleSymmetry,
    Symmetry,
    breaking_block,
    breaking_disturbance,
    finer,
    ring_motions,
    subgroups,
)
from .variational import Period, Shift, flow, linearised_period

# Tolerances of the integration and of Newton's method at special points.
RTOL, _TOLERANCE = 3e-11, 1e-9
# The least amplitude of a family of cycles, over its first one.
SMALL = 1e-3

# The greatest gap of the greatest velocity, over itself, of a family of cycles.
_RETURNS = 1e-6


class CycleLinearisation(eqx.Module):
    """Further results of `Shooting.cycle`.

    - `state`: that on the section; `period`.
    - `speed`: the greatest velocity, along the belt, of the mass where the orbit is cut, in
      `Shooting.units`.
    - `times_round`: k = 2, 3, ... if the orbit already closes after 1/k of the period, else 1.
    - `amplitude` (n,): half peak-to-peak of each displacement over a period.
    - `monodromy` M = d(state after a period)/d(state), (2n, 2n), in the order (x, v); `part`: Q of
      `Period`, which is M without a shift.
    - `multipliers` (2n - 1,): the nontrivial ones, the greatest modulus first; `trivial_defect`
      = |M f - f| / |f|.
    - `sound`: whether it can be a cycle, and its trivial multiplier is 1.
    """

    state: State
    period: Float[Array, ""]
    speed: Float[Array, ""]
    times_round: Int[Array, ""]
    amplitude: Float[Array, " n"]
    monodromy: Float[Array, "two_n two_n"]
    part: Float[Array, "two_n two_n"]
    multipliers: Complex[Array, " others"]
    trivial_defect: Float[Array, ""]
    sound: Bool[Array, ""]


class Shooting(AbstractOrbit, eqx.Module):
    """The equations of a periodic orbit of `field`, cut at the greatest velocity of one mass.

    **Arguments:**

    - `field`: a `Chain`, or another model.
    - `mass`: index j of the mass at whose greatest velocity the orbit is cut.
    - `images`: orbits with a symmetry have unknowns only for masses that differ: entry n is the
      index of the mass that moves like mass n, `images[i] = i` for those solved for.  None: no
      symmetry.
    - `parameter`: the argument of `Chain.with_` that is the parameter of the residual, a tuple of
      several, or None; "period" for a family of orbits, see `is_family`.
    - `m`: the number of variables of a cell.
    - `forcing_periods`: the number of periods of the force in the orbit's; None without forcing.
    - `shift`: (motion, k) of orbits with x_motion[n](t + T / k) = x_n(t), or None.
    - `units`: see `AbstractOrbit`.
    """

    field: AbstractModel
    rtol: Float[Array, ""] = eqx.field(converter=to_float)
    solver: AbstractStructuredRosenbrock = eqx.field(static=True)
    mass: int = eqx.field(static=True)
    images: tuple[int, ...] = eqx.field(static=True)
    parameter: str | tuple[str, ...] | None = eqx.field(static=True, default=None)
    m: int = eqx.field(static=True, default=2)
    forcing_periods: int | None = eqx.field(static=True, default=None)
    shift: Shift | None = eqx.field(static=True, default=None)
    units: Float[Array | np.ndarray, " m_and_time"] | None = None

    @property
    def n(self) -> int:
        """The number of masses."""
        return len(self.images)

    @property
    def parts(self) -> int:
        """k, or 1 without a shift."""
        return 1 if self.shift is None else self.shift[1]

    @property
    def solved(self) -> list[int]:
        """The masses that are solved for."""
        return sorted(set(self.images))

    @property
    def balanced(self) -> bool:
        """Whether x_j is explicit, from the balance of forces at the cut."""
        return self.forcing_periods is None and self.field.balanced(self.n)

    @property
    def others(self) -> list[int]:
        """The masses whose displacements are unknowns: without j if x_j is explicit."""
        return [n for n in self.solved if n != self.mass or not self.balanced]

    @property
    def z_index(self) -> int:
        """The index of z_j in u."""
        return self._starts[min(self.field.contact, self.m - 1)] + self.solved.index(self.mass)

    @property
    def _starts(self) -> list[int]:
        """The index in u at which each of the m variables begins, and the end of the last one."""
        count = len(self.others)
        return [0, *(count + k * len(self.solved) for k in range(self.m))]

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self._starts[-1] + (self.forcing_periods is None)

    def pack(self, state: State, period: Any, *parameter: Any) -> Float[Array, " m"]:
        """u of a state on the section (without x_j if it is explicit)."""
        field = self.at(*parameter)
        parts = [part / unit for part, unit in zip(state, self.of_variables, strict=True)]
        contact = min(field.contact, self.m - 1)
        belt, width = _layer(field, state[contact])
        if width is not None:
            parts[contact] = jnp.arcsinh((state[contact] - belt) / width)
        elif self.is_family:
            parts[contact] = jnp.where(self._own, jnp.log(parts[contact]), parts[contact])
        rows = [self.others, *[self.solved] * (self.m - 1)]
        numbers = [part[jnp.asarray(row, int)] for part, row in zip(parts, rows, strict=True)]
        if self.forcing_periods is None:
            numbers.append(jnp.log(to_float(period))[None])
        return jnp.concatenate(numbers)

    def unpack(self, u: Float[Array, " m"], *parameter: Any) -> tuple[AbstractModel, State, Array]:
        """(field, state on the section, period)."""
        field, starts = self.at(*parameter), self._starts
        position = {n: i for i, n in enumerate(self.solved)}
        index = jnp.asarray([position[i] for i in self.images])
        if self.forcing_periods is None:
            period = jnp.exp(u[-1])
        else:
            period = self.forcing_periods * to_float(field.forcing_period())
        parts = [u[first:last] for first, last in itertools.pairwise(starts)]
        parts[1:] = [part[index] for part in parts[1:]]
        if not self.balanced:
            parts[0] = parts[0][index]
        contact = min(field.contact, self.m - 1)
        belt, width = _layer(field, parts[contact])
        known = parts[contact]
        if self.is_family:
            parts[contact] = jnp.where(self._own, jnp.exp(known), known)
        parts = [part * unit for part, unit in zip(parts, self.of_variables, strict=True)]
        if width is not None:
            parts[contact] = belt + width * jnp.sinh(known)
        if not self.balanced:
            return field, tuple(parts), period
        field = cast(AbstractOscillators, field)
        # With x_j = 0, the force on j is what K_jj x_j has to balance.
        count, v = starts[1], parts[1]
        spread = {n: i for i, n in enumerate(self.others)}
        at = jnp.asarray([spread.get(i, count) for i in self.images])
        x = jnp.concatenate([parts[0], jnp.zeros(1)])[at]
        slopes = jnp.asarray([float(i == self.images[self.mass]) for i in self.images])
        force = field.local_force(0.0, x, v) + field.restoring_force(x)
        stiffness = -field.restoring_force(slopes)[self.mass]
        return field, (x + slopes * (force[self.mass] / stiffness), v), period

    def rest(self, *parameter: Any) -> Array:
        """sinh z_j at zero velocity: -|v_d| / eps."""
        field = self.at(*parameter)
        belt, width = _layer(field, jnp.zeros(self.n))
        if width is None:
            return jnp.zeros(())
        return (-belt / width)[self.mass]

    def linearise(
        self, u: Float[Array, " m"], *parameter: Any
    ) -> tuple[Float[Array, " m"], Float[Array, "m columns"], Period]:
        """(R, its derivatives in u and, if it is given, the parameter, the orbit).

        It takes one integration.  With y = (x, v), y_1 the state after a period: dy_1 = M dy +
        f(y_1) dT + (dy_1/dp) dp, and dR follows from R = gap(u, y_1, p).  With a shift y_1 is the
        state after T / k, moved.
        """
        d, m = self.m * self.n, u.shape[0]
        z = jnp.append(u, jnp.stack(parameter)) if parameter else u

        def start(z: Array) -> Array:
            _, state, period = self.unpack(z[:m], *z[m:])
            return jnp.concatenate([*state, z[m:], (period / self.parts)[None]])

        def gap(z: Array, end: State) -> Array:
            return self.gap(z[:m], end, *z[m:])

        def make(y: Array) -> tuple[AbstractModel, State, Array]:
            return self.at(*y[d:]), tuple(jnp.split(y[:d], self.m)), period

        first, by_z = start(z), jax.jacfwd(start)(z)
        period = first[-1]
        numerics = {"rtol": self.rtol, "solver": self.solver, "shift": self.shift}
        whole = linearised_period(make, first[:-1], **numerics)
        rate = jnp.concatenate(self.at(*parameter)(0.0, whole.end))
        end = jnp.concatenate([whole.slopes, rate[:, None]], axis=1) @ by_z
        direct, by_end = jax.jacfwd(gap, argnums=(0, 1))(z, whole.end)
        jacobian = direct + jnp.concatenate(by_end, axis=1) @ end
        return gap(z, whole.end), jacobian, whole

    def cycle(
        self, u: Float[Array, " m"], *parameters: Any
    ) -> tuple[Float[Array, " m"], Float[Array, "m more"], CycleLinearisation]:
        """(R, [R_u R_p], `CycleLinearisation`), from one integration."""
        r, jacobian, whole = self.linearise(u, *parameters)
        field, state, period = self.unpack(u, *parameters)
        f = None if self.forcing_periods else jnp.concatenate(field(0.0, state))
        floquet = orbit_multipliers(whole.monodromy, f)
        sound = field.can_be_cycle(period, whole.fastest)
        if self.is_family:
            sound &= jnp.abs(self.gap(u, whole.end)[self._lost]) < _RETURNS
        extra = CycleLinearisation(
            state,
            period,
            field.belt_direction() * self._speed(field, state),
            whole.returned.times_round,
            whole.amplitude,
            whole.monodromy,
            whole.part,
            floquet.multipliers,
            floquet.defect,
            sound & is_trusted(floquet.multipliers, floquet.defect),
        )
        return r, jacobian, extra

    def seen(self, u: Float[Array, " m"], *parameters: Any) -> SeenCycle:
        """The cycle, with derivatives."""
        field, state, period = self.unpack(u, *parameters)
        numerics = {"rtol": self.rtol, "solver": self.solver}
        _, _, (amplitude,) = flow(field, state, period, observers=[Amplitude()], **numerics)
        return SeenCycle(state, period, amplitude)

    def weights(self, p: float) -> np.ndarray:
        """All masses except j share one unit; z_j, ln T and p / p_start have one each."""
        m = self.size
        weights = np.full(m + 1, len(self.solved) ** -0.5)
        weights[self.z_index] = 1.0
        if self.forcing_periods is None:
            weights[m - 1] = 1.0
        weights[m] = 1.0 / (abs(p) or 1.0)
        return weights

    def residual(self, u: Float[Array, " m"], *parameter: Any) -> Float[Array, " m"]:
        """The gap of x and of z after a period, over the velocity amplitude of mass j, in `units`.

        If x_j is not explicit, its acceleration at the cut is one more, divided in the same way.

        Rest also solves the undivided equations; Newton's method for the divided ones avoids it.
        """
        field, state, period = self.unpack(u, *parameter)
        return self.gap(u, self.end(field, state, period), *parameter)

    def end(self, field: AbstractModel, state: State, period: Array) -> State:
        """The state after the period, or after T / k, moved."""
        end, _, _ = flow(field, state, period / self.parts, rtol=self.rtol, solver=self.solver)
        return end if self.shift is None else tuple(p[np.asarray(self.shift[0])] for p in end)

    def image(self, z: Unknowns, one: Float[Array, " d"]) -> Float[Array, " d"]:
        """See `AbstractOrbit`."""
        return replace(self, shift=None)._end_of(z, one)

    def _end_of(self, z: Unknowns, one: Float[Array, " d"]) -> Float[Array, " d"]:
        field, state, period = self.unpack(z.u, *z.parameters)

        def end(y: Array) -> Array:
            return jnp.concatenate(self.end(field, tuple(jnp.split(y, self.m)), period))

        return jax.jvp(end, (jnp.concatenate(state),), (one,))[1]

    def breaking_block(self, part: Any, kept: Symmetry) -> tuple[Any, Any, float]:
        """See `symmetry.breaking_block`."""
        return breaking_block(part, (self.images, self.shift), kept, self.m)

    def breaking_image(
        self, z: Unknowns, one: Float[Array, " d"], kept: Symmetry
    ) -> Float[Array, " d"]:
        """The matrix of this block times a disturbance, with derivatives."""
        lost = kept[0] == self.images  # only shifts are
        return (self if lost else replace(self, shift=kept[1]))._end_of(z, one)

    def _motions(self, state: State) -> list[np.ndarray]:
        """The symmetries of the equations, if the orbit keeps one."""
        less = len(self.solved) < self.n or self.shift is not None
        return ring_motions(self.field, state) if less else []

    def subgroups(self, extra: CycleLinearisation) -> tuple[CycleSymmetry, ...]:
        """The symmetries of the branches that leave at a symmetry breaking."""
        symmetry = self.images, self.shift
        state = tuple(map(jnp.asarray, extra.state))
        return subgroups(extra.part, symmetry, self._motions(state), self.m)

    def with_less_symmetry(
        self, point: Any, symmetry: CycleSymmetry
    ) -> tuple[Shooting, SpecialPoint]:
        """The equations with `symmetry` only, and the point with the direction that keeps it."""
        m, p, mass, kept = self.m, point.parameter, self.mass, (symmetry.images, symmetry.shift)
        own = symmetry.images[mass]  # the section is at the representative of its class
        images = tuple(mass if image == own else image for image in symmetry.images)
        full = replace(self, images=images, shift=symmetry.shift)
        given = self.images, self.shift
        _, null = breaking_disturbance(point.raw.extra.part, given, kept, m)

        def packed(z: Any) -> Any:
            _, state, period = self.unpack(z[:-1], z[-1])
            return jnp.append(full.pack(state, period, z[-1]), z[-1])

        if self.forcing_periods is None:  # along the motion to the section
            field, start = full.at(p), tuple(map(jnp.asarray, point.state))
            pushes = tuple(jnp.asarray(part) for part in null.reshape(m, self.n))

            def turn(change: State) -> Array:
                def rate(y: State) -> Array:
                    return field.second_rate(0.0, y)[mass]

                return jax.jvp(rate, (start,), (change,))[1]

            flow = field(0.0, start)
            null = null - float(turn(pushes) / turn(flow)) * np.concatenate(flow)

        def disturbed(share: Any) -> Any:
            pushes = null.reshape(m, self.n)
            state = tuple(a + share * b for a, b in zip(point.state, pushes, strict=True))
            return jnp.append(full.pack(state, point.period, p), p)

        z = jnp.append(point.raw.u, p)
        u, tangent = jax.jvp(packed, (z,), (jnp.asarray(point.raw.tangent),))
        _, other = jax.jvp(disturbed, (jnp.zeros(()),), (jnp.ones(()),))
        return full, replace(
            point.raw, u=np.asarray(u)[:-1], tangent=np.asarray(tangent), other=np.asarray(other)
        )

    def kinds(self, u: np.ndarray, p: float) -> list[AbstractKind]:
        """See `AbstractOrbit`."""
        autonomous = self.forcing_periods is None
        kinds: list[AbstractKind] = [Hopf()] if autonomous and not self.is_family else []
        # One multiplier besides the trivial one is never negative.
        if self.m * self.n > 2 or not autonomous:
            kinds += [PeriodDoubling(), Torus()]
        motions = self._motions(self.unpack(jnp.asarray(u), p)[1])
        less = finer(motions, self.images, self.shift) if motions else []
        return kinds + [SymmetryBreaking(kept) for kept in less]

    def lost(self, first: CycleLinearisation, extra: CycleLinearisation) -> str:
        """See `AbstractOrbit`."""
        if self.is_family and extra.speed < SMALL * first.speed:
            return "the amplitude vanishes"
        if not extra.sound:
            return "it is no longer a cycle, by its speed, period or trivial multiplier"
        if self.forcing_periods is not None:
            return ""
        if extra.speed <= 0:
            return "the amplitude vanishes"
        state = tuple(map(jnp.asarray, extra.state))
        greatest = np.max(np.abs(self.field.value_and_rate(0.0, state)[1]))
        little = extra.speed * self._unit_of_speed < 1e-2 * greatest
        return f"mass {self.mass} hardly vibrates: cut the orbit at another" if little else ""

    def is_valid(self, extra: CycleLinearisation) -> bool:
        """See `AbstractOrbit`; the last point may be its own mirror image."""
        moves = self.forcing_periods is not None or extra.speed > 0
        return bool(moves and extra.sound)

    def with_least_period(self, u: np.ndarray, p: float, extra: Any) -> Start | None:
        """See `AbstractOrbit`."""
        times = extra.times_round
        if times == 1 or self.forcing_periods is not None:
            return None
        once = u - np.append(np.zeros(self.size - 1), np.log(times))
        return Start(self, once, p / (times if self.is_family else 1), None)

    def exact(self, kind: AbstractKind, raw: SpecialPoint, tolerance: float) -> SpecialPoint:
        """From tightly integrated equations; it does not depend on the tolerance of the branch.

        Its error is the change for a tolerance ten times as great, plus the remaining error of the
        search.
        """
        if not (raw.refined or kind.is_end):
            return raw
        rtol = min(float(self.rtol), RTOL)
        tight, loose = (
            kind.locate(self, orbit.corrector(raw.p, min(tolerance, _TOLERANCE)), raw)
            for orbit in (replace(self, rtol=share * rtol) for share in (1.0, 10.0))
        )
        if tight is None:
            return replace(raw, refined=False, error=np.inf)
        integration = np.inf if loose is None else abs(tight.p - loose.p)
        error = tight.error + integration
        return replace(tight, refined=tight.refined and bool(np.isfinite(error)), error=error)

    def cycles(self, rows: Rows, special: SpecialRows, mass: int, rtol: Any) -> Cycles:
        """See `AbstractOrbit`; special points are integrated more tightly than others."""
        del mass, rtol
        u, p = np.stack([u for _, u, _ in rows]), np.array([[p] for _, _, p in rows])
        seen = self.seen_at(u, p)
        seen += [SeenCycle(e.state, e.period, e.amplitude) for e in (s.extra for _, s in special)]
        state, period, amplitude = jax.tree.map(lambda *leaves: np.stack(leaves), *seen)
        every = np.concatenate([u, *(raw.u[None] for _, raw in special)])
        peaks = np.sinh(every[:, self.z_index])
        switches = self.field.switching(0.0, jnp.zeros(self.n)) is not None
        return state, period, amplitude, peaks if switches else np.full_like(peaks, np.nan)

    special_kind, curve_ends = None, ()

    def meets_more(self, extra: CycleLinearisation) -> bool:
        """See `AbstractOrbit`."""
        del extra
        return False

    def curve_tests(self, *, folds: bool) -> dict[str, Callable[..., float]]:
        """See `AbstractOrbit`."""
        del folds
        return {}

    def beyond(self, ended: str, u: np.ndarray) -> None:
        """See `AbstractOrbit`."""
        del ended, u

    def closing(self, u: Float[Array, " m"]) -> tuple[Float[Array, " m"], Float[Array, " n"]]:
        """(the residual after the whole period, the amplitudes)."""
        end, _, (amplitude,) = flow(
            *self.unpack(u), rtol=self.rtol, solver=self.solver, observers=[Amplitude()]
        )
        return self.gap(u, end), amplitude

    def gap(self, u: Float[Array, " m"], end: State, *parameter: Any) -> Float[Array, " m"]:
        """The residual, given the state after a period."""
        field, state, _ = self.unpack(u, *parameter)
        contact, rows = min(field.contact, self.m - 1), jnp.asarray(self.solved, int)
        known = zip(end, state, self.of_variables, strict=True)
        gaps = [(after - before) / unit for after, before, unit in known]
        belt, width = _layer(field, state[contact])
        if width is not None:
            # To first order a gap of z, but linear in v, for convergence far from the orbit.
            missed = end[contact] - state[contact]
            gaps[contact] = missed / jnp.hypot(state[contact] - belt, width)
        gaps = jnp.concatenate([gap[rows] for gap in gaps])
        if self.forcing_periods is not None:
            return gaps
        if not self.balanced:
            slowing = field.second_rate(0.0, state)[self.mass] / self._unit_of_speed
            gaps = jnp.append(gaps, slowing * self.of_time)
        gaps = gaps / self._speed(field, state)
        if self.is_family and parameter:
            gaps = gaps.at[self._lost].set(u[-1] - jnp.log(parameter[0]))
        return gaps

    @property
    def _unit_of_speed(self) -> Any:
        return self.of_variables[0] / self.of_time

    def _speed(self, field: AbstractModel, state: State) -> Any:
        """The velocity of the mass where the orbit is cut."""
        return field.value_and_rate(0.0, state)[1][self.mass] / self._unit_of_speed

    @property
    def _own(self) -> np.ndarray:
        """The masses whose unknown is the logarithm of the greatest velocity, for a family.

        So it ends at a small amplitude, and does not go on into its mirror image.
        """
        return np.array(self.images) == self.images[self.mass]

    @property
    def _lost(self) -> int:
        """The index in `gap` of that of the greatest velocity."""
        contact = min(self.field.contact, self.m - 1)
        return contact * len(self.solved) + self.solved.index(self.mass)


def _layer(field: AbstractModel, v: Array) -> tuple[Any, Any]:
    """(velocity v_d at which friction switches, sign(v_d) eps); (None, None) without switching."""
    switching = field.switching(0.0, jnp.zeros_like(v))
    if switching is None:
        return None, None
    return -switching[0], field.belt_direction() * switching[1]


class _Round(NamedTuple):
    best: Iterate
    start: Float[Array, " m"]  # of the next search
    goes_on: Bool[Array, ""]


def newton_minimal_period(
    equations: Any,
    linearise: Linearise,
    start: Float[Array, " m"],
    weights: Float[Array, " m"],
    *,
    limit: Any,
    fine: float,
    closed: Callable[[Iterate], Bool[Array, ""]],
    least_damping: float = 0.5,
) -> Iterate:
    """Newton's method for an orbit with its minimal period; one integration is compiled.

    Once the orbit is `closed`, the search continues until a step is shorter than `fine` (1 + |u|)
    or no longer helps, halved down to `least_damping`.  If the orbit also returns after a fraction
    of its period, it is solved for again with that fraction (with at most `limit` integrations),
    and the result is kept if it is the same orbit.  A forced orbit keeps a multiple of the period
    of the force, and its whole period if the equations have `forcing_periods`.  `equations` have
    `pack`, `unpack` and `forcing_periods`; `aux` of `linearise` has `returned`, a `Returned`.
    """
    # Traced once, for its shapes and for the loop.
    linearise = eqx.filter_closure_convert(linearise, start)
    nothing = begin(linearise, start)

    def going(now: Iterate) -> Array:
        done = now.length <= fine * (1.0 + size(now.u, weights))
        hopeless = now.refused & (now.damping <= least_damping)
        return ~done & ~(hopeless & closed(now)) & (now.evaluations < limit)

    def round_(now: _Round) -> _Round:
        end = newton_steps(linearise, nothing._replace(u=now.start), weights, going)
        count, returned = now.best.evaluations + end.evaluations, end.aux.returned
        field, state, period = equations.unpack(end.u)
        same = closed(end) & returned.same(field, equations.unpack(now.best.u)[1], state)
        good = (now.best.evaluations == 0) | same
        best = where(good, end, now.best)._replace(evaluations=count)
        times = returned.times_round
        again = good & closed(end) & (times > 1) & (equations.forcing_periods is None)
        if (forced := field.forcing_period()) is not None:
            forcing_periods = period / times / forced
            again &= jnp.abs(forcing_periods - jnp.round(forcing_periods)) < 1e-6
        return _Round(best, equations.pack(state, period / times), again)

    first = _Round(nothing, start, jnp.asarray(True))
    return lax.while_loop(lambda now: now.goes_on, round_, first).best


def greatest_gap(now: Iterate) -> Float[Array, ""]:
    """max |F| at the present iterate; infinite if the first integration failed."""
    return jnp.where(jnp.isfinite(now.length), jnp.max(jnp.abs(now.value)), jnp.inf)
