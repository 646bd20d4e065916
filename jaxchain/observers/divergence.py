"""The divergence of the flow along a run: how phase space shrinks."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators
from .base import AbstractObserver, Step

# Gauss's rule on [0, 1], exact to order 9.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


class Divergence(AbstractObserver):
    """Integral of tr J along a run, by Gauss's rule of five points in every step.

    It is a number without derivatives.
    """

    def init(self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del field, t0, t1, y0
        return jnp.zeros(())

    def update(self, accumulator: Any, step: Step) -> Any:
        frozen = lax.stop_gradient
        field = frozen(step.field)
        nodes, length = jnp.asarray(_NODES), frozen(step.t1 - step.t0)
        states = jax.vmap(step.displacement)(nodes), jax.vmap(step.velocity)(nodes)
        rates = jax.vmap(field.divergence)(frozen(step.t0) + nodes * length, frozen(states))
        return frozen(accumulator + length * (jnp.asarray(_WEIGHTS) @ rates))

    def settled(self, accumulator: Any) -> None:
        del accumulator

    def read(self, accumulator: Any) -> Float[Array, ""]:
        return accumulator
