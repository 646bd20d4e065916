"""One step of Dormand and Prince's explicit method of order 8.

It is for motions between events, which are not stiff.  A loop over its stages is traced and
compiled in a tenth of the time of diffrax's more general one.

Source: Prince and Dormand, High order embedded Runge-Kutta formulae, Journal of Computational and
Applied Mathematics 7 (1981); the coefficients are those of `diffrax.Dopri8`.
"""

from collections.abc import Callable

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import ScalarLike

_TABLEAU = dfx.Dopri8.tableau
_STAGES = np.zeros((len(_TABLEAU.c) + 1, len(_TABLEAU.c) + 1))
for _row, _weights in enumerate(_TABLEAU.a_lower):
    _STAGES[_row + 1, : _row + 1] = _weights
_END, _ERROR = np.asarray(_TABLEAU.b_sol), np.asarray(_TABLEAU.b_error)


def step(
    rate: Callable[[Float[Array, "..."]], Float[Array, "..."]],
    y: Float[Array, "..."],
    slope: Float[Array, "..."],
    h: ScalarLike,
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """(y after a step h of y' = rate(y), an estimate of its error); `slope` = rate(y)."""
    rates = jnp.concatenate([slope[None], jnp.zeros((len(_END) - 1, *y.shape))])

    def stage(i: Array, rates: Array) -> Array:
        here = y + h * jnp.tensordot(jnp.asarray(_STAGES)[i], rates, 1)
        return lax.dynamic_update_index_in_dim(rates, rate(here), i, 0)

    rates = lax.fori_loop(1, len(_END), stage, rates)
    end = y + h * jnp.tensordot(jnp.asarray(_END), rates, 1)
    return end, h * jnp.tensordot(jnp.asarray(_ERROR), rates, 1)
