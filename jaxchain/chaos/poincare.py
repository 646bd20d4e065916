"""Long runs watched in windows, and whether what is seen there comes back.

A window is some ten periods long; of each the amplitudes, the times of the maxima and the states
at the maxima of one mass are kept.  That is a Poincare section, from which periodic orbits (the
points fall upon each other), slow transients (they creep) and drifting phases (they never come
back) can be told apart, and it is little enough to keep of a run of 1e5 time units.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators
from ..observers.amplitude import Amplitude
from ..observers.peaks import PeakTimes
from ..observers.section import Section
from ..simulation.run import simulate

# Returns of which an orbit may be made, and points of the section kept of a window, at least.
MOST_RETURNS = 4
_SPIRAL = 5.0
# A record may be one of many runs, and on the host.
_Numbers: TypeAlias = Array | np.ndarray


class Record(eqx.Module):
    """What was seen of a run, window by window; W windows of n masses.

    - `t`: end of each window, (W,); `amplitude`: half peak-to-peak in it, (W, n).
    - `peaks`: times of the maxima of every displacement, (W, peaks, n), NaN where none.
    - `point_times`, `points`: when the reference mass was at a maximum, (W, points), and the
      state (x_1 .. x_n, v_1 .. v_n) then, (W, points, 2n).
    - `state`, `result`: how the run ended.
    """

    t: Float[_Numbers, "*batch W"]
    amplitude: Float[_Numbers, "*batch W n"]
    peaks: Float[_Numbers, "*batch W peaks n"]
    point_times: Float[_Numbers, "*batch W points"]
    points: Float[_Numbers, "*batch W points two_n"]
    state: tuple[_Numbers, _Numbers]
    result: Any


def watch(
    chain: AbstractOscillators,
    initial: State,
    reference: Any,
    *,
    t0: ScalarLike = 0.0,
    window: ScalarLike = 50.0,
    windows: int = 20,
    peaks: int = 16,
    solver: Any = None,
    rtol: Any = 1e-6,
) -> Record:
    """A run over `windows` windows of length `window`, from t0 on.

    **Arguments:** `reference`, index of the mass whose maxima are the Poincare section, may be
    traced; `peaks`, how many maxima of each mass are kept of a window (the first); `solver` and
    `rtol` as for `simulate`.

    **Returns:** `Record`; a run that failed says so in `result`.  Works under `jit` and `vmap`.

    !!! example

        ```python
        from jaxchain import equation_8, paper_chain
        chain = paper_chain(n=1, width=None)
        seen = watch(chain, equation_8(chain, 1), 0, windows=4)
        found = recurrence(seen, scale=1.6)
        found.returns, round(found.period, 4)  # (1, 6.3163)
        ```
    """
    run = simulate(
        chain, initial, t0 + windows * jnp.asarray(window, float), t0=t0,
        observe={
            "amplitude": Amplitude(),
            "peaks": PeakTimes(capacity=peaks),
            "points": Section(jnp.asarray(reference), MOST_RETURNS + 1),
        },
        solver=solver, rtol=rtol, segments=windows, throw=False,
    )  # fmt: skip
    times, x, v = run.observed["points"]
    ends = t0 + window * jnp.arange(1, windows + 1)
    return Record(
        t=ends, amplitude=run.observed["amplitude"], peaks=run.observed["peaks"],
        point_times=times, points=jnp.concatenate([x, v], axis=-1),
        state=run.state, result=run.result,
    )  # fmt: skip


class Recurrence(NamedTuple):
    """How well the points of a section come back.

    - `returns`: q, after how many returns they do best (1 ... `MOST_RETURNS`).
    - `spread`: the greatest distance of a point of the second half of the record from the nearest
      of the q last points; relative to the amplitude, in the greatest component.
    - `gap`: distance after q returns in the last window; `period`: the time they take.
    - `point`: the state where the last window's returns begin, (2n,).
    """

    returns: int
    spread: float
    gap: float
    period: float
    point: np.ndarray


def recurrence(record: Any, *, scale: Any, closed: float = 1e-3) -> Recurrence:
    """Whether the second half of a record is q points of the section, over and over.

    The least q whose spread is below `closed`, or not more than 5 times the least of all (an
    orbit approached in a spiral does somewhat better after a turn of it).
    `scale`, what an amplitude is, makes distances relative.
    """
    points, times = np.asarray(record.points), np.asarray(record.point_times)
    half, last = points[len(points) // 2 :], points[-1]
    tried: list[Recurrence] = []
    for q in range(1, MOST_RETURNS + 1):
        away = np.max(np.abs(half[:, :1] - last[None, :q]), axis=-1).min(axis=1)
        spread, gap = np.max(away) / scale, np.max(np.abs(last[q] - last[0])) / scale
        worst = float(np.nan_to_num(max(spread, gap), nan=np.inf))
        period = float(times[-1, q] - times[-1, 0])
        tried.append(Recurrence(q, worst, float(gap), period, last[0]))
    limit = max(closed, _SPIRAL * min(found.spread for found in tried))
    return next(found for found in tried if found.spread <= limit)


def novelty(record: Any) -> float:
    """How new the states of the second half of a record are, 0 ... 1.

    Mean distance of its section points from the nearest of the first half, relative to the
    greatest distance of any two of the second half, in the greatest component.  A torus
    that is filled gives the spacing of its points, a steady drift a half.
    """
    points = np.asarray(record.points)[:, 0]
    before, after = np.array_split(points, 2)
    away = [np.min(np.max(np.abs(before - point), axis=1)) for point in after]
    extent = np.max(np.ptp(after, axis=0))
    return float(np.mean(away) / extent) if extent > 0 else 0.0


def phases(record: Any, masses: Any) -> Float[np.ndarray, "W active"]:
    """Cycles that each of some masses has gone through since the first, one number a window.

    Between the maxima of a mass its phase grows evenly by one; that of the first mass in `masses`
    is taken away.  Locked masses keep theirs, others drift; whole numbers are phase slips.
    """
    peaks = np.asarray(record.peaks)[:, :, masses]
    counts = np.sum(np.isfinite(peaks), axis=1)
    before = np.concatenate([np.zeros_like(counts[:1]), np.cumsum(counts, axis=0)[:-1]])
    # Of the second maximum of a window, so that the length of a period is known around it.
    length = np.nanmean(np.diff(peaks, axis=1), axis=(0, 1))
    start = peaks[:, 0, :1]
    turned = before + (start - peaks[:, 0]) / length
    return turned - turned[:, :1]


def mean_periods(record: Any, masses: Any) -> Float[np.ndarray, " active"]:
    """Mean time between the maxima of each of some masses over a record."""
    peaks = np.asarray(record.peaks)[:, :, masses]
    count = np.sum(np.isfinite(peaks), axis=(0, 1))
    first, last = np.nanmin(peaks, axis=(0, 1)), np.nanmax(peaks, axis=(0, 1))
    return (last - first) / np.maximum(count - 1, 1)


def reflections(active: Bool[np.ndarray, " n"], ends: str) -> list[np.ndarray]:
    """The reflections of a ring, or of a row with free ends, that map the vibrating masses onto
    themselves: index arrays of shape (n,)."""
    n = len(active)
    sums = range(n) if ends == "cyclic" else [n - 1]
    found = [(s - np.arange(n)) % n for s in sums]
    return [image for image in found if np.array_equal(active[image], active)]


def symmetry_defect(
    record: Any, active: Bool[np.ndarray, " n"], period: float, ends: str = "cyclic"
) -> Float[np.ndarray, " W"]:
    """How far the delays of a block are from a mirror image of themselves, window by window.

    min over R, s of max_i |phi_i - phi_{R i} - s| / P, wrapped, with the reflections R that keep
    the block, and s = 0 (the mirror image itself) or P/2 (half a period later); R and s are those
    of the first window.  0 is symmetric, 1/2 the most there can be.
    """
    first = np.asarray(record.peaks)[:, 0]
    found = []
    for image in reflections(active, ends):
        moved = active & (image != np.arange(len(active)))
        difference = (first - first[:, image])[:, moved] / period
        shifts = (0.0,) if np.any(active & ~moved) else (0.0, 0.5)
        for shift in shifts:
            turns = difference - shift
            found.append(np.max(np.abs(turns - np.round(turns)), axis=1, initial=0.0))
    if not found:
        return np.full(len(first), np.nan)
    return min(found, key=lambda series: series[0])


def join(records: list[Any]) -> Any:
    """Records of successive runs as one."""
    parts = {
        name: np.concatenate([np.asarray(getattr(r, name)) for r in records])
        for name in ("t", "amplitude", "peaks", "point_times", "points")
    }
    return Record(**parts, state=records[-1].state, result=records[-1].result)
