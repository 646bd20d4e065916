"""Progress: a bar in a terminal, a line a minute in a log."""

import io

import pytest

from jaxchain import _progress
from jaxchain._progress import progress_bar


class Terminal(io.StringIO):
    def isatty(self):
        return True


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


def test_a_terminal_gets_a_bar_in_place(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    for _ in progress_bar(range(3), show=True, desc="some", unit="case"):
        pass
    assert terminal.getvalue().count("\r") >= 2
    assert terminal.getvalue().count("\n") == 1
    assert "|" in terminal.getvalue()


def test_a_notebook_gets_a_bar_although_it_is_no_terminal(monkeypatch):
    screen = type("OutStream", (io.StringIO,), {"__module__": "ipykernel.iostream"})()
    monkeypatch.setattr("sys.stderr", screen)
    for _ in progress_bar(range(3), show=True, desc="some", unit="case"):
        pass
    assert screen.getvalue().count("\r") >= 2


@pytest.mark.parametrize("stream", [None, "log"])
def test_nothing_is_shown_without_a_terminal(monkeypatch, stream):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", None if stream is None else log)
    assert list(progress_bar(range(3), show=stream is None, desc="a", unit="b")) == [0, 1, 2]
    assert log.getvalue() == ""
