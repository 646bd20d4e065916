"""Arguments that many functions take, checked: a chain, a state, a mass, a symmetry."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from jaxtyping import Array, Float

from .._checks import (
    check_finite,
    check_kind,
    check_whole,
    require_64_bits,
    require_x64,
    shown,
    to_float,
)
from .._spelling import did_you_mean
from .cells import AbstractCells, AbstractField
from .chain import MAKE_CHAIN, Chain
from .entries import array_of
from .locality import check_cells, check_local
from .oscillators import AbstractOscillators

_STATES = "see `excited_state` for initial states."

_Kind = TypeVar("_Kind", bound=AbstractField)


def as_chain(chain: Any, kind: type[_Kind] = Chain, remedy: str = "") -> _Kind:
    """The chain, or `ValueError` unless it is of this kind and made of 64-bit numbers."""
    require_x64()
    others = {Chain: "", AbstractOscillators: " or other `AbstractOscillators`"}
    other = others.get(kind, ", or other `AbstractOscillators` or `AbstractCells`")
    check_kind("chain", chain, kind, f"a `Chain`{other}", remedy or MAKE_CHAIN)
    require_64_bits("chain", chain)
    return chain


def as_state(
    chain: AbstractField,
    state: Any,
    name: str = "initial",
    *,
    t0: Any = 0.0,
    batch: bool = False,
) -> tuple[Float[Array, "*states n"], ...]:
    """A state (x, v) as floats, both of shape (n,), or (states, n) if it is a `batch`.

    The state of `AbstractCells` is a tuple of as many arrays as `rate` returns.

    **Raises:** `ValueError` for anything else, for numbers that are not finite, and for other
    oscillators whose forces are not local there at the time `t0`.
    """
    if isinstance(chain, AbstractCells):
        return _as_state_of_cells(chain, state, name, t0, batch)
    if not isinstance(state, tuple | list) or len(state) != 2:
        raise ValueError(
            f"Argument `{name}` must be the pair (displacement, velocity), but is "
            f"{shown(state)}: {_STATES}"
        )
    parts = zip(("displacement", "velocity"), state, strict=True)
    x, v = (to_float(value, f"{name} {part}", _STATES) for part, value in parts)
    n = chain.n if isinstance(chain, Chain) else x.shape[-1] if x.ndim else 0
    if x.shape != v.shape or x.shape[-1:] != (n,) or x.ndim != 1 + batch or not x.size:
        masses = "one mass" if n == 1 else f"{n} masses"
        wanted = f"(states, {n})" if batch else f"({n},): use `jax.vmap` or `sweep` for several"
        raise ValueError(
            f"Argument `{name}` has parts of shapes {x.shape} and {v.shape}, but for {masses} "
            f"displacement and velocity have shape {wanted}."
        )
    for part, values in (("displacement", x), ("velocity", v)):
        check_finite(f"{name} {part}", values, _STATES)
    if not isinstance(chain, Chain) and not batch:
        check_local(chain, t0, (x, v))
    return x, v


def _as_state_of_cells(
    cells: AbstractCells, state: Any, name: str, t0: Any, batch: bool
) -> tuple[Float[Array, "*states n"], ...]:
    kind = type(cells).__name__
    if not isinstance(state, tuple | list) or not state:
        raise ValueError(
            f"Argument `{name}` must be a tuple of arrays of shape (n,), one for each number of a "
            f"cell of `{kind}`, but is {shown(state)}."
        )
    parts = tuple(to_float(part, f"{name}[{k}]") for k, part in enumerate(state))
    shapes = {part.shape for part in parts}
    if len(shapes) > 1 or parts[0].ndim != 1 + batch or not parts[0].size:
        raise ValueError(
            f"Argument `{name}` must hold arrays of one shape {'(states, n)' if batch else '(n,)'}"
            f", one for each number of a cell, but has the shapes {[p.shape for p in parts]}."
        )
    for k, part in enumerate(parts):
        check_finite(f"{name}[{k}]", part)
    if not batch:
        cells.dependence(parts)  # raises unless there is a rate for each number
        check_cells(cells, t0, parts)
    return parts


def as_parameter(model: AbstractField, name: Any, title: str = "parameter") -> Float[Array, ""]:
    """The value of the parameter of this name, one number, or `ValueError`.

    An entry of an array is one, too: "stiffness[0, 1]".
    """
    if array_of(name) is not None:
        return model.value_of(name)
    numbers = model.numbers()
    known = sorted(k for k, value in numbers.items() if np.shape(value) == ())
    if not isinstance(name, str) or name not in known:
        shape = np.shape(numbers.get(name)) if isinstance(name, str) else ()
        entry = ", ".join(["0"] * len(shape))
        raise ValueError(
            f"Argument `{title}` must be one of {known}, the numbers of the model that are the "
            f"same for all cells, or an entry of an array, but is {shown(name)}"
            + (f": name one of its entries, `{name}[{entry}]`." if shape else "")
            + ("" if shape else f"{did_you_mean(name, known)}.")
        )
    return model.value_of(name)


def as_mass(n: int, mass: Any, default: Any = None, name: str = "mass") -> Any:
    """The index of one of n masses, `default` for None, or `ValueError`."""
    if mass is None:
        return default
    remedy = "For several vibrating masses follow the branch of their cycle."
    return check_whole(name, mass, 0, n - 1, f"it is the index of a mass. {remedy}")


def as_images(images: Any, n: int, mass: int | None = None) -> tuple[int, ...]:
    """For each of n masses the index of the one that it moves like; None: no symmetry."""
    if images is None:
        return tuple(range(n))
    given = images if isinstance(images, tuple | list | np.ndarray) else ()
    whole = all(isinstance(i, int | np.integer) for i in given)
    given = tuple(int(i) for i in given) if whole else ()
    good = len(given) == n and all(0 <= i < n and given[i] == i for i in given)
    if not good or (mass is not None and given[mass] != mass):
        itself = "" if mass is None else f", mass {mass} (`mass`) among them"
        raise ValueError(
            f"Argument `images` must name for each of {n} masses the one it does the same as, and "
            f"for that one itself{itself}, but is {shown(images)}."
        )
    return given
