"""The verdict on a motion from an ensemble of long runs; `chaos/criteria.py` says what decides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array

from .._checks import (
    check_concrete,
    check_flag,
    check_kind,
    check_nonnegative,
    check_positive_number,
    check_whole,
    shown,
    to_float,
)
from .._progress import progress_bar
from ..model.arguments import as_chain, as_state
from ..model.chain import Chain
from ..model.oscillators import AbstractOscillators
from ..simulation.accuracy import MAX_STEP, check_resolved, check_tolerances, own_solver
from ..simulation.event_driven import EventDriven
from .criteria import Criteria, classify, judge_exponents, judge_torus
from .orbits import judge_orbit
from .records import Evidence, Verdict
from .runs import Numerics, Trial, advance, exponents_of

# Runs at most of one kind; and what to do where a verdict cannot be had.
_MOST_RUNS = 10**5
_INSTEAD = "use `lyapunov_spectrum` or `simulate`."
_NOISE = "it holds standard deviations, such as (1e-8, 1e-3)."


def verdict(chain: AbstractOscillators, initial: Any, **settings: Any) -> Verdict:
    """Whether the motion from `initial` comes to rest, is periodic, quasi-periodic or chaotic.

    **Arguments:** `chain`; `initial`, the pair (x, v), both of shape (n,); `settings` as for
    `verdicts`.

    **Returns:** a `Verdict`.

    **Raises:** `ValueError` for bad input.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, verdict
        >>> chain = paper_chain(n=1, belt_speed=1.5, width=None)
        >>> found = verdict(chain, (jnp.array([2.2]), jnp.zeros(1)))
        >>> found.verdict
        'periodic'
        >>> print(found.reason)  # a mass that sticks forgets everything
        7 runs: 7 cycle; locked by 2000 to 2000, slowest relaxation time 0
    """
    as_chain(chain, AbstractOscillators)
    check_concrete(_INSTEAD, chain=chain, initial=initial)
    x, v = as_state(chain, initial)
    return verdicts(chain, (x[None], v[None]), **settings)[0]


def verdicts(
    chain: AbstractOscillators,
    initials: Any,
    *,
    noise: Sequence[float] = (1e-8, 1e-3),
    seeds: Any = 3,
    first: Any = 2000.0,
    longest: Any = 32000.0,
    exponent_time: Any = 10000.0,
    exponent_runs: Any = 3,
    count: Any = 3,
    window: Any = 50.0,
    solver: Any = None,
    rtol: Any = 1e-6,
    criteria: Criteria | None = None,
    lanes: Any = 16,
    key: int = 0,
    progress: bool = False,
    description: str = "verdicts",
) -> list[Verdict]:
    """A verdict for each of several initial states of a chain, with all their runs at once.

    Every state is run as it is, and `seeds` times with each of the `noise` added to displacements
    and velocities.  A run goes on, doubling its time, until it rests or is bound for a periodic
    orbit that Newton's method has closed, at most to `longest`.  Of runs that never close
    the leading exponents are measured.

    **Arguments:**

    - `chain`: a `Chain` or other autonomous `AbstractOscillators`; `initials`: (x, v), both of
      shape (states, n).
    - `noise`: standard deviations, ascending; () runs each state once.
    - `first`, `longest`: the run is judged after `first` time units, and whenever its time has
      doubled, up to `longest`; rounded up to whole chunks of 20 windows.
    - `exponent_time`: window for exponents, after a fifth of it for directions to settle;
      `exponent_runs`: of how many runs of a state, that without noise and then the noisiest
      first; `count`: how many of them.
    - `window`: time over which amplitudes are taken, some periods.
    - `solver`, `rtol`: as for `simulate`.
    - `criteria`: the thresholds; `key`: of the noise.
    - `lanes`: runs at a time on each device; of their number the last bits of a run depend, not of
      the number of devices.
    - `progress`, `description`: a progress bar and its name.

    **Returns:** `Verdict` for each state.  A run that fails says so in its `kind` and leaves the
    others alone.

    **Raises:** `ValueError` for bad input.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.chaos import verdicts
        >>> chain = paper_chain(1, belt_speed=1.5, width=None)
        >>> starts = jnp.array([[0.6], [2.2]]), jnp.zeros((2, 1))  # near sliding, and far from it
        >>> found = verdicts(chain, starts, noise=(1e-3,), seeds=1)
        >>> [one.verdict for one in found]
        ['at rest', 'periodic']
    """
    as_chain(chain, AbstractOscillators)
    criteria = Criteria() if criteria is None else criteria
    check_kind("criteria", criteria, Criteria, "None or `Criteria`", "`Criteria()` has them.")
    check_concrete(_INSTEAD, chain=chain, initials=initials)
    x, v = as_state(chain, initials, "initials", batch=True)
    counts = {"seeds": seeds, "exponent_runs": exponent_runs, "lanes": lanes}
    for name, value in counts.items():
        check_whole(name, value, 1, _MOST_RUNS, "every one of them is a run.")
    check_whole("count", count, remedy="of the leading exponents 3 are usual.")
    check_whole("key", key, 0, remedy="it is the seed of the noise.")
    check_flag("progress", progress)
    check_kind("description", description, str, "the name of the progress bar")
    times = {
        "first": first, "longest": longest, "exponent_time": exponent_time, "window": window
    }  # fmt: skip
    for name, value in times.items():
        check_positive_number(name, value, "a period is about 2 pi; see the defaults.")
    check_tolerances(rtol, None, MAX_STEP)
    solver = own_solver(chain, solver)
    if isinstance(chain, Chain) and not isinstance(solver, EventDriven):
        check_resolved(chain.n, chain.width, chain.belt_speed, rtol, None)
    if np.shape(to_float(noise, "noise", _NOISE)) != (len(np.ravel(noise)),):
        raise ValueError(f"Argument `noise` must be a sequence, but is {shown(noise)}: {_NOISE}")
    check_nonnegative("noise", noise, _NOISE)
    if longest < first:
        raise ValueError(f"Argument `longest` = {longest} must be at least `first` = {first}.")
    trials = _starts(x, v, noise, seeds, key)
    numerics = Numerics(solver, float(rtol), float(window), min(lanes, len(trials)))
    orbits: list[list] = [[] for _ in range(x.shape[0])]

    def advance_and_judge(going: list[Trial], stage: float, *, again: bool = False) -> None:
        for trial, record in advance(chain, numerics, going, stage):
            known = orbits[trial.state_index]
            found = judge_orbit(chain, numerics, criteria, trial, record, known)
            trial.reference = found.reference
            if found.orbit is not None:
                known.append(found.orbit)
            # Of a run that has not locked in a second look the longer record tells more.
            if not again or found.evidence.decided:
                trial.evidence = found.evidence

    with progress_bar(total=len(trials), desc=description, unit="run", show=progress) as bar:
        stage = first
        while True:
            going = [trial for trial in trials if not trial.evidence.decided]
            advance_and_judge(going, stage)
            bar.update(sum(trial.evidence.decided for trial in going))
            if stage >= longest or all(trial.evidence.decided for trial in trials):
                break
            # Runs are a whole number of chunks long, and may have got farther than was asked.
            reached = min(t.evidence.time for t in trials if not t.evidence.decided)
            while stage < longest and stage <= reached:
                stage = min(2.0 * stage, longest)
            if stage <= reached:
                break
        measured = _for_exponents(trials, exponent_runs)
        bar.update(sum(not trial.evidence.decided for trial in trials) - len(measured))
        most = min(int(count), 2 * x.shape[1])
        exponents_of(chain, numerics, measured, float(exponent_time), most, bar.update)
        # What has locked meanwhile is closed, too.
        end = max((trial.evidence.time for trial in measured), default=0.0)
        advance_and_judge(measured, end + 1.0, again=True)
    groups = [[t.evidence for t in trials if t.state_index == i] for i in range(x.shape[0])]
    for group in groups:
        torus = judge_torus(group, criteria)
        for run in group:
            if run.kind == "open" and len(run.exponents):
                run.kind = "torus" if torus else judge_exponents(run, criteria)
                run.locked_at = run.time if run.kind == "cycle" else run.locked_at
    return [classify(group) for group in groups]


def _starts(x: Array, v: Array, noise: Sequence[float], seeds: int, key: int) -> list[Trial]:
    trials = []
    rng = np.random.default_rng(key)
    for i in range(x.shape[0]):
        levels = [(0.0, 0)] + [(float(a), s) for a in noise for s in range(seeds)]
        for level, seed in levels:
            own = [np.asarray(a[i]) + level * rng.normal(size=x.shape[1]) for a in (x, v)]
            trials.append(Trial(i, own[0], own[1], Evidence(level, seed)))
    return trials


def _for_exponents(trials: list[Trial], most: int) -> list[Trial]:
    """`most` of the open runs of each state: the one without noise, and then the noisiest."""
    chosen = []
    for i in {trial.state_index for trial in trials}:
        own = [t for t in trials if t.state_index == i and t.evidence.kind == "open"]
        chosen += sorted(own, key=lambda t: -(t.evidence.noise or np.inf))[:most]
    return chosen
