"""Which public names the table does not try, and why."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator

import jaxchain

RESULT = "what a function returns; no caller makes one"
BASE = "a base class, for subclasses: tests/test_custom_laws.py, test_local_force.py, test_base.py"
NO_ARGUMENT = "takes no argument"
RECORD = "holds whatever it is given: no check, no meaning of its own"
# Submodules whose input are files: their own tests have broken ones.
FILES = {"scenes", "studies"}
NOT_TRIED = {
    **dict.fromkeys(
        (
            "Result", "SearchResult", "Simulation", "Numerics",
            "StabilityRange", "FoldDescent", "HopfDescent", "Equilibrium", "HopfPoint", "Fold",
            "Grazing", "HopfPoints", "CurvePoint", "SpecialCurve", "SpecialCycle",
            "Extrapolation", "Evidence", "Verdict",
            "LyapunovSpectrum", "Branch", "SpecialPoint", "FoldPoint", "CycleBranch",
            "LimitCycle", "CyclePoint", "CycleSearch", "CycleSymmetry",
            "Identification", "Profile", "Design", "Depinning",
            "FrontSpeed", "LinearModes", "LockedPattern", "PhaseModel", "LocalSlopes", "Step",
            "ComplexModes", "StoreError", "SlidingBasin", "EdgeState", "Blow",
            "SweepInterrupted", "Settled",
        ),
        RESULT,
    ),
    **dict.fromkeys(
        (
            "AbstractFrictionLaw", "AbstractModel", "AbstractCells", "AbstractOscillators",
            "AbstractObserver", "AbstractStructuredRosenbrock", "AbstractRegion",
            "AbstractClassifier",
        ),
        BASE,
    ),
    **dict.fromkeys(("Divergence", "EnergyBalance", "MostSticking"), NO_ARGUMENT),
    **dict.fromkeys(("Variable", "DimensionalParameters"), RECORD),
    "Method": "its fields are those of `simulate`, and checked where a run begins",
}  # fmt: skip


def public() -> set[str]:
    """The names of the top level and of all submodules but `FILES`."""
    submodules = set(jaxchain.SUBMODULES) - FILES
    modules = [
        jaxchain,
        *(importlib.import_module(f"jaxchain.{submodule}") for submodule in submodules),
    ]
    return {
        name for module in modules for name in module.__all__ if name not in jaxchain.SUBMODULES
    }


def untried(names: Iterable[str]) -> Iterator[str]:
    """Public names that are neither tried nor excused, and excuses that nothing needs."""
    tried = {name.partition(",")[0].partition(".")[0] for name in names}
    for name in sorted(public() - tried - NOT_TRIED.keys()):
        yield f"{name} is public, but not in the table\n"
    for name in sorted((NOT_TRIED.keys() & tried) | (NOT_TRIED.keys() - public())):
        yield f"{name} needs no excuse\n"
