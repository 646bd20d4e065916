"""The loop of a search, and its steps, which are shortened until one is accepted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from ..result import SearchResult
from .damped_newton import where

_SHRINKAGE = 0.3  # the factor by which a rejected step shrinks


def iterate(
    step: Callable[[Any, Int[Array, ""]], Any],
    state: PyTree,
    ended: Callable[[Any], SearchResult],
    limit: Any,
) -> tuple[Any, SearchResult, Int[Array, ""]]:
    """(state, result, number of steps) at the end of a search of at most `limit` steps.

    It is one `lax.while_loop`, like `_iterate.py` of optimistix.

    **Arguments:** `step(state, k)`, the state after step k = 0, 1, ...; `ended(state)`, how the
    search ended there: "max_steps_reached" as long as it should go on.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.continuation.iteration import iterate
    >>> from jaxchain.result import SearchResult
    >>> of = SearchResult
    >>> def ended(x):
    ...     return of.where(x < 0.1, of.successful, of.max_steps_reached)
    >>> x, result, count = iterate(lambda x, k: x / 2, jnp.asarray(1.0), ended, 10)
    >>> float(x), bool(result == of.successful), int(count)
    (0.0625, True, 4)
    """

    def goes_on(now: tuple[Any, Array]) -> Array:
        return (ended(now[0]) == SearchResult.max_steps_reached) & (now[1] < limit)

    def once_more(now: tuple[Any, Array]) -> tuple[Any, Array]:
        return step(*now), now[1] + 1

    state, count = lax.while_loop(goes_on, once_more, (state, jnp.zeros((), int)))
    return state, ended(state), count


class TrialStep(eqx.Module):
    """The next step of an optax optimiser from the best point so far."""

    step: Float[Array, " m"]
    length: Float[Array, ""]  # the share of it that is tried
    memory: PyTree  # the state of the optimiser
    refused: Int[Array, ""]  # successive trials

    @classmethod
    def first(cls, optimiser: Any, start: Float[Array, " m"]) -> TrialStep:
        """No step: the start itself is tried."""
        return cls(jnp.zeros_like(start), jnp.ones(()), optimiser.init(start), jnp.zeros((), int))

    def after(self, accepted: Array, step: Array, memory: Any, length: Any = 1.0) -> TrialStep:
        """`step` from the new best point if the trial was accepted, else a shorter one."""
        following = TrialStep(step, jnp.asarray(length), memory, jnp.zeros((), int))
        shorter = replace(self, length=_SHRINKAGE * self.length, refused=self.refused + 1)
        return where(accepted, following, shorter)
