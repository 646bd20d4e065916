"""Energy balance along a run: work of the belt, losses to friction and damping, what is stored.

v_d sum p_n F_n = sum p_n |F_n w_n| + sum 2 xi_n v_n^2 + d/dt 1/2 (v . v + x . K x)
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxchain.model.chain import Chain
from jaxchain.observers.base import AbstractObserver, Step

# Nodes and weights of Gauss's rule on [0, 1], exact to order 5: better than what is interpolated.
_NODES = 0.5 + 0.5 * np.sqrt(0.6) * np.array([-1.0, 0.0, 1.0])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
# A mass that the non-smooth solver holds on the belt has exactly its speed, but for interpolation.
_STUCK = 1e-9


class EnergyBalance(AbstractObserver):
    """(work of the belt, energy lost to friction and damping, growth of the stored energy).

    **Arguments:** `chain`; `dry`, whether its friction is meant as it is or smoothed.
    """

    chain: Chain
    dry: bool = eqx.field(static=True, default=False)

    def init(self, field: Any, t0: Any, t1: Any, y0: Any) -> tuple[Array, Array, Array, Array]:
        del field, t0, t1
        stored = self._stored(*y0)
        return jnp.zeros(()), jnp.zeros(()), stored, stored

    def update(self, accumulator: Any, step: Step) -> Any:
        work, lost, start, _ = accumulator
        h = step.t1 - step.t0
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            x, v = step.displacement(node), step.velocity(node)
            force = self._friction(x, v)
            w = v - self.chain.belt_speed
            work = work + weight * h * self.chain.belt_speed * jnp.sum(force)
            damping = 2.0 * self.chain.damping_ratio * v**2
            lost = lost + weight * h * jnp.sum(damping - force * w)
        return work, lost, start, self._stored(*step.y1)

    def settled(self, accumulator: Any) -> None:
        del accumulator

    def read(self, accumulator: Any) -> Float[Array, "3"]:
        work, lost, start, end = accumulator
        return jnp.stack([work, lost, end - start])

    def _stored(self, x: Array, v: Array) -> Array:
        return 0.5 * jnp.sum(v**2 - x * self.chain.restoring_force(x))

    def _friction(self, x: Array, v: Array) -> Array:
        chain = self.chain
        w = v - chain.belt_speed
        if not self.dry:
            return chain.load * chain.friction.force(w)
        sliding = -chain.load * chain.friction.law.coefficient(jnp.abs(w)) * jnp.sign(w)
        holding = 2.0 * chain.damping_ratio * v - chain.restoring_force(x)
        return jnp.where(jnp.abs(w) < _STUCK, holding, sliding)
