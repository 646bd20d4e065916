"""Running a scene: experiments -> datasets -> a folder of results.

Each dataset is written as soon as its experiment is done, before anything is drawn, so that
neither a later failure nor an interruption loses what was computed.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from .._limits import MOST_LANES
from ..boundaries.fold import find_fold
from ..boundaries.hopf import hopf_belt_speed
from ..cycles.branches import continue_cycle
from ..datasets import Variable, dataset, labelled
from ..model.cells import AbstractCells
from ..model.chain import Chain
from ..model.friction import AbstractFrictionLaw
from ..model.provenance import versions
from ..model.sliding import has_uniform_damping
from ..observers.base import AbstractObserver
from ..plotting.groups import CYCLES
from ..plotting.pages import figure
from ..sweeps.store import describe, stores_in
from ..sweeps.sweeping import SweepInterrupted, sweep
from .building import Built, Custom, build
from .files import SceneError, as_value, escaped, read_scene, to_toml
from .folder import Results, missing, now, unfinished, was_cut_off
from .report import PAGE, summary, write_page
from .scene import Experiment, Group, LoadedScene, Scene

# Descriptions of the numbers of a start, which a sweep does not have.
_OF_THE_START = {
    "displacement": ("how far excited masses are pulled away at the start", "x0"),
    "velocity": ("velocity of every mass at the start", "x0 omega_n"),
}


def run_scene(
    loaded: LoadedScene,
    folder: Path,
    *,
    custom_law: type[AbstractFrictionLaw] | None = None,
    custom_observers: Mapping[str, type[AbstractObserver]] | None = None,
    custom_models: Mapping[str, type[AbstractCells]] | None = None,
    plot: bool = True,
    netcdf: bool = False,
    progress: bool = False,
    report: Callable[[str], object] = print,
    command: str = "",
    custom_files: Sequence[Path] = (),
    client: Any = None,
) -> dict[str, xr.Dataset]:
    """Runs every experiment of a scene and fills `folder` with results.

    `<scene>.zarr` has each experiment as a group; open it with `xarray.open_datatree`.  For an
    experiment with both models the dry runs are the group `<experiment>_dry`.  For one oscillator
    from several starts over belt speed, the group `<experiment>_cycles` is the branch of cycles
    with its fold.  `<scene>.png` and `<scene>.pdf` show all of them, and `<scene>.toml` is a copy
    of the scene.  An experiment of many runs has a separate store (`numerics.store`), from which
    an interrupted run continues; results that do not fit into memory are only there.
    `report.html` summarises the folder, also after a failure or an interruption.

    In a folder with results of the same scene it goes on: finished runs are kept, missing ones are
    computed.

    **Arguments:** `loaded`, from `load_scene`, to go on from `load_scene(folder)`; `folder`, an
    existing one, empty (see `claimed`) or with such results; `custom_law`, a friction law
    for every experiment, with the numbers of the scene's law; `custom_observers`, by the names of
    their classes, for every experiment; `custom_models`, classes of cells by their names, for
    those whose `model.kind` names them; `plot`, whether to draw; `netcdf`, whether to also write
    `<scene>.nc`, which needs h5netcdf; `report`, a function that receives a summary of each
    experiment; `command`, the command line, and `custom_files`, copied into the folder, for the
    record; `client`, a `distributed.Client` whose workers run every experiment, into stores.

    **Returns:** the datasets by experiment.

    **Raises:** `KeyboardInterrupt` on Ctrl-C, after writing the finished runs; `StorageError` if
    something cannot be written, or if another process fills the folder; `FigureError` if only
    the figure fails; `StoreError` if a store cannot be written; `SceneError` for inconsistent
    numbers, and for a folder with results of another scene or version of jaxchain.

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
        ['quickstart.toml', 'quickstart.zarr', 'report.html']
        >>> found["ladder"].active_count.values.tolist()
        [[0.0, 1.0]]
    """
    custom = Custom(custom_law, custom_observers or {}, custom_models or {})
    run = _Run(loaded, folder, build(loaded, custom), report, progress, client)
    scene = as_run(loaded.scene, custom_law is not None, custom.observers)
    cut_off = was_cut_off(folder)
    if cut_off or stores_in(folder) or (folder / f"{loaded.name}.zarr").exists():
        with unfinished(folder, loaded.name):
            results = Results.reopen(folder, loaded.name)
            results.about |= _resumed(results, scene, command)
            if results.datasets:
                report(f"saved already: {', '.join(results.datasets)}")
            if not cut_off and not missing(folder, loaded.name, run.names, results.datasets):
                report("nothing is missing")
            return run.fill(results, scene, plot, netcdf)
    results = Results(folder, loaded.name, origin_attributes(command))
    files = scene_files(loaded.name, scene, results.about, custom_files)
    try:
        results.keep(files)
        return run.fill(results, scene, plot, netcdf)
    finally:
        if not results.store.exists() and not stores_in(folder):  # nothing was saved
            for name in files:
                (folder / name).unlink(missing_ok=True)


def _resumed(results: Results, scene: dict[str, Any], command: str) -> dict[str, str]:
    """The origin of results that are continued: of their first run, and of this one.

    **Raises:** `SceneError` if they are of another scene.
    """
    file = results.folder / f"{results.name}.toml"
    if not file.exists() or read_scene(str(file))[1] != scene:
        remedy = "`load_scene` of the folder has theirs, `claimed` finds another folder"
        problem = f"has other numbers than the results in {results.folder}: {remedy}"
        raise SceneError(results.name, [problem])
    about = origin_attributes(command)
    text = file.read_text(encoding="utf-8")
    first = re.findall(r'^# (command|started) = (".*")$', text, re.MULTILINE)
    about |= {"resumed": about["started"], "resumed_by": about["command"]}
    return about | {key: json.loads(value) for key, value in first}


@dataclass(frozen=True)
class _Run:
    """The run of a scene."""

    loaded: LoadedScene
    folder: Path
    built: Mapping[str, Built]
    report: Callable[[str], object]
    progress: bool
    client: Any

    @property
    def names(self) -> list[str]:
        """The names of its datasets."""
        return [group.name for group in self.loaded.scene.groups()]

    def fill(
        self, results: Results, scene: dict[str, Any], plot: bool, netcdf: bool
    ) -> dict[str, xr.Dataset]:
        """Runs and saves every group that is not saved yet, and draws the figure."""
        loaded, report = self.loaded, self.report
        whole = {"title": loaded.scene.title, "scene": loaded.name}
        results.about |= {"description": loaded.scene.description, **whole}
        before = list(results.datasets)
        try:
            for group in loaded.scene.groups():
                about = {
                    **whole,
                    "description": group.experiment.description,
                    "experiment": group.of,
                    "model": "dry" if self.built[group.of].model.dry else group.model,
                    "definition": json.dumps(scene["experiment"][group.of]),
                }
                if group.name not in results.datasets:
                    self.run_group(group, results, about)
                beside = group.of + CYCLES
                if group.model == "smoothed" and beside not in results.datasets:
                    branch = cycles(self.built[group.of].model, group.experiment.grid())
                    if branch is not None:
                        results.save(beside, branch.assign_attrs(about))
                        report(summary(beside, branch))
            if netcdf:
                results.write_netcdf()
            large = {name + CYCLES for name in results.stored}
            shown = {name: data for name, data in results.datasets.items() if name not in large}
            drawn = (results.folder / f"{loaded.name}.pdf").exists()  # the last file of a drawing
            if plot and shown and (list(results.datasets) != before or not drawn):
                results.draw(lambda: figure(shown))
        finally:
            _write_page(results, loaded)
        return results.datasets | results.stored

    def run_group(self, group: Group, results: Results, about: Mapping[str, str]) -> None:
        """Runs an experiment and saves it, or after an interruption its finished runs."""
        experiment, built = group.experiment, self.built[group.of]
        interrupt, store = None, None
        if experiment.stored() or self.client is not None:
            store = results.folder / f"{results.name}.{group.name}.zarr"
        try:
            with _located(results.name, f"experiment.{group.of}: "), warnings.catch_warnings():
                # The summary reports this in more detail.
                warnings.filterwarnings("ignore", message=r"\d+ of \d+ runs ended with")
                data = sweep(
                    built.model,
                    built.initial,
                    experiment.time.transient + experiment.time.window,
                    over=experiment.grid(),
                    observe=built.observe,
                    method=built.methods[group.model],
                    lanes=experiment.numerics.lanes,
                    client=self.client,
                    store=store,
                    progress=self.progress,
                    description=group.name,
                )
        except SweepInterrupted as stopped:
            if store is not None:
                raise
            data, interrupt = stopped.dataset, stopped
        data = _described(data, experiment, built).assign_attrs(about)
        hopf = hopf_speed(built.model, experiment.grid())
        data = data if hopf is None else data.assign(hopf_belt_speed=hopf)
        if store is not None:
            describe(store, about)
            if not built.fits_memory:
                results.stored[group.name] = data
                self.report(summary(group.name, data, store))
                return
            data = _in_memory(data)
        results.save(group.name, data)
        self.report(summary(group.name, data))
        if interrupt is not None:
            raise interrupt


def _described(data: xr.Dataset, experiment: Experiment, built: Built) -> xr.Dataset:
    """The quantities that a scene asks for, with words for what is swept of its start."""
    unwanted = {"amplitude", "energy", "active_count"} - set(experiment.observe.quantities)
    starts = _OF_THE_START
    if not experiment.is_chain:
        unwanted |= {f"{quantity}_{name}" for quantity in unwanted for name in built.variables}
        swept = set(experiment.sweep) - built.model.parameters().keys()
        starts = {name: (f"{name} at the start", "1") for name in swept}
    data = data.drop_vars(unwanted & set(data.data_vars))
    for name in starts.keys() & set(map(str, data.coords)):
        words, unit = starts[name]
        data[name].attrs |= {"long_name": words, "units": unit}
    return data


def _in_memory(data: xr.Dataset) -> xr.Dataset:
    """The dataset of a store in memory, without the encoding of its files."""
    read = data.load().copy()
    read.encoding = {}
    for variable in read.variables.values():
        kept = {name: variable.encoding.get(name) for name in ("dtype", "_FillValue")}
        variable.encoding = {name: value for name, value in kept.items() if value is not None}
    return read


def _write_page(results: Results, loaded: LoadedScene) -> None:
    """Writes the page for the saved results; a failure gives only a warning."""
    if results.store.exists() or stores_in(results.folder):
        try:
            write_page(results.folder, loaded.name, results.datasets, loaded)
        except OSError as error:
            why = error.strerror or error
            warnings.warn(f"cannot write {results.folder / PAGE}: {why}", stacklevel=2)


@contextlib.contextmanager
def _located(scene: str, where: str) -> Iterator[None]:
    """Adds the experiment to an error that appears only in a run, such as a width too small.

    **Raises:** `SceneError` for a `ValueError`; `MemoryError` with a remedy if memory is short.
    """
    try:
        yield
    except ValueError as error:
        raise SceneError(scene, [f"{where}{error}"]) from error
    except (MemoryError, RuntimeError) as error:
        # The compiler reports it as RESOURCE_EXHAUSTED.
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        more = "" if "fewer" in str(error) else ": take fewer values, masses or chains at once"
        raise MemoryError(f"{where}out of memory ({str(error)[:1000]}){more}") from error


def hopf_speed(
    chain: Chain | AbstractCells, grid: Mapping[str, np.ndarray]
) -> xr.DataArray | None:
    """The Hopf speed over the swept parameters of the chain other than the belt speed.

    None for cells, if no belt speed is swept, for parameters per mass, whose search needs
    eigenvalues, and for more combinations than fit into memory.
    """
    known = isinstance(chain, Chain) and has_uniform_damping(chain)
    if "belt_speed" not in grid or not known:
        return None
    swept = [name for name in grid if name in chain.parameters() and name != "belt_speed"]
    if math.prod(len(grid[name]) for name in swept) > MOST_LANES:
        return None
    axes = np.meshgrid(*(grid[name] for name in swept), indexing="ij")

    def speed(*values: jax.Array) -> jax.Array:
        return hopf_belt_speed(chain.with_(**dict(zip(swept, values, strict=True))))

    speeds = jnp.vectorize(speed)(*axes) if swept else speed()
    text = "Hopf speed v_H: above it steady sliding is stable"
    return xr.DataArray(labelled(Variable(speeds, tuple(swept), "x0 omega_n", text)))


def cycles(chain: Chain | AbstractCells, grid: Mapping[str, np.ndarray]) -> xr.Dataset | None:
    """All cycles of one oscillator with smoothed friction over the belt speed, through their fold.

    **Arguments:** `chain` and the swept values of the experiment that the cycles accompany.

    **Returns:** a dataset over `point`, from rest at the Hopf speed through the fold to
    stick-slip, with the attribute `cut_off` if it is not whole; None for anything but one
    oscillator, with a sweep over at least ten belt speeds and starts and no other parameter of the
    chain; or if its cycles do not fold.
    """
    swept = [name for name in grid if name in chain.parameters()]
    if not isinstance(chain, Chain) or chain.n != 1:
        return None
    if swept != ["belt_speed"] or len(grid) < 2 or len(grid["belt_speed"]) < 10:
        return None
    fold = find_fold(chain)
    if np.isnan(fold.belt_speed):
        return None
    # Down to where the runs begin; the sweep may lie above the fold altogether.
    lowest = min(max(float(np.min(grid["belt_speed"])), 0.05), 0.5 * float(fold.belt_speed))
    at_fold = chain.with_(belt_speed=fold.belt_speed), fold.state, fold.period
    # Lengths of the sides: on the slip cycles asinh(max w / eps) covers about asinh(v_d / eps).
    slipping = float(np.arcsinh(fold.belt_speed / chain.width)) + 3.0
    sides, cuts = [], []
    for direction, length, least in ("slip", slipping, 0.0), ("stick", 5.0, lowest):
        side = continue_cycle(
            *at_fold, direction=direction, step=length / 72, max_step=length / 72, max_points=73,
            bounds=(least, np.inf), keep_part=False,
        )  # fmt: skip
        sides.append(np.stack([side.parameter, side.amplitude[:, 0], side.period]))
        if side.ended != "left_bounds" and not side.of_kind("hopf"):
            last = f"{side.parameter[-1]:.6g}"
            cuts.append(f"The {direction} cycles end at belt speed {last}. {side.message}")
    slip, stick = sides
    # Steady sliding, with the period of the smallest cycle found.
    hopf = [[float(hopf_belt_speed(chain))], [0.0], slip[2:, -1]]
    rows = np.concatenate([hopf, slip[:, :0:-1], stick], axis=1)
    stable = np.arange(rows.shape[1]) > slip.shape[1]
    belt_speed, amplitude, period = rows
    each, top = ("point",), slip.shape[1]
    at_fold = "belt speed v_d of the fold"
    variables = {
        "stable": Variable(stable, each, None, "whether the cycle is stable"),
        "belt_speed": Variable(belt_speed, each, "x0 omega_n", "belt speed v_d"),
        "fold_belt_speed": Variable(belt_speed[top], (), "x0 omega_n", at_fold),
        "amplitude": Variable(amplitude, each, "x0", "amplitude A, half peak-to-peak"),
        "fold_amplitude": Variable(amplitude[top], (), "x0", "amplitude A at the fold"),
        "period": Variable(period, each, "1 / omega_n", "period"),
    }
    return dataset(variables, attrs={"cut_off": " ".join(cuts)} if cuts else None)


def origin_attributes(command: str = "") -> dict[str, str]:
    """The origin of results besides the scene, as attributes; `command` is the command line."""
    devices = jax.devices()
    return {
        # An argument may be bytes that are not text.
        "command": command.encode("utf-8", "backslashreplace").decode(),
        "started": now(),
        "devices": f"{len(devices)} x {devices[0].device_kind}",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "versions": json.dumps(versions()),
    }


def scene_files(
    name: str, scene: dict[str, Any], about: Mapping[str, str], custom_files: Sequence[Path] = ()
) -> dict[str, bytes]:
    """The files by name: `scene` (see `as_run`) with `about` as comments, and custom code."""
    head = [
        "# What was run: every number of the scene, with what the command line changed.",
        "# `jaxchain run` takes the folder of this file, or this file, and runs it again;",
        "# `jaxchain resume` takes the folder and continues a run that was cut off.",
        *(f'# {key} = "{escaped(text)}"' for key, text in about.items() if key != "versions"),
        f"# versions = {as_value(versions())}",
    ]
    files = {f"{name}.toml": "\n".join([*head, "", to_toml(scene), ""]).encode()}
    for file in custom_files:
        content, copy, count = file.read_bytes(), file.name, 1
        while files.get(copy, content) != content:
            count += 1
            copy = f"{file.stem}-{count}{file.suffix}"
        files[copy] = content
    return files


def as_run(
    scene: Scene,
    custom_law: bool = False,
    custom_observers: Mapping[str, Any] | Sequence[str] = (),
) -> dict[str, Any]:
    """The complete content of a scene file, with all defaults.

    A law given on the command line is marked as custom, and so are further observers, so that the
    next command line must name them again.
    """
    data = scene.model_dump(mode="json", exclude_none=True)
    for name, experiment in scene.experiment.items():
        table = data["experiment"][name]
        for owner in (table[experiment.of], *table[experiment.of].get("contacts", [])):
            law = owner.get("friction")
            if custom_law and isinstance(law, dict):
                numbers = {key: value for key, value in law.items() if key not in ("speed", "mu")}
                numbers = numbers if law["law"] == "tabulated" else law
                owner["friction"] = {**numbers, "law": "custom"}
        others = table["observe"].get("others", [])
        named = {other.get("name") for other in others}
        others += [{"observer": "custom", "name": k} for k in custom_observers if k not in named]
        if others:
            table["observe"]["others"] = others
    return data
