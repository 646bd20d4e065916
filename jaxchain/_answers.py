"""What `jaxchain boundary` and `jaxchain basins` print: an object of JSON, or a table."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

# The numbers that each takes, those of the paper by default.
BOUNDARY = ("width", "damping_ratio", "coupling", "mu_static", "mu_dynamic", "v_ref")
BASINS = ("width", "damping_ratio", "mu_static", "mu_dynamic", "v_ref", "belt_speed")
_NO_HOPF = (
    "steady sliding is stable at every belt speed, or at no high one: friction weakens too little "
    "for the damping, or damping does not exceed 0"
)
_NO_FOLD = (
    "no fold was found: a vibration of one mass does not exist, or sets in gently at the Hopf "
    "speed, or does not end at any belt speed for want of damping, or the search failed "
    "(`find_fold(chain).message` says why)"
)


def boundary_report(chain: Any, found: Any) -> dict[str, Any]:
    """What `jaxchain boundary --json` prints: numbers, null with a reason in `missing`."""
    reasons = {
        "hopf": f"{_NO_HOPF}, at this width",
        "hopf_nonsmooth": f"{_NO_HOPF}, for dry friction",
        "fold": f"{_NO_FOLD}, at this width",
        "fold_nonsmooth": f"{_NO_FOLD}, for dry friction; for several masses, also where the "
        "neighbours reach the speed of the belt",
        "fold_limit": "a fold is not found at one of the widths that are extrapolated from",
    }
    values = _numbers({name: value for name, value in vars(found).items() if name != "mass"})
    return {
        **values,
        "missing": {name: why for name, why in reasons.items() if values[name] is None},
        "vibrating_oscillator": found.mass + 1,  # from 1, as the paper counts
        "parameters": {"n": chain.n, **_parameters(chain, BOUNDARY)},
    }


def boundary_text(report: dict[str, Any]) -> str:
    """Both boundaries as a table: at the width asked, for dry friction, with the bar."""
    parameters, fold, dry = report["parameters"], report["fold"], report["fold_nonsmooth"]
    single = f"the vibration of oscillator {report['vibrating_oscillator']} alone"
    who = "its vibration" if parameters["n"] == 1 else single
    rows = [
        ("belt speed", f"width {parameters['width']:g}", "dry friction", "what it says"),
        ("Hopf", *_pair(report, "hopf"), "just below it vibration starts by itself"),
        ("fold", *_pair(report, "fold"), f"up to it {who} survives"),
    ]
    if report["fold_limit"] is not None:
        limit = f"{report['fold_limit']:.9f} ± {report['fold_limit_error']:.0e}"
        rows.append(("", "", limit, "the same, extrapolated from smoothed friction"))
    lines = [f"{a:<12} {b:<14} {c:<24} {d}" for a, b, c, d in rows]
    hopf = report["hopf_nonsmooth"]
    if hopf is not None and dry is not None and hopf < dry:
        lines.append(f"From {hopf:.4f} to {dry:.4f} it depends on the start: rest or vibration.")
    if fold is not None and dry is not None:
        lines.append(f"The width moves the fold by {100 * (fold / dry - 1.0):+.3g} %.")
    return "\n".join([*lines, *_reasons(report)])


def basins_report(chain: Any, box: Any, smoothed: Any, dry: Any, found: Any) -> dict[str, Any]:
    """What `jaxchain basins --json` prints: numbers, null with a reason in `missing`."""
    values, reasons = {}, {}
    for ending, basin, kind in (
        ("", smoothed, "at this width"),
        ("_nonsmooth", dry, "for dry friction"),
    ):
        for name, field in (("share", "share"), ("blow_up", "up"), ("blow_down", "down")):
            value = values[name + ending] = float(getattr(basin, field))
            why = "every motion comes to slide steadily, however hard the blow"
            why = why if math.isinf(value) else basin.message.rstrip(".")
            reasons[name + ending] = f"{why}, {kind}"
        for name in ("hopf", "fold"):
            values[name + ending] = getattr(found, name + ending)
            why = "there is none, or it was not found: `jaxchain boundary` says more"
            reasons[name + ending] = f"{why}, {kind}"
    values = _numbers(values)
    return {
        **values,
        "missing": {name: reasons[name] for name, value in values.items() if value is None},
        "box": {key: getattr(box, key).tolist() for key in ("displacement", "velocity")},
        "parameters": _parameters(chain, BASINS),
    }


def basins_text(report: dict[str, Any]) -> str:
    """The share, the gentlest blows and the boundaries as a table, with what is missing."""
    (a, b), (c, d) = report["box"].values()
    parameters = report["parameters"]
    rows = [
        ("", f"width {parameters['width']:g}", "dry friction", "what it says"),
        ("share", *_pair(report, "share"), "of the starts that come to slide steadily"),
        ("blow up", *_pair(report, "blow_up"), "velocity that makes a sliding mass vibrate"),
        ("blow down", *_pair(report, "blow_down"), "the same, downward"),
        ("Hopf", *_pair(report, "hopf"), "belt speed just below which vibration starts by itself"),
        ("fold", *_pair(report, "fold"), "belt speed up to which it survives"),
    ]
    speed = parameters["belt_speed"]
    head = f"belt speed {speed:g}, starts with {a:g} <= x <= {b:g} and {c:g} <= v <= {d:g}"
    lines = [f"{one:<12} {two:<14} {three:<14} {four}" for one, two, three, four in rows]
    return "\n".join([head, *lines, *_reasons(report)])


def _numbers(values: dict[str, Any]) -> dict[str, float | None]:
    return {name: float(v) if math.isfinite(v) else None for name, v in values.items()}


def _parameters(chain: Any, names: tuple[str, ...]) -> dict[str, float | None]:
    numbers = {name: chain.numbers().get(name) for name in names}
    return {name: None if value is None else float(value) for name, value in numbers.items()}


def _pair(report: dict[str, Any], name: str) -> Iterator[str]:
    """A number at this width and for dry friction, which may have an error bar."""
    for key in (name, f"{name}_nonsmooth"):
        value, bar = report[key], report.get(f"{key}_error")
        more = "" if bar is None else f" ± {bar:.0e}"
        yield "none" if value is None else f"{value:.9f}{more}"


def _reasons(report: dict[str, Any]) -> Iterator[str]:
    return (f"{name}: {why}." for name, why in report["missing"].items())
