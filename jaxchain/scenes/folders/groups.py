"""What a scene makes: one group of results for each experiment and model, some kept in stores.

    <scene>.zarr, <scene>.nc          all groups that fit into memory
    <scene>.<group>.zarr              the store of one group, which the runs enter as they end,
    <scene>.<group>.zarr.units/       and its records

The name of a group has no dot, so that no store bears the name of another file.  Nothing here
needs JAX.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ...plotting.groups import NONSMOOTH
from ..scene import Experiment, Scene
from ..tables import NumericsTable


@dataclass(frozen=True)
class Group:
    """The runs of one experiment with one model of friction."""

    name: str
    of: str
    """The name of the experiment."""
    experiment: Experiment
    model: str
    """ "smoothed" or "nonsmooth"."""

    def store(self, folder: Path, scene: str) -> Path | None:
        """Where its runs go as they end; None if they are kept in memory until all have."""
        return folder / f"{scene}.{self.name}.zarr" if self.experiment.stored() else None


def is_store_of(scene: str, path: Path) -> bool:
    """Whether a store bears the name of one that a scene makes.

    >>> is_store_of("two", Path("two.ladder.zarr")), is_store_of("two", Path("ladder.zarr"))
    (True, False)
    """
    return re.fullmatch(rf"{re.escape(scene)}\.[^.]+\.zarr", path.name) is not None


def models(numerics: NumericsTable) -> tuple[str, ...]:
    """ "smoothed", "nonsmooth" or both, in the order in which they are run."""
    return ("smoothed", "nonsmooth") if numerics.model == "both" else (numerics.model,)


def groups_of(scene: Scene) -> list[Group]:
    """In the order in which they are run."""
    found = []
    for name, experiment in scene.experiment.items():
        for model in models(experiment.numerics):
            # Of two models the smoothed one goes by the name of the experiment.
            second = model == "nonsmooth" and experiment.numerics.model == "both"
            found.append(Group(f"{name}{NONSMOOTH}" if second else name, name, experiment, model))
    return found


def all_stored(scene: Scene) -> Scene:
    """The same scene with a store for every experiment."""
    kept = {}
    for name, experiment in scene.experiment.items():
        numerics = experiment.numerics.model_copy(update={"store": True})
        kept[name] = experiment.model_copy(update={"numerics": numerics})
    return scene.model_copy(update={"experiment": kept})
