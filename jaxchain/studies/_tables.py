"""Tables that several studies share; nothing here needs JAX."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from jaxchain.scenes.tables import NonNegative, Positive, Table

if TYPE_CHECKING:
    from jaxchain.model.chain import Chain

Count: TypeAlias = Annotated[int, Field(ge=1)]
Several: TypeAlias = Annotated[list[Positive], Field(min_length=1)]
Tolerance: TypeAlias = Annotated[float, Field(gt=0, lt=1)]


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


class BaseTable(Table):
    """Equal masses on their belt; each number stands where a study does not vary it."""

    damping_ratio: Positive
    mu_static: Positive
    mu_dynamic: NonNegative
    v_ref: Positive

    @model_validator(mode="after")
    def _check(self) -> BaseTable:
        if self.mu_dynamic >= self.mu_static:
            raise ValueError("must have a `mu_static` above `mu_dynamic`")
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
