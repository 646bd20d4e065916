"""The study `ladder`: the branches of cycles behind the ladder of localized states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxchain.studies.ladder.table import Study

if TYPE_CHECKING:
    from xarray import Dataset


def run(
    study: Study,
    folder: Path,
    *,
    name: str = "ladder",
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, Dataset]:
    """Computes, saves each part as soon as it is done, reports and draws.

    **Returns:** datasets by part: `patterns`, the locked patterns of phases and whether a cycle
    was found near each; one for each branch, such as `k2_alternating`; `ensemble`; `couplings`;
    `disturbed` and `dry`, the checks.  In the results files the first is the root.

    **Raises:** `KeyboardInterrupt` on Ctrl-C, with all parts that were done, and the branch under
    way, saved; `jaxchain.scenes.errors.FigureError`.
    """
    from tqdm import tqdm

    from jaxchain.scenes.storage import save, save_drawing
    from jaxchain.studies.ladder.figure import draw
    from jaxchain.studies.ladder.report import summary

    datasets: dict[str, Dataset] = {}
    with tqdm(desc=name, unit="point", disable=not progress) as bar:
        for key, data in _parts(study, datasets, bar):
            data.attrs |= {
                "title": study.title, "scene": name, "definition": study.model_dump_json()
            }  # fmt: skip
            save(data, folder / name, key if datasets else None)
            datasets[key] = data
            if "interrupted" in (data.attrs.get("ended_up"), data.attrs.get("ended_down")):
                raise KeyboardInterrupt
    report(summary(datasets))
    if plot:
        save_drawing(lambda: draw(datasets), folder / name)
    return datasets


def _parts(study: Study, done: dict[str, Dataset], bar: Any) -> Iterator[tuple[str, Dataset]]:
    """Each part and its name, in the order in which they are computed."""
    from jaxchain.studies.ladder.branches import catalogue, follow_rung, ring, rungs_of
    from jaxchain.studies.ladder.checks import closing_errors, disturbed, dry_runs, table
    from jaxchain.studies.ladder.ends import ensemble, stable_ends

    def tick(*_: Any) -> None:
        bar.update()

    model, rungs = rungs_of(study)
    cycles, found = catalogue(model, rungs)
    yield "patterns", found
    chain = ring(study)
    for rung, cycle in zip(rungs, cycles, strict=True):
        if cycle.converged:
            bar.set_postfix_str(rung.key)
            for key, data in follow_rung(study, rung, cycle, tick):
                data["residual"] = ("point", closing_errors(chain, data, study.walk.rtol))
                data["closing_error"] = ("point", closing_errors(chain, data))
                yield key, data
    branches = {key: data for key, data in done.items() if key != "patterns"}
    yield "ensemble", ensemble(chain, study.ensemble)
    yield "disturbed", disturbed(chain, branches, study.checks)
    yield "dry", dry_runs(chain, branches, study.checks)
    ends: list[dict[str, Any]] = []
    for coupling in study.couplings.coupling:
        bar.set_postfix_str(f"coupling {coupling:g}")
        ends += stable_ends(study, coupling)
    yield "couplings", table(ends, "pattern")
