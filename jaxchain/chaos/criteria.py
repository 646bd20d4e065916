"""Is a motion at rest, periodic, quasi-periodic, chaotic, or still changing?  The criteria.

No single run can say.  A symmetric start may stay on a symmetric orbit that no disturbance
survives, and phases that are weakly coupled may wander for 1e4 periods before they lock.  So the
verdict is on an ensemble: the start itself, and starts with noise.  For each run there is one of

    rest        every amplitude is below `rest`
    cycle       the states at the maxima of one mass fall upon each other (or creep towards a
                point), Newton's method closes the orbit nearby, and all its exponents but the
                zero of the flow are negative: ln |multiplier| / period < -defect / period (-inf
                for what sticking annihilates); or zero within its error, while the run sits on
                the orbit: one of a family, as that of masses which are not coupled; or,
                of a run that locks only while exponents are measured, the greatest exponent is
                0 within `zero` and the next one below -`zero`, intervals included
    unstable    the same with a positive exponent, while the run sits on the orbit to rounding:
                what only an exact symmetry, or exact arithmetic, can keep; a run with noise is
                given its time to leave
    chaos       never closed, and the whole 95 % interval of the greatest exponent is positive
    torus       never closed, the two greatest exponents are 0 within `zero`, intervals
                included, the energies of the two halves of the record agree, and the states
                of the second half fall near those of the first (a slow drift meets new ones)
    open        anything else

and `classify` puts them together.  For regular motion, averages with a smooth weight converge much
faster than block means, but have no interval of their own: that of a torus is taken over
the runs of an ensemble (`judge_torus`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from .._checks import check_positive_number
from .._final import final
from .._statistics import mean_interval
from ..result import message
from .records import KINDS, MEANINGS, Evidence, Verdict


@final
@dataclass(frozen=True)
class Criteria:
    """The thresholds, with their reasons.

    - `rest`: amplitude (x0) of a mass that does not move: above rounding, below any vibration.
    - `near`: spread of section points, relative to the amplitude, from which on Newton's method
      is asked; it converges from there, and a periodic orbit found much farther away is another.
    - `sits`: spread of a run that does not move any more: above the solver's error of 1e-6, below
      what a passage near an unstable orbit shows.
    - `gap`: what Newton's method leaves, relative to the amplitude.
    - `zero`: exponents (per time unit) of neutral directions: a tenth of the weakest chaos and of
      the slowest relaxation seen in blocks of vibrating masses, 1e-3.
    - `drift`: by how much the energies of the two halves of a record may differ on a torus.
    - `novelty`: the most there may be on a torus, see `recurrence.novelty`: half of it is what a
      steady drift has, and 0.3 what 100 points on a square have.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, verdict
        >>> from jaxchain.chaos import Criteria
        >>> chain = paper_chain(1, belt_speed=1.5, width=None)
        >>> start = jnp.array([2.2]), jnp.zeros(1)
        >>> strict = Criteria(gap=1e-9)  # orbits must close better; all else as by default
        >>> verdict(chain, start, noise=(), criteria=strict).verdict
        'periodic'
    """

    rest: float = 1e-6
    near: float = 0.05
    sits: float = 1e-4
    gap: float = 1e-7
    zero: float = 1e-4
    drift: float = 0.02
    novelty: float = 0.3

    def __post_init__(self) -> None:
        for field in fields(self):
            remedy = f"{field.default:g} is usual."
            check_positive_number(field.name, getattr(self, field.name), remedy)


def judge_exponents(run: Evidence, criteria: Criteria) -> str:
    """The kind of a run that did not close, from its exponents: chaos, cycle, torus or open.

    >>> import numpy as np
    >>> run = Evidence(0.0, 0, exponents=np.array([2e-3, 0.0]), low=np.array([1e-3, -1e-5]))
    >>> run.high = np.array([3e-3, 1e-5])
    >>> judge_exponents(run, Criteria())
    'chaos'
    """
    if not len(run.exponents) or not np.all(np.isfinite(run.exponents[:1])):
        return "open"
    if run.low[0] > 0:
        return "chaos"
    # What is too small to be told from rounding, NaN, is below everything else.
    low, high = (np.where(np.isnan(run.exponents), -np.inf, a) for a in (run.low, run.high))
    neutral = (np.abs(low) < criteria.zero) & (np.abs(high) < criteria.zero)
    if len(neutral) < 2 or not neutral[0]:
        return "open"
    if high[1] < -criteria.zero:
        return "cycle"
    return "torus" if neutral[1] and _comes_back(run, criteria) else "open"


def _comes_back(run: Evidence, criteria: Criteria) -> bool:
    return not (run.drift > criteria.drift or run.novelty > criteria.novelty)


def judge_torus(runs: Sequence[Evidence], criteria: Criteria) -> bool:
    """Whether the open runs of an ensemble are on a torus, by their smooth averages.

    Mean +- t s / sqrt(m) over the m runs, Student's t at 95 %, lies within `zero` of 0 for both
    leading exponents, and the energies do not drift.
    """
    own = [run for run in runs if run.kind == "open" and len(run.smooth) > 1]
    if len(own) < 2 or not all(_comes_back(run, criteria) for run in own):
        return False
    values = np.array([np.sort(run.smooth)[::-1][:2] for run in own])
    return bool(np.all(np.abs(mean_interval(values)) < criteria.zero))


def classify(runs: Sequence[Evidence]) -> Verdict:
    """The verdict on an ensemble whose runs have their `kind`.

    The verdict is that of the strongest noise, because a state that survives exact symmetry only
    is seen by nobody; what the start itself does without noise is `undisturbed`.  Runs on
    unstable orbits have no say where others have left them.  If the runs of the strongest noise
    disagree, or any of them is open, the verdict is "transient"; if any of them failed, "failed".

    >>> still = [Evidence(noise, 0, kind="cycle") for noise in (0.0, 1e-3)]
    >>> classify(still).verdict
    'periodic'
    >>> classify([Evidence(0.0, 0, kind="unstable"), Evidence(1e-3, 0, kind="chaos")]).verdict
    'chaotic'
    """
    strongest = max(run.noise for run in runs)
    voters = [run for run in runs if run.noise == strongest]
    own = [run for run in runs if run.noise == 0.0] or voters
    verdict = _common(voters)
    undisturbed = "periodic" if own[0].kind == "unstable" else _common(own)
    counted = {kind: sum(run.kind == kind for run in runs) for kind in KINDS}
    told = ", ".join(f"{count} {kind}" for kind, count in counted.items() if count)
    lost = [run.kind for run in runs if _failed(run)]
    failures = [f"{lost.count(name)} failed ({name})" for name in sorted(set(lost))]
    reason = f"{len(runs)} runs: {', '.join([told] * bool(told) + failures)}"
    reason += "".join(f"; {text}" for text in _numbers(runs, verdict))
    return Verdict(
        verdict=verdict,
        reason=reason,
        remedy=_remedy(voters) if verdict in ("transient", "failed") else "",
        undisturbed=undisturbed,
        depends_on_noise=verdict != undisturbed or any(run.kind == "unstable" for run in own),
        longest=max(run.time for run in runs),
        runs=tuple(runs),
    )


def _failed(run: Evidence) -> bool:
    return run.kind not in KINDS


def _common(runs: Sequence[Evidence]) -> str:
    if any(map(_failed, runs)):
        return "failed"
    # Not every run of an ensemble need have exponents: what else has not closed goes with those.
    kinds = {run.kind for run in runs if len(run.exponents) or run.kind != "open"}
    if any(run.kind in ("cycle", "rest") for run in runs):
        kinds = {run.kind for run in runs}
    found = {MEANINGS.get(kind) for kind in kinds}
    only = found.pop() if len(found) == 1 else None
    return "transient" if only is None else only


def _numbers(runs: Sequence[Evidence], verdict: str) -> list[str]:
    told = []
    closed = [run for run in runs if run.kind == "cycle"]
    if closed:
        times = [run.relaxation_time for run in closed]
        resolved = not any(map(math.isnan, times))
        slow = max(times) if resolved else max(run.longest_relaxation_time for run in closed)
        told.append(
            f"locked by {min(r.locked_at for r in closed):.0f} to "
            f"{max(r.locked_at for r in closed):.0f}, slowest relaxation time "
            + (f"{slow:.3g}" if resolved else f"below {slow:.3g} (not resolved)")
        )
        if math.isinf(slow):
            told.append(
                "the orbit is one of a family: some disturbances neither grow nor decay, such as "
                "those of the phases of masses that are not coupled"
            )
    unstable = [run for run in runs if run.kind == "unstable" and len(run.exponents)]
    if unstable:
        told.append(f"an unstable orbit grows at {max(r.exponents[0] for r in unstable):.2e}")
    with_exponents = [r for r in runs if r.kind in ("chaos", "torus", "open") and len(r.exponents)]
    if with_exponents:
        least = min(run.low[0] for run in with_exponents)
        most = max(run.high[0] for run in with_exponents)
        told.append(f"greatest exponents within [{least:.2e}, {most:.2e}]")
    never = [run for run in runs if run.kind in ("chaos", "torus", "open")]
    if never and verdict in ("chaotic", "quasi-periodic"):
        total = sum(run.time for run in never)
        # No event in a time t: with 95 % certainty the rate is below 3 / t.
        told.append(
            f"none of them locked, so that with 95 % the mean life is above {total / 3:.2g}"
        )
    return told


def _remedy(runs: Sequence[Evidence]) -> str:
    kinds = {run.kind for run in runs}
    longest = max(run.time for run in runs)
    failures = sorted(kinds - set(KINDS))
    if failures:
        return " ".join(f"Runs failed with `{name}`: {message(name)}" for name in failures)
    if kinds & {"cycle", "rest"} and len(kinds) > 1:
        ended = sum(run.kind in ("cycle", "rest") for run in runs)
        total = sum(r.locked_at if np.isfinite(r.locked_at) else r.time for r in runs)
        return (
            f"{ended} of {len(runs)} runs have ended on an orbit: the others take "
            f"{total / ended:.2g} on average, or there are two attractors; a `longest` of "
            f"{10 * total / ended:.1g}, or more seeds, would tell."
        )
    if "unstable" in kinds:
        return "Noise did not leave the unstable orbit: a longer run, or more noise, would."
    return (
        f"Exponents are not yet told from zero, or the motion still changes at {longest:.3g}: "
        "a longer `exponent_time` and `longest` would tell."
    )
