"""Pages that are read off the program: submodules, the keys of scene files, the command line."""

import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from names import names_of
from sphinx.util.docutils import SphinxDirective

import jaxchain
from jaxchain.scenes import schema

COMMANDS = ("", "explore", "run", "resume", "status", "report", "scenes", "boundary", "basins")


class Submodule(SphinxDirective):
    """Every public name of a submodule: a table of them, then each with its docstring."""

    required_arguments = 1

    def run(self):
        top = self.arguments[0] == "jaxchain"
        module = jaxchain if top else getattr(jaxchain, self.arguments[0])
        names = names_of(module)
        about = inspect.getdoc(module) or ""
        if names and not top:  # the files that the docstring lists matter to those who read them
            about = about.split("\n\n", 1)[0]
        about = [about, "", "| name | what it is |", "|---|---|"]
        for name in names:
            first = (inspect.getdoc(getattr(module, name)) or "").split("\n", 1)[0]
            link = f"{{py:obj}}`~{_home(name)}.{name}`"
            about.append(f"| {link} | {first.replace('|', chr(92) + '|')} |")
        text = [f".. py:module:: {module.__name__}", "", ".. markdown::", ""]
        table = "\n".join(about if names else about[:1])
        text += [f"   {line}" for line in table.splitlines()]
        for name in names:
            if top and _home(name) != "jaxchain":
                continue  # it is described in its submodule
            thing = getattr(module, name)
            members = ["   :members:"] if isinstance(thing, type) else []
            text += ["", f".. {_kind(thing)}:: {module.__name__}.{name}", *members, ""]
        return self.parse_text_to_nodes("\n".join(text))


def _home(name: str) -> str:
    for submodule in jaxchain.SUBMODULES:
        if name in names_of(getattr(jaxchain, submodule)):
            return f"jaxchain.{submodule}"
    return "jaxchain"


def _kind(thing: object) -> str:
    if isinstance(thing, type):
        return "autoexception" if issubclass(thing, BaseException) else "autoclass"
    return "autofunction" if callable(thing) else "autodata"


class Keys(SphinxDirective):
    """The keys of scene files: their types, defaults and meanings."""

    def run(self):
        whole = schema()
        tables = whole.pop("$defs", {})
        text = "\n".join(_told("The file itself", whole, tables))
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def _told(title: str, table: dict[str, Any], others: dict[str, Any]) -> Iterator[str]:
    yield f"## {title.removesuffix('Table')}"
    yield ""
    yield table.get("description", "")
    yield ""
    if "properties" in table:
        yield "| key | type | default | meaning |"
        yield "|---|---|---|---|"
        for key, said in table["properties"].items():
            needed = "required" if key in table.get("required", ()) else ""
            default = f"`{said['default']!r}`" if "default" in said else needed
            meaning = " ".join(said.get("description", "").split()).replace("|", "\\|")
            kind = _type(said).replace("|", "\\|")
            yield f"| `{key}` | {kind} | {default} | {meaning} |"
        yield ""
    for other, content in others.items():
        yield from _told(other, content, {})


def _type(said: dict[str, Any]) -> str:
    if "$ref" in said:
        return said["$ref"].rsplit("/", 1)[-1].removesuffix("Table")
    for several in ("oneOf", "anyOf", "allOf"):
        if several in said:
            return " or ".join(dict.fromkeys(map(_type, said[several])))
    if "const" in said:
        return f"`{said['const']}`"
    if "enum" in said:
        return " or ".join(f"`{value}`" for value in said["enum"])
    if said.get("type") == "array":
        return f"list of {_type(said.get('items', {})) or 'values'}"
    if said.get("type") == "object":
        named = [*said.get("patternProperties", {}).values(), said.get("additionalProperties")]
        if isinstance(named[0], dict):
            return f"table of {_type(named[0])} tables by name"
    bounds = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    limits = [f"{sign} {said[key]:g}" for key, sign in bounds.items() if key in said]
    return " ".join([said.get("type", "any"), *limits])


class Commands(SphinxDirective):
    """What the command line says of itself."""

    def run(self):
        text = []
        for command in COMMANDS:
            line = " ".join(["jaxchain", *command.split()])
            text += [f"## {line}", "", "```text", _help(command), "```", ""]
        return self.parse_text_to_nodes("\n".join(text), allow_section_headings=True)


def _help(command: str) -> str:
    words = [sys.executable, "-m", "jaxchain", *command.split(), "--help"]
    told = os.environ | {"COLUMNS": "96", "NO_COLOR": "1"}
    return subprocess.run(words, env=told, capture_output=True, text=True, check=True).stdout


def setup(app):
    app.add_directive("submodule", Submodule)
    app.add_directive("keys", Keys)
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True}
