"""Where the names of other packages are explained, from lists in `docs/inventories`.

Sphinx would fetch each package's list from its site; these are kept here, so that a build needs no
network, and hold what pages refer to.  A file is a line `# package: address` and lines `kind name
url`; `$` in a url is the name.
"""

import zlib
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "inventories"


def compiled(text: str) -> tuple[str, bytes]:
    """Address and inventory, in the form that Sphinx reads, of one list."""
    first, *lines = text.splitlines()
    package, address = first.removeprefix("# ").split(": ")
    head = (
        "# Sphinx inventory version 2\n"
        f"# Project: {package}\n# Version: \n"
        "# The remainder of this file is compressed using zlib.\n"
    )
    rows = (f"{name} {kind} 1 {url} -\n" for kind, name, url in map(str.split, lines))
    return address, head.encode() + zlib.compress("".join(rows).encode())


def use(app, config):
    folder = Path(app.doctreedir) / "inventories"
    folder.mkdir(parents=True, exist_ok=True)
    for source in sorted(FOLDER.glob("*.txt")):
        address, inventory = compiled(source.read_text(encoding="utf-8"))
        file = folder / f"{source.stem}.inv"
        file.write_bytes(inventory)
        config.intersphinx_mapping[source.stem] = (address, str(file))


def setup(app):
    app.connect("config-inited", use)
    return {"parallel_read_safe": True}
