"""Runs a scene: experiments -> datasets -> a folder of results.

Each dataset is written as soon as its experiment is done, before anything is drawn, so that
neither a later failure nor an interruption loses what was computed.
"""

from __future__ import annotations

import contextlib
import dataclasses
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
from ..plotting.groups import CYCLES
from ..plotting.sweeps import figure
from ..simulation.event_driven import EventDriven
from ..sweeps.store import StoreError, describe, in_lines, read_layout, status_of, stores_in
from ..sweeps.sweeping import SweepInterrupted, sweep
from .boundaries import cycles, hopf_speed
from .building import (
    build_chain,
    build_initial,
    build_observers,
    build_solver,
    checked_chains,
    describe_start,
)
from .errors import SceneError, StudyFailedError, shortened
from .folders.datasets import in_memory
from .folders.groups import Group, all_stored, groups_of
from .observing import ObserveTable
from .pages.page import page_behind
from .reading import LoadedScene
from .registry import StudyTable, study_run
from .report import cycles_summary, stored_summary, summary
from .scene import Experiment, SweepTable
from .storage import Results
from .writing import as_run, circumstances, scene_files

# Of an error from elsewhere.
_CHARACTERS = 1000


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
    store: Path | None = None,
    client: Any = None,
) -> xr.Dataset:
    """Runs one experiment with smoothed or with true dry friction.

    Failed runs are marked in `result` and warn of nothing.

    **Arguments:** `experiment`, one of a scene; `name`, of the progress bar; `model`, "smoothed"
    or "nonsmooth"; `own_law`, `own_observers`, `progress` as for `run_scene`; `initial`,
    `observe`: instead of what the experiment says; `store`, `client`: as for `sweep`.

    **Returns:** the dataset of `sweep`.

    **Raises:** `SweepInterrupted` on Ctrl-C, with the runs that had ended.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.scenes import load_scene, run_experiment
        >>> small = "chain.n=3", "sweep.belt_speed=[1.5]", "sweep.excited=[0, 1]"  # seconds
        >>> scene = load_scene("quickstart", [f"experiment.ladder.{key}" for key in small]).scene
        >>> data = run_experiment(scene.experiment["ladder"])
        >>> data.active_count.values.tolist(), data.sizes["oscillator"]
        ([[0.0, 1.0]], 3)
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
            **numerics.model_dump(exclude={"solver", "model", "store"}),
            **({} if client is None else {"client": client}),
            store=store,
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
    except StoreError:  # says it all
        raise
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
    client: Any = None,
) -> dict[str, xr.Dataset]:
    """Runs every experiment of a scene, or a study, and fills `folder` with results.

    `<scene>.zarr` and `<scene>.nc` hold each experiment as a group, to be opened by
    `xarray.open_datatree`; of an experiment with both models the runs with true dry friction are
    the group `<experiment>_nonsmooth`.  Of one oscillator from several starts over belt speed,
    the branch of cycles with its fold is the group `<experiment>_cycles`.
    `<scene>.png` and `<scene>.pdf` show all of them.  `<scene>.toml` is what was run (see
    `scenes/writing.py`).  An experiment of many runs has a store of its own beside them
    (`StoredNumericsTable.store`), from which a run that was cut off goes on; what does not fit
    into memory stays there alone.  `report.html` tells all of this to people, also of a run that
    failed or was interrupted.

    **Arguments:** `folder` exists and is empty (see `claimed`); `own_law`, the friction law of
    every experiment, in place of the one that is named there (see `load_law`); `own_observers`, by
    the names of their classes (see `load_observer`); `plot`, draw the figure; `progress`, show a
    progress bar; `report` receives the summary of each experiment; `command`, the command line,
    and `own_files`, of which copies are kept, for whoever runs it again; `client`, a
    `distributed.Client` whose workers run every experiment, into stores.

    **Returns:** the datasets by experiment.

    **Raises:** `KeyboardInterrupt` on Ctrl-C, once the runs that had ended are written;
    `StorageError` if something cannot be written; `FigureError` if everything is written but the
    figure; `StudyFailedError` if everything is written but a study found what must not be;
    `StoreError` if a store cannot be written, which `resume_scene` goes on with; `SceneError`
    for numbers that do not go together.

    !!! example

        >>> import jax, tempfile
        >>> jax.config.update("jax_enable_x64", True)
        >>> from pathlib import Path
        >>> from jaxchain.scenes import load_scene, run_scene
        >>> small = "chain.n=3", "sweep.belt_speed=[1.5]", "sweep.excited=[0, 1]"  # seconds
        >>> scene = load_scene("quickstart", [f"experiment.ladder.{key}" for key in small])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = run_scene(scene, Path(folder), plot=False, report=lambda summary: None)
        ...     print(sorted(file.name for file in Path(folder).iterdir()))
        ['quickstart.nc', 'quickstart.toml', 'quickstart.zarr', 'report.html']
        >>> found["ladder"].active_count.values.tolist()
        [[0.0, 1.0]]
    """
    scene, chains = loaded.scene, {}
    if isinstance(scene, StudyTable):
        given = {"--law": own_law, "--observer": own_observers, "--workers": client}
        if wrong := [option for option, value in given.items() if value]:
            raise SceneError(loaded.name, [f"{wrong[0]}: is for scenes, and this is a study"])
    else:
        if client is not None:
            scene = all_stored(scene)
            loaded = dataclasses.replace(loaded, scene=scene)
        chains = checked_chains(loaded, own_law, own_observers)
    results, around = Results.of(folder, loaded.name), circumstances(command)
    results.about |= {"title": scene.title, "description": scene.description}
    results.about |= {"scene": loaded.name, **around}
    run = as_run(scene, own_law is not None, own_observers or ())
    with contextlib.ExitStack() as stack:
        results.keep(scene_files(loaded.name, run, around, own_files))
        stack.enter_context(page_behind(results, scene))
        if isinstance(scene, StudyTable):
            with in_words(loaded.name):
                return study_run(scene.study)(
                    scene, results, name=loaded.name, plot=plot, progress=progress, report=report
                )
        with _to_go_on(results):
            fill(
                loaded, results, chains, own_law=own_law, own_observers=own_observers,
                progress=progress, report=report, client=client,
            )  # fmt: skip
        if plot:
            draw(results)
    return results.datasets | results.stored


@contextlib.contextmanager
def _to_go_on(results: Results) -> Iterator[None]:
    """What is cut off within it leaves its stores, if it has any, and a mark beside them."""
    folder = results.folder
    try:
        yield
    except BaseException:
        if stores_in(folder):
            results.unfinished.add(folder)
        raise


def fill(
    loaded: LoadedScene,
    results: Results,
    chains: Mapping[str, Chain],
    *,
    own_law: type[AbstractFrictionLaw] | None,
    own_observers: Mapping[str, type[AbstractObserver]] | None,
    progress: bool,
    report: Callable[[str], object],
    client: Any,
) -> None:
    """Runs and saves every group of a scene that is not saved yet."""
    scene = loaded.scene
    run = as_run(scene, own_law is not None, own_observers or ())
    for group in groups_of(scene):
        chain, grid = chains[group.of], group.experiment.grid()
        about = {
            "title": scene.title,
            "description": group.experiment.description,
            "scene": loaded.name,
            "experiment": group.of,
            "model": group.model,
            "definition": json.dumps(run["experiment"][group.of]),
        }
        if group.name not in results.datasets:

            def runs(store: Path | None, group: Group = group) -> xr.Dataset:
                with in_words(loaded.name, f"experiment.{group.of}: "):
                    return run_experiment(
                        group.experiment, name=group.name, model=group.model, own_law=own_law,
                        own_observers=own_observers, progress=progress, store=store, client=client,
                    )  # fmt: skip

            hopf = hopf_speed(chain, grid)
            store = group.store(results.folder, loaded.name)
            if store is None:
                _keep(group, runs, about, hopf, results, report)
            else:
                _keep_stored(group, runs, store, about, hopf, results, report)
        if group.model == "smoothed" and group.of + CYCLES not in results.datasets:
            branch = cycles(chain, grid)
            if branch is not None:
                branch = branch.assign_attrs(about)
                results.save(group.of + CYCLES, branch)
                report(cycles_summary(group.of + CYCLES, branch))


def _keep(
    group: Group,
    runs: Callable[[Path | None], xr.Dataset],
    about: Mapping[str, str],
    hopf: xr.DataArray | None,
    results: Results,
    report: Callable[[str], object],
) -> None:
    """Runs an experiment in memory and saves it; once it is interrupted, what has ended."""
    interrupt = None
    try:
        data = runs(None)
    except SweepInterrupted as stopped:
        # Who goes on has no use for a part.
        if results.reopened or stores_in(results.folder):
            raise
        data, interrupt = stopped.dataset, stopped
    kept = _with_about(data, group, about, hopf)
    results.save(group.name, kept)
    report(summary(group.name, kept))
    if interrupt is not None:
        raise interrupt


def _keep_stored(
    group: Group,
    runs: Callable[[Path | None], xr.Dataset],
    store: Path,
    about: Mapping[str, str],
    hopf: xr.DataArray | None,
    results: Results,
    report: Callable[[str], object],
) -> None:
    """Fills the store of an experiment, and saves it beside others where it fits into memory."""
    try:
        data = runs(store)
        describe(store, about)
    except BaseException:
        if read_layout(store) is not None:
            report(in_lines(status_of(store)))
        raise
    kept = _with_about(data, group, about, hopf)
    if group.experiment.fits_memory():
        kept = in_memory(kept)
        results.save(group.name, kept)
        report(summary(group.name, kept))
    else:
        results.stored[group.name] = kept
        report(stored_summary(group.name, kept, status_of(store)))


def _with_about(
    data: xr.Dataset, group: Group, about: Mapping[str, str], hopf: xr.DataArray | None
) -> xr.Dataset:
    """What the experiment asks for, and where it comes from."""
    unwanted = {"amplitude", "energy", "active_count"} - set(group.experiment.observe.quantities)
    kept = data.drop_vars(unwanted & set(data.data_vars))
    kept.attrs |= about
    describe_start(kept)
    if hopf is not None:
        kept["hopf_belt_speed"] = hopf
    return kept


def draw(results: Results) -> None:
    """The figure of everything that fits into memory, if anything does."""
    shown = {
        name: data
        for name, data in results.datasets.items()
        if name.removesuffix(CYCLES) not in results.stored
    }
    if shown:
        results.draw(lambda: figure(shown))
