"""The submodules of the package: no function hides the module it stands in."""

import ast
from pathlib import Path

import jaxchain

PACKAGE = Path(jaxchain.__file__).parent
MODULES = [
    path
    for path in sorted(PACKAGE.rglob("*.py"))
    if path.name not in ("__init__.py", "__main__.py")
]


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
    hidden = [
        str(path.relative_to(PACKAGE))
        for path in MODULES
        if path.stem in names_of(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not hidden
