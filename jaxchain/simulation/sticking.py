"""Which masses stick to the belt in a state."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._types import ScalarLike, State
from ..model.model import AbstractModel
from ..solvers.dry_friction import RESOLUTION


def is_sticking(model: AbstractModel, t: ScalarLike, state: State) -> Bool[Array, " n"] | None:
    """Which masses stick at the time t, of shape (n,); None of a model whose masses cannot stick.

    By the rule of `jaxchain.plotting.sticking`, which takes the states of many times.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.model import on_the_belt
    >>> from jaxchain.simulation.sticking import is_sticking
    >>> chain = paper_chain(3, belt_speed=1.5, width=None)
    >>> is_sticking(chain, 0.0, on_the_belt(chain)).tolist()
    [False, True, False]
    """
    known: Any = model
    if (limit := known.stick_speed()) is None:
        return None
    if known.dry:
        unit = known.natural_scales()[1]
        (contact,) = known.frictional_contacts  # of several there is no one speed
        limit = limit + RESOLUTION * (unit + jnp.abs(contact.speed_at(t)))
    layer: Any = known.layer(t, state)
    left, right = known.neighbours(state)
    return (jnp.abs(layer[0]) <= limit) & (known.excess_force(t, left, state, right) <= 0)
