"""What may stand in the file of the study `mistuning`."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import Problem, raise_all
from jaxchain.scenes.values import (
    MOST_NUMBERS,
    MOST_TIME,
    RTOL,
    TRANSIENT,
    WINDOW,
    Name,
    Positive,
    Table,
    Time,
    Tolerance,
    Window,
)
from jaxchain.studies._tables import (
    BASE,
    MOST_ENTRIES,
    MOST_MASSES,
    RING,
    BaseTable,
    Once,
    Several,
    number,
    numbers,
    too_many,
)

Disorder: TypeAlias = Annotated[float, Field(ge=0, le=0.24)]
Disorders: TypeAlias = Annotated[
    list[Disorder],
    Field(
        min_length=1,
        max_length=MOST_ENTRIES,
        description="Standard deviations of the stiffness relative to its mean.",
    ),
    Once,
]
Chains: TypeAlias = Annotated[int, Field(ge=2, le=100_000)]
Start: TypeAlias = Literal["disturbed", "all", "half", "one"]

# No cycle of these chains is shorter (time units).
SHORTEST_PERIOD = 4.0


class Base(BaseTable):
    """The ring of which the stiffnesses vary."""

    masses: Annotated[int, Field(ge=3, le=MOST_MASSES), RING]


class Ensemble(Table):
    """Many chains at every coupling, belt speed and disorder, all from one kind of start.

    Couplings, belt speeds and disorders are given in rising order, each.
    """

    start: Start
    """Steady sliding, with all masses a little "disturbed" at random; or with masses pulled away
    as in eq. (8) of the paper: "all", a random "half" of them, or "one"."""
    belt_speed: Annotated[Several, numbers("belt_speed")]
    coupling: Annotated[Several, numbers("coupling")]
    disorder: Disorders
    chains: Chains
    """How many in every point; the same ones (scaled to its disorder) in each."""
    transient: Annotated[Time, TRANSIENT]
    window: Annotated[Window, WINDOW]
    disturbance: Positive = 0.01
    """Standard deviation of the displacements at the start, in x0, for "disturbed"."""

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
    """How many chains of each ensemble are run again."""
    factor: Annotated[float, Field(gt=1, le=1000)]
    """By what the transient is multiplied."""


class Locking(Table):
    """Frequencies of the masses, all of which start to vibrate: do they agree?"""

    belt_speed: Annotated[Positive, number("belt_speed")]
    coupling: Annotated[Positive, number("coupling")]
    disorder: Disorders
    chains: Chains
    """How many at every disorder."""
    transient: Time
    """Time units that are waited for before frequencies are measured."""
    window: Annotated[float, Field(ge=50, le=MOST_TIME)]
    """Time units over which they are measured."""


class Study(StudyTable):
    """Random stiffnesses and friction: which of them localizes the vibration?"""

    study: Annotated[Literal["mistuning"], WHICH]
    base: Annotated[Base, BASE]
    distribution: Literal["uniform", "normal"] = "uniform"
    """How stiffnesses are distributed; normal ones are cut off at four standard deviations."""
    ensemble: Annotated[dict[Name, Ensemble], Field(min_length=1, max_length=MOST_ENTRIES)]
    """The ensembles by name; each makes one dataset of this name."""
    longer: Longer
    """A check that the transients are long enough."""
    locking: Locking
    """What becomes of phase locking where all masses vibrate."""
    rtol: Annotated[Tolerance, RTOL] = 1e-6

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
