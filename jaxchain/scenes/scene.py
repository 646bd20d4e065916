"""Scenes: experiments described as data, read and checked key by key.

The tables check each key; this module checks what a scene by itself has: names, numbers of runs,
pictures.  What does not fit the model is refused where it is built (`building`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from pydantic import AfterValidator, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from .._final import final
from .._limits import MOST_LANES, MOST_STORED, MOST_UNSTORED
from .._spelling import did_you_mean
from ..plotting.groups import CYCLES, DRY
from . import tables
from .files import (
    MOST_SHOWN,
    SceneError,
    as_key,
    as_value,
    builtin_scenes,
    read_scene,
    shortened,
)
from .tables import FEWER, Table, Text, array

# (path of a key within the table, what is wrong with it).
_Problem: TypeAlias = tuple[tuple[str | int, ...], str]


def _raise_all(problems: Iterator[_Problem]) -> None:
    """Raises all problems at once, in the same way as pydantic."""
    details: list[InitErrorDetails] = [
        {"type": PydanticCustomError("problem", "{text}", {"text": text}), "loc": path, "input": 0}
        for path, text in problems
    ]
    if details:
        raise ValidationError.from_exception_data("scene", details)


Picture: TypeAlias = Literal["circles", "orbit_diagram", "delays", "time_series", "phase_plots"]
MISSING = "is missing: give it here or in `sweep`"
# The observers that pictures need besides amplitudes.
_OBSERVED = {
    "orbit_diagram": "PeakTimes",
    "delays": "PeakTimes",
    "time_series": "Samples",
    "phase_plots": "Samples",
}


@final
class Experiment(Table):
    """One sweep of a scene, which gives one dataset.

    Its fields are the tables of `[experiment.NAME]` in the file: `chain`, or `model` for other
    cells, and `initial`, `sweep`, `time`, `observe` and `numerics`; `schema()` describes every
    key.

    !!! example

        >>> from jaxchain.scenes import load_scene
        >>> one = load_scene("quickstart").scene.experiment["ladder"]
        >>> one.chain.n, one.time.transient, one.initial.kind
        (6, 500.0, 'equation_8')
        >>> {name: len(values) for name, values in one.grid().items()}, one.lanes()
        ({'belt_speed': 11, 'excited': 7}, 77)
    """

    description: Text = ""
    """A description in some sentences, which is stored with the results."""
    chain: tables.ChainTable | None = None
    """Masses, springs, belt and friction."""
    model: tables.ModelTable | None = None
    """Instead of `chain`: the class of other cells, their number and their numbers."""
    initial: tables.InitialTable = Field(default_factory=dict)
    """Displacements and velocities of a chain at the start; of other cells each of their numbers,
    by its name or its number from 0: one number, or a list with one per cell; absent: 0."""
    time: tables.TimeTable
    """How long the runs are."""
    sweep: Annotated[dict[str, tables.Values], Field(max_length=32)] = Field(default_factory=dict)
    """Numbers of the model, its friction or the initial state, with the values they take; they
    replace the single number given there, which may be left out."""
    observe: tables.ObserveTable = Field(default_factory=tables.ObserveTable)
    """What is measured, and when a run may end early."""
    numerics: tables.NumericsTable = Field(default_factory=tables.NumericsTable)
    """Solver, tolerances and limits; absent: their defaults."""
    pictures: (
        Annotated[list[Picture], Field(min_length=1), AfterValidator(tables.distinct)] | None
    ) = None
    """What the figure shows of a sweep over `excited`; absent: amplitude or energy."""

    @property
    def of(self) -> str:
        """Where the table of its model is."""
        return "model" if self.chain is None else "chain"

    @property
    def cells(self) -> Any:
        """The table of its model, `chain` or `model`."""
        return self.model if self.chain is None else self.chain

    @property
    def is_chain(self) -> bool:
        """Whether its model is a chain."""
        return isinstance(self.cells, tables.ChainTable)

    def grid(self) -> dict[str, np.ndarray]:
        """The swept values by name, in the order of the file, each of shape (values,).

        Without a sweep this is one run, at the belt speed of the chain.
        """
        if not self.sweep:
            return {"belt_speed": np.array([self.cells.belt_speed], float)}
        grid = {name: array(values) for name, values in self.sweep.items()}
        if "excited" in grid and np.all(grid["excited"] == np.round(grid["excited"])):
            grid["excited"] = grid["excited"].astype(int)
        return grid

    def lanes(self) -> int:
        """Number of runs."""
        return math.prod(map(len, self.grid().values()))

    def stored(self) -> bool:
        """Whether its runs use a store."""
        requested = self.numerics.store
        return self.lanes() > MOST_UNSTORED if requested is None else requested

    @model_validator(mode="before")
    @classmethod
    def _without_belt(cls, given: Any) -> Any:
        """Other cells than a chain have no count of active masses."""
        match given:
            case {"model": {"kind": kind}} if kind != "Chain":
                observe = given.get("observe", {})
                if isinstance(observe, dict):
                    observe = {"quantities": ["amplitude", "energy"], **observe}
                return {**given, "observe": observe}
        return given

    @model_validator(mode="after")
    def _check(self) -> Experiment:
        _raise_all(self._problems())
        return self

    def _problems(self) -> Iterator[_Problem]:
        if self.chain is None and self.model is None:
            yield ("chain",), "is missing: give the table `chain`, or `model` for other cells"
            return
        if self.chain is not None and self.model is not None:
            yield ("chain",), "cannot stand beside `model`: leave one out"
            return
        if self.is_chain:
            if isinstance(self.initial, dict):
                kinds = '"equation_8", "equation_10", "excited"'
                yield ("initial", "kind"), f"must be one of {kinds}, but is missing"
            if not self.sweep and self.cells.belt_speed is None:
                yield (self.of, "belt_speed"), MISSING
        else:
            yield from self._lacks_a_chain()
        stored = self.stored()
        if self.sweep and self.lanes() > (most := MOST_STORED if stored else MOST_LANES):
            runs = " x ".join(f"{len(v)} {k}" for k, v in self.grid().items())
            instead = "" if stored else ", or keep them in a store (`numerics.store = true`)"
            message = f"is {self.lanes():.3g} runs ({runs}), and {most} are the most: {FEWER}"
            yield ("sweep",), message + instead
        yield from ((("pictures",), message) for message in self._lacks_for_pictures())

    def _lacks_a_chain(self) -> Iterator[_Problem]:
        if not self.sweep:
            yield ("sweep",), "is missing: name a number with its values, such as one value"
        for where, value, allowed in (
            (("observe", "quantities"), self.observe.quantities, ("amplitude", "energy")),
            (("observe", "stop"), [self.observe.stop], ("never", "steady")),
        ):
            for given in value:
                if given not in allowed:
                    must = " or ".join(map(as_value, allowed))
                    yield where, f"must be {must}, but is {as_value(given)}, which needs a `chain`"
        if self.pictures is not None:
            yield ("pictures",), "needs a `chain`: leave it out"

    def _lacks_for_pictures(self) -> Iterator[str]:
        pictures = self.pictures or []
        others: dict[str, Any] = {other.observer: other for other in self.observe.others or []}
        if pictures and [*self.sweep] != ["excited"]:
            yield "needs `excited` alone in `sweep`"
        if pictures and "amplitude" not in self.observe.quantities:
            yield "needs `amplitude` among `observe.quantities`"
        for picture in pictures:
            if _OBSERVED.get(picture) not in {None, *others}:
                yield f"has `{picture}`, which needs `{_OBSERVED[picture]}` in `observe.others`"
        if samples := others.get("Samples"):
            if "phase_plots" in pictures and len(samples.oscillators or []) != 3:
                yield "has `phase_plots`, which needs three `oscillators` of `Samples`"
            if "time_series" in pictures and samples.oscillators is not None:
                yield "has `time_series`, which needs `Samples` of all oscillators"


class Group(NamedTuple):
    """The runs of one experiment with one model of friction: a dataset of the results."""

    name: str
    of: str  # the name of the experiment
    experiment: Experiment
    model: str  # "smoothed" or "dry"


@final
class Scene(Table):
    """A scene file: `title`, `description` and the experiments, each a table `[experiment.NAME]`.

    `Scene.model_validate` checks tables that were not read from a file.

    !!! example

        >>> from jaxchain.scenes.scene import LoadedScene, Scene
        >>> law = {"law": "exponential_decay", "mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5}
        >>> tables = {
        ...     "chain": {"n": 3, "damping_ratio": 0.05, "friction": law | {"width": 1e-2}},
        ...     "initial": {"kind": "equation_8"},
        ...     "sweep": {"belt_speed": [1.4, 1.5], "excited": [0, 1]},
        ...     "time": {"transient": 100.0, "window": 20.0},
        ... }
        >>> scene = Scene.model_validate({"title": "Three", "experiment": {"three": tables}})
        >>> mine = LoadedScene("mine", scene)  # for `run_scene`
        >>> mine.scene.experiment["three"].lanes()
        4
    """

    title: Annotated[Text, Field(min_length=1)]
    """What it is called, in one line."""
    description: Text = ""
    """A description in some sentences, which is stored with the results."""
    experiment: Annotated[dict[tables.Name, Experiment], Field(min_length=1, max_length=1000)]
    """The experiments by name; each makes one dataset of this name."""

    @model_validator(mode="after")
    def _check(self) -> Scene:
        beside = {DRY: "runs of the other model", CYCLES: "cycles"}
        _raise_all(
            (("experiment", name), f"is where the {what} of `{other}` may go: rename it")
            for name in self.experiment
            for ending, what in beside.items()
            if name.endswith(ending) and (other := name.removesuffix(ending)) in self.experiment
        )
        return self

    def groups(self) -> Iterator[Group]:
        """The groups to run, in order; the first of two models has the name of the experiment."""
        for name, experiment in self.experiment.items():
            model = experiment.numerics.model
            yield Group(name, name, experiment, "smoothed" if model == "both" else model)
            if model == "both":
                yield Group(f"{name}{DRY}", name, experiment, "dry")


@final
@dataclass(frozen=True)
class LoadedScene:
    """A scene with the `name` under which its results are stored.

    See `load_scene` for an example.
    """

    name: str
    scene: Scene


def load_scene(scene: str, overrides: Sequence[str] = ()) -> LoadedScene:
    """Reads and checks a scene.

    **Arguments:** `scene`, the name of a built-in scene, the path of a TOML file, or that of a
    folder with results, for its scene; `overrides`, assignments such as
    "experiment.ladder.chain.n=40", applied before the check.

    **Returns:** a `LoadedScene`.

    **Raises:** `SceneError` with every problem.

    >>> from jaxchain.scenes import load_scene
    >>> list(load_scene("quickstart").scene.experiment)
    ['ladder']
    """
    name, data = read_scene(scene, overrides)
    # Files that the scene names are in the same folder.
    path = Path(scene)
    folder = path if scene not in builtin_scenes() and os.path.isdir(path) else path.parent
    try:
        return LoadedScene(name, Scene.model_validate(data, context={"folder": folder}))
    except ValidationError as error:
        details = error.errors(include_url=False)
        problems = [_problem(detail) for detail in details[:MOST_SHOWN]]
        if more := len(details) - len(problems):
            problems.append(f"and {more} more")
        raise SceneError(scene, problems) from None


def schema() -> dict[str, Any]:
    """The JSON schema of scene files, for editors.

    Optional keys are optional, not null, because TOML has no null.  Python examples are omitted.

    **Returns:** a dict that `json.dumps` writes.

    !!! example

        >>> from jaxchain.scenes import schema
        >>> list(schema()["properties"])
        ['title', 'description', 'experiment']
    """

    def of_files(part: Any) -> Any:
        if isinstance(part, list):
            return [of_files(entry) for entry in part if entry != {"type": "null"}]
        if not isinstance(part, dict):
            return part
        part = {key: of_files(value) for key, value in part.items()}
        if isinstance(text := part.get("description"), str):
            part["description"] = text.partition("\n\n!!! example")[0]
        if part.get("default", ...) is None:
            del part["default"]
        if len(part.get("anyOf", ())) == 1:
            part |= part.pop("anyOf")[0]
        return part

    return of_files(Scene.model_json_schema())


def _problem(detail: Any) -> str:
    """A problem found by pydantic: the key, the requirement and the value."""
    kind, value = detail["type"], detail["input"]
    # pydantic also names the kind that it chose among several, in angle brackets.
    location = [p for p in detail["loc"] if not str(p).startswith("<") and p != "[key]"]
    path = "".join(f"[{p}]" if isinstance(p, int) else f".{as_key(p)}" for p in location)
    message = detail["msg"].removeprefix("Value error, ")
    bounds = {"ge": "at least", "gt": "greater than", "le": "at most", "lt": "less than"}
    for bound in bounds.keys() & detail.get("ctx", {}).keys():
        limit = detail["ctx"][bound]
        limit = f"{limit:g}" if isinstance(limit, float) else limit
        message = f"Input should be {bounds[bound]} {limit}"
    if kind == "extra_forbidden":
        allowed = _keys_at(detail["loc"][:-1])
        near = did_you_mean(str(location[-1]), allowed)
        message = f"is not a known key{near}; allowed: {', '.join(allowed)}"
    elif kind == "missing":
        message = "is missing"
    elif kind == "one_of":
        key, _, options = message.partition(" ")
        given = value.get(key, ...) if isinstance(value, dict) else value
        written = "missing" if given is ... else shortened(as_value(given), 80)
        path, message = f"{path}.{key}", f"must be one of {options}, but is {written}"
    elif "should" in message:
        written = {dict: "a table", list: "a list"}.get(type(value)) or as_value(value)
        message = message.replace("Input should", "must").replace("String should", "must")
        message = f"{message}, but is {shortened(written, 80)}"
    return f"{path[1:]}: {message}" if path else message


def _keys_at(location: Sequence[int | str]) -> list[str]:
    """The keys of the table at a location of pydantic."""
    kinds = [Scene]
    for part in location:
        if str(part).startswith("<"):
            kinds = [kind for kind in kinds if kind.__name__ == str(part)[1:-1]] or kinds
        elif fields := [k.model_fields[part] for k in kinds if part in k.model_fields]:
            held = (fields[0].annotation, *fields[0].metadata)
            kinds = [table for part in held for table in _tables(part)]
    return list(kinds[0].model_fields)


def _tables(kind: Any) -> Iterator[type[Table]]:
    """All tables that a value of this type may be, or hold."""
    if isinstance(kind, type) and issubclass(kind, Table):
        yield kind
    for part in kind.kinds.values() if isinstance(kind, tables.OneOf) else get_args(kind):
        yield from _tables(part)
