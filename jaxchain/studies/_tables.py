"""Tables that several studies share; nothing here needs JAX."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from jaxchain._limits import MOST_LANES
from jaxchain.model.parameters import parameter
from jaxchain.scenes.scene import Problem, raise_all
from jaxchain.scenes.values import (
    MOST_LANES_REMEDY,
    MOST_NUMBERS,
    NonNegative,
    Positive,
    Table,
    distinct,
)

if TYPE_CHECKING:
    from jaxchain.model.chain import Chain

# Values of one list, and masses of a ring, that a study takes in a reasonable time.
MOST_ENTRIES, MOST_MASSES = 1000, 1000
Once = AfterValidator(distinct)
Several: TypeAlias = Annotated[list[Positive], Field(min_length=1, max_length=MOST_ENTRIES), Once]


def number(name: str) -> Any:
    """What a key means that holds this number of the chain."""
    return Field(description=f"{parameter(name).in_words.capitalize()}.")


def numbers(name: str) -> Any:
    """What a key means that holds several values of this number of the chain."""
    return Field(description=f"Values of the {parameter(name).in_words}.")


# Of keys whose bounds differ from study to study.
RING = Field(description="Number of masses of the ring.")
BASE = Field(description="Numbers of the masses, each where the study does not vary it.")


def too_many(counts: Mapping[str, int], masses: int, path: tuple[str, ...]) -> list[Problem]:
    """What is wrong with so many runs as the product of these counts, of so many masses."""
    runs, product = 1, " x ".join(f"{count} {name}" for name, count in counts.items())
    for count in counts.values():
        runs *= count
    most = min(MOST_LANES, MOST_NUMBERS // masses)
    if runs <= most:
        return []
    what = f"would be {runs:.3g} runs of {masses} masses ({product})"
    return [(path, f"{what}, and {most} are the most: {MOST_LANES_REMEDY}")]


class Span(Table):
    """Values from `start` to `stop`, both included."""

    start: Positive
    """The first value."""
    stop: Positive
    """The last value."""
    count: Annotated[int, Field(ge=2, le=1000)]
    """Number of values, both ends included."""
    spacing: Literal["linear", "log"] = "linear"
    """Whether their differences are equal ("linear") or their ratios ("log")."""

    @model_validator(mode="after")
    def _check(self) -> Span:
        if self.stop <= self.start:
            text = f"must be above `start` = {self.start:g}, but is {self.stop:g}"
            raise_all([(("stop",), text)])
        return self

    def array(self) -> np.ndarray:
        """The values, in order."""
        make = np.linspace if self.spacing == "linear" else np.geomspace
        return make(self.start, self.stop, self.count)


class BaseTable(Table):
    """Equal masses on their belt, with exponentially decaying friction."""

    damping_ratio: Annotated[Positive, number("damping_ratio")]
    mu_static: Annotated[Positive, number("mu_static")]
    mu_dynamic: Annotated[NonNegative, number("mu_dynamic")]
    v_ref: Annotated[Positive, number("v_ref")]

    @model_validator(mode="after")
    def _check(self) -> BaseTable:
        if self.mu_dynamic >= self.mu_static:
            least = self.mu_dynamic
            text = f"must be above `mu_dynamic` = {least:g}, but is {self.mu_static:g}"
            raise_all([(("mu_static",), text)])
        return self

    def chain(
        self,
        n: int,
        belt_speed: float = 1.0,
        *,
        width: float | None = None,
        coupling: float | None = None,
    ) -> Chain:
        """A ring of `n` of these masses, with dry friction unless there is a width."""
        from jaxchain.model.chain import Chain
        from jaxchain.model.friction import ExponentialDecay

        law = ExponentialDecay(self.mu_static, self.mu_dynamic, self.v_ref).with_(width=width)
        return Chain(n, law, belt_speed, self.damping_ratio, coupling)
