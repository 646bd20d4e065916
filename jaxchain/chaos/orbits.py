"""What the record of a run says of its orbit: at rest, closed and stable, or neither yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..cycles.closing import ClosedOrbit, close_orbit
from ..model.chain import Chain
from ..model.oscillators import AbstractOscillators
from ..observers.quantities import energy
from ..result import NAMES, ended_well
from .criteria import Criteria
from .poincare import mean_periods, novelty, phases, recurrence, symmetry_defect
from .records import Evidence
from .runs import Numerics, Trial

# Errors of an exponent within which it is taken for zero.
_NEUTRAL = 10.0


@dataclass(frozen=True)
class Judgement:
    """What a record says: new evidence, the mass to watch, and the orbit if one was closed."""

    evidence: Evidence
    reference: int
    orbit: tuple[int, np.ndarray, ClosedOrbit] | None = None


def judge_orbit(
    chain: AbstractOscillators,
    numerics: Numerics,
    criteria: Criteria,
    trial: Trial,
    record: Any,
    known: Sequence[tuple[int, np.ndarray, ClosedOrbit]],
) -> Judgement:
    """What a record adds to the evidence of its run, and whether that is decided.

    `known` are the orbits that other runs from the same state have closed, so that a run that ends
    on one of them does not close it again: (reference mass, a point of its section, the orbit).
    """
    own = replace(trial.evidence, kind="open", state=(trial.x, trial.v))
    outcome = NAMES[int(record.result)]
    if not ended_well(outcome):
        return Judgement(replace(own, kind=outcome), trial.reference)
    amplitude = record.amplitude
    half = len(amplitude) // 2
    scale = float(np.max(amplitude[-1]))
    energies = np.asarray(energy(jnp.asarray(amplitude)))[half:]
    own.energy, own.energy_deviation = float(np.mean(energies)), float(np.std(energies))
    if scale < criteria.rest:
        own.active = np.zeros(amplitude.shape[1], bool)
        own.kind, own.locked_at, own.spread = "rest", own.time, 0.0
        return Judgement(own, trial.reference)
    parts = np.array_split(energies, 2)
    own.drift = float(abs(np.mean(parts[0]) - np.mean(parts[1])) / np.mean(energies))
    own.active = amplitude[-1] > 0.5 * scale
    masses = np.flatnonzero(own.active)
    turned = phases(record, masses)
    own.slips = float(np.max(np.abs(turned[-1] - turned[half])))
    own.period = float(np.mean(mean_periods(record, masses)))
    own.delays = np.asarray(record.peaks)[-1, 1, masses] / own.period
    ends = chain.ends if isinstance(chain, Chain) else "free"
    defect = symmetry_defect(record, own.active, own.period, ends)
    own.symmetry_time = np.append(own.symmetry_time, record.t)
    own.symmetry = np.append(own.symmetry, defect)
    if trial.reference not in masses:
        # The section was that of a mass that rests; the middle of what vibrates moves most evenly.
        return Judgement(own, int(masses[np.argmin(np.abs(masses - len(own.active) // 2))]))
    own.novelty = novelty(record)
    found = recurrence(record, scale=scale, closed=criteria.sits)
    own.spread, own.returns = found.spread, found.returns
    if found.spread > criteria.near or not found.period > 0:
        return Judgement(own, trial.reference)
    orbit, closed = _known(known, trial.reference, found.point, criteria.sits * scale), None
    if orbit is None:
        n = len(own.active)
        start = jnp.asarray(found.point[:n]), jnp.asarray(found.point[n:])
        orbit = close_orbit(
            chain, start, found.period, solver=numerics.solver, rtol=min(numerics.rtol, 1e-9)
        )
        if not (orbit.gap < criteria.gap * scale and orbit.distance < 4 * criteria.near * scale):
            return Judgement(own, trial.reference)
        closed = trial.reference, found.point, orbit
    _enter_orbit(own, orbit, found.spread < criteria.sits)
    away = np.abs(record.points[:, :1] - record.points[-1][None, : found.returns]).max(-1).min(1)
    outside = np.flatnonzero(~(away < criteria.near * scale))
    # Since when the run has kept close to where it ended.
    if own.kind in ("cycle", "unstable") and outside.size:
        own.locked_at = float(record.t[outside[-1]])
    return Judgement(own, trial.reference, closed)


def _known(
    orbits: Sequence[tuple[int, np.ndarray, ClosedOrbit]],
    reference: int,
    point: np.ndarray,
    near: float,
) -> ClosedOrbit | None:
    for other, place, orbit in orbits:
        if other == reference and np.max(np.abs(place - point)) < near:
            return orbit
    return None


def _enter_orbit(own: Evidence, orbit: ClosedOrbit, sits: bool) -> None:
    period = float(orbit.period)
    # Of an exponent that is not resolved, NaN, it is known below what it lies.
    rates, highest = (np.append(0.0, a) for a in (orbit.exponents, orbit.highest_exponents))
    # What the trivial multiplier is off by, any other may be; rates of small ones feel it more.
    error = max(float(orbit.defect), 1e-9) / period
    finite = np.isfinite(rates)
    errors = np.where(finite, error * np.exp(-np.where(finite, rates, 0.0) * period), 0.0)
    greatest = np.argmax(highest[1:]) + 1
    stable = highest[greatest] < -errors[greatest]
    # One of a family of orbits: phases of masses that are not coupled neither lock nor drift.
    neutral = sits and abs(highest[greatest]) <= _NEUTRAL * errors[greatest]
    if not (stable or neutral) and not (sits and highest[greatest] > errors[greatest]):
        return
    own.kind = "cycle" if stable or neutral else "unstable"
    if neutral:
        rates = np.where(np.abs(rates) <= _NEUTRAL * errors, 0.0, rates)
    order = np.argsort(-highest, kind="stable")
    own.period, own.locked_at = period, own.time
    own.exponents, own.high = rates[order], (highest + errors)[order]
    own.low = np.where(np.isnan(rates), -np.inf, rates - errors)[order]
