"""The study `ladder`: the branches of cycles behind the ladder of localized states.

Its parts: `patterns`, the locked patterns of phases and whether a cycle was found near each; one
for each branch, such as `k2_alternating`; `ensemble`, runs; `disturbed` and `dry`, the checks;
`couplings`, where the calmest cycles are stable.
"""

from __future__ import annotations

from collections.abc import Iterator

from xarray import Dataset

from jaxchain.model.initial_states import equation_8
from jaxchain.observers.amplitude import Amplitude
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.studies import _study
from jaxchain.studies.ladder.branches import catalogue, follow_rung, ring, rungs_of, stable_ends
from jaxchain.studies.ladder.checks import closing_errors, disturbed, dry_runs
from jaxchain.studies.ladder.figure import draw
from jaxchain.studies.ladder.report import LABELS, branches_of, summary
from jaxchain.studies.ladder.table import Study
from jaxchain.sweeps.sweeping import sweep


def _branches(study: Study, job: _study.Job) -> Iterator[tuple[str, Dataset]]:
    rungs = rungs_of(study)
    cycles, found = catalogue(rungs)
    yield "patterns", found
    chain = ring(study)
    with job.bar(unit="point") as bar:
        for rung, cycle in zip(rungs, cycles, strict=True):
            if not cycle.successful:
                continue
            bar.set_postfix_str(rung.key)
            for key, data in follow_rung(study, rung, cycle, lambda *_: bar.update()):
                data["residual"] = ("point", closing_errors(chain, data, study.walk.rtol))
                data["closing_error"] = ("point", closing_errors(chain, data))
                yield key, data
                if "interrupted" in (data.attrs["ended_up"], data.attrs["ended_down"]):
                    raise KeyboardInterrupt


def _ensemble(study: Study, job: _study.Job) -> Dataset:
    """Runs of eq. (8) with true dry friction, for every count of excited masses."""
    chain, own = ring(study), study.ensemble
    return sweep(
        chain, equation_8, own.transient + own.window,
        over={"belt_speed": own.belt_speed.array(), "excited": range(chain.n + 1)},
        observe=Amplitude(window=own.window), solver=EventDriven(), progress=job.progress,
        description="ensemble",
    )  # fmt: skip


def _couplings(study: Study, job: _study.Job) -> Dataset:
    couplings = job.bar(study.couplings.coupling, unit="coupling")
    rows = [row for coupling in couplings for row in stable_ends(study, coupling)]
    return _study.from_rows(rows, "pattern")


run = _study.Study(
    parts={
        "branches": _branches,
        "ensemble": _ensemble,
        "disturbed": lambda study, job: disturbed(study, branches_of(job.done)),
        "dry": lambda study, job: dry_runs(study, branches_of(job.done)),
        "couplings": _couplings,
    },
    labels=LABELS,
    report=summary,
    figure=draw,
)
