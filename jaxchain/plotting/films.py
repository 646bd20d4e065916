"""Films of a chain in motion: who sticks when, and loops that close."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._checks import (
    as_array,
    check_concrete,
    check_finite,
    check_positive_number,
    check_whole,
    numbers_of,
    shown,
)
from ..cycles.guesses import most_lively
from ..model.arguments import as_chain, as_state
from ..model.chain import Chain
from ..observers.samples import Trajectory
from ..observers.section import Section
from ..simulation.accuracy import own_solver
from ..simulation.run import Simulation, simulate
from ..solvers.dry_friction import RESOLUTION

LEAST_FRAMES, MOST_FRAMES = 2, 10**6


def sticking(chain: Chain, states: Any) -> np.ndarray:
    """Which masses stick, of the shape (times, n) of x and v: what `StickTime` adds up.

    With dry friction a mass sticks while v = v_d; with smoothed friction while |v - v_d| is below
    the speed of greatest friction and the force on it, without friction, does not exceed p mu_st.
    States of a smoothed chain that `EventDriven` ran are those of `chain.with_(width=None)`.

    **Arguments:** `chain`; `states`, (x, v), each of shape (times, n).

    **Returns:** booleans of that shape.

    !!! example

        >>> import jax, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Trajectory, equation_8, paper_chain, simulate
        >>> from jaxchain.plotting import sticking
        >>> chain = paper_chain(n=1, belt_speed=1.0, width=None)
        >>> watch = Trajectory(np.linspace(40.0, 46.4325, 101))  # one period
        >>> film = simulate(chain, equation_8(chain, 1), 60.0, observe=watch).observed
        >>> sticks = sticking(chain, film)
        >>> sticks.shape, round(float(sticks.mean()), 2)  # the share of the time
        ((101, 1), 0.16)
    """
    as_chain(chain)
    if not isinstance(states, tuple | list) or len(states) != 2:
        raise ValueError(f"Argument `states` must be the pair (x, v), but is {shown(states)}.")
    x, v = (as_array("states", part, 2, 2, "those of some times.") for part in states)
    if x.shape != v.shape or x.shape[1] != chain.n:
        raise ValueError(
            f"Argument `states` has parts of shapes {x.shape} and {v.shape}, but for {chain.n} "
            f"masses both have shape (times, {chain.n})."
        )
    rounding = RESOLUTION * (1.0 + jnp.abs(chain.belt_speed)) if chain.dry else 0.0
    limit = chain.stick_speed() + rounding

    @eqx.filter_jit
    def held(x: Any, v: Any) -> Any:
        w, _ = chain.switching(0.0, v)
        return (jnp.abs(w) <= limit) & (chain.unheld_force(x, v) <= 0)

    return np.asarray(jax.vmap(held)(x, v))


def loop(
    chain: Any,
    state: Any,
    *,
    frames: Any = 60,
    solver: Any = None,
    longest: Any = 100.0,
    tolerance: Any = 1e-2,
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """A whole number of periods of the vibration that goes through `state`, for a film in a loop.

    The motion is cut where the liveliest mass turns, and closed at the first of these turns (after
    up to `longest` time units) that comes back nearly as well as any: the greatest difference in a
    displacement or velocity from the first turn is then at most `tolerance`.

    **Arguments:** `state` = (x, v) after the transient; `frames`, how many; `solver` as for
    `simulate`.

    **Returns:** (times, (x, v)) of shapes (frames,) and (frames, n), from time 0; the next frame
    would be the first again.

    **Raises:** `ValueError` for bad input; `RuntimeError` where nothing vibrates or nothing comes
    back.

    ```python
    chain = paper_chain(n=20, belt_speed=1.5, width=None)
    last = simulate(chain, equation_8(chain, 3), 4000.0).state
    times, states = loop(chain, last)
    save_gif(animate(chain, times, states), "chain.gif")
    ```
    """
    as_chain(chain)
    check_whole("frames", frames, 1, MOST_FRAMES, "60 are usual.")
    check_positive_number("longest", longest, "100 is some sixteen periods.")
    check_positive_number("tolerance", tolerance, "1e-2 cannot be seen.")
    state, solver = as_state(chain, state, "state"), own_solver(chain, solver)
    turns = Section(most_lively(chain, state), capacity=256)
    run = simulate(chain, state, longest, observe=turns, solver=solver)
    at, x, v = (np.asarray(part) for part in run.observed)
    if np.count_nonzero(np.isfinite(at)) < 2:
        raise RuntimeError(
            f"No loop was found: the liveliest mass does not turn twice within {longest} time "
            "units. Start from a state that vibrates, or raise `longest`."
        )
    apart = np.maximum(np.abs(x[1:] - x[0]).max(1), np.abs(v[1:] - v[0]).max(1))
    apart = np.where(np.isfinite(apart), apart, np.inf)
    if apart.min() > tolerance:
        raise RuntimeError(
            f"No loop was found: within {longest} time units no turn of the liveliest mass comes "
            f"closer than {apart.min():.1e} to the first. Let the transient pass, raise `longest` "
            "or `tolerance`, or make a film that does not close: `animate` takes any times."
        )
    back = 1 + int(np.argmax(apart <= max(2.0 * apart.min(), 0.1 * tolerance)))
    period = float(at[back] - at[0])
    times = period * np.arange(frames) / frames
    begin = (jnp.asarray(x[0]), jnp.asarray(v[0]))
    film = simulate(chain, begin, period, observe=Trajectory(times), solver=solver)
    return times, (np.asarray(film.observed[0]), np.asarray(film.observed[1]))


def checked_film(chain: Any, times: Any, states: Any) -> tuple[np.ndarray, tuple[Any, Any]]:
    """Times and (x, v) as arrays of fitting shapes, or `ValueError`."""
    as_chain(chain)
    times = checked_times(times)
    return times, checked_states(states, len(times), chain.n)


def checked_times(times: Any) -> np.ndarray:
    """Increasing times, or `ValueError`."""
    check_concrete("draw what it returns.", times=times)
    times = np.asarray(numbers_of("times", times, "one for each frame."))
    check_finite("times", times, "leave out such times.")
    if times.ndim != 1 or len(times) < LEAST_FRAMES or not np.all(np.diff(times) > 0):
        raise ValueError(
            f"Argument `times` must hold at least {LEAST_FRAMES} increasing times, one for each "
            f"frame, but has shape {times.shape}: observe `Trajectory(jnp.linspace(t0, t1, 60))`."
        )
    return times


def checked_states(
    states: Any, times: int | None = None, n: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(x, v) of so many times and masses, or `ValueError`; None: of those that x has."""
    check_concrete("draw what it returns.", states=states)
    if isinstance(states, Simulation):
        states = states.observed
    if not isinstance(states, tuple | list) or len(states) != 2:
        raise ValueError(
            "Argument `states` must be the pair (x, v), or a `Simulation` that observed one "
            f"`Trajectory` and nothing else, but is {type(states).__name__}."
        )
    x, v = (np.asarray(numbers_of("states", part)) for part in states)
    if x.ndim != 2:
        raise ValueError(
            f"Argument `states` has displacements of shape {x.shape}, but those of some times and "
            "masses have shape (times, n)."
        )
    times, n = len(x) if times is None else times, x.shape[1] if n is None else n
    for name, part in (("displacements", x), ("velocities", v)):
        if part.shape != (times, n):
            raise ValueError(
                f"Argument `states` has {name} of shape {part.shape}, but {times} times and "
                f"{n} masses need {(times, n)}."
            )
        check_finite(name, part, "a run that failed ends with NaN; see its `result`.")
    return x, v


def picked_masses(n: int, masses: Any) -> list[int]:
    """Different indices of some of n masses, or `ValueError`."""
    given = masses if isinstance(masses, list | tuple | range | np.ndarray) else []
    whole = all(isinstance(i, int | np.integer) for i in given)
    picked = [int(i) for i in given] if whole else []
    if not picked or len(set(picked)) < len(picked) or not all(0 <= i < n for i in picked):
        raise ValueError(
            f"Argument `masses` must hold different indices of masses, 0 ... {n - 1}, but is "
            f"{shown(masses)}."
        )
    return picked
