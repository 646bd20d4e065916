"""The model, start, observers and method of an experiment, from its tables; your own classes.

Each is made once, by the constructors of the library.  What these refuse, and what `sweep` would,
is refused here, before anything runs, with the key it belongs to.

A scene contains only the numbers of a custom friction law, model or observer; its code runs only
if its file is named on the command line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import inspect
import keyword
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import observers, solvers
from .._checks import to_float
from .._limits import MOST_LANES, MOST_STORED
from .._spelling import did_you_mean
from .._types import State
from ..model import drives, initial_states
from ..model.arguments import as_state
from ..model.cells import AbstractCells
from ..model.chain import Chain
from ..model.friction import AbstractFriction, AbstractFrictionLaw, TanhFriction
from ..model.parameters import CHAIN, parameter
from ..model.tabulated import TabulatedFriction
from ..observers.base import AbstractObserver
from ..observers.fronts import FrontTrack
from ..simulation.event_driven import EventDriven, as_dry
from ..simulation.method import Method, fit_linear_solve
from ..simulation.run import check_fit
from ..sweeps.axes import check_axes
from ..sweeps.ensemble import check_observers
from .files import SceneError, as_key
from .scene import MISSING, Experiment, LoadedScene
from .tables import (
    FEWER,
    INDICES,
    LAWS,
    MOST_NUMBERS,
    OBSERVERS,
    READY_MADE,
    ExcitedTable,
    Table,
)

_Made = TypeVar("_Made")


@dataclass(frozen=True)
class Custom:
    """Your own classes, which replace or complete what the scenes name."""

    law: type[AbstractFrictionLaw] | None = None
    observers: Mapping[str, type[AbstractObserver]] = dataclasses.field(default_factory=dict)
    models: Mapping[str, type[AbstractCells]] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True)
class Built:
    """An experiment, ready for `sweep`: with the first value of every swept number."""

    model: Any
    initial: Callable[..., State]
    observe: list[AbstractObserver]
    methods: dict[str, Method]
    """Of runs with smoothed friction, and with dry friction."""
    variables: tuple[str, ...]
    """The names of the variables of a cell."""
    fits_memory: bool
    """Whether the results of its runs do."""


class _LocatedError(ValueError):
    """What is wrong, with its key."""


@contextlib.contextmanager
def _at(path: str, swept: Sequence[str] = (), **keys: str) -> Iterator[None]:
    """Gives the errors of the library the key of their argument, below `path` or in `sweep`.

    `keys`: those that are called otherwise than the argument.
    """
    try:
        yield
    except _LocatedError:
        raise
    except (ValueError, OverflowError) as error:
        text = str(error)
        found = re.match(r"Argument `([^`]+)` (?:names '([^']+)', which )?", text)
        if found is None:
            raise _LocatedError(f"{path}: {text}") from error
        # Such as over['width'], contacts[0].direction, plus['friction']['damping'].
        over = re.match(r"over\['([^']+)'\]", found[1])
        name = over[1] if over else re.sub(r"\['(\w+)'\]", r".\1", found[1])
        name = found[2] or keys.get(name, name)
        # The part of a model may name only its own field, which is swept by its full name.
        whole = [own for own in swept if own == name or own.endswith(f".{name}")]
        is_swept = found[2] or whole or over
        where = f"sweep.{as_key((whole or [name])[0])}" if is_swept else f"{path}.{name}"
        first = name.partition("[")[0]
        where = {"over": "sweep", "initial": "initial", "observe": path}.get(first, where)
        raise _LocatedError(f"{where}: {text[found.end() :]}") from error


class _Builder:
    """Makes the parts of one experiment."""

    def __init__(self, experiment: Experiment, custom: Custom):
        self.experiment, self.custom = experiment, custom
        self.grid, self.n = experiment.grid(), experiment.cells.n
        self.first = {name: values[0].item() for name, values in self.grid.items()}

    def make(
        self, kind: type[_Made], table: Mapping[str, Any], path: str, prefix: str = "", **more: Any
    ) -> _Made:
        """A law, a model, a part of one or an observer, from the keys of its table and the sweep.

        `prefix`: of the names of its parameters, such as "contacts[0].".

        **Raises:** `ValueError` for numbers that are not its fields, or are missing.
        """
        fields, chain = inspect.signature(kind).parameters, issubclass(kind, Chain)
        numbers = {name: value for name, value in table.items() if value is not None}
        swept = {name: self.first.get(prefix + name) for name in fields}
        numbers |= {name: value for name, value in swept.items() if value is not None} | more
        if unknown := next((name for name in numbers if name not in fields), None):
            has = f"{did_you_mean(unknown, fields)}; its fields: {', '.join(fields) or 'none'}"
            raise _LocatedError(f"{path}.{unknown}: is not a field of {kind.__name__}{has}")
        for name, field in fields.items():
            required = field.default is field.empty or (chain and parameter(name).required)
            if required and name not in numbers:
                raise _LocatedError(f"{path}.{name}: {MISSING}")
        made: Any = kind
        with _at(path, [name for name in self.first if name.startswith(prefix)]):
            try:
                return made(**numbers)
            except TypeError as error:
                raise ValueError(f"{kind.__name__} cannot be made: {error}") from error

    def part(self, given: Any, path: str, name: str, prefix: str = "") -> Any:
        """The value of a key of a model: numbers as they are, and what its tables make."""
        where, own = f"{path}.{name}", f"{prefix}{name}"
        if isinstance(given, list) and isinstance(given[0], Table):
            each = enumerate(given)
            return [self.whole(one, f"{where}[{i}]", f"{own}[{i}].") for i, one in each]
        if not isinstance(given, Table):
            return given
        if given.makes is drives.Table:
            return self.whole(given, where, f"{own}.")
        return self.friction(given, where, prefix)

    def parts(self, table: Table, path: str, prefix: str = "") -> dict[str, Any]:
        """The values of all keys of a model, or of a part of it, that are given."""
        keys = {name: getattr(table, name) for name in type(table).model_fields}
        keys |= table.model_extra or {}
        return {k: self.part(v, path, k, prefix) for k, v in keys.items() if v is not None}

    def whole(self, table: Table, path: str, prefix: str) -> Any:
        """A contact, a stop or a drive."""
        return self.make(table.makes, self.parts(table, path, prefix), path, prefix)

    def friction(self, table: Any, path: str, prefix: str) -> AbstractFriction:
        """Smoothed friction; the law itself without a width."""
        numbers = table.model_dump(exclude={"law", "file", "width"})
        kind = self.custom.law or LAWS.get(table.law, TabulatedFriction)
        numbers = {} if self.custom.law and table.law == "tabulated" else numbers
        if self.custom.law is None and table.law == "custom":
            raise _LocatedError(
                f'{path}.law: is "custom", so the law must be named on the command line: '
                "--law FILE.py:CLASS"
            )
        law = self.make(kind, numbers, path, prefix)
        width = self.first.get(f"{prefix}width", table.width)
        if width is None and self.experiment.is_chain:
            raise _LocatedError(f"{path}.width: {MISSING}")
        if width is None:
            return law
        return self.make(TanhFriction, {"law": law, "width": width}, path, prefix)

    def model(self) -> Any:
        """The chain or cells."""
        table, path = self.experiment.cells, self.experiment.of
        known = {"Chain": Chain} | READY_MADE | dict(self.custom.models)
        name = "Chain" if self.experiment.is_chain else table.kind
        if name not in known:
            raise _LocatedError(
                f"model.kind: is `{name}`, so this class must be named on the command line: "
                f"--model FILE.py:{name}{did_you_mean(name, known)}; ready-made are "
                f"{', '.join(READY_MADE)}"
            )
        kind = known[name]
        given = self.parts(table, path)
        given.pop("kind", None)
        if self.experiment.is_chain and self.n == 1:
            where = "sweep" if "coupling" in self.grid else path
            if where == "sweep" or table.coupling is not None:
                alone = "must be left out: a single mass (`n` = 1) has no neighbours"
                raise _LocatedError(f"{where}.coupling: {alone}")
        fields = inspect.signature(kind).parameters
        if "n" not in fields:
            del given["n"]
        elif name not in self.custom.models:  # it checks its numbers itself
            arrays = {k: np.array(given[k]) for k in CHAIN if isinstance(given.get(k), list)}
            return self.make(kind, given | (arrays if kind is Chain else {}), path)
        arrays = {f.name for f in dataclasses.fields(kind) if not f.metadata.get("static")}
        numbers = {}
        for name in arrays & (given.keys() | self.first.keys()):
            value = self.first.get(name, given.get(name))
            if value is not None and not isinstance(value, AbstractFriction):
                with _at(path, [*self.first]):
                    numbers[name] = self.per_cell(to_float(value, name), f"{path}.{name}")
        return self.make(kind, given, path, **numbers)

    def per_cell(self, value: Any, path: str) -> Any:
        """A number, or a list with one for each cell."""
        if np.ndim(value) and len(value) != self.n:
            must = f"must be one number or {self.n} in a list (one per cell)"
            raise _LocatedError(f"{path}: {must}, but has {len(value)}")
        return value

    def component(self, given: str | int, names: Sequence[str], where: str) -> int:
        """The number of a variable from its name or number."""
        numbers = {str(k): k for k in range(len(names))} | {v: k for k, v in enumerate(names)}
        if str(given) not in numbers:
            near = did_you_mean(str(given), numbers)
            has = ", ".join(numbers)
            raise _LocatedError(f"{where}: is not a number of a cell{near}; it has: {has}")
        return numbers[str(given)]

    def variables(self, model: Any) -> tuple[str, ...]:
        """The names of the m variables of a cell; if it has none, their numbers 0 ... m - 1."""
        names = [variable.name for variable in model.variables]
        names = names or [str(k) for k in range(len(self.experiment.initial))]
        if not names:
            raise _LocatedError(
                "initial: must have all numbers of a cell, such as `0 = 0.0`, because "
                f"`{self.experiment.cells.kind}` does not name them in `components`"
            )
        return tuple(names)

    def index(self, given: int | list[int], path: str) -> Any:
        """Masses from 0, of masses that are counted from 1."""
        masses = given if isinstance(given, list) else [given]
        if max(masses) > self.n:
            raise _LocatedError(f"{path}: must lie in 1 ... {self.n} (`n`), but is {max(masses)}")
        return tuple(m - 1 for m in given) if isinstance(given, list) else given - 1

    def initial(self) -> Callable[..., State]:
        """The initial state of a chain as a function of the chain and of the swept numbers."""
        table = self.experiment.initial
        start = table.model_dump(exclude={"kind"}, exclude_none=True)
        masses = start.pop("oscillators", None)
        if masses is not None and "excited" in start:
            raise _LocatedError("initial.oscillators: cannot stand beside `excited`: omit one")
        self.index(start.get("excited", 0), "initial.excited")
        if masses is None and "excited" not in {**start, **self.grid}:
            raise _LocatedError(f"initial.excited: {MISSING}")
        if not isinstance(table, ExcitedTable):
            return functools.partial(getattr(initial_states, table.kind), **start)
        how: Any = {"block": table.block, "pattern": table.pattern}
        given: Any = start.get("excited")
        pulled, moved = (np.asarray(a, float) for a in (table.displacement, table.velocity))
        if masses is not None:
            chosen = self.index(masses, "initial.oscillators")
            given = jnp.asarray(np.isin(np.arange(self.n), chosen))

        def pulled_away(
            chain: Chain,
            excited: Any = given,
            displacement: Any = pulled,
            velocity: Any = moved,
        ) -> State:
            return initial_states.excited_state(
                chain, excited, amplitude=displacement, velocity=velocity, **how
            )

        if masses is None:
            return pulled_away
        return lambda chain, displacement=pulled, velocity=moved: pulled_away(
            chain, given, displacement, velocity
        )

    def initial_of_cells(
        self, model: AbstractCells, names: tuple[str, ...]
    ) -> Callable[..., State]:
        """The initial state as a function of the cells and of the swept numbers of the start.

        A swept number has its name as a parameter, or `component_K` if that cannot be one.
        """
        given: dict[int, Any] = {}
        for key, value in self.experiment.initial.items():
            k = self.component(key, names, f"initial.{key}")
            if k in given:
                raise _LocatedError(
                    f"initial.{key}: is given twice, by name and by number: leave one out"
                )
            given[k] = self.per_cell(np.asarray(value, float), f"initial.{key}")
        fields, n = model.parameters(), self.n
        parameters = [
            f"component_{k}"
            if name in fields or keyword.iskeyword(name) or not name.isidentifier()
            else name
            for k, name in enumerate(names)
        ]

        def start(_: AbstractCells, **own: Any) -> State:
            parts = (own.get(name, given.get(k, 0.0)) for k, name in enumerate(parameters))
            return tuple(jnp.broadcast_to(jnp.asarray(part, float), (n,)) for part in parts)

        only = inspect.Parameter.KEYWORD_ONLY
        taken = [inspect.Parameter(name, only, default=None) for name in parameters]
        first = inspect.Parameter("_", inspect.Parameter.POSITIONAL_ONLY)
        start.__signature__ = inspect.Signature([first, *taken])
        return start

    def observers(self, names: Sequence[str]) -> dict[str, AbstractObserver]:
        """The observers by their keys: amplitudes, then those in the table, then your own."""
        table, time = self.experiment.observe, self.experiment.time
        how = table.model_dump(exclude={"quantities", "others"}, exclude_none=True)
        if "component" in how:
            how["component"] = self.component(how["component"], names, "observe.component")
        with _at("observe"):
            made: dict[str, AbstractObserver] = {
                "observe": observers.Amplitude(window=time.window, **how)
            }
        unnamed = dict(self.custom.observers)
        for i, other in enumerate(table.others or []):
            path = f"observe.others[{i}]"
            fields = other.model_dump(exclude={"observer", "name"}, exclude_none=True)
            if other.observer == "custom":
                if other.name not in self.custom.observers:
                    raise _LocatedError(
                        f"{path}.name: is `{other.name}`, so this observer must be named on the "
                        f"command line: --observer FILE.py:{other.name}"
                    )
                kind = unnamed.pop(other.name, self.custom.observers[other.name])
            else:
                kind = OBSERVERS[other.observer]
                for key in fields.keys() & set(INDICES):
                    fields[key] = self.index(fields[key], f"{path}.{key}")
                if "component" in fields:
                    where = f"{path}.component"
                    fields["component"] = self.component(fields["component"], names, where)
            made[path] = self.make(kind, fields, path)
            if isinstance(own := made[path], FrontTrack):
                part = (time.transient + time.window) / own.windows
                if part < 4 * math.pi:
                    raise _LocatedError(
                        f"{path}.windows: would be parts of {part:.3g} time units, and "
                        f"{4 * math.pi:.4g}, two periods, are the least: lower it, or lengthen "
                        "the run"
                    )
        for name, kind in unnamed.items():
            made[f"--observer {name}"] = self.make(kind, {}, f"--observer {name}")
        return made

    def methods(self, model: Any) -> dict[str, Method]:
        """How smoothed and dry runs are integrated."""
        numerics = self.experiment.numerics
        names = ("rtol", "atol", "max_step", "max_steps")
        how = {name: getattr(numerics, name) for name in names}
        solver: Any = None
        if numerics.solver in ("Rodas4", "Rodas5P"):
            solver = getattr(solvers, numerics.solver)()
            solver = fit_linear_solve(solver, model, numerics.rtol, numerics.max_step)
        elif numerics.solver != "auto":
            solver = getattr(dfx, numerics.solver)()
        methods = {"smoothed": Method(solver, **how), "dry": Method(EventDriven(), **how)}
        if numerics.model == "both" and model.dry:
            raise _LocatedError('numerics.model: must be "dry": no friction has a `width`')
        scale = model.smallest_scale(self.n)
        if scale is not None:
            scale = tuple(map(self.grid.get, ("width", "belt_speed"), scale))
        if numerics.model != "smoothed":
            with _at("numerics.model"):
                as_dry(model)
        for name in methods if numerics.model == "both" else (numerics.model,):
            with _at("numerics"):
                methods[name].checked(model, self.n, scale)
        return methods

    def check_start(self, model: Any, initial: Callable[..., State]) -> None:
        """The start at the ends of each of its swept numbers."""
        own = {k: v for k, v in self.grid.items() if not model.has_parameter(k)}
        first = {name: values[0] for name, values in own.items()}
        with _at("initial", [*own], amplitude="displacement"):
            as_state(model, initial(model, **first))
            for name, values in own.items():
                broken = values[values != np.round(values)][:1] if name == "excited" else ()
                for value in (values.min(), values.max(), *broken):
                    initial(model, **{**first, name: value})

    def check_size(self, model: Any, watch: Mapping[str, AbstractObserver], m: int) -> bool:
        """Whether the results fit into memory; `ValueError` if they do not and must."""
        experiment, lanes, fits = self.experiment, self.experiment.lanes(), True
        state = tuple(jax.ShapeDtypeStruct((self.n,), float) for _ in range(m))
        for path, observer in watch.items():
            with _at(path):
                kept = eqx.filter_eval_shape(_value_of, observer, model, self.end, state)
                check_fit([observer], 0.0, self.end, None)
            count = sum(leaf.size for leaf in jax.tree.leaves(kept))
            fits = fits and lanes * count <= MOST_NUMBERS
            if not fits and not experiment.stored():
                raise _LocatedError(
                    f"{path}: would keep {lanes * count:.3g} numbers of {lanes} runs of {self.n} "
                    f"masses, and {MOST_NUMBERS:.0e} are the most: keep less of each run, {FEWER}"
                    ", or keep them in a store (`numerics.store = true`)"
                )
        return fits and lanes <= MOST_LANES

    def check_window(self, model: Any) -> None:
        """A window of at least one period of the softest spring of a chain."""
        softest = np.min(self.grid.get("stiffness", np.asarray(model.stiffness)))
        period, window = 2 * math.pi / softest**0.5, self.experiment.time.window
        if window < period:
            must = f"must hold at least one period, {period:.4g}, but is {window:g}"
            raise _LocatedError(f"time.window: {must}")

    @property
    def end(self) -> float:
        """The length of a run."""
        return self.experiment.time.transient + self.experiment.time.window

    def build(self) -> Built:
        """All parts, made and checked together."""
        experiment = self.experiment
        model = self.model()
        names = self.variables(model)
        chain = experiment.is_chain
        initial = self.initial() if chain else self.initial_of_cells(model, names)
        watch = self.observers(names)
        with _at(f"{experiment.of}.friction", [*self.grid], model="width"):
            axes = check_axes(model, initial, self.grid, most=MOST_STORED)
        if chain:
            self.check_window(model)
        fits = self.check_size(model, watch, len(names))
        self.check_start(model, initial)
        zeros = (jnp.zeros(self.n),) * len(names)
        model.dependence(zeros)  # raises for a `rate` that does not fit
        observe, size = list(watch.values()), (len(names), self.n)
        with _at("observe"):
            check_observers(observe, model, size, 0.0, self.end, None, axes)
        return Built(model, initial, observe, self.methods(model), names, fits)


def _value_of(observer: AbstractObserver, model: Any, end: float, state: State) -> Any:
    return observer.read(observer.init(model, 0.0, end, state))


def build(loaded: LoadedScene, custom: Custom = Custom()) -> dict[str, Built]:
    """Every experiment of a scene, ready to run.

    **Raises:** `SceneError` with a problem of each experiment that cannot be run.
    """
    built, problems, experiments = {}, [], loaded.scene.experiment
    used = {getattr(one.cells, "kind", None) for one in experiments.values()}
    for name in custom.models:
        if name in READY_MADE:
            problems.append(f"--model: {name} is a ready-made class: give yours another name")
        elif name not in used:
            problems.append(f'--model: no experiment has `model.kind` = "{name}"')
    for name, experiment in experiments.items():
        try:
            built[name] = _Builder(experiment, custom).build()
        except _LocatedError as error:
            problems.append(f"experiment.{name}.{error}")
        except ValueError as error:
            problems.append(f"experiment.{name}: {error}")
    if problems:
        raise SceneError(loaded.name, problems)
    return built


def load_model(given: str, scene: str) -> type[AbstractCells]:
    """Loads the model "FILE.py:CLASS".  This runs the file.

    **Arguments:** `given`, as above; `scene`, the name that an error bears.

    **Returns:** the class, for `custom_models` of `run_scene`, by its name.

    **Raises:** `SceneError` if the file or class does not exist, if the class is not a subclass of
    `AbstractCells`, or if the file fails.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes.building import load_model
        >>> code = '''
        ... import jax
        ... from jaxchain.model import AbstractCells
        ... class Decay(AbstractCells):
        ...     speed: jax.Array
        ...     components = ("x",)
        ...     def rate(self, t, left, own, right):
        ...         return (-self.speed * own[0],)
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "cells.py"
        ...     _ = file.write_text(code)
        ...     decay = load_model(f"{file}:Decay", "mine")
        >>> {decay.__name__: decay}.keys()  # `custom_models` of `run_scene`
        dict_keys(['Decay'])
    """
    return _load("--model", given, scene, AbstractCells, "jaxchain.model")


def load_law(given: str, scene: str) -> type[AbstractFrictionLaw]:
    """Loads the friction law "FILE.py:CLASS".  This runs the file.

    **Arguments:** `given`, as above; `scene`, the name that an error bears.

    **Returns:** the class, for `custom_law` of `run_scene`; its fields are the numbers of the
    scene's friction table.

    **Raises:** `SceneError` if the file or class does not exist, if the class is not a friction
    law, or if the file fails.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes.building import load_law
        >>> code = '''
        ... from jaxchain.model import AbstractFrictionLaw
        ... class Rational(AbstractFrictionLaw):
        ...     mu_static: float
        ...     v_ref: float
        ...     def coefficient(self, speed):
        ...         return self.mu_static / (1.0 + speed / self.v_ref)
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "laws.py"
        ...     _ = file.write_text(code)
        ...     law = load_law(f"{file}:Rational", "mine")
        >>> law(mu_static=1.0, v_ref=1.5).coefficient(1.5)
        0.5
    """
    return _load("--law", given, scene, AbstractFrictionLaw, "jaxchain.model")


def load_observer(given: str, scene: str) -> type[AbstractObserver]:
    """Loads the observer "FILE.py:CLASS".  This runs the file.

    **Arguments:** `given`, as above; `scene`, the name that an error bears.

    **Returns:** the class, for `custom_observers` of `run_scene`, by its name.

    **Raises:** `SceneError` if the file or class does not exist, if the class is not an observer,
    or if the file fails.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes.building import load_observer
        >>> code = '''
        ... import jax.numpy as jnp
        ... from jaxchain.observers import AbstractObserver, Variable
        ... class Fastest(AbstractObserver):
        ...     def init(self, field, t0, t1, y0):
        ...         return jnp.max(y0[1])
        ...     def update(self, accumulator, step):
        ...         return jnp.maximum(accumulator, jnp.max(step.y1[1]))
        ...     def read(self, accumulator):
        ...         return accumulator
        ...     def label(self, value, chain):
        ...         return {"fastest": Variable(value, long_name="greatest velocity")}
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "watch.py"
        ...     _ = file.write_text(code)
        ...     fastest = load_observer(f"{file}:Fastest", "mine")
        >>> {fastest.__name__: fastest}.keys()  # `custom_observers` of `run_scene`
        dict_keys(['Fastest'])
    """
    return _load("--observer", given, scene, AbstractObserver, "jaxchain.observers")


def _load(option: str, given: str, scene: str, base: type[_Made], module: str) -> type[_Made]:
    """A subclass of `base`, a name of `module`, from "FILE.py:CLASS"."""

    def wrong(what: str) -> SceneError:
        return SceneError(scene, [f'{option} "{given}": {what}'])

    file, _, name = given.rpartition(":")
    if not file or not name:
        raise wrong("must look like FILE.py:CLASS")
    if not os.path.isfile(file):  # which never raises
        raise wrong(f"there is no file {file}")
    spec = importlib.util.spec_from_file_location(Path(file).stem, file)
    if spec is None or spec.loader is None:
        raise wrong(f"{file} is no Python file")
    code = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module there; no existing name is replaced.
    sys.modules.setdefault(spec.name, code)
    sys.path.insert(0, str(Path(file).parent.resolve()))  # workers import the file by its name
    try:
        spec.loader.exec_module(code)
    except (Exception, SystemExit) as error:
        raise wrong(f"{file} fails: {type(error).__name__}: {error}") from error

    def fits(value: Any) -> bool:
        return inspect.isclass(value) and issubclass(value, base)

    if not hasattr(code, name):
        kinds = [key for key, value in vars(code).items() if fits(value) and value is not base]
        near = did_you_mean(name, kinds)
        raise wrong(f"{file} has no class {name}{near}; it has: {', '.join(kinds) or 'none'}")
    if not fits(getattr(code, name)):
        raise wrong(f"{name} is not a subclass of `{module}.{base.__name__}`")
    return getattr(code, name)
