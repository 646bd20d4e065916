"""What is done of a store, by whom and how fast.  Nothing here needs JAX, and nobody is disturbed.

- `status_of`: as numbers and words, for programs
- `in_lines`: for people
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from .._outcomes import ADVICE, WELL
from .claims import living
from .records import read_layout, unit_counts, unit_records, units_of

# The rate is that of the units that ended in the last so many seconds of the work, and of so many
# units at least.
_RECENT, _LEAST = 600.0, 8
_UNITS_OF_TIME = ((86400, "days"), (3600, "h"), (60, "min"), (1, "s"))
_MOST_NAMED = 5


def status_of(path: Path) -> dict[str, Any]:
    """What the records of a store say, as JSON has it.

    **Raises:** `FileNotFoundError` if there is no store.
    """
    layout = read_layout(path)
    if layout is None:
        raise FileNotFoundError(f"There is no store {path}.")
    found = list(unit_records(path, layout))
    results: Counter[str] = Counter()
    for record in found:
        results.update(record["results"])
    lanes, done = math.prod(layout["sizes"].values()), sum(record["lanes"] for record in found)
    owners, now = living(units_of(path)), time.time()
    rate = _rate(found)
    return {
        "store": str(path),
        "sizes": layout["sizes"],
        "units": math.prod(unit_counts(layout)),
        "units_done": len(found),
        "lanes": lanes,
        "lanes_done": done,
        "results": {name: results[name] for name in ADVICE if results[name]},
        "failed": {name: results[name] for name in ADVICE if results[name] and name not in WELL},
        "under_way": [
            {
                "unit": unit,
                "host": owner["host"].partition(" ")[0],
                "process": owner["process"],
                "for_s": None if "since" not in owner else round(now - owner["since"], 1),
            }
            for unit, owner in sorted(owners.items())
        ],
        "lanes_per_hour": None if rate is None else round(3600 * rate, 1),
        "left_s": _left(lanes - done, rate, bool(owners)),
        "bytes": _size(path) + _size(units_of(path)),
        "hosts": _counts(record["host"] for record in found),
        "device_kinds": _counts(record["device_kind"] for record in found),
        "versions": _versions(found),
    }


def in_lines(told: Mapping[str, Any]) -> str:
    """What `status_of` says of a store, for people."""
    done, units = told["units_done"], told["units"]
    rows = [
        ("units", f"{done:,} of {units:,} done"),
        ("runs", f"{told['lanes_done']:,} of {told['lanes']:,} done{_listed(told['results'])}"),
    ]
    rows += [("failed", f"{count:,} {n}: {ADVICE[n]}") for n, count in told["failed"].items()]
    if told["under_way"]:
        rows.append(("under way", _owners(told["under_way"])))
    elif done < units:
        rows.append(("under way", "nothing"))
    if told["lanes_per_hour"] is not None:
        left = "" if not told["left_s"] else f", {duration(told['left_s'])} left"
        rows.append(("rate", f"{told['lanes_per_hour']:,.0f} runs an hour{left}"))
    rows.append(("size", f"{told['bytes'] / 1e6:,.3g} MB"))
    for what, kinds in (("devices", told["device_kinds"]), *told["versions"].items()):
        if len(kinds) > 1:
            rows.append((what, f"not the same for all units{_listed(kinds)}"))
    return "\n".join([told["store"], *(f"  {name:<14}{text}" for name, text in rows)])


def duration(seconds: float) -> str:
    """In the unit that suits it.

    >>> duration(90.0), duration(7200.0)
    ('1.5 min', '2 h')
    """
    least, unit = next(one for one in _UNITS_OF_TIME if seconds >= one[0] or one[0] == 1)
    amount = seconds / least
    return f"{amount:.2g} {unit}" if 1 <= amount < 10 else f"{amount:,.0f} {unit}"


def _rate(found: Sequence[Mapping[str, Any]]) -> float | None:
    """Lanes a second over the recent units; time in which nobody computed does not count."""
    ended = sorted(found, key=lambda record: record["ended"])
    if not ended:
        return None
    first = next(i for i, r in enumerate(ended) if r["ended"] > ended[-1]["ended"] - _RECENT)
    first = max(0, min(first, len(ended) - _LEAST))
    recent = ended[first:]
    # A unit that ended before tells from when on these are all that ended.
    since = ended[first - 1]["ended"] if first else min(record["began"] for record in recent)
    spans = [(max(record["began"], since), record["ended"]) for record in recent]
    took = covered(spans)
    return sum(record["lanes"] for record in recent) / took if took > 0 else None


def covered(spans: Iterable[tuple[float, float]]) -> float:
    """The length of what these spans cover together.

    >>> covered([(0.0, 2.0), (1.0, 3.0), (5.0, 6.0)])
    4.0
    """
    length, until = 0.0, -math.inf
    for began, ended in sorted(spans):
        length += max(0.0, ended - max(began, until))
        until = max(until, ended)
    return length


def _left(lanes: int, rate: float | None, under_way: bool) -> float | None:
    if lanes == 0:
        return 0.0
    return round(lanes / rate, 1) if rate and under_way else None


def _size(folder: Path) -> int:
    """Bytes of the files in a folder; of one that is not there, 0."""
    size, folders = 0, [os.fspath(folder)]
    while folders:
        try:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
                    else:
                        size += entry.stat(follow_symlinks=False).st_size
        except FileNotFoundError:  # while a process fills it
            continue
    return size


def _counts(words: Iterable[str]) -> dict[str, int]:
    return dict(sorted(Counter(words).items()))


def _versions(found: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Of each package, by how many units each version was used."""
    counts: dict[str, Counter[str]] = {}
    for record in found:
        for name, version in record["versions"].items():
            counts.setdefault(name, Counter())[version] += 1
    return {name: dict(sorted(own.items())) for name, own in counts.items()}


def _listed(counts: Mapping[str, int]) -> str:
    said = ", ".join(f"{count:,} {name}" for name, count in counts.items())
    return f": {said}" if said else ""


def _owners(owners: Sequence[Mapping[str, Any]]) -> str:
    """How many units each process computes, and since when the oldest of them."""
    by_process: dict[str, list[Mapping[str, Any]]] = {}
    for owner in owners:
        by_process.setdefault(f"process {owner['process']} on {owner['host']}", []).append(owner)
    said = []
    for who, own in list(by_process.items())[:_MOST_NAMED]:
        ages = [entry["for_s"] for entry in own if entry["for_s"] is not None]
        since = f" for {duration(max(ages))}" if ages else ""
        said.append(f"{len(own)} by {who}{since}")
    if (more := len(by_process) - _MOST_NAMED) > 0:
        said.append(f"and by {more} processes more")
    return ", ".join(said)
