"""The top level and the submodules: few names, each in its place, clear errors."""

import ast
import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import jaxchain

# What the README of 0.1 showed; code that uses it keeps working.
SHOWN = {
    *("Chain", "paper_chain", "simulate", "sweep", "EventDriven", "Rodas4", "Rodas5P"),
    *("Amplitude", "PeakTimes", "equation_8", "energy", "active", "continue_cycle"),
    *("hopf_belt_speed", "fold_belt_speed", "find_limit_cycle"),
    *("monodromy_matrix", "floquet_multipliers", "lyapunov_spectrum", "verdict"),
}


def submodules():
    folders = [info.name for info in pkgutil.iter_modules(jaxchain.__path__) if info.ispkg]
    return [name for name in folders if not name.startswith("_")]


def files(submodule):
    return [
        info.name for info in pkgutil.iter_modules(importlib.import_module(submodule).__path__)
    ]


def listed(module):
    """What a docstring lists, a line each: "- `name`: what it is"."""
    # From the file: the type checker of the tests hides the docstring of a module.
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    return re.findall(r"^- `(\w+)`: \S", ast.get_docstring(tree) or "", flags=re.MULTILINE)


def exported(submodule):
    return getattr(importlib.import_module(submodule), "__all__", [])


def test_few_names_stand_at_top_and_those_of_before_among_them():
    names = exported("jaxchain")
    assert len(names) <= 41
    assert set(names) >= SHOWN
    assert all(getattr(jaxchain, name) is not None for name in names)
    assert set(dir(jaxchain)) == {*names, *submodules()}


def test_the_door_shows_every_room():
    assert sorted(jaxchain.SUBMODULES) == sorted(submodules())
    assert listed(jaxchain) == list(jaxchain.SUBMODULES)


@pytest.mark.parametrize("submodule", submodules())
def test_a_room_lists_its_files_and_has_what_it_exports(submodule):
    module = importlib.import_module(f"jaxchain.{submodule}")
    assert sorted(listed(module)) == files(f"jaxchain.{submodule}")
    for name in exported(f"jaxchain.{submodule}"):
        assert getattr(module, name) is not None
        assert name not in submodules()


def test_a_name_stands_in_one_room():
    names = [name for submodule in submodules() for name in exported(f"jaxchain.{submodule}")]
    assert len(names) == len(set(names))


def test_a_name_that_is_unknown_at_the_top_level_is_refused():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        getattr(jaxchain, "nonsense")  # noqa: B009


def names_of(tree):
    """The names that a module defines at its top level."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            for part in ast.walk(node):
                if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                    yield part.id


def test_no_module_bears_the_name_of_a_name_in_it():
    package = Path(jaxchain.__file__).parent
    modules = [path for path in package.rglob("*.py") if not path.name.startswith("__")]
    assert len(modules) > 100
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in modules}
    assert not [path for path, tree in trees.items() if path.stem in names_of(tree)]
