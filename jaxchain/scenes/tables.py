"""The tables a scene file is made of, each a pydantic model.

Nothing here needs JAX, so that a scene is found wrong in milliseconds.  Every number is
dimensionless.  A number that is swept may be left out, so most are optional here; whether one is
missing is for the experiment to say (`jaxchain.scenes.scene`).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    create_model,
    model_validator,
)

from .._limits import MOST_LANES
from ..model.measured import check_measured, read_curve
from ..model.parameters import CHAIN, Parameter, parameter
from .values import (
    MOST_NUMBERS,
    MOST_STEPS,
    MOST_VALUES,
    RTOL,
    TRANSIENT,
    WINDOW,
    AbsoluteTolerance,
    Masses,
    NonNegative,
    Number,
    Positive,
    PositiveTime,
    StepLength,
    Table,
    Time,
    Tolerance,
    form,
)

T = TypeVar("T", bound=BaseModel)


def by_tag(union: Any, key: str) -> dict[str, type[Table]]:
    """The tables of a union by the values of `key` that tell them apart."""
    tables = get_args(get_args(union)[0])
    return {tag: t for t in tables for tag in get_args(t.model_fields[key].annotation)}


_SIGNS: dict[str, Any] = {"any": Number, "nonnegative": NonNegative, "positive": Positive}


def _key(row: Parameter, several: bool) -> Any:
    """Type and default of the key of a number; `several`: also one for each mass or spring."""
    kind: Any = _SIGNS[row.sign]
    if several and row.per != "chain":
        many = Annotated[list[kind], Field(min_length=1, max_length=MOST_NUMBERS), Tag("list")]
        kind = Annotated[Annotated[kind, Tag("number")] | many, Discriminator(form)]
    kind = kind | None if row.default is None else kind
    return Annotated[kind, Field(description=row.description)], row.default


def _numbers(*names: str, several: bool = False) -> Callable[[type[T]], type[T]]:
    """Gives a table the keys of these numbers, after its own."""

    def with_keys(table: type[T]) -> type[T]:
        keys: Any = {name: _key(parameter(name), several) for name in names}
        return create_model(table.__name__, __base__=table, __doc__=table.__doc__, **keys)

    return with_keys


_WEAKENING = ("width", "mu_static", "mu_dynamic", "v_ref")
_LAW = Field(description="Which friction law.")


@_numbers(*_WEAKENING)
class ExponentialDecayTable(Table):
    """mu(s) = mu_dynamic + (mu_static - mu_dynamic) exp(-s / v_ref)."""

    law: Annotated[Literal["exponential_decay"], _LAW]


@_numbers(*_WEAKENING, "mu_viscous")
class WeakeningStrengtheningTable(Table):
    """mu(s) = mu_dynamic + (mu_static - mu_dynamic) exp(-s / v_ref) + mu_viscous s / v_ref."""

    law: Annotated[Literal["weakening_strengthening"], _LAW]


@_numbers(*_WEAKENING, "mu_viscous")
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
    __pydantic_extra__: dict[str, Number] = Field(init=False)

    law: Annotated[Literal["own"], _LAW]

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
LAWS = by_tag(FrictionTable, "law")


@_numbers(*CHAIN, several=True)
class ChainTable(Table):
    """A chain of masses on a belt: x'' + 2 xi x' + k x + coupling = p F(x' - v_d)."""

    n: Annotated[int, Field(ge=1, le=MOST_NUMBERS)]
    """Number of masses."""
    friction: FrictionTable
    """Law of the friction, mu(s) at the speed s of a mass relative to the belt."""
    ends: Literal["cyclic", "free"] = "cyclic"
    """A ring ("cyclic"), or a row whose first and last mass have one neighbour ("free")."""


Block: TypeAlias = Literal["forward", "centred"]


_KIND = Field(description="Which kind of start.")


class _BlockTable(Table):
    excited: Annotated[int, Field(ge=0, le=MOST_NUMBERS)] | None = None
    """How many neighbouring masses are excited; left out where it is swept."""
    block: Block = "forward"
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
KINDS = by_tag(InitialTable, "kind")


class TimeTable(Table):
    """A run lasts transient + window time units (one period of a free mass is about 2 pi)."""

    transient: Annotated[Time, TRANSIENT]
    window: Annotated[PositiveTime, WINDOW]


Solver: TypeAlias = Literal[
    "auto", "Rodas4", "Rodas5P", "Bosh3", "Tsit5", "Dopri5", "Dopri8",
    "Kvaerno3", "Kvaerno4", "Kvaerno5",
]  # fmt: skip


class SolverTable(Table):
    """How a run is computed."""

    solver: Solver = "auto"
    """For smoothed friction: a structured Rosenbrock solver, a stock diffrax solver, or the choice
    left to jaxchain.  True dry friction is integrated event by event."""
    rtol: Annotated[Tolerance, RTOL] = 1e-6
    atol: AbsoluteTolerance | None = None
    """Absolute tolerance of a time step; absent: rtol / 10."""
    max_step: StepLength = 0.5
    """No step is longer (time units)."""
    max_steps: Annotated[int, Field(ge=1, le=MOST_STEPS)] | None = None
    """Steps allowed for each run; absent: no limit."""
    lanes: Annotated[int, Field(ge=1, le=MOST_LANES)] | None = None
    """Runs computed at once; absent: as many as suit the machine."""


class NumericsTable(SolverTable):
    """How a run is computed, and with which friction."""

    model: Literal["smoothed", "nonsmooth", "both"] = "smoothed"
    """Friction smoothed by its width, true dry friction, or one run of each."""


class StoredNumericsTable(NumericsTable):
    """How the runs of an experiment are computed, with which friction, and where they are kept."""

    store: bool | None = None
    """Whether they are kept in a store as they end, from which a run that was cut off goes on;
    absent: if there are more than 4096."""
