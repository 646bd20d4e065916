"""One mass with dry friction, by SciPy's DOP853 with events."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp


def integrate(force, law, limit, start, t1, corners=(), max_step=0.01):
    """Pieces of x'' = force(t, x, x') - law(|x'|) sign x', which sticks while |force| <= limit.

    Pieces also end at the `corners` of the force in x.  Returns SciPy's solutions
    with dense output, and for each the sign of sliding.
    """
    t: Any = 0.0
    y: Any = np.array(start, float)
    sign: Any = np.sign(y[1])
    pieces, released = [], False
    while t < t1:
        if sign == 0.0 and (released or abs(force(t, *y)) > limit):
            sign = np.sign(force(t, *y))

        def motion(t: Any, y: Any, slides: Any = sign) -> Any:
            friction = law(slides * y[1]) * slides if slides else force(t, *y)
            return y[1], force(t, *y) - friction

        def ends(t: Any, y: Any, slides: Any = sign) -> Any:
            return slides * y[1] if slides else limit - abs(force(t, *y))

        events: Any = [ends, *((lambda t, y, c=c: y[0] - c) for c in corners)]
        for event in events:
            event.terminal = True
        events[0].direction = -1
        piece: Any = solve_ivp(
            motion, (t, t1), y, "DOP853", rtol=1e-12, atol=1e-13, max_step=max_step,
            events=events, dense_output=True,
        )  # fmt: skip
        pieces.append((piece, sign))
        t, y = piece.t[-1], piece.y[:, -1].copy()
        if piece.t_events[0].size:
            released = sign == 0.0
            y[1], sign = 0.0, 0.0
        elif piece.status == 1:  # beyond the corner
            y[0] += 1e-13 * np.sign(y[1])
    return pieces
