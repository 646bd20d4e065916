"""Progress: a bar in a terminal, a line a minute in a log."""

import io

import pytest

from jaxchain import _progress
from jaxchain._progress import progress_bar


@pytest.fixture
def clock(monkeypatch):
    """The clock of bars, to be set by hand."""
    now = [0.0]
    monkeypatch.setattr(_progress.time, "monotonic", lambda: now[0])
    return now


def test_a_log_gets_a_line_a_minute_and_one_at_the_end(monkeypatch, clock):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    with progress_bar(total=600, show=True, desc="some", unit="case") as bar:
        for second in range(600):
            clock[0] = float(second)
            for _ in range(10):
                bar.refresh()
            bar.n = second + 1
    lines = log.getvalue().splitlines()
    assert "\r" not in log.getvalue()
    assert len(lines) == 10
    assert [line.split()[2] for line in lines] == [
        *(f"{60 * i}/600" for i in range(1, 10)),
        "600/600",
    ]
    assert lines[0].startswith("some:  10% 60/600 [")
    assert "case/s" in lines[0]
    assert "<" in lines[0]


def bars(monkeypatch, stream, show=True):
    """How often a line is drawn anew."""
    monkeypatch.setattr("sys.stderr", stream)
    assert list(progress_bar(range(3), show=show, desc="some", unit="case")) == [0, 1, 2]
    return stream.getvalue().count("\r") if stream else 0


def test_a_terminal_and_a_notebook_get_a_bar_in_place_if_they_want_one(monkeypatch):
    terminal = type("Terminal", (io.StringIO,), {"isatty": lambda self: True})
    notebook = type("OutStream", (io.StringIO,), {"__module__": "ipykernel.iostream"})
    assert bars(monkeypatch, terminal()) >= 2
    assert bars(monkeypatch, notebook()) >= 2
    assert bars(monkeypatch, terminal(), show=False) == bars(monkeypatch, None) == 0
