"""Regions of the state space from which a system may start."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._checks import (
    as_array,
    check_finite,
    check_whole,
    is_traced,
    numbers_of,
    shown,
)
from .._reprs import call

_EDGES = "give (low, high), as (-2, 2)."
_MASSES = "give None for all masses, or indices from 0, as (0, 1)."


def _edges(name: str) -> Any:
    return lambda value: as_array(name, value, 1, 1, _EDGES)


def _indices(value: Any) -> Any:
    """A tuple of whole numbers, or what was given, for the check to refuse."""
    if isinstance(value, list | tuple | range | np.ndarray):
        return tuple(value.tolist() if isinstance(value, np.ndarray) else value)
    return value


class Box(eqx.Module):
    """Displacements and velocities between two numbers each, the same for every mass.

    a <= x_n <= b, c <= v_n <= d, for the masses n that are pushed; the others slide steadily.

    **Arguments:** `displacement` = (a, b) and `velocity` = (c, d), dimensionless, differentiable;
    `masses`, None for all, or the indices (from 0) of those that are pushed.

    **Raises:** `ValueError` unless a < b and c < d are finite, and `masses` are different indices.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> box = Box(displacement=(-2, 2), velocity=(0, 2))
    >>> box.displacement.tolist(), box.velocity.tolist(), box.masses
    ([-2.0, 2.0], [0.0, 2.0], None)
    """

    displacement: Float[Array, "2"] = eqx.field(
        converter=_edges("displacement"), default=(-2.0, 2.0)
    )
    velocity: Float[Array, "2"] = eqx.field(converter=_edges("velocity"), default=(0.0, 2.0))
    masses: tuple[int, ...] | None = eqx.field(converter=_indices, default=None, static=True)

    def __repr__(self) -> str:
        return call(self)

    def __check_init__(self) -> None:
        for name in ("displacement", "velocity"):
            edges = getattr(self, name)
            if edges.shape != (2,):
                raise ValueError(
                    f"Argument `{name}` must be two numbers, but is {shown(edges)}: {_EDGES}"
                )
            check_finite(name, edges, _EDGES)
            known = None if is_traced(edges) else numbers_of(name, edges)
            if known is not None and not known[0] < known[1]:
                raise ValueError(
                    f"Argument `{name}` must be (low, high) with low < high, but is "
                    f"{tuple(known.tolist())}: {_EDGES}"
                )
        if self.masses is None:
            return
        if not isinstance(self.masses, tuple) or not self.masses:
            raise ValueError(
                f"Argument `masses` must be indices, but is {shown(self.masses)}: {_MASSES}"
            )
        for mass in self.masses:
            check_whole("masses", mass, 0, remedy=_MASSES)
        if len(set(self.masses)) < len(self.masses):
            raise ValueError(
                f"Argument `masses` must be different, but is {shown(self.masses)}: {_MASSES}"
            )
