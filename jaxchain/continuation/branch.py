"""What continuation returns: a branch, its special points, and why it ended.

Everything here is plain data on the host, in NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from .._printing import Printed, Sketch
from ..datasets import Variable, along, dataset, oscillators

if TYPE_CHECKING:
    from xarray import Dataset

ENDINGS = {
    "max_points": "The branch has as many points as asked. Allow more (`max_points`).",
    "stopped": "`stop` was true at the last point.",
    "left_bounds": "The parameter reached `bounds`, on which the branch ends.",
    "belt_speed = 0": (
        "The belt stops there: masses with dry friction do not slide any more, but stick, each in "
        "an interval of displacements. See `find_equilibrium`."
    ),
    "closed": "The branch came back to its first point.",
    "no_start": (
        "No point of the branch was found near the start. Start closer to a solution; at a fold, "
        "or with a vertical branch, give `direction` as a vector."
    ),
    "step_too_small": (
        "No step of at least `min_step` was both solved and smooth: the branch ends, has a corner "
        "or leaves where the residual is finite, or `tolerance` is below the residual's noise. "
        "Loosen `tolerance`, or lower `min_step`."
    ),
    "interrupted": "Interrupted from the keyboard; the points up to there are kept.",
}
"""The reasons for which a branch ends, each with its explanation and a remedy."""


@dataclass(frozen=True)
class Point:
    """One solved point z = [u; p], with its tangent and the determinant of its Jacobian.

    `tangent` = dz/ds has length 1 in the weighted norm and looks ahead; `sign` and `logdet` belong
    to det [F_z; tangent^T], which is zero where branches cross; `residual` = max |F|
    before the last Newton step, after which it is much smaller.  `last_step` is the weighted
    length of that step: the error of z is smaller, but the Jacobian and the tangent belong to the
    point before the step.
    """

    z: Float[np.ndarray, " m_plus_1"]
    tangent: Float[np.ndarray, " m_plus_1"]
    jacobian: Float[np.ndarray, "m m_plus_1"]
    sign: float
    logdet: float
    residual: float
    last_step: float
    contraction: float
    extra: Any = None

    @property
    def u(self) -> Float[np.ndarray, " m"]:
        """z without its last entry, of shape (m,)."""
        return self.z[:-1]

    @property
    def p(self) -> float:
        """The parameter, the last entry of z."""
        return float(self.z[-1])


@dataclass(frozen=True, repr=False)
class SpecialPoint(Printed):
    """A fold, a branch point, or a zero of one of the given tests, on a branch.

    `kind` is "fold", "branch point" or the name of the test; it lies between the points `index`
    and `index` + 1 at `arclength`.  `u` (m,) and `p` are the solution there, `residual` = max |F|,
    `tangent` (m + 1,) and `extra` as in `Branch`.  `left_over` is the test function there,
    relative to its values at these two points, and `refined` whether it is zero (a test that jumps
    has no zero).  `error` bounds the error of `p`: the greatest change in the last steps of the
    search.  `other` is the direction in which another branch leaves a branch point, orthogonal to
    `tangent`.

    See `continue_branch` for an example.
    """

    kind: str
    index: int
    arclength: float
    u: Float[np.ndarray, " m"]
    p: float
    tangent: Float[np.ndarray, " m_plus_1"]
    residual: float
    left_over: float
    refined: bool
    error: float
    extra: Any = None
    other: Float[np.ndarray, " m_plus_1"] | None = None

    def _in_short(self) -> str:
        return f"{self.kind} at {self.p:.6g}"


@dataclass
class Counts:
    """The cost of a branch: evaluations of F, of F with its Jacobian, and steps."""

    values: int = 0
    jacobians: int = 0
    solves: int = 0
    rejected: int = 0


class Labels(NamedTuple):
    """Names for datasets: the parameter, and (name, unit, long name) of the parts of u.

    A part has one entry for each cell.
    """

    parameter: str
    units: str | None
    long_name: str
    parts: Sequence[tuple[str, str, str]]


@dataclass(frozen=True, repr=False)
class Branch(Printed):
    """A branch of k solutions of F(u, p) = 0 in order, as data on the host.

    - `u` (k, m), `p` (k,); `arclength` (k,) from the first point in the weighted norm; `tangents`
      (k, m + 1) = d[u; p]/ds.
    - `residuals` (k,): max |F| before the last Newton step.
    - `extra`: the further arrays of the residual, stacked along a first axis.
    - `special`: tuple of `SpecialPoint`, in order of arclength.
    - `ended`: "left_bounds", "closed", "max_points", "stopped", "no_start", "step_too_small",
      "interrupted" or, of equilibria, "belt_speed = 0"; `message` gives a remedy, and `reason` the
      value of `stop`.
    - `counts`: the cost.
    - `ended_first`: of a branch that was followed in both directions, why it ends at its first
      point, else "".
    - `stable` (k,), `labels`: of equilibria, else None.

    See `continue_branch` for an example.
    """

    u: Float[np.ndarray, "k m"]
    p: Float[np.ndarray, " k"]
    arclength: Float[np.ndarray, " k"]
    tangents: Float[np.ndarray, "k m_plus_1"]
    residuals: Float[np.ndarray, " k"]
    extra: Any
    special: tuple[SpecialPoint, ...]
    ended: str
    reason: str = ""
    counts: Counts = field(default_factory=Counts)
    ended_first: str = ""
    stable: Bool[np.ndarray, " k"] | None = None
    labels: Labels | None = None

    def _sketch(self) -> Sketch:
        """The first unknown over the parameter; dashed where equilibria are unstable."""
        x, y = "p", "u[0]"
        if self.labels is not None:
            x, y = self.labels.parameter, self.labels.parts[0][0]
        line = (self.p, self.u[:, 0], True if self.stable is None else self.stable)
        points = [(point.p, point.u[0], point.kind) for point in self.special]
        return Sketch(x, y, [line], points)

    @property
    def message(self) -> str:
        """The reason why the branch ended, with a remedy; for both ends if both were followed."""
        by_itself = self.ended == "stopped" and self.reason
        last = f"The branch ends here: {self.reason}." if by_itself else ENDINGS[self.ended]
        first = ENDINGS.get(self.ended_first, "")
        if not first or first == last:
            return last
        return f"At the first point: {first} At the last point: {last}"

    def up_to(self, index: int, arclength: float) -> Branch:
        """The branch up to the point `index`, with its special points before `arclength`."""
        k = index + 1
        names = "u", "p", "arclength", "tangents", "residuals"
        rows = {name: getattr(self, name)[:k] for name in names}
        extra = jax.tree.map(lambda leaf: leaf[:k], self.extra)
        before = tuple(other for other in self.special if other.arclength < arclength)
        return replace(self, extra=extra, special=before, **rows)

    def of_kind(self, kind: str) -> tuple[SpecialPoint, ...]:
        """The special points of one kind: "fold", "branch point", or the name of a test."""
        return tuple(point for point in self.special if point.kind == kind)

    def to_dataset(self) -> Dataset:
        """The branch as an `xarray.Dataset` over `point`, with its special points over `special`.

        **Returns:** the coordinate `p` (point); `u` (point, unknown), `arclength` and `residual`
        (point); for special points the variables of `special_variables` and `special_u` (special,
        unknown); the attributes `parameter`, `ended` and `message`.  Of equilibria the parameter
        and the parts of u have their own names, such as `belt_speed` and `displacement` (point,
        oscillator), with the mean over several oscillators, such as `mean_displacement` (point);
        and there is `stable` (point).

        !!! example

            >>> import jax, jax.numpy as jnp
            >>> jax.config.update("jax_enable_x64", True)
            >>> from jaxchain.continuation import continue_branch
            >>> circle = continue_branch(lambda u, p, _: u**2 + p**2 - 1.0, jnp.ones(1), 0.0)
            >>> data = circle.to_dataset()
            >>> data.u.dims, data.special_kind.values[0], data.special_parameter.values[0].round(9)
            (('point', 'unknown'), np.str_('fold'), np.float64(1.0))
        """
        name, units, text, parts = self.labels or Labels("p", None, "parameter p", ())
        special = np.reshape([point.u for point in self.special], (-1, self.u.shape[1]))
        if parts:
            columns, n = _columns(self.u, parts), self.u.shape[1] // len(parts)
            there, coords = _columns(special, parts), {"oscillator": oscillators(n)}
        else:
            columns = {"u": Variable(self.u, ("unknown",), None, "unknowns u")}
            there = {"u": Variable(special, ("unknown",), None, "unknowns u there")}
            coords = {}
        of_points = {}
        if self.stable is not None:
            stable = "whether all eigenvalues have negative real parts"
            of_points["stable"] = Variable(self.stable, (), None, stable)
        of_points |= {
            "arclength": Variable(self.arclength, (), None, "length along the branch"),
            "residual": Variable(self.residuals, (), None, "greatest |F|, last but one"),
        }
        parameters = [point.p for point in self.special]
        return dataset(
            along(columns, "point")
            | along(there, "special", prefix="special_")
            | along(of_points, "point")
            | special_variables(self.special, parameters, units or "1"),
            {name: Variable(self.p, ("point",), units, text), **coords},
            {
                "parameter": name,
                "ended": self.ended,
                "message": self.message,
                **({"ended_first": self.ended_first} if self.ended_first else {}),
            },
        )


def _columns(u: np.ndarray, parts: Sequence[tuple[str, str, str]]) -> dict[str, Variable]:
    """The parts of u as variables, with the means over several cells."""
    columns: dict[str, Variable] = {}
    n = u.shape[1] // len(parts)
    for i, (name, unit, text) in enumerate(parts):
        part = u[:, i * n : (i + 1) * n]
        columns[name] = Variable(part, ("oscillator",), unit, text)
        if n > 1:
            columns[f"mean_{name}"] = Variable(part.mean(axis=1), (), unit, f"mean {text}")
    return columns


def joined(back: Branch, ahead: Branch) -> Branch:
    """One branch of two that leave the same first point in opposite directions."""
    before, length = len(back.p) - 1, back.arclength[-1]

    def both(one: np.ndarray, other: np.ndarray, sign: float = 1.0) -> np.ndarray:
        return np.concatenate([sign * one[:0:-1], other])

    special = [
        replace(
            point,
            index=before - 1 - point.index,
            arclength=length - point.arclength,
            tangent=-point.tangent,
        )
        for point in reversed(back.special)
    ] + [
        replace(point, index=before + point.index, arclength=length + point.arclength)
        for point in ahead.special
    ]
    counts = {name: n + getattr(back.counts, name) for name, n in vars(ahead.counts).items()}
    return replace(
        ahead,
        u=both(back.u, ahead.u),
        p=both(back.p, ahead.p),
        arclength=both(length - back.arclength, length + ahead.arclength),
        tangents=both(back.tangents, ahead.tangents, -1.0),
        residuals=both(back.residuals, ahead.residuals),
        extra=jax.tree.map(both, back.extra, ahead.extra),
        special=tuple(special),
        ended_first=back.ended,
        counts=Counts(**counts),
    )


def special_variables(
    points: Sequence[Any], parameters: Sequence[Any], units: str
) -> dict[str, Variable]:
    """Special points as variables of a dataset, over the dimension `special`.

    **Arguments:** `points`, each with `kind`, `error`, `index` and `refined`; the `parameters`
    there, and their `units`.
    """

    def each(name: str, kind: type) -> np.ndarray:
        return np.array([getattr(point, name) for point in points], kind)

    place = "it lies between this point of the branch and the next"
    columns = {
        "kind": Variable(each("kind", str), (), None, "kind of special point"),
        "parameter": Variable(np.array(parameters, float), (), units, "parameter there"),
        "error": Variable(each("error", float), (), units, "error of the parameter there"),
        "index": Variable(each("index", int), (), "1", place),
        "refined": Variable(each("refined", bool), (), None, "whether it is solved for"),
    }
    return along(columns, "special", prefix="special_")


class BranchRecorder:
    """A branch under construction: plain lists, so that an interruption loses nothing."""

    def __init__(self, m: int) -> None:
        self.m = m
        self.points: list[Point] = []
        self.arclengths: list[float] = []
        self.special: list[SpecialPoint] = []

    def append(self, point: Point, length: float) -> None:
        """Adds a point that lies `length` beyond the last one."""
        self.arclengths.append(self.arclengths[-1] + length if self.arclengths else 0.0)
        self.points.append(point)

    def branch(self, ended: str, reason: str, counts: Counts) -> Branch:
        """The branch so far, as arrays."""
        points = self.points[: len(self.arclengths)]
        z = np.reshape([point.z for point in points], (-1, self.m + 1))
        extra = [point.extra for point in points]
        return Branch(
            u=z[:, :-1],
            p=z[:, -1],
            arclength=np.array(self.arclengths[: len(points)], dtype=float),
            tangents=np.reshape([point.tangent for point in points], (-1, self.m + 1)),
            residuals=np.array([point.residual for point in points], dtype=float),
            extra=jax.tree.map(lambda *leaves: np.stack(leaves), *extra) if points else None,
            # An interruption may come after a special point and before the end of its segment.
            special=tuple(point for point in self.special if point.index + 1 < len(points)),
            ended=ended,
            reason=reason,
            counts=counts,
        )
