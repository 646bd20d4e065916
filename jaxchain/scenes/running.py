"""Runs a scene: experiments -> datasets -> a folder of results.

Each dataset is written as soon as its experiment is done, before anything is drawn, so that
neither a later failure nor an interruption loses what was computed.
"""

from __future__ import annotations

import functools
import itertools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from .._types import ScalarLike, State
from ..model import friction, initial_states
from ..model.chain import Chain
from ..observers.amplitude import Amplitude
from ..plotting.groups import NONSMOOTH
from ..plotting.style import save_figure
from ..plotting.sweeps import figure
from ..simulation.accuracy import fit_linear_solve
from ..simulation.event_driven import EventDriven
from ..solvers.rosenbrock import Rodas4, Rodas5P
from ..sweeps.sweeping import SweepInterrupted, sweep
from .errors import FigureError, SceneError
from .reading import LoadedScene
from .registry import StudyTable, study_run
from .scene import CHAIN_NUMBERS, Experiment
from .summary import summary
from .tables import Equation8Table, Equation10Table

LAWS = {
    "exponential_decay": friction.ExponentialDecay,
    "weakening_strengthening": friction.WeakeningStrengthening,
    "coulomb": friction.Coulomb,
}


def build_chain(experiment: Experiment) -> Chain:
    """The chain of an experiment, with the first value of everything that is swept."""
    table, grid = experiment.chain, experiment.grid()

    def number(name: str, given: float | list[float] | None) -> Any:
        if name in grid:
            return float(grid[name][0])
        return np.array(given, float) if isinstance(given, list) else given

    law = {k: number(k, getattr(table.friction, k)) for k in experiment.friction_numbers()}
    width = law.pop("width")
    return Chain(
        table.n,
        friction.TanhFriction(LAWS[table.friction.law](**law), width),
        ends=table.ends,
        **{name: number(name, getattr(table, name)) for name in CHAIN_NUMBERS},
    )


def build_initial(experiment: Experiment) -> Callable[..., State]:
    """The initial state as a function of the chain; what is swept are parameters of it."""
    table = experiment.initial
    excited: dict[str, Any] = {} if table.excited is None else {"excited": table.excited}
    if isinstance(table, Equation8Table):
        return functools.partial(initial_states.equation_8, block=table.block, **excited)
    if isinstance(table, Equation10Table):
        return functools.partial(
            initial_states.equation_10, block=table.block, reading=table.reading, **excited
        )
    who: Any = table.excited
    if table.oscillators is not None:
        mask = np.isin(np.arange(1, experiment.chain.n + 1), table.oscillators)
        who = jnp.asarray(mask)

    def pulled_away(
        chain: Chain,
        excited: Any = who,
        displacement: ScalarLike = table.displacement,
        velocity: ScalarLike = table.velocity,
    ) -> State:
        return initial_states.excited_state(
            chain,
            excited,
            amplitude=displacement,
            velocity=velocity,
            block=table.block,
            pattern=table.pattern,
        )

    return pulled_away


def build_solver(
    name: str, chain: Chain, rtol: float, max_step: float
) -> dfx.AbstractSolver | None:
    """A solver by its name in a scene; None leaves the choice to `sweep`."""
    if name == "auto":
        return None
    own = {"Rodas4": Rodas4, "Rodas5P": Rodas5P}
    if name in own:
        return fit_linear_solve(own[name](), chain, rtol, max_step)
    return getattr(dfx, name)()


def models(experiment: Experiment) -> tuple[str, ...]:
    """ "smoothed", "nonsmooth" or both, in the order in which they are run."""
    model = experiment.numerics.model
    return ("smoothed", "nonsmooth") if model == "both" else (model,)


def run_experiment(
    experiment: Experiment,
    *,
    name: str = "sweep",
    model: str = "smoothed",
    progress: bool = False,
) -> xr.Dataset:
    """Runs one experiment with smoothed or with true dry friction.

    Failed runs are marked in `result` and warn of nothing.

    **Raises:** `SweepInterrupted` on Ctrl-C, with the runs that had ended.
    """
    numerics, observe, time = experiment.numerics, experiment.observe, experiment.time
    chain = build_chain(experiment)
    if model == "nonsmooth":
        solver = EventDriven()
    else:
        solver = build_solver(numerics.solver, chain, numerics.rtol, numerics.max_step)
    with warnings.catch_warnings():
        # The summary says it better.
        warnings.filterwarnings("ignore", message=r"\d+ of \d+ lanes ended with")
        return sweep(
            chain,
            build_initial(experiment),
            time.transient + time.window,
            over=experiment.grid(),
            observe=Amplitude(
                window=time.window,
                stop=observe.stop,
                tolerance=observe.tolerance,
                repeats=observe.repeats,
                quiet_below=observe.quiet_below,
            ),
            solver=solver,
            rtol=numerics.rtol,
            atol=numerics.atol,
            max_step=numerics.max_step,
            max_steps=numerics.max_steps,
            lanes=numerics.lanes,
            progress=progress,
            description=name,
        )


def new_folder(path: Path) -> Path:
    """Creates a folder for results that nothing else has used: `path`, or `path`-2, `path`-3, ...

    An empty folder counts as unused.

    **Raises:** `OSError` if no folder can be made there.
    """
    for count in itertools.count(1):
        folder = path if count == 1 else path.with_name(f"{path.name}-{count}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            if not folder.is_dir() or any(folder.iterdir()):
                continue
        return folder
    raise AssertionError  # the count never ends


def save(data: xr.Dataset, path: Path, group: str | None) -> None:
    """Writes `data` into `path`.zarr and `path`.nc, at the root (None) or as a group."""
    zarr_file, netcdf_file = path.with_name(path.name + ".zarr"), path.with_name(path.name + ".nc")
    # Format 2 is what other tools read, and what has consolidated metadata.
    data.to_zarr(zarr_file, group=group, mode="a", zarr_format=2, consolidated=True)
    data.to_netcdf(
        netcdf_file, group=group, mode="a" if netcdf_file.exists() else "w", engine="h5netcdf"
    )


def save_drawing(draw: Callable[[], Figure], path: Path) -> None:
    """Draws and writes `path`.png and `path`.pdf, once everything else is written.

    **Raises:** `FigureError` if that fails.
    """
    try:
        save_figure(draw(), path)
    except Exception as error:
        raise FigureError(
            f"the results are in {path.parent}, but drawing them failed: {error!r}"
        ) from error


def run_scene(
    loaded: LoadedScene,
    folder: Path,
    *,
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, xr.Dataset]:
    """Runs every experiment of a scene, or a study, and fills `folder` with results.

    `<scene>.zarr` and `<scene>.nc` hold the main experiment at the root and the others as groups;
    of an experiment with both models the runs with true dry friction are the group
    `<experiment>_nonsmooth`.
    `<scene>.png` and `<scene>.pdf` show all of them.

    **Arguments:** `folder` exists and is empty (see `new_folder`); `plot`, draw the figure;
    `progress`, show a progress bar; `report` receives the summary of each experiment.

    **Returns:** the datasets by experiment.

    **Raises:** `KeyboardInterrupt` on Ctrl-C, once the runs that had ended are written;
    `FigureError` if everything is written but the figure; `StudyFailedError` if everything is
    written but a study found what must not be; `SceneError` for numbers that do not go together.
    """
    if isinstance(loaded.scene, StudyTable):
        return study_run(loaded.scene.study)(
            loaded.scene, folder, name=loaded.name, plot=plot, progress=progress, report=report
        )
    path = folder / loaded.name
    datasets = {}
    for name, experiment in loaded.scene.experiment.items():
        for model in models(experiment):
            # Of two models the smoothed one goes by the name of the experiment.
            second = model == "nonsmooth" and experiment.numerics.model == "both"
            group = f"{name}{NONSMOOTH}" if second else name
            try:
                data = run_experiment(experiment, name=group, model=model, progress=progress)
                interrupt = None
            except SweepInterrupted as stopped:
                data, interrupt = stopped.dataset, stopped
            except ValueError as error:
                # What only the numbers together show: a width too small for the tolerance.
                problem = f"experiment.{name}: {error}"
                raise SceneError(loaded.name, [problem]) from error
            unwanted = {"amplitude", "energy", "active_count"} - set(experiment.observe.quantities)
            kept = data.drop_vars(unwanted & set(data.data_vars))
            kept.attrs |= {
                "title": loaded.scene.title,
                "description": experiment.description,
                "scene": loaded.name,
                "experiment": name,
                "model": model,
                "definition": experiment.model_dump_json(exclude_none=True),
            }
            save(kept, path, None if group == loaded.scene.main else group)
            report(summary(group, kept))
            if interrupt is not None:
                raise interrupt
            datasets[group] = kept
    if plot:
        save_drawing(lambda: figure(datasets), path)
    return datasets
