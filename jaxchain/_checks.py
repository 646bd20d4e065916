"""Conversion and checks of input: errors that name the argument, its value and a remedy.

The checks look at concrete numbers only. A traced value passes silently, so that a law or a chain
can be built under `jit`, `vmap` and `grad`; shapes are known even there and are always checked.
"""

import functools
import inspect
from collections.abc import Callable, Collection, Iterable, Sequence
from types import CellType, FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ._limits import LEAST_POSITIVE, MOST_COUNT
from ._spelling import did_you_mean
from ._types import ArrayLike, Given

# Characters of a value that an error shows.
_LONGEST = 60


def shown(value: object) -> str:
    """The text for a value in an error: the value itself if it is short, otherwise its kind.

    >>> shown(2.5), shown([1, "a"]), shown(int), shown(np.ones(3))
    ('2.5', "[1, 'a']", 'the class `int`', 'an array of shape (3,)')
    """
    if isinstance(value, type):
        return f"the class `{value.__name__}`"
    if inspect.isfunction(value):
        return f"the function `{value.__name__}{inspect.signature(value)}`"[:_LONGEST]
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        plain = np.ndim(value) == 0 and not is_traced(value)
        of = "" if _is_real(value) else f" of {value.dtype}"
        return str(value) if plain else f"an array of shape {np.shape(value)}{of}"
    kind = f"a {type(value).__name__}"
    if isinstance(value, eqx.Module):
        return kind
    try:
        text = repr(value)
    except Exception:  # an integer of 5000 digits, or a foreign object whose repr fails
        return kind
    fits = len(text) <= _LONGEST and "\n" not in text and " at 0x" not in text
    return text if fits else kind


def _is_real(value: object) -> bool:
    """Whether it is a real number, traced or not, or an array or nested list of real numbers."""
    if isinstance(value, bool | int | float):
        return True
    if isinstance(value, list | tuple):
        return all(map(_is_real, value))
    if isinstance(value, type):
        return False
    dtype: Any = getattr(value, "dtype", None)
    if dtype is None:
        dtype = np.asarray(value).dtype
    return any(jnp.issubdtype(dtype, kind) for kind in (bool, jnp.integer, jnp.floating))


def _not_real(name: str, value: object, remedy: str) -> ValueError:
    who = f"Argument `{name}`" if name else "What is given here"
    text = f"{who} must be made of real numbers, but is {shown(value)}"
    return ValueError(f"{text}{_end(remedy)}")


def _end(remedy: str) -> str:
    return f": {remedy}" if remedy else "."


def to_float(value: Any, name: str = "", remedy: str = "") -> Float[Array, "..."]:
    """`value` as a floating-point JAX array: the converter of every numeric field.

    Integers become floats, because only floats have tangents; and the result is never weakly
    typed, because a weakly typed leaf would compile everything once more.

    **Raises:** `ValueError` for anything but real numbers; a complex number would lose its
    imaginary part.
    """
    if isinstance(value, jax.Array) and value.dtype == float and not value.weak_type:
        return value
    try:
        if _is_real(value):
            # Converting a JAX array compiles a program; converting a NumPy array does not.
            if isinstance(value, int | float | np.ndarray | np.generic):
                return jnp.asarray(np.asarray(value, dtype=float))
            return jnp.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):  # rows of unequal length, 10**400
        pass
    raise _not_real(name, value, remedy)


def named(name: str, remedy: str = "") -> Callable[[Given[ArrayLike]], Float[Array, "..."]]:
    """`to_float` as the converter of a field; its errors give the name of the field."""
    return functools.partial(to_float, name=name, remedy=remedy)


def optional(name: str) -> Callable[[Given[ArrayLike | None]], Float[Array, "..."] | None]:
    """`named` for a field that may be None."""

    def convert(value: Given[ArrayLike | None]) -> Float[Array, "..."] | None:
        return None if value is None else to_float(value, name)

    return convert


def as_array(
    name: str, value: Any, least: int, most: int | None = None, remedy: str = ""
) -> Float[Array, "..."]:
    """`value` as floats of at least `least` and at most `most` dimensions, none of them empty."""
    array = to_float(value, name, remedy)
    if array.ndim < least or array.ndim > (array.ndim if most is None else most) or not array.size:
        axes = ["..."] * (most is None) + ["m", "n"][2 - least :]
        shape = f"({', '.join(axes)}{',' * (len(axes) == 1)})"
        raise ValueError(
            f"Argument `{name}` must have a shape like {shape} and not be empty, but has shape "
            f"{array.shape}{_end(remedy)}"
        )
    return array


def require_x64() -> None:
    """Raises `RuntimeError` unless JAX computes with 64-bit floats."""
    if jnp.result_type(float) != jnp.float64:
        raise RuntimeError(
            "jaxchain needs 64-bit floats, but JAX computes with 32 bits here: call "
            "`jaxchain.configure()` at the start of the program, or set the environment variable "
            "JAX_ENABLE_X64=1."
        )


def require_64_bits(name: str, tree: object) -> None:
    """Raises `ValueError` if a floating-point array in `tree` has fewer than 64 bits.

    Such numbers were made before 64-bit floats were switched on: there 0.05 is 0.0500000007.
    """
    for leaf in jax.tree.leaves(tree):
        dtype = getattr(leaf, "dtype", None)
        if dtype is not None and jnp.issubdtype(dtype, jnp.floating) and dtype.itemsize < 8:
            raise ValueError(
                f"Argument `{name}` holds {dtype} numbers: it was made before JAX was set to use "
                "64-bit floats, or from an array of 32 bits. Make it again from 64-bit numbers."
            )


def numbers_of(name: str, value: object, remedy: str = "") -> np.ndarray | None:
    """`value` as real numbers, or None if it is traced."""
    if is_traced(value):
        return None
    try:
        if _is_real(value):
            return np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise _not_real(name, value, remedy)


def _check_each(
    name: str, value: Any, good: np.ndarray | np.bool, demand: str, remedy: str
) -> None:
    if np.all(good):
        return
    numbers = np.asarray(value)
    if numbers.ndim == 0:
        shown_value = f"is {numbers}"
    else:
        first = tuple(int(i) for i in np.argwhere(~good)[0])
        shown_value = f"is {numbers[first]} at index {first}"
    raise ValueError(f"Argument `{name}` must be {demand}, but {shown_value}{_end(remedy)}")


def check_finite(name: str, value: Any, remedy: str = "") -> None:
    """Raises `ValueError` if a concrete `value` holds NaN or infinity."""
    if (numbers := numbers_of(name, value, remedy)) is not None:
        _check_each(name, value, np.isfinite(numbers), "finite", remedy)


def check_positive(name: str, value: Any, remedy: str = "") -> None:
    """Raises `ValueError` if any entry of a concrete `value` is zero, negative or not finite.

    >>> check_positive("width", 0.01, "choose 1e-3, say.")
    >>> check_positive("width", -0.1, "choose 1e-3, say.")
    Traceback (most recent call last):
        ...
    ValueError: Argument `width` must be positive and finite, but is -0.1: choose 1e-3, say.
    """
    if (numbers := numbers_of(name, value, remedy)) is not None:
        good = np.isfinite(numbers) & (numbers > 0)
        _check_each(name, value, good, "positive and finite", remedy)
        # The reciprocal of a smaller one is infinite.
        _check_each(name, value, numbers >= LEAST_POSITIVE, f"at least {LEAST_POSITIVE:g}", remedy)


def check_nonnegative(name: str, value: Any, remedy: str = "") -> None:
    """Raises `ValueError` if any entry of a concrete `value` is negative or not finite."""
    if (numbers := numbers_of(name, value, remedy)) is not None:
        good = np.isfinite(numbers) & (numbers >= 0)
        _check_each(name, value, good, "zero or positive, and finite", remedy)


def check_at_least(
    name: str, value: ArrayLike, floor_name: str, floor: ArrayLike, remedy: str = ""
) -> None:
    """Raises `ValueError` if any entry of a concrete `value` is below a concrete `floor`."""
    numbers, bounds = numbers_of(name, value), numbers_of(floor_name, floor)
    if numbers is None or bounds is None:
        return
    numbers, bounds = np.broadcast_arrays(numbers, bounds)
    _check_each(name, numbers, numbers >= bounds, f"at least `{floor_name}` = {floor}", remedy)


def check_per_mass(**arguments: Any) -> None:
    """Raises `ValueError` unless each argument is one number or one per mass, with equal lengths.

    >>> check_per_mass(mu_static=1.0, v_ref=jnp.array([0.5, 0.6]))
    >>> check_per_mass(mu_static=jnp.ones(3), v_ref=jnp.ones(2))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    ValueError: Arguments given per mass must agree in length, but `mu_static` has shape (3,)...
    """
    shapes = {name: jnp.shape(value) for name, value in arguments.items() if jnp.ndim(value) > 0}
    for name, shape in shapes.items():
        if len(shape) != 1 or shape[0] == 0:
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


def closed_over(function: FunctionType) -> list[Any]:
    """What a function has in its closure."""
    return [cell.cell_contents for cell in function.__closure__ or () if cell != CellType()]


def require_signature(cls: type, **methods: str) -> None:
    """Raises `TypeError` if `cls` defines a method that cannot be called with these arguments."""
    for name, arguments in methods.items():
        method = vars(cls).get(name)
        if not inspect.isfunction(method):
            continue
        try:
            inspect.signature(method).bind(*f"self, {arguments}".split(", "))
        except TypeError:
            raise TypeError(
                f"Class `{cls.__name__}` defines `{name}{inspect.signature(method)}`, but it is "
                f"called with ({arguments}): write `def {name}(self, {arguments})`."
            ) from None
        if is_traced(closed_over(method)):
            raise TypeError(
                f"Class `{cls.__name__}` defines `{name}` with a number that JAX traces in its "
                "closure, in which searches would find no derivative: make it a field."
            )


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
    if high is None and whole and value > MOST_COUNT:
        high = MOST_COUNT
    if not whole or value < low or (high is not None and value > high):
        where = f"of at least {low}" if high is None else f"in {low} ... {high}"
        raise ValueError(
            f"Argument `{name}` must be {or_}an integer {where}, but is "
            f"{shown(value)}{_end(remedy)}"
        )
    return int(value)


def check_count(name: str, value: object, most: int | None = None, remedy: str = "") -> None:
    """Raises `ValueError` unless `value` is None (no limit) or an integer of at least 1."""
    if value is not None:
        check_whole(name, value, 1, most, remedy, or_="None or ")


def check_one_of(name: str, value: object, choices: Sequence[str]) -> None:
    """Raises `ValueError` unless `value` is one of the words."""
    if not isinstance(value, str) or value not in choices:
        words = [f'"{word}"' for word in choices]
        listed = f"{', '.join(words[:-1])} or {words[-1]}"
        near = did_you_mean(value, choices)
        raise ValueError(f"Argument `{name}` must be {listed}, but is {shown(value)}{near}.")


def check_known(of: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raises `ValueError` if a name is not known to `of`, with the nearest of those that are.

    >>> check_known("`Chain.with_`", ["widht"], ["n", "width"])  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    ValueError: `Chain.with_` does not know ['widht'] (did you mean `width`?); it takes ...
    """
    if unknown := [name for name in names if name not in known]:
        raise ValueError(
            f"{of} does not know {unknown}{did_you_mean(unknown[0], known)}; it takes "
            f"{sorted(known)}."
        )


def check_flag(name: str, value: object) -> None:
    """Raises `ValueError` unless `value` is True or False."""
    if not isinstance(value, bool | np.bool):
        raise ValueError(f"Argument `{name}` must be True or False, but is {shown(value)}.")


def check_kind(name: str, value: object, kind: Any, wanted: str, remedy: str = "") -> None:
    """Raises `ValueError` unless `value` is a `kind`, which the error calls `wanted`."""
    if not isinstance(value, kind):
        raise ValueError(
            f"Argument `{name}` must be {wanted}, but is {shown(value)}{_end(remedy)}"
        )


def check_concrete(instead: str, **arguments: Any) -> None:
    """Raises `ValueError` if any value is traced, for a function that runs on the host."""
    for name, value in arguments.items():
        if is_traced(value):
            raise ValueError(
                f"Argument `{name}` is traced, but this runs on the host, not in a compiled "
                f"program: call it outside `jit`, `vmap` and `grad`, or {instead}"
            )


def check_function(name: str, value: Any, wanted: str, takes: int) -> None:
    """Raises `ValueError` unless `value` takes `takes` arguments, as `wanted` says."""
    try:
        good = callable(value)
        if good:
            inspect.signature(value).bind_partial(*[None] * takes)
    except TypeError:
        good = False
    except ValueError:  # the signature of a compiled function may be unknown
        good = True
    if not good:
        raise ValueError(f"Argument `{name}` must be a function, {wanted}, but is {shown(value)}.")


def check_pair(name: str, value: Any, remedy: str) -> tuple[float, float]:
    """(low, high) with low < high, possibly infinite, or raises `ValueError`."""
    pair = np.shape(value) == (2,) and _is_real(value)
    if not pair or not value[0] < value[1]:
        raise ValueError(
            f"Argument `{name}` must be (low, high) with low < high, but is "
            f"{shown(value)}: {remedy}"
        )
    return float(value[0]), float(value[1])


def check_number(name: str, value: object, remedy: str = "") -> None:
    """Raises `ValueError` unless `value` is one real number, finite if it is concrete."""
    numbers = numbers_of(name, value, remedy)
    shape = jnp.shape(value) if numbers is None else numbers.shape  # pyright: ignore[reportArgumentType]
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
    if (numbers := numbers_of(name, value, remedy)) is not None:
        _check_each(name, value, (numbers > 0) & (numbers < 1), "between 0 and 1", remedy)
