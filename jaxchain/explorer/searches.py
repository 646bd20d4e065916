"""Searches of the explorer, in a process of their own: boundaries, cycles, branches.

A search traces and compiles for seconds, which would stop the pictures of every visitor; and a
process can be ended, which is how a search is cancelled.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from .._configure import configure


def boundaries(
    model: Any, bars: bool, parameter: str, bounds: Any, report: Callable[[str], Any]
) -> dict[str, Any]:
    """Hopf and fold over a parameter, None where there is none; `note`: why no fold is searched.

    Of a chain, over its belt speed, with `bars` also for dry friction.  Of every other model the
    Hopf point in `parameter` that is nearest to its present value, within `bounds`.

    **Raises:** `ValueError` for an equilibrium that cannot be followed.
    """
    from ..boundaries.equilibria import find_hopf_point
    from ..boundaries.ranges import stability_range
    from ..model.arguments import as_chain

    del report
    names, note = ["hopf", "fold"], ""
    try:
        found: Any = stability_range(as_chain(model), error_bars=bars)
        names += ["hopf_dry", "hopf_dry_error", "fold_dry", "fold_dry_error"] if bars else []
        numbers = {name: float(np.asarray(getattr(found, name))) for name in names}
    except ValueError as error:
        found = find_hopf_point(model, parameter, bounds=bounds, throw=False)
        numbers = {"hopf": float(found.value) if found.successful else np.nan}
        note = str(error)
    known = {name: value if np.isfinite(value) else None for name, value in numbers.items()}
    return {**known, "parameter": parameter, "note": note}


def cycle(model: Any, state: Any, t: float, mass: int, report: Callable[[str], Any]) -> Any:
    """The limit cycle on which the run settles, or `RuntimeError` with advice."""
    from ..cycles.limit_cycle import find_limit_cycle
    from ..simulation.run import simulate

    report("the run settles, then Newton's method")
    return find_limit_cycle(model, simulate(model, state, t, t0=t), mass=mass)


def branch(found: Any, parameter: str, high: float, report: Callable[[str], Any]) -> Any:
    """Both halves of the branch through a cycle: parameter, energy, unstable, special points."""
    from ..cycles.branches import continue_cycle

    halves, points = [], []
    for direction in (1, -1):

        def show(count: int, point: Any, direction: int = direction) -> None:
            way = "up" if direction > 0 else "down"
            report(f"{way}, point {count}: {parameter} = {float(np.asarray(point.p)):.4g}")

        half = continue_cycle(
            found, parameter=parameter, direction=direction, bounds=(-high, high),
            max_points=150, progress=show, keep_part=False,
        )  # fmt: skip
        halves.append((half.parameter, half.energy, half.unstable > 0))
        points += [(point.kind, float(point.parameter)) for point in half.special]
    columns = [np.concatenate([b[::-1], a]) for a, b in zip(*halves, strict=True)]
    return {"columns": columns, "special": points}


class CancelledError(Exception):
    """A search that its visitor cancelled."""


class Searcher:
    """The process that searches, one task after the other; started with the first one."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._turn = threading.Lock()
        self._background: threading.Event | None = None
        self._stopped = False
        self._ending = threading.Lock()  # the thread that stops and the one that searches

    def run(
        self,
        task: Callable[..., Any],
        *arguments: Any,
        report: Callable[[str], Any] = lambda text: None,
        cancelled: threading.Event | None = None,
        background: bool = False,
    ) -> Any:
        """The result of a task, or its error; `CancelledError` once `cancelled` is set.

        A task in the `background` is cancelled for one that a visitor waits for.

        A model that the process cannot import, such as one of a notebook, is searched here.
        """
        report("waits for another search")
        cancelled = threading.Event() if cancelled is None else cancelled
        if not background and self._background is not None:
            self._background.set()
        while not self._turn.acquire(timeout=0.1):
            if cancelled.is_set() or self._stopped:
                raise CancelledError
        self._background = cancelled if background else None
        try:
            report("starts")
            try:
                request = pickle.dumps((task.__name__, arguments))
            except (pickle.PicklingError, AttributeError, TypeError):
                return task(*arguments, report=report)
            kind, answer = self._ask(request, report, cancelled)
        finally:
            self._turn.release()
        if kind == "unknown":
            return task(*arguments, report=report)
        if kind == "error":
            raise answer
        return answer

    def _ask(
        self, request: bytes, report: Callable[[str], Any], cancelled: threading.Event
    ) -> tuple[str, Any]:
        """The last message that the process sends about a request."""
        process: Any = self._started()
        done = threading.Event()

        def watch() -> None:
            while not done.wait(0.1):
                if cancelled.is_set():
                    return process.kill()
            return None

        threading.Thread(target=watch, daemon=True).start()
        try:
            process.stdin.write(request)
            process.stdin.flush()
            while (message := pickle.load(process.stdout))[0] == "progress":
                report(message[1])
            return message
        except (EOFError, OSError, pickle.UnpicklingError):
            with self._ending:
                self._end()  # waits: a process that is being killed still seems to live
            if cancelled.is_set() or self._stopped:
                raise CancelledError from None
            raise RuntimeError("The process that searches has ended: try again.") from None
        finally:
            done.set()

    def _started(self) -> subprocess.Popen[bytes]:
        """The process, started if none lives."""
        with self._ending:
            if self._stopped:
                raise CancelledError
            if self._process is None or self._process.poll() is not None:
                self._end()
                paths = [path for path in sys.path if path]
                self._process = subprocess.Popen(
                    [sys.executable, "-m", __name__],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
                )
            return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                with contextlib.suppress(OSError):  # a request that was not sent
                    pipe.close() if pipe is not None else None

    def stop(self) -> None:
        """Ends the process for good: a search that runs or waits is cancelled."""
        with self._ending:
            self._stopped = True
            if self._process is not None:
                self._process.kill()
            # The thread that searches reads to the end and closes the pipes.
            if self._turn.acquire(blocking=False):
                self._end()
                self._turn.release()


def _serve() -> None:
    """Answers requests of `Searcher` until it closes the pipe."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what is printed is no answer
    os.nice(10)  # pictures come first
    configure(cache=True)

    def send(*message: Any) -> None:
        pickle.dump(message, out)
        out.flush()

    while True:
        try:
            name, arguments = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        except (ImportError, AttributeError) as error:
            send("unknown", str(error))
            continue
        try:
            send("done", globals()[name](*arguments, report=lambda text: send("progress", text)))
        except Exception as error:
            kind = ValueError if isinstance(error, ValueError) else RuntimeError
            send("error", kind(str(error)))


if __name__ == "__main__":
    _serve()
