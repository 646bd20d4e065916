"""`jaxchain bench`: the speed of this machine, both sides of every comparison run in turn."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxchain.bench.timing import Row

# Each row with what `--help` says about it.
ROWS = {
    "stock": "the structured solver against the fastest stock diffrax solver at equal error",
    "lsoda": "against LSODA and CVODE with compiled right side and Jacobian, one lane and 64",
    "size": "cost of one oscillator and step from N = 200 to N = 200,000",
    "devices": "two CPU devices against one, 512 lanes",
    "dry": "smoothed friction against true dry friction, 64 lanes",
    "mixed": "a sweep of quiet and stick-slip lanes against plain vmap(diffeqsolve)",
    "import": "import jaxchain beyond jax and diffrax, and the command without JAX",
    "profile": "what a step is made of, and how far it is from a C loop",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the rows asked for; returns 0 also if a bar is missed, 1 if a row failed."""
    options = _parser().parse_args(sys.argv[1:] if argv is None else argv)
    _configure_jax()
    # Only now: these need 64 bits and their devices.
    from jaxchain.bench.timing import Row, format_row, heading

    functions = _functions()
    rows: list[Row] = []
    failed = False
    if not options.json:
        print(heading(), flush=True)
    for name in options.rows:
        try:
            found = functions[name](options.repeats)
        except Exception as error:  # one row that fails must not hide the others
            failed = True
            found = [Row(name, ROWS[name], note=f"failed: {type(error).__name__}: {error}")]
        rows += found
        if not options.json:
            print("\n".join(map(format_row, found)), flush=True)
    if options.json:
        print(json.dumps([row.to_dict() for row in rows], indent=2))
    return int(failed)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxchain bench",
        description="Measures the speed on this machine. Both sides of a comparison run in turn; "
        "medians, least and most of the repeats. For quiet numbers, run nothing else meanwhile.",
        epilog="rows: " + "; ".join(f"{name} - {text}" for name, text in ROWS.items()),
    )
    parser.add_argument(
        "--rows", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW",
        help="only these rows (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--repeats", type=_positive, default=5, metavar="N", help="turns for each row (5)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON with every measurement")
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, but is {number}")
    return number


def _functions() -> dict[str, Callable[[int], list[Row]]]:
    from jaxchain.bench.rows_ensembles import devices_row, dry_row, mixed_row
    from jaxchain.bench.rows_size import size_row
    from jaxchain.bench.rows_solvers import lsoda_row, stock_row
    from jaxchain.bench.rows_steps import import_row, profile_row

    return {
        "stock": stock_row,
        "lsoda": lsoda_row,
        "size": size_row,
        "devices": devices_row,
        "dry": dry_row,
        "mixed": mixed_row,
        "import": import_row,
        "profile": profile_row,
    }


def _configure_jax() -> None:
    """64 bits, and two CPU devices where there are two cores.

    No cache of compiled programs: compile times are measured, too.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    # JAX takes the others only before its first computation.
    with contextlib.suppress(RuntimeError):
        if "JAX_PLATFORMS" not in os.environ:
            jax.config.update("jax_platforms", "cpu")
        if "JAX_NUM_CPU_DEVICES" not in os.environ:
            jax.config.update("jax_num_cpu_devices", min(2, len(os.sched_getaffinity(0))))
