"""The chain, start, observers and solver of an experiment, from its tables.

A scene contains only the numbers of a custom friction law or observer; its code runs only if its
file is named on the command line.
"""

from __future__ import annotations

import functools
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

from .. import observers, solvers
from .._types import State
from ..model import friction, initial_states
from ..model.chain import Chain
from ..model.friction import AbstractFrictionLaw
from ..model.parameters import CHAIN
from ..model.tabulated import TabulatedFriction
from ..observers.base import AbstractObserver
from ..simulation.accuracy import check_resolved, fit_linear_solve
from ..sweeps.axes import check_axes
from ..sweeps.ensemble import check_observers
from .files import SceneError, did_you_mean
from .scene import Experiment, LoadedScene
from .tables import CustomLawTable, CustomObserverTable, ExcitedTable, ObserveTable, TabulatedTable

LAWS = {
    "exponential_decay": friction.ExponentialDecay,
    "weakening_strengthening": friction.WeakeningStrengthening,
    "gaussian_stribeck": friction.GaussianStribeck,
    "coulomb": friction.Coulomb,
}
_Made = TypeVar("_Made")


def build_chain(
    experiment: Experiment, custom_law: type[AbstractFrictionLaw] | None = None
) -> Chain:
    """The chain of an experiment, with the first value of every swept number.

    `custom_law` takes the place of the law that the experiment names.

    **Raises:** `ValueError` for inconsistent numbers, or numbers that do not fit the law.
    """
    table, grid = experiment.chain, experiment.grid()

    def number(name: str) -> Any:
        given = float(grid[name][0]) if name in grid else experiment.given(name)
        return np.array(given, float) if isinstance(given, list) else given

    numbers = {name: number(name) for name in experiment.friction_numbers()}
    width = numbers.pop("width")
    if custom_law is not None:
        law = make(custom_law, numbers, "chain.friction")
    elif isinstance(table.friction, CustomLawTable):
        raise ValueError(
            'chain.friction.law: is "custom", so the law must be named on the command line: '
            "--law FILE.py:CLASS"
        )
    elif isinstance(table.friction, TabulatedTable):
        law = TabulatedFriction(table.friction.speed, table.friction.mu)
    else:
        law = LAWS[table.friction.law](**numbers)
    smoothed = friction.TanhFriction(law, width)
    return Chain(table.n, smoothed, ends=table.ends, **{name: number(name) for name in CHAIN})


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
) -> list[AbstractObserver]:
    """Amplitudes in the window, the observers of the table, and further custom observers.

    **Raises:** `ValueError` for a custom observer that is missing or cannot be constructed.
    """
    how = table.model_dump(exclude={"quantities", "others"})
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
        watch.append(getattr(observers, other.observer)(**fields))
    return watch + [make(kind, {}, "--observer") for kind in unnamed.values()]


def build_solver(
    name: str, chain: Chain, rtol: float, max_step: float
) -> dfx.AbstractSolver | None:
    """A solver by its name in a scene; None leaves the choice to `sweep`."""
    if name == "auto":
        return None
    if name in ("Rodas4", "Rodas5P"):
        return fit_linear_solve(getattr(solvers, name)(), chain, rtol, max_step)
    return getattr(dfx, name)()


def checked_chains(
    loaded: LoadedScene,
    custom_law: type[AbstractFrictionLaw] | None = None,
    custom_observers: Mapping[str, type[AbstractObserver]] | None = None,
) -> dict[str, Chain]:
    """The chain of every experiment of a scene.

    **Raises:** `SceneError`, before anything runs, with all problems that appear only when chain,
    start, observers and tolerances are combined.
    """
    chains, problems = {}, []
    for name, experiment in loaded.scene.experiment.items():
        try:
            chains[name] = chain = build_chain(experiment, custom_law)
            observe = build_observers(experiment.observe, experiment.time.window, custom_observers)
            _check(experiment, chain, observe)
        except ValueError as error:
            problems.append(f"experiment.{name}: {error}")
    if problems:
        raise SceneError(loaded.name, problems)
    return chains


def _check(experiment: Experiment, chain: Chain, observe: list[AbstractObserver]) -> None:
    numerics, time = experiment.numerics, experiment.time
    axes = check_axes(chain, build_initial(experiment), experiment.grid())
    check_observers(observe, chain, (2, chain.n), 0.0, time.transient + time.window, None, axes)
    if numerics.model != "dry":
        build_solver(numerics.solver, chain, numerics.rtol, numerics.max_step)
        swept: dict[str, Any] = {name: axis[name] for name, axis in axes.items()}
        width, speed = swept.get("width", chain.width), swept.get("belt_speed", chain.belt_speed)
        check_resolved(chain.n, width, speed, numerics.rtol, numerics.atol)


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


def make(kind: type[_Made], numbers: Mapping[str, Any], place: str) -> _Made:
    """A custom law or observer with the numbers at `place` of a scene.

    **Raises:** `ValueError` for numbers that are not its fields, or are missing.
    """
    fields = inspect.signature(kind)
    try:
        fields.bind(**{key: value for key, value in numbers.items() if value is not None})
        return kind(**numbers)
    except TypeError as error:
        names = ", ".join(fields.parameters) or "none"
        message = f"{place}: {kind.__name__} cannot be made: {error}; its fields: {names}"
        raise ValueError(message) from error
