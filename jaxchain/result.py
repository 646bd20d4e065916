"""How a run or a search ended, with advice in every message."""

from __future__ import annotations

import functools
import operator
from dataclasses import fields
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool

from ._outcomes import ADVICE, WELL
from ._printing import Printed, advice_of, is_one, name_of


class _Outcomes(type(eqx.Enumeration)):
    """Enumerations of outcomes that print their name and advice, or the counts of a batch.

    equinox prints only the advice, which is empty for success, and that of each item of a batch.
    """

    def __getitem__(cls, item: Any) -> str:
        advice = super().__getitem__(item)  # raises for another enumeration
        return f"{name_of(item)}: {advice}" if advice and is_one(item) else name_of(item)


class Result(eqx.Enumeration, metaclass=_Outcomes):
    """The outcome of one run.

    "successful" reached its end; "quiet" and "steady" stopped early because the answer could not
    change; all others failed.  `Result[run.result]` gives advice.  In a dataset `result` holds the
    numbers, and its attribute `flag_meanings` the names.

    !!! example

        >>> import jax, textwrap
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Result, equation_8, paper_chain, simulate
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> run = simulate(chain, equation_8(chain, 1), 100.0, max_steps=10, throw=False)
        >>> bool(run.result == Result.successful), run.outcome
        (False, 'max_steps_reached')
        >>> print(textwrap.fill(Result[run.result], 80))
        max_steps_reached: The run used up its steps before it reached its end. Allow
        more (`max_steps`), loosen `rtol`, or use a larger regularization width.
    """

    successful = ADVICE["successful"]
    quiet = ADVICE["quiet"]
    steady = ADVICE["steady"]
    max_steps_reached = ADVICE["max_steps_reached"]
    step_too_small = ADVICE["step_too_small"]
    untrusted_linear_solve = ADVICE["untrusted_linear_solve"]
    nonfinite = ADVICE["nonfinite"]
    solver_failed = ADVICE["solver_failed"]
    events_accumulate = ADVICE["events_accumulate"]
    interrupted = ADVICE["interrupted"]
    bad_span = ADVICE["bad_span"]
    pending = ADVICE["pending"]
    forces_not_unique = ADVICE["forces_not_unique"]
    bounces_accumulate = ADVICE["bounces_accumulate"]


class SearchResult(eqx.Enumeration, metaclass=_Outcomes):
    """The outcome of a search for a root, a cycle, a boundary or a fit.

    Every result of a search has it as `result`, with the property `successful`, and a `message`
    that gives the reason of a failure and a remedy.

    !!! example

        >>> import jax, textwrap
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import SearchResult, find_fold, paper_chain
        >>> fold = find_fold(paper_chain(n=1, width=1e-2).with_(damping_ratio=0.6))
        >>> bool(fold.successful), bool(fold.result == SearchResult.no_fold)
        (False, True)
        >>> print(textwrap.fill(fold.message, 80))
        There is no fold: damping outweighs the weakening of friction at every speed, 2
        xi_n > p_n F'(w), so all motions approach steady sliding at every belt speed.
    """

    successful = ""
    nonfinite = (
        "The search met NaN, infinity or a singular Jacobian, at its start or in its result. "
        "Check the given numbers, or start elsewhere."
    )
    no_step_helps = (
        "No step reduced the residual. There may be no solution nearby: start closer, or loosen "
        "the tolerance."
    )
    max_steps_reached = (
        "The search used up its steps. Allow more, start closer, or loosen the tolerance."
    )
    steady_sliding = (
        "The result is steady sliding or sticking, not a vibration: the mass hardly moves. Start "
        "from a state farther from it, or force it harder."
    )
    other_kind = (
        "A cycle was found, but not as requested: of the other kind (stick-slip or slip), or with "
        "a shorter period, for which the given shift of time is another one."
    )
    passed = (
        "No fold was found: on the grazing cycle another mass exceeds the belt speed. "
        "Follow the cycle in which several vibrate: with `chain.with_(width=1e-3)`, "
        "`find_limit_cycle` from the end of a run, then `continue_cycle`."
    )
    no_turn = (
        "No fold was found: the cycles grow out of steady sliding as the belt slows down, and "
        "none turns around. Vibration sets in supercritically and ends at `hopf_belt_speed`. "
        "`hopf_points` gives the criticality."
    )
    no_fold = (
        "There is no fold: damping outweighs the weakening of friction at every speed, 2 xi_n > "
        "p_n F'(w), so all motions approach steady sliding at every belt speed."
    )
    drops = (
        "Friction falls at once where a mass is released (`mu_static` is above mu(0)), and this "
        "search knows slip cycles only, which a vibration that sticks outlives. Follow that one "
        "to the belt speed where it ends: `continue_cycle(find_limit_cycle(chain))`, from a slow "
        "belt on. For shares sample: `basin_shares`."
    )
    undamped = (
        "No fold was found: the damping ratio of the mass is not positive, so its vibration "
        "survives at every belt speed. Give it damping."
    )
    supercritical = (
        "No fold was found: to first harmonic the belt is fastest for the smallest vibration, so "
        "vibration probably sets in supercritically at the Hopf speed. This is not a proof: see "
        "`hopf_points` for the criticality, and run `simulate` from a vibration above "
        "`hopf_belt_speed`."
    )
    no_touch = (
        "No fold was found, although averaging predicts one: the search for the grazing cycle "
        "failed. With strong coupling one mass may not vibrate alone at any belt speed: try a "
        "run. Weaken the coupling, or follow the cycle in which several vibrate: "
        "with `chain.with_(width=1e-3)`, `find_limit_cycle` from the end of a run, then "
        "`continue_cycle`."
    )
    no_cycle = (
        "No fold was found, although averaging predicts one: the search for a cycle failed. If "
        "friction weakens over speeds far below that of the belt, the cycle is very unstable: "
        "`find_fold(chain.with_(width=None)).smoothed(width)` estimates the fold. Otherwise "
        "another width may help, or `continue_cycle` from a cycle of `find_limit_cycle`."
    )
    at_hopf = (
        "The belt speed equals that of a Hopf point to within 1e-8: an unstable cycle, if it "
        "exists, is smaller than 1e-4 of the belt speed. Use a belt speed a little farther away."
    )
    belt_too_slow = (
        "The belt does not move, or moves so slowly that friction grows with its speed: steady "
        "sliding and sticking are the same there. Use a faster belt, or a smaller width."
    )
    same_state = (
        "There is no edge between the two starts: the same masses continue to vibrate from both, "
        "or `classify` finds the same state. "
        "Disturb one of the starts more, or less."
    )
    undecided = (
        "A run was not decided in the allowed time: the masses in question neither became quiet "
        "nor stuck to the belt, or `classify` did not decide. Allow more (`patience`), or use "
        "other starts; near the Hopf speed decisions take long."
    )
    too_close = (
        "The motion cannot be distinguished from the quiet state, as happens next to the Hopf "
        "speed. Choose another belt speed."
    )
    edge_lost = (
        "The edge was lost: both ends of the bracket are on one side. Tighten `rtol`, or use a "
        "wider bracket (`near`)."
    )
    other_state = (
        "The edge is not between the states of the two starts: other masses vibrate on its "
        "sides, see `vibrates`."
    )
    not_settled = (
        "The edge was followed for the requested time, but the amplitudes of its windows do not "
        "agree. Follow it for longer (`time`); motion with two or more frequencies never repeats. "
        "If its `distances` exceed `far` at once, take a shorter `window`."
    )
    sliding_unstable = (
        "Steady sliding is unstable, so any blow starts vibration. Raise the belt speed above "
        "`hopf_belt_speed`, or the damping."
    )
    no_vibration = (
        "No tried kick leads to vibration: the motion dies out after all of them. The belt may be "
        "too fast for any vibration, see `fold_belt_speed`."
    )
    not_certified = (
        "Runs with 1 % less and 1 % more than the blow, or random tries, contradict it. Allow "
        "more `starts` and `steps`; very close to the Hopf speed no run is long enough."
    )
    ran_away = (
        "The search left all cycles: with this damping no cycle has such a velocity, or with "
        "these springs no cycle has such a period. Start from a vibrating run, "
        "`guess=simulate(...)`."
    )
    other_events = (
        "A cycle was found, but on it a mass sticks or slides at one more place than on the given "
        "one, or two events have changed their order."
    )
    sticking = (
        "The belt stands still there: masses with dry friction stick, each in an interval of "
        "displacements, in which there is no Hopf point. Start at a faster belt."
    )


class Outcome(Printed, eqx.Module):
    """The base class of results of searches: how the search ended.

    A result with a number that is not finite is never successful, but `nonfinite`, unless the
    number may be missing: `may_be_missing` names the fields in which NaN and infinity mean
    something.
    """

    result: eqx.AbstractVar[SearchResult]
    may_be_missing: ClassVar[tuple[str, ...]] = ()

    def __check_init__(self) -> None:
        numbers = {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name not in self.may_be_missing and not field.metadata.get("static")
        }
        ended, nonfinite = code(self.result), code(SearchResult.nonfinite)
        sound = _finite(numbers, np.ndim(ended))
        if isinstance(sound, Tracer) or not np.all(sound):
            failed = (self.result == SearchResult.successful) & ~sound
            ended = jnp.where(failed, nonfinite, ended)
            result = eqx.tree_at(lambda r: r._value, self.result, ended)
            object.__setattr__(self, "result", result)  # the module is still being made

    @property
    def successful(self) -> Bool[Array, "*batch"]:
        """Whether the search succeeded."""
        return self.result == SearchResult.successful

    @property
    def message(self) -> str:
        """The reason of a failure, with a remedy, for one search; empty after success."""
        return advice_of(self.result)


def _finite(tree: Any, batch: int) -> Any:
    """Whether all floats in a tree are finite, except in modules; of shape (*batch,)."""
    leaves = jax.tree.leaves(tree, is_leaf=lambda leaf: isinstance(leaf, eqx.Module))
    sound = np.True_
    for leaf in leaves:
        if not isinstance(leaf, float | np.ndarray | np.generic | jax.Array):
            continue
        traced = isinstance(leaf, Tracer)
        # Nothing is compiled for concrete arrays.
        xp, array = (jnp, lax.stop_gradient(leaf)) if traced else (np, np.asarray(leaf))
        sound = sound & xp.all(xp.isfinite(array), axis=tuple(range(batch, array.ndim)))
    return sound


# In the order of the enumerations' integer values, for labels and reports.  equinox offers no
# public way.
NAMES = tuple(Result._name_to_item)
SEARCH_NAMES = tuple(SearchResult._name_to_item)
_STOPPED_WELL = [NAMES.index(name) for name in WELL]


def code(result: Result | SearchResult) -> Any:
    """The integer behind a (possibly traced or batched) `Result`: an index into `NAMES`.

    For a `SearchResult` it is an index into `SEARCH_NAMES`.
    """
    return result._value  # equinox offers no public accessor


def ended_well(result: Any) -> Any:
    """Whether runs reached their end, or stopped early because nothing could change.

    **Arguments:** a `Result`, a code or an array of codes, or the name of one outcome.
    """
    if isinstance(result, str):
        return NAMES.index(result) in _STOPPED_WELL
    result = code(result) if isinstance(result, type(Result.quiet)) else result
    return functools.reduce(operator.or_, [result == well for well in _STOPPED_WELL])


def ended_as(codes: Any) -> dict[str, int]:
    """Counts of these runs by their outcome, in the order of the enumeration.

    >>> ended_as([0, 3, 0])
    {'successful': 2, 'max_steps_reached': 1}
    """
    values, counts = np.unique(np.asarray(codes), return_counts=True)
    return {NAMES[value]: int(count) for value, count in zip(values, counts, strict=True)}


def message(name: str) -> str:
    """The advice that goes with an outcome, by its name."""
    return advice_of(getattr(Result, name))
