"""Cells of several displacements: masses, springs, dampers, friction at one of them, forcing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import partial
from types import CellType, FunctionType
from typing import Any, get_args

import equinox as eqx
import jax
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
    closed_over,
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
from .drives import OfTime, takes_state
from .friction import AbstractFriction, AbstractFrictionLaw, TanhFriction, as_law
from .parameters import Parameter
from .springs import Ends
from .tridiagonal import factor, substitute

# The fields with an entry for each displacement, unless they are one number for all of them.
_MATRICES = ("stiffness", "mass", "damping", "coupling", "coupling_damping")
_OF_DISPLACEMENTS = (*_MATRICES, "force")

Parts = tuple[Float[Array, " n"], ...]
# Matrices up to this size are written out entry by entry, so that no zero is multiplied; more
# entries would take minutes to compile (24 displacements 6), and are arrays.
_WRITTEN_OUT = 6
# Shares of a period at which a drive is compared with the next period.
_INSIDE = (0.13, 0.37, 0.81)
# One number, (d,) for a diagonal, (d, d), or (n, d, d) for a matrix of each cell.
Matrix = Float[Array, "..."]


def _forces(name: str) -> Callable[[Any], Any]:
    """The converter of a law to a pytree."""

    def convert(function: Any) -> Any:
        wanted = "None, or a function of parts of a state that returns forces"
        check_kind(name, function, Callable | None, wanted)
        known = isinstance(function, eqx.Module | jtu.Partial | None)
        return function if known else _with_closure(function)

    return convert


def _drive(name: str) -> Callable[[Any], Any]:
    """The converter of a number, an array, or a function of time, which becomes a pytree."""

    def convert(value: Any) -> Any:
        if not callable(value):
            return optional(name)(value)
        function = _forces(name)(value)
        return function if name != "normal_load" or takes_state(value) else OfTime(function)

    return convert


def _with_closure(function: Any, seen: tuple[Any, ...] = ()) -> jtu.Partial:
    """The function, with whatever traced it closes over, or has as default, as leaves.

    Searches treat a model as constant and attach derivatives in its leaves: what they do not see
    has none.
    """
    if isinstance(function, partial):
        inner, owned = _with_closure(function.func, seen), (function.args, function.keywords)
        if not is_traced(inner, owned):  # the same object is the same program
            return jtu.Partial(function)
        return jtu.Partial(lambda f, owned, *a: f(*owned[0], *a, **owned[1]), inner, owned)
    if not isinstance(function, FunctionType):
        return jtu.Partial(function)
    seen = (*seen, function)

    def inside(content: Any) -> Any:
        further = isinstance(content, FunctionType | partial) and content not in seen
        return _with_closure(content, seen) if further else content

    owned = closed_over(function), function.__defaults__, function.__kwdefaults__
    leaves, treedef = jtu.tree_flatten(jax.tree.map(inside, owned))
    traced = [k for k, leaf in enumerate(leaves) if is_traced(leaf)]
    if not traced:
        return jtu.Partial(function)
    others = [None if is_traced(leaf) else leaf for leaf in leaves]
    own = function.__code__, function.__globals__, function.__name__

    def rebuilt(numbers: list[Array], *arguments: Any) -> Any:
        both = dict(enumerate(others)) | dict(zip(traced, numbers, strict=True))
        contents, defaults, keywords = jtu.tree_unflatten(treedef, both.values())
        again = FunctionType(*own, defaults, tuple(CellType(content) for content in contents))
        again.__kwdefaults__ = keywords
        return again(*arguments)

    return jtu.Partial(rebuilt, [leaves[k] for k in traced])


class Added(PrintedAsCall, eqx.Module):
    """`factor` times `matrices`, which are added to those of the same names."""

    matrices: dict[str, Matrix]
    factor: Array = eqx.field(converter=named("factor"), default=0.0)


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


def _friction(friction: Any) -> Any:
    return as_law(friction) if isinstance(friction, AbstractFrictionLaw) else friction


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

    h being all other forces and r the force that holds the mass.

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
    spring: Callable[..., Any] | None = eqx.field(converter=_forces("spring"), default=None)
    local_force: Callable[..., Any] | None = eqx.field(
        converter=_forces("local_force"), default=None
    )
    friction: AbstractFriction | None = eqx.field(converter=_friction, default=None)
    belt_speed: Any = eqx.field(converter=_drive("belt_speed"), default=0.0)
    normal_load: Any = eqx.field(converter=_drive("normal_load"), default=1.0)
    force: Any = eqx.field(converter=_drive("force"), default=None)
    frequency: Array | None = eqx.field(converter=optional("frequency"), default=None)
    sliding: int = eqx.field(static=True, default=0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    names: tuple[str, ...] | None = eqx.field(static=True, default=None)
    n: int | None = eqx.field(static=True, default=None)
    coupling_damping: Matrix | None = eqx.field(
        converter=optional("coupling_damping"), default=None
    )

    plus: dict[str, Added] | None = eqx.field(
        converter=lambda plus: None if plus is None else _plus(plus), default=None
    )
    _symmetric = ("mass",)

    def __post_init__(self) -> None:
        if self.n is None:  # known from a matrix for each cell, or a load or law for each
            matrices = [getattr(self, name) for name in _MATRICES]
            counts = [np.shape(a)[0] for a in matrices if a is not None and np.ndim(a) == 3]
            friction = self.friction if isinstance(self.friction, AbstractFriction) else None
            each = [*(friction.parameters().values() if friction else ())]
            each += [] if callable(self.normal_load) else [self.normal_load]
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
        self._check_drives()
        if self.friction is not None:
            wanted = "None, a friction law (dry friction) or `TanhFriction(law, width)`"
            check_kind("friction", self.friction, AbstractFriction, wanted)
        force: Any = self.force
        waves = force is not None and not callable(force)  # f cos(omega t)
        driven = waves or any(map(callable, (force, self.normal_load, self.belt_speed)))
        given = self.frequency is not None
        if (waves and not given) or (given and not driven):
            raise ValueError(
                "Arguments `force` and `frequency` belong together, but are "
                f"{shown(self.force)} and {shown(self.frequency)}: give both or neither."
            )
        if self.frequency is not None:
            check_positive("frequency", self.frequency)
            check_number("frequency", self.frequency)
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
        zero, rest = jnp.zeros(()), (jnp.zeros(self.n or 1),) * (2 * self.d)
        calls_at = {
            "belt_speed": self.belt_speed_at,
            "normal_load": lambda t: self.load_at(t, rest),
            "force": self._drive_at,
        }
        for name, call in calls_at.items():
            if not callable(getattr(self, name)):
                continue
            try:
                found = jax.eval_shape(call, zero)
                good = name == "force" or found.shape in ((), (self.n or 1,))
            except (TypeError, ValueError, IndexError) as error:
                found, good = error, False
            if not good:
                wanted = {
                    "belt_speed": "a function (t) that returns one speed",
                    "normal_load": "a function (t) or (t, q, v) that returns one load, or one for "
                    "each cell",
                    "force": f"a function (t) that returns one force, or {self.d}",
                }[name]
                raise ValueError(f"Argument `{name}` must be {wanted}, but gives {shown(found)}.")
            if self.frequency is None or is_traced(self.frequency, getattr(self, name)):
                continue
            period = 2.0 * np.pi / float(self.frequency)
            with jax.ensure_compile_time_eval():
                ends = [
                    [np.asarray(part) for part in jax.tree.leaves(calls_at[name](now))]
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

    def _selector(self, name: str) -> Callable[[Any], Any]:
        if self.plus is None or name not in self.plus:
            return super()._selector(name)
        return lambda cells: cells.plus[name].factor

    def description(self, n: int) -> dict[str, Any]:
        """Also the matrices of `plus`."""
        plus = {name: added.matrices for name, added in (self.plus or {}).items()}
        return super().description(n) | ({"plus": plus} if plus else {})

    def parameters(self) -> dict[str, Array]:
        """The arrays among the fields, the parameters of the law, the parameters of `plus`."""
        return super().parameters() | {name: a.factor for name, a in (self.plus or {}).items()}

    @property
    def components(self) -> tuple[str, ...]:
        """The names of the displacements, and of their velocities with a prime."""
        names = self.names or tuple(f"q{i + 1}" for i in range(self.d))
        return (*names, *(f"{name}'" for name in names))

    @property
    def frictional(self) -> bool:
        """Whether there is friction."""
        return self.friction is not None

    def velocity_of(self, index: int) -> int | None:
        """The index of q_i' for q_i."""
        return index + self.d if index < self.d else None

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
    def moving_belt(self) -> bool:
        """Whether the belt's speed is a function of time."""
        return callable(self.belt_speed)

    @property
    def varying_load(self) -> bool:
        """Whether the load is a function of time or of the state."""
        return callable(self.normal_load)

    def belt_speed_at(self, t: Any) -> Any:
        """v_d."""
        speed = self.belt_speed
        return speed(t) if callable(speed) else speed

    def load_at(self, t: Any, y: State) -> Any:
        """p, at least 0: where a function is negative the contact has lifted off."""
        load = self.normal_load
        if not callable(load):
            return load
        pressed: Any = load(t, y[: self.d], y[self.d :])
        return jnp.maximum(pressed, 0.0)

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

    def static_limit(self) -> PerMass:
        """p mu_st, the greatest friction on a sticking mass; of the nominal load if p varies."""
        load = self.natural_scales()[2] if self.varying_load else self.normal_load
        return load * self.law.mu_static

    def switching(
        self, t: ScalarLike, v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], PerMass] | None:
        """(u' - v_d, width), None without friction."""
        if self.friction is None:
            return None
        width = self.friction.width if isinstance(self.friction, TanhFriction) else to_float(0.0)
        return v - self.belt_speed_at(t), width

    def belt_direction(self) -> ScalarLike:
        """The sign of v_d; 1 for v_d = 0."""
        return jnp.where(self.belt_speed_at(jnp.zeros(())) < 0, -1.0, 1.0)

    def stick_speed(self) -> PerMass | None:
        """The speed of greatest friction, 0 if it is dry; None without friction."""
        return None if self.friction is None else self.friction.stick_speed()

    def excess_force(self, t: Any, left: State, own: State, right: State) -> PerMass:
        """|r| - p mu_st with r the force that would hold a contact; -inf if friction is dry."""
        if not isinstance(self.friction, TanhFriction):
            return super().excess_force(t, left, own, right)
        free, share = self.free_acceleration(t, left, own, right), self.compliance()
        limit = self.load_at(t, own) * self.law.mu_static
        return jnp.abs(free[self.sliding] / share[self.sliding]) - limit

    def release_acceleration(self) -> PerMass | None:
        """p mu_st times its share b_u of the contact; None without smoothed friction."""
        if not isinstance(self.friction, TanhFriction):
            return None
        share: Any = self.compliance()[self.sliding]
        return self.static_limit() * share

    def friction_scales(self) -> tuple[AbstractFrictionLaw, Any, Any, Any] | None:
        """The unit is P sqrt(b_u / K_uu) with the greatest load P, cell by cell."""
        if self.friction is None:
            return None
        return self.law, 1.0, self.belt_speed_at(jnp.zeros(())), self.natural_scales()[1]

    def natural_scales(self) -> tuple[Any, Any, Any]:
        """(1 / sqrt(b_u K_uu), P sqrt(b_u / K_uu), P) with the greatest load P.

        Of a load that varies P is its value at t = 0 and rest, or 1 if that is 0.
        """
        if self.friction is None:
            return super().natural_scales()
        u = self.sliding
        matrix = self._matrix("stiffness")
        stiffness: Any = matrix[u][u] if isinstance(matrix, list) else matrix[..., u, u]
        stiffness = jnp.where(stiffness > 0, stiffness, 1.0)
        share: Any = self.compliance()[u]
        rest = (jnp.zeros(self.n or 1),) * (2 * self.d)
        load = jnp.max(self.load_at(jnp.zeros(()), rest))
        load = jnp.where(load > 0, load, 1.0)
        time = 1.0 / jnp.sqrt(jnp.min(share * stiffness))
        return time, load * jnp.sqrt(jnp.max(share / stiffness)), load

    def forcing_period(self) -> ScalarLike | None:
        """2 pi / omega; None without forcing."""
        return None if self.frequency is None else 2.0 * jnp.pi / self.frequency

    def compliance(self) -> list[Any]:
        """M^{-1} e_u: the accelerations by a unit force at the contact; None for 0."""
        unit: list[Any] = [None] * self.d
        unit[self.sliding] = jnp.ones(())
        return _solve(self._matrix("mass"), unit)

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
        v, accelerations = own[self.d :], self.free_acceleration(t, left, own, right)
        if self.friction is not None:
            w = v[self.sliding] - self.belt_speed_at(t)
            friction = self.load_at(t, own) * self.friction.force(w)
            accelerations = tuple(
                a if share is None else a + share * friction
                for a, share in zip(accelerations, self.compliance(), strict=True)
            )
        return (*v, *accelerations)


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
