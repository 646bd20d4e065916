"""Places of cells, their contacts and stops: how far each is from an event, and what one changes.

A stop is like a contact that slides with w = gap - e . q: its landing is an impact, at which
velocities jump.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._types import State
from ..model.contacts import along
from ..solvers.dry_friction import (
    STICK,
    motion,
    nominal_limit,
    scaled_force,
    slip_speed,
    thrown,
)

# Touches are at odd indices; only special cycles have them.
EVENTS = ("landing", "peak", "release", "turn", "at once")
# A margin of rounding.
MET = 1e-9


def belts(model: Any, n: int) -> Array:
    """v_d of each place at the time 0; 0 of stops."""
    speeds = [contact.speed_at(0.0) for contact in model.frictional_contacts]
    return jnp.concatenate(
        [jnp.broadcast_to(a, (n,)) for a in (*speeds, *[0.0] * len(model.stops))]
    )


def scales(model: Any, n: int) -> Array:
    """What w of contacts and the gaps of stops are measured by, in the units of the model.

    V + |v_d| and T V + |gap|, with the times and velocities T and V of `natural_scales`.
    """
    time, unit, _ = model.natural_scales()
    contacts = jnp.full(n * len(model.frictional_contacts), unit)
    own = [time * unit + jnp.abs(jnp.broadcast_to(stop.gap, (n,))) for stop in model.stops]
    return jnp.concatenate([contacts, *own]) + jnp.abs(belts(model, n))


def limits(model: Any, n: int) -> Array:
    """The static limit of contacts, see `nominal_limit`; 1 of stops."""
    contacts = n * len(model.frictional_contacts)
    own = jnp.broadcast_to(nominal_limit(model), (contacts,))
    return jnp.concatenate([own, jnp.ones(stops_of(model, n))]) if model.stops else own


def at_places(model: Any, t: Any, y: State, modes: Any) -> tuple[Array, Array]:
    """(w of contacts and gap - e . q of stops, r) of each place in its mode."""
    contacts = modes[: modes.size - stops_of(model, y[0].size)]
    w, r = slip_speed(model, t, y), scaled_force(model, t, y, contacts)
    if not model.stops:
        return w, r
    gaps = [stop.gap - along(stop.direction, y[: len(y) // 2]) for stop in model.stops]
    return jnp.concatenate([w, *gaps]), jnp.concatenate([r, *(0.0 * gap for gap in gaps)])


def motion_in(model: Any, t: Any, y: State, modes: Any) -> State:
    """y' in the modes of the places."""
    return motion(model, t, y, modes[: modes.size - stops_of(model, y[0].size)])


def thrown_at(model: Any, z: Array, m: int, event: Any, place: Any) -> Array:
    """(t, y) after an event, which may be an impact."""
    if not model.stops:
        return z
    y = tuple(jnp.split(z[1:], m))
    n = y[0].size
    index = place - n * len(model.frictional_contacts)
    hits = (jnp.arange(stops_of(model, n)) == index) & (event == EVENTS.index("landing"))
    return jnp.concatenate([z[:1], *thrown(model, y, hits)])


def places_of_a_cell(model: Any) -> int:
    """The number of places of a cell."""
    return len(model.frictional_contacts) + len(model.stops)


def stops_of(model: Any, n: int) -> int:
    """The number of places of stops of n cells."""
    return n * len(model.stops)


def outside(mode: Any, w: Any, rises: Any, r: Any, limit: Any, scale: Any) -> Array:
    """By what share places are outside of the bands of their modes, negative within."""
    speed = jnp.where(mode == STICK, jnp.abs(w), -mode * w) / scale
    force = jnp.where(mode == STICK, jnp.abs(r) / limit - 1.0, -mode * rises / scale)
    return lax.stop_gradient(jnp.where(jnp.abs(w) / scale > MET, speed, force))
