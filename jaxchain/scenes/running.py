"""Runs a scene: experiments -> datasets -> a folder of results.

Each dataset is written as soon as its experiment is done, before anything is drawn, so that
neither a later failure nor an interruption loses what was computed.
"""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from .._types import State
from ..model.chain import Chain
from ..model.friction import AbstractFrictionLaw
from ..observers.base import AbstractObserver
from ..plotting.groups import CYCLES, NONSMOOTH
from ..plotting.sweeps import figure
from ..simulation.event_driven import EventDriven
from ..sweeps.sweeping import SweepInterrupted, sweep
from .boundaries import cycles, hopf_speed
from .building import (
    build_chain,
    build_initial,
    build_observers,
    build_solver,
    check_experiment,
)
from .errors import SceneError, StudyFailedError, shortened
from .observing import ObserveTable
from .reading import LoadedScene
from .registry import StudyTable, study_run
from .report import cycles_summary, summary
from .scene import Experiment, SweepTable
from .storage import Results
from .tables import NumericsTable
from .writing import as_run, circumstances, scene_files

# Of an error from elsewhere.
_CHARACTERS = 1000


def models(numerics: NumericsTable) -> tuple[str, ...]:
    """ "smoothed", "nonsmooth" or both, in the order in which they are run."""
    return ("smoothed", "nonsmooth") if numerics.model == "both" else (numerics.model,)


def run_experiment(
    experiment: SweepTable,
    *,
    name: str = "sweep",
    model: str = "smoothed",
    own_law: type[AbstractFrictionLaw] | None = None,
    own_observers: Mapping[str, type[AbstractObserver]] | None = None,
    progress: bool = False,
    initial: Callable[..., State] | None = None,
    observe: Any = None,
) -> xr.Dataset:
    """Runs one experiment with smoothed or with true dry friction.

    Failed runs are marked in `result` and warn of nothing.

    **Arguments:** `initial`, `observe`: instead of what the experiment says.

    **Raises:** `SweepInterrupted` on Ctrl-C, with the runs that had ended.
    """
    numerics, time = experiment.numerics, experiment.time
    chain = build_chain(experiment, own_law)
    if observe is None:
        table = experiment.observe if isinstance(experiment, Experiment) else ObserveTable()
        observe = build_observers(table, time.window, own_observers)
    if model == "nonsmooth":
        solver = EventDriven()
    else:
        solver = build_solver(numerics.solver, chain, numerics.rtol, numerics.max_step)
    with warnings.catch_warnings():
        # The summary says it better.
        warnings.filterwarnings("ignore", message=r"\d+ of \d+ lanes ended with")
        return sweep(
            chain,
            build_initial(experiment) if initial is None else initial,
            time.transient + time.window,
            over=experiment.grid(),
            observe=observe,
            solver=solver,
            **numerics.model_dump(exclude={"solver", "model"}),
            progress=progress,
            description=name,
        )


@contextlib.contextmanager
def in_words(scene: str, where: str = "") -> Iterator[None]:
    """Says where an error is that only a run shows: a width too small, say, or too little memory.

    **Raises:** `SceneError` for a `ValueError`; `MemoryError` with a remedy for want of memory;
    `StudyFailedError` for a run that fails.
    """
    try:
        yield
    except ValueError as error:
        raise SceneError(scene, [f"{where}{error}"]) from error
    except MemoryError as error:
        raise MemoryError(_short_of_memory(where, error)) from error
    except RuntimeError as error:
        if "RESOURCE_EXHAUSTED" in str(error):  # how the compiler says it
            raise MemoryError(_short_of_memory(where, error)) from error
        raise StudyFailedError(f"{where}{shortened(str(error), _CHARACTERS)}") from error


def _short_of_memory(where: str, error: Exception) -> str:
    said = shortened(str(error), _CHARACTERS)
    if "fewer" in said:
        return f"{where}{said}"
    return (
        f"{where}out of memory{f' ({said})' if said else ''}: take fewer values, masses or chains "
        "at once"
    )


def checked_chains(
    loaded: LoadedScene,
    own_law: type[AbstractFrictionLaw] | None = None,
    own_observers: Mapping[str, type[AbstractObserver]] | None = None,
) -> dict[str, Chain]:
    """The chain of every experiment of a scene.

    **Raises:** `SceneError` with everything that cannot be run, before anything is.
    """
    chains, problems = {}, []
    for name, experiment in loaded.scene.experiment.items():
        try:
            chains[name] = chain = build_chain(experiment, own_law)
            window = experiment.time.window
            observe = build_observers(experiment.observe, window, own_observers)
            check_experiment(experiment, chain, observe)
        except ValueError as error:
            problems.append(f"experiment.{name}: {error}")
    if problems:
        raise SceneError(loaded.name, problems)
    return chains


def run_scene(
    loaded: LoadedScene,
    folder: Path | Results,
    *,
    own_law: type[AbstractFrictionLaw] | None = None,
    own_observers: Mapping[str, type[AbstractObserver]] | None = None,
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
    command: str = "",
    own_files: Sequence[Path] = (),
) -> dict[str, xr.Dataset]:
    """Runs every experiment of a scene, or a study, and fills `folder` with results.

    `<scene>.zarr` and `<scene>.nc` hold each experiment as a group, to be opened by
    `xarray.open_datatree`; of an experiment with both models the runs with true dry friction are
    the group `<experiment>_nonsmooth`.  Of one oscillator from several starts over belt speed,
    the branch of cycles with its fold is the group `<experiment>_cycles`.
    `<scene>.png` and `<scene>.pdf` show all of them.  `<scene>.toml` is what was run (see
    `jaxchain.scenes.writing`).

    **Arguments:** `folder` exists and is empty (see `claimed`); `own_law`, the friction law of
    every experiment, in place of the one that is named there (see `load_law`); `own_observers`, by
    the names of their classes (see `load_observer`); `plot`, draw the figure; `progress`, show a
    progress bar; `report` receives the summary of each experiment; `command`, the command line,
    and `own_files`, of which copies are kept, for whoever runs it again.

    **Returns:** the datasets by experiment.

    **Raises:** `KeyboardInterrupt` on Ctrl-C, once the runs that had ended are written;
    `StorageError` if something cannot be written; `FigureError` if everything is written but the
    figure; `StudyFailedError` if everything is written but a study found what must not be;
    `SceneError` for numbers that do not go together.
    """
    scene, chains = loaded.scene, {}
    if isinstance(scene, StudyTable):
        for option, given in (("--law", own_law), ("--observer", own_observers)):
            if given:
                raise SceneError(loaded.name, [f"{option}: is for scenes, and this is a study"])
    else:
        chains = checked_chains(loaded, own_law, own_observers)
    results, around = Results.of(folder, loaded.name), circumstances(command)
    results.about |= {"title": scene.title, "description": scene.description}
    results.about |= {"scene": loaded.name, **around}
    run = as_run(scene, own_law is not None, own_observers or ())
    results.keep(scene_files(loaded.name, run, around, own_files))
    if isinstance(scene, StudyTable):
        with in_words(loaded.name):
            return study_run(scene.study)(
                scene, results, name=loaded.name, plot=plot, progress=progress, report=report
            )
    for name, experiment in scene.experiment.items():
        chain, grid = chains[name], experiment.grid()
        hopf = hopf_speed(chain, grid)
        for model in models(experiment.numerics):
            # Of two models the smoothed one goes by the name of the experiment.
            second = model == "nonsmooth" and experiment.numerics.model == "both"
            group = f"{name}{NONSMOOTH}" if second else name
            try:
                with in_words(loaded.name, f"experiment.{name}: "):
                    data = run_experiment(
                        experiment, name=group, model=model, own_law=own_law,
                        own_observers=own_observers, progress=progress,
                    )  # fmt: skip
                interrupt = None
            except SweepInterrupted as stopped:
                data, interrupt = stopped.dataset, stopped
            unwanted = {"amplitude", "energy", "active_count"} - set(experiment.observe.quantities)
            kept = data.drop_vars(unwanted & set(data.data_vars))
            about = {
                "title": scene.title,
                "description": experiment.description,
                "scene": loaded.name,
                "experiment": name,
                "model": model,
                "definition": json.dumps(run["experiment"][name]),
            }
            kept.attrs |= about
            if hopf is not None:
                kept["hopf_belt_speed"] = hopf
            results.save(group, kept)
            report(summary(group, kept))
            if interrupt is not None:
                raise interrupt
            if model == "smoothed" and (branch := cycles(chain, grid)) is not None:
                branch = branch.assign_attrs(about)
                results.save(name + CYCLES, branch)
                report(cycles_summary(name + CYCLES, branch))
    if plot:
        results.draw(lambda: figure(results.datasets))
    return results.datasets
