"""Curves of special points in two parameters of a model, and special cycles to all digits.

A special point solves the equations of its cycle or equilibrium and one more, which its kind has
(see `jaxchain/kinds/kind.py`); with a second parameter free such points form a curve.  A Hopf
point has lambda_1 + lambda_2 = 0, for a pair of eigenvalues with the product kappa = omega^2.

With dry friction a curve of folds consists of two kinds of pieces: grazing folds, and smooth folds
of slip cycles that stay slower than the belt.  They meet, with one tangent, at a degenerate
grazing, V_+ + V_- = 0 (see `boundaries/grazing.py`), and the curve is followed from one piece to
the next.  It is also followed where events of two masses change their order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .._checks import (
    check_concrete,
    check_flag,
    check_kind,
    check_one_of,
    check_pair,
    is_traced,
    shown,
    to_float,
)
from .._printing import Sketch
from .._types import Given, ScalarLike, State
from ..continuation.arclength import continue_branch
from ..continuation.branch import ENDINGS, Branch
from ..continuation.damped_newton import check_tolerance, factorise, solve
from ..continuation.implicit import attach_derivative, if_found
from ..cycles.branches import CyclePoint
from ..cycles.floquet import LEAST_VELOCITY, check_orbit, is_cycle
from ..cycles.orbit import AbstractOrbit
from ..cycles.phases import OTHER_EVENTS
from ..cycles.places import MET
from ..cycles.reading_phases import phases_of, slip_phases
from ..cycles.shooting import SMALL
from ..datasets import Variable, along, dataset, oscillators
from ..kinds.changes import NAMES
from ..kinds.fold import Fold
from ..kinds.hopf import Hopf
from ..kinds.kind import AbstractKind, Unknowns
from ..model.arguments import as_mass, as_model, as_parameter
from ..model.chain import require_smoothed
from ..model.model import AbstractModel
from ..model.parameters import parameter
from ..model.provenance import provenance_of
from ..observers.amplitude import amplitude_variables
from ..result import Outcome, Printed, SearchResult
from .equilibria import HopfPoint, HopfSystem, Rates, find_hopf_point, lyapunov_coefficient
from .grazing import Grazing

if TYPE_CHECKING:
    from xarray import Dataset

# Beside the length of the tangent: slopes of both parameters that vanish together at a cusp.
_CUSP = 1e-4
# Reasons besides those of a branch.
_ENDINGS = {
    "small": "The amplitude vanishes at the last point, at no known Hopf point.",
    "lost": "The last point is no cycle, by its speed, period or multipliers.",
}
# The greatest distance of the last fold from the generalised Hopf point, as a share of the curve.
_NEAR = 1e-2
# Of the last Newton step; the error is its square, or that of the integration.
_TOLERANCE = 1e-8
# The least share of the way to another model.
_LEAST_STEP = 1e-3
# Below it a parameter has no scale of its own.
_TINY = 1e-6
# Ends that a parameter which vanishes may cause, and its share of the greatest on the curve.
_VANISHING = ("small", "lost", "step_too_small", *OTHER_EVENTS)
_VANISHED = 1e-3


class _CycleEquations(eqx.Module):
    """R(U) = [F; g] with U = (u, p, ...) or, for a torus, (u, kappa, p, ...)."""

    orbit: Any
    kind: AbstractKind = eqx.field(static=True)

    @property
    def field(self) -> AbstractModel:
        """The model."""
        return self.orbit.field

    @property
    def names(self) -> tuple[str, str]:
        """The first and the second parameter."""
        return cast(tuple[str, str], self.orbit.parameter)

    @property
    def ends(self) -> tuple[str, ...]:
        """The tests at whose zero the curve ends."""
        return self.kind.curve_ends(self.orbit)

    @property
    def may_jump(self) -> tuple[str, ...]:
        """Tests that may jump, which is no special point."""
        return self.orbit.curve_ends

    @property
    def needs_belt(self) -> bool:
        """Whether there is no such point where the belt stops."""
        return self.orbit.forcing_periods is None

    def beyond(self, ended: str, U: np.ndarray) -> _CycleEquations | None:
        """The equations of the next piece, if the curve goes on where this one has ended."""
        orbit = self.orbit.beyond(ended, U[: self.orbit.size])
        return orbit and _CycleEquations(orbit, self.kind.beyond(orbit))

    def split(self, U: Array) -> Unknowns:
        """The parts of U."""
        m, k = self.orbit.size, self.kind.unknowns
        return Unknowns(U[:m], tuple(U[m + k :]), U[m])

    def values(self, U: Array) -> tuple[Array, Array, Any, Any]:
        """(R, [F_u F_p ...], further results, the vectors of g) from one integration."""
        z = self.split(U)
        r, slopes, extra = self.orbit.cycle(z.u, *z.parameters)
        g, vectors = self.kind.equation(self.orbit, z, slopes, extra)
        return jnp.append(r, g), slopes, extra, vectors

    def value(self, U: Array) -> Array:
        """R, for steps without new derivatives."""
        return self.values(U)[0] if self.kind.from_slopes else self.residual(U)

    def residual(self, U: Array) -> Array:
        """R, with derivatives, in every parameter of the model as well."""
        z, vectors = self.split(U), ()
        if self.kind.from_slopes:  # g has the slopes that it has with fixed vectors
            field = lax.stop_gradient(self.field)
            fixed = replace(self, orbit=replace(self.orbit, field=field))
            vectors = lax.stop_gradient(fixed.values(lax.stop_gradient(U))[3])
        gaps = self.orbit.residual(z.u, *z.parameters)
        return jnp.append(gaps, self.kind.fixed(self.orbit, z, vectors))

    def linearise(self, U: Array) -> tuple[Array, Array, Any]:
        """(R, its derivatives, further results)."""
        r, slopes, extra, vectors = self.values(U)
        m, k = self.orbit.size, self.kind.unknowns

        def g(U: Array) -> Array:
            return self.kind.fixed(self.orbit, self.split(U), vectors)

        top = [slopes[:, :m], jnp.zeros((len(slopes), k)), slopes[:, m:]]
        return r, jnp.concatenate([jnp.concatenate(top, axis=1), jax.jacfwd(g)(U)]), extra

    def weights(self, U: np.ndarray) -> np.ndarray:
        """Of the norm of steps, see `AbstractOrbit.weights`."""
        of_cycle = self.orbit.weights(1.0)[: self.orbit.size]
        return np.concatenate([of_cycle, np.ones(self.kind.unknowns), _relative(U[-2:])])

    def tests(self) -> dict[str, Callable[..., float]]:
        """The tests of `continue_branch`."""
        return self.kind.curve_tests(self.orbit)

    def stop(self, first: Any, extra: Any) -> str:
        """ "small" if the amplitude vanishes, "lost" if there is no cycle, else ""."""
        if not extra.sound:
            return "lost"
        small = self.orbit.forcing_periods is None and extra.speed < SMALL * first.speed
        return "small" if small else ""

    def cycles(self, unknowns: Sequence[np.ndarray]) -> list[tuple[Any, Any, Any]]:
        """(state, period, amplitude) of each."""
        return self.orbit.seen_at(
            np.array(unknowns)[:, : self.orbit.size], np.array(unknowns)[:, -2:]
        )

    def solved_at(self, curve: SpecialCurve, index: int, model: Any) -> SpecialCycle:
        """The special cycle of another model near point `index` of a curve."""
        U = jnp.asarray(curve.unknowns[index][:-1])
        settings = to_float(_TOLERANCE), jnp.asarray(30)
        return _checked(_in_steps(self, model, curve.names[0], U, *settings))


def _relative(values: np.ndarray) -> np.ndarray:
    """1 / |value|, or 1 for a value without a scale of its own."""
    return 1.0 / np.where(np.abs(values) < _TINY, 1.0, np.abs(values))


class _HopfEquations(eqx.Module):
    """R(U) = (f, g, product - kappa) with U = (y, kappa, p, q)."""

    rates: Rates
    second: str = eqx.field(static=True)
    kind, ends, may_jump = Hopf(), ("Bogdanov-Takens",), ("generalised Hopf",)

    @property
    def needs_belt(self) -> bool:
        """Whether there is no such point where the belt stops."""
        return self.field.dry

    def beyond(self, ended: str, U: np.ndarray) -> None:
        """Such a curve is one piece."""
        del ended, U

    @property
    def names(self) -> tuple[str, str]:
        """The first and the second parameter."""
        return str(self.rates.parameter), self.second

    def weights(self, U: np.ndarray) -> np.ndarray:
        """Of the norm of steps."""
        m = U.size - 3
        return np.append(np.full(m, m**-0.5), _relative(U[m:]))

    @property
    def field(self) -> AbstractModel:
        """The model."""
        return self.rates.field

    def tests(self) -> dict[str, Callable[..., float]]:
        """The tests of `continue_branch`; l1 jumps through infinity at no special point."""
        return {
            "Bogdanov-Takens": lambda u, *_: float(u[-2]),
            "generalised Hopf": lambda u, p, tangent, l1: float(l1),
        }

    def stop(self, first: Any, extra: Any) -> str:
        """Never, but at an end."""
        del first, extra
        return ""

    def cycles(self, unknowns: Sequence[np.ndarray]) -> list[tuple[Any, Any, Any]]:
        """(state, period, amplitude) of each, cycles of no amplitude."""
        of = []
        for *y, kappa, _, _ in unknowns:
            state = tuple(np.split(np.array(y), self.rates.m))
            period = 2 * np.pi / np.sqrt(kappa) if kappa > 0 else np.inf
            of.append((state, period, np.zeros_like(state[0])))
        return of

    def solved_at(self, curve: SpecialCurve, index: int, model: Any) -> HopfPoint:
        """The Hopf point of another model near point `index` of a curve."""
        first, state = curve.names[0], tuple(part[index] for part in curve.state)
        there = model.with_(**{first: curve.first[index]})
        return find_hopf_point(there, first, state, frequency=2 * np.pi / curve.period[index])

    def at(self, U: Array) -> tuple[Array, Rates, Array]:
        """(y, the rates with q set, p)."""
        field = self.rates.field.with_(**{self.second: U[-1]})
        return U[:-3], eqx.tree_at(lambda rates: rates.field, self.rates, field), U[-2]

    def residual(self, U: Array) -> Array:
        y, rates, p = self.at(U)
        near = jnp.sqrt(lax.complex(-lax.stop_gradient(U[-3]), jnp.zeros(())))
        one, other = (HopfSystem(rates, sign * near).eigenvalue(y, p) for sign in (1.0, -1.0))
        pair = jnp.stack([jnp.real(one + other), jnp.real(one * other) - U[-3]])
        return jnp.concatenate([rates(y, p), pair])

    value = residual

    def linearise(self, U: Array) -> tuple[Array, Array, Any]:
        y, rates, p = self.at(U)
        frequency = jnp.sqrt(jnp.maximum(U[-3], 0.0))
        l1 = lyapunov_coefficient(lambda y: rates(y, p), y, frequency)
        return self.residual(U), jax.jacfwd(self.residual)(U), l1


def _residual(U: Array, q: Any, equations: Any) -> Array:
    return equations.value(jnp.append(U, q))


def _linearise(U: Array, q: Any, equations: Any) -> tuple[Array, Array, Any]:
    return equations.linearise(jnp.append(U, q))


class SpecialCycle(Outcome):
    """A cycle at a special point, to all digits.

    - `kind`: "fold", "period doubling", "symmetry breaking" or "torus"; with dry friction also
      "grazing fold", "grazing", "release", "stick onset" or "two events".
    - `parameter`: the name of the parameter that was solved for, and `value` its value there.
    - `state`, `period`: of the cycle, as `find_limit_cycle` has them.
    - `residual`: of the equations, after `steps` Jacobians; `result`: the outcome.
    - `equations`, `unknowns`: those of the special cycle, and what solves them.  With dry friction
      the state is that after one of the events.

    See `find_special_cycle` for an example.
    """

    parameter: str = eqx.field(static=True)
    value: Float[Array, ""]
    state: State
    period: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    steps: Int[Array, ""]
    equations: _CycleEquations
    unknowns: Float[Array, " more"]

    @property
    def kind(self) -> str:
        """The name of the kind."""
        return self.equations.kind.name

    @property
    def orbit(self) -> AbstractOrbit:
        """The equations of the cycle."""
        return self.equations.orbit


def find_special_cycle(
    point: Any,
    model: Given[AbstractModel | None] = None,
    *,
    kind: Given[str | None] = None,
    mass: Given[int | None] = None,
    parameter: Given[str] = "belt_speed",
    tolerance: Given[ScalarLike] = _TOLERANCE,
    max_steps: Given[int] = 30,
    throw: bool = True,
) -> SpecialCycle:
    """The special cycle near a given point, of the same kind, for other parameters of the model.

    Solves the equations of the cycle and of the special point together, by damped Newton steps.

    **Arguments:**

    - `point`: one of those that `continue_special` takes, except "hopf".  With dry friction also a
      cycle close to a special one, a `LimitCycle` or (state, period).  Such a cycle and a
      `Grazing` must not be traced.
    - `model`: the model with other parameters, by default the same; its own value of the parameter
      is ignored.  If the search fails, it goes there in steps, unless `model` is traced.
    - `kind`, `mass` (by default that of the cycle), `parameter`, for such a cycle: "grazing" (the
      mass, while it slides, just reaches the speed of the belt), "release" (while it sticks, the
      force just reaches the static limit) or "stick onset" (it begins to stick where it passed the
      speed of the belt), and the name of the parameter that is solved for.
    - `tolerance`, `max_steps`: see `jaxchain.continuation.newton`.

    **Returns:** a `SpecialCycle`; `value`, `state` and `period` have first derivatives in every
    parameter of `model`.  It works under `jit` and `vmap`; there `throw` has no effect.

    **Raises:** `ValueError` for bad input, `RuntimeError` if no such cycle is found.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_cycle, find_limit_cycle, paper_chain
        >>> from jaxchain.boundaries import find_special_cycle
        >>> chain = paper_chain(1, belt_speed=1.5, width=0.05)
        >>> fold = continue_cycle(find_limit_cycle(chain)).of_kind("fold")[0]
        >>> def speed(damping):
        ...     return find_special_cycle(fold, chain.with_(damping_ratio=damping)).value
        >>> round(float(speed(0.05)), 8), round(float(jax.grad(speed)(0.05)), 3)
        (1.65930737, -24.069)
    """
    check_flag("throw", throw)
    limit = check_tolerance(tolerance, max_steps)
    if kind is None:
        equations, name, U = _start(point)
    else:
        equations, name, U = _of_dry_cycle(point, model, kind, mass, parameter)
    known = equations.field
    model = known if model is None else as_model(model)
    check_kind("model", model, type(known), "the model of `point`", "change its numbers.")
    if known.dry:
        model = model.with_(width=None)
    else:
        require_smoothed(model, "")
    found = _in_steps(equations, model, name, U, to_float(tolerance), jnp.asarray(limit))
    return _checked(found) if throw else found


def _in_steps(
    equations: _CycleEquations, model: Any, name: str, U: Array, *settings: Array
) -> SpecialCycle:
    """The special cycle of `model`; one that is too far is reached by models in between."""
    found = _find(equations, model, name, U, *settings)
    begin, done, step = equations.field, 0.0, 0.5
    if is_traced(found.successful) or jax.tree.structure(begin) != jax.tree.structure(model):
        return found
    while not found.successful and step > _LEAST_STEP:
        share = min(done + step, 1.0)
        there = jax.tree.map(lambda a, b, share=share: a + share * (b - a), begin, model)
        near = _find(equations, there, name, U, *settings)
        if near.successful:
            U, done, step = near.unknowns, share, 2.0 * step
            found = near if share == 1.0 else found
        else:
            step *= 0.5
    return found


def _checked(found: SpecialCycle) -> SpecialCycle:
    if not is_traced(found.successful) and not found.successful:
        raise RuntimeError(
            f"No {found.kind} in `{found.parameter}` was found near the given point: "
            f"{found.message} The branch of these points may turn on the way: follow it with "
            "`continue_special`."
        )
    return found


@eqx.filter_jit
def _find(
    given: _CycleEquations, model: Any, name: str, U: Array, tolerance: Array, limit: Array
) -> SpecialCycle:
    def equations(field: Any) -> _CycleEquations:
        return replace(given, orbit=replace(given.orbit, field=field, parameter=(name,)))

    fixed, weights = equations(lax.stop_gradient(model)), 1.0 / (1.0 + jnp.abs(U))

    def both(U: Array) -> tuple[Array, Any, Any]:
        value, slopes, extra = fixed.linearise(U)
        return value, factorise(slopes, weights), (jnp.max(jnp.abs(value)), extra)

    root, result, steps = solve(both, lax.stop_gradient(U), weights, tolerance, limit)
    left, extra = both(root)[2]
    result = SearchResult.where(jnp.isfinite(left), result, SearchResult.nonfinite)
    forced = given.orbit.forcing_periods is not None
    moves = extra.sound & ((extra.speed > LEAST_VELOCITY) | forced)
    lost = (result == SearchResult.successful) & ~moves
    result = SearchResult.where(lost, SearchResult.steady_sliding, result)
    more = (result == SearchResult.successful) & fixed.orbit.meets_more(extra)
    result = SearchResult.where(more, SearchResult.other_events, result)
    once = "A special cycle can be differentiated once only."
    live = equations(model)
    root = attach_derivative(_solved, root, live, once=once)
    root = if_found(result == SearchResult.successful, root)
    u, (value,), _ = live.split(root)
    _, state, period = live.orbit.unpack(u, value)
    return SpecialCycle(
        parameter=name, value=value, state=state, period=period, residual=left,
        result=result, steps=steps, equations=fixed, unknowns=root,
    )  # fmt: skip


def _solved(U: Array, equations: _CycleEquations) -> Array:
    return equations.residual(U)


def _start(point: Any) -> tuple[_CycleEquations, str, Array]:
    """(equations, name of the parameter, unknowns) of a special cycle."""
    remedy = "`continue_cycle(...).special` and dry `find_fold` have them."
    given = CyclePoint | SpecialCycle | Grazing
    check_kind("point", point, given, "a special point of cycles", remedy)
    if isinstance(point, Grazing):
        check_concrete("use `fold_belt_speed`.", point=point)
        if not point.successful:
            raise ValueError(f"Argument `point` is a search that failed. {point.message}")
        chain, touches = point.chain.with_(width=None), bool(point.touches)
        orbit, u = slip_phases(chain, point.state, point.period, point.mass, touches)
        equations = _CycleEquations(orbit, orbit.special_kind or Fold())
        return equations, "belt_speed", jnp.append(u, point.belt_speed)
    if isinstance(point, SpecialCycle):
        return point.equations, point.parameter, point.unknowns
    name = str(point.orbit.parameter)
    orbit = replace(point.orbit, parameter=(name,))
    kind, kappa = point.how.followed(orbit, point)
    U = jnp.asarray([*point.raw.u, *kappa, point.parameter])
    return _CycleEquations(point.orbit, kind), name, U


def _of_dry_cycle(
    point: Any, model: Any, kind: Any, mass: Any, name: Any
) -> tuple[_CycleEquations, str, Array]:
    """The same of a cycle with dry friction near a special one."""
    check_one_of("kind", kind, NAMES[:3])
    if is_cycle(point):
        field, state, period = point.chain, point.state, point.period
    elif isinstance(point, tuple | list) and len(point) == 2 and model is not None:
        field, (state, period) = model, point
    else:
        raise ValueError(
            "Argument `point` must be a `LimitCycle`, or (state, period) with a `chain`, if there "
            f"is a `kind`, but is {shown(point)}."
        )
    check_concrete("give a `SpecialCycle` as `point`.", chain=field, state=state, period=period)
    if not field.dry:
        raise ValueError(
            f'Argument `kind` = "{kind}" needs dry friction: "fold" and others of smoothed '
            "friction are found by `continue_cycle`."
        )
    state = check_orbit(field, state, period, 1e-9, "point")
    mass = as_mass(state[0].shape[0], mass, getattr(point, "mass", 0))
    value = as_parameter(field, name)
    orbit, u = phases_of(field, state, period, kind, mass)
    equations = _CycleEquations(orbit, cast(AbstractKind, orbit.special_kind))
    return equations, name, jnp.append(u, value)


@dataclass(frozen=True, repr=False)
class CurvePoint(Printed):
    """A point of a `SpecialCurve` at which more happens.

    `kind`, the parameters `first` and `second`; `error` of `second`, from the search; `index`: it
    lies between this point of the curve and the next; `unknowns`: as in `SpecialCurve`.

    See `continue_special` for an example.
    """

    kind: str
    first: float
    second: float
    error: float
    index: int
    unknowns: Float[np.ndarray, " more"]

    def _in_short(self) -> str:
        return f"{self.kind} at ({self.first:.6g}, {self.second:.6g})"


@dataclass(frozen=True, repr=False)
class SpecialCurve(Printed):
    """A curve of k special points in two parameters of a model, in order, as data on the host.

    - `kind`: "hopf", or that of a `SpecialCycle`, at the start; `kinds`: that of each point, which
      with dry friction changes between "grazing fold" and "fold"; `names` of both parameters,
      `first` and `second` (k,): their values.
    - `state`, m arrays (k, n); `period` (k,), of a Hopf point 2 pi / omega; `amplitude` (k, n);
      `residual` (k,): the greatest one of the equations.
    - `special`: tuple of `CurvePoint`, in order.  On curves of Hopf points "generalised Hopf" (l1
      = 0, where a curve of folds begins) and "Bogdanov-Takens" (omega = 0); on curves of folds
      "cusp"; on those of folds, period doublings and tori "1:1" and "1:2", where one more
      multiplier is 1 or -1, and "1:3", "1:4" for the angle of a torus; on all of them "extremum",
      where `second` turns back.  With dry friction "degenerate grazing", from where on slip cycles
      fold without a grazing, and as an end "persistence", V_- = 0, from where on a grazing is no
      fold.
    - `ended`: the reasons at the first and the last point: "generalised Hopf" (of folds, whose
      amplitude vanishes there), "Bogdanov-Takens", "1:1" or "1:2" (of a torus), "left_bounds",
      "closed", "max_points", "small" (the amplitude vanishes elsewhere), "lost", "belt_speed = 0"
      (without a belt that moves there is no cycle), such as "mu_dynamic = 0" for any parameter
      that must not be negative, ...; with dry friction also "another grazing", "another release",
      "another stick onset" and "two events", at one time; `message`: their texts.
    - `equations`, `unknowns` (k, ...): of each point what is solved, and its solution; NaN without
      a cycle.

    See `continue_special` for an example.
    """

    kind: str
    names: tuple[str, str]
    first: Float[np.ndarray, " k"]
    second: Float[np.ndarray, " k"]
    state: tuple[Float[np.ndarray, "k n"], ...]
    period: Float[np.ndarray, " k"]
    amplitude: Float[np.ndarray, "k n"]
    residual: Float[np.ndarray, " k"]
    special: tuple[CurvePoint, ...]
    ended: tuple[str, str]
    equations: tuple[Any, ...]
    unknowns: Float[np.ndarray, "k more"]

    def _sketch(self) -> Sketch:
        """The curve in the plane of its two parameters."""
        points = [(point.first, point.second, point.kind) for point in self.special]
        return Sketch(*self.names, [(self.first, self.second)], points)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kind of each point."""
        return tuple(equations.kind.name for equations in self.equations)

    @property
    def message(self) -> str:
        """The texts of both reasons."""
        return " ".join(
            f"It ends where {end}."
            if end.endswith(" = 0")
            else _ENDINGS.get(end) or ENDINGS.get(end, f"It ends in a point of kind {end}.")
            for end in self.ended
        )

    @property
    def chain(self) -> AbstractModel:
        """The model, with the parameters of the point that the curve was started from."""
        return self.equations[0].field

    def of_kind(self, kind: str) -> tuple[CurvePoint, ...]:
        """The special points of one kind."""
        return tuple(point for point in self.special if point.kind == kind)

    def at(self, index: int, model: Any = None) -> SpecialCycle | HopfPoint:
        """Point `index`, solved again for the first parameter, with derivatives in the others.

        `model`: the model with other parameters; by default the parameters stay.

        **Raises:** `RuntimeError` if no such point is found.
        """
        index = range(len(self.first))[index]
        u = self.unknowns[index]
        if not np.all(np.isfinite(u)):
            raise ValueError(
                f"Argument `index` = {shown(index)} is the end of the curve, where the amplitude "
                "is 0: give one next to it."
            )
        second = self.names[1]
        if model is None:
            model = self.chain.with_(**{second: u[-1]})
        return self.equations[index].solved_at(self, index, model)

    def to_dataset(self) -> Dataset:
        """The curve as an `xarray.Dataset` over `point`, with its special points over `special`.

        **Returns:** both parameters as coordinates along `point`, under their own names; `period`,
        `residual`, `point_kind` (point), `amplitude` (point, oscillator); for special points
        `special_kind`,
        `special_<number>` of both, `special_error`, `special_index`; the attributes `kind`,
        `first`, `second`, `ended_first`, `ended_last`, `parameters` and those of
        `CycleBranch.to_dataset`.
        """
        n, place = self.amplitude.shape[1], "it lies between this point of the curve and the next"

        def special(name: str, kind: type = float) -> np.ndarray:
            return np.array([getattr(point, name) for point in self.special]).astype(kind)

        def numbers(*columns: np.ndarray) -> dict[str, Variable]:
            rows = zip(map(parameter, self.names), columns, strict=True)
            return {row.name: Variable(v, (), row.unit, row.long_name) for row, v in rows}

        period = "period T, at a Hopf point 2 pi / omega"
        of_points = {
            "period": Variable(self.period, (), "1 / omega_n", period),
            "amplitude": amplitude_variables(jnp.asarray(self.amplitude), None)["amplitude"],
            "residual": Variable(self.residual, long_name="greatest residual, last but one"),
            "point_kind": Variable(self.kinds, (), None, "kind of the point"),
        }
        of_special = {
            "kind": Variable(special("kind", str), (), None, "kind of special point"),
            "error": Variable(special("error"), (), "1", "error of the second number there"),
            "index": Variable(special("index", int), (), "1", place),
            **numbers(special("first"), special("second")),
        }
        return dataset(
            along(of_points, "point") | along(of_special, "special", prefix="special_"),
            along(numbers(self.first, self.second), "point") | {"oscillator": oscillators(n)},
            provenance_of(
                self.chain,
                n,
                self.names,
                kind=self.kind,
                first=self.names[0],
                second=self.names[1],
                ended_first=self.ended[0],
                ended_last=self.ended[1],
            ),
        )


def continue_special(
    point: Any,
    second: Given[str],
    *,
    bounds: Mapping[str, tuple[Any, Any]] | None = None,
    step: Given[ScalarLike] = 0.05,
    max_step: Given[ScalarLike] = 0.1,
    max_points: Given[int] = 200,
    tolerance: Given[ScalarLike] = 1e-9,
    keep_part: bool = True,
) -> SpecialCurve:
    """Follows a special point as two parameters of the model change together, in both directions.

    Pseudo-arclength continuation of the equations of the cycle or equilibrium and of the special
    point, by damped Newton steps.

    **Arguments:**

    - `point`: a "fold", "period doubling", "symmetry breaking", "torus" or "hopf" of
      `continue_cycle(...).special`, with dry friction also a change of the sequence, or a zero of
      one of its `events`; a `HopfPoint` of `find_hopf_point`; a `SpecialCycle`; or, with
      dry friction, a `Grazing` of `find_fold`.  Its parameter is the first parameter.
    - `second`: the name of the second parameter, one for all cells.
    - `bounds`: the ranges of both, name -> (low, high), in which the curve stays; it also ends
      where a parameter of a `Chain` that must not be negative is 0, and cycles without a force end
      where the belt speed is.
    - `step`, `max_step`, `max_points` in each direction, `tolerance`, `keep_part` (after Ctrl-C):
      see `continue_branch`; lengths as in `continue_cycle`, with the second parameter relative
      to its first value.

    **Returns:** a `SpecialCurve`.

    **Raises:** `ValueError` for bad input; `RuntimeError` if there is no curve near the start;
    `KeyboardInterrupt` as `continue_branch`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_cycle, continue_special, find_limit_cycle, paper_chain
        >>> chain = paper_chain(1, belt_speed=1.5, width=0.05)
        >>> fold = continue_cycle(find_limit_cycle(chain)).of_kind("fold")[0]
        >>> curve = continue_special(fold, "damping_ratio", bounds={"damping_ratio": (0.04, 1.0)})
        >>> curve.ended
        ('left_bounds', 'generalised Hopf')
        >>> round(float(curve.second[-1]), 9), round(float(curve.first[-1]), 9)
        (0.291637021, 0.26834438)
    """
    remedy = "`continue_cycle(...).special`, `find_hopf_point` and dry `find_fold` have them."
    given = CyclePoint | SpecialCycle | Grazing | HopfPoint
    check_kind("point", point, given, "a special point of cycles or a `HopfPoint`", remedy)
    if isinstance(point, CyclePoint) and point.how == Hopf():
        point = _hopf_of(point)
    equations, U = _equations(point, second)
    first = equations.names[0]
    check_concrete("use `find_special_cycle` or `find_hopf_point`.", chain=equations.field)
    q = float(as_parameter(equations.field, second, "second"))
    if second == first:
        numbers = equations.field.parameters()
        others = sorted(k for k in numbers if np.shape(numbers[k]) == () and k != first)
        raise ValueError(
            f"Argument `second` must be another parameter than the first, `{first}`: one of "
            f"{others}."
        )
    U, ranges = np.append(U, q), _ranges(bounds, first, second)
    for name, value in zip(ranges, U[-2:], strict=True):
        if not ranges[name][0] <= value <= ranges[name][1]:
            raise ValueError(
                f"Argument `bounds` must contain the start, {name} = {value:.6g}, but is "
                f"{ranges[name]} for it."
            )
    limits = _limits(equations, U)
    ranges = {
        name: (max(low, limits[name][0]), min(high, limits[name][1]))
        for name, (low, high) in ranges.items()
    }
    options = {
        "step": step,
        "max_step": max_step,
        "max_points": max_points,
        "tolerance": tolerance,
        "keep_part": keep_part,
    }
    sides = [_side(equations, U, 1, ranges, options)]
    if sides[0].ended not in ("closed", "interrupted"):
        sides.append(_side(equations, U, -1, ranges, options))
    sides = [_named_zero(limits, side) for side in sides]
    return _joined(equations, sides)


def _equations(point: Any, second: Any) -> tuple[Any, Array]:
    """(the equations of the curve, their unknowns at its start)."""
    if isinstance(point, HopfPoint):
        y, field, first = jnp.concatenate(point.state), point.chain, point.parameter
        rates = Rates.of(field, len(point.state), first)
        U = jnp.append(y, jnp.stack([point.frequency**2, point.value]))
        return _HopfEquations(rates, second), U
    equations, first, U = _start(point)
    return replace(equations, orbit=replace(equations.orbit, parameter=(first, second))), U


def _hopf_of(point: CyclePoint) -> HopfPoint:
    """The Hopf point at which a branch of cycles ends."""
    name, state = str(point.orbit.parameter), tuple(map(jnp.asarray, point.state))
    chain = point.orbit.field.with_(**{name: point.parameter})
    return find_hopf_point(chain, name, state, frequency=2 * np.pi / point.period)


def _ranges(bounds: Any, *names: str) -> dict[str, tuple[float, float]]:
    bounds = {} if bounds is None else bounds
    check_kind("bounds", bounds, Mapping, "a mapping from names to (low, high)")
    for name in bounds:
        check_one_of("bounds", name, names)
    everything = (-np.inf, np.inf)
    remedy = "it is the range of a number."
    return {
        name: check_pair(f"bounds[{name!r}]", bounds.get(name, everything), remedy)
        for name in names
    }


def _limits(equations: Any, U: np.ndarray) -> dict[str, tuple[float, float]]:
    """The ranges of both parameters that have such points, on the side of the start."""
    limits = {}
    for name, value in zip(equations.names, U[-2:], strict=True):
        signed = equations.field.parameter(name).sign != "any"
        ends_at_0 = signed or (equations.needs_belt and name == "belt_speed" and value != 0)
        low, high = (-np.inf, 0.0) if value < 0 else (0.0, np.inf)
        limits[name] = (low, high) if ends_at_0 else (-np.inf, np.inf)
    return limits


class _Side(NamedTuple):
    """One half of a curve, from its start: its solutions and why it ends.

    `cycles`: (state, period, amplitude) of each.
    """

    unknowns: list[np.ndarray]
    residual: list[float]
    cycles: list[tuple[Any, Any, Any]]
    equations: list[Any]
    special: list[CurvePoint]
    ended: str


def _side(
    equations: Any,
    U: np.ndarray,
    direction: int,
    ranges: Mapping[str, tuple[float, float]],
    options: dict[str, Any],
) -> _Side:
    side = _piece(equations, U, direction, ranges, options)
    if isinstance(side, str):
        raise RuntimeError(
            f"No curve was found: {side} The given point may not be one of its kind, or may not "
            "depend on the second number."
        )
    while equations := equations.beyond(side.ended, side.unknowns[-1]):
        # Both pieces have one tangent there.
        before, meeting = side.unknowns[-2:]
        more = _piece(equations, meeting, int(np.sign(meeting[-1] - before[-1])), ranges, options)
        if isinstance(more, str):
            return side._replace(ended="step_too_small")
        shifted = [replace(p, index=p.index + len(side.unknowns) - 1) for p in more.special]
        rows = ([*a[:-1], *b] for a, b in zip(side[:4], more[:4], strict=True))
        side = _Side(*rows, special=[*side.special, *shifted], ended=more.ended)  # pyright: ignore[reportArgumentType]
    return side


def _piece(
    equations: Any,
    U: np.ndarray,
    direction: int,
    ranges: Mapping[str, tuple[float, float]],
    options: dict[str, Any],
) -> _Side | str:
    """One piece, or the reason why it has no first point."""
    tests, ((low, high), second), first = equations.tests(), ranges.values(), []
    weights = equations.weights(U)
    # Each look at a method makes a new object, which takes longer than the test.
    ends, done = equations.ends, equations.stop

    def edge(u: np.ndarray, *_: Any) -> float:
        return float(min(u[-1] - low, high - u[-1]))

    def stop(u: np.ndarray, *others: Any) -> Any:
        first.append(others[-1])
        passed = [name for name in ends if tests.get(name, edge)(u, *others) < -MET]
        return (passed or [edge(u) < 0 or done(first[0], first[-1])])[0]

    branch: Branch = continue_branch(
        _residual, U[:-1], U[-1], equations, direction=direction, bounds=second, weights=weights,
        tests={**tests, "edge": edge}, stop=stop, value_and_jacobian=_linearise, **options,
    )  # fmt: skip
    if not branch.p.size:
        return branch.message
    unknowns, residual = [*np.column_stack([branch.u, branch.p])], [*branch.residuals]
    ended, special = branch.reason or branch.ended, []
    for raw in branch.special:
        kind, z = raw.kind, np.append(raw.u, raw.p)
        begins = kind in equations.ends and np.allclose(z, U, rtol=1e-9, atol=1e-9)
        if begins or (kind in equations.may_jump and not raw.refined):
            continue
        if kind == Fold().name:
            slopes = np.abs(weights * raw.tangent)[-2:]
            kind = equations.kind.turn if max(slopes) < _CUSP else "extremum"
        if kind != "edge":
            error = raw.error if raw.refined else np.inf
            special.append(CurvePoint(kind, float(z[-2]), float(z[-1]), error, raw.index, z))
        if kind in (*equations.ends, "edge"):
            unknowns[raw.index + 1 :] = [z]
            residual[raw.index + 1 :] = [raw.residual]
            ended = "left_bounds" if kind == "edge" else kind
            break
    cycles = equations.cycles(unknowns)
    if equations.kind.meets_hopf and ended in ("small", "step_too_small"):
        meeting = _end_of_folds(equations, np.array(unknowns), ranges)
        if meeting is not None:
            ended, special = meeting.kind, [*special, replace(meeting, index=len(cycles) - 1)]
            *y, kappa, p, q = meeting.unknowns
            state = tuple(np.split(np.array(y), equations.orbit.m))
            unknowns.append(np.append(np.full(U.size - 2, np.nan), [p, q]))
            residual.append(residual[-1])
            cycles.append((state, 2 * np.pi / np.sqrt(kappa), np.zeros_like(state[0])))
    return _Side(unknowns, residual, cycles, [equations] * len(cycles), special, ended)


def _named_zero(limits: Mapping[str, tuple[float, float]], side: _Side) -> _Side:
    """The side; a parameter that vanishes at its end names the end, with its noise left out."""
    numbers = np.abs(np.array(side.unknowns)[:, -2:])
    small = {"left_bounds": _TINY, **dict.fromkeys(_VANISHING, _VANISHED)}.get(side.ended, -1.0)
    vanish = numbers[-1] <= small * np.max(numbers, axis=0)
    for name, vanishes in zip(limits, vanish, strict=True):
        if 0.0 in limits[name] and vanishes:
            last = len(side.unknowns) - 2
            special = [p for p in side.special if p.kind not in _VANISHING or p.index < last]
            end = side.unknowns[-1].copy()
            end[-2:] = np.clip(end[-2:], *np.transpose([*limits.values()]))
            unknowns = [*side.unknowns[:-1], end]
            return side._replace(ended=f"{name} = 0", special=special, unknowns=unknowns)
    return side


def _end_of_folds(
    equations: _CycleEquations, unknowns: np.ndarray, ranges: Mapping[str, Any]
) -> CurvePoint | None:
    """The generalised Hopf point near a fold of almost no amplitude, on the curve of Hopf points.

    There it is well conditioned; on the curve of folds the equations are noise divided by the
    amplitude.
    """
    (first, second), (p, q) = ranges, unknowns[-1, -2:]
    ((state, period, _),) = equations.cycles([unknowns[-1]])
    chain, frequency = equations.field.with_(**{first: p, second: q}), 2 * np.pi / period
    hopf = find_hopf_point(chain, first, state, frequency=frequency, throw=False)
    if not hopf.successful:
        return None
    curve = continue_special(hopf, second, step=1e-3, max_points=30, keep_part=False)
    size = np.max(np.abs(unknowns[:, -2:]), axis=0)

    def distance(point: CurvePoint) -> float:
        return float(np.max(np.abs([point.first - p, point.second - q]) / size))

    nearest = min(curve.of_kind("generalised Hopf"), key=distance, default=None)
    return None if nearest is None or distance(nearest) > _NEAR else nearest


def _joined(equations: Any, sides: list[_Side]) -> SpecialCurve:
    """The curve of both sides, from the end of the second to that of the first."""
    ahead, back = sides[0], sides[-1]
    before = len(back.unknowns) - 1 if len(sides) > 1 else 0

    def both(name: str) -> list[Any]:
        return [*getattr(back, name)[before:0:-1], *getattr(ahead, name)]

    special = [replace(p, index=before - 1 - p.index) for p in back.special[::-1] if before]
    special += [replace(p, index=before + p.index) for p in ahead.special]
    unknowns = np.array(both("unknowns"))
    states, period, amplitude = zip(*both("cycles"), strict=True)
    return SpecialCurve(
        kind=equations.kind.name, names=equations.names,
        first=unknowns[:, -2], second=unknowns[:, -1],
        state=tuple(map(np.stack, zip(*states, strict=True))), period=np.stack(period),
        amplitude=np.stack(amplitude), residual=np.array(both("residual")),
        special=tuple(special), ended=(back.ended, ahead.ended),
        equations=tuple(both("equations")), unknowns=unknowns,
    )  # fmt: skip
