"""Scenes: experiments described as data, checked as a whole before anything is compiled.

The tables check each key by itself; here stands what concerns several keys at once: numbers that
are neither given nor swept, lists that do not fit the chain, more excited masses than there are,
sweeps that are too large.  Nothing here needs JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import InitErrorDetails

from .._final import final
from .._limits import MOST_LANES, MOST_STORED, MOST_UNSTORED
from ..model.parameters import CHAIN, FRICTION, parameter
from ..plotting.groups import CYCLES, NONSMOOTH
from .errors import MOST_SHOWN, did_you_mean
from .observing import (
    FrontTrackTable,
    ObserveTable,
    OwnObserverTable,
    SamplesTable,
    kept_numbers,
)
from .tables import (
    KINDS,
    LAWS,
    ChainTable,
    ExcitedTable,
    InitialTable,
    SolverTable,
    StoredNumericsTable,
    TimeTable,
)
from .values import (
    MOST_LANES_REMEDY,
    MOST_NUMBERS,
    MOST_TIME,
    Description,
    Name,
    Problem,
    Table,
    Title,
    Values,
    array,
    as_error,
    distinct,
    raise_all,
    short_of_a_period,
)

_MISSING = "is missing: give it here or in `sweep`"
# What can be looked at together whatever the rest of an experiment is, with a time to go with it.
_TOGETHER = ("chain", "initial", "sweep")
_LONG = {"transient": 0.0, "window": MOST_TIME}

# Far more than there are numbers to sweep.
MOST_SWEPT, MOST_EXPERIMENTS = 32, 1000
# Of the key in all tables that have one.
NUMERICS = Field(description="Solver, tolerances and limits; absent: their defaults.")
# A part of a run in which fronts are looked for holds two periods.
_TWO_PERIODS = 4 * math.pi


def missing_numbers(tables: dict[str, Any]) -> Iterator[Problem]:
    """What is neither given in these tables nor swept, as far as they can be read."""
    chain, initial, sweep = (tables.get(name, {}) for name in ("chain", "initial", "sweep"))
    if not isinstance(sweep, dict):
        return
    if isinstance(chain, dict) and chain:
        for name, row in CHAIN.items():
            if row.required and name not in chain and name not in sweep:
                yield ("chain", name), _MISSING
        friction = chain.get("friction")
        friction = friction if isinstance(friction, dict) else {}
        law = friction.get("law")
        known = LAWS[law].model_fields if isinstance(law, str) and law in LAWS else {}
        for name in FRICTION:
            if name in known and name not in friction and name not in sweep:
                yield ("chain", "friction", name), _MISSING
    kind = initial.get("kind") if isinstance(initial, dict) else None
    if isinstance(kind, str) and kind in KINDS:
        given = initial.keys() | sweep.keys()
        if not given & {"excited", "oscillators"}:
            yield ("initial", "excited"), _MISSING


def _again(detail: Any) -> InitErrorDetails:
    """A problem as it was found, to be raised with others."""
    if detail["type"] == "problems":
        detail = {**detail, "type": as_error(detail["ctx"]["problems"])}
    return detail


class SweepTable(Table):
    """The runs of a chain: over what, from where, for how long, and how they are computed."""

    swept: ClassVar[tuple[str, ...]] = ()
    """The names that `sweep` must hold, and no others; of none, any may stand there."""

    chain: ChainTable
    """Masses, springs, belt and friction."""
    initial: InitialTable
    """Displacements and velocities at the start."""
    time: TimeTable
    """How long the runs are."""
    sweep: Annotated[dict[str, Values], Field(max_length=MOST_SWEPT)] = Field(default_factory=dict)
    """Numbers of the chain, its friction or the initial state, with the values they take; they
    replace the single number given there, which may be left out."""
    numerics: Annotated[SolverTable, NUMERICS] = Field(default_factory=SolverTable)

    def friction_numbers(self) -> tuple[str, ...]:
        """Names of the numbers of the friction law, width last."""
        table = self.chain.friction
        known = tuple(name for name in FRICTION if name in type(table).model_fields)
        return (*(table.model_extra or ()), *known)

    def given(self, name: str) -> Any:
        """A number of the chain or its friction as it stands in their tables."""
        return getattr(self.chain if name in CHAIN else self.chain.friction, name)

    def initial_numbers(self) -> tuple[str, ...]:
        """Names of the numbers of the initial state that can be swept."""
        if not isinstance(self.initial, ExcitedTable):
            return ("excited",)
        own = ("displacement", "velocity")
        return own if self.initial.oscillators is not None else ("excited", *own)

    def sweepable(self) -> tuple[str, ...]:
        """Every name that may stand in `sweep`."""
        return self.swept or (*CHAIN, *self.friction_numbers(), *self.initial_numbers())

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

    @model_validator(mode="wrap")
    @classmethod
    def _told_together(
        cls, data: Any, handler: ModelWrapValidatorHandler[SweepTable]
    ) -> SweepTable:
        """What chain, start and sweep lack is told of beside whatever else is wrong."""
        try:
            return handler(data)
        except ValidationError as error:
            if not isinstance(data, dict) or error.error_count() > MOST_SHOWN:
                raise
            wrong = {detail["loc"][:1] for detail in error.errors(include_url=False)}
            own = {name: data[name] for name in _TOGETHER if name in data}
            if wrong & {(name,) for name in _TOGETHER}:
                problems = list(missing_numbers(own))
            else:
                problems = handler(own | {"time": _LONG}).problems()
            if not problems:
                raise
            found: list[InitErrorDetails] = [
                {"type": as_error(problems), "loc": (), "input": None},
                *map(_again, error.errors(include_url=False)),
            ]
        raise ValidationError.from_exception_data(cls.__name__, found)

    @model_validator(mode="after")
    def _check(self) -> SweepTable:
        raise_all(self.problems())
        return self

    def problems(self) -> list[Problem]:
        """What only several keys together show."""
        swept = [(("sweep", name), message) for name, message in self._sweep_problems()]
        missing = missing_numbers(self.model_dump(exclude_none=True))
        behind = [] if swept else [*self._misfits(), *self._too_large()]
        return [*swept, *missing, *behind]

    def _sweep_problems(self) -> Iterator[tuple[str, str]]:
        for name in self.swept:
            if name not in self.sweep:
                yield name, "is missing: give a list of values"
        for name, values in self.sweep.items():
            if name not in self.sweepable():
                near = did_you_mean(name, self.sweepable())
                yield name, f"cannot be swept{near}; allowed: {', '.join(self.sweepable())}"
                continue
            numbers = array(values)
            least, sign = np.min(numbers), parameter(name).sign
            if sign == "positive" and least <= 0:
                yield name, f"must be greater than 0 throughout, but holds {least:g}"
            if sign == "nonnegative" and least < 0:
                yield name, f"must not be negative, but holds {least:g}"
            if name == "excited":
                n = self.chain.n
                bad = numbers[(numbers != np.round(numbers)) | (numbers < 0) | (numbers > n)]
                if bad.size:
                    must = f"must be whole numbers from 0 to {n} (`chain.n`)"
                    yield name, f"{must}, but holds {bad[0]:g}"
            elif name == "coupling" and self.chain.n == 1:
                yield name, "cannot be swept: a single mass (`chain.n` = 1) has no neighbours"

    def _misfits(self) -> Iterator[Problem]:
        yield from ((("chain", *path), message) for path, message in self._chain_misfits())
        n, initial = self.chain.n, self.initial
        if initial.excited is not None and initial.excited > n:
            yield (
                ("initial", "excited"),
                f"must not exceed {n} (`chain.n`), but is {initial.excited}",
            )
        if isinstance(initial, ExcitedTable) and initial.oscillators is not None:
            if initial.excited is not None:
                yield ("initial", "oscillators"), "cannot stand beside `excited`: leave one out"
            if (last := max(initial.oscillators)) > n:
                yield (
                    ("initial", "oscillators"),
                    f"must lie in 1 ... {n} (`chain.n`), but holds {last}",
                )
        softest = self._extreme("stiffness", min)
        if softest is not None and (problem := short_of_a_period(self.time.window, softest)):
            yield ("time", "window"), problem

    def _chain_misfits(self) -> Iterator[Problem]:
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
                yield (
                    (name,),
                    f"must be one number or {count} in a list ({which}), but has {len(value)}",
                )
        if self.given("coupling") is not None and chain.n == 1:
            yield ("coupling",), "must be left out: a single mass (`n` = 1) has no neighbours"
        if {"mu_static", "mu_dynamic"} <= set(type(chain.friction).model_fields):
            static, dynamic = self._extreme("mu_static", min), self._extreme("mu_dynamic", max)
            if static is not None and dynamic is not None and static < dynamic:
                yield (
                    ("friction", "mu_static"),
                    f"must be at least `mu_dynamic` = {dynamic:g}, but is {static:g}",
                )

    def _extreme(self, name: str, choose: Callable[..., float]) -> float | None:
        """The least or greatest value that a number of chain or friction takes."""
        if name in self.sweep:
            return float(choose(self.grid()[name]))
        value = self.given(name)
        return choose(value) if isinstance(value, list) else value

    def _too_large(self) -> Iterator[Problem]:
        lanes, n = self.lanes(), self.chain.n
        if lanes > MOST_LANES:
            yield self._too_many(MOST_LANES)
        elif lanes * n > MOST_NUMBERS:
            yield (
                ("sweep",),
                f"is {lanes} runs of {n} masses, {lanes * n:.3g} amplitudes, and "
                f"{MOST_NUMBERS:.0e} are the most: {MOST_LANES_REMEDY}, or shorten the chain",
            )

    def _too_many(self, most: int) -> Problem:
        product = " x ".join(f"{len(v)} {k}" for k, v in self.grid().items())
        runs = f"{self.lanes():.3g} runs ({product})"
        return ("sweep",), f"is {runs}, and {most} are the most: {MOST_LANES_REMEDY}"


Picture: TypeAlias = Literal["circles", "orbit_diagram", "delays", "time_series", "phase_plots"]
# What is kept for pictures, beside amplitudes.
_OBSERVED = {
    "orbit_diagram": "PeakTimes", "delays": "PeakTimes", "time_series": "Samples",
    "phase_plots": "Samples",
}  # fmt: skip


@final
class Experiment(SweepTable):
    """One sweep of a scene: what is computed in one go and stored as one dataset.

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

    description: Description = ""
    observe: ObserveTable = Field(default_factory=ObserveTable)
    """What is measured, and when a run may end early."""
    numerics: Annotated[StoredNumericsTable, NUMERICS] = Field(default_factory=StoredNumericsTable)
    pictures: Annotated[list[Picture], Field(min_length=1), AfterValidator(distinct)] | None = None
    """What the figure shows of a sweep over `excited`; absent: amplitude or energy."""

    def stored(self) -> bool:
        """Whether its runs are kept in a store."""
        asked = self.numerics.store
        return self.lanes() > MOST_UNSTORED if asked is None else asked

    def fits_memory(self) -> bool:
        """Whether all that is kept of its runs can be looked at in one go."""
        return not any(True for _ in self._beyond_memory())

    @model_validator(mode="before")
    @classmethod
    def _without_main(cls, table: Any) -> Any:
        """Files may still mark one experiment as the main one: now all are groups alike."""
        if not isinstance(table, dict):
            return table
        return {key: value for key, value in table.items() if key != "main"}

    def _misfits(self) -> Iterator[Problem]:
        yield from super()._misfits()
        n = self.chain.n
        for i, other in enumerate(self.observe.others or []):
            if isinstance(other, OwnObserverTable):
                continue
            own = other.model_dump(include={"oscillator", "oscillators", "middle"})
            for key, given in own.items():
                if given is not None and np.max(given) > n:
                    yield (
                        ("observe", f"others[{i}]", key),
                        f"must lie in 1 ... {n} (`chain.n`), but is {given}",
                    )
            if isinstance(other, FrontTrackTable):
                part = (self.time.transient + self.time.window) / other.windows
                if part < _TWO_PERIODS:
                    yield (
                        ("observe", f"others[{i}]", "windows"),
                        f"would be parts of {part:.3g} time units, and {_TWO_PERIODS:.4g}, two "
                        f"periods, are the least: lower it, or lengthen the run",
                    )

        yield from ((("pictures",), problem) for problem in self._lacks_for_pictures())

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
        if isinstance(samples := others.get("Samples"), SamplesTable):
            if "phase_plots" in pictures and len(samples.oscillators or []) != 3:
                yield "has `phase_plots`, which needs three `oscillators` of `Samples`"
            if "time_series" in pictures and samples.oscillators is not None:
                yield "has `time_series`, which needs `Samples` of all oscillators"

    def _too_large(self) -> Iterator[Problem]:
        if not self.stored():
            yield from self._beyond_memory()
        elif self.lanes() > MOST_STORED:
            yield self._too_many(MOST_STORED)

    def _beyond_memory(self) -> Iterator[Problem]:
        for path, problem in super()._too_large():
            yield path, f"{problem}, or keep them in a store (`numerics.store = true`)"
        lanes, n = min(self.lanes(), MOST_LANES), self.chain.n
        for i, other in enumerate(self.observe.others or []):
            if (kept := lanes * kept_numbers(other, n)) > MOST_NUMBERS:
                yield (
                    ("observe", f"others[{i}]"),
                    f"would keep {kept:.3g} numbers of {lanes} runs of {n} masses, and "
                    f"{MOST_NUMBERS:.0e} are the most: keep less of each run, or sweep over fewer "
                    "values, or keep them in a store (`numerics.store = true`)",
                )


@final
class Scene(Table):
    """A scene file: `title`, `description` and the experiments, each a table `[experiment.NAME]`.

    `Scene.model_validate` checks tables that were not read from a file; its errors are those of
    pydantic, and `load_scene` says them in the words of the file.

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

    title: Title
    description: Description = ""
    experiment: Annotated[dict[Name, Experiment], Field(min_length=1, max_length=MOST_EXPERIMENTS)]
    """The experiments by name; each makes one dataset of this name."""

    @model_validator(mode="after")
    def _check(self) -> Scene:
        problems: list[Problem] = []
        names = set(self.experiment)
        for name in self.experiment:
            for ending, what in ((NONSMOOTH, "runs of the other model"), (CYCLES, "cycles")):
                if name.endswith(ending) and (other := name.removesuffix(ending)) in names:
                    problem = f"is where the {what} of `{other}` may go: rename it"
                    problems.append((("experiment", name), problem))
        raise_all(problems)
        return self
