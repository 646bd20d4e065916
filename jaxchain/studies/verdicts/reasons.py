"""Why a verdict differs from what the paper says, or how it comes about: in words, by rules."""

from __future__ import annotations

import numpy as np

from jaxchain.chaos.records import Verdict
from jaxchain.studies.verdicts.paper import REGULAR

# Before this time the paper regards everything as transient, and from it on it looks.
PAPER_TRANSIENT, PAPER_END = 1e4, 1.5e4


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
