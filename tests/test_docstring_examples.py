"""Every example in a docstring or in the README runs, and prints what it says.

Those of the names at the front door run with the quick tests, all others with the long ones; so
do those that take seconds, of what has quick tests of its own, and what stands in a fence: it
takes too long to wait for, and says nothing to compare.
"""

import ast
import doctest
import importlib
import pkgutil
from importlib.util import find_spec
from pathlib import Path

import pytest
from fences import fenced

import jaxchain

README = Path(__file__).parents[1] / "README.md"


def docstrings():
    """(module, name, docstring) of all that has an example; read from the files.

    A function that is compiled, or wrapped otherwise, hides its docstring from the interpreter.
    """
    for info in pkgutil.walk_packages(jaxchain.__path__, "jaxchain."):
        spec = find_spec(info.name)
        assert spec is not None
        assert spec.origin is not None
        text = Path(spec.origin).read_text(encoding="utf-8")
        if ">>>" not in text and "```python" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                found = ast.get_docstring(node)
                if found:
                    yield info.name, getattr(node, "name", "module"), found


DOCSTRINGS = list(docstrings())
PROMPTS = {
    f"{module.removeprefix('jaxchain.')}.{name}": (module, test)
    for module, name, text in DOCSTRINGS
    if (test := doctest.DocTestParser().get_doctest(text, {}, name, module, 0)).examples
}
FENCES = {
    f"{module.removeprefix('jaxchain.')}.{name}-{k}": (module, code)
    for module, name, text in DOCSTRINGS
    for k, code in enumerate(fenced(text))
}
README_FENCES = list(fenced(README.read_text(encoding="utf-8")))


# Each compiles a program of its own: sweeps, cycles, folds and their gradients, a gradient through
# events.
SLOW = (
    "EventDriven", "Samples", "find_limit_cycle", "fold_belt_speed", "monodromy_matrix",
    "nonsmooth_fold_belt_speed", "sweep",
)  # fmt: skip


def cost(name):
    last = name.split(".")[-1]
    at_the_door = last in getattr(jaxchain, "__all__", ())
    quick = at_the_door and last not in SLOW
    return name if quick else pytest.param(name, marks=pytest.mark.long)


@pytest.mark.parametrize("name", [cost(name) for name in PROMPTS])
def test_an_example_prints_what_it_says(name):
    module, test = PROMPTS[name]
    test.globs = vars(importlib.import_module(module)).copy()
    assert doctest.DocTestRunner().run(test, clear_globs=False).failed == 0


@pytest.mark.long
@pytest.mark.parametrize("name", FENCES)
def test_an_example_in_a_fence_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module, code = FENCES[name]
    # Whatever a door exports may be used without a word.
    doors = [jaxchain, *(getattr(jaxchain, room) for room in jaxchain.ROOMS)]
    public = {n: getattr(door, n) for door in doors for n in getattr(door, "__all__", ())}
    exec(compile(code, name, "exec"), public | vars(importlib.import_module(module)))


@pytest.mark.long
@pytest.mark.parametrize("k", range(len(README_FENCES)))
def test_an_example_of_the_readme_runs(k, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(README_FENCES[k], "README.md", "exec"), {})
