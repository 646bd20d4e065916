"""What the paper says of each state: data, taken from its text and the captions of its figures.

Papangelo et al., Multiple spatially localized dynamical states in friction-excited oscillator
chains.  States go by the number of oscillators excited at the start.
"""

from __future__ import annotations

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
