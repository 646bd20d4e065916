"""The front door and the rooms: few names, each room in its place, and words for who is lost."""

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxchain

# What the README of 0.1 showed; code that uses it keeps working.
SHOWN = {
    *("Chain", "paper_chain", "simulate", "sweep", "EventDriven", "Rodas4", "Rodas5P"),
    *("Amplitude", "PeakTimes", "equation_8", "energy", "active", "continue_cycle"),
    *("hopf_belt_speed", "fold_belt_speed", "dry_fold_belt_speed", "find_limit_cycle"),
    *("monodromy_matrix", "floquet_multipliers", "lyapunov_spectrum", "verdict"),
}


def rooms():
    folders = [info.name for info in pkgutil.iter_modules(jaxchain.__path__) if info.ispkg]
    return [name for name in folders if not name.startswith("_")]


def files(room):
    return [info.name for info in pkgutil.iter_modules(importlib.import_module(room).__path__)]


def listed(module):
    """What a docstring lists, a line each: "- `name`: what it is"."""
    # From the file: the type checker of the tests hides the docstring of a module.
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    return re.findall(r"^- `(\w+)`: \S", ast.get_docstring(tree) or "", flags=re.MULTILINE)


def exported(room):
    return getattr(importlib.import_module(room), "__all__", [])


def fresh(code):
    """What a fresh interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout


def test_few_names_stand_at_the_door_and_those_of_before_among_them():
    names = exported("jaxchain")
    assert len(names) <= 40
    assert set(names) >= SHOWN
    assert all(getattr(jaxchain, name) is not None for name in names)
    assert set(dir(jaxchain)) == {*names, *rooms()}


def test_the_door_shows_every_room():
    assert sorted(jaxchain.ROOMS) == sorted(rooms())
    assert listed(jaxchain) == list(jaxchain.ROOMS)


@pytest.mark.parametrize("room", rooms())
def test_a_room_lists_its_files_and_has_what_it_exports(room):
    module = importlib.import_module(f"jaxchain.{room}")
    assert sorted(listed(module)) == files(f"jaxchain.{room}")
    for name in exported(f"jaxchain.{room}"):
        assert getattr(module, name) is not None
        assert name not in rooms()


def test_a_name_stands_in_one_room():
    names = [name for room in rooms() for name in exported(f"jaxchain.{room}")]
    assert len(names) == len(set(names))


def test_who_asks_at_the_door_is_sent_to_the_room():
    told = "jaxchain.front_speed moved to jaxchain.localization.front_speed"
    with pytest.raises(AttributeError, match=told):
        _ = jaxchain.front_speed  # pyright: ignore[reportAttributeAccessIssue]
    # In an interpreter of its own: the type checker of the tests stands between the two.
    code = "try: from jaxchain import front_speed\nexcept ImportError as error: print(error)"
    assert fresh(code).strip() == told
    assert not hasattr(jaxchain, "front_speed")
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = jaxchain.nonsense  # pyright: ignore[reportAttributeAccessIssue]


def test_nothing_is_imported_before_it_is_asked_for():
    code = "import sys, jaxchain; dir(jaxchain); jaxchain.boundaries; print(*sys.modules)"
    loaded = set(fresh(code).split())
    assert "jaxchain.boundaries" in loaded
    assert not loaded & {"jax", "jaxlib", "equinox", "diffrax", "numpy", "scipy", "matplotlib"}
