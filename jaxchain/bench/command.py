"""`jaxchain bench`: the speed of this machine, both sides of every comparison run in turn."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    "sweep": ("sweep", "what sweep adds to vmap(simulate), core time of a step and lane"),
    "devices": ("ensembles", "two CPU devices against one, 512 lanes"),
    "dry": ("ensembles", "smoothed friction against true dry friction, 64 lanes"),
    "heyoka": (
        "heyoka", "true dry friction against heyoka at equal error: one mass, N = 20, 64 lanes"
    ),
    "mixed": (
        "ensembles", "a sweep of quiet and stick-slip lanes against plain vmap(diffeqsolve)"
    ),
    "import": ("steps", "import jaxchain beyond jax and diffrax, and the command without JAX"),
    "gpu": ("gpu", "ensembles on a GPU against a CPU core; skipped where there is none"),
    "profile": ("steps", "what a step is made of, and how far it is from a C loop"),
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the rows asked for; returns 0 also if a bar is missed, 1 if a row failed.

    `--json` prints `{"machine": ..., "versions": ..., "rows": [...]}`: what the machine is and
    does, see `bench/machine.py`, and of each row every measurement, see `Row.to_dict`.
    """
    options = _parser().parse_args(sys.argv[1:] if argv is None else argv)
    _configure_jax()
    # Only now: these need 64 bits and their devices.
    from jaxchain.bench.machine import one_line, this_machine, versions
    from jaxchain.bench.page import markdown, rows_of
    from jaxchain.bench.timing import Row, format_row, heading

    show = _show_nothing if options.json or options.markdown else _show
    kept = options.source
    data = kept or {"machine": this_machine(), "versions": versions()}
    show(one_line(data["machine"], data["versions"]) + "\n" + heading())
    rows: list[Row] = []
    failed = False
    for name in options.rows:
        try:
            found = rows_of(kept, name) if kept else _measure(name, options.repeats)
        except Exception as error:  # one row that fails must not hide the others
            failed = True
            found = [Row(name, ROWS[name][1], note=f"failed: {type(error).__name__}: {error}")]
        rows += found
        if found:
            show("\n".join(map(format_row, found)))
    data = data | {"rows": [row.to_dict() for row in rows]}
    if options.json:
        print(json.dumps(data, indent=2))
    if options.markdown:
        print(markdown(data), end="")
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
    form = parser.add_mutually_exclusive_group()
    form.add_argument(
        "--json", action="store_true", help="print JSON: machine, versions, every measurement"
    )
    form.add_argument("--markdown", action="store_true", help="print a page with the table")
    parser.add_argument(
        "--from", dest="source", metavar="FILE", type=_read,
        help="measure nothing, show the rows of this file, printed by --json",
    )  # fmt: skip
    return parser


def _read(path: str) -> dict[str, Any]:
    """What `--json` has printed."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"cannot read {path}: {error}") from None
    if not (isinstance(data, dict) and {"machine", "versions", "rows"} <= data.keys()):
        raise argparse.ArgumentTypeError(f"{path} is not what `jaxchain bench --json` prints")
    return data


def _show(text: str) -> None:
    print(text, flush=True)


def _show_nothing(text: str) -> None:
    pass


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
    import jax

    configure(devices=None if "JAX_NUM_CPU_DEVICES" in os.environ else min(2, cores()))
    if "JAX_PLATFORMS" not in os.environ and jax.default_backend() != "cpu":
        # A GPU has a row of its own.
        jax.config.update("jax_default_device", jax.local_devices(backend="cpu")[0])
