"""What an experiment is computed with: chain, start, observers and solver, from its tables."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

from .. import observers
from .._types import ScalarLike, State
from ..model import friction, initial_states
from ..model.chain import Chain
from ..model.parameters import CHAIN
from ..model.tabulated import TabulatedFriction
from ..observers.base import AbstractObserver
from ..simulation.accuracy import check_resolved, fit_linear_solve
from ..solvers.rosenbrock import Rodas4, Rodas5P
from ..sweeps.axes import check_axes
from ..sweeps.ensemble import check_observers
from .errors import SceneError
from .observing import ObserveTable, OwnObserverTable
from .own_code import make_law, make_observer
from .reading import LoadedScene
from .scene import Experiment, SweepTable
from .tables import Equation8Table, Equation10Table, OwnLawTable, TabulatedTable

if TYPE_CHECKING:
    from xarray import Dataset

LAWS = {
    "exponential_decay": friction.ExponentialDecay,
    "weakening_strengthening": friction.WeakeningStrengthening,
    "gaussian_stribeck": friction.GaussianStribeck,
    "coulomb": friction.Coulomb,
}

# What the numbers of a start mean: a sweep, for which they may be anything, does not know.
_OF_THE_START = {
    "displacement": ("how far excited masses are pulled away at the start", "x0"),
    "velocity": ("velocity of every mass at the start", "x0 omega_n"),
}


def build_chain(
    experiment: SweepTable, own_law: type[friction.AbstractFrictionLaw] | None = None
) -> Chain:
    """The chain of an experiment, with the first value of everything that is swept.

    `own_law` takes the place of the law that the experiment names.

    **Raises:** `ValueError` for numbers that do not go together, or do not make this law.
    """
    table, grid = experiment.chain, experiment.grid()

    def number(name: str) -> Any:
        if name in grid:
            return float(grid[name][0])
        given = experiment.given(name)
        return np.array(given, float) if isinstance(given, list) else given

    law = {name: number(name) for name in experiment.friction_numbers()}
    width = law.pop("width")
    return Chain(
        table.n,
        friction.TanhFriction(_law(table.friction, law, own_law), width),
        ends=table.ends,
        **{name: number(name) for name in CHAIN},
    )


def _law(
    table: Any, numbers: dict[str, Any], own: type[friction.AbstractFrictionLaw] | None
) -> friction.AbstractFrictionLaw:
    if own is not None:
        return make_law(own, numbers)
    if isinstance(table, OwnLawTable):
        raise ValueError(
            'chain.friction.law: is "own", so the law must be named on the command line: '
            "--law FILE.py:CLASS"
        )
    if isinstance(table, TabulatedTable):
        return TabulatedFriction(table.speed, table.mu)
    return LAWS[table.law](**numbers)


def build_initial(experiment: SweepTable) -> Callable[..., State]:
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


def describe_start(data: Dataset) -> None:
    """Says of the numbers of a start what they are, where they were swept; in place."""
    for name in _OF_THE_START.keys() & set(map(str, data.coords)):
        words, unit = _OF_THE_START[name]
        data[name].attrs |= {"long_name": words, "units": unit}


def build_observers(
    table: ObserveTable,
    window: float,
    own_observers: Mapping[str, type[AbstractObserver]] | None = None,
) -> list[AbstractObserver]:
    """Amplitudes in the window, what else the table names, and own observers that it does not.

    **Raises:** `ValueError` for an observer of one's own that is not there, or cannot be made.
    """
    how = table.model_dump(exclude={"quantities", "others"})
    found: list[AbstractObserver] = [observers.Amplitude(window=window, **how)]
    unnamed = given = dict(own_observers or {})
    for i, other in enumerate(table.others or []):
        if isinstance(other, OwnObserverTable):
            if other.name not in given:
                raise ValueError(
                    f"observe.others[{i}].name: is `{other.name}`, so this observer must be named "
                    f"on the command line: --observer FILE.py:{other.name}"
                )
            numbers = other.model_extra or {}
            place = f"observe.others[{i}]"
            found.append(make_observer(given[other.name], numbers, place))
            unnamed = {k: v for k, v in unnamed.items() if k != other.name}
            continue
        own = other.model_dump(exclude={"observer"})
        for key in own.keys() & {"oscillator", "middle"}:
            own[key] = None if own[key] is None else own[key] - 1
        if own.get("oscillators"):
            own["oscillators"] = tuple(number - 1 for number in own["oscillators"])
        found.append(getattr(observers, other.observer)(**own))
    return found + [make_observer(kind, {}, "--observer") for kind in unnamed.values()]


def check_experiment(
    experiment: Experiment, chain: Chain, observe: list[AbstractObserver]
) -> None:
    """Raises `ValueError` for what only chain, start and observers together show.

    What `sweep` would say, before anything runs.
    """
    numerics, time, initial = experiment.numerics, experiment.time, build_initial(experiment)
    axes = check_axes(chain, initial, experiment.grid())
    check_observers(observe, chain, 0.0, time.transient + time.window, None, axes)
    if numerics.model != "nonsmooth":
        build_solver(numerics.solver, chain, numerics.rtol, numerics.max_step)
        swept: dict[str, Any] = {name: own[name] for name, own in axes.items()}
        width, speed = swept.get("width", chain.width), swept.get("belt_speed", chain.belt_speed)
        check_resolved(chain.n, width, speed, numerics.rtol, numerics.atol)


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


def checked_chains(
    loaded: LoadedScene,
    own_law: type[friction.AbstractFrictionLaw] | None = None,
    own_observers: Mapping[str, type[AbstractObserver]] | None = None,
) -> dict[str, Chain]:
    """The chain of every experiment of a scene.

    **Raises:** `SceneError` with everything that cannot be run, before anything is.
    """
    chains, problems = {}, []
    for name, experiment in loaded.scene.experiment.items():
        try:
            chains[name] = chain = build_chain(experiment, own_law)
            window = experiment.time.window
            observe = build_observers(experiment.observe, window, own_observers)
            check_experiment(experiment, chain, observe)
        except ValueError as error:
            problems.append(f"experiment.{name}: {error}")
    if problems:
        raise SceneError(loaded.name, problems)
    return chains
