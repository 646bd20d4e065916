"""Searches in a process of their own: results, progress, cancel, refusals."""

import threading

import numpy as np
import pytest

from jaxchain import ExponentialDecay, equation_8
from jaxchain.explorer.searches import CancelledError, Searcher, boundaries, branch, cycle
from jaxchain.explorer.session import Session
from jaxchain.model import MechanicalCells, VanDerPol

SPEEDS = "belt_speed", (0.0, 3.0)


@pytest.fixture(scope="module")
def searcher():
    made = Searcher()
    yield made
    made.stop()


@pytest.mark.slow
def test_the_process_finds_the_cycle_of_the_run_and_its_fold(searcher, chains):
    chain = chains[1, 1e-2]
    session = Session(chain, equation_8(chain, 1))
    for _ in range(50):
        session.advance(1.0)
    found = searcher.run(cycle, session.model, session.run.state, session.run.t, 0)
    assert found.stable
    assert float(found.period) == pytest.approx(session.numbers().period, abs=1e-4)
    said = []
    line = searcher.run(branch, found, "belt_speed", 3.0, report=said.append)
    assert any("belt_speed = " in text for text in said)
    speeds, energies, unstable = line["columns"]
    assert len(speeds) == len(energies) == len(unstable)
    assert 0 < unstable.sum() < len(unstable)
    limits = searcher.run(boundaries, chain, False, *SPEEDS)
    folds = [value for kind, value in line["special"] if kind == "fold"]
    assert np.min(np.abs(np.subtract(folds, limits["fold"]))) < 1e-6  # found in another way


def test_the_hopf_point_of_every_model_is_found_and_what_has_no_fold_says_why(searcher):
    law = ExponentialDecay(1.0, 0.5, 0.5)
    mass = MechanicalCells(1.0, damping=0.1, friction=law, belt_speed=1.5)
    found = searcher.run(boundaries, mass, False, *SPEEDS)
    assert found["hopf"] == pytest.approx(0.5 * np.log(10.0), abs=1e-9)
    assert "must be a `Chain`, but is a MechanicalCells" in found["note"]
    assert searcher.run(boundaries, mass, False, "belt_speed", (1.3, 3.0))["hopf"] is None


def test_a_search_is_cancelled_and_the_next_one_runs(searcher, chains):
    cancelled = threading.Event()
    threading.Timer(0.3, cancelled.set).start()
    chain = chains[3, 1e-2]
    with pytest.raises(CancelledError):
        searcher.run(boundaries, chain, True, *SPEEDS, cancelled=cancelled)
    with pytest.raises(ValueError, match="belt_speed"):
        searcher.run(boundaries, VanDerPol(1.0), False, *SPEEDS)

    class Own:  # which no other process can import: it is searched here
        pass

    with pytest.raises(ValueError, match="Own"):
        searcher.run(boundaries, Own(), False, *SPEEDS)


def test_what_is_stopped_ends_the_search_that_runs_and_starts_no_other(chains):
    stopped = Searcher()
    threading.Timer(0.3, stopped.stop).start()
    for _ in range(2):
        with pytest.raises(CancelledError):
            stopped.run(boundaries, chains[3, 1e-2], True, *SPEEDS)
