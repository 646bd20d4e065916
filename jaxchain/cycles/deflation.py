"""Cycles that are not known yet: Newton's method that known cycles repel.

The residual R of the shooting equations is multiplied by

    prod_k (1 + 1 / d_k^2),     d_k = min |u - u_k|,

one factor for each known cycle k, the minimum over all points u_k at which the cycle, or an image
of it under the ring's rotations and reflections, crosses the section of the search.  The product
removes the zeros of R at known cycles and keeps all others (Farrell, Birkisson, Funke, Deflation
techniques for finding distinct solutions of nonlinear partial differential equations, SIAM Journal
on Scientific Computing 37, 2015).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import check_flag, check_kind, check_whole, shown, to_float
from .._progress import progress_bar
from .._types import Given, ScalarLike, State
from ..continuation.damped_newton import check_tolerance
from ..model.arguments import as_chain, as_images, as_mass, as_model, as_state
from ..model.chain import Chain, require_smoothed, steady_sliding
from ..model.initial_states import reference_site
from ..model.model import AbstractModel
from ..observers.samples import Trajectory
from ..observers.section import Section
from ..result import Printed, name_of
from ..simulation.method import MAX_STEP, check_tolerances
from ..simulation.run import simulate
from .averaging import one_mass
from .floquet import LimitCycle, cycle_solver
from .limit_cycle import find_limit_cycle, guess_from_point, solve_cycle, watched
from .orbit import units_of
from .shooting import Shooting
from .symmetry import ring_motions

# Points of the section kept of each image of a cycle; the least number of cycles that a program
# can know, which doubles.
_POINTS, _KNOWN = 6, 8
# Two cycles are one if they cross the section this close, relative to the size of its unknowns.
_SAME = 1e-5
_PHASES = 64


@dataclass(repr=False)
class CycleSearch(Printed):
    """The cycles that `find_limit_cycles` found.

    - `cycles`: new ones, none a copy of another or of a known one under time shift, rotation or
      reflection, in the order in which they were found.
    - `outcomes`, shape (rounds, starts): the index of the cycle to which each start led, or -1.
    - `failures`: how often a start led to nothing new, by reason; "copy": to a known cycle; "not
      isolated": a multiplier is so close to 1 that copies cannot be told from other cycles, as for
      masses that are not coupled; "shorter period": a forced cycle that closes sooner.
    - `gave_up`: why the search ended.

    See `find_limit_cycles` for an example.
    """

    cycles: list[LimitCycle]
    outcomes: np.ndarray
    failures: dict[str, int]
    gave_up: str


class _Search(eqx.Module):
    """The equations, and the points of known cycles; infinite where there is none."""

    shooting: Shooting
    known: Float[Array, "cycles points m"]
    tolerance: Array
    limit: Any

    def solve(self, state: State, period: Array) -> tuple[LimitCycle, Array]:
        """The cycle that a start leads to, repelled by the known ones."""
        return solve_cycle(
            self.shooting, state, period, self.tolerance, self.limit, known=self.known
        )


@eqx.filter_jit
def _solve_all(search: _Search, states: Any, periods: Array) -> tuple[LimitCycle, Array]:
    return jax.vmap(search.solve)(states, periods)


@eqx.filter_jit
def _on_the_section(shooting: Shooting, states: Any, periods: Array) -> Any:
    """The starts; one in which the mass does not move along the belt, run to where it is fastest.

    The equations divide by this velocity.
    """
    field, mass = shooting.field, shooting.mass

    def point(start: Any) -> State:
        state, period = start
        fastest = guess_from_point(field, state, period, mass)
        along = field.belt_direction() * field.value_and_rate(0.0, state)[1][mass]
        return jax.tree.map(lambda a, b: jnp.where(along > 0, a, b), state, fastest)

    return jax.lax.map(point, (states, periods))


@eqx.filter_jit
def _crossings(shooting: Shooting, images: Any, period: Array) -> Float[Array, "images p m"]:
    """Where each image of a cycle crosses the section, NaN in the rows that are left.

    A forced cycle is cut at every period of the force.
    """
    forcing_periods, forced = shooting.forcing_periods, shooting.field.forcing_period()
    watch = Section(shooting.mass, _POINTS, of="velocity")
    if forcing_periods is not None:
        watch = Trajectory(to_float(forced) * jnp.arange(forcing_periods))

    def of(state: State) -> Array:
        parts = watched(shooting.field, state, 1.05 * period, watch)
        parts = parts[1:] if forcing_periods is None else parts
        return jax.vmap(lambda *point: shooting.pack(point, period))(*parts)

    return jax.lax.map(of, images)


def _points(shooting: Shooting, cycle: LimitCycle, motions: list[np.ndarray]) -> np.ndarray:
    """The unknowns at all crossings of a cycle and its images, of shape (points, m)."""
    images = tuple(jnp.stack([part[at] for at in motions]) for part in cycle.state)
    points = np.asarray(_crossings(shooting, images, cycle.period))
    points = points.reshape(-1, points.shape[-1])
    return points[np.all(np.isfinite(points), axis=1)]


def _distance(points: np.ndarray, u: np.ndarray) -> float:
    """The least distance of u from the points, relative to the size of u."""
    if not len(points):
        return np.inf
    gaps = np.sqrt(np.mean((points - u) ** 2, axis=1))
    return float(np.min(gaps) / (1.0 + np.sqrt(np.mean(u**2))))


def _is_isolated(cycle: LimitCycle, rtol: float) -> bool:
    """Whether errors of the orbit, divided by |1 - mu|, stay below what tells cycles apart."""
    gaps = np.abs(1.0 - np.asarray(cycle.multipliers))
    error = max(float(cycle.residual), rtol)
    return bool(error < _SAME * np.nanmin(gaps, initial=np.inf))


def random_starts(
    chain: Chain, count: int, mass: int, key: int = 0
) -> tuple[tuple[Array, ...], Float[np.ndarray, " starts"]]:
    """States in which random masses vibrate with random phases, and the period of one mass.

    Mass `mass` vibrates as it does while its neighbours are fixed, and so does each of the others
    with probability 1/2, at a random phase; the rest slide steadily.

    **Returns:** ((x, v), both of shape (count, n), periods of shape (count,)).

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.cycles.deflation import random_starts
    >>> (x, v), periods = random_starts(paper_chain(3, width=1e-2), 5, mass=1)
    >>> x.shape, periods.shape
    ((5, 3), (5,))
    """
    alone = find_limit_cycle(one_mass(chain, mass))
    times = jnp.linspace(0.0, alone.period, _PHASES, endpoint=False)
    run = simulate(alone.chain, alone.state, alone.period, observe=Trajectory(times))
    motion = [np.asarray(part)[:, 0] for part in run.observed]
    rng, rest = np.random.default_rng(key), steady_sliding(chain)
    phases = rng.integers(_PHASES, size=(count, chain.n))
    vibrates = rng.random((count, chain.n)) < 0.5
    phases[:, mass], vibrates[:, mass] = 0, True
    parts = (
        jnp.asarray(np.where(vibrates, part[phases], np.asarray(still)))
        for part, still in zip(motion, rest, strict=True)
    )
    return tuple(parts), np.full(count, float(alone.period))


def find_limit_cycles(
    model: AbstractModel,
    guesses: Any = 200,
    *,
    known: Iterable[LimitCycle] = (),
    mass: Given[int | None] = None,
    rounds: Given[int] = 3,
    key: Any = 0,
    tolerance: Given[ScalarLike] = 1e-9,
    rtol: Given[ScalarLike] = 1e-9,
    max_steps: Given[int] = 40,
    lanes: Given[int] = 16,
    progress: bool = False,
) -> CycleSearch:
    """Limit cycles that are not known yet, stable or not, from many starts.

    Each round runs Newton's method from every start, repelled by all cycles that are known by
    then, also by their images under the ring's rotations and reflections.  What is found is solved
    for again without the repulsion, so that it is a cycle to `tolerance`.

    **Arguments:**

    - `model`: a `Chain` with smoothed friction, or any other model.
    - `guesses`: (states, periods), a state with a first axis over the starts, best where mass
      `mass` is fastest, and periods of shape (starts,).  For a `Chain` also a number: so many
      starts from `random_starts`, with the seed `key`.
    - `known`: cycles of this model that are not looked for.
    - `mass`: the index of the mass at whose greatest velocity cycles are cut.  Only cycles in
      which it vibrates are found; in a ring of equal masses these are all, up to rotations.
    - `rounds`: the search also ends after a round without a new cycle.
    - `tolerance`, `rtol`, `max_steps`: as for `find_limit_cycle`; `lanes`: searches side by side.

    **Returns:** a `CycleSearch`.  That a cycle is not among them does not prove that there is
    none.

    **Raises:** `ValueError` for bad input.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.cycles import find_limit_cycles
        >>> search = find_limit_cycles(paper_chain(2, width=1e-2), 8, rounds=2, lanes=8)
        >>> all(cycle.residual < 1e-9 for cycle in search.cycles)
        True
    """
    as_model(model)
    require_smoothed(model, "use `find_limit_cycle`, ")
    check_tolerances(rtol, None, MAX_STEP)
    limit = check_tolerance(tolerance, max_steps)
    for name, value in (("rounds", rounds), ("lanes", lanes)):
        check_whole(name, value)
    check_whole("key", key, 0, remedy="it is the seed of the starts.")
    check_flag("progress", progress)
    wanted = "a sequence of `LimitCycle`s"
    check_kind("known", known, Iterable, wanted, "() if none is known.")
    for i, cycle in enumerate(known := list(known)):
        check_kind(f"known[{i}]", cycle, LimitCycle, "a `LimitCycle`")
    if isinstance(guesses, int) and not isinstance(guesses, bool):
        ring = as_chain(
            model, remedy="give `guesses` = (states, periods) for other models.", name="model"
        )
        check_whole("guesses", guesses)
        start = int(as_mass(ring.n, mass, reference_site(ring.n)))
        guesses = random_starts(ring, guesses, start, key)
    states, periods = _checked_starts(model, guesses)
    n, m = states[0].shape[1], len(states)
    mass = int(as_mass(n, mass, reference_site(n)))
    one = tuple(part[0] for part in states)
    forced = model.forcing_period()
    forcing_periods = None
    if forced is not None:
        every = np.unique(np.round(periods / float(forced)))
        if len(every) > 1 or not np.allclose(periods, every[0] * float(forced)) or every[0] < 1:
            raise ValueError(
                f"Argument `guesses` has the periods {np.unique(periods)}, but they must be one "
                f"multiple of that of the force, {float(forced):g}."
            )
        forcing_periods = int(every[0])
    solver = cycle_solver(model, rtol, one)
    images = as_images(None, n, mass)
    shape = None, m, forcing_periods, None, units_of(model, one)
    shooting = Shooting(model, rtol, solver, mass, images, *shape)
    if forcing_periods is None:
        states = _on_the_section(shooting, states, jnp.asarray(periods))
    motions = ring_motions(model, one)
    points = [_points(shooting, cycle, motions) for cycle in known]
    search = _Search(shooting, _stacked([], shooting.size), to_float(tolerance), np.asarray(limit))
    free, cycles, outcomes, failures = search, [], [], {}
    gave_up = f"After {rounds} rounds; more may find more."
    total = rounds * len(periods)
    with progress_bar(total=total, desc="cycles", unit="search", show=progress) as bar:
        for _ in range(rounds):
            before = len(cycles)
            search = eqx.tree_at(lambda s: s.known, search, _stacked(points, shooting.size))
            row = np.full(len(periods), -1)
            for first in range(0, len(periods), lanes):
                index = np.minimum(np.arange(first, first + lanes), len(periods) - 1)
                batch = tuple(part[index] for part in states), jnp.asarray(periods[index])
                rough, _ = _solve_all(search, *batch)
                period = jnp.where(rough.successful, rough.period, jnp.nan)  # no second search
                fine, unknowns = _solve_all(free, rough.state, period)
                for k, i in enumerate(index[: len(periods) - first]):
                    pair = [jax.tree.map(lambda a, k=k: a[k], cycle) for cycle in (rough, fine)]
                    names = [name_of(cycle.result) for cycle in pair]
                    cycle = eqx.tree_at(lambda c: c.chain, pair[1], model)
                    reason = next((name for name in names if name != "successful"), "")
                    if not reason and not _is_isolated(cycle, float(rtol)):
                        reason = "not isolated"
                    u = np.asarray(unknowns[k])
                    near = [j for j, p in enumerate(points) if _distance(p, u) < _SAME]
                    if not reason and near:
                        reason = "copy"
                        row[i] = near[0] - (len(points) - len(cycles))
                    if not reason and int(cycle.times_round) > 1:
                        reason = "shorter period"
                        points.insert(0, _points(shooting, cycle, motions))  # known from now on
                    if reason:
                        failures[reason] = failures.get(reason, 0) + 1
                        continue
                    points.append(_points(shooting, cycle, motions))
                    row[i] = len(cycles)
                    cycles.append(cycle)
                bar.update(min(lanes, len(periods) - first))
            outcomes.append(row)
            if len(cycles) == before:
                gave_up = "The last round found no new cycle from any start."
                break
    return CycleSearch(cycles, np.maximum(np.array(outcomes), -1), failures, gave_up)


def _checked_starts(model: AbstractModel, guesses: Any) -> tuple[tuple[Array, ...], np.ndarray]:
    if not isinstance(guesses, tuple | list) or len(guesses) != 2:
        raise ValueError(
            "Argument `guesses` must be (states, periods), or the number of random starts of a "
            f"`Chain`, but is {shown(guesses)}."
        )
    states = as_state(model, guesses[0], "guesses", batch=True)
    periods = np.asarray(to_float(guesses[1], "guesses"), float)
    if periods.shape != states[0].shape[:1] or not np.all(periods > 0):
        raise ValueError(
            f"Argument `guesses` has {states[0].shape[0]} states, but periods of shape "
            f"{periods.shape}: give a positive one for each state."
        )
    return states, periods


def _stacked(points: list[np.ndarray], m: int) -> Float[Array, "cycles points m"]:
    """The points of all cycles in one array, infinite where there is none.

    Its shape doubles, so that few programs are compiled.
    """
    cycles, most = _KNOWN, _KNOWN
    while cycles < len(points):
        cycles *= 2
    while most < max(map(len, points), default=0):
        most *= 2
    known = np.full((cycles, most, m), np.inf)
    for row, some in zip(known, points, strict=False):
        row[: len(some)] = some
    return jnp.asarray(known)
