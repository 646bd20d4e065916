"""Where a cell touches something: contacts with friction, and stops that it hits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import (
    check_finite,
    check_kind,
    check_nonnegative,
    check_number,
    check_per_mass,
    check_positive,
    is_traced,
    named,
    numbers_of,
    shown,
    to_float,
)
from .._printing import PrintedAsCall
from .._types import PerMass, State
from .drives import as_drive, check_drive
from .friction import AbstractFriction, AbstractFrictionLaw, TanhFriction, as_law


def _direction(value: Any) -> tuple[float, ...]:
    """The converter of e: numbers of Python, so that zeros cost nothing."""
    found = numbers_of("direction", value)
    if found is None or found.ndim > 1 or not np.any(found) or not np.all(np.isfinite(found)):
        raise ValueError(
            "Argument `direction` must hold a finite number for each displacement of a cell, not "
            f"all 0, such as (1, -1) for the first against the second, but is {shown(value)}."
        )
    return tuple(map(float, np.atleast_1d(found)))


def along(direction: Sequence[float], parts: Sequence[Any]) -> Any:
    """e . q, without the displacements that do not take part."""
    terms = [q if e == 1.0 else e * q for e, q in zip(direction, parts, strict=True) if e]
    return sum(terms[1:], start=terms[0])


def friction_law(friction: Any) -> Any:
    """The converter of dry friction, smoothed friction, or None."""
    return as_law(friction) if isinstance(friction, AbstractFrictionLaw) else friction


class Contact(PrintedAsCall, eqx.Module):
    """One contact with friction of each cell, which slides along a direction e.

    Its sliding velocity is w = e . q' - v_d, and the force on the displacements is -e lambda with

        sliding   lambda = p mu(|w|) sign(w),        sticking   |lambda| <= p mu_st.

    **Arguments:**

    - `direction` = e, a number for each displacement of a cell: (1, 0) for the first against a
      belt, (1, -1) for the first against the second.
    - `friction`: a law of `jaxchain.model` for dry friction, or `TanhFriction`.
    - `normal_load` = p >= 0: a number, one for each cell, or a function of t or of (t, q, v), the
      tuples of displacements and velocities; where it is negative the contact has lifted off.
    - `belt_speed` = v_d: a number, one for each cell, or a function of t.

    **Raises:** `ValueError` for anything else.

    !!! example

        A block on a block on a belt:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import StickTime, simulate
        >>> from jaxchain.model import Contact, MechanicalCells, StaticKinetic
        >>> law = StaticKinetic(mu_static=0.5, mu_kinetic=0.3)
        >>> blocks = MechanicalCells(
        ...     [[1.0, 0.0], [0.0, 0.2]], mass=[1.0, 0.5],
        ...     contacts=[Contact((1, 0), law, 1.5, 0.2), Contact((-1, 1), law, 0.5)],
        ... )
        >>> start = tuple(jnp.zeros((4, 1)))
        >>> run = simulate(blocks, start, 20.0, observe=[StickTime(contact=i) for i in (0, 1)])
        >>> [round(float(time[0]), 3) for time in run.observed]
        [7.755, 20.0]
    """

    direction: tuple[float, ...] = eqx.field(converter=_direction, static=True)
    friction: AbstractFriction = eqx.field(converter=friction_law)
    normal_load: Any = eqx.field(converter=as_drive("normal_load"), default=1.0)
    belt_speed: Any = eqx.field(converter=as_drive("belt_speed"), default=0.0)

    def __check_init__(self) -> None:
        wanted = "a friction law (dry friction) or `TanhFriction(law, width)`"
        check_kind("friction", self.friction, AbstractFriction, wanted)
        if not self.moving:
            check_finite("belt_speed", self.belt_speed)
        if not self.varying:
            check_nonnegative("normal_load", self.normal_load, "a mass cannot pull at the belt.")
        # A law may also hold a network.
        check_per_mass(**{k: a for k, a in self.numbers().items() if eqx.is_array_like(a)})

    @property
    def law(self) -> AbstractFrictionLaw:
        """The friction law mu(s), without smoothing."""
        friction: Any = self.friction
        return friction.law

    @property
    def dry(self) -> bool:
        """Whether friction is a law without smoothing."""
        return not isinstance(self.friction, TanhFriction)

    @property
    def width(self) -> PerMass:
        """eps, 0 with dry friction."""
        numbers = self.friction.parameters()
        return to_float(0.0) if self.dry else numbers["width"]

    @property
    def moving(self) -> bool:
        """Whether the belt's speed is a function of time."""
        return callable(self.belt_speed)

    @property
    def varying(self) -> bool:
        """Whether the load is a function of time or of the state."""
        return callable(self.normal_load)

    @property
    def displacement(self) -> int | None:
        """The displacement whose velocity slides on the belt; None for a difference of several."""
        others = sum(e != 0.0 for e in self.direction) > 1
        return None if others or 1.0 not in self.direction else self.direction.index(1.0)

    def speed_at(self, t: Any) -> Any:
        """v_d."""
        return self.belt_speed(t) if self.moving else self.belt_speed

    def acceleration_at(self, t: Any) -> Any:
        """v_d' of a belt that is moving."""
        now = jnp.asarray(t, float)
        return jax.jvp(self.speed_at, (now,), (jnp.ones_like(now),))[1]

    def load_at(self, t: Any, y: State) -> Any:
        """p, at least 0: where a function is negative the contact has lifted off."""
        if not self.varying:
            return self.normal_load
        pressed: Any = self.normal_load(t, y[: len(y) // 2], y[len(y) // 2 :])
        return jnp.maximum(pressed, 0.0)

    def force_at_rest(self, rest: State, stiffness: Any) -> Any:
        """The force that counts as 1: the load at t = 0."""
        del stiffness
        return self.load_at(jnp.zeros(()), rest)

    def slip(self, t: Any, y: State) -> Array:
        """w = e . q' - v_d."""
        return along(self.direction, y[len(y) // 2 :]) - self.speed_at(t)

    def drop(self) -> Any:
        """By what share of p friction falls at a release; None if it cannot."""
        return self.law.drop()

    def numbers(self) -> dict[str, Any]:
        """Its parameters by name."""
        own = {"normal_load": self.normal_load, "belt_speed": self.belt_speed}
        return self.friction.parameters() | {k: a for k, a in own.items() if not callable(a)}


class Stop(PrintedAsCall, eqx.Module):
    """A rigid stop that each cell can hit: e . q <= gap.

    Where e . q reaches the gap with the velocity e . q' > 0 the velocities jump,

        q'_+ = q'_- - (1 + R) M^{-1} e (e . q') / (e . M^{-1} e),

    so that e . q'_+ = -R e . q'_-: Newton's law of impact, without friction during it.  Contacts
    that the jump moves slide on.

    **Arguments:** `direction` = e, a number for each displacement of a cell, (-1, 0) for a stop
    below the first; `gap`, one number or one for each cell; `restitution` = R, above 0 and at most
    1.  For an elastic stop give `local_force` a force that grows beyond the gap.

    Bounces that follow each other infinitely often, until the mass rests on the stop, end a run as
    `bounces_accumulate`.

    **Raises:** `ValueError` for anything else.

    !!! example

        A ball of weight 1 falls from the height 1/2, and bounces:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import simulate
        >>> from jaxchain.model import MechanicalCells, Stop
        >>> floor = Stop(-1.0, gap=0.5, restitution=0.8)
        >>> ball = MechanicalCells(0.0, force=lambda t: -1.0, stops=[floor])
        >>> run = simulate(ball, (jnp.zeros(1), jnp.zeros(1)), 1.8)  # it is at the top again
        >>> [round(float(part[0]), 6) for part in run.state]
        [-0.18, 0.0]
    """

    direction: tuple[float, ...] = eqx.field(converter=_direction, static=True)
    gap: Array = eqx.field(converter=named("gap"))
    restitution: Array = eqx.field(converter=named("restitution"), default=1.0)

    def __check_init__(self) -> None:
        check_finite("gap", self.gap)
        check_per_mass(gap=self.gap)
        check_number("restitution", self.restitution)
        remedy = "a mass that stays at a stop needs an elastic one, a `local_force`."
        check_positive("restitution", self.restitution, remedy)
        if not is_traced(self.restitution) and float(self.restitution) > 1.0:
            raise ValueError(
                f"Argument `restitution` must be at most 1, but is {shown(self.restitution)}: an "
                "impact gives no energy."
            )

    def force_at_rest(self, rest: State, stiffness: Any) -> Any:
        """The force that counts as 1: stiffness times gap."""
        del rest
        return stiffness * jnp.abs(self.gap)

    def numbers(self) -> dict[str, Any]:
        """Its parameters by name."""
        return {"gap": self.gap, "restitution": self.restitution}


def check_contacts(contacts: Sequence[Contact], stops: Sequence[Stop], d: int, n: Any) -> None:
    """Raises `ValueError` for contacts and stops that do not fit cells of d displacements."""
    kinds = (("contacts", contacts, Contact), ("stops", stops, Stop))
    for name, items, kind in kinds:
        for i, item in enumerate(items):
            check_kind(f"{name}[{i}]", item, kind, f"a `{kind.__name__}`")
            if len(item.direction) != d:
                raise ValueError(
                    f"Argument `{name}[{i}].direction` must have an entry for each of the {d} "
                    f"displacements, but is {item.direction}."
                )
            for k, value in item.numbers().items():
                if np.shape(value) not in ((), (n or np.size(value),)):
                    raise ValueError(
                        f"Argument `{name}[{i}].{k}` must be one number, or one for each of the "
                        f"cells, but has shape {np.shape(value)}."
                    )
    for i, contact in enumerate(contacts):
        check_drive(f"contacts[{i}].belt_speed", contact.belt_speed, contact.speed_at, n)
        rest = (jnp.zeros(n or 1),) * (2 * d)
        pressed: Any = contact.normal_load

        def load(t: Any, contact: Contact = contact, rest: Any = rest) -> Any:
            return contact.load_at(t, rest)

        check_drive(f"contacts[{i}].normal_load", pressed, load, n)
    if len({contact.dry for contact in contacts}) > 1:
        raise ValueError(
            "Argument `contacts` must have dry friction in all of them, or smoothed friction in "
            "all of them: leave out the widths, or give each law one."
        )
    if stops and not all(contact.dry for contact in contacts):
        raise ValueError(
            "Argument `stops` needs dry friction: only event-driven runs find impacts. Give the "
            "friction law itself, without a width."
        )
