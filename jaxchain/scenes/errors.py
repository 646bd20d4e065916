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
    """A scene that cannot be run: what is wrong, one line per problem.

    - `name`: of the scene; `problems`: a list of texts, each with the key, its value and a remedy.

    !!! example

        >>> from jaxchain.scenes import SceneError, load_scene
        >>> wrong = "experiment.ladder.chain.n=0", "experiment.ladder.time.window=0"
        >>> try:
        ...     scene = load_scene("quickstart", wrong)
        ... except SceneError as error:
        ...     print(error)
        scene quickstart has 2 errors:
          experiment.ladder.chain.n: must be at least 1, but is 0
          experiment.ladder.time.window: must be greater than 0, but is 0
    """

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
    """The figure could not be drawn; the results are saved.

    Draw them yourself: `xarray.open_datatree` reads them, `jaxchain.plotting` has the pictures.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes import FigureError, Results
        >>> def draw():
        ...     raise ZeroDivisionError("an axis of no length")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     try:
        ...         Results(Path(folder), "mine").draw(draw)
        ...     except FigureError as error:
        ...         print("no picture:", repr(error.__cause__))
        no picture: ZeroDivisionError('an axis of no length')
    """


class StorageError(Exception):
    """Results that cannot be written; `datasets` holds all of the run, in memory.

    - `name`: of the dataset; `folder`: where it should go; `reason`: of the system; `whole`: the
      names of what was saved before.  Save `datasets` in another folder, by other `Results`.

    !!! example

        >>> import tempfile, xarray as xr
        >>> from pathlib import Path
        >>> from jaxchain.scenes import Results, StorageError
        >>> data = xr.Dataset({"amplitude": ("belt_speed", [1.6, 1.7])})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "file"
        ...     file.touch()  # no folder
        ...     try:
        ...         Results(file, "mine").save("run", data)
        ...     except StorageError as error:
        ...         elsewhere = Results(Path(folder), "mine")
        ...         for name, kept in error.datasets.items():
        ...             elsewhere.save(name, kept)
        ...         print(error.reason, list(elsewhere.datasets))
        Not a directory ['run']
    """

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


class StudyFailedError(Exception):
    """The study ran to its end and its results are saved, but they are not as they must be.

    Also a run of a study that fails on the way; the message says which, and what to do.

    !!! example

        ```python
        try:
            run_scene(load_scene("edges"), folder)
        except StudyFailedError as error:
            print(error)
        ```
    """


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
