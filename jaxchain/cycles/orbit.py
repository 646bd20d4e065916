"""What the equations of every closed orbit have, for branches and curves of special points."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import to_float
from .._types import State
from ..continuation.arclength import make_corrector
from ..continuation.branch import SpecialPoint
from ..continuation.corrector import Corrector
from ..kinds.kind import AbstractKind, Unknowns
from ..model.model import AbstractModel

# Cycles that are integrated at once.
_TOGETHER = 8


# (orbit, u, p) of solutions; (orbit, the special point) of others.
Rows = Sequence[tuple[Any, np.ndarray, float]]
SpecialRows = Sequence[tuple[Any, SpecialPoint]]
# (state, period, amplitude, scaled peak velocity) of cycles.
Cycles = tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]


class SeenCycle(NamedTuple):
    """What a user's own event may depend on, to be followed in two parameters."""

    state: State
    period: Float[Array, ""]
    amplitude: Float[Array, " n"]


class Start(NamedTuple):
    """Where a piece of a branch begins: its equations, a solution (u, p), the direction."""

    orbit: Any
    u: Float[np.ndarray, " m"]
    p: float
    direction: Any


class AbstractOrbit(abc.ABC):
    """The equations of a closed orbit of a model, and what happens along its branches.

    - `field`: the model; `m`: the number of variables of a cell; `n` of cells; `mass`: the one at
      whose event the orbit is cut; `size`: the number of unknowns u.
    - `parameter`: the argument of `model.with_` that is the parameter of the equations, a tuple of
      several, or None.
    - `forcing_periods`: the number of periods of the force in the orbit's; None without forcing.
    - `units`: what counts as 1 of each of the m variables of a cell, then of time, in the unknowns
      and the equations; None: 1 of all.
    - `special_kind`: the kind of special point whose equation is among these, or None;
      `curve_ends`: the tests of `curve_tests` at whose zero a curve of special points ends.
    """

    field: Any
    parameter: str | tuple[str, ...] | None
    m: int
    forcing_periods: int | None
    units: Float[Array | np.ndarray, " m_and_time"] | None
    special_kind: AbstractKind | None
    curve_ends: tuple[str, ...]

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """The number of unknowns."""

    @property
    def of_variables(self) -> tuple[Any, ...]:
        """What counts as 1 of each variable of a cell."""
        return (1.0,) * self.m if self.units is None else (*self.units[:-1],)

    @property
    def of_time(self) -> Any:
        """What counts as 1 of time."""
        return 1.0 if self.units is None else self.units[-1]

    @property
    def is_family(self) -> bool:
        """Whether its orbit is one of a family over its period, as without damping."""
        return self.parameter == "period" and not self.field.has_parameter("period")

    def at(self, *parameter: Any) -> AbstractModel:
        """The field with the parameter, or several, set."""
        if self.parameter is None or self.is_family:
            return self.field
        if self.parameter == "belt_speed":  # the usual one, without the checks of a new chain
            return eqx.tree_at(lambda f: f.belt_speed, self.field, *parameter)
        names = [self.parameter] if isinstance(self.parameter, str) else self.parameter
        return self.field.with_(**dict(zip(names, parameter, strict=True)))

    @abc.abstractmethod
    def unpack(self, u: Float[Array, " m"], *parameter: Any) -> tuple[AbstractModel, State, Array]:
        """(field, state where the orbit is cut, period)."""

    @abc.abstractmethod
    def residual(self, u: Float[Array, " m"], *parameter: Any) -> Float[Array, " equations"]:
        """F(u, p), whose zero is a closed orbit."""

    @abc.abstractmethod
    def cycle(self, u: Float[Array, " m"], *parameters: Any) -> tuple[Array, Array, Any]:
        """(F, [F_u F_p], further results) from one integration.

        The results have `state`, `period`, `speed` (the greatest along the belt of the mass that
        is cut, in `units`), `amplitude`, `multipliers` (all but the trivial one, the greatest
        modulus first), `trivial_defect`, `monodromy` and `sound`.
        """

    @abc.abstractmethod
    def seen(self, u: Float[Array, " m"], *parameters: Any) -> SeenCycle:
        """The cycle, with derivatives."""

    @abc.abstractmethod
    def image(self, z: Unknowns, one: Float[Array, " d"]) -> Float[Array, " d"]:
        """M times a disturbance, with derivatives."""

    @abc.abstractmethod
    def weights(self, p: float) -> np.ndarray:
        """The weights of the norm of steps, of shape (size + 1,)."""

    def corrector(self, p: float, tolerance: float) -> Corrector:
        """The corrector of `continue_branch`."""
        weights = self.weights(p)
        return make_corrector(residual, linearise, self, self.size, weights, tolerance)

    @abc.abstractmethod
    def kinds(self, u: np.ndarray, p: float) -> list[AbstractKind]:
        """The kinds of special points that a branch of this orbit may have."""

    @abc.abstractmethod
    def lost(self, first: Any, extra: Any) -> str:
        """Why a point, not `first`, is no cycle of this branch, or ""."""

    @abc.abstractmethod
    def is_valid(self, extra: Any) -> bool:
        """Whether a solution of the equations is a cycle."""

    @abc.abstractmethod
    def with_least_period(self, u: np.ndarray, p: float, extra: Any) -> Start | None:
        """Where to begin instead if the orbit goes several times round, else None."""

    @abc.abstractmethod
    def exact(self, kind: AbstractKind, raw: SpecialPoint, tolerance: float) -> SpecialPoint:
        """A special point to all digits, with its error."""

    @abc.abstractmethod
    def cycles(self, rows: Rows, special: SpecialRows, mass: int, rtol: Any) -> Cycles:
        """The cycles of `rows`, then of special points; the scaled peak velocity is of `mass`."""

    def seen_at(
        self, u: Float[np.ndarray, "k m"], parameters: Float[np.ndarray, "k more"]
    ) -> list[SeenCycle]:
        """`seen` of k solutions."""
        every = together(lambda u, p: _seen(u, p, self), u, parameters)
        return [jax.tree.map(lambda leaf, i=i: leaf[i], every) for i in range(len(u))]

    @abc.abstractmethod
    def meets_more(self, extra: Any) -> Any:
        """Whether the cycle of a solution meets further events."""

    @abc.abstractmethod
    def curve_tests(self, *, folds: bool) -> dict[str, Callable[..., float]]:
        """The tests of `continue_branch` along such a curve, by name; whether it is of folds."""

    @abc.abstractmethod
    def beyond(self, ended: str, u: np.ndarray) -> AbstractOrbit | None:
        """The orbit of the next piece of a curve, if it goes on where it has `ended`."""


def units_of(model: AbstractModel, state: State) -> Float[Array, " m_and_time"] | None:
    """`AbstractOrbit.units` of the cycle through a state."""
    sizes = model.sizes(state)
    if sizes is None:
        return None
    kept = [jnp.where(a > 0, a, 1.0) for a in sizes]
    return lax.stop_gradient(jnp.stack([*kept, to_float(model.natural_scales()[0])]))


def together(function: Callable[..., Any], *columns: np.ndarray) -> Any:
    """What a compiled function makes of rows, some at once, which takes a sixth of the time."""
    k, parts = len(columns[0]), []
    for first in range(0, k, _TOGETHER):
        rows = np.minimum(first + np.arange(_TOGETHER), k - 1)
        parts.append(jax.device_get(function(*(column[rows] for column in columns))))
    return jax.tree.map(lambda *part: np.concatenate(part)[:k], *parts)


@eqx.filter_jit
def _seen(u: Any, parameters: Any, orbit: AbstractOrbit) -> SeenCycle:
    return jax.vmap(lambda u, parameters: orbit.seen(u, *parameters))(u, parameters)


def residual(u: Float[Array, " m"], parameter: Any, orbit: Any) -> Float[Array, " m"]:
    """The equations of a cycle as a plain function, which is the same object in every call."""
    return orbit.residual(u, parameter)


def linearise(u: Float[Array, " m"], parameter: Any, orbit: Any) -> tuple[Array, Array, Any]:
    """(R, [R_u R_p], further results) of the equations of a cycle, in the same way."""
    return orbit.cycle(u, parameter)
