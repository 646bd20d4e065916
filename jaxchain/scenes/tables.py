"""The tables a scene file is made of, each a pydantic model.

Nothing here needs JAX, so that a scene is found wrong in milliseconds.  Every number is
dimensionless.  A number that is swept may be left out, so most are optional here; whether one is
missing is for the experiment to say (`jaxchain.scenes.scene`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    create_model,
    model_validator,
)

from ..model.measured import check_measured, read_curve
from ..model.parameters import CHAIN, Parameter, parameter

T = TypeVar("T", bound=BaseModel)
MOST_LANES = 10**6
MOST_LANES_REMEDY = "take fewer values, or share them out over several experiments or scene files"


class Table(BaseModel):
    """A table of a scene file: unknown keys, wrong types, NaN and infinity are errors."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


def _form(value: Any) -> str:
    if isinstance(value, dict | BaseModel):
        return "table"
    return "list" if isinstance(value, list) else "number"


def short_of_a_period(time: float, stiffness: float = 1.0) -> str | None:
    """What is wrong with a time that holds no period of a free mass; None if it does.

    >>> short_of_a_period(1.0)
    'must hold at least one period, 6.283, but is 1'
    """
    period = 2 * math.pi / stiffness**0.5
    if time >= period:
        return None
    return f"must hold at least one period, {period:.4g}, but is {time:g}"


def _holds_a_period(time: float) -> float:
    if problem := short_of_a_period(time):
        raise ValueError(problem)
    return time


Positive: TypeAlias = Annotated[float, Field(gt=0)]
# A time over which vibrations are measured.
Window: TypeAlias = Annotated[Positive, AfterValidator(_holds_a_period)]
NonNegative: TypeAlias = Annotated[float, Field(ge=0)]
_SIGNS: dict[str, Any] = {"any": float, "nonnegative": NonNegative, "positive": Positive}


def _key(row: Parameter, several: bool) -> Any:
    """Type and default of the key of a number; `several`: also one for each mass or spring."""
    kind: Any = _SIGNS[row.sign]
    if several and row.per != "chain":
        many = Annotated[list[kind], Field(min_length=1), Tag("list")]
        kind = Annotated[Annotated[kind, Tag("number")] | many, Discriminator(_form)]
    kind = kind | None if row.default is None else kind
    return Annotated[kind, Field(description=row.meaning or None)], row.default


def _numbers(*names: str, several: bool = False) -> Callable[[type[T]], type[T]]:
    """Gives a table the keys of these numbers, after its own."""

    def with_keys(table: type[T]) -> type[T]:
        keys: Any = {name: _key(parameter(name), several) for name in names}
        return create_model(table.__name__, __base__=table, __doc__=table.__doc__, **keys)

    return with_keys


class Range(Table):
    """Equally spaced values: start, start + step, ... stop, or `count` values with both ends."""

    start: float
    stop: float
    step: float | None = None
    """Distance between values; negative to count down."""
    count: Annotated[int, Field(ge=1)] | None = None
    """Number of values, both ends included."""

    @model_validator(mode="after")
    def _check(self) -> Range:
        if (self.step is None) == (self.count is None):
            raise ValueError("must have either `step` or `count` beside `start` and `stop`")
        if self.step is not None:
            if self.step == 0:
                raise ValueError("must have a `step` other than 0")
            if (self.stop - self.start) / self.step < 0:
                raise ValueError(
                    f"is empty: a step of {self.step:g} does not lead from {self.start:g} to "
                    f"{self.stop:g}"
                )
            if self._length() < 2 and self.start != self.stop:
                raise ValueError(
                    f"has a step of {self.step:g} beyond its range: only {self.start:g} would be "
                    f"left. A `step` of at most {abs(self.stop - self.start):g} reaches further"
                )
        elif self.count == 1 and self.start != self.stop:
            raise ValueError("cannot hold both ends in one value: raise `count`")
        elif self.start == self.stop and self.count != 1:
            raise ValueError("has two equal ends: `count` must be 1")
        if self._length() > MOST_LANES:
            raise ValueError(
                f"would be {self._length():.3g} values, and {MOST_LANES} are the most: "
                f"{MOST_LANES_REMEDY}"
            )
        return self

    def _length(self) -> float:
        if self.step is None:
            return float(self.count or 0)
        # The last value may miss `stop` by rounding.
        return (self.stop - self.start) / self.step + 1 + 1e-9

    def array(self) -> np.ndarray:
        """The values.  Steps are added in decimal, so that 1.0 + 3 * 0.05 is 1.15."""
        count = math.floor(self._length())
        if self.step is None:
            return np.linspace(self.start, self.stop, count)
        start, step = Decimal(repr(self.start)), Decimal(repr(self.step))
        return np.array([float(start + i * step) for i in range(count)])


Values: TypeAlias = Annotated[
    Annotated[list[float], Field(min_length=1, max_length=MOST_LANES), Tag("list")]
    | Annotated[Range, Tag("table")],
    Discriminator(_form),
]


def array(values: Values) -> np.ndarray:
    """The numbers of a list or a range.

    >>> array(Range(start=1.0, stop=2.0, step=0.5)).tolist()
    [1.0, 1.5, 2.0]
    """
    return values.array() if isinstance(values, Range) else np.array(values)


_WEAKENING = ("width", "mu_static", "mu_dynamic", "v_ref")


@_numbers(*_WEAKENING)
class ExponentialDecayTable(Table):
    """mu(s) = mu_dynamic + (mu_static - mu_dynamic) exp(-s / v_ref)."""

    law: Literal["exponential_decay"]


@_numbers(*_WEAKENING, "mu_viscous")
class WeakeningStrengtheningTable(Table):
    """mu(s) = mu_dynamic + (mu_static - mu_dynamic) exp(-s / v_ref) + mu_viscous s / v_ref."""

    law: Literal["weakening_strengthening"]


@_numbers(*_WEAKENING, "mu_viscous")
class GaussianStribeckTable(Table):
    """mu(s) = mu_dynamic + (mu_static - mu_dynamic) exp(-(s / v_ref)^2) + mu_viscous s / v_ref."""

    law: Literal["gaussian_stribeck"]


@_numbers("width", "mu_dynamic")
class CoulombTable(Table):
    """mu(s) = mu_dynamic."""

    law: Literal["coulomb"]


@_numbers("width")
class TabulatedTable(Table):
    """mu(s) through measured points, constant beyond the last: a file, or two lists."""

    law: Literal["tabulated"]
    file: str | None = None
    """CSV file of two columns, speed and friction coefficient, beside the scene file."""
    speed: list[float] = []
    """Speeds, rising from 0; instead of `file`."""
    mu: list[float] = []
    """Friction coefficient at each of them."""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, table: Any, info: Any) -> Any:
        """With the numbers of its file, so that results hold them."""
        if not isinstance(table, dict) or not isinstance(table.get("file"), str):
            return table
        if "speed" in table or "mu" in table:
            raise ValueError("must have either `file` or `speed` and `mu`")
        file = Path((info.context or {}).get("folder", ".")) / table["file"]
        try:
            speed, mu = read_curve(file)
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"has a `file` that cannot be read, {file}: {error}") from None
        return {key: value for key, value in table.items() if key != "file"} | {
            "speed": speed, "mu": mu,
        }  # fmt: skip

    @model_validator(mode="after")
    def _check(self) -> TabulatedTable:
        if not self.speed and not self.mu:
            raise ValueError("must have either `file` or `speed` and `mu`")
        check_measured(self.speed, self.mu)
        return self


@_numbers("width")
class OwnLawTable(Table):
    """A law of one's own, named on the command line: `--law FILE.py:CLASS`."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float] = Field(init=False)

    law: Literal["own"]

    @model_validator(mode="after")
    def _check(self) -> OwnLawTable:
        if taken := sorted({*CHAIN, "n", "ends", "excited"} & set(self.model_extra or ())):
            raise ValueError(f"cannot have the key `{taken[0]}`, a number of the chain: rename it")
        return self


FrictionTable: TypeAlias = Annotated[
    ExponentialDecayTable
    | WeakeningStrengtheningTable
    | GaussianStribeckTable
    | CoulombTable
    | TabulatedTable
    | OwnLawTable,
    Field(discriminator="law"),
]


@_numbers(*CHAIN, several=True)
class ChainTable(Table):
    """A chain of masses on a belt: x'' + 2 xi x' + k x + coupling = p F(x' - v_d)."""

    n: Annotated[int, Field(ge=1)]
    """Number of masses."""
    friction: FrictionTable
    ends: Literal["cyclic", "free"] = "cyclic"


Block: TypeAlias = Literal["forward", "centred"]


class _BlockTable(Table):
    excited: Annotated[int, Field(ge=0)] | None = None
    """How many neighbouring masses are excited."""
    block: Block = "forward"
    """Where they are: 11 ... 10 + k of 20 ("forward"), or round oscillator 11 ("centred")."""


class Equation8Table(_BlockTable):
    """Alternating displacements of 2 around steady sliding, at rest: eq. (8) of the paper."""

    kind: Literal["equation_8"]


class Equation10Table(_BlockTable):
    """Like eq. (8), with velocities of 0.56: eq. (10) of the paper."""

    kind: Literal["equation_10"]
    reading: Literal["as_printed", "as_equation_8"] = "as_equation_8"
    """Whether F(v_d) in eq. (10) is meant as printed, or as the F(-v_d) of eq. (8)."""


class ExcitedTable(_BlockTable):
    """Steady sliding with some masses pulled away from it."""

    kind: Literal["excited"]
    oscillators: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1)] | None = None
    """Which masses are excited, counted from 1; instead of `excited`."""
    pattern: Literal["alternating", "in-phase"] = "alternating"
    """Signs of the displacements along the chain."""
    displacement: float = 2.0
    """How far an excited mass is pulled away."""
    velocity: float = 0.0
    """Velocity of every mass."""


InitialTable: TypeAlias = Annotated[
    Equation8Table | Equation10Table | ExcitedTable, Field(discriminator="kind")
]


class TimeTable(Table):
    """A run lasts transient + window time units (one period of a free mass is about 2 pi)."""

    transient: NonNegative
    """What is waited for before amplitudes are measured."""
    window: Positive
    """How long they are measured."""


Solver: TypeAlias = Literal[
    "auto", "Rodas4", "Rodas5P", "Bosh3", "Tsit5", "Dopri5", "Dopri8",
    "Kvaerno3", "Kvaerno4", "Kvaerno5",
]  # fmt: skip


class SolverTable(Table):
    """How a run is computed."""

    solver: Solver = "auto"
    """For smoothed friction: a structured Rosenbrock solver, a stock diffrax solver, or the choice
    left to jaxchain.  True dry friction is integrated event by event."""
    rtol: Annotated[float, Field(gt=0, lt=1)] = 1e-6
    atol: Positive | None = None
    """Absent: rtol / 10."""
    max_step: Positive = 0.5
    """No step is longer (time units)."""
    max_steps: Annotated[int, Field(ge=1)] | None = None
    """Steps allowed for each run; absent: no limit."""
    lanes: Annotated[int, Field(ge=1)] | None = None
    """Runs computed at once; absent: as many as suit the machine."""


class NumericsTable(SolverTable):
    """How a run is computed, and with which friction."""

    model: Literal["smoothed", "nonsmooth", "both"] = "smoothed"
    """Friction smoothed by its width, true dry friction, or one run of each."""
