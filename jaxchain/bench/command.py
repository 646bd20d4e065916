"""`jaxchain bench`: the speed of this machine, both sides of every comparison run in turn."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from jaxchain._configure import configure, cores

if TYPE_CHECKING:
    from jaxchain.bench.timing import Row

# Each row: the module whose function `NAME_row` measures it, and what `--help` says about it.
ROWS = {
    "stock": (
        "solvers",
        "the structured solver against the fastest stock diffrax solver at equal error",
    ),
    "lsoda": (
        "solvers",
        "against LSODA and CVODE with compiled right side and Jacobian, one lane and 64",
    ),
    "size": ("size", "cost of one oscillator and step from N = 200 to N = 200,000"),
    "devices": ("ensembles", "two CPU devices against one, 512 lanes"),
    "dry": ("ensembles", "smoothed friction against true dry friction, 64 lanes"),
    "heyoka": (
        "heyoka", "true dry friction against heyoka at equal error: one mass, N = 20, 64 lanes"
    ),
    "mixed": (
        "ensembles", "a sweep of quiet and stick-slip lanes against plain vmap(diffeqsolve)"
    ),
    "import": ("steps", "import jaxchain beyond jax and diffrax, and the command without JAX"),
    "profile": ("steps", "what a step is made of, and how far it is from a C loop"),
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the rows asked for; returns 0 also if a bar is missed, 1 if a row failed."""
    options = _parser().parse_args(sys.argv[1:] if argv is None else argv)
    _configure_jax()
    # Only now: these need 64 bits and their devices.
    from jaxchain.bench.timing import Row, format_row, heading

    rows: list[Row] = []
    failed = False
    if not options.json:
        print(heading(), flush=True)
    for name in options.rows:
        try:
            found = _measure(name, options.repeats)
        except Exception as error:  # one row that fails must not hide the others
            failed = True
            found = [Row(name, ROWS[name][1], note=f"failed: {type(error).__name__}: {error}")]
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
        epilog="rows: " + "; ".join(f"{name} - {text}" for name, (_, text) in ROWS.items()),
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


def _measure(name: str, repeats: int) -> list[Row]:
    module = importlib.import_module(f"jaxchain.bench.rows_{ROWS[name][0]}")
    return getattr(module, f"{name}_row")(repeats)


def _configure_jax() -> None:
    """As users do, with two CPU devices where there are two cores.

    No cache of compiled programs: compile times are measured, too.
    """
    if "JAX_PLATFORMS" not in os.environ:
        import jax

        jax.config.update("jax_platforms", "cpu")
    configure(devices=None if "JAX_NUM_CPU_DEVICES" in os.environ else min(2, cores()))
