"""What a command has around it: streams that nobody may be reading, signals, somebody to ask."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

# The status of a command that was interrupted, if no signal says another.
INTERRUPTED = 128 + signal.SIGINT
# A terminal that was closed sends SIGHUP.
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Forgiving(io.FileIO):
    """A stream that drops what cannot be written, and remembers why it first could not."""

    fault: OSError | None = None

    def write(self, data: Any, /) -> int:
        size = memoryview(data).nbytes
        try:
            written = super().write(data)
        except OSError as error:
            self.fault = self.fault or error
            return size
        # None where a stream that must not wait would have to.
        return size if written is None else written


@contextlib.contextmanager
def forgiving_streams() -> Iterator[_Forgiving | None]:
    """Within it, printing raises nothing: a reader that has gone, a full disk, a character that
    the terminal does not know, which becomes an escape.

    Streams that somebody has put in the place of the standard ones stay as they are.

    **Returns:** the raw standard output, with its first `fault`.
    """
    kept, raws = (sys.stdout, sys.stderr), []
    with contextlib.ExitStack() as opened:
        for name in ("stdout", "stderr"):
            stream, raw = getattr(sys, name), None
            if stream is None:  # closed by whoever started us; a file would take its number
                setattr(sys, name, opened.enter_context(open(os.devnull, "w", encoding="utf-8")))
            elif stream is getattr(sys, f"__{name}__") and isinstance(stream, io.TextIOWrapper):
                with contextlib.suppress(OSError):
                    stream.flush()
                raw = _Forgiving(stream.fileno(), "w", closefd=False)
                text = io.TextIOWrapper(
                    io.BufferedWriter(raw), stream.encoding, "backslashreplace",
                    line_buffering=stream.line_buffering, write_through=stream.write_through,
                )  # fmt: skip
                setattr(sys, name, text)
                opened.callback(text.flush)
            raws.append(raw)
        try:
            yield raws[0]
        finally:
            sys.stdout.flush()
            sys.stdout, sys.stderr = kept


def _lost(raw: _Forgiving | None) -> str | None:
    """Why what was printed is lost, if it is; a reader who has gone wanted no more."""
    fault = None if raw is None else raw.fault
    return None if fault is None or fault.errno == errno.EPIPE else fault.strerror


class Stop:
    """Which signal asked the process to stop, if any."""

    number: int | None = None
    count: int = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        del frame
        self.number, self.count = self.number or number, self.count + 1
        if self.count == 2:  # `timeout` sends two, and people are impatient
            with contextlib.suppress(OSError):
                os.write(2, b"\njaxchain: saving what has ended; once more to give it up\n")
        else:
            raise KeyboardInterrupt

    def status(self, status: int) -> int:
        """The exit status: 128 and the number of the signal where that has ended the command."""
        interrupted = status == INTERRUPTED and self.number is not None
        return 128 + (self.number or 0) if interrupted else status


@contextlib.contextmanager
def stoppable() -> Iterator[Stop]:
    """Within it, Ctrl-C, SIGTERM and SIGHUP raise `KeyboardInterrupt`, but not while that is
    being dealt with: the second signal is only answered, the third raises again.

    A signal that is ignored, or that somebody else handles, stays so.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    usual = (signal.SIG_DFL, signal.default_int_handler)
    mine = [number for number, handler in before.items() if handler in usual]
    for number in mine:
        signal.signal(number, stop)
    try:
        yield stop
    finally:
        for number in mine:
            signal.signal(number, before[number])


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Signals that ask the process to stop wait for the end of the block: it takes a moment."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    # None is a handler that Python does not know and could not put back.
    mine = [n for n, handler in before.items() if handler not in (signal.SIG_IGN, None)]
    for number in mine:
        signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, before[number])
        for number in came:
            signal.raise_signal(number)


def run_command(command: Callable[[], int], *, print_matters: bool) -> int:
    """The exit status of a command, which is stopped by signals and by nothing else around it.

    **Arguments:** `print_matters`, whether it has failed if what it prints is lost.
    """
    with forgiving_streams() as output, stoppable() as stop:
        try:
            status = command()
        except KeyboardInterrupt:
            print("jaxchain: interrupted", file=sys.stderr)
            status = INTERRUPTED
        sys.stdout.flush()
        if status == 0 and print_matters and (why := _lost(output)):
            print(f"jaxchain: cannot print: {why}", file=sys.stderr)
            status = 1
    return stop.status(status)


class Elsewhere:
    """Where results go that cannot be written: where somebody at the terminal wants them, else
    into a new folder `name` in the system's place for temporary files.

    Called with what went wrong; returns None when it knows no other folder.
    """

    def __init__(self, name: str):
        self.name = name
        self.forced = False
        """Whether nobody chose the folder."""

    def __call__(self, error: Exception) -> Path | None:
        print(f"jaxchain: {error}", file=sys.stderr)
        answer = ask("Another folder for the results (Enter: a temporary one)?")
        if answer is None and self.forced:
            return None
        self.forced = answer is None
        if answer is not None:
            return Path(answer).expanduser()
        import tempfile  # takes longer than all of this module, and is seldom needed

        try:
            folder = Path(tempfile.mkdtemp(prefix="jaxchain-"), self.name)
        except OSError:
            return None
        print(f"jaxchain: the results go to {folder} instead, if they fit there", file=sys.stderr)
        return folder


def ask(question: str) -> str | None:
    """What somebody at the terminal answers; None if nobody is there or nothing is said."""
    if not (sys.stdin and sys.stdin.isatty() and sys.stderr.isatty()):
        return None
    print(question, end=" ", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip() or None
