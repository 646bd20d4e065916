"""What the study `verdicts` found, state by state, in lines of text."""

from __future__ import annotations

import numpy as np
from xarray import Dataset

from jaxchain.chaos.classification import VERDICTS
from jaxchain.studies._reports import pairs, table
from jaxchain.studies.verdicts.figure import decisive


def summary(key: str, data: Dataset) -> str:
    """State by state: the paper's text and caption, the verdict, its numbers, and why."""
    names, found = np.array(VERDICTS), decisive(data)
    said = {where: data[f"paper_{where}"].values for where in ("text", "caption")}
    columns = {
        "k": (data["excited"], "d"),
        "vibrate": (data["active"].sum("oscillator"), "d"),
        **{where: (np.where(text == "", "-", text), "") for where, text in said.items()},
        "ours": (names[data["verdict"].values], ""),
        "without noise": (names[data["undisturbed"].values], ""),
        "exponent": (found["value"], ".1e"),
        "95 % interval": (pairs("[{:+.1e}, {:+.1e}]", found["low"], found["high"]), ""),
        "longest": (data["time"].max("run"), ".0f"),
        "why": (data["why"], ""),
    }
    head = f"{key}: belt speed {data.attrs['belt_speed']:g}, {data.attrs['equation']}"
    return f"{head}\n{table(columns)}"
