"""The tables a scene file is made of, each a pydantic model.

This module does not need JAX, so that a wrong scene is refused in milliseconds.  Every number is
dimensionless.  A swept number may be left out, so most are optional here; the experiment checks
for missing ones (`jaxchain.scenes.scene`).

Bounds are far beyond all meaningful values: they keep squares and quotients finite, and counts
small enough to compute and store.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_args

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

from .._limits import LEAST_ATOL, LEAST_RTOL, MOST_LANES
from ..model.measured import check_measured, read_curve
from ..model.parameters import CHAIN, parameter

# Bounds of nonzero numbers, in magnitude; time units of a run: some days of one core.
LEAST, MOST, MOST_TIME = 1e-15, 1e15, 1e9
# The most values of one list, and the most numbers kept by one experiment: 0.8 GB.
MOST_VALUES, MOST_NUMBERS = 10**6, 10**8
FEWER = "take fewer values, or share them out over several experiments or scene files"
T = TypeVar("T", bound=BaseModel)


class Table(BaseModel):
    """A table of a scene file: unknown keys, wrong types, NaN and infinity are errors."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


def _not_tiny(value: float) -> float:
    if 0 < abs(value) < LEAST:
        raise ValueError(f"must be 0 or at least {LEAST:g} in size, but is {value!r}")
    return value


def _printable(text: str) -> str:
    if bad := next((c for c in text if not (c.isprintable() or c in "\n\t")), None):
        raise ValueError(f"must not hold the character {bad!r}, which cannot be printed")
    return text


def _form(value: Any) -> str:
    """The tag of a value that may be a number, a list or a table."""
    if isinstance(value, dict | BaseModel):
        return "table"
    return "list" if isinstance(value, list) else "number"


def _one_of(forms: str) -> Discriminator:
    return Discriminator(_form, "forms", f"Input should be {forms}")


Number: TypeAlias = Annotated[float, Field(ge=-MOST, le=MOST), AfterValidator(_not_tiny)]
NonNegative: TypeAlias = Annotated[float, Field(ge=0, le=MOST), AfterValidator(_not_tiny)]
Positive: TypeAlias = Annotated[float, Field(ge=LEAST, le=MOST)]
Time: TypeAlias = Annotated[float, Field(ge=0, le=MOST_TIME), AfterValidator(_not_tiny)]
PositiveTime: TypeAlias = Annotated[float, Field(ge=LEAST, le=MOST_TIME)]
Count: TypeAlias = Annotated[int, Field(ge=1, le=10**6)]
Mass: TypeAlias = Annotated[int, Field(ge=1, le=MOST_NUMBERS)]  # counted from 1
Text: TypeAlias = Annotated[str, Field(max_length=10_000), AfterValidator(_printable)]
# Of an experiment: names a group of the results.
Name: TypeAlias = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=64)]


class Range(Table):
    """Equally spaced values: start, start + step, ... stop, or `count` values with both ends."""

    start: Number
    """The first value."""
    stop: Number
    """The last value, unless the steps do not meet it; none lies beyond."""
    step: Number | None = None
    """Distance between values; negative to count down."""
    count: Annotated[int, Field(ge=1)] | None = None
    """Number of values, both ends included; instead of `step`."""

    @model_validator(mode="after")
    def _check(self) -> Range:
        if (self.step is None) == (self.count is None):
            raise ValueError("must have either `step` or `count` beside `start` and `stop`")
        if self.step == 0:
            raise ValueError("must have a `step` other than 0")
        size = self._size()
        if size < 1:
            raise ValueError(
                f"is empty: a step of {self.step:g} does not lead from {self.start:g} to "
                f"{self.stop:g}"
            )
        if size > MOST_VALUES:
            raise ValueError(
                f"would be {size:.3g} values, and {MOST_VALUES} are the most: {FEWER}"
            )
        if self.start == self.stop and self.count not in (None, 1):
            raise ValueError("has two equal ends: `count` must be 1")
        if self.start != self.stop and math.floor(size) == 1:
            raise ValueError(
                f"has a step of {self.step:g} beyond its range: only {self.start:g} would be "
                f"left. A `step` of at most {abs(self.stop - self.start):g} reaches further"
                if self.step
                else "cannot hold both ends in one value: raise `count`"
            )
        return self

    def _size(self) -> float:
        """Number of values; the last one may miss `stop` by rounding."""
        if self.step is None:
            return float(min(self.count or 0, MOST))
        return (self.stop - self.start) / self.step + 1 + 1e-9

    def array(self) -> np.ndarray:
        """The values.  Steps are added in decimal, so that 1.0 + 3 * 0.05 is 1.15."""
        count = math.floor(self._size())
        if self.step is None:
            return np.linspace(self.start, self.stop, count)
        start, step = Decimal(repr(self.start)), Decimal(repr(self.step))
        return np.array([float(start + i * step) for i in range(count)])


def array(values: Range | list[Any]) -> np.ndarray:
    """The numbers of a list or a range.

    >>> array(Range(start=1.0, stop=2.0, step=0.5)).tolist()
    [1.0, 1.5, 2.0]
    """
    return values.array() if isinstance(values, Range) else np.array(values)


def distinct(values: Any) -> Any:
    """The values; `ValueError` if a list holds one more than once."""
    if isinstance(values, list) and len(set(values)) < len(values):
        twice = next(one for i, one in enumerate(values) if one in values[:i])
        raise ValueError(f"holds {twice!r} more than once")
    return values


def _form_of_field(value: Any) -> str:
    """The tag of the value of a field of a model, which may also be a text or a whole number."""
    if isinstance(value, int) and not isinstance(value, bool):
        return "whole"
    return "text" if isinstance(value, str) else _form(value)


Values: TypeAlias = Annotated[
    Annotated[list[Number], Field(min_length=1, max_length=MOST_VALUES), Tag("list")]
    | Annotated[Range, Tag("table")],
    _one_of("a list or a range table"),
    AfterValidator(distinct),
]
_One: TypeAlias = Annotated[Number, Tag("number")]
_Several: TypeAlias = Annotated[
    list[Number], Field(min_length=1, max_length=MOST_NUMBERS), Tag("list")
]
PerCell: TypeAlias = Annotated[_One | _Several, _one_of("a number or a list")]
FieldValue: TypeAlias = Annotated[
    _One
    | _Several
    | Annotated[int, Field(ge=-MOST, le=MOST), Tag("whole")]
    | Annotated[Text, Tag("text")],
    Discriminator(_form_of_field, "forms", "Input should be a number, a list or a text"),
]
# The name or the number, from 0, of one of the numbers of a cell.
Component: TypeAlias = Annotated[
    Annotated[int, Field(ge=0, le=100), Tag("whole")] | Annotated[Text, Tag("text")],
    Discriminator(_form_of_field, "forms", "Input should be a name or a number from 0"),
]
Masses: TypeAlias = Annotated[
    list[Mass], Field(min_length=1, max_length=MOST_VALUES), AfterValidator(distinct)
]


def _numbers(*names: str, several: bool = False) -> Callable[[type[T]], type[T]]:
    """Gives a table the keys of these parameters of a chain or law, after its own.

    `several`: also one for each mass or spring.
    """
    kinds: dict[str, Any] = {"any": Number, "nonnegative": NonNegative, "positive": Positive}
    keys: dict[str, Any] = {}
    for row in map(parameter, names):
        kind: Any = kinds[row.sign]
        if several and row.per != "chain":
            many = Annotated[list[kind], Field(min_length=1, max_length=MOST_NUMBERS), Tag("list")]
            kind = Annotated[Annotated[kind, Tag("number")] | many, _one_of("a number or a list")]
        kind = kind | None if row.default is None else kind
        keys[row.name] = Annotated[kind, Field(description=row.description)], row.default

    def with_keys(table: type[T]) -> type[T]:
        return create_model(table.__name__, __base__=table, __doc__=table.__doc__, **keys)

    return with_keys


_LAW = Field(description="Which friction law.")


@_numbers("width", "mu_static", "mu_dynamic", "v_ref")
class ExponentialDecayTable(Table):
    """mu(s) = mu_dynamic + (mu_static - mu_dynamic) exp(-s / v_ref)."""

    law: Annotated[Literal["exponential_decay"], _LAW]


@_numbers("width", "mu_static", "mu_dynamic", "v_ref", "mu_viscous")
class WeakeningStrengtheningTable(Table):
    """mu(s) = mu_dynamic + (mu_static - mu_dynamic) exp(-s / v_ref) + mu_viscous s / v_ref."""

    law: Annotated[Literal["weakening_strengthening"], _LAW]


@_numbers("width", "mu_static", "mu_dynamic", "v_ref", "mu_viscous")
class GaussianStribeckTable(Table):
    """mu(s) = mu_dynamic + (mu_static - mu_dynamic) exp(-(s / v_ref)^2) + mu_viscous s / v_ref."""

    law: Annotated[Literal["gaussian_stribeck"], _LAW]


@_numbers("width", "mu_dynamic")
class CoulombTable(Table):
    """mu(s) = mu_dynamic."""

    law: Annotated[Literal["coulomb"], _LAW]


_Points: TypeAlias = Annotated[list[Number], Field(max_length=MOST_VALUES)]


@_numbers("width")
class TabulatedTable(Table):
    """mu(s) through measured points, constant beyond the last: a file, or two lists."""

    law: Annotated[Literal["tabulated"], _LAW]
    file: str | None = None
    """CSV file of two columns, speed and friction coefficient, beside the scene file."""
    speed: _Points = Field(default_factory=list)
    """Speeds, rising from 0; instead of `file`."""
    mu: _Points = Field(default_factory=list)
    """Friction coefficient at each of them."""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, table: Any, info: Any) -> Any:
        """Adds the numbers of the file, so that the results contain them."""
        if not isinstance(table, dict) or not isinstance(table.get("file"), str):
            return table
        if "speed" in table or "mu" in table:
            raise ValueError("must have either `file` or `speed` and `mu`")
        file = Path((info.context or {}).get("folder", ".")) / table["file"]
        try:
            speed, mu = read_curve(file)
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"has a `file` that cannot be read, {file}: {error}") from None
        return {**table, "file": None, "speed": speed, "mu": mu}

    @model_validator(mode="after")
    def _check(self) -> TabulatedTable:
        if not self.speed and not self.mu:
            raise ValueError("must have either `file` or `speed` and `mu`")
        check_measured(self.speed, self.mu)
        return self


@_numbers("width")
class CustomLawTable(Table):
    """A custom law, named on the command line: `--law FILE.py:CLASS`."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Number] = Field(init=False)

    law: Annotated[Literal["custom"], _LAW]

    @model_validator(mode="after")
    def _check(self) -> CustomLawTable:
        if taken := sorted({*CHAIN, "n", "ends", "excited"} & set(self.model_extra or ())):
            raise ValueError(f"cannot have the key `{taken[0]}`, a number of the chain: rename it")
        return self


FrictionTable: TypeAlias = Annotated[
    ExponentialDecayTable
    | WeakeningStrengtheningTable
    | GaussianStribeckTable
    | CoulombTable
    | TabulatedTable
    | CustomLawTable,
    Field(discriminator="law"),
]


@_numbers(*CHAIN, several=True)
class ChainTable(Table):
    """A chain of masses on a belt: x'' + 2 xi x' + k x + coupling = p F(x' - v_d)."""

    n: Annotated[int, Field(ge=1, le=MOST_NUMBERS)]
    """Number of masses."""
    friction: FrictionTable
    """Law of the friction, mu(s) at the speed s of a mass relative to the belt."""
    ends: Literal["cyclic", "free"] = "cyclic"
    """A ring ("cyclic"), or a row whose first and last mass have one neighbour ("free")."""


class ModelTable(Table):
    """Cells of another model: a class of `jaxchain.model`, or yours, named by `--model`.

    The other keys are fields of the class: a number, or a list with one per cell; for static
    fields also a text or a whole number.  A swept number may be left out.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, FieldValue] = Field(init=False)

    kind: Text
    """The name of the class, such as "LuGre"."""
    n: Annotated[int, Field(ge=1, le=MOST_NUMBERS)]
    """Number of cells."""
    ends: Literal["cyclic", "free"] | None = None
    """A ring or a row, if the class has this field; absent: as the class has it."""
    friction: (
        Annotated[
            _One | _Several | Annotated[FrictionTable, Tag("table")],
            _one_of("a number, a list or a table with a `law`"),
        ]
        | None
    ) = None
    """Of a class with this field: a number or a list; or a table, for smoothed friction."""


_KIND = Field(description="Which kind of start.")


class _BlockTable(Table):
    excited: Annotated[int, Field(ge=0, le=MOST_NUMBERS)] | None = None
    """How many neighbouring masses are excited; left out where it is swept."""
    block: Literal["forward", "centred"] = "forward"
    """Where they are: 11 ... 10 + k of 20 ("forward"), or round oscillator 11 ("centred")."""


class Equation8Table(_BlockTable):
    """Alternating displacements of 2 around steady sliding, at rest: eq. (8) of the paper."""

    kind: Annotated[Literal["equation_8"], _KIND]


class Equation10Table(_BlockTable):
    """Like eq. (8), with velocities of 0.56: eq. (10) of the paper."""

    kind: Annotated[Literal["equation_10"], _KIND]
    reading: Literal["as_printed", "as_equation_8"] = "as_equation_8"
    """Whether F(v_d) in eq. (10) is meant as printed, or as the F(-v_d) of eq. (8)."""


class ExcitedTable(_BlockTable):
    """Steady sliding with some masses pulled away from it."""

    kind: Annotated[Literal["excited"], _KIND]
    oscillators: Masses | None = None
    """Which masses are excited, counted from 1; instead of `excited`."""
    pattern: Literal["alternating", "in-phase"] = "alternating"
    """Signs of the displacements along the chain."""
    displacement: Number = 2.0
    """How far an excited mass is pulled away, in x0."""
    velocity: Number = 0.0
    """Velocity of every mass, in x0 omega_n."""


InitialTable: TypeAlias = Annotated[
    Equation8Table | Equation10Table | ExcitedTable, Field(discriminator="kind")
]


class TimeTable(Table):
    """A run lasts transient + window time units (one period of a free mass is about 2 pi)."""

    transient: Time
    """Time units before amplitudes are measured."""
    window: PositiveTime
    """Time units over which amplitudes are measured; a period is about 2 pi."""


Solver: TypeAlias = Literal[
    "auto", "Rodas4", "Rodas5P", "Bosh3", "Tsit5", "Dopri5", "Dopri8",
    "Kvaerno3", "Kvaerno4", "Kvaerno5",
]  # fmt: skip


class NumericsTable(Table):
    """The computation of the runs: model of friction, solver, tolerances and storage."""

    model: Literal["smoothed", "dry", "both"] = "smoothed"
    """Friction smoothed by its width, true dry friction, or one run of each."""
    solver: Solver = "auto"
    """For smoothed friction: a structured Rosenbrock solver, a stock diffrax solver, or the choice
    left to jaxchain.  True dry friction is integrated event by event."""
    rtol: Annotated[float, Field(ge=LEAST_RTOL, lt=1)] = 1e-6
    """Relative tolerance of a time step: a smaller one is more accurate and slower."""
    atol: Annotated[float, Field(ge=LEAST_ATOL, le=MOST)] | None = None
    """Absolute tolerance of a time step; absent: rtol / 10."""
    max_step: Annotated[float, Field(ge=1e-6, le=MOST_TIME)] = 0.5
    """No step is longer (time units)."""
    max_steps: Annotated[int, Field(ge=1, le=10**15)] | None = None
    """Steps allowed for each run; absent: no limit."""
    lanes: Annotated[int, Field(ge=1, le=MOST_LANES)] | None = None
    """Runs computed at once; absent: as many as suit the machine."""
    store: bool | None = None
    """Whether runs are saved in a store as they end, from which an interrupted run continues;
    absent: if there are more than 4096."""


class CellsNumericsTable(NumericsTable):
    """Like `Numerics`; dry friction needs a chain."""

    model: Literal["smoothed"] = "smoothed"
    """Cells are integrated as they are; `dry` and `both` need a chain."""


_OBSERVER = Field(description="Which observer.")


class StickTimeTable(Table):
    """The time for which each mass sticks."""

    observer: Annotated[Literal["StickTime"], _OBSERVER]
    window: PositiveTime | None = None
    """The last time units of the run that count; absent: all."""


class _CrossingsTable(Table):
    capacity: Count = 64
    """How many maxima of each mass are kept, the first ones."""
    start: Number = 0.0
    """The time before which nothing is kept."""


class PeakTimesTable(_CrossingsTable):
    """The times of the maxima of each displacement."""

    observer: Annotated[Literal["PeakTimes"], _OBSERVER]


class CellsPeakTimesTable(PeakTimesTable):
    """The times of the maxima of one of the numbers of each cell."""

    component: Component = 0
    """Its name, or its number from 0."""


class SectionTable(_CrossingsTable):
    """The states in which the displacement or the velocity of one mass has a maximum."""

    observer: Annotated[Literal["Section"], _OBSERVER]
    oscillator: Mass
    """Which mass, counted from 1."""
    of: Literal["displacement", "velocity"] = "displacement"
    """Whether its displacement has a maximum then, or its velocity in the belt's direction."""


class SamplesTable(Table):
    """States at start, start + interval, ..."""

    observer: Annotated[Literal["Samples"], _OBSERVER]
    interval: PositiveTime
    """Time units between them."""
    capacity: Count
    """How many are kept, the first ones."""
    oscillators: Masses | None = None
    """Masses, counted from 1; absent: all."""
    start: Time = 0.0
    """Time of the first."""


class FrontTrackTable(Table):
    """The positions of the two fronts of a vibrating block."""

    observer: Annotated[Literal["FrontTrack"], _OBSERVER]
    windows: Count
    """Into how many equal parts the run is cut, of two periods each at least."""
    middle: Mass | None = None
    """An oscillator inside the block; absent: that in the middle."""


class WholeRunTable(Table):
    """Energy balance, integral of the divergence, or how many masses ever stick at once."""

    observer: Annotated[Literal["EnergyBalance", "Divergence", "MostSticking"], _OBSERVER]


class DivergenceTable(Table):
    """Integral of the divergence over the run."""

    observer: Annotated[Literal["Divergence"], _OBSERVER]


class CustomObserverTable(Table):
    """A custom observer, named on the command line: `--observer FILE.py:CLASS`.

    The other keys are fields of its class.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Any] = Field(init=False)

    observer: Annotated[Literal["custom"], _OBSERVER]
    name: Text
    """The name of its class."""


CellsObserverTable: TypeAlias = Annotated[
    CellsPeakTimesTable | SectionTable | SamplesTable | DivergenceTable | CustomObserverTable,
    Field(discriminator="observer"),
]
ObserverTable: TypeAlias = Annotated[
    StickTimeTable
    | PeakTimesTable
    | SectionTable
    | SamplesTable
    | FrontTrackTable
    | WholeRunTable
    | CustomObserverTable,
    Field(discriminator="observer"),
]


class ObserveTable(Table):
    """The observed quantities of every run."""

    quantities: Annotated[
        list[Literal["amplitude", "energy", "active_count"]],
        Field(min_length=1),
        AfterValidator(distinct),
    ] = Field(default_factory=lambda: ["amplitude", "energy", "active_count"])
    """What is kept of the amplitudes A: each of them, the energy 1/2 sum A^2, and how many exceed
    half the belt speed."""
    stop: Literal["never", "quiet", "steady"] = "never"
    """When a run may end early: once every mass rests for good ("quiet"), or also once the
    amplitudes of successive windows agree ("steady")."""
    tolerance: Positive = 1e-6
    """How well they must agree for "steady"."""
    repeats: Count = 5
    """In how many windows in succession they must agree for "steady"."""
    quiet_below: Positive = 1e-6
    """Speed and acceleration below which a mass counts as at rest, for "quiet" and "steady"."""
    others: Annotated[list[ObserverTable], Field(min_length=1, max_length=50)] | None = None
    """What else is observed, such as `{ observer = "StickTime", window = 100.0 }`."""

    @model_validator(mode="after")
    def _check(self) -> ObserveTable:
        kinds = [getattr(other, "name", other.observer) for other in self.others or []]
        if twice := [kind for kind in kinds if kinds.count(kind) > 1]:
            raise ValueError(f"must have no two `others` of one kind, but has two `{twice[0]}`")
        return self


class CellsObserveTable(ObserveTable):
    """The observed quantities of every run of other cells than a chain."""

    component: Component = 0
    """Which of the numbers of a cell the amplitude is of: its name, or its number from 0."""
    quantities: Annotated[
        list[Literal["amplitude", "energy"]], Field(min_length=1), AfterValidator(distinct)
    ] = Field(default_factory=lambda: ["amplitude", "energy"])
    """What is kept of the amplitudes A: each of them, and 1/2 sum A^2."""
    stop: Literal["never", "steady"] = "never"
    """When a run may end early: once the amplitudes of successive windows agree ("steady")."""
    others: Annotated[list[CellsObserverTable], Field(min_length=1, max_length=50)] | None = None
    """What else is observed, such as `{ observer = "PeakTimes", component = 1 }`."""


def kept_numbers(table: ObserverTable | CellsObserverTable, n: int) -> int:
    """The number of stored numbers per run of n masses."""
    match table:
        case SectionTable():
            return table.capacity * (2 * n + 1)
        case PeakTimesTable():
            return table.capacity * n
        case SamplesTable():
            return table.capacity * (2 * len(table.oscillators or range(n)) + 1)
        case FrontTrackTable():
            return 3 * table.windows
    return n


def tags(table: type[BaseModel]) -> tuple[str, ...]:
    """The values of the key that selects one of several kinds of table; empty for others."""
    keys = {"law", "kind", "observer"} & table.model_fields.keys()
    return tuple(tag for key in keys for tag in get_args(table.model_fields[key].annotation))
