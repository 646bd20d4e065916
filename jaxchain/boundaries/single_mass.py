"""All cycles of one mass over the belt speed, from steady sliding to stick-slip.

The cycles of one mass form one branch.  It leaves steady sliding at the Hopf speed, continues as
unstable slip cycles up to the fold, and returns as the stable stick-slip cycle.  As a function of
z = asinh(max w / eps) it is smooth at every width, also around the fold.  It is not a graph over
z: on the stick-slip cycles of the paper's set z has a maximum near v_d = 0.75.  So
`continue_cycle` follows the branch in both directions from its fold.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import check_concrete, check_kind, check_positive_number
from .._final import final
from .._types import Given, ScalarLike
from ..cycles.branches import continue_cycle
from ..model.chain import Chain, require_smoothed
from ..model.initial_states import check_mass
from ..result import Printed
from .fold import Fold, find_fold
from .hopf import hopf_belt_speed

# Points on each side of the fold, at most.
_POINTS = 72
# Lengths of the sides: on the slip cycles z covers about asinh(v_d / eps).
_STICKING, _SLACK = 5.0, 3.0


@final
class OneMassBranch(Printed, eqx.Module):
    """The cycles of one mass in order: steady sliding, unstable slip cycles, fold, stick-slip.

    - `belt_speed` v_d, `amplitude` A (half peak-to-peak of x), `period` T; dimensionless, padded
      with NaN, which must be dropped before a line is drawn.
    - `scaled_peak_velocity`: s = max w / eps.

    The first entry is the Hopf point, of amplitude 0; `fold` is the index of the fold.  `cut_off`
    says where and why a side ends before steady sliding or `lowest`; it is empty if none does.

    See `one_mass_branch` for an example.
    """

    belt_speed: Float[Array, " points"]
    amplitude: Float[Array, " points"]
    scaled_peak_velocity: Float[Array, " points"]
    period: Float[Array, " points"]
    fold: int = eqx.field(static=True)
    cut_off: str = eqx.field(static=True, default="")


def one_mass_branch(
    chain: Chain, lowest: Given[ScalarLike] = 0.1, fold: Fold | None = None
) -> OneMassBranch:
    """Every cycle of one mass, stable or not, with smoothed friction.

    **Arguments:** `chain` of one mass; its `belt_speed` is ignored.  `lowest`, the belt speed at
    which the stick-slip branch ends, below the fold.  `fold`, the result of `find_fold(chain)`, if
    you have it.

    **Returns:** 146 points, 73 of them slip cycles, filled with NaN; for the paper's set at width
    1e-2 the fold is at v_d = 1.7925, A = 1.7808.  It works for one chain, on the host.  The error
    of the points is some ten times the tolerance of the integration, 3e-11.  All are NaN if there
    is no fold: then cycles, if any, are stable and grow out of the Hopf point as the belt slows
    down.

    **Raises:** `ValueError` for a chain of several masses or a `lowest` that is not positive, or
    not below the fold; `KeyboardInterrupt` on Ctrl-C, without a part of the branch.

    !!! example

        >>> import jax, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.boundaries import one_mass_branch
        >>> branch = one_mass_branch(paper_chain(n=1, width=1e-2), lowest=1.0)
        >>> there = ~np.isnan(branch.belt_speed)  # NaN where there is no point
        >>> float(branch.amplitude[0]), round(float(branch.belt_speed[0]), 4)  # at the Hopf point
        (0.0, 1.1513)
        >>> bool(branch.belt_speed[there].max() == branch.belt_speed[branch.fold])
        True
    """
    _check_single(chain)
    require_smoothed(
        chain, "use `jaxchain.basins.sliding_basin` for its slip cycles, or ", "chain"
    )
    check_positive_number("lowest", lowest, "the cycles are lost as the belt comes to rest.")
    check_concrete("use `find_limit_cycle`.", chain=chain)
    fold = find_fold(chain) if fold is None else fold
    check_kind("fold", fold, Fold, "a `Fold` of the chain", "`find_fold(chain)` finds it.")
    check_below_fold(lowest, fold)
    rows = np.full((4, 2 * _POINTS + 2), np.nan)
    if not fold.successful:
        return OneMassBranch(*map(jnp.asarray, rows), fold=_POINTS + 1)
    top = float(fold.belt_speed)
    slipping = np.arcsinh(top / float(chain.width)) + _SLACK
    sides = ("slip", slipping, -1, 0.0), ("stick", _STICKING, 1, float(lowest))
    cuts = []
    for direction, length, way, least in sides:
        step = float(length) / _POINTS
        side = continue_cycle(
            chain.with_(belt_speed=top), fold.state, fold.period, direction=direction, step=step,
            max_step=step, max_points=_POINTS + 1, bounds=(least, np.inf), mass=0,
            keep_part=False,
        )  # fmt: skip
        columns = _POINTS + 1 + way * np.arange(len(side.parameter))
        rows[:, columns] = (
            side.parameter,
            side.amplitude[:, 0],
            side.scaled_peak_velocity,
            side.period,
        )
        if side.ended != "left_bounds" and not side.of_kind("hopf"):
            last = float(side.parameter[-1])
            cuts.append(f"The {direction} cycles end at belt speed {last:.6g}. {side.message}")
    hopf = float(hopf_belt_speed(chain))
    # The period of the smallest cycle found, which is near that of the Hopf point.
    first = rows[3, np.argmax(np.isfinite(rows[3]))]
    rows[:, 0] = hopf, 0.0, -hopf / float(chain.width), first
    return OneMassBranch(*map(jnp.asarray, rows), fold=_POINTS + 1, cut_off=" ".join(cuts))


def check_below_fold(lowest: Any, fold: Fold) -> None:
    """Raises `ValueError` if `lowest` is at or above the fold."""
    speed = float(jnp.min(jnp.where(fold.successful, fold.belt_speed, jnp.inf)))
    if float(lowest) >= speed:
        raise ValueError(
            f"Argument `lowest` must be below the fold, at a belt speed of {speed:.6g}, but is "
            f"{lowest}: no mass sticks and slips above it. 0.1 is usual."
        )


def _check_single(chain: Any) -> None:
    check_mass(chain, 0)
    if chain.n != 1:
        raise ValueError(
            f"Argument `chain` must have one mass, but has {chain.n}. For the cycles of several "
            "masses use `continue_branch`."
        )
