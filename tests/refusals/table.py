"""The rows of the table of bad calls, and the requirements on every refusal."""

from __future__ import annotations

import math
import re
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxchain import Chain, paper_chain, simulate

LONGEST_MESSAGE = 600
# Seconds.  A refusal takes milliseconds; what is not refused may compile and run for minutes.
MOST_TIME = 5

# Of a message that says what would be good.
HELPS = (
    r"must |needs? |have shape|is usual|[gG]ive |[lL]eave |[tT]ake |[uU]se |[cC]all |Exchange"
    "|allowed|lower|masses"
)

# What each kind of argument cannot be.
WRONG = (None, "x", {}, object)
NUMBER = (*WRONG, [1.0, 2.0], (), math.nan, math.inf, 1j)
POSITIVE = (*NUMBER, -1.0, 0.0, 5e-324)
NONNEGATIVE = (*NUMBER, -1.0)
COUNT = (*WRONG, "3", 2.5, [1], math.nan, 0, -1, True, 10**30)
INDEX = (*(value for value in COUNT if value is not True and value != 0), True)
WORD = (None, 3, "nonsense", ["a"], {})
FLAG = (None, "no", 2)
A_CHAIN = (None, "x", Chain, {}, 3.0, [paper_chain(3)])
FUNCTION = (None, 3, "x", lambda: None)
SOLVER = ("Rodas4", 3, {})
TREE = (None, "x", [], {}, {"a": "b"}, math.nan, [1.0, math.nan], 1j)


def optional(values: Sequence[Any]) -> tuple[Any, ...]:
    """The same without None."""
    return tuple(value for value in values if value is not None)


def states(n: int) -> tuple[Any, ...]:
    """Values that are not a state of n masses."""
    x, nan = jnp.ones(n), jnp.full(n, math.nan)
    return (
        None, "x", 3.0, [], {"x": x}, simulate, (x,), (x, "v"), (x, nan), (nan, x),
        (x, jnp.ones(n + 1)), (jnp.ones((2, n)), jnp.ones((2, n))), ({}, {}), (None, None),
        (x + 1j, x),
    )  # fmt: skip


class Told(NamedTuple):
    """A value that the message describes by this text."""

    value: Any
    instead: str


class Row(NamedTuple):
    """A public name, and calls of it with one argument replaced by each of some values.

    `name` is that of the module, or begins with it; `says` must be matched by every message.
    """

    name: str
    call: Callable[..., object]
    good: Mapping[str, Any]
    bad: Mapping[str, Sequence[Any]]
    says: str = ""

    def faults(self) -> Iterator[str]:
        for argument, values in self.bad.items():
            for value in values:
                if fault := self._fault(argument, value):
                    yield f"{self.name}({argument}={_short(value)}): {fault}"

    def _fault(self, argument: str, value: Any) -> str:
        plain = value.value if isinstance(value, Told) else value
        begun = time.perf_counter()
        signal.alarm(MOST_TIME)
        try:
            self.call(**{**self.good, argument: plain})
        except Exception as error:
            message, kind = str(error), type(error)
        else:
            return "was taken without a word"
        finally:
            signal.alarm(0)
        if kind not in (ValueError, TypeError):
            return f"{kind.__name__}: {message}"
        if not re.search(rf"rguments? .*`{argument}\b", message):
            return f"does not name the argument: {message}"
        if not _is_shown(value, message):
            return f"does not say what was given: {message}"
        if not re.search(HELPS, message):
            return f"does not say what helps: {message}"
        if not re.search(self.says, message):
            return f"does not say {self.says}: {message}"
        if len(message) > LONGEST_MESSAGE or "\n" in message:
            return f"is too long: {message}"
        if time.perf_counter() - begun > MOST_TIME:
            return "took too long"
        return ""

    def attempts(self) -> int:
        return sum(map(len, self.bad.values()))


def _is_shown(value: Any, message: str) -> bool:
    """Whether a message shows a value, its kind or its shape, or those of a part of it."""
    if isinstance(value, Told):
        return bool(re.search(value.instead, message))
    if isinstance(value, type):
        return value.__name__ in message
    own = [repr(value), str(value), type(value).__name__]
    if _is_numbers(value):
        own += [f"has {np.shape(value)}", f"shape {np.shape(value)}", f"shapes {np.shape(value)}"]
        own += ["nan"] if np.any(np.isnan(value)) else []
    if any(text in message for text in own):
        return True
    if isinstance(value, Mapping):
        return any(_is_shown(part, message) for part in (*value, *value.values()))
    return isinstance(value, list | tuple) and any(_is_shown(part, message) for part in value)


def _is_numbers(value: Any) -> bool:
    """Whether it is an array, a number, or nested lists of numbers."""
    try:
        return np.asarray(value).dtype.kind in "ifc"
    except ValueError:  # lists of unequal lengths
        return False


def _short(value: Any) -> str:
    text = repr(value).replace("\n", " ")
    return text if len(text) < 60 else f"{text[:57]}..."


def too_slow(*_: Any) -> None:
    """The handler of the alarm."""
    raise TimeoutError(f"was not refused within {MOST_TIME} seconds")
