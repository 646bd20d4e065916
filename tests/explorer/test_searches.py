"""Searches in a process of their own: results, progress, cancel, refusals."""

import threading

import numpy as np
import pytest

from jaxchain import equation_8, find_limit_cycle, stability_range
from jaxchain.explorer import Session
from jaxchain.explorer.searches import CancelledError, Searcher, boundaries, branch, cycle
from jaxchain.model.ready_made import VanDerPol


@pytest.fixture(scope="module")
def searcher():
    made = Searcher()
    yield made
    made.stop()


@pytest.mark.slow
def test_the_process_finds_what_the_library_finds(searcher, chains):
    chain = chains[1, 1e-2]
    session = Session(chain, equation_8(chain, 1))
    for _ in range(50):
        session.advance(1.0)
    found = searcher.run(cycle, session.model, session.run.state, session.run.t, 0)
    assert found.stable
    assert float(found.period) == pytest.approx(float(find_limit_cycle(chain).period), abs=1e-7)
    said = []
    line = searcher.run(branch, found, "belt_speed", 3.0, report=said.append)
    assert any("belt_speed = " in text for text in said)
    speeds, energies, unstable = line["columns"]
    assert len(speeds) == len(energies) == len(unstable)
    assert 0 < unstable.sum() < len(unstable)
    limits = searcher.run(boundaries, chain, False)
    assert limits["fold"] == pytest.approx(float(stability_range(chain).fold), abs=1e-8)
    folds = [value for kind, value in line["special"] if kind == "fold"]
    assert np.min(np.abs(np.subtract(folds, limits["fold"]))) < 1e-6


def test_what_is_no_chain_is_refused_in_the_librarys_words(searcher):
    with pytest.raises(ValueError, match="must be a `Chain`, but is a VanDerPol"):
        searcher.run(boundaries, VanDerPol(1.0), False)


def test_a_search_is_cancelled_and_the_next_one_runs(searcher, chains):
    cancelled = threading.Event()
    threading.Timer(0.3, cancelled.set).start()
    chain = chains[3, 1e-2]
    with pytest.raises(CancelledError):
        searcher.run(boundaries, chain, True, cancelled=cancelled)
    with pytest.raises(ValueError, match="VanDerPol"):
        searcher.run(boundaries, VanDerPol(1.0), False)


def test_a_model_that_no_other_process_can_import_is_searched_here(searcher):
    class Own:
        pass

    with pytest.raises(ValueError, match="`chain` must be a `Chain`"):
        searcher.run(boundaries, Own(), False)


@pytest.mark.parametrize("after", [0.0, 0.3])
def test_what_is_stopped_ends_the_search_that_runs_and_starts_no_other(chains, after):
    stopped = Searcher()
    threading.Timer(after, stopped.stop).start()
    with pytest.raises(CancelledError):
        stopped.run(boundaries, chains[3, 1e-2], True)
    stopped.stop()
    with pytest.raises(CancelledError):
        stopped.run(boundaries, chains[3, 1e-2], True)
