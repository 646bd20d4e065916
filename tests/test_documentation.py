"""The pages of docs/: their code runs, their commands are known, their links lead somewhere.

All fences of a page that begin with three backticks and `python` run, from top to bottom, in one
namespace and an empty folder. What cannot run here stands in a fence of another language, or in
one that begins with `{code-block} python`.
"""

import shlex
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from fences import anchors, fenced, headings, links

from jaxchain.cli import _parser
from jaxchain.result import NAMES, SEARCH_NAMES
from jaxchain.scenes import load_scene

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def pages():
    """Each page; not what was built, nor the copy of `examples/` that a build makes."""
    for page in sorted(DOCS.rglob("*.md")):
        first = page.relative_to(DOCS).parts[0]
        if first != "examples" and not first.startswith(("_", ".")):
            yield page


PAGES = {str(page.relative_to(DOCS)): page for page in pages()}
TEXTS = {name: page.read_text(encoding="utf-8") for name, page in PAGES.items()}
READ = {
    **{f"docs/{name}": page for name, page in PAGES.items()},
    **{name: ROOT / name for name in ("README.md", "examples/README.md")},
}


# All that the paper says, found again, takes minutes; others do what a shorter page does, too.
LONG = (
    "explanation/paper.md", "explanation/basins.md", "explanation/fold_is_a_grazing.md",
    "explanation/smoothing.md", "coming_from/bifurcationkit.md", "faq.md", "guides/custom_cell.md",
    "guides/gradients.md",
)  # fmt: skip
CODE = [
    pytest.param(name, marks=[pytest.mark.long] * (name in LONG))
    for name, text in TEXTS.items()
    if fenced(text)
]


@pytest.mark.examples
@pytest.mark.filterwarnings("default")  # a page may show what is warned of
@pytest.mark.parametrize("name", CODE)
def test_the_code_of_a_page_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "__main__"}
    try:
        for k, code in enumerate(fenced(TEXTS[name])):
            exec(compile(code, f"{name}, fence {k + 1}", "exec"), namespace)
    finally:
        plt.close("all")


@pytest.mark.parametrize("name", READ)
def test_a_page_has_one_title_and_links_that_lead_somewhere(name):
    page = READ[name]
    text = page.read_text(encoding="utf-8")
    assert [level for level, _ in headings(text)].count(1) == 1
    for file, anchor in links(text):
        target = (page.parent / file).resolve() if file else page
        if target.is_relative_to(DOCS / "examples"):
            target = ROOT / "examples" / target.relative_to(DOCS / "examples")
        assert target.exists(), f"there is no {file}"
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target.read_text(encoding="utf-8")), f"{file}#{anchor}"


def scenes():
    return [(name, k) for name, text in TEXTS.items() for k, _ in enumerate(fenced(text, "toml"))]


@pytest.mark.parametrize(("name", "k"), scenes())
def test_a_scene_of_a_page_is_one(name, k, tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text(fenced(TEXTS[name], "toml")[k], encoding="utf-8")
    load_scene(str(file))


def commands(text):
    """The arguments of each line of a shell that begins with `jaxchain`."""
    for code in fenced(text, "sh"):
        for line in code.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            ends = [k for k, word in enumerate(words) if word in ("&", ">", "&&", "|")]
            if words[:1] == ["jaxchain"]:
                yield words[1 : min(ends, default=len(words))]


@pytest.mark.parametrize("name", [name for name, text in TEXTS.items() if any(commands(text))])
def test_the_commands_of_a_page_are_known(name, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda package: package)
    for words in commands(TEXTS[name]):
        try:
            _parser().parse_args(words)
        except SystemExit:
            pytest.fail(f"jaxchain {shlex.join(words)}")


def test_the_page_on_failures_lists_every_outcome():
    """Those of runs with their codes, in their order; those of searches in any."""
    tables = [
        line
        for line in TEXTS["guides/failures.md"].splitlines()
        if line[:3] == "| `" and "`result`" not in line
    ]
    assert [line.split("|")[1:3] for line in tables[: len(NAMES)]] == [
        [f" `{name}` ", f" {code} "] for code, name in enumerate(NAMES)
    ]
    searches = " ".join(line.split("|")[1] for line in tables[len(NAMES) :])
    known = set(SEARCH_NAMES)
    assert set(searches.replace("`", "").replace(",", "").split()) == known
