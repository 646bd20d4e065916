"""Cells of several displacements: masses, springs, dampers, friction at one of them, forcing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._checks import (
    check_finite,
    check_kind,
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
from .._types import PerMass, ScalarLike, State
from .cells import AbstractCells
from .friction import AbstractFriction, AbstractFrictionLaw, TanhFriction, as_law
from .springs import Ends
from .tridiagonal import Entries, factor, substitute

# The fields with an entry for each displacement, unless they are one number for all of them.
_OF_DISPLACEMENTS = ("stiffness", "mass", "damping", "coupling", "force")

Parts = tuple[Float[Array, " n"], ...]
# One number, (d,) for a diagonal, (d, d), or (n, d, d) for a matrix of each cell.
Matrix = Float[Array, "..."]


def _forces(name: str) -> Callable[[Any], Any]:
    """The converter of a law to a pytree: of a plain function no leaf, of a module its numbers."""

    def convert(function: Any) -> Any:
        wanted = "None, or a function of parts of a state that returns forces"
        check_kind(name, function, Callable | None, wanted)
        return function if isinstance(function, eqx.Module | None) else jtu.Partial(function)

    return convert


def _friction(friction: Any) -> Any:
    return as_law(friction) if isinstance(friction, AbstractFrictionLaw) else friction


@final
class MechanicalCells(AbstractCells):
    """Cells of d displacements q with masses, springs, dampers, dry or smoothed friction, forcing.

    M q_n'' + D q_n' + K q_n + C (2 q_n - q_{n-1} - q_{n+1}) = s(q_{n+1} - q_n) - s(q_n - q_{n-1})
        + g(q_n, q_n') + p F(u_n' - v_d) e_u + f cos(omega t),

    where u is the displacement number `sliding` of a cell, which slides on the belt, and e_u its
    unit vector.  A state is (q_1, ..., q_d, q_1', ..., q_d'), each of shape (n,).

    With dry friction `simulate` and `sweep` find every start and end of sticking (`EventDriven`):

        sliding   M q'' = h - p mu(|w|) sign(w) e_u,     w = u' - v_d,
        sticking  u'' = 0,    while |r| <= p mu_st,      r = e_u M^{-1} h / (e_u M^{-1} e_u),

    h being all other forces and r the force that holds the mass.  Searches for cycles need
    smoothed friction.

    **Arguments** (dimensionless, or of any system of units):

    - `stiffness` = K, `mass` = M, `damping` = D, `coupling` = C: one number (times the unit
      matrix), shape (d,) for a diagonal, (d, d), or (n, d, d) for a matrix of each cell.  M must
      be symmetric and positive definite; K may be singular or not symmetric.
    - `spring` = s: the force of a nonlinear spring between neighbours.  It takes d elongations of
      shape (n,) and returns d forces, with s(0) = 0.
    - `local_force` = g: further forces on a cell, of its d displacements and d velocities.
    - `friction`: a law of `jaxchain.model` for dry friction, or `TanhFriction`; `belt_speed` = v_d
      and `normal_load` = p >= 0; `sliding`, which displacement slides, counted from 0.
    - `force` = f, one number or shape (d,); `frequency` = omega > 0.
    - `ends`: "cyclic" or "free"; `names` of the displacements.

    `spring` and `local_force` are functions, or `equinox.Module`s whose numbers are fields; they
    compute all cells side by side.

    `with_` changes numbers by their names.  Where the cells hold an array over displacements, it
    refuses one number, which would act on all displacements; `normal_load` and the numbers of the
    friction law are one for all cells or one for each.

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
    """

    stiffness: Matrix = eqx.field(converter=named("stiffness"))
    mass: Matrix = eqx.field(converter=named("mass"), default=1.0)
    damping: Matrix = eqx.field(converter=named("damping"), default=0.0)
    coupling: Matrix | None = eqx.field(converter=optional("coupling"), default=None)
    spring: Callable[..., Any] | None = eqx.field(converter=_forces("spring"), default=None)
    local_force: Callable[..., Any] | None = eqx.field(
        converter=_forces("local_force"), default=None
    )
    friction: AbstractFriction | None = eqx.field(converter=_friction, default=None)
    belt_speed: Array = eqx.field(converter=named("belt_speed"), default=0.0)
    normal_load: PerMass = eqx.field(converter=named("normal_load"), default=1.0)
    force: Array | None = eqx.field(converter=optional("force"), default=None)
    frequency: Array | None = eqx.field(converter=optional("frequency"), default=None)
    sliding: int = eqx.field(static=True, default=0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    names: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_one_of("ends", self.ends, get_args(Ends))
        d = self.d
        for name in _OF_DISPLACEMENTS[:4]:
            value = getattr(self, name)
            if value is None:
                continue
            check_finite(name, value)
            if value.shape[-2:] not in ((), (d,), (d, d)) or value.ndim > 3:
                raise ValueError(
                    f"Argument `{name}` must be one number, or of shape ({d},), ({d}, {d}) or "
                    f"(n, {d}, {d}) for {d} displacements, but has shape {value.shape}."
                )
        check_whole("sliding", self.sliding, 0, d - 1, "it counts displacements from 0.")
        if self.names is not None and len(self.names) != d:
            raise ValueError(f"Argument `names` must have {d} names, but is {self.names}.")
        if not is_traced(self.mass):
            whole = np.asarray(self.mass)
            whole = whole if whole.ndim > 1 else whole * np.eye(d)
            symmetric = np.array_equal(whole, np.swapaxes(whole, -1, -2))
            if not symmetric or np.min(np.linalg.eigvalsh(whole)) <= 0:
                raise ValueError(
                    "Argument `mass` must be symmetric and positive definite, but is "
                    f"{whole.tolist()}: a displacement without mass has no rate."
                )
        check_number("belt_speed", self.belt_speed)
        check_nonnegative("normal_load", self.normal_load, "a mass cannot pull at the belt.")
        if self.friction is not None:
            wanted = "None, a friction law (dry friction) or `TanhFriction(law, width)`"
            check_kind("friction", self.friction, AbstractFriction, wanted)
        if (self.force is None) != (self.frequency is None):
            raise ValueError(
                "Arguments `force` and `frequency` belong together, but are "
                f"{shown(self.force)} and {shown(self.frequency)}: give both or neither."
            )
        if self.force is not None:
            check_finite("force", self.force)
            check_positive("frequency", self.frequency)
            check_number("frequency", self.frequency)
            if self.force.shape not in ((), (d,)):
                raise ValueError(
                    f"Argument `force` must be one number or of shape ({d},), but has shape "
                    f"{self.force.shape}."
                )
        per_cell = {"normal_load": self.normal_load}
        if self.friction is not None:
            per_cell |= self.friction.numbers()
        for name in ("stiffness", "mass", "damping", "coupling"):
            value = getattr(self, name)
            if value is not None and value.ndim == 3:
                per_cell[name] = value[:, 0, 0]
        check_per_mass(**per_cell)
        if self.spring is not None:
            rest = self.spring(*[jnp.zeros(1)] * d)
            if len(rest) != d or not (is_traced(rest) or all(np.all(f == 0) for f in rest)):
                law = getattr(self.spring, "func", self.spring)
                raise ValueError(
                    f"Argument `spring` must return {d} forces that vanish without elongation, "
                    f"but is {shown(law)} and returns {[str(f) for f in rest]}: springs beyond "
                    "free ends exert no force."
                )

    def _check_change(self, name: str, number: Array) -> None:
        """One number in the place of several would act on all displacements, unnoticed."""
        shape = vars(self)[name].shape if name in _OF_DISPLACEMENTS else ()
        if shape and self.d > 1 and not number.shape:
            entry = ", ".join("0" for _ in shape)
            raise ValueError(
                f"Argument `{name}` must have shape {shape}, as in these cells, but is one "
                f"number, {shown(number)}, which would act on all {self.d} displacements: give "
                f"all entries, such as `cells.{name}.at[{entry}].set(0.2)`. A sweep does so by "
                f"`vary`: `lambda cells, size: "
                f"cells.with_({name}=cells.{name}.at[{entry}].set(size))`."
            )

    @property
    def d(self) -> int:
        """The number of displacements of a cell."""
        matrices = self.stiffness, self.mass, self.damping, self.coupling
        sizes = [a.shape[-1] for a in matrices if a is not None and a.ndim]
        return sizes[0] if sizes else 1

    @property
    def components(self) -> tuple[str, ...]:
        """The names of the displacements, and of their velocities with a prime."""
        names = self.names or tuple(f"q{i + 1}" for i in range(self.d))
        return (*names, *(f"{name}'" for name in names))

    @property
    def contact(self) -> int:
        """The number of a state that is the sliding velocity."""
        return self.d + self.sliding

    @property
    def dry(self) -> bool:
        """Whether friction is a law without smoothing."""
        return isinstance(self.friction, AbstractFrictionLaw)

    @property
    def law(self) -> AbstractFrictionLaw:
        """The friction law mu(s), without smoothing."""
        friction: Any = self.friction
        return friction.law

    @property
    def load(self) -> PerMass:
        """p, as a `Chain` calls it."""
        return self.normal_load

    def static_limit(self) -> PerMass:
        """p mu_st, the greatest friction force on a sticking mass."""
        return self.normal_load * self.law.mu_static

    def switching(
        self, t: ScalarLike, v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], PerMass] | None:
        """(u' - v_d, width), None without friction."""
        if self.friction is None:
            return None
        width = self.friction.width if isinstance(self.friction, TanhFriction) else to_float(0.0)
        return v - self.belt_speed, width

    def belt_direction(self) -> ScalarLike:
        """The sign of v_d; 1 for v_d = 0."""
        return jnp.where(self.belt_speed < 0, -1.0, 1.0)

    def stick_speed(self) -> PerMass | None:
        """0 with dry friction; None otherwise, because the force that would hold is not local."""
        return to_float(0.0) if self.dry else None

    def release_acceleration(self) -> PerMass | None:
        """p mu_st times its share b_u of the contact; None without smoothed friction."""
        if not isinstance(self.friction, TanhFriction):
            return None
        share: Any = self.compliance()[self.sliding]
        return self.static_limit() * share

    def forcing_period(self) -> ScalarLike | None:
        """2 pi / omega; None without forcing."""
        return None if self.frequency is None else 2.0 * jnp.pi / self.frequency

    def compliance(self) -> list[PerMass | None]:
        """M^{-1} e_u: the acceleration of each displacement by a unit force at the contact."""
        unit: list[Any] = [None] * self.d
        unit[self.sliding] = jnp.ones(())
        return substitute(factor(_entries(self.mass, self.d)), unit)

    def free_acceleration(self, t: ScalarLike, left: State, own: State, right: State) -> Parts:
        """M^{-1} h, the accelerations without friction."""
        d = self.d
        q, v = own[:d], own[d:]
        behind = [a - b for a, b in zip(q, left[:d], strict=True)]
        ahead = [a - b for a, b in zip(right[:d], q, strict=True)]
        forces = [-part for part in _product(_entries(self.stiffness, d), q)]

        def add(parts: Any, sign: float = 1.0) -> None:
            for i, part in enumerate(parts):
                forces[i] = forces[i] + sign * part

        add(_product(_entries(self.damping, d), v), -1.0)
        if self.coupling is not None:
            bend = [a - b for a, b in zip(ahead, behind, strict=True)]
            add(_product(_entries(self.coupling, d), bend))
        if self.spring is not None:
            add(self.spring(*ahead))
            add(self.spring(*behind), -1.0)
        if self.local_force is not None:
            add(self.local_force(q, v))
        if self.force is not None:
            frequency: Any = self.frequency  # belongs to `force`
            wave = jnp.cos(frequency * t)
            add([f * wave for f in jnp.broadcast_to(self.force, (d,))])
        return tuple(substitute(factor(_entries(self.mass, d)), forces))

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Parts:
        v, accelerations = own[self.d :], self.free_acceleration(t, left, own, right)
        if self.friction is not None:
            friction = self.normal_load * self.friction.force(v[self.sliding] - self.belt_speed)
            accelerations = tuple(
                a if share is None else a + share * friction
                for a, share in zip(accelerations, self.compliance(), strict=True)
            )
        return (*v, *accelerations)


def _entries(matrix: Matrix, d: int) -> Entries:
    """The entries of a matrix; None for zeros of one that is given by less than (d, d)."""
    if matrix.ndim > 1:
        return [[matrix[..., i, j] for j in range(d)] for i in range(d)]
    diagonal = jnp.broadcast_to(matrix, (d,))
    return [[diagonal[i] if i == j else None for j in range(d)] for i in range(d)]


def _product(matrix: Entries, parts: Any) -> list[Any]:
    return [
        sum((a * part for a, part in zip(row, parts, strict=True) if a is not None), 0.0)
        for row in matrix
    ]
