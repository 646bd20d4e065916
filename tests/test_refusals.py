"""Impossible arguments are refused everywhere, by errors that help."""

import importlib
import signal

import jaxtyping
import pytest
from refusals import combined
from refusals.table import public, too_slow

# What functions return: no caller makes one.
RESULTS = (
    "Result SearchResult Simulation Numerics StabilityRange FoldDescent HopfDescent Equilibrium "
    "HopfPoint Fold Grazing HopfPoints CurvePoint SpecialCurve SpecialCycle Extrapolation "
    "Evidence Verdict LyapunovSpectrum Branch SpecialPoint CycleBranch LimitCycle "
    "CyclePoint CycleSearch CycleSymmetry Identification Profile Design Depinning FrontSpeed "
    "LinearModes LockedPattern PhaseModel Step ComplexModes StoreError SlidingBasin "
    "EdgeState Blow SweepInterrupted Settled"
)
# Classes without an argument; records, which hold whatever they are given;
# and fields that are checked where a run begins. Base classes are in tests/test_every_model.py.
OTHERS = "Divergence EnergyBalance MostSticking Variable DimensionalParameters Method"
SUBMODULES = ("model", "runs", "searches", "states", "pictures")


@pytest.fixture(autouse=True)
def unchecked():
    """The annotations, which are checked in tests, would refuse before jaxchain does."""
    before = signal.signal(signal.SIGALRM, too_slow)
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # some are numbers of SI units, which are warned of, too
def test_a_bad_argument_is_refused_by_name_with_its_value_and_what_helps():
    tried, faults = set(), []
    for submodule in SUBMODULES:
        for row in importlib.import_module(f"refusals.{submodule}").rows():
            tried.add(row.name.partition(",")[0].partition(".")[0])
            faults += row.faults()
    assert not faults, "\n".join(faults)
    bases = {name for name in public() if name.startswith("Abstract")}
    excused = {*RESULTS.split(), *OTHERS.split(), *bases}
    assert tried | excused == public().keys()
    assert not tried & excused


def test_arguments_that_do_not_fit_together_are_refused_with_the_reason():
    for words, call in combined.values():
        with pytest.raises(ValueError, match=words):
            call()
