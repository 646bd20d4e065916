"""What the study `crosscheck` found, in lines of text."""

from __future__ import annotations

import numpy as np
import xarray as xr

from jaxchain.studies.crosscheck.cycles import OUTCOMES, VIBRATES

# Belt speeds in the table; the dataset has all of them.
MOST_ROWS = 6
_LAW = "relative error = a eps ln(1/eps) + b eps"


def summarize_cycles(data: xr.Dataset) -> str:
    """The law of the error and the widths, for some belt speeds; where there is no cycle."""
    rows = spread(data["belt_speed"].size, MOST_ROWS)
    took = data.attrs["wall_time_s"] + data.attrs["nonsmooth_wall_time_s"]
    lines = [
        f"one oscillator, vibrating cycle: {data.sizes['belt_speed']} belt speeds x "
        f"{data.sizes['width']} widths, {took:.3g} s; {_LAW}",
        f"  {'':<20}{'dry':>9}{'a':>9}{'expected':>10}{'b':>8}{'off by':>8}{'up to':>8}"
        + _widths_head(data),
    ]
    for quantity in data["quantity"].values:
        own = data.sel(quantity=quantity)
        for i in rows:
            row = own.isel(belt_speed=int(i))
            label = f"{quantity} at {float(row['belt_speed']):g}"
            expected = float(row["log_coefficient_expected"])
            shown = f"{expected:10.4f}" if np.isfinite(expected) else f"{'':10}"
            lines.append(
                f"  {label:<20}{float(row['nonsmooth']):9.5f}"
                f"{float(row['log_coefficient']):9.4f}{shown}{_rest(row)}"
            )
    lines += _without_cycle(data)
    lines += [
        "  expected: a mass leaves the belt like a dry one that starts at a relative speed of",
        "  (eps/4) ln[16 pi (p mu_st)^2 / (k v_d eps)].  It does not wait for the greatest",
        "  friction, (eps/2) [ln(4/eps) + 1] below mu_st for the paper's set: twice the log.",
    ]
    return "\n".join(lines)


def summarize_states(data: xr.Dataset) -> str:
    """The law of the error of the energy and the widths; where another state was reached."""
    took = data.attrs["wall_time_s"] + data.attrs["nonsmooth_wall_time_s"]
    lines = [
        f"localized states, energy: {data.sizes['excited']} states x {data.sizes['width']} "
        f"widths, {took:.3g} s; {_LAW}",
        f"  {'':<20}{'dry':>9}{'a':>9}{'':10}{'b':>8}{'off by':>8}{'up to':>8}"
        + _widths_head(data),
    ]
    for excited in data["excited"].values:
        row = data.sel(excited=excited)
        label = f"{excited} excited"
        lines.append(
            f"  {label:<20}{float(row['energy_nonsmooth']):9.5f}"
            f"{float(row['log_coefficient']):9.4f}{'':10}{_rest(row)}"
        )
        truth = float(row["active_count_nonsmooth"])
        if np.isnan(truth):
            lines.append("    the run with true dry friction failed")
            continue
        if truth != excited:
            lines.append(f"    {truth:.0f} vibrate in the end with true dry friction")
        other = row["active_count"].values != truth
        if other.any():
            counts = ", ".join(
                ("the run failed" if np.isnan(count) else f"{count:.0f}") + f" at {width:g}"
                for count, width in zip(
                    row["active_count"].values[other], row["width"].values[other], strict=True
                )
            )
            lines.append(f"    another state, left out: {truth:.0f} vibrate, but {counts}")
    return "\n".join(lines)


def spread(size: int, most: int) -> np.ndarray:
    """Indices of at most `most` of `size` entries, evenly spread, the first and last among them.

    >>> spread(17, 5).tolist()
    [0, 4, 8, 12, 16]
    """
    return np.unique(np.round(np.linspace(0, size - 1, min(size, most))).astype(int))


def _widths_head(data: xr.Dataset) -> str:
    heads = (f"{f'{100 * goal:g} %':>9}" for goal in data["accuracy"].values)
    return f"   width for{''.join(heads)}"


def _rest(row: xr.Dataset) -> str:
    widths = "".join(f"{width:9.1e}" for width in row["width_for"].values)
    off = float(row["worst_residual"])
    return (
        f"{float(row['linear_coefficient']):8.3f}{100 * off:6.1g} %"
        f"{float(row['widest_fitted']):8.0e}{'':12}{widths}"
    )


def _without_cycle(data: xr.Dataset) -> list[str]:
    """ "no cycle: ..." for each way in which there was none."""
    lines = []
    dry = data["outcome_nonsmooth"]
    for code, name in enumerate(OUTCOMES):
        if code == VIBRATES:
            continue
        speeds = dry["belt_speed"].values[(dry == code).values]
        if speeds.size:
            lines.append(f"  no dry cycle ({name}) at belt speeds {_listed(speeds)}")
        for speed in data["belt_speed"].values:
            here = data["outcome"].sel(belt_speed=speed)
            widths = here["width"].values[(here == code).values]
            if widths.size and int(dry.sel(belt_speed=speed)) == VIBRATES:
                lines.append(
                    f"  no smoothed cycle ({name}) at belt speed {speed:g}, widths "
                    f"{_listed(widths)}"
                )
    return lines


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in values)
