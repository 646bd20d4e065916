"""Masses with dry friction: the equations of sticking and sliding.

A mass sticks to the belt, slides forward (w = v - v_d > 0) or slides backward (w < 0):

    sliding   v' = r - sign(w) p mu(|w|),    until w = 0
    sticking  v  = v_d,                      until |r| = p mu_st,   mu_st >= mu(0)

with r = -2 xi v - k x + C x, the force on the mass without friction.  Where w reaches 0 the mass
sticks if |r| <= p mu_st and slides on in the direction of r otherwise (Filippov's solution of the
set-valued equations; it is unique forward in time).  Between two such events the motion is
analytic, and given here as a Taylor series.  The belt's speed may be a function of time, the load
also one of the state: then v = v_d(t) while a mass sticks, and r is less by v_d'.

In `MechanicalCells` a unit force at the contact gives the displacements of a cell the
accelerations b = M^{-1} e_u.  With the accelerations a without friction, r = a_u / b_u, and
v' = a - b p mu(|w|) sign(w) while it slides, v' = a - b r while it sticks.

Several contacts of a cell act together: v' = a - sum_c b_c lambda_c with b_c = M^{-1} e_c.  The
forces of those that stick follow from w_c' = 0 for all of them, a linear system with the matrix
e_c . b_c', which is positive definite unless they hold the same displacements twice.  One contact
of a cell changes its mode at a time.  If this leaves another one outside of its band, that one
follows in a step of no length: so the modes after the event are found by principal pivoting.

A stop is hit where gap - e . q reaches 0; the velocities jump there, and contacts that the jump
moves slide on.

Arrays of the contacts have the shape (contacts n,), those of the first contact first; those of
events have the stops after the contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._computed_once import flatten
from .._types import PerMass, State
from ..model.chain import Chain
from ..model.contacts import Contact, Stop, along
from ..model.friction import spread_friction
from ..model.mechanical import MechanicalCells
from ..model.tridiagonal import factor, substitute
from .taylor import (
    CLEARANCE,
    FAR,
    evaluated,
)

Dry: TypeAlias = Chain | MechanicalCells

STICK, FORWARD, BACKWARD = 0.0, 1.0, -1.0
# Shares of the natural scale below which a speed or a force is rounding.
RESOLUTION = 1e-13
# Sticking friction exceeds p mu_st by this share, so that a mass that starts to stick exactly at
# the limit is not released by rounding.
SLACK = 1e-13
# A pivot below this share of its diagonal is rounding: contacts hold the same displacements twice.
_DEPENDENT = 1e-10


def each_of(stacked: Array, count: int) -> list[Array]:
    """The parts of an array of several contacts."""
    return [stacked] if count == 1 else jnp.split(stacked, count) if count else []


def joined(parts: Sequence[Any], like: Array) -> Any:
    """One array of those of several contacts; that of one contact as it is."""
    if len(parts) == 1:
        return parts[0]
    shape = like.shape
    return jnp.concatenate([*(jnp.broadcast_to(part, shape) for part in parts), jnp.zeros(0)])


def alone(chain: Dry) -> bool:
    """Whether cells have one contact only, at a belt, and no stop."""
    return only_displacement(chain) is not None


def unique(chain: Dry, modes: Modes, y: State) -> Bool[Array, ""]:
    """Whether no cell is held in more ways than one."""
    return ~jnp.any(Held(chain, modes.direction, y[0]).singular)


def only_displacement(chain: Dry) -> int | None:
    """The sliding displacement of cells with one contact, at a belt, and no stop; else None."""
    contacts = chain.frictional_contacts
    return contacts[0].displacement if len(contacts) == 1 and not chain.stops else None


def static_limit(chain: Dry, t: Any, y: State) -> Array:
    """p mu_st, and a little more: see `SLACK`."""
    contacts = chain.frictional_contacts
    limits = [c.load_at(t, y) * c.law.mu_static * (1.0 + SLACK) for c in contacts]
    return limits[0] if len(limits) == 1 else joined(limits, y[0])


def slip_speed(chain: Dry, t: Any, y: State) -> Array:
    """w, the velocity of a mass relative to the belt."""
    return joined([c.slip(t, y) for c in chain.frictional_contacts], y[0])


def modes_at(chain: Dry, t: Any, y: State) -> Array:
    """The modes of contacts in a state of a run, in which w of those that stick is rounding."""
    unit = chain.natural_scales()[1]
    belts = joined([c.speed_at(t) for c in chain.frictional_contacts], y[0])
    w = slip_speed(chain, t, y)
    return jnp.where(
        jnp.abs(w) <= 100.0 * RESOLUTION * (unit + jnp.abs(belts)), STICK, jnp.sign(w)
    )


def modes_at_rest(chain: Dry) -> Array:
    """The modes of contacts of cells at rest, which their belts slide past."""
    speeds = [jnp.asarray(c.speed_at(0.0), float) for c in chain.frictional_contacts]
    return jnp.sign(-joined(speeds, jnp.zeros(chain.n or 1)))


def _belt_acceleration(contact: Contact, t: Any) -> Any:
    return contact.acceleration_at(t) if contact.moving else None


def weighted_sum(direction: Sequence[float], parts: Sequence[Any]) -> Any:
    """e . parts, of which some are None for 0."""
    both = zip(direction, parts, strict=True)
    terms = [a if e == 1.0 else e * a for e, a in both if e and a is not None]
    return sum(terms[1:], start=terms[0]) if terms else 0.0


class Held:
    """The forces of the contacts of each cell in their modes.

    `singular` (n,): whether those that stick hold the same displacements twice.
    """

    def __init__(self, chain: Dry, direction: Array, like: Array):
        self.contacts = chain.frictional_contacts
        count = len(self.contacts)
        self.reach = [chain.inverse_mass(c) for c in self.contacts]
        self.gram = [[weighted_sum(c.direction, b) for b in self.reach] for c in self.contacts]
        self.sticks = [part == STICK for part in each_of(direction, count)]
        none, matrix = jnp.zeros_like(like), []
        for c, row in enumerate(self.gram):
            matrix.append([])
            for k, entry in enumerate(row):
                both = self.sticks[c] & self.sticks[k]
                matrix[c].append(jnp.where(both, entry, 1.0 if c == k else 0.0) + none)
        lu, self.singular = factor(matrix), jnp.zeros(like.shape, bool)
        for c, row in enumerate(lu):
            lost = row[c] <= _DEPENDENT * matrix[c][c]
            self.singular = self.singular | lost
            row[c] = jnp.where(lost, 1.0, row[c])
        self.lu = lu

    def forces(self, pulls: Sequence[Any], slides: Sequence[Any]) -> list[Array]:
        """lambda, from e . a - v_d' without friction and the forces of those that slide."""
        found = [jnp.where(s, 0.0, a) for s, a in zip(self.sticks, slides, strict=True)]
        right = []
        for pull, row, sticks in zip(pulls, self.gram, self.sticks, strict=True):
            others = sum((g * a for g, a in zip(row, found, strict=True)), start=0.0)
            right.append(jnp.where(sticks, pull - others, 0.0))
        held = substitute(self.lu, right)
        return [jnp.where(s, h, a) for s, h, a in zip(self.sticks, held, found, strict=True)]

    def less(self, parts: Sequence[Any], forces: Sequence[Any]) -> list[Any]:
        """`parts` - sum_c b_c lambda_c, for accelerations or velocities."""
        parts = [*parts]
        for reach, force in zip(self.reach, forces, strict=True):
            parts = [a if b is None else a - b * force for a, b in zip(parts, reach, strict=True)]
        return parts


def pulls_on(chain: Dry, t: Any, free: Sequence[Array]) -> list[Any]:
    """e . a - v_d' of each contact."""
    pulls = []
    for contact in chain.frictional_contacts:
        pull, belt = weighted_sum(contact.direction, free), _belt_acceleration(contact, t)
        pulls.append(pull if belt is None else pull - belt)
    return pulls


def holding_force(chain: Dry, t: Any, y: State, free: Sequence[Array], direction: Array) -> Any:
    """r, the force on each contact that sticks, from the accelerations without friction.

    One contact need not stick: of cells with one it is the force that would hold it.
    """
    contacts, u = chain.frictional_contacts, only_displacement(chain)
    if u is not None:
        return pulls_on(chain, t, free)[0] / chain.inverse_mass(contacts[0])[u]
    slip = slip_speed(chain, t, y)
    mu, _ = friction_coefficient(chain, slip, direction, slip)
    slides = _slides(chain, t, y, direction, mu)
    return joined(Held(chain, direction, y[0]).forces(pulls_on(chain, t, free), slides), y[0])


def _slides(chain: Dry, t: Any, y: State, direction: Array, mu: Array) -> list[Array]:
    contacts = chain.frictional_contacts
    parts = zip(
        contacts, each_of(direction, len(contacts)), each_of(mu, len(contacts)), strict=True
    )
    return [part * c.load_at(t, y) * own for c, part, own in parts]


def thrown(chain: Dry, y: State, hits: Array) -> State:
    """The state after impacts of the cells in `hits`, at one stop after the other."""
    d, count = len(y) // 2, len(chain.stops)
    v = y[d:]
    for stop, hit in zip(chain.stops, each_of(hits, count), strict=True):
        v = thrown_at_stop(chain, stop, v, hit, stop.restitution)
    return (*y[:d], *v)


def free_force(chain: Dry, t: Any, y: State) -> Array:
    """r, the force that would hold a mass, of cells with one contact."""
    return holding_force(chain, t, y, chain.accelerations(t, y), jnp.zeros_like(y[0]))


def scaled_force(chain: Dry, t: Any, y: State, modes: Any = None) -> Array:
    """r, in such a unit that the static limit is `nominal_limit` also where p varies.

    `modes`: of several contacts, those that stick; the others have their friction.
    """
    modes = jnp.zeros_like(y[0]) if modes is None else modes
    r = holding_force(chain, t, y, chain.accelerations(t, y), modes)
    if not any(contact.varying for contact in chain.frictional_contacts):
        return r
    limit = static_limit(chain, t, y)
    return r * (nominal_limit(chain) / jnp.where(limit > 0, limit, 1.0))  # 0: it has lifted off


def nominal_limit(chain: Dry) -> PerMass:
    """p mu_st, the greatest friction on a contact that sticks; of a nominal load if p varies."""
    contacts, load = chain.frictional_contacts, chain.natural_scales()[2]
    limits = [(load if c.varying else c.normal_load) * c.law.mu_static for c in contacts]
    return limits[0] if len(limits) == 1 else joined(limits, jnp.zeros(chain.n or 1))


def friction_at_rest(chain: Dry, t: Any, y: State, direction: Array) -> Array:
    """The friction force against `direction` of masses with w = 0 in their modes.

    Of cells with one contact.
    """
    (contact,) = chain.frictional_contacts
    slides = direction * contact.load_at(t, y)
    slides = slides * contact.law.coefficient(jnp.zeros_like(direction))
    return jnp.where(direction == STICK, free_force(chain, t, y), slides)


def motion(chain: Dry, t: Any, y: State, direction: Array) -> State:
    """y' of masses in their modes."""
    d, mu = len(y) // 2, []
    # Beyond w = 0 the law is continued, so that a grazing is smooth.
    contacts = chain.frictional_contacts
    for contact, own in zip(contacts, each_of(direction, len(contacts)), strict=True):
        mu.append(contact.law.coefficient(own * contact.slip(t, y)))
    free = chain.accelerations(t, y)
    return (*y[d:], *rates(chain, t, y, free, joined(mu, y[0]), direction))


def rates(
    chain: Dry, t: Any, y: State, free: Sequence[Array], mu: Array, direction: Any
) -> list[Array]:
    """v' of masses in their modes, from the accelerations without friction and mu(|w|)."""
    if (u := only_displacement(chain)) is None:
        held = Held(chain, direction, y[0])
        slides = _slides(chain, t, y, direction, mu)
        return held.less(free, held.forces(pulls_on(chain, t, free), slides))
    (contact,) = chain.frictional_contacts
    b, belt = chain.inverse_mass(contact), _belt_acceleration(contact, t)
    slides = direction * contact.load_at(t, y) * mu
    friction = jnp.where(direction == STICK, holding_force(chain, t, y, free, direction), slides)
    parts = [a if s is None else a - s * friction for a, s in zip(free, b, strict=True)]
    parts[u] = jnp.where(direction == STICK, 0.0 if belt is None else belt, parts[u])
    return parts


class Modes(eqx.Module):
    """The mode of every mass.

    `direction`: STICK, FORWARD or BACKWARD.  `contact`: the power of time with which w leaves 0: 0
    if w is not 0, 1 after passing through w = 0, 2 after sticking; after sticking also 1 if
    friction falls at the release.  `bounced`: the same of stops, 1 after an impact; None without.
    """

    direction: Float[Array, " contacts"]
    contact: Int[Array, " contacts"]
    bounced: Int[Array, " stops"] | None = None


def bounced_of(modes: Modes) -> Any:
    """The power of time with which each stop is left; none without stops."""
    return jnp.zeros(0, int) if modes.bounced is None else modes.bounced


def friction_coefficient(
    chain: Dry, w: Array, direction: Array, since: Array
) -> tuple[Array, list[list[Array]]]:
    """(mu(|w|) of masses in their modes, values that `expand` need not compute again).

    `w`: of the contacts.  A law with knots is evaluated in the piece where w was `since` the start
    of the step, which ends just beyond a knot.
    """
    contacts, found, known = chain.frictional_contacts, [], []
    parts = (each_of(part, len(contacts)) for part in (flatten(w), direction, since))
    for contact, own, sign, before in zip(contacts, *parts, strict=True):
        law, values = spread_friction(contact.law, sign), []
        speed = sign * own
        if law.knots is None:
            mu, values = evaluated(law.coefficient, speed)
        else:
            if (piece := piece_of(law, before)) is not None:
                below, above, offset = piece
                speed = jnp.clip(speed, below + offset, above - offset)
            mu = law.coefficient(speed)
        found.append(mu)
        known.append(values)
    return joined(found, direction[: direction.size // max(len(contacts), 1)]), known


def fastest_knot(law: Any) -> Any:
    """The greatest knot of a law, by which its speeds count; 1 without knots."""
    knots = jnp.asarray(() if law.knots is None else law.knots, float)
    return jnp.max(knots) if knots.size else 1.0


def piece_of(law: Any, w: Array) -> tuple[Array, Array, Array] | None:
    """(knot below |w|, knot above, offset of the friction series); None without knots."""
    knots = jnp.asarray(() if law.knots is None else law.knots, float)
    if knots.size == 0:
        return None
    ahead = CLEARANCE * (fastest_knot(law) + jnp.abs(w))
    knots = jnp.broadcast_to(knots if knots.ndim == 2 else knots[:, None], (len(knots), w.size))
    far = jnp.full((1, w.size), FAR)
    edges = jnp.concatenate([-far, knots, far])
    index = jnp.sum((jnp.abs(w) + ahead)[None] >= knots, axis=0, keepdims=True)
    below, above = (jnp.take_along_axis(edges, index + i, axis=0)[0] for i in (0, 1))
    return below, above, ahead


def thrown_at_stop(
    chain: Dry, stop: Stop, v: Sequence[Array], hit: Array, restitution: Any
) -> list[Array]:
    """The velocities after an impact of the cells in `hit`."""
    reach = chain.inverse_mass(stop)
    impulse = (1.0 + restitution) * along(stop.direction, v) / weighted_sum(stop.direction, reach)
    impulse = jnp.where(hit, impulse, 0.0)
    return [a if b is None else a - b * impulse for a, b in zip(v, reach, strict=True)]
