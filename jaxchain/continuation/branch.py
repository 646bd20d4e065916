"""What continuation returns: a branch, its special points, and why it ended.

Everything here is plain data on the host, in NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from .._final import final
from ..result import Printed

if TYPE_CHECKING:
    from xarray import Dataset

ENDINGS = {
    "max_points": "The branch has as many points as asked. Allow more (`max_points`).",
    "stopped": "`stop` was true at the last point.",
    "left_bounds": "The parameter reached `bounds`; the last point lies on them.",
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


@final
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


@dataclass
class Counts:
    """The cost of a branch: evaluations of F, of F with its Jacobian, and steps."""

    values: int = 0
    jacobians: int = 0
    solves: int = 0
    rejected: int = 0


@final
@dataclass(frozen=True, repr=False)
class Branch(Printed):
    """A branch of k solutions of F(u, p) = 0 in order, as data on the host.

    - `u` (k, m), `p` (k,); `arclength` (k,) from the first point in the weighted norm; `tangents`
      (k, m + 1) = d[u; p]/ds.
    - `residuals` (k,): max |F| before the last Newton step.
    - `extra`: the further arrays of the residual, stacked along a first axis.
    - `special`: tuple of `SpecialPoint`, in order of arclength.
    - `ended`: "left_bounds", "closed", "max_points", "stopped", "no_start", "step_too_small" or
      "interrupted"; `message` gives a remedy, and `reason` the value of `stop`.
    - `counts`: the cost.

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

    @property
    def message(self) -> str:
        """The reason why the branch ended, with a remedy."""
        by_itself = self.ended == "stopped" and self.reason
        return f"The branch ends here: {self.reason}." if by_itself else ENDINGS[self.ended]

    def of_kind(self, kind: str) -> tuple[SpecialPoint, ...]:
        """The special points of one kind: "fold", "branch point", or the name of a test."""
        return tuple(point for point in self.special if point.kind == kind)

    def to_dataset(self) -> Dataset:
        """The branch as an `xarray.Dataset` over `point`, with its special points over `special`.

        **Returns:** the coordinate `p` (point); `u` (point, unknown), `arclength` and `residual`
        (point); for special points the variables of `special_variables` and `special_u` (special,
        unknown); the attributes `parameter`, `ended` and `message`.

        !!! example

            >>> import jax, jax.numpy as jnp
            >>> jax.config.update("jax_enable_x64", True)
            >>> from jaxchain.continuation import continue_branch
            >>> circle = continue_branch(lambda u, p, _: u**2 + p**2 - 1.0, jnp.ones(1), 0.0)
            >>> data = circle.to_dataset()
            >>> data.u.dims, data.special_kind.values[0], data.special_parameter.values[0].round(9)
            (('point', 'unknown'), np.str_('fold'), np.float64(1.0))
        """
        # xarray imports pandas, which would double the import time.
        from xarray import Dataset

        points = [(point.kind, point.p, point.error) for point in self.special]
        more = [(point.index, point.refined) for point in self.special]
        special = special_variables(points, more)
        u = np.reshape([point.u for point in self.special], (-1, self.u.shape[1]))
        return Dataset(
            {
                "u": (("point", "unknown"), self.u, {"long_name": "unknowns u"}),
                "arclength": ("point", self.arclength, {"long_name": "length along the branch"}),
                "residual": ("point", self.residuals, {"long_name": "greatest |F|, last but one"}),
                **special,
                "special_u": (("special", "unknown"), u, {"long_name": "unknowns u there"}),
            },
            coords={"p": ("point", self.p, {"long_name": "parameter p"})},
            attrs={"parameter": "p", "ended": self.ended, "message": self.message},
        )


def special_variables(
    points: Sequence[tuple[str, Any, Any]],
    more: Sequence[tuple[int, bool]],
    units: str = "1",
) -> dict[str, tuple]:
    """Special points as variables of a dataset, over the dimension `special`.

    **Arguments:** (kind, parameter, error of it) of each; (index, refined) of each; `units` of the
    parameter.
    """
    kinds, values, errors = zip(*points, strict=True) if points else ((), (), ())
    index, refined = zip(*more, strict=True) if more else ((), ())
    columns = {
        "kind": (np.array(kinds, dtype=str), "kind of special point", None),
        "parameter": (np.array(values, float), "parameter there", units),
        "error": (np.array(errors, float), "error of the parameter there", units),
        "index": (
            np.array(index, int),
            "it lies between this point of the branch and the next",
            "1",
        ),
        "refined": (np.array(refined, bool), "whether it is solved for", None),
    }
    return {
        f"special_{name}": ("special", column, {"long_name": text, **_units(unit)})
        for name, (column, text, unit) in columns.items()
    }


def _units(unit: str | None) -> dict[str, str]:
    return {} if unit is None else {"units": unit}


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
            special=tuple(self.special),
            ended=ended,
            reason=reason,
            counts=counts,
        )
