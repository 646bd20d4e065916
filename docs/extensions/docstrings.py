"""Docstrings are Markdown: autodoc hands them on as they are, and MyST reads them."""

import re
import textwrap

from docutils.utils import new_document
from myst_parser.parsers.sphinx_ import MystParser
from sphinx.util.docutils import SphinxDirective

EXAMPLE = re.compile(r"^!!! (\w+)\n+((?:(?:    .*)?(?:\n|\Z))+)", re.MULTILINE)
# Up to an empty line; without a fence Markdown would read a quotation.
SESSION = re.compile(r"^>>> .*(?:\n.+)*", re.MULTILINE)


def as_markdown(text: str) -> str:
    """`!!! example` and its indented block as a title and code; `>>>` lines as a session."""

    def plain(found: re.Match) -> str:
        block = textwrap.dedent(found[2]).strip("\n")
        return f"**{found[1].capitalize()}:**\n\n{block}\n\n"

    return SESSION.sub(lambda found: f"```pycon\n{found[0]}\n```", EXAMPLE.sub(plain, text))


class MarkdownDirective(SphinxDirective):
    """Its content, read as Markdown within a page of reStructuredText."""

    has_content = True

    def run(self):
        document = new_document(self.get_source_info()[0] or "", self.state.document.settings)
        MystParser().parse("\n".join(self.content), document)
        return document.children


def wrap(app, what, name, obj, options, lines):
    text = as_markdown("\n".join(lines))
    lines[:] = ["", ".. markdown::", "", *(f"   {line}" for line in text.splitlines()), ""]


def setup(app):
    app.add_directive("markdown", MarkdownDirective)
    app.connect("autodoc-process-docstring", wrap)
    return {"parallel_read_safe": True}
