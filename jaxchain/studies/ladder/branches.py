"""The branches of the study `ladder`: from locked patterns of phases to cycles, and on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from jaxchain.cycles.branches import CycleBranch, continue_cycle, switch_cycle
from jaxchain.cycles.search import find_limit_cycle
from jaxchain.localization.patterns import (
    LockedPattern,
    PhaseModel,
    block_sites,
    locked_patterns,
    pattern_guess,
    phase_model,
    rotating_wave,
)
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.studies._study import from_rows
from jaxchain.studies.ladder.table import Study, Walk

_NEWTON_RTOL = 1e-9
_BEYOND = 1e-7
# Of every point of a branch.
_NUMBERS = ("energy", "period", "unstable", "closeness", "amplitude", "x", "v")
_LOSSES = ("fold", "symmetry breaking", "branch point", "period doubling", "torus")


@dataclass(frozen=True)
class Rung:
    """One locked pattern: `count` neighbours of a ring, what it is called, and it."""

    model: PhaseModel
    count: int
    name: str
    pattern: LockedPattern

    @property
    def key(self) -> str:
        """The name of the rung in datasets."""
        return f"k{self.count}_{self.name.replace('-', '_')}"


def ring(study: Study, masses: int | None = None, coupling: float | None = None) -> Chain:
    """The chain at the belt speed from which branches are followed."""
    chain = paper_chain(masses or study.ring.masses, study.walk.start, study.ring.width)
    return chain.with_(coupling=coupling or study.ring.coupling)


def named(model: PhaseModel, count: int, names: Sequence[str]) -> list[Rung]:
    """The patterns of `count` neighbours that go by these names, each once.

    "in-phase" is the one with the greatest `order`, "alternating" that with the least, "calmest"
    the one whose phases keep together best.
    """
    n = model.chain.n
    if count == n:
        waves = [rotating_wave(model, turns) for turns in range(n // 2 + 1)]
        found = tuple(sorted(waves, key=lambda wave: wave.growth))
    else:
        found = locked_patterns(model, count)
    choose = {
        "in-phase": lambda: max(found, key=lambda p: p.order),
        "alternating": lambda: min(found, key=lambda p: p.order),
        "calmest": lambda: found[0],
    }
    rungs: list[Rung] = []
    for name in names:
        pattern = choose[name]()
        if not any(pattern is rung.pattern for rung in rungs):
            rungs.append(Rung(model, count, "single" if count == 1 else name, pattern))
    return rungs


def rungs_of(study: Study) -> list[Rung]:
    """Every pattern that is to be followed."""
    model = phase_model(ring(study))
    return [r for count in study.rungs.count for r in named(model, count, study.rungs.pattern)]


def symmetry(n: int, pattern: LockedPattern) -> tuple[int, list[int] | None]:
    """(the mass at which the orbit is cut, its `images`) of a centred block.

    Of a mirrored block the left half does as the right half; of a ring in which every second mass
    does the same, two masses differ, or one.
    """
    k = pattern.phases.size
    sites = block_sites(n, k)
    mass = int(sites[k // 2])
    if k == n:
        steps = np.cos(np.diff(pattern.phases))
        if np.allclose(steps, 1.0):
            return mass, [mass] * n
        if np.allclose(steps, -1.0) and n % 2 == 0:
            return mass, [mass + (i - mass) % 2 for i in range(n)]
        return mass, None
    if not pattern.mirrored:
        return mass, None
    total = int(sites[0] + sites[-1])
    images = [max(i, (total - i) % n) if i != mass else i for i in range(n)]
    return mass, images


def start(rung: Rung) -> Any:
    """The `LimitCycle` of the whole ring near a locked pattern; it may not have converged."""
    model = rung.model
    mass, images = symmetry(model.chain.n, rung.pattern)
    state, period = pattern_guess(model, rung.pattern.phases, first=mass)
    return find_limit_cycle(
        model.chain, state, period=period, vibrating=mass, images=images, rtol=_NEWTON_RTOL,
        throw=False,
    )  # fmt: skip


def follow(rung: Rung, cycle: Any, walk: Walk, **more: Any) -> list[CycleBranch]:
    """The branch through a cycle, towards greater and towards smaller belt speeds."""
    _, images = symmetry(rung.model.chain.n, rung.pattern)
    more |= {"images": images, "rtol": walk.rtol, **walk.limits()}
    return [continue_cycle(cycle, direction=direction, **more) for direction in (1, -1)]


def switched(branch: CycleBranch, walk: Walk, progress: Any = None) -> CycleBranch | None:
    """The branch that crosses at the first symmetry breaking beyond the fold, if there is one."""
    folds = [point.index for point in branch.of_kind("fold")]
    for point in branch.of_kind("symmetry breaking"):
        if not folds or point.index < folds[0]:
            continue
        try:
            return switch_cycle(branch, point, progress=progress, **walk.limits())
        except RuntimeError:
            continue
    return None


def follow_rung(
    study: Study, rung: Rung, cycle: Any, progress: Any
) -> Iterator[tuple[str, xr.Dataset]]:
    """The branch of a pattern, and the one that crosses it if that is asked for, as datasets."""
    up, down = follow(rung, cycle, study.walk, progress=progress)
    yield rung.key, to_dataset(rung, up, down)
    if rung.count in study.rungs.switch:
        other = switched(up, study.walk, progress)
        if other is not None:
            yield f"{rung.key}_switched", to_dataset(rung, other)


def catalogue(rungs: list[Rung]) -> tuple[list[Any], xr.Dataset]:
    """The cycle near each pattern, and a table of what the phase model and the cycle say.

    `growth` is ln |mu| / T of the greatest multiplier, `phase_growth` that of phases alone;
    `order` and `phase_order` do not differ by more than the coupling moves phases.
    """
    model, cycles = rungs[0].model, [start(rung) for rung in rungs]
    n = model.chain.n
    rows = [
        {
            "key": rung.key, "count": rung.count, "phase_order": rung.pattern.order,
            "phase_growth": rung.pattern.growth, "phases": _spread(n, rung.pattern.phases),
            "converged": np.int8(cycle.successful), "residual": float(cycle.residual),
            "period": float(cycle.period), "energy": float(cycle.energy), "growth": _growth(cycle),
        }
        for rung, cycle in zip(rungs, cycles, strict=True)
    ]  # fmt: skip
    data = from_rows(rows, "pattern", "oscillator").assign_coords(oscillator=np.arange(1, n + 1))
    data.attrs |= {
        "belt_speed": float(model.chain.belt_speed),
        "reactive": float(model.interaction[1].real),
        "dissipative": float(model.interaction[1].imag),
    }
    return cycles, data


def _growth(cycle: Any) -> float:
    """ln |mu| / T of the greatest multiplier."""
    return float(np.log(np.abs(cycle.multipliers[0])) / cycle.period)


def _spread(n: int, phases: np.ndarray) -> np.ndarray:
    """Phases of a centred block on the ring, NaN for the quiet masses."""
    every = np.full(n, np.nan)
    every[block_sites(n, phases.size)] = phases
    return every


def to_dataset(rung: Rung, up: CycleBranch, down: CycleBranch | None = None) -> xr.Dataset:
    """Both ways as one branch, from the end of `down` to the end of `up`."""
    pieces = [(up, slice(None))]
    if down is not None:
        pieces.insert(0, (down, slice(None, 0, -1)))  # its first point is that of `up`

    def joined(read: Any) -> np.ndarray:
        return np.concatenate([np.asarray(read(branch))[part] for branch, part in pieces])

    first = 0 if down is None else down.parameter.size - 1
    special = sorted(
        [(first + point.index, point) for point in up.special]
        + [(first - point.index - 1, point) for point in (down.special if down else ())],
        key=lambda item: item[0],
    )
    points = [point for _, point in special]
    n = up.x.shape[1]
    leading = joined(lambda b: b.multipliers[:, 0])
    numbers: dict[str, Any] = {
        "belt_speed": joined(lambda b: b.parameter),
        **{key: joined(lambda b, key=key: getattr(b, key)) for key in _NUMBERS},
        "multiplier": np.abs(leading), "turn": np.abs(np.angle(leading)),
    }  # fmt: skip
    each = {
        "special_kind": np.array([p.kind for p in points], dtype="U24"),
        "special_belt_speed": np.array([p.parameter for p in points], float),
        "special_refined": np.array([p.refined for p in points], dtype=np.int8),
        # It lies between this point and the next.
        "special_after": np.array([i for i, _ in special], dtype=int),
    }
    data = xr.Dataset(
        {key: (("point", "oscillator")[: own.ndim], own) for key, own in numbers.items()}
        | {key: ("special", own) for key, own in each.items()},
        coords={"oscillator": np.arange(1, n + 1)},
        attrs={
            "count": rung.count, "pattern": rung.name, "phases": rung.pattern.phases,
            "phase_growth": rung.pattern.growth, "phase_order": rung.pattern.order,
            "mass": up.shooting.mass, "solved_for": len(up.shooting.solved),
            "rtol": float(up.shooting.rtol),
            "ended_up": up.ended, "ended_down": "" if down is None else down.ended,
            "start": first,
        },
    )  # fmt: skip
    amplitudes = np.reshape([p.amplitude for p in points], (-1, n))
    data["special_amplitude"] = (("special", "oscillator"), amplitudes)
    data["special_energy"] = 0.5 * (data["special_amplitude"] ** 2).sum("oscillator")
    return data


def stable_ends(study: Study, coupling: float) -> list[dict[str, Any]]:
    """Between which belt speeds the calmest cycle of each count is stable, at a coupling.

    **Returns:** a row for each count: `lower` and `upper`, belt speeds (NaN where it is not stable
    at the start, or its branch ends otherwise), with `lower_kind`, `upper_kind`, what happens
    there; `stable`, whether the cycle at the start was found to be; `growth` = ln |mu| / T of its
    greatest multiplier, and `phase_growth`, what the phase model says.
    """
    own = study.couplings
    walk = study.walk.model_copy(update={"points": own.points})
    model = phase_model(ring(study, own.masses, coupling))
    rungs = [rung for count in own.count for rung in named(model, count, ["calmest"])]
    return [{"count": r.count, "coupling": coupling, **_ends(r, walk)} for r in rungs]


def _ends(rung: Rung, walk: Walk) -> dict[str, Any]:
    row: dict[str, Any] = {
        "stable": False, "growth": np.nan, "phase_growth": rung.pattern.growth,
        "lower": np.nan, "upper": np.nan, "lower_kind": "", "upper_kind": "",
    }  # fmt: skip
    cycle = start(rung)
    if not bool(cycle.successful):
        return row
    row |= {"growth": _growth(cycle), "stable": bool(cycle.stable)}
    if not row["stable"]:
        return row

    def lost(p: float, extra: Any) -> bool:
        del p
        return bool(np.abs(extra.multipliers[0]) > 1.0 + _BEYOND)

    ways = zip(("upper", "lower"), follow(rung, cycle, walk, stop=lost), strict=True)
    for name, branch in ways:
        row[name], row[f"{name}_kind"] = _first_loss(branch)
    return row


def _first_loss(branch: CycleBranch) -> tuple[float, str]:
    """Where stability is lost, and how; the bound if it is not."""
    if branch.ended == "left_bounds":
        return float(branch.parameter[-1]), "bound"
    if branch.ended != "stopped":
        return np.nan, branch.ended
    last = branch.parameter.size - 2
    for point in branch.special:
        if point.index >= last and point.kind in _LOSSES:
            return point.parameter, point.kind
    return float(branch.parameter[-1]), "unknown"
