"""Notebooks as a reader finds them: a question first, public names alone, a task at the end.

That they run is tried when all examples are; here nothing is executed.
"""

import ast
import importlib
import json
import re
from pathlib import Path

import pytest

import jaxchain

NOTEBOOKS = sorted((Path(__file__).parents[1] / "examples").glob("*.ipynb"))
# What a page can show without a third party's script.
KINDS = {"image/png", "text/plain", "text/html"}
NOT_TO_BE_READ = re.compile(r"0x[0-9a-f]{6}|findfont|Warning|Traceback|/(tmp|home|root|work)/")


def cells(path):
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        yield cell["cell_type"], "".join(cell["source"]), cell.get("outputs", [])


def imported(code):
    """(module, name) of everything that is imported."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem[:2])
def notebook(request):
    return list(cells(request.param))


def test_a_notebook_uses_public_names_by_room(notebook):
    for kind, code, _ in notebook:
        if kind != "code":
            continue
        for module, name in imported(code):
            if module.partition(".")[0] != "jaxchain" or name is None:
                assert not module.startswith("jaxchain.")
                continue
            assert module == "jaxchain" or module.removeprefix("jaxchain.") in jaxchain.SUBMODULES
            assert name in importlib.import_module(module).__all__
        assert not re.search(r"\.\_[a-z]", code)  # nothing private


def test_a_notebook_has_its_pictures_and_links_and_prints_nothing_of_the_machine(notebook):
    code = [(text, outputs) for kind, text, outputs in notebook if kind == "code"]
    assert sum("image/png" in out.get("data", {}) for _, outs in code for out in outs) >= 2
    for output in (output for _, outputs in code for output in outputs):
        assert output["output_type"] != "error"
        data = output.get("data", {})
        assert set(data) <= KINDS
        text = "".join(output.get("text", [])) + "".join(data.get("text/plain", []))
        assert not NOT_TO_BE_READ.search(text)

    links = [re.findall(r"\]\(([^)\s]+)\)", text) for kind, text, _ in notebook if kind != "code"]
    assert all((NOTEBOOKS[0].parent / target).is_file() for own in links for target in own)
