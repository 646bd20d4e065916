"""Every author whom the package names stands on the page of the methods' sources."""

import re
import unicodedata
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "explanation" / "methods_and_sources.md"
# "J. L. Kaplan" or "J.-M. Strelcyn".
AUTHOR = re.compile(r"\b[A-Z]\.(?:-[A-Z]\.)? (?:[A-Z]\. )?([A-Z][a-z]+)")


def in_ascii(text):
    """As names stand in docstrings: Mueller, More."""
    text = text.replace("ü", "ue")
    return unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()


def test_every_author_stands_on_the_page():
    page = in_ascii(PAGE.read_text(encoding="utf-8"))
    named = {
        (author, file.name)
        for file in (ROOT / "jaxchain").rglob("*.py")
        for author in AUTHOR.findall(file.read_text(encoding="utf-8"))
    }
    assert len(named) > 20
    assert not [(author, file) for author, file in named if author not in page]
