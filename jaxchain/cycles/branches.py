"""Branches of cycles: where a localized vibration begins, folds, loses its symmetry, and ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex, Float

from .._checks import check_kind
from .._final import final
from ..continuation.arclength import (
    Switched,
    check_following,
    continue_branch,
    switch_branch,
)
from ..continuation.branch import ENDINGS, Branch, Point
from ..result import Printed
from .bifurcation_tests import count_unstable, linearise, on_the_circle, orbit, special_tests
from .equations import as_heading, cycle_equations, cycle_weights
from .shooting import Shooting, residual
from .special_points import (
    RTOL,
    CyclePoint,
    as_cycle_point,
    at_rest,
    hardly_felt,
    refine,
    sharply,
    without_symmetry,
)

if TYPE_CHECKING:
    from xarray import Dataset

# Share of the greatest velocity below which that of the mass where the orbit is cut is too little.
_HARDLY = 1e-2
_UNSOUND = (
    "what was followed is no cycle any more, by its speed, its period or its trivial multiplier"
)
# Of `continue_branch`, for these unknowns.
_DEFAULTS: dict[str, Any] = {"min_step": 1e-6, "max_step": 0.3, "max_points": 300}


class NoBranchError(RuntimeError):
    """No cycle was found near the start of a branch."""


@final
@dataclass(frozen=True, repr=False)
class CycleBranch(Printed):
    """A branch of cycles, k points in order, as plain data on the host.

    - `parameter` (k,): its values; `name`: which argument of `Chain.with_` it is.
    - `x`, `v` (k, n): the states at the greatest velocity of mass `shooting.mass` in the direction
      of the belt; `period` (k,).
    - `amplitude` (k, n): half peak-to-peak of each displacement; `energy` (k,): half the sum of
      squares of these.
    - `closeness` (k,): max w / eps of that mass, negative for a slip cycle; NaN without friction.
    - `multipliers` (k, 2n - 1): but for the trivial one, whose error is `trivial_defect` (k,), the
      greatest modulus first; `unstable` (k,): how many lie beyond the unit circle.
    - `special`: tuple of `CyclePoint`, in order; `ended`, `message`: why the branch ends.
    - `shooting`, `branch`: the equations, and the branch as their solution (with `counts`).

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_cycle, find_limit_cycle, paper_chain
        >>> cycle = find_limit_cycle(paper_chain(1, belt_speed=1.5, width=1e-2))
        >>> branch = continue_cycle(cycle)
        >>> branch.name, branch.amplitude.shape == (branch.parameter.size, 1)
        ('belt_speed', True)
        >>> stable = branch.unstable == 0
        >>> top = branch.of_kind("fold")[0].parameter  # the greatest belt speed
        >>> bool(stable[0]), bool(stable[-1]), bool(branch.parameter.max() <= top)
        (True, False, True)
        >>> sorted(branch.table())[:4]  # columns for a data frame
        ['amplitude', 'belt_speed', 'closeness', 'energy']
    """

    name: str
    parameter: Float[np.ndarray, " k"]
    x: Float[np.ndarray, "k n"]
    v: Float[np.ndarray, "k n"]
    period: Float[np.ndarray, " k"]
    amplitude: Float[np.ndarray, "k n"]
    closeness: Float[np.ndarray, " k"]
    multipliers: Complex[np.ndarray, "k others"]
    trivial_defect: Float[np.ndarray, " k"]
    special: tuple[CyclePoint, ...]
    shooting: Shooting
    branch: Branch

    @property
    def energy(self) -> Float[np.ndarray, " k"]:
        """E = 1/2 sum_n A_n^2 of each cycle, of shape (k,)."""
        return 0.5 * np.sum(self.amplitude**2, axis=1)

    @property
    def unstable(self) -> Any:
        """How many multipliers of each cycle lie beyond the unit circle, of shape (k,)."""
        return count_unstable(self.multipliers)

    @property
    def ended(self) -> str:
        """Why the branch ends, in a word: see `Branch`."""
        return self.branch.ended

    @property
    def message(self) -> str:
        """Why the branch ends, with a remedy."""
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
            "closeness": self.closeness,
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
          where the cycle is cut; `closeness`;
        - `multiplier_real`, `multiplier_imag` (point, multiplier), because NetCDF has no complex
          numbers;
        - `unstable_count`, `stable`, `trivial_defect` (point);
        - of each special point `special_kind`, `special_parameter` with its `special_error`,
          `special_index` (it lies between this point and the next) and `special_refined`; and its
          `special_amplitude`, `special_energy` and so on, up to the multipliers;
        - the attributes `parameter`, `parameters`, `ended`, `message`, `solver`, `rtol`,
          `cut_at_oscillator`, `images`, `versions`, `platform`, `created`.

        !!! example

            ```python
            branch = continue_cycle(find_limit_cycle(paper_chain(1, belt_speed=1.5, width=1e-2)))
            data = branch.to_dataset()
            data.energy.where(data.stable).max()  # of the stable cycles
            data.to_netcdf("branch.nc", engine="h5netcdf")
            ```
        """
        from .dataset import branch_dataset

        return branch_dataset(self)


def continue_cycle(
    chain: Any,
    state: Any = None,
    period: Any = None,
    *,
    parameter: Any = "belt_speed",
    direction: Any = 1,
    bounds: tuple[Any, Any] | None = None,
    vibrating: Any = None,
    images: Any = None,
    step: Any = 0.05,
    min_step: Any = 1e-6,
    max_step: Any = 0.3,
    max_points: Any = 300,
    stop: Callable[[float, Any], Any] | None = None,
    progress: Callable[[int, Point], Any] | None = None,
    rtol: Any = RTOL,
    tolerance: Any = 1e-9,
) -> CycleBranch:
    """Follows a cycle as a number of the chain changes, round folds, with stability and crossings.

    Pseudo-arclength continuation (`continue_branch`) of the shooting equations, cut at the
    greatest velocity of one mass and measured by u = (x_n, z_n = asinh(w_n / eps), ln T): the
    layer in which a smoothed fold happens, of thickness O(eps), is as wide there as for any width.

    **Arguments:**

    - `chain`, `state` = (x, v), `period`: a cycle, or near one, at the greatest velocity of mass
      `vibrating` (by default the fastest) in the direction of the belt; or all three in one
      `LimitCycle`.  Of a period that is a multiple of the least one, the least is followed.  The
      chain may be any autonomous `AbstractOscillators`.
    - `parameter`: a scalar argument of `Chain.with_`, or a field of other oscillators that is a
      scalar array (`coupling` is their springs' constant); `bounds`: of it, where the branch ends;
      `direction`: 1 or -1, with which sign it begins to change.  At a fold nothing does:
      "stick" or "slip" sets out towards greater or smaller closeness of that mass.
    - `images`: a symmetry of the cycle, entry i the index of the mass that i does the same as.
      The orbit is followed within it; multipliers are those of all disturbances.
    - `step`, `min_step`, `max_step`, `max_points`, `progress`, `tolerance`: see `continue_branch`;
      lengths are (mean of x^2 and z^2 of the others + z_j^2 + ln^2 T + p^2)^(1/2).
    - `stop(p, linearisation)`: ends the branch where it is true.  It also ends where the amplitude
      vanishes, in a Hopf point.
    - `rtol`: tolerance of the integration.

    **Returns:** a `CycleBranch`, however it ended, also after Ctrl-C.  Its points err by some ten
    times `rtol`; its special points are those of an `rtol` of at most 3e-11, and each says its
    `error`.

    **Raises:** `ValueError` for arguments that cannot be; `RuntimeError`, with a remedy, if no
    cycle is found near the start.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_cycle, find_limit_cycle, paper_chain
        >>> cycle = find_limit_cycle(paper_chain(1, belt_speed=1.5, width=1e-2))
        >>> branch = continue_cycle(cycle)  # up, round the fold, and down to the Hopf point
        >>> [(point.kind, round(point.parameter, 6)) for point in branch.special]
        [('fold', 1.792456), ('hopf', 1.151293)]
    """
    check_following(stop, progress)
    shooting, u, p = cycle_equations(chain, state, period, parameter, vibrating, images, rtol)
    heading = as_heading(direction, shooting, u.size)
    return _follow(
        shooting, u, p, heading, bounds, stop,
        {"step": step, "min_step": min_step, "max_step": max_step, "max_points": max_points,
         "progress": progress, "tolerance": tolerance},
    )  # fmt: skip


def switch_cycle(
    branch: CycleBranch,
    point: CyclePoint,
    *,
    side: Any = 1,
    step: Any = 0.02,
    bounds: tuple[Any, Any] | None = None,
    stop: Callable[[float, Any], Any] | None = None,
    **options: Any,
) -> CycleBranch:
    """The other branch of cycles through a "symmetry breaking" or "branch point" of `branch`.

    At a symmetry-breaking point it leaves along the disturbance with multiplier +1, and is
    followed without the symmetry; the half of `side` = -1 is then the mirror image of that of 1.

    **Arguments:** `point`, one of `branch.special`; `step`, the distance of the first point of the
    other branch; all others as in `continue_cycle`.

    **Returns:** a `CycleBranch` that begins at that first point.

    **Raises:** `ValueError` for a point of another kind; `RuntimeError` if no other branch is
    found.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_cycle, find_limit_cycle, paper_chain
        >>> from jaxchain.cycles import switch_cycle
        >>> cycle = find_limit_cycle(paper_chain(3, belt_speed=1.36, width=0.05), vibrating=1)
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
    shooting, raw = branch.shooting, point.raw
    if point.kind == "symmetry breaking":
        shooting, raw = without_symmetry(shooting, point)
    elif point.kind != "branch point":
        raise ValueError(
            'Argument `point` must be of kind "symmetry breaking" or "branch point", but is a '
            f'"{point.kind}": no other branch of cycles of this period crosses there.'
        )
    tolerance = options.setdefault("tolerance", 1e-9)
    found: Switched = switch_branch(
        residual, raw, shooting, side=side, step=step, tolerance=tolerance,
        weights=cycle_weights(shooting, raw.p), value_and_jacobian=linearise,
    )  # fmt: skip
    if found.u is None or found.p is None:
        raise RuntimeError(found.reason)
    options = {"step": step, **_DEFAULTS, **options}
    return _follow(shooting, found.u, found.p, found.direction, bounds, stop, options)


def _follow(
    shooting: Shooting,
    u: np.ndarray,
    p: float,
    heading: Any,
    bounds: tuple[Any, Any] | None,
    stop: Callable[[float, Any], Any] | None,
    options: dict[str, Any],
) -> CycleBranch:
    weights, tests = cycle_weights(shooting, p), special_tests(shooting)
    times = None  # how often the first orbit is gone round within its period

    def ends(u: np.ndarray, p: float, tangent: np.ndarray, extra: Any) -> Any:
        nonlocal times
        del u, tangent
        if times is None:
            times = int(extra.times_round)
            if times > 1:
                return True
        if not extra.sound:
            return _UNSOUND
        if extra.speed <= 0:
            return "the amplitude vanishes"
        if extra.speed < _HARDLY * np.max(np.abs(extra.v)):
            return f"mass {shooting.mass} hardly vibrates any more: cut the orbit at another"
        return stop is not None and stop(p, extra)

    branch = continue_branch(
        residual, u, p, shooting, direction=heading, weights=weights, tests=tests, stop=ends,
        bounds=(-np.inf, np.inf) if bounds is None else bounds, value_and_jacobian=linearise,
        **options,
    )  # fmt: skip
    if branch.extra is None or not branch.extra.sound[0]:
        raise NoBranchError(branch.message if branch.extra is None else ENDINGS["no_start"])
    if times is not None and times > 1:
        once = branch.u[0] - np.append(np.zeros(u.size - 1), np.log(times))
        return _follow(shooting, once, float(branch.p[0]), heading, bounds, stop, options)
    correctors = sharply(shooting, weights, options["tolerance"])
    hopf = {point.index for point in branch.special if point.kind == "hopf"}
    special = []
    for raw in branch.special:
        # Where the amplitude vanishes the branch meets its own mirror image, smoothly: no fold.
        if raw.kind in ("fold", "branch point") and raw.index in hopf:
            continue
        if raw.kind == "hopf":
            p, error = at_rest(correctors, raw)
            point = replace(raw, p=p, error=error)
        elif raw.kind in tests and hardly_felt(branch, raw, tests[raw.kind]):
            continue
        else:
            point = refine(correctors, raw, tests) if raw.refined else raw
        if raw.kind != "torus" or on_the_circle(point.extra):
            special.append(as_cycle_point(point))
    extra, k = branch.extra, len(branch.p)
    # The last point may be its own mirror image, or no cycle.
    if k and not (extra.speed[-1] > 0 and extra.sound[-1]):
        k -= 1
    if not k:
        raise NoBranchError("The branch ends in rest at its first point: begin farther from it.")
    points = [orbit(u, p, shooting) for u, p in zip(branch.u[:k], branch.p[:k], strict=True)]
    x, v, period, amplitude = (np.stack(column) for column in zip(*points, strict=True))
    switches = shooting.field.switching(0.0, points[0][1]) is not None
    closeness = np.sinh(branch.u[:k, shooting.place]) if switches else np.full(k, np.nan)
    return CycleBranch(
        name=shooting.parameter or "",
        parameter=branch.p[:k],
        x=x,
        v=v,
        period=period,
        amplitude=amplitude,
        closeness=closeness,
        multipliers=extra.multipliers[:k],
        trivial_defect=extra.trivial_defect[:k],
        special=tuple(special),
        shooting=shooting,
        branch=branch,
    )
