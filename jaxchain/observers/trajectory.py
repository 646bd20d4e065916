"""The states at given times."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._checks import check_finite, is_traced, named
from .._reprs import call


class Trajectory(eqx.Module):
    """The state at given times: value (x, v), both of shape (len(times), n).

    The times must lie within the run; they are served by diffrax's `SaveAt`.
    """

    times: Float[Array, " times"] = eqx.field(converter=named("times"))

    def __repr__(self) -> str:
        return call(self)

    def __check_init__(self) -> None:
        if self.times.ndim != 1 or not self.times.size:
            raise ValueError(
                "Argument `times` must be a non-empty one-dimensional array, but has shape "
                f"{self.times.shape}."
            )
        check_finite("times", self.times, "leave out such times.")
        times = None if is_traced(self.times) else np.asarray(self.times)
        if times is not None and np.any(np.diff(times) < 0):
            at = int(np.argmax(np.diff(times) < 0))
            raise ValueError(
                f"Argument `times` must increase, but {times[at]:g} is followed by "
                f"{times[at + 1]:g}: sort them."
            )
