"""The benchmarks run, and compare as they promise; how fast this machine is, no test asserts."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
ROWS = {"stock", "lsoda", "heyoka", "dry", "sweep", "mixed", "devices", "gpu", "size", "profile"}


@pytest.fixture
def timing(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import timing  # pyright: ignore[reportMissingImports]

    return timing


def run(*arguments):
    command = [sys.executable, str(ROOT / "benchmarks" / "run.py"), "--quick", *arguments]
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(
        command, env=os.environ | paths, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.skipif(not find_spec("heyoka") or not find_spec("numba"), reason="no peers")
def test_every_row_runs_and_the_page_that_is_kept_is_such_a_page(tmp_path):
    run("--page", str(tmp_path / "page.json"))
    table = json.loads((tmp_path / "page.json").read_text(encoding="utf-8"))
    assert {line["row"] for line in table} == ROWS | {"import"}
    for line in table:
        if not line["case"].startswith("skipped: "):
            numbers = [line[key] for key in ("seconds", "least", "most")]
            numbers += [line["ratio"]] if line.get("ratio") is not None else []
            assert np.all(np.isfinite(numbers)), line
            assert min(numbers) > 0, line
    run("gpu", "--page", str(tmp_path / "page.md"))
    page = ROOT / "docs" / "explanation" / "performance.md"
    kept, made = (file.read_text(encoding="utf-8") for file in (page, tmp_path / "page.md"))
    measured = {line.split(" | ")[0].strip("| ") for line in kept.splitlines() if line[:2] == "| "}
    assert measured - {"row", "---"} == ROWS | {"import"}
    assert kept.split("\n\n")[:5] == made.split("\n\n")[:5]


def test_sides_are_measured_in_turn_and_compared_turn_by_turn(timing):
    now, calls = [0.0], []

    def side(name, *seconds):
        durations = iter(seconds)

        def call():
            calls.append(name)
            now[0] += next(durations)

        return call

    # The warm-up, then three turns on a machine that slows down; b takes half the time of a.
    sides = {"a": side("a", 9.0, 1.0, 2.0, 4.0), "b": side("b", 0.75, 0.5, 0.5, 1.0, 2.0)}
    times = timing.in_turn(sides, 3, clock=lambda: now[0])
    assert "".join(calls) == "abb" + "ab" * 3
    assert times["a"].tolist() == [1.0, 2.0, 4.0]
    a, b = timing.lines("case", times, "b", {"a": (">=", 3.0)})
    assert (a["ratio_least"], a["ratio"], a["ratio_most"]) == (2.0, 2.0, 2.0)
    assert (a["seconds"], a["bar"]) == (2.0, ">= 3 MISSED")
    assert "bar" not in b


def test_a_tolerance_counts_only_if_the_next_tighter_one_meets_the_error_bar_too(timing):
    errors = {1e-3: 1e-9, 1e-4: 1e-2, 1e-5: np.nan, 1e-6: 1e-6, 1e-7: 1e-7, 1e-8: 1e-8}

    def solve(rtol):
        requested.append(rtol)
        return np.full((2, 3), errors[rtol])

    requested = []
    label, winner = timing.cheapest({"lucky": solve}, np.zeros((2, 3)), 1e-5, list(errors))
    assert min(requested) == 1e-7  # two in succession are enough
    assert label.startswith(("lucky, rtol 1e-06", "lucky, rtol 1e-07"))
    assert winner().max() in (1e-6, 1e-7)
    with pytest.raises(RuntimeError, match="none of lucky met the error bar 1e-12"):
        timing.cheapest({"lucky": solve}, np.zeros((2, 3)), 1e-12, list(errors))
