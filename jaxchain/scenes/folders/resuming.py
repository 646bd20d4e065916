"""A run that was cut off goes on, in its own folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ...model.friction import AbstractFrictionLaw
from ...observers.base import AbstractObserver
from ..building import checked_chains
from ..errors import SceneError, StorageError
from ..pages.page import page_behind
from ..reading import LoadedScene
from ..registry import StudyTable
from ..running import draw, fill
from ..storage import Results
from ..writing import circumstances, circumstances_before
from .groups import all_stored
from .saving import MARKER, filled


def resume_scene(
    loaded: LoadedScene,
    folder: Path,
    *,
    own_law: type[AbstractFrictionLaw] | None = None,
    own_observers: Mapping[str, type[AbstractObserver]] | None = None,
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
    command: str = "",
    client: Any = None,
) -> None:
    """Goes on with the run that filled `folder`.

    **Arguments:** `loaded`, what was run there, as `load_scene(folder)` reads it; the rest as for
    `run_scene`.

    **Raises:** as `run_scene`; `SceneError` for a study, and where a store belongs to another
    version of jaxchain or of the scene.

    !!! example

        >>> import jax, tempfile
        >>> jax.config.update("jax_enable_x64", True)
        >>> from pathlib import Path
        >>> from jaxchain.scenes import load_scene, resume_scene, run_scene
        >>> small = "chain.n=3", "sweep.belt_speed=[1.5]", "sweep.excited=[0, 1]"  # seconds
        >>> scene = load_scene("quickstart", [f"experiment.ladder.{key}" for key in small])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = run_scene(scene, Path(folder), plot=False, report=lambda text: None)
        ...     resume_scene(load_scene(folder), Path(folder), plot=False)  # of what ran there
        saved already: ladder
        nothing is missing
    """
    if isinstance(loaded.scene, StudyTable):
        raise SceneError(
            loaded.name,
            [f"is a study, which cannot go on: `jaxchain run {folder}` runs it again"],
        )
    if client is not None:
        loaded = dataclasses.replace(loaded, scene=all_stored(loaded.scene))
    chains = checked_chains(loaded, own_law, own_observers)
    how: dict[str, Any] = {
        "own_law": own_law, "own_observers": own_observers, "progress": progress,
        "client": client,
    }  # fmt: skip
    try:
        with filled(folder):
            results = Results.reopen(folder, loaded.name)
            with results, page_behind(results, loaded.scene):
                _complete(loaded, results, chains, how, plot, report, command)
    except BlockingIOError:
        raise SceneError(
            loaded.name,
            [f"is being run in {folder} by another process: wait until that ends, or use "
             "`--workers` there"],
        ) from None  # fmt: skip
    except OSError as error:
        raise StorageError(loaded.name, folder, error.strerror or str(error), [], {}) from error


def _complete(
    loaded: LoadedScene,
    results: Results,
    chains: Mapping[str, Any],
    how: Mapping[str, Any],
    plot: bool,
    report: Callable[[str], object],
    command: str,
) -> None:
    """Computes and saves what is missing, and draws."""
    scene, folder, before = loaded.scene, results.folder, list(results.datasets)
    around = circumstances(command)
    first = circumstances_before(folder / f"{loaded.name}.toml")
    results.about |= {"title": scene.title, "description": scene.description}
    results.about |= {"scene": loaded.name, **around, **first}
    results.about |= {"resumed": around["started"], "resumed_by": around["command"]}
    if before:
        report(f"saved already: {', '.join(before)}")
    fill(loaded, results, chains, report=report, **how)
    more = list(results.datasets) != before
    if not more:
        report("nothing is missing" if before else "nothing is missing beside the stores")
    if plot and (more or not (folder / f"{loaded.name}.png").exists()):
        draw(results)
    (folder / MARKER).unlink(missing_ok=True)
