"""Hundreds of built-in scenes with one to three mistakes: each a clear error or a valid run."""

import copy
import json
import math
import random
import time

import pytest

from jaxchain.model.parameters import PARAMETERS
from jaxchain.scenes.building import build
from jaxchain.scenes.files import SceneError, builtin_scenes, read_scene
from jaxchain.scenes.scene import load_scene

SEED, COUNT = 14, 300
# What a refusal may take, and how long its text and a line of it may be.
MOST_SECONDS, MOST_CHARACTERS, MOST_OF_A_LINE = 2.0, 100_000, 2000
NUMBERS = [
    math.nan, math.inf, -1, 0, 1, 3, -1.0, 0.0, 0.5, 1e300, 5e-324, 1e-12, 10**9, 10**30, 10**400,
]  # fmt: skip


TEXTS = ["", "x", "a/b", ".", "a\nb", "a\x1b[31mb", "\u202e", "x" * 100_000, "amplitude", "n", "2"]


OTHERS = [
    True, [], {}, [[]], [{}], {"x": 1}, [1, 1], ["a", "a"], [math.nan], [1, "x"], [True],
    [5e-324], [10**30], [2, 1], {"start": 1, "stop": 2, "count": 10**9},
    {"law": "custom", "width": 1e-3}, {"kind": "excited", "excited": 1},
    [{"observer": "PeakTimes", "capacity": 10**9}], [{"observer": "Divergence"}] * 2,
]  # fmt: skip


SWEPT = [*PARAMETERS, "excited", "displacement", "velocity", "n"]


def inline(value):
    """The value in TOML, in one line."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{" + ", ".join(f"{inline(k)} = {inline(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(inline, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)


def entries(data, path=()):
    """(where, key, its path) of every key of every table and every entry of every list."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield data, key, (*path, key)
        if isinstance(value, dict | list):
            yield from entries(value, (*path, key))


def wrong(rng):
    return copy.deepcopy(rng.choice(rng.choices([NUMBERS, TEXTS, OTHERS], [50, 15, 35])[0]))


def change(data, rng):
    """One mistake in the tables."""
    where, key, _ = rng.choice([*entries(data)])
    value = where[key]
    kind = rng.choice(["replace", "replace", "delete", "misspell", "list", "scale", "sweep"])
    if kind == "delete":
        del where[key]
    elif kind == "misspell" and isinstance(where, dict):
        at = rng.randrange(len(key) + 1)
        where[rng.choice([key[:at] + "x" + key[at:], key.upper(), *TEXTS])] = where.pop(key)
    elif kind == "list" and isinstance(value, list):
        value[:] = rng.choice([[], value * 2, value[::-1], [list(value)], value + value[:1]])
    elif kind == "scale" and isinstance(value, int | float) and abs(value) < 1e100:
        where[key] = value * rng.choice([-1, 2, 10, 10**6, 0.5, 1e-3])
    elif kind == "sweep" and isinstance(where, dict):
        where["sweep"] = {rng.choice(SWEPT): rng.choice([[rng.choice(NUMBERS), 1.0], wrong(rng)])}
    else:
        where[key] = wrong(rng)


def faults_of(error, seconds):
    text, lines = str(error), str(error).split("\n")
    return {
        "slow": seconds > MOST_SECONDS,
        "long": len(text.encode("utf-8", "replace")) > MOST_CHARACTERS,
        "not printable": not all(line.isprintable() for line in lines),
        "not one line a problem": not error.problems or len(lines) > len(error.problems) + 2
        or max(map(len, lines)) > MOST_OF_A_LINE or not all(line.strip() for line in lines),
    }  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*If it is in SI units")
def test_hundreds_of_mutants_are_refused_in_words_or_valid(tmp_path):
    scenes, file = {name: read_scene(name)[1] for name in builtin_scenes()}, tmp_path / "mine.toml"
    accepted, refused, faults = [], 0, []
    for number in range(COUNT):
        rng = random.Random(f"{SEED}/{number}")
        data = copy.deepcopy(scenes[rng.choice([*scenes])])
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            change(data, rng)
        text = "".join(f"{inline(key)} = {inline(value)}\n" for key, value in data.items())
        file.write_bytes(text.encode("utf-8", "surrogatepass"))
        begun = time.process_time()
        try:
            loaded = load_scene(str(file))
        except SceneError as error:
            refused += 1
            found = faults_of(error, time.process_time() - begun)
            faults += [(number, fault, str(error)[:200]) for fault, so in found.items() if so]
        else:
            accepted.append((number, loaded))
    for number, loaded in accepted[:10]:
        try:
            build(loaded)
        except SceneError as error:  # what does not fit the model is refused only here
            found = faults_of(error, 0.0)
            faults += [(number, fault, str(error)[:200]) for fault, so in found.items() if so]
    assert not faults
    assert refused > 0.6 * COUNT
    assert len(accepted) > 0.05 * COUNT
