"""What the paper says of each state, and why a verdict differs from it or how it comes about.

The claims are data, taken from its text and the captions of its figures; the reasons are rules.

Papangelo et al., Multiple spatially localized dynamical states in friction-excited oscillator
chains.  States go by the number of oscillators excited at the start.
"""

from __future__ import annotations

import numpy as np

from jaxchain.chaos.classification import Verdict

# Before this time the paper regards everything as transient, and from it on it looks.
PAPER_TRANSIENT = 1e4
REGULAR, IRREGULAR, SILENT = "periodic", "irregular", ""

_TEXT_1_5 = {
    **dict.fromkeys((1, 2, 8, 19, 20), REGULAR), **dict.fromkeys((5, 9, 12, 13), IRREGULAR)
}  # fmt: skip
_CAPTION_1_5 = {
    **dict.fromkeys((1, 2, 3, 4, 7, 20), REGULAR),
    **dict.fromkeys((5, 6, *range(9, 19)), IRREGULAR),
}

# By the name of a claim in the study's file: (what text says, what the caption says).
CLAIMS: dict[str, tuple[dict[int, str], dict[int, str]]] = {
    # Sec. 3.3 with Figs. 6 and 7; caption of Fig. 8, which leaves 8 and 19 out.
    "figures 6 to 8": (_TEXT_1_5, _CAPTION_1_5),
    # Sec. 4.1, Fig. 9: "increasing the belt velocity leads to more irregular solutions".
    "figure 9": ({}, {}),
    # Sec. 4.2, Fig. 10: "all the solutions obtained (perhaps except the 18th) are periodic".
    "figure 10": ({k: REGULAR for k in range(1, 21) if k != 18} | {18: "perhaps not"}, {}),
    "none": ({}, {}),
}


def claim(name: str, excited: int) -> tuple[str, str]:
    """(text, caption) of the paper on a state; "" where it says nothing.

    >>> claim("figures 6 to 8", 8), claim("figures 6 to 8", 3)
    (('periodic', ''), ('', 'periodic'))
    """
    text, caption = CLAIMS[name]
    return text.get(excited, SILENT), caption.get(excited, SILENT)


def agrees(verdict: str, claim: str) -> bool | None:
    """Whether a verdict fits a claim; None where there is none, or nothing is decided."""
    if not claim or verdict in ("transient", "failed") or claim not in (REGULAR, "irregular"):
        return None
    return (verdict in ("periodic", "at rest")) == (claim == REGULAR)


def why(verdict: Verdict, text: str, caption: str) -> str:
    """One sentence."""
    told = []
    unstable = [run for run in verdict.runs if run.kind == "unstable"]
    noise_free = [run for run in verdict.runs if run.noise == 0.0]
    if unstable:
        rate = max(run.exponents[0] for run in unstable)
        told.append(
            f"the start without noise ends on a symmetric orbit that is unstable (grows at "
            f"{rate:.1e}): exact arithmetic alone stays there"
        )
    locked = [run.locked_at for run in verdict.runs if run.kind == "cycle"]
    if locked and max(locked) > PAPER_TRANSIENT:
        told.append(
            f"phases lock only by {np.median(locked):.0f} (median of {len(locked)} runs, latest "
            f"{max(locked):.0f}); the paper looks at 1e4 - 1.5e4"
        )
    elif locked and len(locked) == len(verdict.runs):
        told.append(f"every run is locked by {max(locked):.0f}")
    still = [run for run in verdict.runs if run.kind in ("chaos", "torus", "open")]
    if still and locked:
        told.append(f"{len(still)} of {len(verdict.runs)} runs still wander")
    if verdict.verdict == "chaotic" and not unstable:
        least = min(run.low[0] for run in still if len(run.low))
        told.append(f"phases wander with an exponent above {least:.1e}")
    if verdict.depends_on_noise and not unstable and noise_free:
        told.append(f"without noise it is {verdict.undisturbed}")
    against = [
        f"{where} ({claim})"
        for where, claim in (("text", text), ("caption", caption))
        if agrees(verdict.verdict, claim) is False
    ]
    start = f"against {' and '.join(against)}: " if against else ""
    return start + "; ".join(told)
