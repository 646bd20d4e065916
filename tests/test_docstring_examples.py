"""Every example in a docstring or in the README runs and prints the stated output.

Every public name has one; `pytest -m examples` runs them.  What stands in a fence takes too long
to wait for, or says nothing to compare.
"""

import ast
import doctest
import importlib
import pkgutil
import re
from importlib.util import find_spec
from pathlib import Path

import jax
import pytest
from fences import fenced

import jaxchain

README = Path(__file__).parents[1] / "README.md"


def docstrings():
    """(module, name, docstring), read from the files.

    A function that is compiled, or wrapped otherwise, hides its docstring from the interpreter.
    """
    for info in pkgutil.walk_packages(jaxchain.__path__, "jaxchain."):
        spec = find_spec(info.name)
        assert spec is not None
        assert spec.origin is not None
        text = Path(spec.origin).read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                found = ast.get_docstring(node)
                if found:
                    yield info.name, getattr(node, "name", "module"), found


def prompts(text, name):
    """The examples with prompts; None if there are none, or if all are skipped."""
    test = doctest.DocTestParser().get_doctest(text, {}, name, name, 0)
    runs = any(doctest.SKIP not in example.options for example in test.examples)
    return test if runs else None


def public():
    """Of every public name "submodule.module.name", as the stubs say; imports nothing."""
    folder = Path(jaxchain.__path__[0])
    for stub in (folder / "__init__.pyi", *sorted(folder.glob("*/__init__.pyi"))):
        submodule = [] if stub.parent == folder else [stub.parent.name]
        for node in ast.parse(stub.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                yield from (".".join([*submodule, node.module, name.name]) for name in node.names)


# A name whose definition stands in a module below its submodule.
BELOW = {"observers.base.Variable": "datasets.Variable"}
PUBLIC = {BELOW.get(name, name) for name in public()}
ALL = list(docstrings())
DOCSTRINGS = [
    (module, f"{module.removeprefix('jaxchain.')}.{name}", text) for module, name, text in ALL
]
PROMPTS = {
    name: (module, test) for module, name, text in DOCSTRINGS if (test := prompts(text, name))
}
FENCES = {
    f"{name}-{k}": (module, code)
    for module, name, text in DOCSTRINGS
    for k, code in enumerate(fenced(text))
}
# Those that take longer than most; quicker tests hold what they show, too.
LONG = {
    "basins.classifiers.AbstractClassifier", "basins.edges.edge_state",
    "basins.shares.share_differences", "boundaries.descent.fold_by_descent",
    "boundaries.limit.extrapolated_fold", "boundaries.ranges.stability_range",
    "boundaries.special_curves.find_special_cycle", "chaos.classification.Criteria",
    "chaos.classification.verdicts", "cycles.branches.switch_cycle",
    "cycles.deflation.find_limit_cycles", "cycles.symmetry.cycle_symmetry",
    "inverse.optimal_design.design", "localization.fronts.front_speed",
    "localization.patterns.pattern_guess", "localization.patterns.phase_model",
    "localization.patterns.rotating_wave", "model.ready_made.LuGre",
    "model.ready_made.Pendulums", "plotting.branches.plot_special_curves",
    "plotting.fits.plot_profile",
}  # fmt: skip
README_FENCES = list(fenced(README.read_text(encoding="utf-8")))


def test_every_public_name_has_an_example_or_refers_to_one():
    """A record need not repeat the example of the function that returns it."""
    assert len(PUBLIC) > 150
    shown = PROMPTS.keys() | {name.rpartition("-")[0] for name in FENCES}
    short = {name.rpartition(".")[2] for name in PUBLIC & shown}
    named = {
        f"{module.removeprefix('jaxchain.')}.{name}"
        for module, name, text in ALL
        if short & set(re.findall(r"`(\w+)", text))
    }
    assert sorted(PUBLIC - shown - named) == []
    assert sorted(LONG - PROMPTS.keys()) == []


def run(name):
    module, test = PROMPTS[name]
    if name not in PUBLIC:
        test.globs = vars(importlib.import_module(module)).copy()
        assert doctest.DocTestRunner().run(test, clear_globs=False).failed == 0
        return
    # What one copies must run as it stands, in a process that has set nothing up.
    test.globs = {"__name__": "__main__"}
    jax.config.update("jax_enable_x64", False)
    try:
        assert doctest.DocTestRunner().run(test, clear_globs=False).failed == 0
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.examples
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name in LONG)) for name in PROMPTS]
)
def test_an_example_prints_the_stated_output(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(name)


@pytest.mark.examples
@pytest.mark.parametrize("name", FENCES)
def test_an_example_in_a_fence_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module, code = FENCES[name]
    # Whatever a module exports may be used without a word.
    modules = [jaxchain, *(getattr(jaxchain, submodule) for submodule in jaxchain.SUBMODULES)]
    names = {n: getattr(module, n) for module in modules for n in getattr(module, "__all__", ())}
    exec(compile(code, name, "exec"), names | vars(importlib.import_module(module)))


@pytest.mark.examples
@pytest.mark.parametrize("k", range(len(README_FENCES)))
def test_an_example_of_the_readme_runs(k, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(README_FENCES[k], "README.md", "exec"), {})
