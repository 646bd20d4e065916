"""What decides the numbers of a sweep, but for its grid: by it a store knows whose it is.

Numbers, words and digests, by names that say in an error what has changed.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..model.provenance import versions
from ..observers.base import Step
from .axes import Axes, columns_of
from .ensemble import Ensemble
from .starts import first as first_of
from .starts import start_of

# Of this package: all that a lane does and sees, and what its results are called.
_CODE = (
    "model", "observers", "solvers", "simulation", "sweeps/lanes.py", "sweeps/starts.py",
    "result.py",
)  # fmt: skip
_OUR_MODULES = ("jaxchain.", "diffrax.")
DEVICES = "xla_force_host_platform_device_count"
# A number is shown in an error, an array up to this size too.
_SHOWN = 4


def fingerprint_of(ensemble: Ensemble, lanes: int) -> dict[str, Any]:
    """All that decides what comes out of a lane, as JSON: a tree of names."""
    task, starts, axes = ensemble.task, ensemble.starts, ensemble.axes
    chain, plan = starts.chain, task.plan
    swept = columns_of(axes)
    numbers = {**chain.numbers(), "n": chain.n, "ends": chain.ends}
    solver = eqx.tree_at(lambda p: p.observers, plan, None, is_leaf=lambda a: a is None)
    first = ensemble.jobs(ensemble.first_job())
    return {
        "chain": {k: _value(v) for k, v in numbers.items() if k not in swept and v is not None},
        "friction": {
            "law": _kind(type(chain.friction)),
            "curve": _digest(
                _program(_force, chain.friction, jnp.zeros(())).encode(),
                # A table, say: arrays are data of the program.
                *(
                    digest(leaf).encode()
                    for leaf in _arrays(chain.friction)
                    if all(leaf is not number for number in numbers.values())
                ),
            ),
        },
        "solver": _described(solver),
        "observers": {
            # The program says more than the source: what it takes from elsewhere, too.
            str(i): {**_described(o), "code": _program(_seen, o, chain, task.t0, task.t1)}
            for i, o in enumerate(plan.observers, start=1)
        },
        "t0": float(task.t0),
        "t1": float(task.t1),
        "max_steps": None if task.max_steps is None else int(task.max_steps),
        "segments": task.segments,
        "accuracy": ensemble.accuracy,
        "initial and vary": _digest(
            _program(start_of, starts, first_of(first)).encode(),
            _words(task.varied).encode(),
            *(digest(leaf).encode() for leaf in _arrays((starts.initial, starts.vary))),
        ),
        "lanes": lanes,
        "dimensions": list(axes),
        "over": {dim: sorted(columns) for dim, columns in axes.items()},
        "versions": {k: v for k, v in versions().items() if k != "python"},
        "code of jaxchain": code(),
        "XLA_FLAGS": flags(),
    }


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What is not the same, in words."""
    old, new = dict(_flat(before)), dict(_flat(now))
    said = []
    for name in [*old, *(name for name in new if name not in old)]:
        was, now_is = old.get(name), new.get(name)
        if json.dumps(was) == json.dumps(now_is):  # NaN is not NaN
            continue
        digests = isinstance(was, str) and was.startswith("sha256")
        said.append(
            f"{name} has changed" if digests else f"{name} was {_word(was)} and is {_word(now_is)}"
        )
    return said


def digest(values: Any) -> str:
    """Of an array: its values, shape and kind."""
    array = np.ascontiguousarray(values)
    about = f"{array.dtype.str}{array.shape}".encode()
    return f"sha256 {hashlib.sha256(about + array.tobytes()).hexdigest()[:32]}"


def columns(axes: Axes) -> dict[str, dict[str, str]]:
    """The digest of all that is swept, by dimension and name."""
    return {
        dim: {name: digest(values) for name, values in own.items()} for dim, own in axes.items()
    }


def flags() -> str:
    """The options of XLA, which may change the last bits, but for the number of devices."""
    words = os.environ.get("XLA_FLAGS", "").split()
    return " ".join(sorted(word for word in words if DEVICES not in word))


@functools.cache
def code() -> str:
    """Of the source of this package, as far as it decides numbers."""
    root = Path(__file__).parents[1]
    files = [f for part in _CODE for f in sorted((root / part).rglob("*.py")) or [root / part]]
    return _digest(*(file.read_bytes() for file in files))


def _digest(*parts: bytes) -> str:
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "little") + part)
    return f"sha256 {found.hexdigest()[:32]}"


def _value(value: Any) -> Any:
    """A number, a few numbers, or the digest of many; words as they are."""
    if value is None or isinstance(value, str | bool | int | float):
        return value
    array = np.asarray(value)
    return array.tolist() if array.size <= _SHOWN else digest(array)


def _described(value: Any) -> Any:
    """A solver or an observer by the names of its fields, and its code if it is the user's own."""
    if isinstance(value, eqx.Module):
        kind = type(value)
        own = {} if _is_ours(kind) else {"code": _source(kind)}
        parts = {f.name: _described(getattr(value, f.name)) for f in fields(value)}
        return {"kind": _kind(kind), **own, **parts}
    if isinstance(value, list | tuple):
        return {str(i): _described(one) for i, one in enumerate(value, start=1)}
    if isinstance(value, Mapping):
        return {str(name): _described(one) for name, one in value.items()}
    if value is None or isinstance(value, str) or eqx.is_array_like(value):
        return _value(value)
    return _words(value)


def _words(value: Any) -> str:
    """Without the addresses of functions, which are others in each process."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def _arrays(tree: Any) -> list[Any]:
    return [leaf for leaf in jtu.tree_leaves(tree) if eqx.is_array(leaf)]


def _is_ours(kind: type) -> bool:
    return kind.__module__.startswith(_OUR_MODULES)


def _kind(kind: type) -> str:
    return kind.__qualname__ if _is_ours(kind) else f"{kind.__module__}.{kind.__qualname__}"


def _source(kind: type) -> str:
    """Of a class of the user's own and its bases; empty where it cannot be read."""
    texts = []
    for base in kind.__mro__:
        if not _is_ours(base) and base.__module__ not in ("builtins", "abc"):
            try:
                texts.append(inspect.getsource(base))
            except (OSError, TypeError):
                continue
    return _digest(*(text.encode() for text in texts))


def _force(friction: Any, speed: Any) -> Any:
    return friction.force_and_slope(speed), friction.law.mu_static


def _seen(observer: Any, chain: Any, t0: Any, t1: Any) -> Any:
    """All that an observer makes of one step."""
    start = jnp.ones(chain.n), jnp.ones(chain.n)
    x, v = (lambda theta, part=part: part + 0.0 * theta for part in start)
    kept = observer.init(chain, t0, t1, start)
    kept = observer.update(kept, Step(chain, t0, t1, start, start, x, v))
    said = observer.label(observer.read(kept), chain)
    return observer.settled(kept), observer.rests(kept), dict(said)


def _program(function: Callable, tree: Any, *arguments: Any) -> str:
    """Of what a function of the user computes, as JAX sees it: the text of its program.

    So a comment or another name changes nothing, and a number that a function has from elsewhere
    does.
    """
    arrays, static = eqx.partition(tree, eqx.is_array)

    def traced(arrays: Any, *arguments: Any) -> Any:
        return function(eqx.combine(arrays, static), *arguments)

    lowered = jax.jit(traced).trace(arrays, *arguments).lower(lowering_platforms=("cpu",))
    return _digest(lowered.as_text().encode())


def _flat(tree: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _word(value: Any) -> str:
    return "absent" if value is None else f"{value}"
