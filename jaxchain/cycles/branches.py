"""Branches of cycles: where a localized vibration begins, folds, loses its symmetry, and ends.

A Jacobian of the shooting equations is one integration with the tangents of all 2n states and of
the parameter.  It contains the monodromy matrix, so the stability of a point costs almost nothing
more, even for a symmetric orbit, which has fewer equations.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.interpolate import BarycentricInterpolator

from .._checks import (
    check_concrete,
    check_function,
    check_kind,
    check_one_of,
    check_positive_number,
    check_whole,
    shown,
    to_float,
)
from .._final import final
from .._types import ArrayLike, Given, ScalarLike, State, StateLike
from ..continuation.arclength import (
    Switched,
    check_following,
    check_steps,
    check_walk,
    continue_branch,
    make_corrector,
    switch_branch,
)
from ..continuation.branch import (
    ENDINGS,
    Branch,
    Point,
    SpecialPoint,
    special_variables,
)
from ..continuation.corrector import Corrector
from ..continuation.special_points import Located, Test, polish, zero_error
from ..model.arguments import as_mass, as_parameter
from ..model.model import AbstractModel
from ..model.provenance import environment, parameters_of
from ..observers.amplitude import amplitude_variables
from ..observers.base import renamed
from ..result import Printed
from ..simulation.method import fit_linear_solve
from ..solvers.rosenbrock import Rodas5P
from .floquet import (
    LimitCycle,
    as_orbit,
    check_orbit,
    forcing_periods_of,
    scaled_peak_velocity,
)
from .phases import KINDS, CycleProperties, DryRun, Phases
from .sequences import Start, change_at, corrector_of, is_valid, sequence_of, tests_of, vanishing
from .shooting import CycleLinearisation, Shooting, linearise, residual
from .symmetry import (
    CycleSymmetry,
    Symmetry,
    action,
    as_symmetry,
    elements,
    finer,
    isotropy,
    label_of,
    ring_motions,
)
from .variational import ExtremesAndTrace, flow

if TYPE_CHECKING:
    from xarray import Dataset


# Tolerances of the integration and of Newton's method at special points.
RTOL, _TOLERANCE = 3e-11, 1e-9
_BREAKING = "symmetry breaking"
# How close to +1 multipliers of one special point are.
_UNIT = 1e-5
_SUBGROUPS = "it is the index of one of `point.symmetries`."
# Cycles that are integrated at once, in a sixth of the time.
_TOGETHER = 8
# A share of the parameter: closer to a change of the sequence another special point is part of it.
_SAME = 1e-7
# A share of the first belt speed, below which the belt stops.
_STOPPED = 1e-5
# The least amplitude of a family of cycles, over its first one.
_SMALL = 1e-3
# Arclength for the slope of a test; the error of a point where no better one can be solved.
_PROBE, _ROUGH = 1e-4, 1e-6


@final
@dataclass(frozen=True, repr=False)
class CyclePoint(Printed):
    """A special point of a branch of cycles.

    `kind`: "fold"; "hopf" (the amplitude vanishes, and the branch ends in steady sliding);
    "symmetry breaking" (a multiplier +1 of a disturbance that breaks the orbit's symmetry: a
    branch of less symmetric cycles crosses); "branch point" (the same without a symmetry); "period
    doubling" (-1); "torus" (a pair leaves the unit circle).  With dry friction also changes of the
    sequence of sticking and sliding: "grazing" (a mass that slides just touches the belt speed,
    and sticks shortly beyond), "release" (a mass that sticks slides shortly beyond), "stick onset"
    (it sticks where it passed the belt speed) or one of them the other way round, and "two events"
    (of two masses, which exchange their order); "grazing fold" and so on where `parameter` turns.
    `parameter`, `state` (of a chain `x` and `v`), `period`, `amplitude`, `multipliers` are those
    of this cycle; `refined`: whether the search converged, with a known error; `error`:
    of `parameter`, from the search and from the integration, which uses a tight tolerance; `raw`:
    the point of the equations, `shooting`; `scaled_peak_velocity` as in `CycleBranch`;
    `symmetries` of a "symmetry breaking": the subgroups, as `CycleSymmetry`, along which other
    branches leave, one of each class of conjugate ones.  A zero of one of `events` has its name as
    `kind`, and the function as `event`.

    See `continue_cycle` for an example.
    """

    kind: str
    parameter: float
    state: tuple[Float[np.ndarray, " n"], ...]
    period: float
    amplitude: Float[np.ndarray, " n"]
    multipliers: Complex[np.ndarray, " others"]
    refined: bool
    error: float
    raw: SpecialPoint
    shooting: Shooting | Phases
    scaled_peak_velocity: float
    symmetries: tuple[CycleSymmetry, ...] = ()
    event: Callable[[Any], Any] | None = None

    @property
    def x(self) -> Float[np.ndarray, " n"]:
        """The first variable of each cell, of a chain the displacements."""
        return self.state[0]

    @property
    def v(self) -> Float[np.ndarray, " n"]:
        """The second variable of each cell, of a chain the velocities."""
        return self.state[1]

    @property
    def index(self) -> int:
        """The index of the last point of the branch before it."""
        return self.raw.index


def refined(
    shooting: Shooting, weights: np.ndarray, tolerance: float, tests: Mapping[str, Test]
) -> Callable[[SpecialPoint], SpecialPoint]:
    """A result of a special point, from tightly integrated equations.

    It does not depend on the tolerance of the branch.  Its error is the change for a tolerance ten
    times as great, plus the remaining error of the search.
    """
    rtol = min(float(shooting.rtol), RTOL)
    correctors = [
        make_corrector(
            residual,
            linearise,
            replace(shooting, rtol=share * rtol),
            weights.size - 1,
            weights,
            min(tolerance, _TOLERANCE),
        )
        for share in (1.0, 10.0)
    ]

    def search(raw: SpecialPoint) -> SpecialPoint:
        find = _at_rest if raw.kind == "hopf" else _located
        tight, loose = (find(corrector, raw, tests) for corrector in correctors)
        if tight is None:
            return replace(raw, refined=False, error=np.inf)
        integration = np.inf if loose is None else abs(tight.p - loose.p)
        error = tight.error + integration
        return replace(tight, refined=tight.refined and bool(np.isfinite(error)), error=error)

    return search


def _located(
    corrector: Corrector, raw: SpecialPoint, tests: Mapping[str, Test]
) -> SpecialPoint | None:
    z = np.append(raw.u, raw.p)
    rough = corrector.rough(z, _ROUGH)
    start = corrector(z, raw.tangent) or rough(z, raw.tangent)
    if start is None:
        return None
    z = start.z + _PROBE * start.tangent
    beside = corrector(z, start.tangent, start) or rough(z, start.tangent, start)
    if beside is None:
        return None

    def test(point: Point) -> float:
        """The test function that vanishes at a special point of this kind."""
        if raw.kind == "fold":
            return float(point.tangent[-1])
        if raw.kind == "branch point":
            return point.sign * float(np.exp(min(point.logdet - beside.logdet, 300.0)))
        return float(tests[raw.kind](point.u, point.p, point.tangent, point.extra))

    slope = (test(beside) - test(start)) / _PROBE
    error = zero_error(corrector, start, test(start), slope)
    located = polish(corrector, Located(start, 0.0, 1.0, True, slope, error), test, 0.1)
    numbers = {
        name: getattr(located.point, name) for name in ("u", "p", "tangent", "extra", "residual")
    }
    return replace(raw, **numbers, left_over=abs(test(located.point)), error=located.error)


def _at_rest(corrector: Corrector, raw: SpecialPoint, tests: Any) -> SpecialPoint | None:
    """p in the limit of no amplitude a, from p = p_H + c a^2 + d a^4 + O(a^6).

    Three small amplitudes determine it; the error is the change due to the third one.
    """
    del tests
    z, points = np.append(raw.u, raw.p), []
    for length in (5e-3, 1e-2, 1.5e-2):  # from the Hopf point
        point = corrector(z - length * raw.tangent, raw.tangent)
        if point is None:
            return None
        points.append((float(point.extra.speed) ** 2, point.p))
    squares, located = zip(*points, strict=True)
    if len(set(squares)) < len(squares):
        return None
    two, three = (float(BarycentricInterpolator(squares[:k], located[:k])(0.0)) for k in (2, 3))
    return replace(raw, p=three, error=abs(three - two))


def hardly_felt(branch: Branch, raw: SpecialPoint, test: Test) -> bool:
    """Whether the change of sign of `test` is within the error of the multipliers.

    A localized vibration of many masses hardly depends on its position in the chain, so a shift is
    a disturbance with a multiplier of 1 to rounding, along the whole branch.
    """
    beside = raw.index, min(raw.index + 1, branch.p.size - 1)
    extras = [jax.tree.map(lambda leaf, k=k: leaf[k], branch.extra) for k in beside]
    return any(abs(test(raw.u, raw.p, raw.tangent, extra)) < 1e-8 for extra in extras)


def with_less_symmetry(
    shooting: Shooting, point: CyclePoint, symmetry: CycleSymmetry
) -> tuple[Shooting, SpecialPoint]:
    """The equations with this symmetry only, and the point with the direction that keeps it."""
    m, n, p, mass = shooting.m, shooting.n, point.parameter, shooting.mass
    own = symmetry.images[mass]  # the section is at the representative of its class
    images = tuple(mass if image == own else image for image in symmetry.images)
    full = replace(shooting, images=images, shift=symmetry.shift)
    _, null = breaking_disturbance(point.raw.extra, shooting, (symmetry.images, symmetry.shift))

    def packed(z: Any) -> Any:
        _, state, period = shooting.unpack(z[:-1], z[-1])
        return jnp.append(full.pack(state, period, z[-1]), z[-1])

    if shooting.forcing_periods is None:  # along the motion to the section
        field, start = full.at(p), tuple(map(jnp.asarray, point.state))
        pushes = tuple(jnp.asarray(part) for part in null.reshape(m, n))

        def turn(change: State) -> Array:
            def rate(y: State) -> Array:
                return field.second_rate(0.0, y)[mass]

            return jax.jvp(rate, (start,), (change,))[1]

        flow = field(0.0, start)
        null = null - float(turn(pushes) / turn(flow)) * np.concatenate(flow)

    def disturbed(share: Any) -> Any:
        pushes = null.reshape(m, n)
        state = tuple(a + share * b for a, b in zip(point.state, pushes, strict=True))
        return jnp.append(full.pack(state, point.period, p), p)

    z = jnp.append(point.raw.u, p)
    u, tangent = jax.jvp(packed, (z,), (jnp.asarray(point.raw.tangent),))
    _, other = jax.jvp(disturbed, (jnp.zeros(()),), (jnp.ones(()),))
    return full, replace(
        point.raw, u=np.asarray(u)[:-1], tangent=np.asarray(tangent), other=np.asarray(other)
    )


def cycles_at(
    u: Float[np.ndarray, "k m"], parameters: Float[np.ndarray, "k more"], shooting: Shooting
) -> tuple[Any, Float[np.ndarray, " k"], Float[np.ndarray, "k n"]]:
    """(state, period, amplitude) of k solutions; `linearise` has those of the iterates before."""
    k = len(u)
    rows = [np.minimum(first + np.arange(_TOGETHER), k - 1) for first in range(0, k, _TOGETHER)]
    parts = [_cycles_at(u[row], parameters[row], shooting) for row in rows]
    return jax.tree.map(lambda *part: np.concatenate(part)[:k], *parts)


@eqx.filter_jit
def _cycles_at(u: Any, parameters: Any, shooting: Shooting) -> tuple[Any, Array, Array]:
    def one(u: Array, parameters: Array) -> tuple[State, Array, Array]:
        field, state, period = shooting.unpack(u, *parameters)
        _, _, ((low, high, _, _),) = flow(
            field,
            state,
            period,
            rtol=shooting.rtol,
            solver=shooting.solver,
            observers=[ExtremesAndTrace()],
        )
        return state, period, (high - low) / 2

    return jax.vmap(one)(u, parameters)


def symmetry_breaking_basis(
    images: tuple[int, ...], m: int = 2, kept: tuple[int, ...] | None = None
) -> Float[np.ndarray, "two_n k"]:
    """An orthonormal basis of the disturbances of a state that break the symmetry of `images`.

    Those only that keep the symmetry of `kept`, by default none; all of these if it is the same.
    """
    groups = np.asarray(images)[:, None] == np.unique(images)[None, :]
    less = np.asarray(range(len(images)) if kept is None else kept)
    within = (less[:, None] == np.unique(less)[None, :]).astype(float)
    within /= np.sqrt(np.sum(within, axis=0))
    rest = np.linalg.svd(within.T @ groups)[0][:, groups.shape[1] :]
    return np.kron(np.eye(m), within if kept == images else within @ rest)


def return_of_broken(part: Any, shooting: Shooting, kept: Symmetry) -> tuple[Any, Any, float]:
    """(basis A, block, at): all but `kept` breaks where the block has the eigenvalue `at`.

    The block is A^T Q A, with Q after the shift of `kept`, from `part`, after that of `shooting`.
    If only shifts are lost, it is Q itself in disturbances that keep `images`, and `at` = -1.
    """
    images, shift, m = shooting.images, shooting.shift, shooting.m
    basis = symmetry_breaking_basis(images, m, kept[0])
    if kept[0] == images:
        return basis, basis.T @ part @ basis, -1.0
    at, share = kept[1] or (range(shooting.n), 1)
    return basis, basis.T @ action(part, shift, at, shooting.parts // share, m) @ basis, 1.0


def breaking_disturbance(
    extra: CycleLinearisation, shooting: Shooting, kept: Symmetry
) -> tuple[int, Float[np.ndarray, " two_n"]]:
    """(how many multipliers are +1, a disturbance of the last of them), see `breaking`."""
    basis, block, at = return_of_broken(np.asarray(extra.part), shooting, kept)
    null = basis @ np.linalg.svd(block - at * np.eye(len(block)))[2][-1]
    return int(np.sum(np.abs(np.linalg.eigvals(block) - at) < _UNIT)), null


def symmetries_of(
    extra: CycleLinearisation, shooting: Shooting, motions: list[np.ndarray]
) -> tuple[CycleSymmetry, ...]:
    """The subgroups along which branches leave a symmetry breaking."""
    images, shift, found = shooting.images, shooting.shift, []
    for kept in finer(motions, images, shift):
        count, null = breaking_disturbance(extra, shooting, kept)
        v, part = null.reshape(shooting.m, -1), np.asarray(extra.part)
        less, mirrored = isotropy(motions, images, v, shift, part)
        if count == 1 and elements(motions, *less) == elements(motions, *kept):
            label = label_of(motions, *kept)
            found.append(CycleSymmetry(label, kept[0], mirrored, kept[1]))
    return tuple(found)


def _signed(factors: Any) -> float:
    """The least modulus of the factors, with the sign of their product.

    It is linear in a factor that passes zero, for any other factors; a product of dozens is not.
    """
    if factors.size == 0:
        return 1.0
    return float(np.sign(np.prod(np.sign(factors.real[factors.imag == 0]))) * np.min(abs(factors)))


def breaking(extra: CycleLinearisation, shooting: Shooting, kept: Symmetry) -> float:
    """Zero if a disturbance that breaks the symmetry but for `kept` has a multiplier +1.

    It comes from A^T M A - 1.  M maps these disturbances onto themselves; the trivial multiplier
    belongs to the others.
    """
    _, block, at = return_of_broken(np.asarray(extra.part), shooting, kept)
    return _signed(np.linalg.eigvals(block) - at + 0.0j)


def doubling(extra: CycleLinearisation | CycleProperties) -> float:
    """Zero where a multiplier is -1."""
    return _signed(np.asarray(extra.multipliers) + 1.0)


def encircling(extra: CycleLinearisation | CycleProperties) -> float:
    """From |mu|^2 - 1 of all pairs: it changes its sign as a pair leaves the unit circle.

    Pairs of real multipliers count, too, as mu_i mu_j - 1, so that the sign does not change where
    a pair becomes real.  A zero of such a factor is not a bifurcation: see `on_the_circle`.
    """
    mu: Any = np.asarray(extra.multipliers)
    real = mu[mu.imag == 0].real
    i, j = np.triu_indices(real.size, 1)
    pairs = np.abs(mu[mu.imag > 0]) ** 2 - 1.0
    return _signed(np.concatenate([pairs, real[i] * real[j] - 1.0]) + 0.0j)


def on_the_circle(extra: CycleLinearisation | CycleProperties) -> bool:
    """Whether a complex pair of multipliers has modulus 1."""
    mu: Any = np.asarray(extra.multipliers)
    return bool(np.any(np.abs(np.abs(mu[mu.imag > 0]) - 1.0) < 1e-4))


def special_tests(
    shooting: Shooting, motions: list[np.ndarray]
) -> dict[str, Callable[..., float]]:
    """The tests of `continue_branch`: name -> function of (u, p, tangent, extra).

    "hopf": the amplitude vanishes, and the branch continues as its own mirror image.  Where the
    symmetry makes two multipliers pass +1 together, disturbances of less symmetry have one.
    """

    images, m, forced = shooting.images, shooting.m, shooting.forcing_periods is not None
    symmetric = len(set(images)) < len(images) or shooting.shift is not None
    of: dict[str, Callable[[Any], float]] = {}
    if not forced and not shooting.is_family:
        of["hopf"] = lambda extra: vanishing(float(extra.speed))
    # One multiplier besides the trivial one is never negative.
    if m * len(images) > 2 or forced:
        of |= {"period doubling": doubling, "torus": encircling}
    for kept in finer(motions, images, shooting.shift) if symmetric else []:
        of[f"{_BREAKING} {kept}"] = lambda extra, kept=kept: breaking(extra, shooting, kept)
    return {name: lambda u, p, tangent, extra, test=test: test(extra) for name, test in of.items()}


ENDS = (*KINDS, "hopf")
"""The tests at whose zero a piece of a branch of dry cycles ends."""


def dry_tests(orbit: Phases) -> dict[str, Callable[..., float]]:
    """The tests of `continue_branch` for a sequence of phases."""
    of: dict[str, Callable[..., float]] = dict(tests_of(orbit))
    if orbit.m * orbit.n > 2 or orbit.forcing_periods is not None:
        of["period doubling"] = lambda u, p, tangent, extra: doubling(extra)
        of["torus"] = lambda u, p, tangent, extra: encircling(extra)
    return of


def dry_cycles(
    rows: Sequence[tuple[Phases, np.ndarray, float]], mass: int, rtol: Any
) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
    """(state, period, amplitude, scaled peak velocity of `mass`) of dry cycles, at their cut."""
    orbit, d = rows[0][0], rows[0][0].m * rows[0][0].n
    forced = orbit.forcing_periods is not None
    columns = [
        (u[:d], u[d] if forced else 0.0, np.sum(u[-len(of.events) :]), p) for of, u, p in rows
    ]
    given, k = [np.array(column) for column in zip(*columns, strict=True)], len(rows)
    parts = []
    for first in range(0, k, _TOGETHER):
        some = [column[np.minimum(first + np.arange(_TOGETHER), k - 1)] for column in given]
        runs = DryRun(orbit.field, to_float(rtol), mass, orbit.forcing_periods)
        parts.append(_dry_cycles(runs, orbit.parameter, orbit.m, *some))
    return jax.tree.map(lambda *part: np.concatenate(part)[:k], *parts)


@eqx.filter_jit
def _dry_cycles(runs: DryRun, name: Any, m: int, y: Any, t0: Any, period: Any, p: Any) -> Any:
    def one(y: Array, t0: Array, period: Array, p: Array) -> Any:
        own = replace(runs, field=runs.field.with_(**{name: p}))
        state, _, seen = own.from_the_cut(tuple(jnp.split(y, m)), period, t0)
        low, high, fastest, _ = seen
        peaks = scaled_peak_velocity(own.field, fastest)
        return state, period, (high - low) / 2, peaks[runs.mass]

    return jax.vmap(one)(y, t0, period, p)


class NoBranchError(RuntimeError):
    """No cycle was found near the start of a branch."""


@final
@dataclass(frozen=True, repr=False)
class CycleBranch(Printed):
    """A branch of k cycles in order, as data on the host.

    - `parameter` (k,): its values; `name`: which argument of `Chain.with_` it is.
    - `state`, of a chain `x`, `v` (k, n): the states at the greatest velocity of mass `mass` along
      the belt (of what is forced, at t = 0; with dry friction where the belt releases a mass that
      sticks); `period` (k,).
    - `amplitude` (k, n): half peak-to-peak of each displacement; `energy` (k,): half the sum of
      squares of these.
    - `scaled_peak_velocity` (k,): max w / eps of that mass, negative for a slip cycle, see
      `LimitCycle`; NaN without friction.
    - `multipliers` (k, 2n - 1): without the trivial one, whose error is `trivial_defect` (k,) (NaN
      with dry friction, where the equations of the return leave it out), the
      greatest modulus first; `unstable` (k,): the number of multipliers outside the unit circle.
    - `special`: tuple of `CyclePoint`, in order; `ended`, `message`: why the branch ends.
    - `mass`: the index of the mass at whose greatest velocity the cycles are cut.
    - `pieces`: of each piece of the branch the equations, and the branch as their solution (with
      `counts`); more than one with dry friction, whose sequence of phases changes.  `shooting`,
      `branch`: of the last one.

    See `continue_cycle` for an example.
    """

    name: str
    parameter: Float[np.ndarray, " k"]
    state: tuple[Float[np.ndarray, "k n"], ...]
    period: Float[np.ndarray, " k"]
    amplitude: Float[np.ndarray, "k n"]
    scaled_peak_velocity: Float[np.ndarray, " k"]
    multipliers: Complex[np.ndarray, "k others"]
    trivial_defect: Float[np.ndarray, " k"]
    special: tuple[CyclePoint, ...]
    pieces: tuple[tuple[Shooting | Phases, Branch], ...]
    mass: int

    @property
    def shooting(self) -> Any:
        """The equations of the last piece."""
        return self.pieces[-1][0]

    @property
    def branch(self) -> Branch:
        """The last piece, as solution of its equations."""
        return self.pieces[-1][1]

    @property
    def x(self) -> Float[np.ndarray, "k n"]:
        """The first variable of each cell, of a chain the displacements."""
        return self.state[0]

    @property
    def v(self) -> Float[np.ndarray, "k n"]:
        """The second variable of each cell, of a chain the velocities."""
        return self.state[1]

    @property
    def energy(self) -> Float[np.ndarray, " k"]:
        """E = 1/2 sum_n A_n^2 of each cycle, of shape (k,)."""
        return 0.5 * np.sum(self.amplitude**2, axis=1)

    @property
    def unstable(self) -> Any:
        """The number of multipliers of each cycle outside the unit circle, of shape (k,)."""
        return np.sum(np.abs(self.multipliers) > 1.0 + 1e-7, axis=1)  # by more than rounding

    @property
    def symmetry(self) -> str:
        """The label of the symmetry of its cycles, "Z1" for none, see `CycleSymmetry`."""
        state = tuple(jnp.asarray(part[0]) for part in self.state)
        field = self.shooting.at(*[self.parameter[0]] * (self.shooting.parameter is not None))
        return label_of(ring_motions(field, state), self.shooting.images, self.shooting.shift)

    @property
    def ended(self) -> str:
        """The reason why the branch ends: see `Branch`."""
        return self.branch.ended

    @property
    def message(self) -> str:
        """The text of the reason why the branch ends, with a remedy."""
        return self.branch.message

    def of_kind(self, kind: str) -> tuple[CyclePoint, ...]:
        """The special points of one kind."""
        return tuple(point for point in self.special if point.kind == kind)

    def table(self) -> dict[str, np.ndarray]:
        """Columns for plots and files: name -> array of k rows."""
        return {
            self.name: self.parameter,
            "period": self.period,
            "amplitude": self.amplitude,
            "energy": self.energy,
            "scaled_peak_velocity": self.scaled_peak_velocity,
            "greatest_multiplier": np.abs(self.multipliers[:, 0]),
            "unstable": self.unstable,
        }

    def _named(self, states: list[np.ndarray]) -> Iterator[tuple[str, np.ndarray, str]]:
        """Name, values and unit of each variable of a cell."""
        field = self.shooting.field
        for i, part in enumerate(states):
            yield field.variable(i).name, part, field.variable(i).unit

    def to_dataset(self) -> Dataset:
        """The branch as an `xarray.Dataset`, with the names and units of those of `sweep`.

        Dimensionless; dimensions: `point`, in order along the branch, `oscillator` 1 ... n,
        `multiplier` 1 ... 2n - 1 without coordinate, and `special`.

        **Returns:** a dataset of

        - the parameter, a coordinate along `point` under its own name, such as `belt_speed`;
        - `amplitude` (point, oscillator), `energy`, `active_count`, as a sweep has them, so that
          both lie on top of each other; `period`; `displacement`, `velocity` (point, oscillator)
          where the cycle is cut; `scaled_peak_velocity`;
        - `multiplier_real`, `multiplier_imag` (point, multiplier), because NetCDF has no complex
          numbers;
        - `unstable_count`, `stable`, `trivial_defect` (point);
        - for each special point `special_kind`, `special_parameter` with its `special_error`,
          `special_index` (it lies between this point and the next) and `special_refined`, and also
          `special_amplitude`, `special_energy` and so on, up to the multipliers;
        - the attributes `parameter`, `parameters`, `ended`, `message`, `solver`, `rtol`,
          `cut_at_oscillator`, `images`, `shift`, `symmetry`, `versions`, `platform`, `created`.

        !!! example

            ```python
            branch = continue_cycle(find_limit_cycle(paper_chain(1, belt_speed=1.5, width=1e-2)))
            data = branch.to_dataset()
            data.energy.where(data.stable).max()  # of the stable cycles
            data.to_netcdf("branch.nc", engine="h5netcdf")
            ```
        """
        # xarray imports pandas, which would double the import time.
        from xarray import Dataset

        special, k = self.special, len(self.parameter)
        row = self.shooting.field.parameter(self.name)
        # All cycles; those of the special points come last.
        parameters, period, amplitude, multipliers = (
            np.stack([*getattr(self, name), *(getattr(point, name) for point in special)])
            for name in ("parameter", "period", "amplitude", "multipliers")
        )
        states = [
            np.stack([*part, *(point.state[i] for point in special)])
            for i, part in enumerate(self.state)
        ]
        scaled_peak_velocity = np.append(
            self.scaled_peak_velocity, [point.scaled_peak_velocity for point in special]
        )
        field = self.shooting.field
        time = field.time_unit
        speed = getattr(field, "belt_speed", None)
        speed = parameters if self.name == "belt_speed" else speed
        labels = renamed(amplitude_variables(jnp.asarray(amplitude), speed), field, 0)
        each, multiplier = ("oscillator",), ("multiplier",)
        of_cycles = {
            **{
                name: (v.dims, np.asarray(v.values), v.long_name, v.units)
                for name, v in labels.items()
            },
            "period": ((), period, "least period T", time),
            **{
                name: (each, part, f"{name} where the cycle is cut", unit)
                for name, part, unit in self._named(states)
            },
            "scaled_peak_velocity": (
                (),
                scaled_peak_velocity,
                "max w / eps of the mass that is cut",
                "1",
            ),
            "multiplier_real": (
                multiplier,
                np.real(multipliers),
                "real part of the multiplier",
                "1",
            ),
            "multiplier_imag": (multiplier, np.imag(multipliers), "imaginary part of it", "1"),
        }
        unstable, defect = self.unstable, self.trivial_defect
        of_points = {
            "unstable_count": ((), unstable, "multipliers beyond the unit circle", "1"),
            "stable": ((), unstable == 0, "whether no multiplier is beyond the unit circle", "1"),
            "trivial_defect": ((), defect, "error of the trivial multiplier", "1"),
        }

        def variables(prefix: str, dim: str, rows: slice, columns: Mapping[str, tuple]) -> dict:
            return {
                prefix + name: ((dim, *dims), values[rows], {"long_name": text, "units": units})
                for name, (dims, values, text, units) in columns.items()
            }

        at_special = special_variables(
            [(point.kind, point.parameter, point.error) for point in special],
            [(point.index, point.refined) for point in special],
            row.unit,
        )
        n, shooting = self.x.shape[1], self.shooting
        of_cycles.pop(self.name, None)  # a family over its period
        return Dataset(
            variables("", "point", slice(k), of_cycles | of_points)
            | at_special
            | variables("special_", "special", slice(k, None), of_cycles),
            coords={
                self.name: ("point", self.parameter, row.attrs),
                "oscillator": ("oscillator", np.arange(1, n + 1), {"long_name": "oscillator n"}),
            },
            attrs={
                "parameters": parameters_of(shooting.field, n, [self.name]),
                "parameter": self.name,
                "ended": self.ended,
                "message": self.message,
                "solver": repr(shooting.solver),
                "rtol": float(shooting.rtol),
                "cut_at_oscillator": self.mass + 1,
                "images": json.dumps(shooting.images),
                "shift": json.dumps(shooting.shift),
                "symmetry": self.symmetry,
                **environment(),
            },
        )


def continue_cycle(
    model: Given[AbstractModel | LimitCycle],
    state: Given[StateLike | None] = None,
    period: Given[ScalarLike | None] = None,
    *,
    parameter: Given[str] = "belt_speed",
    direction: Given[ArrayLike | str] = 1,
    bounds: tuple[Any, Any] | None = None,
    mass: Given[int | None] = None,
    images: Given[Sequence[int] | CycleSymmetry | None] = None,
    step: Given[ScalarLike] = 0.05,
    min_step: Given[ScalarLike] = 1e-6,
    max_step: Given[ScalarLike] = 0.3,
    max_points: Given[int] = 300,
    events: Mapping[str, Callable[[Any], Any]] | None = None,
    stop: Callable[[float, Any], Any] | None = None,
    progress: Callable[[int, Point], Any] | None = None,
    rtol: Given[ScalarLike] = RTOL,
    tolerance: Given[ScalarLike] = 1e-9,
    keep_part: bool = True,
) -> CycleBranch:
    """Follows a cycle as a parameter of the model changes, around folds, with stability.

    Pseudo-arclength continuation (`continue_branch`) of the shooting equations, with a section at
    the greatest velocity of one mass, in the coordinates u = (x_n, z_n = asinh(w_n / eps), ln T).
    In these the layer of a smoothed fold, of thickness O(eps), has the same width for all eps.

    With dry friction a cycle is a sequence of phases of sticking and sliding, and the unknowns are
    the state after one event and the duration of each phase.  Where the sequence changes, the
    branch goes on with the next one, and has a special point, see `CyclePoint`.  Multipliers
    contain the jumps at events; those that sticking erases are exactly 0.

    **Arguments:**

    - `model`, `state` = (x, v), `period`: a cycle, or near one, at the greatest velocity of mass
      `mass` (by default the fastest) in the direction of the belt; or all three in one
      `LimitCycle`.  A multiple of the minimal period is reduced to it.  The chain may be any
      `AbstractOscillators` or `AbstractCells`; forced ones are cut at t = 0.
    - `parameter`: "period" for cycles without damping, which are a family over their period and
      energy (the nonlinear normal mode, whose amplitude over frequency is the backbone curve);
      else a scalar argument of `Chain.with_`, or a field of other oscillators that is a
      scalar array (`coupling` is the constant of their springs); `bounds`: its range, at whose
      ends the branch ends; `direction`: 1 or -1, the sign of its first change.  At a fold of
      smoothed friction use "stick" or "slip" to start towards greater or smaller
      scaled_peak_velocity of that mass.
    - `images`: a symmetry of the cycle; entry i is the index of the mass that moves like mass i.
      Or a `CycleSymmetry`, as of `cycle_symmetry`, whose shift of time is kept, too.  The orbit
      keeps this symmetry; multipliers are those of all disturbances.  Ignored with dry friction.
    - `step`, `min_step`, `max_step`, `max_points`, `progress`, `tolerance`, `keep_part` (after
      Ctrl-C): see `continue_branch`; lengths are (mean of x^2 and z^2 of the others + z_j^2 +
      ln^2 T + p^2)^(1/2).
    - `events`: name -> function of a cycle, a number whose zeros are special points of this name:
      `{"one": lambda cycle: cycle.amplitude[0] - 1.0}`.  A cycle has `state`, `period`,
      `amplitude` and `multipliers`; `continue_special` follows what does not depend on the last.
    - `stop(p, linearisation)`: ends the branch where it is true.  The branch also ends at a Hopf
      point, where the amplitude vanishes.
    - `rtol`: tolerance of the integration; of dry cycles only that of states and amplitudes, whose
      branch is integrated to rounding.

    **Returns:** a `CycleBranch`, also after Ctrl-C.  The error of its points is about ten times
    `rtol`.  Special points use an `rtol` of at most 3e-11, and each has an `error`.

    **Raises:** `ValueError` for bad input; `RuntimeError`, with a remedy, if no cycle is found
    near the start; `KeyboardInterrupt` as `continue_branch`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_cycle, find_limit_cycle, paper_chain
        >>> cycle = find_limit_cycle(paper_chain(1, belt_speed=1.5, width=1e-2))
        >>> branch = continue_cycle(cycle)  # up, round the fold, and down to the Hopf point
        >>> [(point.kind, round(point.parameter, 6)) for point in branch.special]
        [('fold', 1.792456), ('hopf', 1.151293)]
        >>> dry = continue_cycle(find_limit_cycle(paper_chain(1, belt_speed=1.5, width=None)))
        >>> [(point.kind, round(point.parameter, 6)) for point in dry.special]
        [('grazing fold', 1.836601), ('hopf', 1.151293)]
    """
    check_following(stop, progress)
    events = _checked_events(events)
    if state is None and period is None and mass is None:
        mass = getattr(model, "mass", None)
    field, state, period = as_orbit(model, state, period)
    check_concrete("use `find_limit_cycle`.", model=field, state=state, period=period)
    state = check_orbit(field, state, period, rtol)
    n, velocity = state[0].size, field.value_and_rate(0.0, state)[1]
    mass = int(as_mass(n, mass, int(jnp.argmax(field.belt_direction() * velocity))))
    family = parameter == "period" and not field.has_parameter("period")
    if family and (field.dry or field.forcing_period() is not None):
        raise ValueError(
            'Argument `parameter` is "period", of which cycles without damping are a family, but '
            f"this model {'has dry friction' if field.dry else 'is forced'}: name a parameter of "
            "the model."
        )
    p = float(to_float(period) if family else as_parameter(field, parameter))
    options = {
        "step": step,
        "min_step": min_step,
        "max_step": max_step,
        "max_points": max_points,
        "progress": progress,
        "tolerance": tolerance,
        "keep_part": keep_part,
    }
    if field.dry:
        way = _sign(direction)  # all is checked before anything long starts
        check_steps(step, min_step, max_step)
        check_positive_number("tolerance", tolerance, "1e-9 is usual.")
        check_walk(p, (-np.inf, np.inf) if bounds is None else bounds, max_points, keep_part)
        begin = sequence_of(field, state, period, mass, parameter, float(tolerance))
        if begin is None:
            raise NoBranchError(
                "No sequence of sticking and sliding was found that has this cycle: give one of "
                "`find_limit_cycle`, or begin at another value of the parameter."
            )
        begin = begin._replace(direction=way * begin.direction)
        return _follow_dry(begin, mass, rtol, bounds, stop, options, events)
    solver = fit_linear_solve(Rodas5P(), field, float(rtol), state=state)
    images, shift = as_symmetry(images, field, state, mass)
    forcing_periods = forcing_periods_of(field, period)
    shooting = Shooting(
        field, rtol, solver, mass, images, parameter, len(state), forcing_periods, shift
    )
    u = np.asarray(shooting.pack(state, period, p))
    heading = direction
    if isinstance(direction, str):
        check_one_of("direction", direction, ("stick", "slip"))
        heading = np.zeros(u.size + 1)
        heading[shooting.z_index] = 1.0 if direction == "stick" else -1.0
    return _follow(shooting, u, p, heading, bounds, stop, options, events)


def _checked_events(events: Any) -> Mapping[str, Callable[[Any], Any]]:
    events = {} if events is None else events
    check_kind("events", events, Mapping, "a dict of functions")
    taken = ("fold", "branch point", "hopf", "torus", "period doubling", _BREAKING, *KINDS)
    for name, event in events.items():
        check_function(f"events[{name!r}]", event, "a cycle -> a number", 1)
        if not isinstance(name, str) or name.removesuffix(" fold") in taken:
            raise ValueError(
                f"Argument `events` must have names of its own, but has {shown(name)}: these are "
                f"kinds of special points, {', '.join(taken)}."
            )
    return events


def _tests_of(events: Mapping[str, Callable[[Any], Any]]) -> dict[str, Test]:
    return {
        name: lambda u, p, tangent, extra, event=event: float(event(extra))
        for name, event in events.items()
    }


def switch_cycle(
    branch: CycleBranch,
    point: CyclePoint,
    *,
    symmetry: Any = 0,
    side: Given[int] = 1,
    step: Given[ScalarLike] = 0.02,
    bounds: tuple[Any, Any] | None = None,
    stop: Callable[[float, Any], Any] | None = None,
    **options: Any,
) -> CycleBranch:
    """The other branch of cycles through a "symmetry breaking" or "branch point" of `branch`.

    At a symmetry breaking the other branch leaves along a disturbance with multiplier +1 and keeps
    a part of the symmetry only.  In a ring two multipliers may be +1 together; then one branch
    leaves for each of `point.symmetries`.  If it is `mirrored`, a rotation, a reflection or both
    map the half of `side` = -1 onto that of 1; otherwise they are two different ones.

    **Arguments:** `point`, one of `branch.special`; `symmetry`, the index of one of its
    `symmetries`; `step`, the distance of the first point of the other branch; all others as in
    `continue_cycle`.

    **Returns:** a `CycleBranch` that begins at that first point.

    **Raises:** `ValueError` for a point of another kind; `RuntimeError` if no other branch is
    found.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_cycle, find_limit_cycle, paper_chain
        >>> from jaxchain.cycles import switch_cycle
        >>> cycle = find_limit_cycle(paper_chain(3, belt_speed=1.36, width=0.05), mass=1)
        >>> mirrored = continue_cycle(  # the middle one vibrates, the others do the same
        ...     cycle, images=(0, 1, 0), direction=-1, bounds=(1.345, 1.37)
        ... )
        >>> point = mirrored.of_kind("symmetry breaking")[0]
        >>> other = switch_cycle(mirrored, point, max_points=3)
        >>> apart = abs(other.amplitude[-1, 0] - other.amplitude[-1, 2])  # no longer the same
        >>> round(point.parameter, 4), bool(apart > 0.01)
        (1.3523, True)
    """
    check_kind("branch", branch, CycleBranch, "one of `continue_cycle`")
    check_kind("point", point, CyclePoint, "one of `branch.special`")
    shooting, raw = point.shooting, point.raw
    if point.kind == "symmetry breaking":
        check_whole("symmetry", symmetry, 0, len(point.symmetries) - 1, _SUBGROUPS)
        shooting, raw = with_less_symmetry(
            cast(Shooting, shooting), point, point.symmetries[symmetry]
        )
    elif point.kind != "branch point":
        raise ValueError(
            'Argument `point` must be of kind "symmetry breaking" or "branch point", but is a '
            f'"{point.kind}": no other branch of cycles of this period crosses there.'
        )
    tolerance = options.setdefault("tolerance", 1e-9)
    switched: Switched = switch_branch(
        residual, raw, shooting, side=side, step=step, tolerance=tolerance,
        weights=shooting.weights(raw.p), value_and_jacobian=linearise,
    )  # fmt: skip
    if switched.u is None or switched.p is None:
        raise RuntimeError(switched.reason)
    defaults = {"min_step": 1e-6, "max_step": 0.3, "max_points": 300, "keep_part": True}
    options = {"step": step, **defaults, **options}
    start = switched.u, switched.p, cast(np.ndarray, switched.direction)
    if isinstance(shooting, Phases):
        return _follow_dry(Start(shooting, *start), branch.mass, RTOL, bounds, stop, options)
    return _follow(shooting, *start, bounds, stop, options)


def _follow(
    shooting: Shooting,
    u: np.ndarray,
    p: float,
    heading: Any,
    bounds: tuple[Any, Any] | None,
    stop: Callable[[float, Any], Any] | None,
    options: dict[str, Any],
    events: Mapping[str, Callable[[Any], Any]] = MappingProxyType({}),
) -> CycleBranch:
    less = len(set(shooting.images)) < shooting.n or shooting.shift is not None
    motions = ring_motions(shooting.field, shooting.unpack(jnp.asarray(u), p)[1]) if less else []
    weights = shooting.weights(p)
    tests = special_tests(shooting, motions) | _tests_of(events)
    first, forced = None, shooting.forcing_periods is not None

    def ends(u: np.ndarray, p: float, tangent: np.ndarray, extra: Any) -> Any:
        nonlocal first
        del u, tangent
        begins, first = first is None, first or extra
        if begins and extra.times_round > 1 and not forced:
            return True
        if shooting.is_family and extra.speed < _SMALL * first.speed:
            return "the amplitude vanishes"
        if not extra.sound:
            return "it is no longer a cycle, by its speed, period or trivial multiplier"
        if extra.speed <= 0 and not forced:
            return "the amplitude vanishes"
        state = tuple(map(jnp.asarray, extra.state))
        greatest = np.max(np.abs(shooting.field.value_and_rate(0.0, state)[1]))
        if extra.speed < 1e-2 * greatest and not forced:
            return f"mass {shooting.mass} hardly vibrates: cut the orbit at another"
        return stop is not None and stop(p, extra)

    branch = continue_branch(
        residual,
        u,
        p,
        shooting,
        direction=heading,
        weights=weights,
        tests=tests,
        stop=ends,
        bounds=(-np.inf, np.inf) if bounds is None else bounds,
        value_and_jacobian=linearise,
        **options,
    )
    extra, k = branch.extra, len(branch.p)
    if extra is None or not extra.sound[0]:
        raise NoBranchError(branch.message if extra is None else ENDINGS["no_start"])
    # The given period is a multiple of the minimal one.
    if extra.times_round[0] > 1 and not forced:
        if branch.ended == "interrupted":
            raise KeyboardInterrupt
        times = extra.times_round[0]
        once = branch.u[0] - np.append(np.zeros(u.size - 1), np.log(times))
        p = float(branch.p[0]) / (times if shooting.is_family else 1)
        return _follow(shooting, once, p, heading, bounds, stop, options, events)
    refine = refined(shooting, weights, options["tolerance"], tests)
    hopf = {point.index for point in branch.special if point.kind == "hopf"}
    special = []
    for raw in branch.special:
        # At zero amplitude the branch continues smoothly in its mirror image, which is not a fold.
        if raw.kind in ("fold", "branch point") and raw.index in hopf:
            continue
        of_multipliers = raw.kind in tests and raw.kind not in ("hopf", *events)
        if of_multipliers and hardly_felt(branch, raw, tests[raw.kind]):
            continue
        point = refine(raw) if raw.refined or raw.kind == "hopf" else raw
        if raw.kind != "torus" or on_the_circle(point.extra):
            e = point.extra
            state = tuple(map(np.asarray, e.state))
            orbit = state, float(e.period), e.amplitude, e.multipliers
            how = point.refined, float(point.error), point, shooting
            kind, subgroups = point.kind, ()
            if kind.startswith(_BREAKING):
                kind, subgroups = _BREAKING, symmetries_of(e, shooting, motions)
                if any(other.kind == kind and _same_point(other, point) for other in special):
                    continue  # it was seen in other disturbances, too
            peak = float(_scaled_peak_velocity(shooting, point.u[None])[0])
            special.append(
                CyclePoint(kind, point.p, *orbit, *how, peak, subgroups, events.get(kind))
            )
    # The last point may be its own mirror image, or no cycle.
    if not ((forced or extra.speed[-1] > 0) and extra.sound[-1]):
        k -= 1
    if not k:
        raise NoBranchError("The amplitude is 0 at the first point: start at a larger one.")
    state, period, amplitude = cycles_at(branch.u[:k], branch.p[:k, None], shooting)
    return CycleBranch(
        name=str(shooting.parameter or ""),
        parameter=branch.p[:k],
        state=state,
        period=period,
        amplitude=amplitude,
        scaled_peak_velocity=_scaled_peak_velocity(shooting, branch.u[:k]),
        multipliers=extra.multipliers[:k],
        trivial_defect=extra.trivial_defect[:k],
        special=tuple(special),
        pieces=((shooting, branch),),
        mass=shooting.mass,
    )


def _sign(direction: Any) -> int:
    if isinstance(direction, str) or np.ndim(direction) or direction not in (1, -1):
        raise ValueError(
            f"Argument `direction` must be 1 or -1 for dry friction, but is {shown(direction)}: "
            "it is the sign of the first change of the parameter."
        )
    return int(direction)


def _follow_dry(
    start: Start | None,
    mass: int,
    rtol: Any,
    bounds: tuple[Any, Any] | None,
    stop: Callable[[float, Any], Any] | None,
    options: dict[str, Any],
    events: Mapping[str, Callable[[Any], Any]] = MappingProxyType({}),
) -> CycleBranch:
    """A branch of dry cycles, piece by piece, see `cycles/sequences.py`."""
    pieces: list[tuple[Phases, Branch]] = []
    points: list[tuple[str, Phases, SpecialPoint]] = []
    room = np.inf if options["max_points"] is None else options["max_points"]
    limits = (-np.inf, np.inf) if bounds is None else bounds
    start_p = 0.0 if start is None else start.p
    while start is not None and room > 0:
        most = None if np.isinf(room) else int(room)
        try:
            branch, met = _dry_piece(start, limits, stop, events, options | {"max_points": most})
            before, orbit = sum(piece.p.size for _, piece in pieces), start.orbit
            room -= branch.p.size
            found = [
                (s.kind, orbit, s)
                for s in branch.special
                if _is_special(s) and (met is None or abs(s.p - met.p) > _SAME * abs(met.p))
            ]
            start = None
            if branch.ended == "interrupted":
                met = None
            if met is not None and met.kind == "hopf":
                corrector = corrector_of(orbit, met.p, options["tolerance"])
                rest = _at_rest(corrector, met, {}) or replace(met, refined=False, error=np.inf)
                found.append(("hopf", orbit, rest))
                branch = replace(branch, ended="stopped", reason="the amplitude vanishes")
            elif met is not None and _belt_stops(orbit, met.p, start_p):
                branch = replace(branch, ended="belt_speed = 0")
            elif met is not None:
                change = change_at(orbit, met, options["tolerance"])
                kind, start = change.kind, change.start
                if start is None:
                    reason = f"no sequence of phases was found beyond the {kind}"
                    branch = replace(branch, ended="stopped", reason=reason)
                elif (start.p - met.p) * (met.p - branch.p[-1]) < 0:
                    kind = f"{kind} fold"
                found.append((kind, change.orbit, change.raw))
                if room <= 0:
                    branch = replace(branch, ended="max_points", reason="")
            pieces.append((orbit, branch))
            points += [(kind, of, replace(s, index=s.index + before)) for kind, of, s in found]
        except KeyboardInterrupt:
            if not (options["keep_part"] and pieces):
                raise
            pieces[-1] = pieces[-1][0], replace(pieces[-1][1], ended="interrupted")
            break
    return _dry_branch(pieces, points, mass, rtol, events)


def _belt_stops(orbit: Phases, speed: float, first: float) -> bool:
    """Whether the belt stops there, without which no cycle is left."""
    driven = orbit.parameter == "belt_speed" and orbit.forcing_periods is None
    return driven and abs(speed) < _STOPPED * abs(first)


def _dry_piece(
    start: Start,
    bounds: tuple[Any, Any],
    stop: Callable[[float, Any], Any] | None,
    events: Mapping[str, Callable[[Any], Any]],
    options: dict[str, Any],
) -> tuple[Branch, SpecialPoint | None]:
    """(the branch of one sequence, the special point at which it ends, if it does)."""
    tests = dry_tests(start.orbit)

    def ends(u: np.ndarray, p: float, tangent: Any, extra: Any) -> Any:
        if not extra.sound:
            return "its phases are too long to be integrated accurately, or not finite"
        if any(tests[name](u, p, tangent, extra) > 0 for name in ENDS if name in tests):
            return "the sequence of phases changes"
        return stop is not None and stop(p, extra)

    branch = continue_branch(
        residual, start.u, start.p, start.orbit, direction=start.direction, bounds=bounds,
        weights=start.orbit.weights(start.p), tests=tests | _tests_of(events), stop=ends,
        value_and_jacobian=linearise, **options,
    )  # fmt: skip
    if not branch.p.size:
        raise NoBranchError(branch.message)
    met = min(
        (s for s in branch.special if s.kind in ENDS), key=lambda s: s.arclength, default=None
    )
    if met is not None:
        return branch.up_to(met.index, met.arclength), met
    last = jax.tree.map(lambda leaf: leaf[-1], branch.extra)
    if branch.p.size > 1 and not is_valid(start.orbit, last):
        branch = branch.up_to(branch.p.size - 2, branch.arclength[-1])
    return branch, None


def _is_special(point: SpecialPoint) -> bool:
    """Whether it is one; see `encircling`."""
    return point.kind != "torus" or on_the_circle(point.extra)


def _dry_branch(
    pieces: list[tuple[Phases, Branch]],
    points: list[tuple[str, Phases, SpecialPoint]],
    mass: int,
    rtol: Any,
    events: Mapping[str, Callable[[Any], Any]],
) -> CycleBranch:
    rows = [
        (orbit, u, p) for orbit, branch in pieces for u, p in zip(branch.u, branch.p, strict=True)
    ]
    k = len(rows)
    rows += [(orbit, raw.u, raw.p) for _, orbit, raw in points]
    state, period, amplitude, peak = dry_cycles(rows, mass, rtol)
    special = tuple(
        CyclePoint(
            kind, raw.p, tuple(part[i] for part in state), float(period[i]), amplitude[i],
            raw.extra.multipliers, raw.refined, raw.error + float(raw.extra.error), raw, orbit,
            float(peak[i]), event=events.get(kind),
        )
        for i, (kind, orbit, raw) in enumerate(points, k)
    )  # fmt: skip
    return CycleBranch(
        name=str(pieces[0][0].parameter),
        parameter=np.concatenate([branch.p for _, branch in pieces]),
        state=tuple(part[:k] for part in state),
        period=period[:k],
        amplitude=amplitude[:k],
        scaled_peak_velocity=peak[:k],
        multipliers=np.concatenate([branch.extra.multipliers for _, branch in pieces]),
        trivial_defect=np.full(k, np.nan),
        special=special,
        pieces=tuple(pieces),
        mass=mass,
    )


def _same_point(one: CyclePoint, other: SpecialPoint) -> bool:
    apart = abs(one.parameter - other.p)
    return apart <= max(one.error, other.error, 1e-8 * abs(other.p)) and (
        abs(one.raw.index - other.index) <= 1
    )


def _scaled_peak_velocity(shooting: Shooting, u: np.ndarray) -> np.ndarray:
    s = np.sinh(u[:, shooting.z_index])
    field = shooting.field
    switches = field.switching(0.0, jnp.zeros(shooting.n)) is not None
    return s if switches else np.full_like(s, np.nan)
