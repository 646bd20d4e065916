"""What `jaxchain boundary` prints: numbers as one JSON object, or words with what is missing."""

from __future__ import annotations

import math
from typing import Any

# The numbers that `boundary` takes, those of the paper by default.
NUMBERS = ("width", "damping_ratio", "coupling", "mu_static", "mu_dynamic", "v_ref")


def _missing(found: Any) -> dict[str, str]:
    """Why each value that is NaN is not there, in words; for one chain, not a batch."""
    no_hopf = (
        "steady sliding is stable at every belt speed, or at no high one: friction weakens too "
        "little for the damping, or damping does not exceed 0"
    )
    no_fold = (
        "no fold was found: a vibration of one mass does not exist, or sets in gently at the Hopf "
        "speed, or does not end at any belt speed for want of damping, or the search failed "
        "(`find_fold(chain).message` tells)"
    )
    joined = "; for several masses, also where the neighbours reach the speed of the belt"
    reasons = {
        "hopf": no_hopf,
        "hopf_nonsmooth": no_hopf + ", for dry friction",
        "fold": no_fold + ", at this width",
        "fold_nonsmooth": no_fold + ", for dry friction" + joined,
        "fold_limit": "a fold is not found at one of the widths that are extrapolated from",
    }
    return {k: why for k, why in reasons.items() if not math.isfinite(getattr(found, k))}


def report(chain: Any, found: Any) -> dict[str, Any]:
    """What `jaxchain boundary --json` prints: numbers, null with a reason in `missing`."""

    def number(value: Any) -> float | None:
        return float(value) if math.isfinite(value) else None

    names = [name for name in vars(found) if name != "mass"]
    values = {name: number(getattr(found, name)) for name in names}
    given = {name: chain.numbers().get(name) for name in NUMBERS}
    parameters = {k: None if value is None else float(value) for k, value in given.items()}
    # From 1, as the paper counts.
    return {
        **values,
        "missing": _missing(found),
        "vibrating_oscillator": found.mass + 1,
        "parameters": {"n": chain.n, **parameters},
    }


def in_words(chain: Any, found: Any) -> str:
    """Both boundaries in words: at the width asked, for dry friction, with the bar."""
    width = float(chain.width)
    who = (
        "its vibration" if chain.n == 1 else f"the vibration of oscillator {found.mass + 1} alone"
    )
    reasons = _missing(found)

    def row(title: str, name: str, more: str) -> str:
        own, dry = (float(getattr(found, key)) for key in (name, name + "_nonsmooth"))
        bar = float(getattr(found, name + "_nonsmooth_error"))
        at_width = "none" if math.isnan(own) else f"{own:.9f}"
        limit = "none" if math.isnan(dry) else f"{dry:.9f} ± {bar:.0e}"
        return f"{title:<12} {at_width:<14} {limit:<24} {more}"

    lines = [
        f"{'belt speed':<12} {f'width {width:g}':<14} {'dry friction':<24} what it says",
        row("Hopf", "hopf", "just below it vibration starts by itself"),
        row("fold", "fold", f"up to it {who} survives"),
    ]
    if "fold_limit" not in reasons:
        lines.append(
            f"{'':<12} {'':<14} {float(found.fold_limit):.9f} ± "
            f"{float(found.fold_limit_error):<9.0e} the same, extrapolated from smoothed friction"
        )
    hopf, fold = float(found.hopf_nonsmooth), float(found.fold_nonsmooth)
    if hopf < fold:  # false for NaN
        lines.append(f"From {hopf:.4f} to {fold:.4f} it depends on the start: rest or vibration.")
    if "fold" not in reasons and "fold_nonsmooth" not in reasons:
        share = float(found.fold) / fold - 1.0
        lines.append(f"The width moves the fold by {100 * share:+.3g} %.")
    lines += [f"{name}: {why}." for name, why in reasons.items()]
    return "\n".join(lines)
