"""The states at given times."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Trajectory(eqx.Module):
    """The state at given times: value (x, v), both of shape (len(times), n).

    The times must lie within the run; they are served by diffrax's `SaveAt`.
    """

    times: Float[Array, " times"] = eqx.field(converter=jnp.asarray)
