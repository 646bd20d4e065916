"""What a table of times was measured on: machine, versions and flags."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import jax

from jaxchain._configure import cores
from jaxchain.model.provenance import versions as own_versions

_PEERS = ("scipy", "numba", "scikit-sundae", "heyoka")


def this_machine() -> dict[str, Any]:
    """Plain data; what the system does not tell is None."""
    return {
        "cpu": _cpu(),
        "cores": cores(),
        "memory_gib": _memory(),
        "os": platform.platform(),
        "devices": [f"{device.device_kind} {device.id}" for device in jax.devices()],
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "time": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "load": [round(load, 2) for load in os.getloadavg()]
        if hasattr(os, "getloadavg")
        else None,
    }


def versions() -> dict[str, str]:
    """Of Python, jaxchain, what computes below it, and of the peers that are installed."""
    found = own_versions()
    for package in _PEERS:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def one_line(machine: dict[str, Any], versions: dict[str, str]) -> str:
    """For above a table."""
    memory = "" if machine["memory_gib"] is None else f", {machine['memory_gib']:.0f} GiB"
    load = "" if machine["load"] is None else f", load {machine['load'][0]:.1f}"
    shown = " ".join(f"{name} {versions[name]}" for name in ("jaxchain", "jax", "jaxlib"))
    return f"{machine['cpu']}, {machine['cores']} cores{memory}{load}; {shown}; {machine['time']}"


def _cpu() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _memory() -> float | None:
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1)
    except (AttributeError, OSError, ValueError):
        return None
