"""What `jaxchain basins` prints: numbers as one JSON object, or words with what is missing."""

from __future__ import annotations

import math
from typing import Any

# The numbers that `basins` takes, those of the paper by default.
NUMBERS = ("width", "damping_ratio", "mu_static", "mu_dynamic", "v_ref", "belt_speed")
_KINDS = {"": "at this width", "_nonsmooth": "for dry friction"}


def _values(smoothed: Any, dry: Any, boundaries: Any) -> dict[str, float]:
    """All that is told, NaN or infinite where there is no number."""
    of_basins = {
        f"{name}{kind}": float(getattr(found, of))
        for kind, found in zip(_KINDS, (smoothed, dry), strict=True)
        for name, of in (("share", "share"), ("blow_up", "up"), ("blow_down", "down"))
    }
    names = [f"{name}{kind}" for name in ("hopf", "fold") for kind in _KINDS]
    return {**of_basins, **{name: float(getattr(boundaries, name)) for name in names}}


def _missing(values: dict[str, float], smoothed: Any, dry: Any) -> dict[str, str]:
    """Why each value that is no finite number is not there, in words."""
    reasons = {}
    for name, value in values.items():
        kind = "_nonsmooth" if name.endswith("_nonsmooth") else ""
        if math.isfinite(value):
            continue
        if name.startswith(("share", "blow")):
            why = (dry if kind else smoothed).message
            if math.isinf(value):
                why = "every motion comes to slide steadily, however hard the blow"
        else:
            why = "there is none, or it was not found: `jaxchain boundary` says more"
        reasons[name] = f"{why.rstrip('.')}, {_KINDS[kind]}"
    return reasons


def report(chain: Any, box: Any, smoothed: Any, dry: Any, boundaries: Any) -> dict[str, Any]:
    """What `jaxchain basins --json` prints: numbers, null with a reason in `missing`."""
    values = _values(smoothed, dry, boundaries)
    numbers = chain.numbers()
    return {
        **{name: value if math.isfinite(value) else None for name, value in values.items()},
        "missing": _missing(values, smoothed, dry),
        "box": {
            "displacement": box.displacement.tolist(),
            "velocity": box.velocity.tolist(),
        },
        "parameters": {name: float(numbers[name]) for name in NUMBERS},
    }


def in_words(chain: Any, box: Any, smoothed: Any, dry: Any, boundaries: Any) -> str:
    """The share, the gentlest blows and the boundaries, with what is missing."""
    values = _values(smoothed, dry, boundaries)

    def row(title: str, name: str, more: str) -> str:
        told = [
            "none" if math.isnan(value) else f"{value:.9f}"
            for value in (values[name], values[f"{name}_nonsmooth"])
        ]
        return f"{title:<12} {told[0]:<14} {told[1]:<14} {more}"

    (a, b), (c, d) = box.displacement.tolist(), box.velocity.tolist()
    lines = [
        f"belt speed {float(chain.belt_speed):g}, starts with {a:g} <= x <= {b:g} and "
        f"{c:g} <= v <= {d:g}",
        f"{'':<12} {f'width {float(chain.width):g}':<14} {'dry friction':<14} what it says",
        row("share", "share", "of the starts that come to slide steadily"),
        row("blow up", "blow_up", "velocity that makes a sliding mass vibrate"),
        row("blow down", "blow_down", "the same, downward"),
        row("Hopf", "hopf", "belt speed just below which vibration starts by itself"),
        row("fold", "fold", "belt speed up to which it survives"),
    ]
    reasons = _missing(values, smoothed, dry)
    return "\n".join([*lines, *(f"{name}: {why}." for name, why in reasons.items())])
