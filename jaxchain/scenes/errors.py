"""What may go wrong with a scene or a study."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


class SceneError(Exception):
    """A scene that cannot be run: what is wrong, one line per problem."""

    def __init__(self, name: str, problems: Sequence[str]):
        super().__init__(name, problems)
        self.name = name
        self.problems = list(problems)

    def __str__(self) -> str:
        count = "an error" if len(self.problems) == 1 else f"{len(self.problems)} errors"
        return "\n".join([f"scene {self.name} has {count}:", *(f"  {p}" for p in self.problems)])


class FigureError(Exception):
    """The figure could not be drawn; the results are saved."""


class StudyFailedError(Exception):
    """The study ran to its end and its results are saved, but they are not as they must be."""


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """ " (did you mean `...`?)", or nothing if no allowed word is near."""
    near = difflib.get_close_matches(word, list(allowed), n=1)
    return f" (did you mean `{near[0]}`?)" if near else ""
