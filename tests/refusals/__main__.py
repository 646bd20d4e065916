"""Input that must be refused, every piece of it by an error that helps.

Run by `test_refusals.py` as a program of its own: with the annotations checked, as in tests, those
would refuse before jaxchain does.  It prints what was not refused as it should be.

    python -m refusals table          one bad argument at a time, of all that is public
    python -m refusals everywhere     NaN, infinity and what cannot be, in runs, sweeps and scenes
"""

import signal
import sys

import jax

jax.config.update("jax_enable_x64", True)

from . import basins, boundaries, everywhere, model, motions, pictures, runs, searches  # noqa: E402
from .coverage import untried  # noqa: E402
from .table import too_slow  # noqa: E402


def main() -> None:
    if sys.argv[1] == "everywhere":
        rows = list(everywhere.rows())
        count = sum(len(row.attempts) for row in rows)
    else:
        signal.signal(signal.SIGALRM, too_slow)
        submodules = (model, runs, searches, boundaries, basins, motions, pictures)
        rows = [row for submodule in submodules for row in submodule.rows()]
        count = sum(row.attempts() for row in rows)
        print(*untried(row.name for row in rows), sep="\n", end="")
    for row in rows:
        for fault in row.faults():
            print(fault)
    print(f"\n{count} attempts")


main()
