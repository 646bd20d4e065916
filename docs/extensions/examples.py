"""The gallery and the notebooks: `examples/` as a folder of the site.

Sphinx reads what lies below `docs`; so a build copies the folder there.
"""

import shutil
from pathlib import Path

SOURCE = Path(__file__).parents[2] / "examples"


def copy(app, config):
    folder = Path(app.srcdir) / "examples"
    shutil.rmtree(folder, ignore_errors=True)
    # Times are kept: what has not changed is not read anew.
    shutil.copytree(SOURCE, folder, ignore=shutil.ignore_patterns(".*", "results"))


def follow_links(app, docname, source):
    """A link from `examples` to a page of `docs` stays a link to that page."""
    if docname.startswith("examples/"):
        source[0] = source[0].replace("](../docs/", "](../")


def setup(app):
    app.connect("config-inited", copy)
    app.connect("source-read", follow_links)
    return {"parallel_read_safe": True}
