"""What a key of a scene file may hold: numbers within bounds, names, texts, lists and ranges.

The bounds are far beyond what means anything for a dimensionless chain.  They keep squares and
quotients finite, and counts within what can be computed and stored.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from decimal import Decimal
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_validator,
)
from pydantic_core import PydanticCustomError

from .._limits import LEAST_ATOL, LEAST_RTOL

# Of numbers other than 0, in magnitude.
LEAST, MOST = 1e-15, 1e15
# Time units of a run: some days of one core.
MOST_TIME = 1e9
# Steps far below any that a vibration needs.
LEAST_STEP = 1e-6
MOST_STEPS, MOST_COUNT = 10**15, 10**6
# Values of one list or range.
MOST_VALUES = 10**6
# Numbers that one experiment keeps: 0.8 GB, which a workstation holds while it writes them.
MOST_NUMBERS = 10**8
MOST_LANES_REMEDY = "take fewer values, or share them out over several experiments or scene files"
# Whole numbers, and powers of ten, up to these are floats.
_EXACT, _EXACT_PLACES = 2**53, 22
# (path of a key within the table, what is wrong with it).
Problem: TypeAlias = tuple[tuple[str, ...], str]
# What begins the names of groups and files.
NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"
NAME_LENGTH, TEXT_LENGTH = 64, 10_000


def description(docstring: str) -> str:
    """What a docstring says to readers of files: all but its example, which is Python."""
    return inspect.cleandoc(docstring).partition("\n\n!!! example")[0]


class Table(BaseModel):
    """A table of a scene file: unknown keys, wrong types, NaN and infinity are errors."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


def raise_all(problems: list[Problem]) -> None:
    """All at once; `jaxchain.scenes.wording` unpacks them again."""
    if problems:
        raise as_error(problems)


def as_error(problems: list[Problem]) -> PydanticCustomError:
    """All problems of a table as one error of pydantic, which carries them."""
    text = "; ".join(f"{'.'.join(path)}: {message}" for path, message in problems)
    return PydanticCustomError("problems", "{text}", {"text": text, "problems": problems})


def form(value: Any) -> str:
    """Which of the kinds of value that may stand for numbers this is."""
    if isinstance(value, dict | BaseModel):
        return "table"
    return "list" if isinstance(value, list) else "number"


def shown(number: float | int) -> str:
    """Short, but a count to the last digit.

    >>> shown(1000000), shown(1e-15)
    ('1000000', '1e-15')
    """
    return str(number) if isinstance(number, int) else f"{number:g}"


def _at_most(most: float) -> Callable[[float], float]:
    def check(value: float) -> float:
        if abs(value) > most:
            raise ValueError(f"must be at most {most:g} in size, but is {value!r}")
        if 0 < abs(value) < LEAST:
            raise ValueError(f"must be 0 or at least {LEAST:g} in size, but is {value!r}")
        return value

    return check


def _above_least(value: float) -> float:
    if value < LEAST:
        raise ValueError(f"must be at least {LEAST:g}, but is {value!r}")
    return value


def _printable(text: str) -> str:
    if bad := next((c for c in text if not (c.isprintable() or c in "\n\t")), None):
        raise ValueError(f"must not hold the character {bad!r}, which cannot be printed")
    return text


Number: TypeAlias = Annotated[float, AfterValidator(_at_most(MOST))]
Positive: TypeAlias = Annotated[
    float, Field(gt=0), AfterValidator(_above_least), AfterValidator(_at_most(MOST))
]
NonNegative: TypeAlias = Annotated[float, Field(ge=0), AfterValidator(_at_most(MOST))]
Count: TypeAlias = Annotated[int, Field(ge=1, le=MOST_COUNT)]
# An error of a step, relative or not.
Tolerance: TypeAlias = Annotated[float, Field(ge=LEAST_RTOL, lt=1)]
AbsoluteTolerance: TypeAlias = Annotated[float, Field(ge=LEAST_ATOL, le=MOST)]
StepLength: TypeAlias = Annotated[float, Field(ge=LEAST_STEP, le=MOST_TIME)]
# The number of a mass, counted from 1.
Mass: TypeAlias = Annotated[int, Field(ge=1, le=MOST_NUMBERS)]
Text: TypeAlias = Annotated[str, Field(max_length=TEXT_LENGTH), AfterValidator(_printable)]
Title: TypeAlias = Annotated[
    str,
    Field(min_length=1, max_length=TEXT_LENGTH, description="What it is called, in one line."),
    AfterValidator(_printable),
]
Description: TypeAlias = Annotated[
    Text, Field(description="What it is about, in some sentences, which its results keep.")
]
# Of an experiment, an ensemble, a case: names a group of the results.
Name: TypeAlias = Annotated[str, Field(pattern=NAME, max_length=NAME_LENGTH)]


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


Time: TypeAlias = Annotated[float, Field(ge=0), AfterValidator(_at_most(MOST_TIME))]
PositiveTime: TypeAlias = Annotated[
    float, Field(gt=0), AfterValidator(_above_least), AfterValidator(_at_most(MOST_TIME))
]
# A time over which vibrations are measured.
Window: TypeAlias = Annotated[
    float, Field(gt=0), AfterValidator(_holds_a_period), AfterValidator(_at_most(MOST_TIME))
]


# What keys mean that several tables have, with bounds of their own.
TRANSIENT = Field(description="Time units that are waited for before amplitudes are measured.")
WINDOW = Field(
    description="Time units over which amplitudes are measured; a period is about 2 pi."
)
RTOL = Field(
    description="Relative tolerance of a time step: what is smaller is more accurate and slower."
)


class Range(Table):
    """Equally spaced values: start, start + step, ... stop, or `count` values with both ends."""

    start: Number
    """The first value."""
    stop: Number
    """The last value, unless the steps do not meet it; none lies beyond."""
    step: float | None = None
    """Distance between values; negative to count down."""
    count: Annotated[int, Field(ge=1)] | None = None
    """Number of values, both ends included; instead of `step`."""

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
        if self._length() > MOST_VALUES:
            raise ValueError(
                f"would be {self._length():.3g} values, and {MOST_VALUES} are the most: "
                f"{MOST_LANES_REMEDY}"
            )
        return self

    def _length(self) -> float:
        if self.step is None:
            return float(min(self.count or 0, MOST))
        # The last value may miss `stop` by rounding.
        return (self.stop - self.start) / self.step + 1 + 1e-9

    def array(self) -> np.ndarray:
        """The values.  Steps are added in decimal, so that 1.0 + 3 * 0.05 is 1.15."""
        count = math.floor(self._length())
        if self.step is None:
            return np.linspace(self.start, self.stop, count)
        start, step = Decimal(repr(self.start)), Decimal(repr(self.step))
        places = max(0, *(-int(number.as_tuple().exponent) for number in (start, step)))
        first, by = (int(number.scaleb(places)) for number in (start, step))
        if places <= _EXACT_PLACES and max(abs(first), abs(first + count * by)) < _EXACT:
            # Both are exact, so that the quotient is the float next to the decimal.
            return (first + by * np.arange(count)) / 10.0**places
        return np.array([float(start + i * step) for i in range(count)])


def distinct(values: Any) -> Any:
    """The list or range, or `ValueError` if it holds a value twice."""
    entries = array(values)
    different, times = np.unique(entries, return_counts=True)
    if different.size < entries.size:
        twice = different[times > 1][0]
        text = f'"{twice}"' if isinstance(twice, str) else f"{twice:g}"
        raise ValueError(f"holds {text} more than once")
    return values


def array(values: Range | Sequence[Any]) -> np.ndarray:
    """The numbers of a list or a range.

    >>> array(Range(start=1.0, stop=2.0, step=0.5)).tolist()
    [1.0, 1.5, 2.0]
    """
    return values.array() if isinstance(values, Range) else np.array(values)


Values: TypeAlias = Annotated[
    Annotated[list[Number], Field(min_length=1, max_length=MOST_VALUES), Tag("list")]
    | Annotated[Range, Tag("table")],
    Discriminator(form),
    AfterValidator(distinct),
]
Masses: TypeAlias = Annotated[
    list[Mass], Field(min_length=1, max_length=MOST_VALUES), AfterValidator(distinct)
]
