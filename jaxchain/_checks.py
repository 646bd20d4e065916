"""Conversion and checks of input: errors that name the argument, its value and a remedy.

The checks look at concrete numbers only. A traced value passes silently, so that a law or a chain
can be built under `jit`, `vmap` and `grad`; shapes are known even there and are always checked.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ._limits import LEAST_ATOL, LEAST_RTOL


def to_float(value: ArrayLike) -> Float[Array, "..."]:
    """`value` as a floating-point JAX array: the converter of every numeric field.

    Integers become floats, because only floats have tangents; and the result is never weakly
    typed, because a weakly typed leaf would compile everything once more.

    **Raises:** `ValueError` for complex numbers, whose imaginary part would be lost.
    """
    if np.iscomplexobj(value):
        raise ValueError(f"Numbers must be real here, but one is complex: {value}.")
    return jnp.asarray(value, dtype=float)


def require_x64() -> None:
    """Raises `RuntimeError` unless JAX computes with 64-bit floats."""
    if jnp.zeros((), dtype=float).dtype != jnp.float64:
        raise RuntimeError(
            "jaxchain needs 64-bit floats, but JAX computes with 32 bits here: call "
            "`jaxchain.configure()` at the start of the program, or set the environment variable "
            "JAX_ENABLE_X64=1."
        )


def require_64_bits(name: str, tree: object) -> None:
    """Raises `ValueError` if a floating-point array in `tree` has fewer than 64 bits.

    Such numbers come from before JAX was told to use 64 bits: 0.05 is 0.0500000007 there.
    """
    for leaf in jax.tree.leaves(tree):
        dtype = getattr(leaf, "dtype", None)
        if dtype is not None and jnp.issubdtype(dtype, jnp.floating) and dtype.itemsize < 8:
            raise ValueError(
                f"Argument `{name}` holds {dtype} numbers: it was made before JAX was told to use "
                "64-bit floats, or from an array of 32 bits. Make it again from 64-bit numbers."
            )


def _concrete(name: str, value: object) -> np.ndarray | None:
    """`value` as real numbers, or None if it is traced."""
    if is_traced(value):
        return None
    numbers = np.asarray(value)
    if not any(jnp.issubdtype(numbers.dtype, kind) for kind in (bool, jnp.integer, jnp.floating)):
        raise ValueError(f"Argument `{name}` must be made of real numbers, but is {value!r}.")
    return numbers


def _check_each(
    name: str, value: ArrayLike, good: np.ndarray | np.bool, demand: str, remedy: str
) -> None:
    if np.all(good):
        return
    numbers = np.asarray(value)
    if numbers.ndim == 0:
        found = f"is {numbers}"
    else:
        first = tuple(int(i) for i in np.argwhere(~good)[0])
        found = f"is {numbers[first]} at index {first}"
    end = f": {remedy}" if remedy else "."
    raise ValueError(f"Argument `{name}` must be {demand}, but {found}{end}")


def check_finite(name: str, value: ArrayLike, remedy: str = "") -> None:
    """Raises `ValueError` if a concrete `value` holds NaN or infinity."""
    if (numbers := _concrete(name, value)) is not None:
        _check_each(name, value, np.isfinite(numbers), "finite", remedy)


def check_positive(name: str, value: ArrayLike, remedy: str = "") -> None:
    """Raises `ValueError` if a concrete `value` is anywhere zero, negative or not finite.

    >>> check_positive("width", 0.01, "choose 1e-3, say.")
    >>> check_positive("width", -0.1, "choose 1e-3, say.")
    Traceback (most recent call last):
        ...
    ValueError: Argument `width` must be positive and finite, but is -0.1: choose 1e-3, say.
    """
    if (numbers := _concrete(name, value)) is not None:
        good = np.isfinite(numbers) & (numbers > 0)
        _check_each(name, value, good, "positive and finite", remedy)


def check_nonnegative(name: str, value: ArrayLike, remedy: str = "") -> None:
    """Raises `ValueError` if a concrete `value` is anywhere negative or not finite."""
    if (numbers := _concrete(name, value)) is not None:
        good = np.isfinite(numbers) & (numbers >= 0)
        _check_each(name, value, good, "zero or positive, and finite", remedy)


def check_at_least(
    name: str, value: ArrayLike, floor_name: str, floor: ArrayLike, remedy: str = ""
) -> None:
    """Raises `ValueError` if a concrete `value` is anywhere below a concrete `floor`."""
    numbers, bounds = _concrete(name, value), _concrete(floor_name, floor)
    if numbers is None or bounds is None:
        return
    numbers, bounds = np.broadcast_arrays(numbers, bounds)
    _check_each(name, numbers, numbers >= bounds, f"at least `{floor_name}` = {floor}", remedy)


def check_per_mass(**arguments: ArrayLike) -> None:
    """Raises `ValueError` unless each argument is one number or one per mass, all of one length.

    >>> check_per_mass(mu_static=1.0, v_ref=jnp.array([0.5, 0.6]))
    >>> check_per_mass(mu_static=jnp.ones(3), v_ref=jnp.ones(2))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    ValueError: Arguments given per mass must agree in length, but `mu_static` has shape (3,)...
    """
    shapes = {name: jnp.shape(value) for name, value in arguments.items() if jnp.ndim(value) > 0}
    for name, shape in shapes.items():
        if len(shape) != 1:
            raise ValueError(
                f"Argument `{name}` must be one number or one per mass, of shape (n,), but has "
                f"shape {shape}: use `jax.vmap` to run many chains at once."
            )
    if len(set(shapes.values())) > 1:
        listed = " and ".join(f"`{name}` has shape {shape}" for name, shape in shapes.items())
        raise ValueError(f"Arguments given per mass must agree in length, but {listed}.")


def is_traced(*values: object) -> bool:
    """Whether any of the values, or any leaf of them, is being traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def check_whole(
    name: str,
    value: Any,
    low: int = 1,
    high: int | None = None,
    remedy: str = "",
    or_: str = "",
) -> int:
    """`value` as an integer, or raises `ValueError` unless it is one within low ... high.

    >>> check_whole("n", 3)
    3
    >>> check_whole("mass", 3, 0, 2)
    Traceback (most recent call last):
        ...
    ValueError: Argument `mass` must be an integer in 0 ... 2, but is 3.
    """
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < low or (high is not None and value > high):
        where = f"of at least {low}" if high is None else f"in {low} ... {high}"
        end = f": {remedy}" if remedy else "."
        raise ValueError(
            f"Argument `{name}` must be {or_}an integer {where}, but is {value!r}{end}"
        )
    return int(value)


def check_count(name: str, value: object) -> None:
    """Raises `ValueError` unless `value` is None (no limit) or an integer of at least 1."""
    if value is not None:
        check_whole(name, value, or_="None or ")


def check_one_of(name: str, value: object, choices: Sequence[str]) -> None:
    """Raises `ValueError` unless `value` is one of the words."""
    if value not in choices:
        words = [f'"{word}"' for word in choices]
        listed = f"{', '.join(words[:-1])} or {words[-1]}"
        raise ValueError(f"Argument `{name}` must be {listed}, but is {value!r}.")


def check_number(name: str, value: object, remedy: str = "") -> None:
    """Raises `ValueError` unless `value` is one real number, finite if it is concrete."""
    numbers = _concrete(name, value)
    shape = jnp.shape(value) if numbers is None else numbers.shape  # pyright: ignore
    if shape != ():
        raise ValueError(
            f"Argument `{name}` must be one number, but has shape {shape}: use `jax.vmap` for "
            "several runs."
        )
    if numbers is not None:
        _check_each(name, numbers, np.isfinite(numbers), "finite", remedy)


def check_positive_number(name: str, value: Any, remedy: str = "") -> None:
    """Raises `ValueError` unless `value` is one number, positive and finite if it is concrete."""
    check_number(name, value, remedy)
    check_positive(name, value, remedy)


def check_share(name: str, value: Any, remedy: str = "") -> None:
    """Raises `ValueError` unless `value` is one number, between 0 and 1 if it is concrete."""
    check_number(name, value, remedy)
    if (numbers := _concrete(name, value)) is not None:
        _check_each(name, value, (numbers > 0) & (numbers < 1), "between 0 and 1", remedy)


def check_span(t0: ArrayLike, t1: ArrayLike) -> None:
    """Raises `ValueError` unless concrete times t0 <= t1 are finite."""
    check_number("t0", t0, "it is a dimensionless time.")
    check_number("t1", t1, "it is a dimensionless time.")
    if not is_traced(t0, t1) and float(np.asarray(t1)) < float(np.asarray(t0)):
        raise ValueError(
            f"Argument `t1` = {t1} lies before `t0` = {t0}: dry friction cannot be integrated "
            "backward in time. Exchange them."
        )


def check_tolerances(rtol: ArrayLike, atol: ArrayLike | None, max_step: ArrayLike) -> None:
    """Raises `ValueError` unless what is given of the step-size control can control a step."""
    check_positive_number("rtol", rtol, "1e-6 is usual.")
    check_positive_number("max_step", max_step, "0.5 is usual, where a period is about 2 pi.")
    if (numbers := _concrete("rtol", rtol)) is not None:
        sensible = (numbers >= LEAST_RTOL) & (numbers < 1)
        remedy = "64-bit floats hold 16 digits; 1e-6 is usual."
        _check_each("rtol", rtol, sensible, f"at least {LEAST_RTOL:g} and below 1", remedy)
    if atol is not None:
        check_positive_number("atol", atol, "a tenth of `rtol` is usual.")
        if (numbers := _concrete("atol", atol)) is not None:
            remedy = "a tenth of `rtol` is usual."
            _check_each("atol", atol, numbers >= LEAST_ATOL, f"at least {LEAST_ATOL:g}", remedy)
