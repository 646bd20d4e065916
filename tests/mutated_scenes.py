"""Scene files with mistakes, made from those that come with jaxchain: the same ones for a seed.

A mutant is a built-in scene with one to three mistakes, in its tables, in its text, or in
assignments of `--set`.  `fault` loads it and says what is wrong with how it was taken.
"""

from __future__ import annotations

import copy
import json
import math
import random
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxchain.model.parameters import PARAMETERS
from jaxchain.scenes.building import build
from jaxchain.scenes.files import SceneError, builtin_scenes, read_scene
from jaxchain.scenes.scene import LoadedScene, load_scene

# What a refusal may take, and how long its text may be.
MOST_SECONDS, MOST_CHARACTERS = 2.0, 100_000
_LINE = 2000
_MANY = 100_001


class Raw(str):
    """A value as it stands in the file."""


NUMBERS = [
    math.nan, math.inf, -math.inf, -1, 0, 1, 2, 3, -1.0, 0.0, 0.5, 7.5, 1e300, -1e300, 5e-324,
    1e-12, 1e-6, 1e6, 1e12, 10**6, 10**9, 10**18, 2**63, 10**30, -(10**30), 10**400, 1e30, 1.5,
    10, 100, 1000,
]  # fmt: skip
TEXTS = [
    "", "x", " ", "a/b", "../../../esc", "/etc/passwd", ".", "..", "a\\b", "a\nb", "a\x1b[31mb",
    "a\x00b", "\u202e", "naïve", "ü" * 300, "x" * 100_000, "$\\frac$", "nan", "none", "CON",
]  # fmt: skip
NAMES = [*TEXTS, "amplitude", "belt_speed", "__x", "-x", "x.y", "time", "main", "n", "2"]
FILES = [".toml", "...toml", "a b.toml", "-.toml", "x", "ü.toml", "..toml", "a\nb.toml"]
SWEPT = [*PARAMETERS, "excited", "displacement", "velocity", "n"]
OTHERS = [
    True, False, [], {}, [[]], [{}], {"x": 1}, [1, 1], [0.5, 0.5], ["a", "a"], [math.nan],
    [1, "x"], [[1.0]], [True], [-1], [-1.5, 1.5], [1e300], [5e-324], [10**30], [0], [1], [2, 1],
    [math.inf], {"start": 1.0, "stop": 2.0, "step": 0.1}, {"start": 1, "stop": 2, "count": 10**9},
    {"start": 0, "stop": 1, "count": 3}, {"start": -1, "stop": 1, "count": 3},
    {"start": 0.0, "stop": 1e300, "step": 1e-300}, {"start": 1, "stop": 1, "count": 1},
    {"law": "coulomb", "width": 0.1, "mu_dynamic": 0.5}, {"law": "custom", "width": 1e-3},
    {"law": "tabulated", "width": 0.1, "speed": [0, 1], "mu": [1, 0.5]},
    {"kind": "excited", "excited": 1}, {"kind": "equation_10"}, {"observer": "StickTime"},
    [{"observer": "PeakTimes", "capacity": 10**9}], [{"observer": "Divergence"}] * 2,
    [{"observer": "Samples", "interval": 5e-324, "capacity": 3}],
    [{"observer": "FrontTrack", "windows": 10**6}], [{"observer": "Section", "oscillator": 1}],
    Raw("2020-01-01"), Raw("07:32:00"), Raw("0x" + "f" * 5000), Raw("9" * 5000), Raw("1_000"),
    Raw("[" * 5000 + "]" * 5000), Raw("{x=" * 3000 + "1" + "}" * 3000),
]  # fmt: skip
_LONG = [
    lambda rng: [rng.choice(["x", -1.0, math.nan])] * _MANY,
    lambda rng: [0.1 + i for i in range(_MANY)],
    lambda rng: [i % 7 for i in range(_MANY)],
    lambda rng: {f"k{i}": 1 for i in range(_MANY)},
]
CHARACTERS = ["\x00", "\x1b", "\x7f", "\r", "\t", '"', "]", "=", "\n", "\ufeff", "é", "{", "#"]


@dataclass
class Mutant:
    """A file to be, the assignments that go with it, and which mistakes are in it."""

    base: str
    name: str = "mutant.toml"
    text: bytes = b""
    overrides: list[str] = field(default_factory=list)
    mistakes: list[str] = field(default_factory=list)

    def load(self, folder: Path) -> LoadedScene:
        """Reads and checks it, as a file of `folder`."""
        file = folder / self.name
        file.write_bytes(self.text)
        return load_scene(str(file), self.overrides)


def mutants(seed: int, count: int, first: int = 0) -> Iterator[Mutant]:
    """These of the endless row of this seed, from the first-th on."""
    scenes = {name: read_scene(name)[1] for name in builtin_scenes()}
    for number in range(first, first + count):
        rng = random.Random(f"{seed}/{number}")
        base = rng.choice(list(scenes))
        mutant, data = Mutant(base), copy.deepcopy(scenes[base])
        kinds = rng.choices(
            ["table", "text", "set", "name"], [75, 8, 15, 2], k=rng.choice((1, 1, 1, 2, 3))
        )
        for _ in range(kinds.count("table")):
            mutant.mistakes.append(_change(data, rng))
        mutant.text = toml(data).encode("utf-8", "surrogatepass")
        for kind in kinds:
            if kind == "text":
                mutant.text = _damage(mutant, rng)
            elif kind == "set":
                mutant.overrides.append(_assignment(data, rng))
            elif kind == "name":
                mutant.name = rng.choice(FILES)
        yield mutant


def toml(data: dict[str, Any]) -> str:
    """The file that holds these tables."""
    return "".join(f"{_key(key)} = {_value(value)}\n" for key, value in data.items())


def _key(key: str) -> str:
    return (
        key if key.isascii() and key.replace("_", "a").replace("-", "a").isalnum() else _text(key)
    )


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _entries(data: Any, path: tuple = ()) -> Iterator[tuple[Any, Any, tuple]]:
    """Every key of every table and every entry of every list: (where, key, its path)."""
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        yield data, key, (*path, key)
        if isinstance(value, dict | list):
            yield from _entries(value, (*path, key))


def _wrong(rng: random.Random) -> Any:
    """Any value."""
    if rng.random() < 0.003:
        return rng.choice(_LONG)(rng)
    return copy.deepcopy(rng.choice(rng.choices([NUMBERS, TEXTS, OTHERS], [50, 15, 35])[0]))


def _misspelt(key: str, rng: random.Random) -> str:
    at = rng.randrange(len(key) + 1)
    longer, shorter = key[:at] + "x" + key[at:], key[:at] + key[at + 1 :]
    return rng.choice([shorter, key.upper(), longer, key.title(), rng.choice(NAMES)])


def _change(data: dict[str, Any], rng: random.Random) -> str:
    """One mistake in the tables.  Returns what it is."""
    entries = list(_entries(data))
    if not entries:
        return "nothing"
    tables = [p for p in entries if isinstance(p[0], dict)]
    where, key, path = rng.choice(tables if rng.random() < 0.7 and tables else entries)
    numbers = [p for p in entries if isinstance(p[0][p[1]], int | float)]
    kind = rng.choices(
        ["replace", "delete", "misspell", "twice", "list", "name", "wrap", "scale", "sweep"],
        [35, 8, 8, 4, 10, 6, 3, 25, 6],
    )[0]
    if kind == "name":
        named = [p for p in tables if p[2][0] == "experiment" and len(p[2]) == 2]
        where, key, path = rng.choice(named or tables)
        kind = "misspell"
    elif kind == "sweep":
        own = [p for p in tables if p[1] == "sweep" and isinstance(p[0][p[1]], dict)]
        where, name = (rng.choice(own)[0]["sweep"] if own else data), rng.choice(SWEPT)
        where[name] = rng.choice([[rng.choice(NUMBERS)], [rng.choice(NUMBERS), 1.0], _wrong(rng)])
        return f"sweep: {name} = {str(where[name])[:60]}"
    elif kind == "scale" and numbers:
        where, key, path = rng.choice(numbers)
    value, said = where[key], ".".join(map(str, path))[:100]
    if kind == "delete":
        del where[key]
    elif kind in ("misspell", "twice") and isinstance(where, dict):
        new = _misspelt(key, rng)
        own = copy.deepcopy(value) if kind == "twice" else where.pop(key)
        where[new] = own
        said += f" -> {new[:50]!r}"
    elif kind == "list" and isinstance(value, list):
        negative = [-v if isinstance(v, int | float) else v for v in value]
        more = [value * 2, value[::-1], [list(value)], value + value[:1]]
        value[:] = rng.choice([[], *more, negative])
    elif kind == "wrap":
        name = key if isinstance(key, str) else "x"
        where[key] = rng.choice([[value], {"x": value}, {name: value}])
    elif kind == "scale" and isinstance(value, int | float) and abs(value) < 1e100:
        where[key] = value * rng.choice([-1, 2, 3, 10, 1000, 10**6, 0.5, 0.1, 1e-3, 1e-6])
    else:
        where[key] = _wrong(rng)
        said += f" = {str(where[key])[:60]}"
    return f"{kind}: {said}"


def _damage(mutant: Mutant, rng: random.Random) -> bytes:
    """The text with one mistake."""
    text = mutant.text
    at = rng.randrange(len(text) + 1)
    kind = rng.choice(["cut", "bytes", "mark", "utf-16", "character", "again", "deep", "lines"])
    mutant.mistakes.append(f"text: {kind}")
    if kind == "cut":
        return text[:at]
    if kind == "bytes":
        return text[:at] + bytes([rng.randrange(128, 256)]) + text[at:]
    if kind == "mark":
        return b"\xef\xbb\xbf" + text
    if kind == "utf-16":
        return text.decode(errors="ignore").encode("utf-16")
    if kind == "character":
        return text[:at] + rng.choice(CHARACTERS).encode() + text[at:]
    lines = text.splitlines(keepends=True) or [b""]
    if kind == "again":
        return text + rng.choice(lines)
    if kind == "deep":
        return text + b"[" + b".".join([b"a"] * 5000) + b"]\nx = 1\n"
    rng.shuffle(lines)
    return b"".join(lines)


def _assignment(data: dict[str, Any], rng: random.Random) -> str:
    """A text for `--set`, with or without a mistake."""
    entries = list(_entries(data)) or [(data, "x", ("x",))]
    path = ".".join(map(str, rng.choice(entries)[2]))
    wrong = _value(_wrong(rng))
    if rng.random() < 0.2:
        return rng.choice([
            path, "=", f"={wrong}", f"{path}.x={wrong}", f"x.{path}={wrong}", f"{path} = ", "",
            f"{path}={wrong}\ny=2", f"{path}={wrong}]", ".".join(["a"] * 5000) + "=1",
            f"{path}=a b", f"{path}=1\n[value]", f"{path}.=1", f"{path}\x1b=1",
            "a" * 100_000 + "=1", f"{path}=\x1b",
        ])  # fmt: skip
    return f"{path}={wrong}"


def built(loaded: LoadedScene) -> list[tuple[Any, Any]]:
    """(model, start) as a scene makes them before anything runs.

    **Raises:** `SceneError` for what must not be run.
    """
    pairs = []
    for name, parts in build(loaded).items():
        grid = loaded.scene.experiment[name].grid()
        first = {
            key: grid[key][0] for key in {"excited", "displacement", "velocity"} & grid.keys()
        }
        pairs.append((parts.model, parts.initial(parts.model, **first)))
    return pairs


def means_nothing(chain: Any, state: Any) -> str:
    """The faults of an accepted chain and start, if any."""
    numbers = [*state, *chain(0.0, state)]
    return "" if all(np.all(np.isfinite(a)) for a in numbers) else "forces are not finite"


@dataclass
class Verdict:
    """The scene of a mutant if it was accepted, and the faults of the answer."""

    loaded: LoadedScene | None
    seconds: float
    text: str = ""
    fault: str = ""


def judge(mutant: Mutant, folder: Path) -> Verdict:
    """Loads a mutant: an error in words, in time and not too long, or a scene."""
    begun = time.process_time()
    try:
        loaded = mutant.load(folder)
    except SceneError as error:
        seconds = time.process_time() - begun
        text = str(error)
        return Verdict(None, seconds, text, fault_of(text, error.problems, seconds))
    except Exception as error:
        return Verdict(None, 0.0, "", f"{type(error).__name__}: {str(error)[:300]}")
    seconds = time.process_time() - begun
    slow = f"took {seconds:.1f} s" if seconds > MOST_SECONDS else ""
    return Verdict(loaded, seconds, "", slow)


def fault_of(text: str, problems: list[str], seconds: float) -> str:
    if seconds > MOST_SECONDS:
        return f"took {seconds:.1f} s"
    if len(text.encode("utf-8", "replace")) > MOST_CHARACTERS:
        return f"has {len(text)} characters"
    lines = text.split("\n")
    if not all(line.isprintable() for line in lines):
        return "has characters that cannot be printed"
    if not problems or len(lines) > len(problems) + 2 or max(map(len, lines)) > _LINE:
        return "is not one line a problem"
    if not all(line.strip() for line in lines):
        return "has an empty line"
    return ""
