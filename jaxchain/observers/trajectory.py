"""The states at given times."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._checks import check_finite, is_traced, named
from .._final import final


@final
class Trajectory(eqx.Module):
    """The state at given times: value (x, v), both of shape (len(times), n).

    **Arguments:** `times`, dimensionless and rising; they must lie within the run, and are served
    by diffrax's `SaveAt`.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Trajectory, equation_8, paper_chain, simulate
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> watch = Trajectory(jnp.linspace(0.0, 10.0, 101))
        >>> x, v = simulate(chain, equation_8(chain, 1), 10.0, observe=watch).observed
        >>> x.shape, float(x[0, 1].round(3))
        ((101, 3), 2.525)
    """

    times: Float[Array, " times"] = eqx.field(converter=named("times"))

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
