"""Code, headings and links of texts that people read: docstrings, the README, pages of docs/."""

import re
from collections.abc import Iterator


def fenced(text: str, language: str = "python") -> list[str]:
    """The code of each fence of this language, without its indentation."""
    fence = re.compile(rf"^( *)```{language}\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
    return [
        "".join(line.removeprefix(indent) for line in code.splitlines(keepends=True))
        for indent, code in fence.findall(text)
    ]


def prose(text: str) -> str:
    """Markdown without what stands in fences of backticks, and without inline code."""
    text = re.sub(r"^( *)(`{3,}).*?^\1\2 *$", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`+[^`\n]*`+", "", text)


def headings(text: str) -> list[tuple[int, str]]:
    """(level, words) of each heading, in order; words may hold inline code."""
    text = re.sub(r"^( *)(`{3,}).*?^\1\2 *$", "", text, flags=re.MULTILINE | re.DOTALL)
    found = re.findall(r"^(#{1,6}) +(.*?) *$", text, re.MULTILINE)
    return [(len(marks), words) for marks, words in found]


def anchors(text: str) -> set[str]:
    """The anchor of a heading, after the "#": small letters, hyphens for blanks."""
    words = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for _, heading in headings(text))
    return {re.sub(r"[^\w\- ]", "", word.lower()).strip().replace(" ", "-") for word in words}


def links(text: str) -> Iterator[tuple[str, str]]:
    """(file, anchor) of each link and picture that is no address on the network."""
    for target in re.findall(r"\]\(<?([^)\s>]+)>?(?: [^)]*)?\)", prose(text)):
        if not re.match(r"[a-z]+:", target):
            file, _, anchor = target.partition("#")
            yield file, anchor
