"""Branches of cycles: where a localized vibration begins, folds, loses its symmetry, and ends.

A Jacobian of the shooting equations is one integration with the tangents of all 2n states and of
the parameter.  It contains the monodromy matrix, so the stability of a point costs almost nothing
more, even for a symmetric orbit, which has fewer equations.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

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
from .._printing import Sketch
from .._types import ArrayLike, Given, ScalarLike, StateLike
from ..continuation.arclength import (
    Switched,
    check_following,
    check_steps,
    check_walk,
    continue_branch,
    switch_branch,
)
from ..continuation.branch import ENDINGS, Branch, Point, SpecialPoint, special_variables
from ..datasets import Variable, along, dataset, oscillators
from ..kinds.changes import NAMES
from ..kinds.event import Event
from ..kinds.fold import BranchPoint, Fold
from ..kinds.kind import AbstractKind, AbstractTested
from ..model.arguments import as_mass, as_parameter
from ..model.model import AbstractModel
from ..model.provenance import provenance_of
from ..observers.amplitude import amplitude_variables
from ..observers.base import renamed
from ..result import Printed
from ..simulation.method import fit_linear_solve
from ..solvers.rosenbrock import Rodas5P
from .floquet import LimitCycle, as_orbit, check_orbit, forcing_periods_of
from .orbit import AbstractOrbit, Start, linearise, residual, units_of
from .phases import Phases
from .sequences import change_at, sequence_of
from .shooting import RTOL, Shooting
from .symmetry import CycleSymmetry, as_symmetry, label_of, ring_motions

if TYPE_CHECKING:
    from xarray import Dataset


_SUBGROUPS = "it is the index of one of `point.symmetries`."
# A share of the parameter: closer to the end of a piece another special point is part of it.
_SAME = 1e-7
# A share of the first value of a parameter that must be positive, below which it is 0.
_STOPPED = 1e-5
# What `continue_branch` finds without a test, and the names that are taken.
_ALWAYS = (Fold(), BranchPoint())
_TAKEN = ("fold", "branch point", "hopf", "torus", "period doubling", "symmetry breaking", *NAMES)


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
    the point of the equations, `orbit`; `scaled_peak_velocity` as in `CycleBranch`;
    `symmetries` of a "symmetry breaking": the subgroups, as `CycleSymmetry`, along which other
    branches leave, one of each class of conjugate ones.  A zero of one of `events` has its name as
    `kind`.  `how`: the kind as an object, see `jaxchain.kinds`.

    See `continue_cycle` for an example.
    """

    how: AbstractKind
    parameter: float
    state: tuple[Float[np.ndarray, " n"], ...]
    period: float
    amplitude: Float[np.ndarray, " n"]
    multipliers: Complex[np.ndarray, " others"]
    refined: bool
    error: float
    raw: SpecialPoint
    orbit: AbstractOrbit
    scaled_peak_velocity: float
    symmetries: tuple[CycleSymmetry, ...] = ()

    def _in_short(self) -> str:
        return f"{self.kind} at {self.parameter:.6g}"

    @property
    def kind(self) -> str:
        """The name of the kind."""
        return self.how.name

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


def hardly_felt(branch: Branch, raw: SpecialPoint, kind: AbstractTested, orbit: Any) -> bool:
    """Whether the change of sign of a test is within the error of the multipliers.

    A localized vibration of many masses hardly depends on its position in the chain, so a shift is
    a disturbance with a multiplier of 1 to rounding, along the whole branch.
    """
    beside = raw.index, min(raw.index + 1, branch.p.size - 1)
    extras = [jax.tree.map(lambda leaf, k=k: leaf[k], branch.extra) for k in beside]
    return any(abs(kind.test(orbit, extra)) < 1e-8 for extra in extras)


class NoBranchError(RuntimeError):
    """No cycle was found near the start of a branch."""


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
      `counts`); more than one with dry friction, whose sequence of phases changes.  `orbit`,
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
    pieces: tuple[tuple[AbstractOrbit, Branch], ...]
    mass: int

    def _sketch(self) -> Sketch:
        """The greatest amplitude over the parameter; dashed where cycles are unstable."""
        line = (self.parameter, np.max(self.amplitude, axis=1), self.unstable == 0)
        points = [(one.parameter, np.max(one.amplitude), one.kind) for one in self.special]
        return Sketch(self.name, "greatest amplitude", [line], points)

    @property
    def orbit(self) -> Any:
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
        field = self.orbit.at(*[self.parameter[0]] * (self.orbit.parameter is not None))
        return label_of(ring_motions(field, state), self.orbit.images, self.orbit.shift)

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
        special, k, field = self.special, len(self.parameter), self.orbit.field
        # All cycles; those of the special points come last.
        parameters, period, amplitude, peak, multipliers = (
            np.stack([*getattr(self, name), *(getattr(point, name) for point in special)])
            for name in ("parameter", "period", "amplitude", "scaled_peak_velocity", "multipliers")
        )
        speed = getattr(field, "belt_speed", None)
        speed = parameters if self.name == "belt_speed" else speed
        of_cycles = renamed(amplitude_variables(jnp.asarray(amplitude), speed), field, 0)
        of_cycles["period"] = Variable(period, (), field.time_unit, "least period T")
        for i, part in enumerate(self.state):
            name, unit, _ = field.variable(i)
            states = np.stack([*part, *(point.state[i] for point in special)])
            text = f"{name} where the cycle is cut"
            of_cycles[name] = Variable(states, ("oscillator",), unit, text)
        each, real, imaginary = ("multiplier",), np.real(multipliers), np.imag(multipliers)
        of_cycles |= {
            "scaled_peak_velocity": Variable(
                peak, long_name="max w / eps of the mass that is cut"
            ),
            "multiplier_real": Variable(real, each, "1", "real part of the multiplier"),
            "multiplier_imag": Variable(imaginary, each, "1", "imaginary part of it"),
        }
        of_cycles.pop(self.name, None)  # a family over its period

        def rows(part: slice) -> dict[str, Variable]:
            return {name: replace(v, values=v.values[part]) for name, v in of_cycles.items()}

        unstable, defect = self.unstable, self.trivial_defect
        stable = "whether no multiplier is beyond the unit circle"
        of_points = {
            "unstable_count": Variable(unstable, long_name="multipliers beyond the unit circle"),
            "stable": Variable(unstable == 0, long_name=stable),
            "trivial_defect": Variable(defect, long_name="error of the trivial multiplier"),
        }
        row, n, shooting = field.parameter(self.name), self.x.shape[1], self.orbit
        values = [point.parameter for point in special]
        return dataset(
            along(rows(slice(k)) | of_points, "point")
            | special_variables(special, values, row.unit)
            | along(rows(slice(k, None)), "special", prefix="special_"),
            {
                self.name: Variable(self.parameter, ("point",), row.unit, row.long_name),
                "oscillator": oscillators(n),
            },
            provenance_of(
                field,
                n,
                [self.name],
                parameter=self.name,
                ended=self.ended,
                message=self.message,
                solver=repr(shooting.solver),
                rtol=float(shooting.rtol),
                cut_at_oscillator=self.mass + 1,
                images=json.dumps(shooting.images),
                shift=json.dumps(shooting.shift),
                symmetry=self.symmetry,
            ),
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
    contain the jumps at events; those that sticking erases are exactly 0.  Of cells with several
    contacts or with stops the branch ends where an event comes or goes in a way that changes
    others.

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
      keeps this symmetry; multipliers belong to all disturbances.  Ignored with dry friction.
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
    own = _checked_events(events)
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
        return _follow(begin, mass, rtol, bounds, stop, options, own)
    solver = fit_linear_solve(Rodas5P(), field, float(rtol), state=state)
    images, shift = as_symmetry(images, field, state, mass)
    forcing_periods = forcing_periods_of(field, period)
    shooting = Shooting(
        field, rtol, solver, mass, images, parameter, len(state), forcing_periods, shift,
        units_of(field, state),
    )  # fmt: skip
    u = np.asarray(shooting.pack(state, period, p))
    heading = direction
    if isinstance(direction, str):
        check_one_of("direction", direction, ("stick", "slip"))
        heading = np.zeros(u.size + 1)
        heading[shooting.z_index] = 1.0 if direction == "stick" else -1.0
    return _follow(Start(shooting, u, p, heading), mass, rtol, bounds, stop, options, own)


def _sign(direction: Any) -> int:
    if isinstance(direction, str) or np.ndim(direction) or direction not in (1, -1):
        raise ValueError(
            f"Argument `direction` must be 1 or -1 for dry friction, but is {shown(direction)}: "
            "it is the sign of the first change of the parameter."
        )
    return int(direction)


def _checked_events(events: Any) -> list[Event]:
    events = {} if events is None else events
    check_kind("events", events, Mapping, "a dict of functions")
    for name, event in events.items():
        check_function(f"events[{name!r}]", event, "a cycle -> a number", 1)
        if not isinstance(name, str) or name.removesuffix(" fold") in _TAKEN:
            raise ValueError(
                f"Argument `events` must have names of its own, but has {shown(name)}: these are "
                f"kinds of special points, {', '.join(_TAKEN)}."
            )
    return [Event(name, function) for name, function in events.items()]


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
    if point.symmetries:
        check_whole("symmetry", symmetry, 0, len(point.symmetries) - 1, _SUBGROUPS)
    orbit, raw = point.how.start_of_other(point, symmetry)
    tolerance = options.setdefault("tolerance", 1e-9)
    switched: Switched = switch_branch(
        residual, raw, orbit, side=side, step=step, tolerance=tolerance,
        weights=orbit.weights(raw.p), value_and_jacobian=linearise,
    )  # fmt: skip
    if switched.u is None or switched.p is None:
        raise RuntimeError(switched.reason)
    defaults = {"min_step": 1e-6, "max_step": 0.3, "max_points": 300, "keep_part": True}
    options = {"step": step, **defaults, **options}
    start = Start(orbit, switched.u, switched.p, switched.direction)
    return _follow(start, branch.mass, RTOL, bounds, stop, options)


def _follow(
    start: Start,
    mass: int,
    rtol: Any,
    bounds: tuple[Any, Any] | None,
    stop: Callable[[float, Any], Any] | None,
    options: dict[str, Any],
    events: Sequence[Event] = (),
) -> CycleBranch:
    """A branch, with dry friction piece by piece, see `cycles/sequences.py`."""
    pieces: list[tuple[AbstractOrbit, Branch]] = []
    points: list[tuple[AbstractKind, AbstractOrbit, SpecialPoint]] = []
    first_p = start.p
    given = (-np.inf, np.inf) if bounds is None else bounds
    wanted = check_walk(first_p, given, options["max_points"], options["keep_part"])
    limits = _within_domain(start.orbit, first_p, wanted)
    room = np.inf if options["max_points"] is None else options["max_points"]
    following: Start | None = start
    while following is not None and room > 0:
        most = None if np.isinf(room) else int(room)
        try:
            piece = _piece(following, limits, stop, events, options | {"max_points": most})
            if isinstance(piece, Start):
                following = piece
                continue
            branch, found, met = piece
            before, orbit = sum(one.p.size for _, one in pieces), following.orbit
            points += [(how, of, replace(s, index=s.index + before)) for how, of, s in found]
            pieces.append((orbit, branch))  # kept if what follows is interrupted
            following, ends = None, []
            room -= branch.p.size
            met = None if branch.ended == "interrupted" else met
            if met is not None and not met.how.goes_on:
                branch = replace(branch, ended="stopped", reason="the amplitude vanishes")
                ends = [(met.how, orbit, orbit.exact(met.how, met.raw, options["tolerance"]))]
            elif met is not None and _belt_stops(orbit, met.raw.p, first_p):
                branch = replace(branch, ended="belt_speed = 0")
            elif met is not None:
                passage = change_at(cast(Phases, orbit), met.raw, options["tolerance"])
                ends = [(passage.kind, passage.orbit, passage.raw)]
                if (following := passage.start) is None:
                    reason = f"no sequence of phases was found beyond the {passage.kind.name}"
                    branch = replace(branch, ended="stopped", reason=reason)
                elif room <= 0:
                    branch = replace(branch, ended="max_points", reason="")
            elif branch.ended == "left_bounds" and wanted[0] < branch.p[-1] == limits[0]:
                reason = f"{orbit.parameter} = 0, the end of its domain"
                branch = replace(branch, ended="stopped", reason=reason)
            pieces[-1] = orbit, branch
            points += [(how, of, replace(s, index=s.index + before)) for how, of, s in ends]
        except (KeyboardInterrupt, NoBranchError) as error:
            stopped = isinstance(error, KeyboardInterrupt)
            if not pieces or (stopped and not options["keep_part"]):
                raise
            reason = "" if stopped else "no point of the next sequence of phases was found"
            ended = "interrupted" if stopped else "stopped"
            pieces[-1] = pieces[-1][0], replace(pieces[-1][1], ended=ended, reason=reason)
            break
    return _joined(pieces, points, mass, rtol)


def _within_domain(
    orbit: AbstractOrbit, p: float, bounds: tuple[float, float]
) -> tuple[float, float]:
    """The part of `bounds` in which the model has a meaning."""
    sign = "any" if orbit.is_family else orbit.field.parameter(str(orbit.parameter)).sign
    least = {"any": -np.inf, "nonnegative": 0.0, "positive": _STOPPED * abs(p)}[sign]
    return max(bounds[0], least), bounds[1]


def _belt_stops(orbit: AbstractOrbit, speed: float, first: float) -> bool:
    """Whether the belt stops there, without which no cycle is left."""
    driven = orbit.parameter == "belt_speed" and orbit.forcing_periods is None
    return driven and abs(speed) < _STOPPED * abs(first)


class _Met(NamedTuple):
    """A special point at which a piece ends."""

    how: AbstractKind
    raw: SpecialPoint


def _piece(
    start: Start,
    bounds: tuple[float, float],
    stop: Callable[[float, Any], Any] | None,
    events: Sequence[Event],
    options: dict[str, Any],
) -> Start | tuple[Branch, list[tuple[AbstractKind, AbstractOrbit, SpecialPoint]], _Met | None]:
    """(one piece, its special points, the one at which it ends); or a better start."""
    orbit, first, once = start.orbit, None, None
    tested = {kind.key: kind for kind in (*orbit.kinds(start.u, start.p), *events)}
    kinds = tested | {kind.key: kind for kind in _ALWAYS}

    def ends(u: np.ndarray, p: float, tangent: np.ndarray, extra: Any) -> Any:
        nonlocal first, once
        del tangent
        if first is None:
            first, once = extra, orbit.with_least_period(u, p, extra)
        lost = "it goes round several times" if once else orbit.lost(first, extra)
        return lost or (stop is not None and stop(p, extra))

    branch = continue_branch(
        residual,
        start.u,
        start.p,
        orbit,
        direction=start.direction,
        bounds=bounds,
        weights=orbit.weights(start.p),
        tests={key: kind.along(orbit) for key, kind in tested.items()},
        stop=ends,
        value_and_jacobian=linearise,
        **options,
    )
    if branch.extra is None:
        raise NoBranchError(branch.message)
    if not branch.extra.sound[0]:
        raise NoBranchError(ENDINGS["no_start"])
    if once is not None:
        if branch.ended == "interrupted":
            raise KeyboardInterrupt
        return once._replace(direction=start.direction)
    ending = [raw for raw in branch.special if kinds[raw.kind].is_end]
    last = min(ending, key=lambda raw: raw.arclength, default=None)
    if last is not None:
        branch = branch.up_to(last.index, last.arclength)
    elif not orbit.is_valid(jax.tree.map(lambda leaf: leaf[-1], branch.extra)):
        if branch.p.size == 1:
            raise NoBranchError(
                "The first point is no cycle of its own, as of amplitude 0: start at a larger one."
            )
        branch = branch.up_to(branch.p.size - 2, branch.arclength[-1])
    met = last and _Met(kinds[last.kind], last)
    found: list[tuple[AbstractKind, AbstractOrbit, SpecialPoint]] = []
    for raw in branch.special:
        kind = kinds[raw.kind]
        if met is not None and _is_part_of(met, raw, kind):
            continue
        if kind.of_multipliers and hardly_felt(branch, raw, tested[raw.kind], orbit):
            continue
        point = orbit.exact(kind, raw, options["tolerance"])
        # A symmetry breaking is seen in other disturbances, too.
        seen = (_same_point(other, point) for how, _, other in found if how.name == kind.name)
        if kind.happens(point.extra) and not (kind.of_multipliers and any(seen)):
            found.append((kind, orbit, point))
    return branch, found, met


def _is_part_of(met: _Met, raw: SpecialPoint, kind: AbstractKind) -> bool:
    """Whether a special point is the end of a piece itself.

    At zero amplitude the branch continues smoothly in its mirror image, which is no fold.
    """
    at_rest = not met.how.goes_on and raw.index == met.raw.index and kind in _ALWAYS
    return at_rest or abs(raw.p - met.raw.p) <= _SAME * abs(met.raw.p)


def _joined(
    pieces: list[tuple[AbstractOrbit, Branch]],
    points: list[tuple[AbstractKind, AbstractOrbit, SpecialPoint]],
    mass: int,
    rtol: Any,
) -> CycleBranch:
    """The branch of all pieces, with its states, amplitudes and special points."""
    rows = [
        (orbit, u, p) for orbit, branch in pieces for u, p in zip(branch.u, branch.p, strict=True)
    ]
    k = len(rows)
    orbit = pieces[0][0]
    state, period, amplitude, peak = orbit.cycles(
        rows, [(of, raw) for _, of, raw in points], mass, rtol
    )
    special = tuple(
        CyclePoint(
            how, raw.p, tuple(part[i] for part in state), float(period[i]), amplitude[i],
            raw.extra.multipliers, raw.refined, float(raw.error), raw, of, float(peak[i]),
            how.subgroups(of, raw.extra),
        )
        for i, (how, of, raw) in enumerate(points, k)
    )  # fmt: skip
    extras = [branch.extra for _, branch in pieces]
    return CycleBranch(
        name=str(orbit.parameter or ""),
        parameter=np.concatenate([branch.p for _, branch in pieces]),
        state=tuple(part[:k] for part in state),
        period=period[:k],
        amplitude=amplitude[:k],
        scaled_peak_velocity=peak[:k],
        multipliers=np.concatenate([extra.multipliers for extra in extras]),
        trivial_defect=np.concatenate([extra.trivial_defect for extra in extras]),
        special=special,
        pieces=tuple(pieces),
        mass=mass,
    )


def _same_point(one: SpecialPoint, other: SpecialPoint) -> bool:
    apart = abs(one.p - other.p)
    near = abs(one.index - other.index) <= 1
    return near and apart <= max(one.error, other.error, 1e-8 * abs(other.p))
