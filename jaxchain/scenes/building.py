"""The chain or cells, start, observers and solver of an experiment, from its tables.

A scene contains only the numbers of a custom friction law, model or observer; its code runs only
if its file is named on the command line.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import inspect
import keyword
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

from .. import observers, solvers
from .._checks import to_float
from .._spelling import did_you_mean
from .._types import State
from ..model import friction, initial_states, ready_made
from ..model.arguments import as_state
from ..model.cells import AbstractCells
from ..model.chain import Chain
from ..model.friction import AbstractFrictionLaw
from ..model.model import AbstractModel
from ..model.parameters import CHAIN
from ..model.tabulated import TabulatedFriction
from ..observers.base import AbstractObserver
from ..simulation.method import check_resolved, fit_linear_solve
from ..sweeps.axes import check_axes
from ..sweeps.ensemble import check_observers
from .files import SceneError
from .scene import (
    AbstractExperiment,
    AnyExperiment,
    CellsExperiment,
    Experiment,
    LoadedScene,
)
from .tables import (
    CustomLawTable,
    CustomObserverTable,
    ExcitedTable,
    ObserveTable,
    Table,
    TabulatedTable,
)

LAWS = {
    "exponential_decay": friction.ExponentialDecay,
    "weakening_strengthening": friction.WeakeningStrengthening,
    "gaussian_stribeck": friction.GaussianStribeck,
    "coulomb": friction.Coulomb,
}
# The classes of cells that a scene may name without a file.
READY_MADE: dict[str, type[AbstractCells]] = {
    name: kind
    for name, kind in vars(ready_made).items()
    if inspect.isclass(kind) and issubclass(kind, AbstractCells)
    if kind.__module__ == ready_made.__name__ and not name.startswith("_")
}
_Made = TypeVar("_Made")


def build_chain(
    experiment: Experiment, custom_law: type[AbstractFrictionLaw] | None = None
) -> Chain:
    """The chain of an experiment, with the first value of every swept number.

    `custom_law` replaces the law that the experiment names.

    **Raises:** `ValueError` for inconsistent numbers, or numbers that do not fit the law.
    """
    table, grid = experiment.chain, experiment.grid()

    def number(name: str) -> Any:
        given = float(grid[name][0]) if name in grid else experiment.given(name)
        return np.array(given, float) if isinstance(given, list) else given

    smoothed = _build_friction(experiment, "chain", custom_law)
    return Chain(table.n, smoothed, ends=table.ends, **{name: number(name) for name in CHAIN})


def _build_friction(
    experiment: AbstractExperiment, path: str, custom_law: type[AbstractFrictionLaw] | None
) -> friction.TanhFriction:
    table, grid = experiment.friction, experiment.grid()
    numbers: dict[str, Any] = {
        name: float(grid[name][0]) if name in grid else getattr(table, name)
        for name in experiment.friction_numbers()
    }
    width = numbers.pop("width")
    if custom_law is not None:
        law = make(custom_law, numbers, f"{path}.friction")
    elif isinstance(table, CustomLawTable):
        raise ValueError(
            f'{path}.friction.law: is "custom", so the law must be named on the command line: '
            "--law FILE.py:CLASS"
        )
    elif isinstance(table, TabulatedTable):
        law = TabulatedFriction(table.speed, table.mu)
    else:
        law = LAWS[table.law](**numbers)
    return friction.TanhFriction(law, width)


def build_cells(
    experiment: CellsExperiment,
    custom_law: type[AbstractFrictionLaw] | None = None,
    custom_models: Mapping[str, type[AbstractCells]] | None = None,
) -> AbstractCells:
    """The cells of an experiment, with the first value of every swept number.

    **Raises:** `ValueError` for a class that is not known, and for numbers that do not fit it.
    """
    table, known = experiment.model, READY_MADE | dict(custom_models or {})
    if table.kind not in known:
        raise ValueError(
            f"model.kind: is `{table.kind}`, so this class must be named on the command line: "
            f"--model FILE.py:{table.kind}{did_you_mean(table.kind, known)}; ready-made are "
            f"{', '.join(READY_MADE)}"
        )
    kind = known[table.kind]
    static = {f.name: f.metadata.get("static", False) for f in dataclasses.fields(kind)}
    given = table.model_dump(exclude={"kind", "n", "friction"}, exclude_none=True)
    given |= {name: float(v[0]) for name, v in experiment.grid().items() if name in static}
    numbers = {k: v if static.get(k, True) else to_float(v, k) for k, v in given.items()}
    if isinstance(table.friction, Table):
        numbers["friction"] = _build_friction(experiment, "model", custom_law)
    elif table.friction is not None:
        numbers["friction"] = to_float(table.friction, "friction")
    return make(kind, numbers, "model")


def component_names(experiment: CellsExperiment, cells: AbstractCells) -> tuple[str, ...]:
    """The names of the m variables of a cell; if it has none, their numbers 0 ... m - 1."""
    names = cells.components or tuple(map(str, range(len(experiment.initial))))
    if not names:
        raise ValueError(
            "initial: must have all numbers of a cell, such as `0 = 0.0`, because "
            f"`{experiment.model.kind}` does not name them in `components`"
        )
    return names


def _component(given: str | int, names: Sequence[str], where: str) -> int:
    """The number of a component from its name or number, or `ValueError`."""
    numbers = {str(k): k for k in range(len(names))} | {name: k for k, name in enumerate(names)}
    if str(given) not in numbers:
        near = did_you_mean(str(given), numbers)
        raise ValueError(f"{where} is not a number of a cell{near}; it has: {', '.join(numbers)}")
    return numbers[str(given)]


def build_start(experiment: CellsExperiment, cells: AbstractCells) -> Callable[..., State]:
    """The initial state as a function of the cells and of the swept numbers of the start.

    A number that is swept has its name as a parameter, or `component_K` if its name cannot be one.
    """
    names, n, given = component_names(experiment, cells), experiment.n, {}
    for key, value in experiment.initial.items():
        k = _component(key, names, f"initial.{key}:")
        if k in given:
            raise ValueError(
                f"initial.{key}: is given twice, by name and by number: leave one out"
            )
        given[k] = np.asarray(value, float)
    fields = cells.parameters()
    parameters = [
        f"component_{k}"
        if name in fields or keyword.iskeyword(name) or not name.isidentifier()
        else name
        for k, name in enumerate(names)
    ]
    allowed = [*fields, *parameters]
    for name in experiment.sweep:
        if name not in allowed:
            near = did_you_mean(name, allowed)
            raise ValueError(f"sweep.{name}: cannot be swept{near}; allowed: {', '.join(allowed)}")

    def start(_: AbstractCells, **own: Any) -> State:
        parts = (own.get(name, given.get(k, 0.0)) for k, name in enumerate(parameters))
        return tuple(jnp.broadcast_to(jnp.asarray(part, float), (n,)) for part in parts)

    taken = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None)
        for name in parameters
    ]
    first = inspect.Parameter("_", inspect.Parameter.POSITIONAL_ONLY)
    start.__signature__ = inspect.Signature([first, *taken])
    return start


def build_initial(experiment: Experiment) -> Callable[..., State]:
    """The initial state as a function of the chain and of the swept parameters."""
    table = experiment.initial
    start = table.model_dump(exclude={"kind"}, exclude_none=True)
    if not isinstance(table, ExcitedTable):
        return functools.partial(getattr(initial_states, table.kind), **start)
    masses, chosen = table.excited, start.pop("oscillators", None)
    if chosen is not None:
        masses = jnp.asarray(np.isin(np.arange(1, experiment.chain.n + 1), chosen))

    def pulled_away(
        chain: Chain,
        excited: Any = masses,
        displacement: Any = table.displacement,
        velocity: Any = table.velocity,
    ) -> State:
        how: Any = {"block": table.block, "pattern": table.pattern}
        return initial_states.excited_state(
            chain, excited, amplitude=displacement, velocity=velocity, **how
        )

    return pulled_away


def build_observers(
    table: ObserveTable,
    window: float,
    custom_observers: Mapping[str, type[AbstractObserver]] | None = None,
    components: Sequence[str] = (),
) -> list[AbstractObserver]:
    """Amplitudes in the window, the observers of the table, and further custom observers.

    `components`, the names of the variables of a cell, which a table may refer to.

    **Raises:** `ValueError` for a custom observer that is missing or cannot be constructed.
    """
    how = table.model_dump(exclude={"quantities", "others"})
    if "component" in how:
        how["component"] = _component(how["component"], components, "observe.component:")
    watch: list[AbstractObserver] = [observers.Amplitude(window=window, **how)]
    unnamed = dict(custom_observers or {})
    for i, other in enumerate(table.others or []):
        if isinstance(other, CustomObserverTable):
            if other.name not in (custom_observers or {}):
                raise ValueError(
                    f"observe.others[{i}].name: is `{other.name}`, so this observer must be named "
                    f"on the command line: --observer FILE.py:{other.name}"
                )
            kind = unnamed.pop(other.name)
            watch.append(make(kind, other.model_extra or {}, f"observe.others[{i}]"))
            continue
        fields = other.model_dump(exclude={"observer"})
        for key in ("oscillator", "middle", "oscillators"):  # counted from 1 in a scene
            if fields.get(key) is not None:
                numbers = np.subtract(fields[key], 1).tolist()
                fields[key] = tuple(numbers) if key == "oscillators" else numbers
        if "component" in fields:
            where = f"observe.others[{i}].component:"
            fields["component"] = _component(fields["component"], components, where)
        watch.append(getattr(observers, other.observer)(**fields))
    return watch + [make(kind, {}, "--observer") for kind in unnamed.values()]


def build(
    experiment: AnyExperiment,
    custom_law: type[AbstractFrictionLaw] | None = None,
    custom_observers: Mapping[str, type[AbstractObserver]] | None = None,
    custom_models: Mapping[str, type[AbstractCells]] | None = None,
) -> tuple[Chain | AbstractCells, Callable[..., State], list[AbstractObserver]]:
    """The chain or cells of an experiment, the initial state as a function, and the observers."""
    observed = experiment.observe, experiment.time.window, custom_observers
    if isinstance(experiment, Experiment):
        chain = build_chain(experiment, custom_law)
        return chain, build_initial(experiment), build_observers(*observed)
    cells = build_cells(experiment, custom_law, custom_models)
    names = component_names(experiment, cells)
    return cells, build_start(experiment, cells), build_observers(*observed, names)


def build_solver(
    name: str, model: AbstractModel, rtol: float, max_step: float
) -> dfx.AbstractSolver | None:
    """A solver by its name in a scene; None leaves the choice to `sweep`."""
    if name == "auto":
        return None
    if name in ("Rodas4", "Rodas5P"):
        return fit_linear_solve(getattr(solvers, name)(), model, rtol, max_step)
    return getattr(dfx, name)()


def checked_chains(
    loaded: LoadedScene,
    custom_law: type[AbstractFrictionLaw] | None = None,
    custom_observers: Mapping[str, type[AbstractObserver]] | None = None,
    custom_models: Mapping[str, type[AbstractCells]] | None = None,
) -> dict[str, Chain | AbstractCells]:
    """The chain or cells of every experiment of a scene.

    **Raises:** `SceneError`, before anything runs, with all problems that appear only when chain,
    start, observers and tolerances are combined.
    """
    chains, problems, experiments = {}, [], loaded.scene.experiment
    used = {one.model.kind for one in experiments.values() if isinstance(one, CellsExperiment)}
    for name in custom_models or {}:
        if name in READY_MADE:
            problems.append(f"--model: {name} is a ready-made class: give yours another name")
        elif name not in used:
            problems.append(f'--model: no experiment has `model.kind` = "{name}"')
    for name, experiment in experiments.items():
        try:
            built = build(experiment, custom_law, custom_observers, custom_models)
            chains[name] = built[0]
            _check(experiment, *built)
        except ValueError as error:
            problems.append(f"experiment.{name}: {error}")
    if problems:
        raise SceneError(loaded.name, problems)
    return chains


def _check(
    experiment: AnyExperiment, model: Any, initial: Any, observe: list[AbstractObserver]
) -> None:
    numerics, time = experiment.numerics, experiment.time
    axes = check_axes(model, initial, experiment.grid())
    m = len(model.variables) or len(as_state(model, initial(model)))
    model.dependence((jnp.zeros(experiment.n),) * m)  # raises for a `rate` that does not fit
    size = m, experiment.n
    check_observers(observe, model, size, 0.0, time.transient + time.window, None, axes)
    solver = None
    if numerics.model != "dry":
        solver = build_solver(numerics.solver, model, numerics.rtol, numerics.max_step)
    scale = model.smallest_scale(experiment.n)
    if numerics.model != "dry" and scale is not None:
        swept: dict[str, Any] = {name: axis[name] for name, axis in axes.items()}
        scale = swept.get("width", scale[0]), swept.get("belt_speed", scale[1])
        check_resolved(experiment.n, scale, numerics.rtol, numerics.atol, solver)


def load_model(given: str, scene: str) -> type[AbstractCells]:
    """Loads the model "FILE.py:CLASS".  This runs the file.

    **Arguments:** `given`, as above; `scene`, the name that an error bears.

    **Returns:** the class, for `custom_models` of `run_scene`, by its name.

    **Raises:** `SceneError` if the file or class does not exist, if the class is not a subclass of
    `AbstractCells`, or if the file fails.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes import load_model
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
        >>> from jaxchain.scenes import load_law
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
        >>> from jaxchain.scenes import load_observer
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


def make(kind: type[_Made], numbers: Mapping[str, Any], where: str) -> _Made:
    """A custom law, model or observer with the numbers at `where` of a scene.

    **Raises:** `ValueError` for numbers that are not its fields, or are missing.
    """
    fields = inspect.signature(kind)
    try:
        fields.bind(**{key: value for key, value in numbers.items() if value is not None})
        return kind(**numbers)
    except TypeError as error:
        names = ", ".join(fields.parameters) or "none"
        unknown = next((name for name in numbers if name not in fields.parameters), "")
        names += did_you_mean(unknown, fields.parameters)
        message = f"{where}: {kind.__name__} cannot be made: {error}; its fields: {names}"
        raise ValueError(message) from error
