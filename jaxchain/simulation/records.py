"""States at given times, which the steps of a run meet exactly."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._types import State


class Record(eqx.Module):
    """The states at given times, which the steps meet exactly."""

    times: Float[Array, " times"]
    states: Any  # (x, v), of shapes (times, n): that of equal times where the first of them stands
    count: Int[Array, ""]  # of the times that have passed

    @classmethod
    def blank(cls, times: Array, n: int) -> Record:
        """A record of n masses at these times, with nothing in it."""
        nothing = jnp.full((*times.shape, n), jnp.nan)
        return cls(times, (nothing, nothing), jnp.zeros((), int))

    def next_time(self) -> Array:
        """The first of the times that is not recorded yet; infinite after the last."""
        last = self.times.shape[0] - 1
        ahead = self.times[jnp.minimum(self.count, last)]
        return jnp.where(self.count <= last, ahead, jnp.inf)

    def keep(self, t: Array, state: State) -> Record:
        """With the state, if the time is one of those asked for."""
        here: Any = self.next_time() <= t
        place = jnp.minimum(self.count, self.times.shape[0] - 1)
        # On the way of reverse derivatives these are buffers, which are written to only like this.
        states = tuple(
            eqxi.buffer_at_set(kept, place, now, pred=here)
            for kept, now in zip(self.states, state, strict=True)
        )
        passed = jnp.searchsorted(self.times, t, side="right")
        return Record(self.times, states, jnp.maximum(self.count, passed))

    def read(self) -> tuple[Array, Array]:
        first = jnp.searchsorted(self.times, self.times)
        x, v = self.states
        return x[first], v[first]
