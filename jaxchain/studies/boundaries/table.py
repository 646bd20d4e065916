"""What may stand in the file of the study `boundaries`."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.tables import NonNegative, Positive, Table


class Span(Table):
    """Values from `start` to `stop`, both included."""

    start: Positive
    stop: Positive
    count: Annotated[int, Field(ge=2, le=1000)]
    spacing: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _check(self) -> Span:
        if self.stop <= self.start:
            raise ValueError(f"must have a `stop` above `start`, but {self.stop:g} is not")
        return self

    def array(self) -> np.ndarray:
        """The values, in order."""
        make = np.linspace if self.spacing == "linear" else np.geomspace
        return make(self.start, self.stop, self.count)


class CouplingSpan(Span):
    """Of a ring of which one mass vibrates."""

    masses: Annotated[int, Field(ge=3)] = 5


class Base(Table):
    """One mass on its belt; each number stands where it does not vary."""

    damping_ratio: Positive
    mu_static: Positive
    mu_dynamic: NonNegative
    v_ref: Positive
    width: Positive

    @model_validator(mode="after")
    def _check(self) -> Base:
        if self.mu_dynamic > self.mu_static:
            raise ValueError("must have a `mu_static` of at least `mu_dynamic`")
        return self


class Cycles(Table):
    """All cycles of one mass over the belt speed."""

    width: Annotated[list[Positive], Field(min_length=1, max_length=4)]
    lowest: Positive = 0.1
    """Belt speed at which the stick-slip branch is left."""


class Study(StudyTable):
    """Hopf and fold curves of one mass, and of a ring of which one mass vibrates."""

    study: Literal["boundaries"]
    base: Base
    damping_ratio: Span
    mu_static: Span
    width: Span
    coupling: CouplingSpan
    cycles: Cycles

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        if self.mu_static.start < self.base.mu_dynamic:
            raise ValueError("must have a `mu_static.start` of at least `base.mu_dynamic`")
        return self
