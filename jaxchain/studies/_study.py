"""What all studies do: each part is computed, described, saved and reported as it comes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from xarray import Dataset

from jaxchain._progress import progress_bar
from jaxchain.model.parameters import PARAMETERS
from jaxchain.result import NAMES
from jaxchain.scenes.errors import StudyFailedError
from jaxchain.scenes.pages.page import page_behind
from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.storage import Results

if TYPE_CHECKING:
    from tqdm import tqdm


@dataclass
class Job:
    """What a part may know beside the study's table."""

    name: str
    """Of the results."""
    progress: bool = False
    """Whether progress is shown: hand it on to `sweep`."""
    done: dict[str, Dataset] = field(default_factory=dict)
    """The datasets of this study so far."""

    def bar(
        self, items: Iterable | None = None, *, unit: str = "part", total: int | None = None
    ) -> tqdm:
        """A progress bar for what is no sweep: over `items`, or moved by its `update()`."""
        return progress_bar(items, desc=self.name, unit=unit, total=total, show=self.progress)


# One dataset, called as the part; or datasets by name, as they come.
Part = Callable[[Any, Job], Dataset | Iterable[tuple[str, Dataset]]]


@dataclass(frozen=True)
class Study:
    """A study as a function of its table and of a folder.

    **Arguments:** `parts`, by name what computes them, from the table and a `Job`, in this order:
    a function that returns a dataset, or a generator of names and datasets.  What a generator has
    handed over is saved, also if it then raises `KeyboardInterrupt`.  `labels`, see `label`, of
    what is not in `STANDARD`;
    `report`, from (name, dataset) to what is to be said of it, "" for nothing; `figure`, from all
    datasets to the page; `fault`, from all datasets to what is wrong with them, if anything is.

    Each dataset is a group of the results files.
    """

    parts: Mapping[str, Part]
    report: Callable[[str, Dataset], str]
    figure: Callable[[dict[str, Dataset]], Figure]
    labels: Mapping[str, Any] = field(default_factory=dict)
    fault: Callable[[dict[str, Dataset]], str | None] = lambda datasets: None

    def __call__(
        self,
        table: StudyTable,
        folder: Path | Results,
        *,
        name: str | None = None,
        plot: bool = True,
        progress: bool = False,
        report: Callable[[str], object] = print,
    ) -> dict[str, Dataset]:
        """Computes, saves, reports, draws, and writes `report.html`.

        **Arguments:** `table`, the study's file; `folder` exists and is empty; `name` of the
        results, that of the study if None.

        **Returns:** the datasets by name.

        **Raises:** `KeyboardInterrupt` on Ctrl-C, with everything saved that was done;
        `StorageError` if something cannot be saved; `FigureError` if everything is saved but the
        figure; `StudyFailedError` if everything is saved, but the datasets are not as they must
        be; `SceneError` for numbers that do not go together.
        """
        results = Results.of(folder, name or table.study)
        with contextlib.ExitStack() as stack:
            if results is not folder:  # a scene's run writes the page behind all that it does
                stack.enter_context(page_behind(results, table))
            return self._fill(table, results, plot, progress, report)

    def _fill(
        self,
        table: StudyTable,
        results: Results,
        plot: bool,
        progress: bool,
        report: Callable[[str], object],
    ) -> dict[str, Dataset]:
        job = Job(results.name, progress, results.datasets)
        own = {"title": table.title, "description": table.description, "scene": job.name}
        results.about |= own
        for part, compute in self.parts.items():
            found = compute(table, job)
            for key, data in [(part, found)] if isinstance(found, Dataset) else found:
                label(data, STANDARD | dict(self.labels))
                data.attrs |= own | {"definition": table.model_dump_json(exclude_none=True)}
                results.save(key, data)
                if said := self.report(key, data):
                    report(said)
        if plot:
            results.draw(lambda: self.figure(job.done))
        if wrong := self.fault(job.done):
            raise StudyFailedError(wrong)
        return job.done


def label(data: Dataset, labels: Mapping[str, Any]) -> None:
    """Describes the variables and coordinates of `data` of which `labels` knows, in place.

    A label is a long name, or a long name and units, or a mapping of attributes.
    """
    for name in labels.keys() & set(map(str, data.variables)):
        own = labels[name]
        if not isinstance(own, Mapping):
            texts = (own,) if isinstance(own, str) else own
            own = dict(zip(("long_name", "units"), texts, strict=False))
        data[name].attrs |= own


def flags(names: Sequence[str], first: int = 0) -> dict[str, Any]:
    """The label of a variable of codes: `first` for the first of `names`, and so on."""
    values = np.arange(first, first + len(names))
    meanings = " ".join(name.replace(" ", "_") for name in names)
    return {"flag_values": values, "flag_meanings": meanings}


def from_rows(rows: Sequence[Mapping[str, Any]], dim: str, *more: str) -> Dataset:
    """Rows of numbers and names as a dataset over `dim`, and over `more` where they are arrays.

    >>> from_rows([{"speed": 1.0, "name": "a"}, {"speed": 2.0, "name": "b"}], "case")["speed"].dims
    ('case',)
    """
    columns = {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else {})}
    return Dataset({name: ((dim, *more)[: own.ndim], own) for name, own in columns.items()})


RESULT = flags(NAMES)
# What needs no label of a study's own: numbers of the chain, oscillators, how a run ended.
STANDARD = {name: row.attrs for name, row in PARAMETERS.items()} | {
    "result": RESULT, "oscillator": ("oscillator n", "1"),
}  # fmt: skip
