"""What may stand in the file of the study `mistuning`."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.scene import Problem, raise_all
from jaxchain.scenes.values import (
    MOST_NUMBERS,
    MOST_TIME,
    Name,
    Positive,
    Table,
    Time,
    Tolerance,
    Window,
)
from jaxchain.studies._tables import (
    MOST_ENTRIES,
    MOST_MASSES,
    BaseTable,
    Once,
    Several,
    too_many,
)

Disorder: TypeAlias = Annotated[float, Field(ge=0, le=0.24)]
Disorders: TypeAlias = Annotated[
    list[Disorder], Field(min_length=1, max_length=MOST_ENTRIES), Once
]
Chains: TypeAlias = Annotated[int, Field(ge=2, le=100_000)]
Start: TypeAlias = Literal["disturbed", "all", "half", "one"]

# No cycle of these chains is shorter (time units).
SHORTEST_PERIOD = 4.0


class Base(BaseTable):
    """The ring of which the stiffnesses vary."""

    masses: Annotated[int, Field(ge=3, le=MOST_MASSES)]


class Ensemble(Table):
    """Many chains at every coupling, belt speed and disorder, all from the same kind of start."""

    start: Start
    """Steady sliding, with all masses a little "disturbed" at random; or with masses pulled away
    as in eq. (8) of the paper: "all", a random "half" of them, or "one"."""
    belt_speed: Several
    coupling: Several
    disorder: Disorders
    """Standard deviation of the stiffness relative to its mean."""
    chains: Chains
    """In every point; the same ones (scaled to its disorder) in each."""
    transient: Time
    """What is waited for before amplitudes are measured."""
    window: Window
    """How long they are measured."""
    disturbance: Positive = 0.01
    """Standard deviation of the displacements, for "disturbed"."""

    @model_validator(mode="after")
    def _check(self) -> Ensemble:
        problems: list[Problem] = []
        for name in ("belt_speed", "coupling", "disorder"):
            for before, after in pairwise(getattr(self, name)):
                if after < before:
                    text = f"must increase, but {before:g} is followed by {after:g}"
                    problems.append(((name,), text))
                    break
        raise_all(problems)
        return self


class Longer(Table):
    """The first chains of each ensemble once more, for longer: has anything still moved?"""

    chains: Chains
    factor: Annotated[float, Field(gt=1, le=1000)]
    """By how much the transient is longer."""


class Locking(Table):
    """Frequencies of the masses, all of which start to vibrate: do they agree?"""

    belt_speed: Positive
    coupling: Positive
    disorder: Disorders
    chains: Chains
    transient: Time
    window: Annotated[float, Field(ge=50, le=MOST_TIME)]
    """Over which frequencies are counted."""


class Study(StudyTable):
    """Random stiffnesses and friction: which of them localizes the vibration?"""

    study: Literal["mistuning"]
    base: Base
    distribution: Literal["uniform", "normal"] = "uniform"
    """Of the stiffness."""
    ensemble: Annotated[dict[Name, Ensemble], Field(min_length=1, max_length=MOST_ENTRIES)]
    longer: Longer
    locking: Locking
    rtol: Tolerance = 1e-6

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        problems: list[Problem] = []
        n, own = self.base.masses, self.locking
        for name, part in self.ensemble.items():
            if name == "locking":
                text = "must have another name: another part of this study is called so"
                problems.append((("ensemble", name), text))
            counts = {
                "couplings": len(part.coupling), "belt speeds": len(part.belt_speed),
                "disorders": len(part.disorder), "chains": part.chains,
            }  # fmt: skip
            problems += too_many(counts, n, ("ensemble", name))
            if (longest := self.longer.factor * part.transient) > MOST_TIME:
                text = f"would make {longest:.3g} of the transient, and {MOST_TIME:g} is the most"
                problems.append((("longer", "factor"), f"{text}: lower it, or the transient"))
        counts = {"disorders": len(own.disorder), "chains": own.chains}
        problems += too_many(counts, n, ("locking",))
        # No mass has more maxima than that.
        peaks = own.window / SHORTEST_PERIOD * n * own.chains * len(own.disorder)
        if peaks > MOST_NUMBERS:
            text = f"would keep {peaks:.3g} maxima, and {MOST_NUMBERS:.0e} are the most"
            problems.append((("locking", "window"), f"{text}: lower it, or take fewer chains"))
        raise_all(problems)
        return self
