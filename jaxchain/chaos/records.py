"""What is known of the runs of an ensemble, and the verdict on it, as plain data."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from .._final import final
from ..result import Printed

KINDS = ("rest", "cycle", "unstable", "chaos", "torus", "open")
VERDICTS = ("at rest", "periodic", "quasi-periodic", "chaotic", "transient", "failed")
# The verdict that each kind stands for.
MEANINGS = {"rest": "at rest", "cycle": "periodic", "torus": "quasi-periodic", "chaos": "chaotic"}


@final
@dataclass(repr=False)
class Evidence(Printed):
    """What is known of one run of an ensemble; NaN, or empty, is not known.

    - `noise`: standard deviation of what was added to the start; `seed`.
    - `kind`: one of `KINDS`, or the name of a failure; `time`: how long the run was; `locked_at`:
      by when it was found on, or bound for, its orbit.
    - `active`: who vibrates; `energy`, `energy_deviation`: mean and deviation over the windows of
      the last record; `drift`: relative difference of the means of its halves; `novelty`: see
      `recurrence.novelty`.
    - `period`, `returns`: of the orbit and of its maxima; `spread`: see `Recurrence`.
    - `exponents`, `low`, `high`: the leading ones with 95 % intervals, descending; of a closed
      orbit those of its multipliers, the first being the zero of the flow.  -inf is a direction
      that sticking annihilates, NaN one that is too small to be told from rounding: of a closed
      orbit, anything below `high`.
    - `smooth`: the same exponents by smoothly weighted averages, see `LyapunovSpectrum`;
      `exponent_time`: over how long, 0 where they are those of multipliers.
    - `slips`: most cycles that a vibrating mass gained on another in the second half of the last
      record; `delays`: of each vibrating mass at the end, in periods.
    - `symmetry_time`, `symmetry`: see `symmetry_defect`.
    - `state`: (x, v) at the end.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, verdict
        >>> chain = paper_chain(1, belt_speed=1.5, width=None)
        >>> start = jnp.array([2.2]), jnp.zeros(1)
        >>> found = verdict(chain, start, noise=(1e-3,), seeds=1)
        >>> for run in found.runs:
        ...     print(run.noise, run.kind, round(run.period, 3), run.active, run.relaxation_time)
        0.0 cycle 6.316 [ True] 0.0
        0.001 cycle 6.316 [ True] 0.0
    """

    noise: float
    seed: int
    kind: str = "open"
    time: float = 0.0
    locked_at: float = math.nan
    active: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    energy: float = math.nan
    energy_deviation: float = math.nan
    drift: float = math.nan
    novelty: float = math.nan
    period: float = math.nan
    returns: int = 0
    spread: float = math.nan
    exponents: np.ndarray = field(default_factory=lambda: np.zeros(0))
    low: np.ndarray = field(default_factory=lambda: np.zeros(0))
    high: np.ndarray = field(default_factory=lambda: np.zeros(0))
    smooth: np.ndarray = field(default_factory=lambda: np.zeros(0))
    exponent_time: float = 0.0
    slips: float = math.nan
    delays: np.ndarray = field(default_factory=lambda: np.zeros(0))
    symmetry_time: np.ndarray = field(default_factory=lambda: np.zeros(0))
    symmetry: np.ndarray = field(default_factory=lambda: np.zeros(0))
    state: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def decided(self) -> bool:
        """Whether a longer run would say nothing new.

        A run with noise has to leave an unstable orbit: noise of 1e-8 takes 18 e-folding times to
        show.
        """
        return self.kind != "open" and (self.kind != "unstable" or self.noise == 0.0)

    @property
    def relaxation_time(self) -> float:
        """1 / |slowest exponent| of an attracting orbit: in so long the distance falls by e.

        0 where sticking annihilates every distance; infinite where the orbit is one of a family,
        as that of masses which are not coupled; NaN where the exponent is not resolved: then it
        is below `longest_relaxation_time`.
        """
        return self._time(self.exponents)

    @property
    def longest_relaxation_time(self) -> float:
        """The relaxation time of the greatest exponent that there may be."""
        return self._time(self.high)

    def _time(self, exponents: np.ndarray) -> float:
        known = self.kind == "cycle" and len(exponents) > 1
        rate = abs(float(exponents[1])) if known else math.nan
        return 1.0 / rate if rate else math.inf


@final
@dataclass(frozen=True, repr=False)
class Verdict(Printed):
    """What an ensemble of runs from one start says.

    - `verdict`: "at rest", "periodic", "quasi-periodic", "chaotic", "transient" (not decided) or
      "failed"; `reason`, a sentence with the numbers; `remedy`: what would decide a transient, or
      what to do about a run that failed, else empty.
    - `undisturbed`: the verdict on the start itself; `depends_on_noise`: whether that differs.
    - `runs`: an `Evidence` each; `longest`: the longest time that was simulated.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, verdict
        >>> chain = paper_chain(1, belt_speed=1.5, width=None)
        >>> start = jnp.array([2.2]), jnp.zeros(1)
        >>> found = verdict(chain, start, noise=(1e-3,), seeds=1)
        >>> found.verdict, found.depends_on_noise, found.lead.kind
        ('periodic', False, 'cycle')
        >>> print(found.reason)
        2 runs: 2 cycle; locked by 2000 to 2000, slowest relaxation time 0
    """

    verdict: str
    reason: str
    remedy: str
    undisturbed: str
    depends_on_noise: bool
    longest: float
    runs: tuple[Evidence, ...]

    @property
    def lead(self) -> Evidence:
        """The run of most exponents among those that the verdict is about."""
        own = [run for run in self.runs if MEANINGS.get(run.kind) == self.verdict]
        worst = max(run.noise for run in self.runs)
        noisiest = [run for run in self.runs if run.noise == worst]
        chosen = [r for r in own if r.noise == worst] or own or noisiest
        return max(chosen, key=lambda run: len(run.exponents))
