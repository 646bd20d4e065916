"""What the study `verdicts` found, state by state, in lines of text."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from xarray import Dataset

from jaxchain.chaos.records import VERDICTS
from jaxchain.studies.verdicts.figure import decisive


def summary(datasets: Mapping[str, Dataset]) -> str:
    """State by state: the paper's text and caption, the verdict, its numbers, and why."""
    lines = []
    for key, data in datasets.items():
        lines.append(f"{key}: belt speed {data.attrs['belt_speed']:g}, {data.attrs['equation']}")
        lines.append(
            f"{'k':>4} {'vibrate':>7} {'text':<12}{'caption':<11}{'ours':<15}"
            f"{'without noise':<15}{'exponent':>10}  {'95 % interval':<23}{'longest':>8}  why"
        )
        found = decisive(data)
        for row in range(data.sizes["excited"]):
            own = data.isel(excited=row)
            low, high = (found[name][row] for name in ("low", "high"))
            known = not np.isnan(low)
            lines.append(
                f"{int(own['excited']):>4} {int(own['active'].sum()):>7} "
                f"{str(own['paper_text'].values) or '-':<12}"
                f"{str(own['paper_caption'].values) or '-':<11}"
                f"{VERDICTS[int(own['verdict'])]:<15}{VERDICTS[int(own['undisturbed'])]:<15}"
                f"{found['value'][row]:>10.1e}  "
                f"{f'[{low:+.1e}, {high:+.1e}]' if known else '':<23}"
                f"{float(own['time'].max()):>8.0f}  {own['why'].values}"
            )
    return "\n".join(lines)
