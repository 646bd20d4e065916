"""Speed on this machine: jaxchain and other programs, measured alternately.

    pip install 'jaxchain[peers]'
    python benchmarks/run.py                              all rows, while nothing else runs
    python benchmarks/run.py stock lsoda --page page.md   two rows, also as a page

Times are medians of the repeats, with the least and the greatest. A ratio is the time of a program
over that of the one with ratio 1, in the same round. "error <= e": each program runs with its
cheapest tolerance for which no displacement and no velocity has an error above e at the end.
Compilation is excluded.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import os
import platform
import sys
from pathlib import Path

import jax
import pandas as pd
from rows_ensembles import devices_row, gpu_row, mixed_row, sweep_row
from rows_solvers import dry_row, heyoka_row, lsoda_row, stock_row
from rows_steps import import_row, profile_row, size_row
from timing import Skipped

import jaxchain

ROWS = {
    "stock": stock_row,
    "lsoda": lsoda_row,
    "heyoka": heyoka_row,
    "dry": dry_row,
    "sweep": sweep_row,
    "mixed": mixed_row,
    "devices": devices_row,
    "gpu": gpu_row,
    "size": size_row,
    "profile": profile_row,
    "import": import_row,
}


def main() -> int:
    """Prints the rows asked for; returns 1 if one failed, 0 also where one missed its bar."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(ROWS)}")
    parser.add_argument("--repeats", type=int, default=5, help="turns of each comparison (5)")
    parser.add_argument("--quick", action="store_true", help="tiny problems, one turn: a trial")
    parser.add_argument("--page", type=Path, help="file for the table, .md or .json")
    options = parser.parse_args()
    if unknown := set(options.rows) - ROWS.keys():
        parser.error(f"no row {', '.join(unknown)}: choose from {', '.join(ROWS)}")

    # As users do, with two CPU devices where there are two cores. A GPU has a row of its own.
    jaxchain.configure(devices=None if "JAX_NUM_CPU_DEVICES" in os.environ else min(2, cores()))
    jax.config.update("jax_default_device", jax.local_devices(backend="cpu")[0])
    print(machine(), flush=True)
    found, failed = [], False
    for name in options.rows or ROWS:
        try:
            rows = ROWS[name](1 if options.quick else options.repeats, options.quick)
        except (ImportError, Skipped) as reason:
            rows = [{"case": f"skipped: {reason}"}]
        except Exception as error:  # one row that fails must not hide the others
            failed, rows = True, [{"case": f"failed: {type(error).__name__}: {error}"}]
        rows = [{"row": name, **row} for row in rows]
        for case, sides in shown(pd.DataFrame(rows)).groupby("case", sort=False):
            text = sides[["side", "time", "ratio", "bar"]].to_string(index=False)
            print(f"\n{name}: {case}\n{text}", flush=True)
        found += rows
    table = pd.DataFrame(found)
    if options.page and options.page.suffix == ".json":
        options.page.write_text(table.to_json(orient="records", indent=1), encoding="utf-8")
    elif options.page:
        options.page.write_text(page(table), encoding="utf-8")
    return int(failed)


def shown(table: pd.DataFrame) -> pd.DataFrame:
    """The table as text: times with units, ratios with the least and the most."""
    text = table.reindex(columns=["row", "case", "side", "seconds", "bar", *RATIOS])
    text["time"] = text["seconds"].map(with_unit)
    text["ratio"] = [
        "" if pd.isna(ratio) else f"{ratio:.3g} ({least:.3g} - {most:.3g})"
        for ratio, least, most in text[RATIOS].itertuples(index=False)
    ]
    return text.reindex(columns=["row", "case", "side", "time", "ratio", "bar"]).fillna("")


RATIOS = ["ratio", "ratio_least", "ratio_most"]


def with_unit(seconds: float) -> str:
    """Three digits and a unit, "" for NaN."""
    for scale, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (1e-9, "ns")):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return ""


def page(table: pd.DataFrame) -> str:
    """The table in Markdown."""
    text = shown(table)
    cells = [list(text), ["---"] * text.shape[1], *text.to_numpy().tolist()]
    lines = ["| " + " | ".join(line) + " |" for line in cells]
    index = ["```{index} benchmark, timing, speed comparison, fast, how fast", "```", ""]
    return "\n".join(["# Performance", "", *index, str(__doc__), machine(), "", *lines, ""])


def machine() -> str:
    """Processor, versions of what computes and of the peers, flags and date."""
    packages = ["jaxchain", "jax", "jaxlib", "diffrax", "numpy", "scipy"]
    peers = ["numba", "scikit-sundae", "heyoka"]
    installed = {dist.name for dist in importlib.metadata.distributions()}
    names = [name for name in packages + peers if name in installed]
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    cpu, info = platform.processor(), Path("/proc/cpuinfo")
    if info.exists():
        models = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = models[0].partition(":")[2].strip() if models else cpu
    flags = os.environ.get("XLA_FLAGS", "none")
    now = f"{datetime.datetime.now():%Y-%m-%d %H:%M}"
    return f"{cpu}, {cores()} cores; {versions}; XLA flags {flags}; {now}"


def cores() -> int:
    """How many cores this process may use."""
    return (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )


if __name__ == "__main__":
    sys.exit(main())
