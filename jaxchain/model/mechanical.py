"""Cells of several displacements: masses, springs, dampers, friction at one of them, forcing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import reduce
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import (
    check_finite,
    check_kind,
    check_known,
    check_nonnegative,
    check_number,
    check_one_of,
    check_per_mass,
    check_positive,
    check_whole,
    is_traced,
    named,
    optional,
    shown,
    to_float,
)
from .._final import final
from .._printing import PrintedAsCall
from .._types import PerMass, ScalarLike, State
from .cells import AbstractCells
from .contacts import Contact, Stop, along, check_contacts, friction_law
from .drives import as_drive, as_function, check_drive, drive_numbers, with_number
from .entries import with_entries
from .friction import AbstractFriction, AbstractFrictionLaw
from .parameters import Parameter
from .springs import Ends
from .tridiagonal import factor, substitute

# The fields with an entry for each displacement, unless they are one number for all of them.
_MATRICES = ("stiffness", "mass", "damping", "coupling", "coupling_damping")
_OF_DISPLACEMENTS = (*_MATRICES, "force")
# The fields that may be functions; the first two also of a contact.
_DRIVES = ("normal_load", "belt_speed", "force", "spring", "local_force")

Parts = tuple[Float[Array, " n"], ...]
# Matrices up to this size are written out entry by entry, so that no zero is multiplied; more
# entries would take minutes to compile (24 displacements 6), and are arrays.
_WRITTEN_OUT = 6
# Shares of a period at which a drive is compared with the next period.
_INSIDE = (0.13, 0.37, 0.81)
# One number, (d,) for a diagonal, (d, d), or (n, d, d) for a matrix of each cell.
Matrix = Float[Array, "..."]


class Added(PrintedAsCall, eqx.Module):
    """`factor` times `matrices`, which are added to those of the same names."""

    matrices: dict[str, Matrix]
    factor: Array = eqx.field(converter=named("factor"), default=0.0)


def _several(name: str) -> Callable[[Any], tuple]:
    """The converter of a list."""

    def convert(items: Any) -> tuple:
        check_kind(name, items, Sequence, "a list, such as [Contact(...), Contact(...)]")
        return tuple(items)

    return convert


def _plus(plus: Any) -> dict[str, Added]:
    """The converter of `plus`: a matrix without a name is added to the stiffness."""
    wanted = '{"friction": matrix} or {"friction": {"stiffness": matrix, "damping": matrix}}'
    check_kind("plus", plus, Mapping, f"a dict of names and matrices, {wanted}")
    added = {}
    for name, part in plus.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"Argument `plus` must have names as keys, but has {shown(name)}.")
        if not isinstance(part, Added):
            given = part if isinstance(part, Mapping) else {"stiffness": part}
            if not given or not given.keys() <= {*_MATRICES}:
                raise ValueError(
                    f"Argument `plus[{name!r}]` must be the matrix that is added to `stiffness`, "
                    f"or a dict of matrices added to {list(_MATRICES)}, but names {[*given]}."
                )
            part = Added({k: to_float(v, f"plus[{name!r}][{k!r}]") for k, v in given.items()})
        added[name] = part
    return added


@final
class MechanicalCells(AbstractCells):
    """Cells of d displacements q with masses, springs, dampers, dry or smoothed friction, forcing.

    M q_n'' + D q_n' + K q_n + (C + B d/dt) (2 q_n - q_{n-1} - q_{n+1})
        = s(q_{n+1} - q_n) - s(q_n - q_{n-1})
        + g(q_n, q_n') + p F(u_n' - v_d) e_u + f cos(omega t),

    where u is the displacement that slides on the belt, number `sliding` of each cell, and e_u its
    unit vector.  A state is (q_1, ..., q_d, q_1', ..., q_d'), each of shape (n,).

    With dry friction `simulate` and `sweep` find every start and end of sticking (`EventDriven`):

        sliding   M q'' = h - p mu(|w|) sign(w) e_u,     w = u' - v_d,
        sticking  u'' = 0,    while |r| <= p mu_st,      r = e_u M^{-1} h / (e_u M^{-1} e_u),

    h being all other forces and r the force that holds the mass.  Of several `contacts` that stick
    the forces follow from the linear system that keeps all their w at 0; where it has many
    solutions, because they hold the same displacements twice, a run ends as `forces_not_unique`.

    **Arguments** (dimensionless, or of any system of units):

    - `stiffness` = K, `mass` = M, `damping` = D, `coupling` = C, `coupling_damping` = B: a number
      (times the unit matrix), shape (d,) for a diagonal, (d, d), or (n, d, d) for a matrix of each
      cell.  M must be symmetric and positive definite; K may be singular or not symmetric.
    - `spring` = s: the force of a nonlinear spring between neighbours, a function (e) of the tuple
      of d elongations that returns d forces, with s(0) = 0.
    - `local_force` = g: further forces on a cell, a function (q, v) of the tuples of its d
      displacements and d velocities.
    - `friction`: a law of `jaxchain.model` for dry friction, or `TanhFriction`; `belt_speed` = v_d
      and `normal_load` = p >= 0; `sliding`, which displacement slides, counted from 0.
    - `contacts`: instead of `friction`, a list of `Contact`s, each with its own direction, law,
      load and belt; `stops`: a list of `Stop`s, rigid ones that the cell bounces off.
    - `force` = f, one number or shape (d,); `frequency` = omega > 0.
    - Instead of a number `force` may be a function of t (or a `Table`) that returns one force or d
      of them, without the cosine; `belt_speed` a function of t; `normal_load` one of t, or of (t,
      q, v), the tuples of displacements and velocities: where it is negative the contact has
      lifted off.  With `frequency` these have the period 2 pi / omega, which cycles need.
    - `plus`: parameters that multiply further matrices, by name.  `plus={"friction": Kf}` makes
      K + friction Kf of the stiffness K; `plus={"friction": {"stiffness": Kf, "damping": Df}}`
      adds to several of the four matrices, whose shapes Kf and Df may have.  Each parameter is 0
      until `with_(friction=0.3)` sets it.
    - `ends`: "cyclic" or "free"; `names` of the displacements.

    `spring` and `local_force` are functions, or `equinox.Module`s whose parameters are fields;
    they compute all cells side by side.  What JAX traces in the closure of a function, such as a
    number by which you differentiate, becomes a part of the cells, as a field would.

    `with_` changes parameters by their names, and entries of arrays by names such as
    "stiffness[0, 1]", counted from 0; off the diagonal of M it sets both entries.  Where the cells
    hold an array over displacements, it refuses one number, which would act on all displacements;
    `normal_load` and the parameters of the friction law are one for all cells or one for each.

    **Raises:** `ValueError` for anything else.

    !!! example

        A mass on a belt that can also move normal to it; dry friction makes it stick and slip:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, ExponentialDecay, simulate
        >>> from jaxchain.model import MechanicalCells
        >>> law = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5)
        >>> matrix = jnp.array([[1.0, 0.3], [0.3, 2.0]])
        >>> cells = MechanicalCells(matrix, damping=0.1, friction=law, belt_speed=0.5)
        >>> start = tuple(jnp.zeros((4, 1)))
        >>> run = simulate(cells, start, 100.0, observe=Amplitude(window=20.0, component=1))
        >>> round(float(run.observed[0]), 4)
        0.1931

        Friction couples two modes of a sliding mass, K + mu Kf, and makes them flutter:

        >>> from jaxchain.boundaries import find_hopf_point
        >>> Kf = jnp.array([[0.0, -1.0], [0.0, 0.0]])
        >>> pads = MechanicalCells([[2.0, 0.5], [0.5, 1.0]], damping=0.1, plus={"friction": Kf})
        >>> flutter = find_hopf_point(pads, "friction", start, bounds=(0.0, 2.0))
        >>> round(float(flutter.value), 4)
        1.03
    """

    stiffness: Matrix = eqx.field(converter=named("stiffness"))
    mass: Matrix = eqx.field(converter=named("mass"), default=1.0)
    damping: Matrix = eqx.field(converter=named("damping"), default=0.0)
    coupling: Matrix | None = eqx.field(converter=optional("coupling"), default=None)
    spring: Callable[..., Any] | None = eqx.field(converter=as_function("spring"), default=None)
    local_force: Callable[..., Any] | None = eqx.field(
        converter=as_function("local_force"), default=None
    )
    friction: AbstractFriction | None = eqx.field(converter=friction_law, default=None)
    belt_speed: Any = eqx.field(converter=as_drive("belt_speed"), default=0.0)
    normal_load: Any = eqx.field(converter=as_drive("normal_load"), default=1.0)
    force: Any = eqx.field(converter=as_drive("force"), default=None)
    frequency: Array | None = eqx.field(converter=optional("frequency"), default=None)
    sliding: int = eqx.field(static=True, default=0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    names: tuple[str, ...] | None = eqx.field(
        converter=lambda names: tuple(names) if isinstance(names, list) else names,
        static=True,
        default=None,
    )
    n: int | None = eqx.field(static=True, default=None)
    coupling_damping: Matrix | None = eqx.field(
        converter=optional("coupling_damping"), default=None
    )

    plus: dict[str, Added] | None = eqx.field(
        converter=lambda plus: None if plus is None else _plus(plus), default=None
    )
    contacts: tuple[Contact, ...] = eqx.field(converter=_several("contacts"), default=())
    stops: tuple[Stop, ...] = eqx.field(converter=_several("stops"), default=())
    _symmetric = ("mass",)

    def __post_init__(self) -> None:
        if self.n is None:  # known from a matrix for each cell, or a load or law for each
            matrices = [getattr(self, name) for name in _MATRICES]
            counts = [np.shape(a)[0] for a in matrices if a is not None and np.ndim(a) == 3]
            friction = self.friction if isinstance(self.friction, AbstractFriction) else None
            each = [*(friction.parameters().values() if friction else ())]
            each += [] if callable(self.normal_load) else [self.normal_load]
            parts = *_several("contacts")(self.contacts), *_several("stops")(self.stops)
            each += [a for part in parts for a in getattr(part, "numbers", dict)().values()]
            self.n = max(
                [*counts, *(np.shape(a)[0] for a in each if np.ndim(a) == 1)], default=None
            )

    def __check_init__(self) -> None:
        check_one_of("ends", self.ends, get_args(Ends))
        d = self.d
        for name, value in self._all_matrices().items():
            check_finite(name, value)
            if value.shape[-2:] not in ((), (d,), (d, d)) or value.ndim > 3:
                raise ValueError(
                    f"Argument `{name}` must be one number, or of shape ({d},), ({d}, {d}) or "
                    f"(n, {d}, {d}) for {d} displacements, but has shape {value.shape}."
                )
        check_whole("sliding", self.sliding, 0, d - 1, "it counts displacements from 0.")
        if self.names is not None and len(self.names) != d:
            raise ValueError(f"Argument `names` must have {d} names, but is {self.names}.")
        for name, added in (self.plus or {}).items():
            check_number(name, added.factor)
            taken = {f.name for f in fields(self)} | set(super().parameters())
            if name in taken and not (name == "friction" and self.friction is None):
                raise ValueError(
                    f"Argument `plus` must have names of its own, but has `{name}`, which is one "
                    "of these cells: rename it."
                )
        if not is_traced(self.mass, self.plus):
            whole = _dense(self.mass, d)
            for added in (self.plus or {}).values():
                if "mass" in added.matrices:
                    whole = whole + float(added.factor) * _dense(added.matrices["mass"], d)
            skew = np.max(np.abs(whole - np.swapaxes(whole, -1, -2)))
            # A product such as R R^T, or a file with nine digits, is symmetric up to rounding.
            rounding = 1e-9 * np.max(np.abs(whole))
            if skew > rounding or np.min(np.linalg.eigvalsh(whole)) <= 0:
                raise ValueError(
                    "Argument `mass` must be symmetric and positive definite, but is "
                    f"{whole.tolist() if whole.size < 10 else shown(whole)}: "
                    "a displacement without mass has no rate."
                )
        per_cell = {}
        if not callable(self.belt_speed):
            check_number("belt_speed", self.belt_speed)
        if not callable(self.normal_load):
            check_nonnegative("normal_load", self.normal_load, "a mass cannot pull at the belt.")
            per_cell["normal_load"] = self.normal_load
        if self.friction is not None:
            wanted = "None, a friction law (dry friction) or `TanhFriction(law, width)`"
            check_kind("friction", self.friction, AbstractFriction, wanted)
        for name, usual in zip(_DRIVES, (1.0, 0.0), strict=False):
            given: Any = getattr(self, name)
            known = callable(given) or not is_traced(given)
            if self.contacts and known and (callable(given) or np.any(given != usual)):
                raise ValueError(
                    f"Argument `{name}` must be left out beside `contacts`, which have their own: "
                    f"give it to each `Contact(..., {name}=...)`."
                )
        check_contacts(self.contacts, self.stops, d, self.n)
        if self.friction is not None and self.contacts:
            raise ValueError(
                "Arguments `friction` and `contacts` exclude each other: give all contacts in "
                "`contacts`, the first one as `Contact((1, ...), friction, normal_load, "
                "belt_speed)`."
            )
        if self.stops and self.friction is not None and not self.dry:
            raise ValueError(
                "Argument `stops` needs dry friction, because only event-driven runs find "
                "impacts: give `friction` without a width."
            )
        force: Any = self.force
        waves = force is not None and not callable(force)  # f cos(omega t)
        drives = [(c.normal_load, c.belt_speed) for c in (self, *self.contacts)]
        driven = waves or any(map(callable, (force, *sum(drives, ()))))
        timed = self.frequency is not None
        if (waves and not timed) or (timed and not driven):
            raise ValueError(
                "Arguments `force` and `frequency` belong together, but are "
                f"{shown(self.force)} and {shown(self.frequency)}: give both or neither."
            )
        if self.frequency is not None:
            check_positive("frequency", self.frequency)
            check_number("frequency", self.frequency)
        self._check_drives()
        if waves:
            check_finite("force", force)
            if np.shape(force) not in ((), (d,)):
                raise ValueError(
                    f"Argument `force` must be one number or of shape ({d},), but has shape "
                    f"{np.shape(force)}."
                )
        if self.friction is not None:
            per_cell |= self.friction.parameters()
        for name, value in self._all_matrices().items():
            if value.ndim == 3:
                per_cell[name] = value[:, 0, 0]
        check_per_mass(**per_cell)
        lengths = {name: len(a) for name, a in per_cell.items() if np.ndim(a)}
        if self.n is not None:
            check_whole("n", self.n, remedy="it is the number of cells.")
        for name, length in lengths.items():
            if self.n not in (None, length):
                raise ValueError(
                    f"Argument `{name}` has {length} entries, but there are `n` = {self.n} cells: "
                    "give one number, or one for each."
                )
        at_rest = (jnp.zeros(1),) * d
        self._check_law("spring", self.spring, "e", at_rest)
        self._check_law("local_force", self.local_force, "q, v", at_rest, at_rest)
        rest = () if self.spring is None else self.spring(at_rest)
        if not (is_traced(rest) or all(np.all(f == 0) for f in rest)):
            raise ValueError(
                "Argument `spring` must return forces that vanish without elongation, but "
                f"returns {[str(f) for f in rest]}: springs beyond free ends exert no force."
            )

    def _check_drives(self) -> None:
        """Raises `ValueError` for a function of time that returns something else than forces."""
        rest = (jnp.zeros(self.n or 1),) * (2 * self.d)
        calls: dict[str, Callable[[Any], Any]] = {}
        for name, contact in {"": self, **_numbered("contacts", self.contacts)}.items():
            speed, pressed = contact.belt_speed, contact.normal_load
            if callable(speed):
                calls[f"{name}belt_speed"] = speed
            if callable(pressed):
                calls[f"{name}normal_load"] = lambda t, p=pressed: p(
                    t, rest[: self.d], rest[self.d :]
                )
        for name, call in calls.items():
            check_drive(name, call, call, self.n)
        if callable(self.force):
            calls["force"] = self._drive_at
            try:
                jax.eval_shape(self._drive_at, jnp.zeros(()))
            except (TypeError, ValueError, IndexError) as error:
                raise ValueError(
                    "Argument `force` must be a function (t) that returns one force, or "
                    f"{self.d}, but gives {shown(error)}."
                ) from error
        if self.frequency is None or is_traced(self.frequency):
            return
        period = 2.0 * np.pi / float(self.frequency)
        for name, call in calls.items():
            if is_traced(call, self.force, self.normal_load, self.belt_speed, self.contacts):
                continue
            with jax.ensure_compile_time_eval():
                ends = [
                    [np.asarray(part) for part in jax.tree.leaves(call(now))]
                    for share in _INSIDE
                    for now in (share * period, (share + 1.0) * period)
                ]
            pairs = zip(ends[::2], ends[1::2], strict=True)
            if not all(
                np.allclose(a, b, 1e-6, 1e-9)
                for one, two in pairs
                for a, b in zip(one, two, strict=True)
            ):
                raise ValueError(
                    f"Argument `frequency` = {float(self.frequency):g} must be that of all "
                    f"drives, but `{name}` has not the period 2 pi / omega = {period:g}: give "
                    "the right one, or none for a run."
                )

    def _check_law(self, name: str, law: Any, arguments: str, *parts: Parts) -> None:
        """Raises `ValueError` unless the law returns a force for each displacement."""
        if law is None:
            return
        cause = None
        try:
            forces = jax.eval_shape(law, *parts)
            good = isinstance(forces, tuple | list) and len(forces) == self.d
        except (TypeError, ValueError, IndexError) as error:
            forces, good, cause = error, False, error
        if not good:
            raise ValueError(
                f"Argument `{name}` must be a function ({arguments}) of tuples of {self.d} arrays "
                f"that returns a tuple of {self.d} forces, but {shown(getattr(law, 'func', law))} "
                f"{'fails: ' if cause else 'returns '}{shown(forces)}"
            ) from cause

    def _check_change(self, name: str, number: Array) -> None:
        """One number in the place of several would act on all displacements, unnoticed."""
        shape = np.shape(vars(self)[name]) if name in _OF_DISPLACEMENTS else ()
        if shape and self.d > 1 and not number.shape:
            entry = ", ".join("0" for _ in shape)
            raise ValueError(
                f"Argument `{name}` must have shape {shape}, as in these cells, but is one "
                f"number, {shown(number)}, which would act on all {self.d} displacements: give "
                f"all entries, or name one of them, `{name}[{entry}]`, in `over` or in "
                f'`cells.with_(**{{"{name}[{entry}]": 0.2}})`.'
            )

    @property
    def d(self) -> int:
        """The number of displacements of a cell."""
        sizes = [a.shape[-1] for a in self._all_matrices().values() if a.ndim]
        return sizes[0] if sizes else 1

    def _all_matrices(self) -> dict[str, Matrix]:
        """The matrices that are given, those of `plus` by names such as "plus['friction']"."""
        named = {name: getattr(self, name) for name in _MATRICES}
        for parameter, added in (self.plus or {}).items():
            named |= {f"plus[{parameter!r}][{k!r}]": a for k, a in added.matrices.items()}
        return {name: value for name, value in named.items() if value is not None}

    def _matrix(self, name: str) -> Any:
        """A matrix with what `plus` adds: its entries, or a large one as an array; or None."""
        value = getattr(self, name)
        total = None if value is None else _of_size(value, self.d)
        for added in (self.plus or {}).values():
            if name in added.matrices:
                total = _plus_scaled(total, added.factor, _of_size(added.matrices[name], self.d))
        return total

    def dense(self, name: str) -> np.ndarray:
        """A matrix of the first cell with what `plus` adds, of shape (d, d); 0 if there is none.

        **Arguments:** `name`: "stiffness", "mass", "damping", "coupling" or "coupling_damping".
        """
        total = self._matrix(name)
        if total is None:
            return np.zeros((self.d, self.d))
        if isinstance(total, list):
            return np.array([[0.0 if a is None else np.ravel(a)[0] for a in row] for row in total])
        return np.asarray(total).reshape(-1, self.d, self.d)[0]

    def _selector(self, name: str) -> Callable[[Any], Any]:
        if self.plus is None or name not in self.plus:
            return super()._selector(name)
        return lambda cells: cells.plus[name].factor

    def description(self, n: int) -> dict[str, Any]:
        """Also the matrices of `plus`."""
        plus = {name: added.matrices for name, added in (self.plus or {}).items()}
        return super().description(n) | ({"plus": plus} if plus else {})

    def parameters(self) -> dict[str, Array]:
        """The arrays among the fields, the parameters of the law, the parameters of `plus`.

        Those of contacts, stops and drives have names such as "contacts[0].mu_static",
        "stops[0].gap", "force.values" (a field of a function that is an `equinox.Module`).
        """
        found = super().parameters() | {name: a.factor for name, a in (self.plus or {}).items()}
        for prefix, part in self._parts().items():
            found |= {prefix + name: value for name, value in part.numbers().items()}
        for prefix, owner in {"": self, **_numbered("contacts", self.contacts)}.items():
            for name in _DRIVES if owner is self else _DRIVES[:2]:
                found |= drive_numbers(prefix + name, getattr(owner, name))
        if self.contacts:  # which have their own
            found = {k: a for k, a in found.items() if k not in _DRIVES[:2]}
        return found

    def _parts(self) -> dict[str, Contact | Stop]:
        return _numbered("contacts", self.contacts) | _numbered("stops", self.stops)

    def with_(self, **changes: Any) -> Any:
        """See `AbstractModel.with_`; the names of numbers of parts are those of `parameters`."""
        changes = with_entries(
            changes, self.parameters(), "`MechanicalCells.with_`", self._symmetric
        )
        nested = {name: changes.pop(name) for name in [*changes] if "." in name}
        check_known("`MechanicalCells.with_`", nested, self.parameters())
        cells: Any = self
        if self.friction is None and self.frictional and "width" in changes:  # of all contacts
            width = changes.pop("width")
            contacts = [replace(c, friction=c.friction.with_(width=width)) for c in self.contacts]
            cells = replace(cells, contacts=contacts)
        for name, value in nested.items():
            owner, _, field = name.rpartition(".")
            cells = eqx.tree_at(*_changed(cells, owner, field, to_float(value, name)))
        return AbstractCells.with_(cells, **changes)

    @property
    def components(self) -> tuple[str, ...]:
        """The names of the displacements, and of their velocities with a prime."""
        names = self.names or tuple(f"q{i + 1}" for i in range(self.d))
        return (*names, *(f"{name}'" for name in names))

    @property
    def frictional(self) -> bool:
        """Whether there is friction, or a stop."""
        return bool(self.frictional_contacts or self.stops)

    @property
    def frictional_contacts(self) -> tuple[Contact, ...]:
        """The `contacts`, or the one of `friction` and `sliding`."""
        if self.friction is None:
            return self.contacts
        unit = tuple(float(i == self.sliding) for i in range(self.d))
        return (Contact(unit, self.friction, self.normal_load, self.belt_speed),)

    def velocity_of(self, index: int) -> int | None:
        """The index of q_i' for q_i."""
        return index + self.d if index < self.d else None

    @property
    def contact(self) -> int:
        """The number of a state that is the sliding velocity, of the first contact with a belt."""
        found = [c.displacement for c in self.contacts if c.displacement is not None]
        return self.d + (found[0] if found else self.sliding)

    @property
    def dry(self) -> bool:
        """Whether friction is a law without smoothing, or there are stops."""
        return self.frictional and all(contact.dry for contact in self.frictional_contacts)

    @property
    def law(self) -> AbstractFrictionLaw:
        """The friction law mu(s), without smoothing; of the first of several contacts."""
        friction: Any = self.friction if self.friction is not None else self.contacts[0].friction
        return friction.law

    def _drive_at(self, t: Any) -> list[Any]:
        """The d external forces."""
        force: Any = self.force
        if not callable(force):
            frequency: Any = self.frequency  # belongs to `force`
            wave = jnp.cos(frequency * t)
            return [f * wave for f in jnp.broadcast_to(force, (self.d,))]
        forces: Any = force(t)
        if not isinstance(forces, tuple | list):
            forces = [*forces] if jnp.ndim(forces) else [forces] * self.d
        if len(forces) != self.d:
            raise ValueError(f"{len(forces)} forces on {self.d} displacements")
        return [*forces]

    def parameter(self, name: str) -> Parameter:
        """The name, and the domain: a mass is positive, and a load not negative."""
        row = super().parameter(name)
        signs = {"mass": "positive", "normal_load": "nonnegative"}
        return row._replace(sign=signs.get(name, row.sign))

    def check_locality(self, t: ScalarLike, y: State) -> None:
        """See `AbstractCells`; and no cell may be beyond a stop."""
        super().check_locality(t, y)
        for i, stop in enumerate(self.stops):
            if is_traced(y, stop):
                continue
            at, gap = np.asarray(along(stop.direction, y[: self.d])), np.asarray(stop.gap)
            if np.any(at - gap > 1e-9 * (1.0 + np.abs(gap))):
                raise ValueError(
                    f"The state must not be beyond `stops[{i}]`, but e . q = {np.max(at):g} "
                    f"exceeds its gap, {np.max(gap):g}: start on its near side."
                )

    def layers(self, t: ScalarLike, y: State) -> list[tuple[Array, PerMass, int | None]]:
        """(w, width, variable that slides or None) of each contact."""
        found = []
        for contact in self.frictional_contacts:
            u = contact.displacement
            found.append((contact.slip(t, y), contact.width, None if u is None else self.d + u))
        return found

    def switching(
        self, t: ScalarLike, v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], PerMass] | None:
        """(u' - v_d, width) of the only contact, with a belt; None for others."""
        only = self._only_contact()
        return None if only is None else (v - only.speed_at(t), only.width)

    def _only_contact(self) -> Contact | None:
        """The contact of cells with one contact whose w is one of their velocities."""
        found = self.frictional_contacts
        return found[0] if len(found) == 1 and found[0].displacement is not None else None

    def smallest_scale(self, n: int) -> tuple[PerMass, PerMass] | None:
        """(eps, |v_d|) of the contact with the least width; None with dry friction or without."""
        if self.dry or not self.frictional:
            return None
        found = [(c.width, jnp.abs(c.speed_at(jnp.zeros(())))) for c in self.frictional_contacts]
        if len(found) == 1:
            return found[0]
        widths, speeds = ([jnp.min(part[i]) for part in found] for i in (0, 1))
        least = jnp.argmin(jnp.stack(widths))
        return jnp.stack(widths)[least], jnp.stack(speeds)[least]

    def belt_direction(self) -> ScalarLike:
        """The sign of v_d of the first contact; 1 for v_d = 0."""
        found = self.frictional_contacts
        speed = found[0].speed_at(jnp.zeros(())) if found else 1.0
        return jnp.where(jnp.ravel(jnp.asarray(speed, float))[0] < 0, -1.0, 1.0)

    def stick_speed(self) -> PerMass | None:
        """The speed of greatest friction, 0 if it is dry; None without, or of several contacts."""
        only = self._only_contact()
        return None if only is None else only.friction.stick_speed()

    def excess_force(
        self, t: Any, left: State, own: State, right: State, contact: int = 0
    ) -> PerMass:
        """|r| - p mu_st with r the force that would hold a contact; -inf if friction is dry.

        r = (e . M^{-1} h - v_d') / (e . M^{-1} e), where h has the friction of the others, too.
        """
        contacts = self.frictional_contacts
        if not contacts or self.dry:
            return super().excess_force(t, left, own, right)
        one, others = contacts[contact], contacts[:contact] + contacts[contact + 1 :]
        free = self._slowed(self.free_acceleration(t, left, own, right), t, own, others)
        pull = along(one.direction, free)
        if one.moving:
            pull = pull - one.acceleration_at(t)
        limit = one.load_at(t, own) * one.law.mu_static
        return jnp.abs(pull / along(one.direction, self._reach(one))) - limit

    def release_acceleration(self) -> PerMass | None:
        """p mu_st times its share b_u of the contact; None without smoothed friction."""
        only = self._only_contact()
        if only is None or only.dry:
            return None
        u: Any = only.displacement
        load = self.natural_scales()[2] if only.varying else only.normal_load
        return load * only.law.mu_static * self.inverse_mass(only)[u]

    def friction_scales(self) -> tuple[AbstractFrictionLaw, Any, Any, Any] | None:
        """The unit is P sqrt(b_u / K_uu) with the greatest load P, cell by cell."""
        only = self._only_contact()
        if only is None:
            return None
        return only.law, 1.0, only.speed_at(jnp.zeros(())), self.natural_scales()[1]

    def natural_scales(self) -> tuple[Any, Any, Any]:
        """(1 / sqrt(b K), P sqrt(b / K), P) with b and K of a contact and the greatest load P.

        b = e . M^{-1} e and K = e . K e / (e . e)^2.  Of several contacts the shortest time, and
        the greatest of the others.  A load that varies counts by its value at t = 0 and rest.
        Without contacts P = K |gap| of the stops; without these either the longest time of all
        displacements, and 1.
        """
        touches = self.frictional_contacts or self.stops
        if not touches:
            return self._times_alone()[1], jnp.ones(()), jnp.ones(())
        times, speeds, loads = [], [], []
        rest = (jnp.zeros(self.n or 1),) * (2 * self.d)
        for touch in touches:
            stiffness: Any = self._felt_stiffness(touch)
            share: Any = along(touch.direction, self._reach(touch))
            load = jnp.max(touch.force_at_rest(rest, stiffness))
            load = jnp.where(load > 0, load, 1.0)
            times.append(1.0 / jnp.sqrt(jnp.min(share * stiffness)))
            speeds.append(load * jnp.sqrt(jnp.max(share / stiffness)))
            loads.append(load)
        greatest = [_extreme(jnp.maximum, values) for values in (speeds, loads)]
        return _extreme(jnp.minimum, times), *greatest

    def sizes(self, y: State) -> tuple[Any, ...]:
        """T V of displacements and V of velocities, in the units of `natural_scales`.

        Without contacts and stops the greatest ones of the state, where none moves by the others.
        """
        if self.frictional_contacts or self.stops:
            time, velocity, _ = self.natural_scales()
            return (time * velocity,) * self.d + (velocity,) * self.d
        (short, long), parts = self._times_alone(), jnp.abs(jnp.stack(y))
        q, v = jnp.max(parts[: self.d]), jnp.max(parts[self.d :])
        return (jnp.maximum(q, short * v),) * self.d + (jnp.maximum(v, q / long),) * self.d

    def _times_alone(self) -> tuple[Any, Any]:
        """The shortest and the longest sqrt(M_uu / K_uu) of the displacements; 1 for K_uu <= 0."""

        def diagonal(name: str) -> Any:
            matrix = self._matrix(name)
            if not isinstance(matrix, list):
                return jnp.diagonal(matrix, axis1=-2, axis2=-1)
            rows = [jnp.ravel(row[u]) for u, row in enumerate(matrix)]
            return jnp.stack(jnp.broadcast_arrays(*rows), axis=-1)

        mass, stiffness = diagonal("mass"), diagonal("stiffness")
        times = jnp.sqrt(mass / jnp.where(stiffness > 0, stiffness, mass))
        return jnp.min(times), jnp.max(times)

    def _reach(self, touch: Contact | Stop) -> list[Any]:
        return [0.0 if part is None else part for part in self.inverse_mass(touch)]

    def _felt_stiffness(self, touch: Contact | Stop) -> Any:
        """e . K e / (e . e)^2; 1 where it is not positive."""
        matrix, e = self._matrix("stiffness"), touch.direction
        if sum(a != 0.0 for a in e) == 1 and 1.0 in e:
            u = e.index(1.0)
            stiffness = matrix[u][u] if isinstance(matrix, list) else matrix[..., u, u]
        else:
            product = _product(matrix, [a * jnp.ones(()) for a in e])
            stiffness = along(e, [*product]) / sum(a * a for a in e) ** 2
        return jnp.where(stiffness > 0, stiffness, 1.0)

    def forcing_period(self) -> ScalarLike | None:
        """2 pi / omega; None without forcing."""
        return None if self.frequency is None else 2.0 * jnp.pi / self.frequency

    def inverse_mass(self, touch: Contact | Stop) -> list[Any]:
        """M^{-1} e: the accelerations by a unit force at a contact or stop; None for 0."""
        unit = [jnp.full((), e) if e else None for e in touch.direction]
        return [*_solve(self._matrix("mass"), unit)]

    def accelerations(self, t: ScalarLike, y: State) -> Parts:
        """`free_acceleration` of all cells of a state."""
        left, right = self.neighbours(y)
        return self.free_acceleration(t, left, y, right)

    def free_acceleration(self, t: Any, left: State, own: State, right: State) -> Parts:
        """M^{-1} h, the accelerations without friction."""
        d = self.d
        q, v = own[:d], own[d:]
        behind = [a - b for a, b in zip(q, left[:d], strict=True)]
        ahead = [a - b for a, b in zip(right[:d], q, strict=True)]
        forces = _product(self._matrix("stiffness"), q)
        forces = [-part for part in forces] if isinstance(forces, list) else -forces

        def add(parts: Any, sign: float = 1.0) -> None:
            nonlocal forces
            if isinstance(forces, list):
                forces = [a + sign * part for a, part in zip(forces, parts, strict=True)]
            elif isinstance(parts, tuple | list):
                forces = forces + sign * jnp.stack(jnp.broadcast_arrays(*parts, q[0])[:-1])
            else:
                forces = forces + sign * parts

        add(_product(self._matrix("damping"), v), -1.0)
        if (coupling := self._matrix("coupling")) is not None:
            bend = [a - b for a, b in zip(ahead, behind, strict=True)]
            add(_product(coupling, bend))
        if (damper := self._matrix("coupling_damping")) is not None:
            turn = [a - 2.0 * b + c for a, b, c in zip(left[d:], v, right[d:], strict=True)]
            add(_product(damper, turn))
        if self.spring is not None:
            add(self.spring(tuple(ahead)))
            add(self.spring(tuple(behind)), -1.0)
        if self.local_force is not None:
            add(self.local_force(q, v))
        if self.force is not None:
            add(self._drive_at(t))
        return tuple(_solve(self._matrix("mass"), forces))

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Parts:
        free = self.free_acceleration(t, left, own, right)
        return (*own[self.d :], *self._slowed(free, t, own, self.frictional_contacts))

    def _slowed(self, accelerations: Parts, t: Any, own: State, contacts: Any) -> Parts:
        """Accelerations with the friction of these contacts."""
        for contact in contacts:
            friction = contact.load_at(t, own) * contact.friction.force(contact.slip(t, own))
            accelerations = tuple(
                a if share is None else a + share * friction
                for a, share in zip(accelerations, self.inverse_mass(contact), strict=True)
            )
        return accelerations


def _extreme(of: Callable[[Any, Any], Any], values: Sequence[Any]) -> Any:
    return values[0] if len(values) == 1 else reduce(of, values)


def _changed(cells: Any, owner: str, field: str, value: Array) -> tuple[Any, Any, Any]:
    """(where, cells, what) for `equinox.tree_at`: a number of a contact, a stop or a drive."""
    kind, _, rest = owner.partition("[")
    if not rest:  # "force"
        return lambda c: getattr(c, owner), cells, with_number(getattr(cells, owner), field, value)
    index, _, drive = rest.partition("]")
    i, part = int(index), getattr(cells, kind)[int(index)]
    if drive:  # ".normal_load"
        name = drive[1:]
        part = replace(part, **{name: with_number(getattr(part, name), field, value)})
    elif field in {f.name for f in fields(part)}:
        part = replace(part, **{field: value})
    else:
        part = replace(part, friction=part.friction.with_(**{field: value}))
    return lambda c: getattr(c, kind)[i], cells, part


def _numbered(name: str, items: Sequence[Any]) -> dict[str, Any]:
    return {f"{name}[{i}].": item for i, item in enumerate(items)}


def _of_size(matrix: Matrix, d: int) -> Any:
    """The entries of a matrix; None for zeros of one that is given by less than (d, d).

    Of a large one an array of shape (d, d) or (n, d, d).
    """
    if d > _WRITTEN_OUT:
        return matrix if matrix.ndim > 1 else jnp.diag(jnp.broadcast_to(matrix, (d,)))
    if matrix.ndim > 1:
        return [[matrix[..., i, j] for j in range(d)] for i in range(d)]
    diagonal = jnp.broadcast_to(matrix, (d,))
    return [[diagonal[i] if i == j else None for j in range(d)] for i in range(d)]


def _dense(matrix: Matrix, d: int) -> np.ndarray:
    """A concrete matrix of shape (d, d) or (n, d, d)."""
    return np.asarray(matrix) if matrix.ndim > 1 else np.asarray(matrix) * np.eye(d)


def _plus_scaled(total: Any, factor: Array, part: Any) -> Any:
    if total is None or not isinstance(part, list):
        scaled = jax.tree.map(lambda a: factor * a, part)  # keeps None
        return scaled if total is None else total + scaled

    def entry(a: Any, b: Any) -> Any:
        return a if b is None else factor * b if a is None else a + factor * b

    return [[*map(entry, *rows)] for rows in zip(total, part, strict=True)]


def _product(matrix: Any, parts: Any) -> Any:
    """The parts of a product; of an array, one array."""
    if not isinstance(matrix, list):
        return jnp.einsum("...ij,j...->i...", matrix, jnp.asarray(parts))
    return [
        sum((a * part for a, part in zip(row, parts, strict=True) if a is not None), 0.0)
        for row in matrix
    ]


def _solve(matrix: Any, parts: Any) -> Any:
    """M^{-1} parts; a part that is None is zero."""
    if isinstance(matrix, list):
        return substitute(factor(matrix), parts)
    if isinstance(parts, list):
        parts = jnp.stack([jnp.zeros(()) if part is None else part for part in parts])
    # The inverse does not depend on the state, so that a Taylor series only multiplies by it.
    return _product(jnp.linalg.inv(matrix), parts)
