"""What came of the search for a fold of cycles, with advice in every message."""

from __future__ import annotations

import equinox as eqx


class FoldResult(eqx.Enumeration):
    """Whether there is a fold: found, proved not to be, or not found, which proves nothing."""

    found = ""
    none = (
        "There is no fold: damping outweighs the weakening of friction at every speed, 2 xi_n > "
        "p_n F'(w), so all motions approach steady sliding at every belt speed."
    )
    undamped = (
        "No fold was found: the damping ratio of the mass is not positive, so that nothing ends "
        "its vibration at a high belt speed. Give it damping."
    )
    gentle = (
        "No fold was found: to first harmonic the belt is fastest for the least vibration of all, "
        "so that vibration seems to set in gently (supercritically), at the Hopf speed. That is "
        "no proof: see `hopf_points` for the criticality, and run `simulate` from a vibration "
        "above `hopf_belt_speed`."
    )
    no_touch = (
        "No fold was found, though averaging has one: the search for the dry cycle that touches "
        "the belt's speed failed. With strong coupling one mass may not vibrate alone at any belt "
        "speed: try a run. Weaken the coupling, or follow the cycle in which several vibrate: "
        "`find_limit_cycle` from the end of a run, then `continue_cycle`."
    )
    no_cycle = (
        "No fold was found, though averaging has one: the search for a closed cycle failed. Where "
        "friction weakens over speeds far below the belt's, the cycle is very unstable: "
        "`find_grazing(chain).smoothed(width)` tells about where the fold is. Otherwise another "
        "width may help, or `continue_cycle` from a cycle of `find_limit_cycle`."
    )
