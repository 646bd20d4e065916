"""What `jaxchain bench` prints, as a table, as JSON and as a page."""

import json
from pathlib import Path

import jax
import pytest

import jaxchain
import jaxchain.bench.command as bench
from jaxchain.bench.page import INTRODUCTION
from jaxchain.bench.rows_gpu import find_gpu, gpu_row
from jaxchain.bench.rows_sweep import sweep_row
from jaxchain.bench.timing import Bar, Row, Sample

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "performance.md"


@pytest.fixture
def rows(monkeypatch):
    def fine(name, repeats):
        sides = {"a | side": Sample((0.002,) * repeats), "other side": Sample((0.001,) * repeats)}
        ratio = sides["a | side"].over(sides["other side"])
        return [
            Row(name, "one / other", sides, ratio, bar=Bar("at least", 4.0), note="first\nsecond"),
            Row(name, "skipped row", note="skipped, no peer"),
        ]

    monkeypatch.setattr(bench, "_measure", fine)


@pytest.fixture
def kept(rows, capsys, tmp_path):
    assert bench.main(["--rows", "size", "--repeats", "2", "--json"]) == 0
    file = tmp_path / "bench.json"
    file.write_text(capsys.readouterr().out, encoding="utf-8")
    return file


def test_json_tells_of_the_machine_and_of_versions_beside_the_rows(kept):
    data = json.loads(kept.read_text(encoding="utf-8"))
    assert list(data) == ["machine", "versions", "rows"]
    about = data["machine"]
    assert about["cores"] >= 1
    assert about["cpu"]
    assert len(about["devices"]) == len(jax.devices())
    assert "xla_cpu_small_while_loop_byte_threshold" in about["xla_flags"]
    assert {"memory_gib", "os", "time", "load"} < about.keys()
    assert data["versions"]["jax"] == jax.__version__
    assert data["versions"]["jaxchain"] == jaxchain.__version__
    assert {"python", "jaxlib", "diffrax", "equinox", "numpy"} < data["versions"].keys()
    assert [row["met"] for row in data["rows"]] == [False, None]
    assert data["rows"][0]["measured"]["a | side"]["values"] == [0.002, 0.002]


def test_a_kept_file_is_shown_again_without_measuring(kept, monkeypatch, capsys):
    monkeypatch.setattr(bench, "_measure", None)
    assert bench.main(["--from", str(kept), "--json"]) == 0
    assert capsys.readouterr().out == kept.read_text(encoding="utf-8")
    assert bench.main(["--from", str(kept)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"jax {jax.__version__}" in lines[0]
    assert lines[1].split()[0] == "what"
    assert lines[3].endswith(">= 4  MISSED")
    assert bench.main(["--from", str(kept), "--rows", "dry"]) == 0
    assert "one / other" not in capsys.readouterr().out


def test_the_page_has_a_line_for_every_row(kept, capsys):
    assert bench.main(["--from", str(kept), "--markdown"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(INTRODUCTION)
    (row, skipped) = [line for line in text.splitlines() if line.startswith("| size ")]
    assert "2 ms: a \\| side<br>1 ms: other side | 2 (2 - 2) | >= 4  MISSED" in row
    assert "| skipped, no peer |" in skipped


def test_the_page_that_is_kept_is_one_that_the_command_prints():
    text = PAGE.read_text(encoding="utf-8")
    assert text.startswith(INTRODUCTION)
    names = {line.split(" | ")[0].strip("| ") for line in text.splitlines() if line[:2] == "| "}
    assert names - {"row"} == set(bench.ROWS)


@pytest.mark.parametrize("content", [None, "[]", "{", '{"rows": []}'])
def test_a_file_that_the_command_did_not_print_is_refused(content, tmp_path, capsys):
    file = tmp_path / "other.json"
    if content is not None:
        file.write_text(content, encoding="utf-8")
    with pytest.raises(SystemExit) as stop:
        bench.main(["--from", str(file)])
    assert stop.value.code == 2
    assert "other.json" in capsys.readouterr().err


def test_without_a_gpu_the_row_says_so():
    if find_gpu() is not None:
        pytest.skip("there is one")
    (row,) = gpu_row(1)
    assert "no GPU" in row.note


@pytest.mark.long
def test_the_row_about_a_gpu_compares_the_same_lanes():
    rows = gpu_row(1, lanes=3, few=2, span=5.0, device=jax.devices()[-1])
    assert [len(row.measured) for row in rows] == [2, 2]
    assert all("amplitudes differ by 0e+00" in row.note for row in rows)


@pytest.mark.long
def test_the_row_about_sweeps_counts_the_steps_of_both_sides(monkeypatch):
    monkeypatch.setattr("jaxchain.bench.rows_sweep.ROUNDS", 2)
    rows = sweep_row(1, span=3.0)
    assert len(rows) == 2 * min(2, len(jax.devices()))
    for row in rows:
        sweep, vmap = row.measured.values()
        assert sweep.median > 0.5 * vmap.median  # a step costs what it costs
