"""The tables a scene file is made of: pydantic models, generated from the classes of the library.

A law, a model or an observer needs no entry here besides its name: the keys of its table are the
fields of its class, with their types and defaults; their meanings are read off its docstring.
What a constructor checks is not checked here; `building` gives its error the key.

Every number is dimensionless.  A swept number may be left out, so those that a class requires are
optional here.  Bounds are far beyond all meaningful values: they keep squares and quotients
finite, and counts small enough to compute and store.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import itertools
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeAlias,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import equinox as eqx
import numpy as np
from jaxtyping import Array
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

from .. import observers
from .._limits import LEAST_ATOL, LEAST_RTOL, MOST_LANES
from .._types import PerMass
from ..model import drives, friction, ready_made
from ..model.cells import AbstractCells
from ..model.friction import AbstractFriction, TanhFriction
from ..model.measured import read_curve, read_rows
from ..model.mechanical import Added, Matrix, MechanicalCells
from ..model.parameters import CHAIN, PARAMETERS, parameter
from ..observers.base import AbstractObserver

# Bounds of nonzero numbers, in magnitude; time units of a run: some days of one core.
LEAST, MOST, MOST_TIME = 1e-15, 1e15, 1e9
# The most values of one list, and the most numbers kept by one experiment: 0.8 GB.
MOST_VALUES, MOST_NUMBERS = 10**6, 10**8
T = TypeVar("T", bound=BaseModel)
FEWER = "take fewer values, or share them out over several experiments or scene files"

# The classes that a scene may name without a file.
LAWS = {
    "exponential_decay": friction.ExponentialDecay,
    "weakening_strengthening": friction.WeakeningStrengthening,
    "gaussian_stribeck": friction.GaussianStribeck,
    "coulomb": friction.Coulomb,
    "static_kinetic": friction.StaticKinetic,
}
READY_MADE: dict[str, type[AbstractCells]] = {
    name: kind
    for name, kind in vars(ready_made).items()
    if inspect.isclass(kind) and issubclass(kind, AbstractCells)
    if kind.__module__ == ready_made.__name__ and not name.startswith("_")
} | {"MechanicalCells": MechanicalCells}
# The amplitude is observed in any case.
OBSERVERS: dict[str, type[AbstractObserver]] = {
    name: kind
    for name in dir(observers)
    if inspect.isclass(kind := getattr(observers, name)) and issubclass(kind, AbstractObserver)
    if not inspect.isabstract(kind) and kind is not observers.Amplitude
}


class Table(BaseModel):
    """A table of a scene file: unknown keys, wrong types, NaN and infinity are errors."""

    makes: ClassVar[Any] = None
    """The class of whose fields it consists."""

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


def distinct(values: Any) -> Any:
    """The values; `ValueError` if a list holds one more than once."""
    if isinstance(values, list) and len(set(values)) < len(values):
        twice = next(one for i, one in enumerate(values) if one in values[:i])
        raise ValueError(f"holds {twice!r} more than once")
    return values


_FORMS = {list: "list", dict: "table", int: "whole", str: "text"}


@dataclass(frozen=True, eq=False)
class OneOf:
    """One of these types by name, as `which` says, for `Annotated[Any, OneOf(...)]`."""

    kinds: Mapping[str, Any]
    which: Discriminator

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        # The tags are in angle brackets: no key of a file is, where pydantic mixes both.
        members = (Annotated[kind, Tag(f"<{name}>")] for name, kind in self.kinds.items())
        return handler.generate_schema(
            Annotated[functools.reduce(operator.or_, members), self.which]
        )


def _either(said: str, **forms: Any) -> OneOf:
    """One of several types, told apart by the form of the value."""

    def form(value: Any) -> str | None:
        kind = "table" if isinstance(value, BaseModel) else _FORMS.get(type(value), "number")
        kind = "number" if kind in ("whole", "text") and kind not in forms else kind
        return f"<{kind}>" if kind in forms else None

    return OneOf(forms, Discriminator(form, "forms", f"Input should be {said}"))


def _one_of(key: str, tables: Mapping[str, type[Table]], other: Any = None) -> OneOf:
    """One of several tables by the value of their `key`; `other` for a value of its own."""

    def tag(value: Any) -> str | None:
        given = value.get(key) if isinstance(value, dict) else getattr(value, key, None)
        table = tables.get(given, other) if isinstance(given, str) else None
        return None if table is None else f"<{table.__name__}>"

    kinds = {one.__name__: one for one in (*tables.values(), other) if one is not None}
    options = ", ".join(f'"{name}"' for name in tables)
    return OneOf(kinds, Discriminator(tag, "one_of", f"{key} {options}"))


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
Masses: TypeAlias = Annotated[
    list[Mass], Field(min_length=1, max_length=MOST_VALUES), AfterValidator(distinct)
]


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


Values: TypeAlias = Annotated[
    Any,
    _either(
        "a list or a range table",
        list=Annotated[list[Number], Field(min_length=1, max_length=MOST_VALUES)],
        table=Range,
    ),
    AfterValidator(distinct),
]


def _several(kind: Any, depth: int = 1) -> OneOf:
    """One number, or one per mass, cell or spring; or a matrix, as lists within lists."""
    entry = kind if depth == 1 else Annotated[Any, _several(kind, depth - 1)]
    many = Annotated[list[entry], Field(min_length=1, max_length=MOST_NUMBERS)]
    return _either("a number or a list", number=kind, list=many)


PerCell: TypeAlias = Annotated[Any, _several(Number)]
_Matrix: TypeAlias = Annotated[Any, _several(Number, 3)]
_Index: TypeAlias = Annotated[int, Field(ge=0, le=MOST_NUMBERS)]
Component: TypeAlias = Annotated[
    Any, _either("a name or a number from 0", whole=Annotated[int, Field(ge=0, le=100)], text=Text)
]

# What scenes have otherwise than the classes; masses are counted from 1 here, and there from 0.
INDICES = ("oscillator", "oscillators", "middle")
_OWN: dict[str, tuple[Any, str]] = {
    "sliding": (_Index, "Which displacement slides on the belt, counted from 0."),
    "contact": (_Index, "Which one of the several contacts of a cell, counted from 0."),
    "component": (Component, "Which variable of a cell: its name, or its number from 0."),
    "capacity": (Count, "How many are kept, the first ones."),
    "start": (Number, "The time before which nothing is kept."),
    "window": (PositiveTime, "The last time units of the run that count; absent: all."),
    "windows": (Count, "Into how many equal parts the run is cut, of two periods each at least."),
    "interval": (PositiveTime, "Time units between samples."),
    "oscillator": (Mass, "Which mass, counted from 1."),
    "oscillators": (Masses, "Masses, counted from 1; absent: all."),
    "middle": (Mass, "An oscillator inside the block, counted from 1; absent: in the middle."),
}
_SIGNS: dict[str, Any] = {"any": Number, "nonnegative": NonNegative, "positive": Positive}


def _meanings(kind: type, names: list[str]) -> Iterator[tuple[str, str]]:
    """The meaning of each field of a class, from the arguments in its docstring."""
    text = (inspect.getdoc(kind) or "").partition("**Arguments")[2].partition("\n\n**Raises")[0]
    first = {text.find(f"`{name}`"): name for name in names if f"`{name}`" in text}
    for start, stop in itertools.pairwise([*sorted(first), len(text)]):
        said = text[start:stop].removeprefix(f"`{first[start]}`")
        said = re.split(r"\n\n|\n- ", said)[0]
        said = re.sub(r"( and|[\s,;:-])+$", "", " ".join(said.split()).lstrip(" ,:="))
        yield first[start], said.replace("None", "absent")


def _number(hint: Any, parts: set[Any], sign: str) -> Any:
    """The type of a key whose field has this hint."""
    if hint is Any:
        return Drive
    if {*parts} & {AbstractFriction, TanhFriction}:
        return FrictionTable
    if Matrix in parts:
        return _Matrix
    if get_origin(hint) is Literal:
        return hint
    if get_origin(hint) is tuple and issubclass(part := get_args(hint)[0], eqx.Module):
        return Annotated[list[_generated(part)], Field(min_length=1, max_length=1000)]
    if dict[str, Added] in parts:
        matrices = Annotated[dict[str, _Matrix], Field(min_length=1, max_length=100)]
        return dict[str, Annotated[Any, _either("a matrix or a table of matrices",
                    number=Number, list=_Matrix, table=matrices)]]  # fmt: skip
    if tuple[str, ...] in parts:
        return Annotated[list[Text], Field(min_length=1)]
    if int in parts and float not in parts:
        return Count
    each = hint in (PerMass, Array, tuple[float, ...])
    return Annotated[Any, _several(_SIGNS[sign])] if each else _SIGNS[sign]


def _keys(kind: type, fields: Mapping[str, tuple[Any, Any]]) -> dict[str, Any]:
    """The keys of a table from names with (type, default), as `create_model` takes them.

    Functions have none: a scene contains no code.
    """
    meanings = dict(_meanings(kind, list(fields))) if fields else {}
    keys: dict[str, Any] = {}
    for name, (hint, default) in fields.items():
        parts = set(get_args(hint)) or {hint}
        if any(get_origin(part) is Callable for part in parts):
            continue
        known = issubclass(kind, AbstractFriction | Table)
        row = PARAMETERS.get(name) if known else None
        meaning = row.description if row else meanings.get(name, "")
        given, meaning = _OWN.get(name, (None, meaning))
        given = given or _number(hint, parts, row.sign if row else "any")
        required = default is dataclasses.MISSING
        # A number may be swept instead; a whole number, a mass or a text may not.
        swept = required and hint in (PerMass, TanhFriction, Matrix, Array)
        optional = swept or default in (None, ())
        value = None if optional else (... if required else default)
        keys[name] = (Annotated[given | None if optional else given, Field(description=meaning)],
                      value)  # fmt: skip
    return keys


def _which(name: str) -> Any:
    """The key that selects a table."""
    return Annotated[Literal[name], Field(description="Which one.")], ...


def _generated(kind: type, /, **more: Any) -> type[Table]:
    """The table of a class, whose keys are its fields.

    `more`: further keys as (type, default), and other defaults of fields.
    """
    hints = get_type_hints(kind)
    own = {name: key for name, key in more.items() if isinstance(key, tuple)}
    fields = {
        field.name: (hints[field.name], more.get(field.name, field.default))
        for field in dataclasses.fields(kind)
        if field.name not in own
    }
    text = re.split(r"\n\n(?:\*\*|!!!)", inspect.getdoc(kind) or "")[0]
    keys: Any = {**own, **_keys(kind, fields)}
    made = create_model(f"{kind.__name__}Table", __base__=Table, __doc__=text, **keys)
    made.makes = kind
    return made


_Width: TypeAlias = Annotated[Positive | None, Field(description=parameter("width").description)]
_Points: TypeAlias = Annotated[list[Number], Field(max_length=MOST_VALUES)]


class _FromFile(Table):
    """Measured values, given in lists or in a file, which is read into them."""

    lists: ClassVar[tuple[str, str]]

    file: str | None = None
    """CSV file beside the scene file, with columns for both lists; instead of these."""

    @classmethod
    def read(cls, file: Path) -> tuple[list[Any], list[Any]]:
        """Both lists."""
        raise NotImplementedError

    @model_validator(mode="before")
    @classmethod
    def _read(cls, table: Any, info: Any) -> Any:
        """Adds the numbers of the file, so that the results contain them."""
        if not isinstance(table, dict) or not isinstance(table.get("file", ""), str):
            return table
        if ("file" in table) == any(name in table for name in cls.lists):
            raise ValueError("must have either `file` or `{}` and `{}`".format(*cls.lists))
        if "file" not in table:
            return table
        file = Path((info.context or {}).get("folder", ".")) / table["file"]
        try:
            numbers = cls.read(file)
        except (OSError, ValueError) as error:
            raise ValueError(f"has a `file` that cannot be read, {file}: {error}") from None
        return {**table, "file": None, **dict(zip(cls.lists, numbers, strict=True))}


class TabulatedTable(_FromFile):
    """mu(s) through measured points, constant beyond the last: a file, or two lists."""

    lists = "speed", "mu"
    law: Literal["tabulated"]
    """Which one."""
    speed: _Points = Field(default_factory=list)
    """Speeds, rising from 0; instead of `file`."""
    mu: _Points = Field(default_factory=list)
    """Friction coefficient at each of them."""
    width: _Width = None

    @classmethod
    def read(cls, file: Path) -> tuple[list[float], list[float]]:
        """Both columns."""
        return read_curve(file)


class CustomLawTable(Table):
    """A custom law, named on the command line: `--law FILE.py:CLASS`.

    The other keys are fields of its class.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, PerCell] = Field(init=False)

    law: Literal["custom"]
    """Which one."""
    width: _Width = None


LAW_TABLES = {
    **{k: _generated(law, law=_which(k), width=(_Width, None)) for k, law in LAWS.items()},
    "tabulated": TabulatedTable,
    "custom": CustomLawTable,
}
FrictionTable: TypeAlias = Annotated[Any, _one_of("law", LAW_TABLES)]


class SignalTable(_FromFile):
    """A function of time through measured values, as `jaxchain.model.Table`: two lists, or a file.

    Outside of the times it keeps the first and the last value, or repeats with a `period`.
    """

    makes = drives.Table
    lists = "t", "values"

    t: _Points
    """The times, rising."""
    values: Annotated[list[PerCell], Field(max_length=MOST_VALUES)]
    """The value at each of them; of a `force` also a list with one for each displacement."""
    period: Positive | None = None
    """After which time it repeats."""
    kind: Literal["cubic", "linear"] = "cubic"
    """Between the times."""

    @classmethod
    def read(cls, file: Path) -> tuple[list[float], list[Any]]:
        """The first column, and the others."""
        rows = read_rows(file, "numbers, a time and its values")
        return [row[0] for row in rows], [row[1:] if len(row) > 2 else row[1] for row in rows]


Drive: TypeAlias = Annotated[
    Any,
    _either(
        "a number, a list or a table of times and values",
        number=Number,
        list=Annotated[list[Number], Field(min_length=1, max_length=MOST_NUMBERS)],
        table=SignalTable,
    ),
]
_Ends: TypeAlias = Literal["cyclic", "free"]
_Size: TypeAlias = Annotated[int, Field(ge=1, le=MOST_NUMBERS)]


def _of_a_chain(table: type[T]) -> type[T]:
    """The table with a key for each parameter of a chain."""
    rows = {k: (PerMass, row.default) for k, row in CHAIN.items()}
    keys = _keys(table, rows)
    return create_model(table.__name__, __base__=table, __doc__=table.__doc__, **keys)


@_of_a_chain
class ChainTable(Table):
    """A chain of masses on a belt: x'' + 2 xi x' + k x + coupling = p F(x' - v_d)."""

    n: _Size
    """Number of masses."""
    friction: FrictionTable
    """Law of the friction, mu(s) at the speed s of a mass relative to the belt."""
    ends: _Ends = "cyclic"
    """A ring ("cyclic"), or a row whose first and last mass have one neighbour ("free")."""


class ChainModelTable(ChainTable):
    """The same as the table `chain`."""

    kind: Literal["Chain"]
    """Which one."""


_Numbers: TypeAlias = Annotated[list[Number], Field(min_length=1, max_length=MOST_NUMBERS)]
_Whole: TypeAlias = Annotated[int, Field(ge=-MOST, le=MOST)]
_FieldValue: TypeAlias = Annotated[
    Any,
    _either("a number, a list or a text", number=Number, list=_Numbers, whole=_Whole, text=Text),
]
_FrictionValue: TypeAlias = Annotated[
    Any,
    _either(
        "a number, a list or a table with a `law`",
        number=Number,
        list=_Numbers,
        table=FrictionTable,
    ),
]


class CustomModelTable(Table):
    """Cells of your own, a class named by `--model`; the other keys are its fields.

    They are a number, or a list with one per cell; for static fields also a text or a whole
    number.  A swept number may be left out.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _FieldValue] = Field(init=False)

    kind: Text
    """The name of the class."""
    n: _Size = 1
    """Number of cells."""
    ends: _Ends | None = None
    """A ring or a row, if the class has this field; absent: as the class has it."""
    friction: _FrictionValue | None = None
    """Of a class with this field: a number or a list; or a table, for smoothed friction."""


_CELLS: Any = Annotated[_Size, Field(description="Number of cells.")], 1
ModelTable: TypeAlias = Annotated[
    Any,
    _one_of(
        "kind",
        {k: _generated(kind, kind=_which(k), n=_CELLS) for k, kind in READY_MADE.items()}
        | {"Chain": ChainModelTable},
        CustomModelTable,
    ),
]


class _BlockTable(Table):
    excited: Annotated[int, Field(ge=0, le=MOST_NUMBERS)] | None = None
    """How many neighbouring masses are excited; left out where it is swept."""
    block: Literal["forward", "centred"] = "forward"
    """Where they are: 11 ... 10 + k of 20 ("forward"), or round oscillator 11 ("centred")."""


class Equation8Table(_BlockTable):
    """Alternating displacements of 2 around steady sliding, at rest: eq. (8) of the paper."""

    kind: Literal["equation_8"]
    """Which one."""


class Equation10Table(_BlockTable):
    """Like eq. (8), with velocities of 0.56: eq. (10) of the paper."""

    kind: Literal["equation_10"]
    """Which one."""
    reading: Literal["as_printed", "as_equation_8"] = "as_equation_8"
    """Whether F(v_d) in eq. (10) is meant as printed, or as the F(-v_d) of eq. (8)."""


class ExcitedTable(_BlockTable):
    """Steady sliding with some masses pulled away from it."""

    kind: Literal["excited"]
    """Which one."""
    oscillators: Masses | None = None
    """Which masses are excited, counted from 1; instead of `excited`."""
    pattern: Literal["alternating", "in-phase"] = "alternating"
    """Signs of the displacements along the chain."""
    displacement: PerCell = 2.0
    """How far an excited mass is pulled away, in x0; one number, or a list with one per mass."""
    velocity: PerCell = 0.0
    """Velocity of every mass, in x0 omega_n; one number, or a list with one per mass."""


StartTable: TypeAlias = Annotated[
    Any,
    _one_of(
        "kind",
        {"equation_8": Equation8Table, "equation_10": Equation10Table, "excited": ExcitedTable},
    ),
]


def _form_of_start(value: Any) -> str:
    words = value.values() if isinstance(value, dict) else ()
    named = isinstance(value, BaseModel) or any(isinstance(one, str) for one in words)
    return "<start>" if named else "<cells>"


_CellNumbers: TypeAlias = Annotated[dict[str, PerCell], Field(max_length=100)]
InitialTable: TypeAlias = Annotated[
    Any, OneOf({"start": StartTable, "cells": _CellNumbers}, Discriminator(_form_of_start))
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
    """Friction smoothed by its width, true dry friction, or one run of each; cells other than a
    chain are integrated as they are, "smoothed"."""
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


class CustomObserverTable(Table):
    """A custom observer, named on the command line: `--observer FILE.py:CLASS`.

    The other keys are fields of its class.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Any] = Field(init=False)

    observer: Literal["custom"]
    """Which one."""
    name: Text
    """The name of its class."""


def _observed(name: str, kind: type[AbstractObserver]) -> type[Table]:
    own: dict[str, Any] = {"start": 0.0, "component": None}
    defaults = {field.name: field.default for field in dataclasses.fields(kind)}
    if defaults.get("capacity") == 0:
        own["capacity"] = dataclasses.MISSING
    own = {k: v for k, v in own.items() if k in defaults}
    return _generated(kind, observer=_which(name), **own)


ObserverTable: TypeAlias = Annotated[
    Any,
    _one_of(
        "observer",
        {name: _observed(name, kind) for name, kind in OBSERVERS.items()}
        | {"custom": CustomObserverTable},
    ),
]


class ObserveTable(Table):
    """The observed quantities of every run."""

    component: Component | None = None
    """Which variable of a cell the amplitude is of: its name, or its number from 0; absent: the
    first."""
    quantities: Annotated[
        list[Literal["amplitude", "energy", "active_count"]],
        Field(min_length=1),
        AfterValidator(distinct),
    ] = Field(default_factory=lambda: ["amplitude", "energy", "active_count"])
    """What is kept of the amplitudes A: each of them, the energy 1/2 sum A^2, and, of a chain, how
    many exceed half the belt speed."""
    stop: Literal["never", "quiet", "steady"] = "never"
    """When a run may end early: once every mass of a chain rests for good ("quiet"), or also once
    the amplitudes of successive windows agree ("steady")."""
    tolerance: Positive = 1e-6
    """How well they must agree for "steady"."""
    repeats: Annotated[int, Field(ge=1, le=10**6)] = 5
    """In how many windows in succession they must agree for "steady"."""
    quiet_below: Positive = 1e-6
    """Speed and acceleration below which a mass counts as at rest, for "quiet" and "steady"."""
    others: Annotated[list[ObserverTable], Field(min_length=1, max_length=50)] | None = None
    """What else is observed, such as `{ observer = "StickTime", window = 100.0 }`."""
