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
from .chain import MAKE_CHAIN, Chain
from .entries import array_of
from .model import AbstractModel
from .oscillators import AbstractOscillators

_STATES = "see `excited_state` for initial states."

_Kind = TypeVar("_Kind", bound=AbstractModel)


def as_model(
    model: Any, kind: type[_Kind] = AbstractModel, remedy: str = "", name: str = "model"
) -> _Kind:
    """The model, or `ValueError` unless it is of this kind and made of 64-bit numbers."""
    require_x64()
    others = {Chain: "", AbstractOscillators: " or other `AbstractOscillators`"}
    other = others.get(kind, ", or other `AbstractOscillators` or `AbstractCells`")
    check_kind(name, model, kind, f"a `Chain`{other}", remedy or MAKE_CHAIN)
    require_64_bits(name, model)
    return model


def as_chain(chain: Any, remedy: str = "", name: str = "chain", belts: bool = False) -> Chain:
    """The chain, or `ValueError` for anything else, and unless `belts` for several belt speeds."""
    chain = as_model(chain, Chain, remedy, name)
    if chain.belt_speed.ndim and not belts:
        raise ValueError(
            f"Argument `{name}` must have one belt speed here, but has one for each mass: use "
            "`chain.with_(belt_speed=1.5)`, or follow a cycle of `find_limit_cycle` in another "
            "parameter."
        )
    return chain


def as_state(
    model: AbstractModel,
    state: Any,
    name: str = "initial",
    *,
    t0: Any = 0.0,
    batch: bool = False,
) -> tuple[Float[Array, "*states n"], ...]:
    """A state as floats: m arrays of shape (n,), or (states, n) if it is a `batch`.

    It is the pair (x, v) of a chain and other oscillators, and a tuple of as many arrays as `rate`
    returns of `AbstractCells`.

    **Raises:** `ValueError` for anything else, for numbers that are not finite, and for a model
    whose forces are not local there at the time `t0`.
    """
    names = [variable.name for variable in model.variables]
    wanted, n = model.state_in_words, model.n
    size = "(n,)" if n is None else f"({n},)"
    several = isinstance(state, tuple | list) and len(state) > 0
    if not several or (names and len(state) != len(names)):
        raise ValueError(
            f"Argument `{name}` must be {wanted}, one array of shape {size} for each variable of "
            f"`{type(model).__name__}`, but is {shown(state)}: {_STATES}"
        )
    labels = [f"{name}[{k}]" for k in range(len(state))]
    if names:
        labels = [f"{name} {part}" for part in names]
    parts = tuple(to_float(a, label, _STATES) for a, label in zip(state, labels, strict=True))
    shapes = {part.shape for part in parts}
    other = parts[0].shape[-1:] != (n,) and n is not None
    if len(shapes) > 1 or other or parts[0].ndim != 1 + batch or not parts[0].size:
        last = parts[0].shape[-1] if n is None and names and parts[0].ndim else n
        size = size if last is None else f"({last},)"
        masses = "" if n is None else " for one mass" if n == 1 else f" for {n} masses"
        shape = f"{size}: use `jax.vmap` or `sweep` for many"
        shape = f"(states, {size[1:-2]})" if batch else shape
        raise ValueError(
            f"Argument `{name}` has parts of shapes {' and '.join(str(a.shape) for a in parts)}, "
            f"but{masses} must be {wanted} of one shape {shape}."
        )
    for part, label in zip(parts, labels, strict=True):
        check_finite(label, part, _STATES)
    if not batch:
        model.check_locality(t0, parts)
    return parts


def as_parameter(model: AbstractModel, name: Any, title: str = "parameter") -> Float[Array, ""]:
    """The value of the parameter of this name, one number, or `ValueError`.

    An entry of an array is one, too: "stiffness[0, 1]".
    """
    if array_of(name) is not None:
        return model.value_of(name)
    numbers = model.parameters()
    known = sorted(k for k, value in numbers.items() if np.shape(value) == ())
    if not isinstance(name, str) or name not in known:
        shape = np.shape(numbers.get(name, 0.0)) if isinstance(name, str) else ()
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
