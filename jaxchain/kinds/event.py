"""A zero of a user's own function of a cycle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .kind import AbstractKind, AbstractTested, Unknowns


@dataclass(frozen=True)
class Event(AbstractTested):
    """`function` of a cycle is zero."""

    name: str
    function: Callable[[Any], Any]

    def test(self, orbit: Any, extra: Any) -> float:
        """The function itself."""
        return float(self.function(extra))

    def followed(self, orbit: Any, point: Any) -> tuple[AbstractKind, list[float]]:
        """It is followed if it depends on what `SeenCycle` has."""
        z = Unknowns(jnp.asarray(point.raw.u), (jnp.asarray(point.parameter),), 0.0)
        try:
            eqx.filter_eval_shape(self.fixed, orbit, z, ())
        except AttributeError as error:
            raise ValueError(
                f'Argument `point` is the event "{self.name}", whose function uses more of a '
                "cycle than `state`, `period` and `amplitude`, which are followed: "
                f"{error}"
            ) from error
        return self, []

    def fixed(self, orbit: Any, z: Unknowns, vectors: Any) -> Float[Array, " equations"]:
        """See `AbstractKind`."""
        return jnp.reshape(self.function(orbit.seen(z.u, *z.parameters)), (1,))
