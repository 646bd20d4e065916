"""Loops in which large arrays are touched once in many steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox.internal as eqxi
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int

# Steps between two times that notes are gathered.
ROUND = 64

Notes = list[Float[Array, "steps n"]]


def in_rounds(
    goes_on: Callable[[Any], Bool[Array, ""]],
    step: Callable[[Any], tuple[Any, list[Float[Array, " n"]]]],
    gather: Callable[[Any, Notes, Int[Array, ""]], Any],
    first: Any,
    notes: int,
    n: int,
) -> Any:
    """step, step, ... while it `goes_on`, and after a round of them what they noted is gathered.

    In a batch, JAX chooses between old and new at every step, for each array that a loop carries
    and some lanes are done with.  Here all lanes take steps until the last one ends; what `step`
    hands on as it is costs nothing.

    **Arguments:** `step`: carry -> (carry, `notes` arrays of shape (n,)); `gather`: carry, notes
    of shape (steps, n), how many of these count -> carry.
    """

    def any_goes_on(carry: Any) -> Bool[Array, ""]:
        return eqxi.unvmap_any(goes_on(carry))

    def more(inner: Any) -> Bool[Array, ""]:
        return (inner[0] < ROUND) & any_goes_on(inner[1])

    def one(inner: Any) -> Any:
        place, old, notes, count = inner
        on = goes_on(old)
        new, noted = step(old)
        new = jtu.tree_map(lambda a, b: a if a is b else jnp.where(on, a, b), new, old)
        notes = [
            lax.dynamic_update_index_in_dim(all, own, place, 0)
            for all, own in zip(notes, noted, strict=True)
        ]
        return place + 1, new, notes, count + on

    def one_round(outer: Any) -> Any:
        carry, notes = outer
        none = jnp.zeros((), int)
        _, carry, notes, count = lax.while_loop(more, one, (none, carry, notes, none))
        return gather(carry, notes, count), notes

    begin = first, [jnp.zeros((ROUND, n)) for _ in range(notes)]
    return lax.while_loop(lambda outer: any_goes_on(outer[0]), one_round, begin)[0]
