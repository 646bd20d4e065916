"""The divergence of the flow along a run: how phase space shrinks."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._final import final
from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators
from .base import AbstractObserver, Step, Variable


@final
class Divergence(AbstractObserver):
    """Integral of tr J along a run, by Gauss's rule of five points in every step.

    **Value:** a number, without derivatives: the logarithm of the factor by which a small volume
    of states around the run grows.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate
        >>> from jaxchain.observers import Divergence
        >>> chain = paper_chain(3, belt_speed=9.0, width=1e-2)  # hardly more than 3 damped masses
        >>> run = simulate(chain, equation_8(chain, 0), 10.0, observe=Divergence())
        >>> round(float(run.observed), 3)  # -3 * 2 xi * 10
        -3.0
    """

    def init(self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del field, t0, t1, y0
        return jnp.zeros(())

    def update(self, accumulator: Any, step: Step) -> Any:
        step = step.frozen()
        return lax.stop_gradient(accumulator + step.integral(step.field.divergence))

    def read(self, accumulator: Any) -> Float[Array, ""]:
        return accumulator

    def label(self, value: Float[Array, ""], chain: Any) -> dict[str, Variable]:
        del chain
        return {"divergence": Variable(value, (), "1", "integral of tr J over the run")}
