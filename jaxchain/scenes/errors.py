"""What may go wrong with a scene or a study."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

# A screen or two, whatever the file: so many problems are shown, of so many characters at most.
MOST_SHOWN, _CHARACTERS = 50, 1000
# Longer words are no misspelt keys, and take long to compare.
_LONGEST_WORD = 50


class SceneError(Exception):
    """A scene that cannot be run: what is wrong, one line per problem."""

    def __init__(self, name: str, problems: Sequence[str]):
        super().__init__(name, problems)
        self.name = name
        self.problems = list(problems)

    def __str__(self) -> str:
        count = "an error" if len(self.problems) == 1 else f"{len(self.problems)} errors"
        lines = [f"scene {shortened(self.name, _CHARACTERS)} has {count}:"]
        lines += [f"  {shortened(p, _CHARACTERS)}" for p in self.problems[:MOST_SHOWN]]
        if (more := len(self.problems) - MOST_SHOWN) > 0:
            lines.append(f"  and {more} more")
        return "\n".join(lines)


class FigureError(Exception):
    """The figure could not be drawn; the results are saved."""


class StorageError(Exception):
    """Results that cannot be written; `datasets` holds all of the run, in memory."""

    def __init__(
        self,
        name: str,
        folder: Path,
        reason: str,
        whole: Sequence[str],
        datasets: Mapping[str, Any],
    ):
        super().__init__(name, folder, reason, whole, datasets)
        self.name, self.folder, self.reason = name, folder, reason
        self.whole, self.datasets = list(whole), datasets

    def __str__(self) -> str:
        there = ", ".join(f"`{name}`" for name in self.whole) or "nothing"
        return (
            f"cannot write `{self.name}` into {self.folder}: {self.reason}. "
            f"What was saved there before stays whole: {there}."
        )


class TakenOverError(Exception):
    """Another process goes on in the folder of a run that has slept."""


class StudyFailedError(Exception):
    """The study ran to its end and its results are saved, but they are not as they must be."""


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """ " (did you mean `...`?)", or nothing if no allowed word is near."""
    if len(word) > _LONGEST_WORD:
        return ""
    own = {name.lower(): name for name in allowed}
    near = difflib.get_close_matches(word.lower(), own, n=1)
    return f" (did you mean `{own[near[0]]}`?)" if near else ""


def shortened(text: str, most: int) -> str:
    """One printable line: other characters as escapes, and no more than `most` of them, or so.

    >>> shortened("a" * 20 + "b", 10)
    'aaaaaaaaaa... (21 characters)'
    """
    cut = text if len(text) <= most else f"{text[:most]}... ({len(text)} characters)"
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in cut)
