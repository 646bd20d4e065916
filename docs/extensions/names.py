"""Inline code that is a public name, of jaxchain or of a package it builds on, becomes a link."""

import re
from types import ModuleType

from docutils import nodes
from inventories import FOLDER
from sphinx import addnodes
from sphinx.transforms import SphinxTransform

import jaxchain

OWN = re.compile(r"jaxchain(\.[A-Za-z_]\w*)+")


def names_of(module: ModuleType) -> list[str]:
    """What a submodule, or the top level, exports."""
    return list(getattr(module, "__all__", ()))


def _public() -> dict[str, str]:
    """Every way to write a public name -> the name under which it is documented."""
    submodules = {submodule: getattr(jaxchain, submodule) for submodule in jaxchain.SUBMODULES}
    found = {name: f"jaxchain.{name}" for name in (*names_of(jaxchain), *submodules)}
    for submodule, module in submodules.items():
        for name in names_of(module):
            found[name] = found[f"{submodule}.{name}"] = f"jaxchain.{submodule}.{name}"
    whole = {name: name for name in found.values()}
    at_top = {f"jaxchain.{name}": found[name] for name in (*names_of(jaxchain), *submodules)}
    # A bare word such as `model` is seldom the submodule.
    return {name: to for name, to in found.items() if name not in submodules} | whole | at_top


PUBLIC = _public()
OTHERS = {
    line.split()[1]
    for source in FOLDER.glob("*.txt")
    for line in source.read_text(encoding="utf-8").splitlines()[1:]
}


def meant(text: str) -> str | None:
    """The name that inline code refers to, if it is one that is documented somewhere.

    One of jaxchain's that is not public is a broken link, which the build reports.
    """
    known = "." in text and text in OTHERS
    return PUBLIC.get(text) or (text if known or OWN.fullmatch(text) else None)


class Link(SphinxTransform):
    default_priority = 5  # before references are resolved

    def apply(self, **options):
        for literal in list(self.document.findall(nodes.literal)):
            target = meant(literal.astext())
            parents = (nodes.reference, nodes.title, addnodes.pending_xref)
            inside = any(isinstance(literal.parent, kind) for kind in parents)
            if target is None or inside or "py" in literal.get("classes", ()):
                continue
            link = addnodes.pending_xref(
                "", literal.deepcopy(), refdomain="py", reftype="obj", reftarget=target,
                refexplicit=True, refwarn=True, refdoc=self.env.docname,
            )  # fmt: skip
            link.source, link.line = literal.source, literal.line
            literal.replace_self(link)


def setup(app):
    app.add_transform(Link)
    return {"parallel_read_safe": True}
