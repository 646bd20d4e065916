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
    """What a room, or the front door, exports."""
    return list(getattr(module, "__all__", ()))


def _public() -> dict[str, str]:
    """Every way to write a public name -> the name under which it is documented."""
    rooms = {room: getattr(jaxchain, room) for room in jaxchain.ROOMS}
    found = {name: f"jaxchain.{name}" for name in (*names_of(jaxchain), *rooms)}
    for room, module in rooms.items():
        for name in names_of(module):
            found[name] = found[f"{room}.{name}"] = f"jaxchain.{room}.{name}"
    whole = {name: name for name in found.values()}
    at_the_door = {f"jaxchain.{name}": found[name] for name in (*names_of(jaxchain), *rooms)}
    # A bare word such as `model` is seldom the room.
    return {name: to for name, to in found.items() if name not in rooms} | whole | at_the_door


PUBLIC = _public()
OTHERS = {
    line.split()[1]
    for source in FOLDER.glob("*.txt")
    for line in source.read_text(encoding="utf-8").splitlines()[1:]
}


def meant(text: str) -> str | None:
    """The name that inline code refers to, if it is one that is documented somewhere.

    One of jaxchain's that is not public is a broken link, of which the build tells.
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
