"""The rows of the table of bad calls, and the requirements on every refusal."""

from __future__ import annotations

import importlib
import inspect
import math
import re
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import optax

import jaxchain
from jaxchain import Chain, EventDriven, Rodas4, paper_chain, simulate

LONGEST_MESSAGE = 600
# Seconds.  A refusal takes milliseconds; what is not refused may compile and run for minutes.
MOST_TIME = 60

# Of a message that says what would be good.
HELPS = (
    r"must |needs? |have shape|is usual|[gG]ive |[lL]eave |[tT]ake |[uU]se |[cC]all |Exchange"
    "|allowed|lower|masses"
)

# What each kind of argument cannot be.
WRONG = (None, "x", {})
NUMBER = (*WRONG, [1.0, 2.0], math.nan, math.inf, 1j)
POSITIVE = (*NUMBER, -1.0, 0.0, 5e-324)
NONNEGATIVE = (*NUMBER, -1.0)
COUNT = (*WRONG, "3", 2.5, [1], math.nan, 0, -1, True, 10**30)
# Where 0 counts, too.
COUNT_0 = tuple(value for value in COUNT if value is True or value != 0)
SHARE = (*NUMBER, 0.0, 1.0, -1.0)
WORD = (None, 3, "nonsense", ["a"], {})
FLAG = (None, "no", 2)
A_CHAIN = (None, "x", Chain, {}, 3.0, [paper_chain(3)])
FUNCTION = (None, 3, "x", lambda: None)
TREE = (None, "x", [], {}, {"a": "b"}, math.nan, [1.0, math.nan], 1j)
ARRAY = (None, "x", {}, object, 3.0, [], [1j])
SOLVERS = (
    "Rodas4", 3, {}, Rodas4, EventDriven, dfx.Tsit5, dfx.Euler(), dfx.KenCarp4(), math.nan,
)  # fmt: skip
MASSES = ("x", {}, 3, (), (0, 0), (-1,), (1.5,), (True,), (None,))
# What most arguments with these names cannot be; a row says what others cannot, and () for none.
_NAMED: dict[str, Sequence[Any]] = {
    name: values
    for names, values in (
        ("chain model field", A_CHAIN),
        ("throw keep_part error_bars", FLAG),
        ("parameter ends block distribution pattern reading quantity", WORD),
        ("lanes steps starts n capacity frames windows rounds repeats workers points halvings",
         COUNT),
        ("component oscillator middle tries", COUNT_0),
        ("max_steps max_points", COUNT[1:]),  # None is no bound
        ("tolerance step min_step max_step max_turn max_bend window radius reach crossing near "
         "quiet_below threshold stands moves longest frames_per_second above agree interval",
         POSITIVE),
        ("transient landing", NONNEGATIVE),
        ("t0 t1 belt_speed damping_ratio centre position", NUMBER),
        ("residual function before change", FUNCTION),
        ("masses", MASSES),
    )
    for name in names.split()
}  # fmt: skip
USUAL = {
    **_NAMED,
    "rtol": (*POSITIVE, 2.0, 1e-300),
    "atol": (*POSITIVE, 1e-300),
    "mass": (*COUNT_0, 3),
    "solver": SOLVERS,
    "optimiser": ("x", 3, {}, optax.adam),
    "direction": (None, "x", 0, 2, [1.0, 2.0, 3.0], math.nan, {}),
    "bounds": ("x", 3, (1,), (2, 1), (math.nan, 1), ("a", "b"), {}, (3.0, 4.0)),
    "images": ("x", 3, {}, (0,), (1, 0, 2), (math.nan, 1, 2), ("a", 1, 2)),
    "description": (3, None),
    "ax": ("x", 3, []),
    "scales": ("x", 3),
    "seed": (None, "x", {}, 1.5, math.nan, [1, 2]),
}  # fmt: skip


def states(n: int) -> tuple[Any, ...]:
    """Values that are not a state of n masses."""
    x, nan = jnp.ones(n), jnp.full(n, math.nan)
    return (
        None, "x", 3.0, [], {"x": x}, simulate, (x,), (x, "v"), (x, nan), (x, jnp.ones(n + 1)),
        (jnp.ones((2, n)), jnp.ones((2, n))), ({}, {}), (x + 1j, x),
    )  # fmt: skip


class Told(NamedTuple):
    """A value that the message describes by this text."""

    value: Any
    instead: str


def public() -> dict[str, Any]:
    """The names of the top level and of all submodules but `scenes`, whose input are files."""
    submodules = set(jaxchain.SUBMODULES) - {"scenes"}
    modules = [jaxchain, *(importlib.import_module(f"jaxchain.{name}") for name in submodules)]
    names = {(name, module) for module in modules for name in module.__all__}
    return {name: getattr(module, name) for name, module in names}


class Row(NamedTuple):
    """A public name, and calls of it with one argument replaced by each of some values."""

    name: str
    call: Callable[..., object]
    good: Mapping[str, Any]
    bad: Mapping[str, Sequence[Any]]

    def faults(self) -> Iterator[str]:
        for argument, values in self.bad.items():
            for value in values:
                if fault := self._fault(argument, value):
                    shown = repr(value).replace("\n", " ")[:60]
                    yield f"{self.name}({argument}={shown}): {fault}"

    def _fault(self, argument: str, value: Any) -> str:
        plain = value.value if isinstance(value, Told) else value
        signal.alarm(MOST_TIME)
        try:
            self.call(**{**self.good, argument: plain})
        except (ValueError, TypeError) as error:
            message = str(error)
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        else:
            return "was taken without a word"
        finally:
            signal.alarm(0)
        wrong = {
            "does not name the argument": not re.search(rf"rguments? .*`{argument}\b", message),
            "does not say what was given": not _is_shown(value, message),
            "does not say what helps": not re.search(HELPS, message),
            "is too long": len(message) > LONGEST_MESSAGE or "\n" in message,
        }
        found = [fault for fault, so in wrong.items() if so]
        return f"{' and '.join(found)}: {message}" if found else ""


def row(name: str, good: Mapping[str, Any], call: Any = None, /, **bad: Sequence[Any]) -> Row:
    """The row of a public name, or of what begins with one and `call` is; usual arguments too."""
    call = call or public()[name.partition(",")[0]]
    for argument, parameter in inspect.signature(call).parameters.items():
        words = str(parameter.annotation)
        usual = FLAG if words in ("bool", str(bool)) else WORD if "Literal[" in words else ()
        bad.setdefault(argument, USUAL.get(argument, usual))
        if argument in bad and parameter.default is None:
            bad[argument] = [value for value in bad[argument] if value is not None]
    return Row(name, call, good, bad)


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


def too_slow(*_: Any) -> None:
    """The handler of the alarm."""
    raise TimeoutError(f"was not refused within {MOST_TIME} seconds")
