"""Scenes: experiments described as data, read and checked as a whole before anything is compiled.

The tables check each key separately; this module checks several keys together: numbers that are
neither given nor swept, lists that do not fit the chain, more excited masses than the chain has,
sweeps that are too large.  It does not need JAX.
"""

from __future__ import annotations

import abc
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeAlias,
    get_args,
    get_origin,
)

import numpy as np
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from .._final import final
from .._limits import MOST_LANES, MOST_STORED, MOST_UNSTORED
from .._spelling import did_you_mean
from ..model.parameters import CHAIN, FRICTION, parameter
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
from .tables import FEWER, MOST_NUMBERS, ExcitedTable, Table, Text, array, tags

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
_MISSING = "is missing: give it here or in `sweep`"
# The observers that pictures need besides amplitudes.
_OBSERVED = {
    "orbit_diagram": "PeakTimes",
    "delays": "PeakTimes",
    "time_series": "Samples",
    "phase_plots": "Samples",
}


class AbstractExperiment(Table):
    """The tables and methods that experiments with a chain and with other cells share."""

    # In each subclass, after its model: errors come in the order of the fields.
    if TYPE_CHECKING:
        time: tables.TimeTable
        sweep: dict[str, tables.Values]
        observe: tables.ObserveTable
        numerics: tables.NumericsTable

    @property
    @abc.abstractmethod
    def n(self) -> int:
        """Number of masses or cells."""

    @property
    @abc.abstractmethod
    def friction(self) -> Any:
        """The table of friction; for cells it may be a number or None."""

    @abc.abstractmethod
    def given(self, name: str) -> Any:
        """The value of a parameter of the model or its friction in the scene."""

    @abc.abstractmethod
    def _problems(self) -> Iterator[_Problem]:
        """What is wrong with several keys together."""

    def friction_numbers(self) -> tuple[str, ...]:
        """Names of the parameters of the friction law, width last."""
        table = self.friction
        fields = tuple(name for name in FRICTION if name in type(table).model_fields)
        return (*(table.model_extra or ()), *fields)

    def grid(self) -> dict[str, np.ndarray]:
        """The swept values by name, in the order of the file, each of shape (values,).

        Without a sweep this is one run, at the belt speed of the chain.
        """
        if not self.sweep:
            return {"belt_speed": np.array([self.given("belt_speed")])}
        grid = {name: array(values) for name, values in self.sweep.items()}
        return {k: v.astype(int) if k == "excited" else v for k, v in grid.items()}

    def lanes(self) -> int:
        """Number of runs."""
        return math.prod(map(len, self.grid().values()))

    def stored(self) -> bool:
        """Whether its runs use a store."""
        requested = self.numerics.store
        return self.lanes() > MOST_UNSTORED if requested is None else requested

    def fits_memory(self) -> bool:
        """Whether its results fit into memory."""
        return next(self._beyond_memory(), None) is None

    @model_validator(mode="after")
    def _check(self) -> AbstractExperiment:
        _raise_all(self._sweep_problems())
        _raise_all(self._problems())
        return self

    def _sweep_problems(self) -> Iterator[_Problem]:
        yield from ()

    def _missing_friction(self, table: str) -> Iterator[_Problem]:
        fields = type(self.friction).model_fields
        for name in FRICTION:
            if name in fields and name not in self.sweep and getattr(self.friction, name) is None:
                yield (table, "friction", name), _MISSING

    def _observer_misfits(self) -> Iterator[_Problem]:
        n = self.n
        for i, other in enumerate(self.observe.others or []):
            path = ("observe", "others", i)
            if isinstance(other, tables.CustomObserverTable):
                continue
            masses = other.model_dump(include={"oscillator", "oscillators", "middle"})
            for key, given in masses.items():
                if given is not None and np.max(given) > n:
                    message = f"must lie in 1 ... {n} (`n`), but is {given}"
                    yield (*path, key), message
            if isinstance(other, tables.FrontTrackTable):
                part = (self.time.transient + self.time.window) / other.windows
                if part < 4 * math.pi:
                    yield (
                        (*path, "windows"),
                        f"would be parts of {part:.3g} time units, and {4 * math.pi:.4g}, two "
                        "periods, are the least: lower it, or lengthen the run",
                    )

    def _size_problems(self) -> Iterator[_Problem]:
        if not self.stored():
            yield from self._beyond_memory()
        elif self.lanes() > MOST_STORED:
            yield self._too_many(MOST_STORED)

    def _too_many(self, most: int) -> _Problem:
        product = " x ".join(f"{len(v)} {k}" for k, v in self.grid().items())
        runs = f"{self.lanes():.3g} runs ({product})"
        return ("sweep",), f"is {runs}, and {most} are the most: {FEWER}"

    def _beyond_memory(self) -> Iterator[_Problem]:
        lanes, n = self.lanes(), self.n
        instead = "or keep them in a store (`numerics.store = true`)"
        if lanes > MOST_LANES:
            path, message = self._too_many(MOST_LANES)
            yield path, f"{message}, {instead}"
            return
        kept: list[tuple[Any, int, str]] = [(("sweep",), n, "amplitudes")]
        for i, other in enumerate(self.observe.others or []):
            kept.append((("observe", "others", i), tables.kept_numbers(other, n), "numbers"))
        for path, count, what in kept:
            if lanes * count > MOST_NUMBERS:
                yield (
                    path,
                    f"would keep {lanes * count:.3g} {what} of {lanes} runs of {n} masses, and "
                    f"{MOST_NUMBERS:.0e} are the most: keep less of each run, {FEWER}, {instead}",
                )


@final
class Experiment(AbstractExperiment):
    """One sweep of a chain in a scene, which gives one dataset.

    Its fields are the tables of `[experiment.NAME]` in the file: `chain`, `initial`, `sweep`,
    `time`, `observe` and `numerics`; `schema()` describes every key.

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
    chain: tables.ChainTable
    """Masses, springs, belt and friction."""
    initial: tables.InitialTable
    """Displacements and velocities at the start."""
    time: tables.TimeTable
    """How long the runs are."""
    sweep: Annotated[dict[str, tables.Values], Field(max_length=32)] = Field(default_factory=dict)
    """Numbers of the chain, its friction or the initial state, with the values they take; they
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
    def n(self) -> int:
        """Number of masses."""
        return self.chain.n

    @property
    def friction(self) -> tables.FrictionTable:
        """The table of the friction law."""
        return self.chain.friction

    def given(self, name: str) -> Any:
        """The value of a parameter of the chain or its friction in the scene."""
        return getattr(self.chain if name in CHAIN else self.chain.friction, name)

    def sweepable(self) -> tuple[str, ...]:
        """Every name that is allowed in `sweep`."""
        start: tuple[str, ...] = ("excited",)
        if isinstance(self.initial, ExcitedTable):
            start = () if self.initial.oscillators is not None else start
            start = (*start, "displacement", "velocity")
        return (*CHAIN, *self.friction_numbers(), *start)

    def _sweep_problems(self) -> Iterator[_Problem]:
        n = self.chain.n
        for name, values in self.sweep.items():
            numbers, sign = array(values), parameter(name).sign
            least, message = np.min(numbers), ""
            if name not in self.sweepable():
                near = did_you_mean(name, self.sweepable())
                message = f"cannot be swept{near}; allowed: {', '.join(self.sweepable())}"
            elif sign == "positive" and least <= 0:
                message = f"must be greater than 0 throughout, but holds {least:g}"
            elif sign == "nonnegative" and least < 0:
                message = f"must not be negative, but holds {least:g}"
            elif name == "coupling" and n == 1:
                message = "cannot be swept: a single mass (`chain.n` = 1) has no neighbours"
            elif name == "excited":
                bad = numbers[(numbers != np.round(numbers)) | (numbers < 0) | (numbers > n)]
                if bad.size:
                    message = (
                        f"must be whole numbers from 0 to {n} (`chain.n`), but holds {bad[0]:g}"
                    )
            if message:
                yield ("sweep", name), message

    def _problems(self) -> Iterator[_Problem]:
        for name, row in CHAIN.items():
            if row.required and name not in self.sweep and self.given(name) is None:
                yield ("chain", name), _MISSING
        yield from self._missing_friction("chain")
        for path, message in self._chain_misfits():
            yield ("chain", *path), message
        yield from self._start_misfits()
        softest = self._extreme("stiffness", min) or 1.0
        period, window = 2 * math.pi / softest**0.5, self.time.window
        if window < period:
            message = f"must hold at least one period, {period:.4g}, but is {window:g}"
            yield ("time", "window"), message
        yield from self._observer_misfits()
        yield from self._size_problems()
        yield from ((("pictures",), message) for message in self._lacks_for_pictures())

    def _lacks_for_pictures(self) -> Iterator[str]:
        pictures = self.pictures or []
        others = {other.observer: other for other in self.observe.others or []}
        if pictures and [*self.sweep] != ["excited"]:
            yield "needs `excited` alone in `sweep`"
        if pictures and "amplitude" not in self.observe.quantities:
            yield "needs `amplitude` among `observe.quantities`"
        for picture in pictures:
            if _OBSERVED.get(picture) not in {None, *others}:
                yield f"has `{picture}`, which needs `{_OBSERVED[picture]}` in `observe.others`"
        if isinstance(samples := others.get("Samples"), tables.SamplesTable):
            if "phase_plots" in pictures and len(samples.oscillators or []) != 3:
                yield "has `phase_plots`, which needs three `oscillators` of `Samples`"
            if "time_series" in pictures and samples.oscillators is not None:
                yield "has `time_series`, which needs `Samples` of all oscillators"

    def _chain_misfits(self) -> Iterator[_Problem]:
        chain = self.chain
        springs = chain.n if chain.ends == "cyclic" else chain.n - 1
        wanted = {
            "mass": (chain.n, "one per mass"),
            "spring": (springs, f"one per spring with {chain.ends} ends"),
        }
        for name, row in CHAIN.items():
            value = self.given(name)
            if isinstance(value, list) and len(value) != wanted[row.per][0]:
                count, which = wanted[row.per]
                must = f"must be one number or {count} in a list ({which})"
                yield (name,), f"{must}, but has {len(value)}"
        if self.given("coupling") is not None and chain.n == 1:
            yield ("coupling",), "must be left out: a single mass (`n` = 1) has no neighbours"
        if {"mu_static", "mu_dynamic"} <= set(type(chain.friction).model_fields):
            static, dynamic = self._extreme("mu_static", min), self._extreme("mu_dynamic", max)
            if static is not None and dynamic is not None and static < dynamic:
                must = f"must be at least `mu_dynamic` = {dynamic:g}"
                yield ("friction", "mu_static"), f"{must}, but is {static:g}"

    def _start_misfits(self) -> Iterator[_Problem]:
        n, initial = self.chain.n, self.initial
        masses = initial.oscillators if isinstance(initial, ExcitedTable) else None
        if initial.excited is None and masses is None and "excited" not in self.sweep:
            yield ("initial", "excited"), _MISSING
        if initial.excited is not None and initial.excited > n:
            message = f"must not exceed {n} (`chain.n`), but is {initial.excited}"
            yield ("initial", "excited"), message
        if masses is not None and initial.excited is not None:
            yield ("initial", "oscillators"), "cannot stand beside `excited`: leave one out"
        if masses is not None and max(masses) > n:
            message = f"must lie in 1 ... {n} (`chain.n`), but holds {max(masses)}"
            yield ("initial", "oscillators"), message

    def _extreme(self, name: str, choose: Callable[..., float]) -> float | None:
        """The least or greatest value that a number of chain or friction takes."""
        if name in self.sweep:
            return float(choose(self.grid()[name]))
        value = self.given(name)
        return choose(value) if isinstance(value, list) else value


@final
class CellsExperiment(AbstractExperiment):
    """One sweep of other cells than a chain: its table `model` stands instead of `chain`.

    !!! example

        >>> from jaxchain.scenes import LoadedScene, Scene
        >>> tables = {
        ...     "model": {"kind": "VanDerPol", "n": 3},
        ...     "initial": {"displacement": [0.1, 0.2, 0.3]},
        ...     "sweep": {"mu": [0.5, 1.0]},
        ...     "time": {"transient": 100.0, "window": 20.0},
        ... }
        >>> scene = Scene.model_validate({"title": "Three", "experiment": {"three": tables}})
        >>> scene.experiment["three"].lanes()
        2
    """

    description: Text = ""
    """A description in some sentences, which is stored with the results."""
    model: tables.ModelTable
    """The class of the cells, their number and their numbers."""
    initial: Annotated[dict[str, tables.PerCell], Field(max_length=100)] = Field(
        default_factory=dict
    )
    """The numbers of a cell at the start, by their names or numbers from 0: one number, or a list
    with one per cell; absent: 0."""
    time: tables.TimeTable
    """How long the runs are."""
    sweep: Annotated[dict[str, tables.Values], Field(max_length=32)] = Field(default_factory=dict)
    """Numbers of the model, its friction or the initial state, with the values they take; they
    replace the single number given there, which may be left out."""
    observe: tables.CellsObserveTable = Field(default_factory=tables.CellsObserveTable)
    """What is measured, and when a run may end early."""
    numerics: tables.CellsNumericsTable = Field(default_factory=tables.CellsNumericsTable)
    """Solver, tolerances and limits; absent: their defaults."""

    def _sweep_problems(self) -> Iterator[_Problem]:
        if not self.sweep:
            yield ("sweep",), "is missing: name a number with its values, such as one value"

    @property
    def n(self) -> int:
        """Number of cells."""
        return self.model.n

    @property
    def friction(self) -> tables.FrictionTable | float | list[float] | None:
        """The key `friction` of the model."""
        return self.model.friction

    def given(self, name: str) -> Any:
        """The value of a number of the friction in the scene."""
        return getattr(self.friction, name)

    def _problems(self) -> Iterator[_Problem]:
        for table, values in (("model", dict(self.model)), ("initial", self.initial)):
            for name, value in values.items():
                if isinstance(value, list) and len(value) != self.n:
                    must = f"must be one number or {self.n} in a list (one per cell)"
                    yield (table, name), f"{must}, but has {len(value)}"
        if isinstance(self.friction, Table):
            yield from self._missing_friction("model")
        yield from self._observer_misfits()
        yield from self._size_problems()


def _kind(experiment: Any) -> str:
    """The class of `[experiment.NAME]`, which has a table `chain` or a table `model`."""
    if isinstance(experiment, dict):
        return "CellsExperiment" if "model" in experiment else "Experiment"
    return type(experiment).__name__


AnyExperiment: TypeAlias = Annotated[
    Annotated[Experiment, Tag("Experiment")] | Annotated[CellsExperiment, Tag("CellsExperiment")],
    Discriminator(_kind),
]


class Group(NamedTuple):
    """The runs of one experiment with one model of friction: a dataset of the results."""

    name: str
    of: str  # the name of the experiment
    experiment: AnyExperiment
    model: str  # "smoothed" or "dry"


@final
class Scene(Table):
    """A scene file: `title`, `description` and the experiments, each a table `[experiment.NAME]`.

    `Scene.model_validate` checks tables that were not read from a file.

    !!! example

        >>> from jaxchain.scenes import LoadedScene, Scene
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
    experiment: Annotated[dict[tables.Name, AnyExperiment], Field(min_length=1, max_length=1000)]
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
    kind, location, value = detail["type"], detail["loc"], detail["input"]
    message = detail["msg"].removeprefix("Value error, ")
    if kind == "extra_forbidden":
        key, (path, kinds) = str(location[-1]), _table_path(location[:-1])
        path = [*path, as_key(key)]
        allowed = [name for table in kinds for name in table.model_fields]
        near = did_you_mean(key, allowed)
        message = f"is not a known key{near}; allowed: {', '.join(allowed)}"
    else:
        path, kinds = _table_path(location)
    bounds = {"ge": "at least", "gt": "greater than", "le": "at most", "lt": "less than"}
    for bound in bounds.keys() & detail.get("ctx", {}).keys():
        limit = detail["ctx"][bound]
        limit = f"{limit:g}" if isinstance(limit, float) else limit
        message = f"Input should be {bounds[bound]} {limit}"
    if kind == "missing":
        message = "is missing"
    elif kind.startswith("union_tag"):
        options = ", ".join(f'"{tag}"' for table in kinds for tag in tags(table))
        path = [*path, detail["ctx"]["discriminator"].strip("'")]
        tag = detail["ctx"].get("tag")
        message = f"must be one of {options}, but is {as_value(tag) if tag else 'missing'}"
    elif "should" in message:
        written = {dict: "a table", list: "a list"}.get(type(value)) or as_value(value)
        message = message.replace("Input should", "must").replace("String should", "must")
        message = f"{message}, but is {shortened(written, 80)}"
    return f"{'.'.join(path)}: {message}" if path else message


def _table_path(location: Sequence[int | str]) -> tuple[list[str], list[type[Table]]]:
    """(the keys in the file for a location of pydantic, the tables that may be there).

    A location also names the kind that pydantic chose among several.
    """
    path: list[str] = []
    kind: Any = Scene
    for i, part in enumerate(location, start=1):
        options = _tables(kind)
        fields = [t.model_fields[part] for t in options if part in t.model_fields]
        member = [table for table in options if part in (table.__name__, *tags(table))]
        if isinstance(part, int):
            path[-1] += f"[{part}]"
        elif get_origin(kind) is dict:
            path, kind = [*path, as_key(part)], get_args(kind)[1]
        elif member and len(options) > 1 and not (fields and i == len(location)):
            kind = member[0]
        elif part not in ("number", "whole", "text", "list", "table", "[key]"):
            path, kind = [*path, as_key(part)], fields[0].annotation if fields else None
    return path, _tables(kind)


def _tables(kind: Any) -> list[type[Table]]:
    """All tables that a value of this type may be."""
    if isinstance(kind, type) and issubclass(kind, Table):
        return [kind]
    return [table for part in get_args(kind) for table in _tables(part)]
