"""What smoothing makes of a touch of the belt's speed: asymptotics of a small width.

At the touch of dry friction, w' = -kappa t, smoothed friction lacks 2 exp(2 w / eps) of itself:

    w' = -kappa t - 2 h exp(2 w / eps),        h = p mu_st.

With tau = t (kappa / eps)^(1/2) this is linear in exp(-2 w / eps):

    exp(-2 w / eps) = exp(tau^2) [exp(-2 w_- / eps) + Q Phi(tau)],        Q = 4 h [pi / (kappa eps)]^(1/2),

Phi the normal distribution's, from 0 to 1, of variance 1/2: a cycle that would come back with w_-
leaves as if with w_+.  Along v_d = V + V_+ w_+ + V_- w_- (see `boundaries/grazing.py`) the belt is fastest at

    w_- = (eps / 2) ln[(rho - 1) / Q],    w_+ = -(eps / 2) ln[Q rho / (rho - 1)],    rho = -V_+ / V_-.
"""  # noqa: E501

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float

from .._types import ScalarLike

# The greatest w is at tau > -8: Q Phi is below rounding before, exp(tau^2) above 1e27.
_EARLIEST, _HALVINGS = -8.0, 44


class Layer(NamedTuple):
    """The fold of smoothed friction near a touch: w_+, w_-, the greatest w / eps, and its time."""

    leaving: Float[Array, ""]
    arriving: Float[Array, ""]
    closeness: Float[Array, ""]
    time: Float[Array, ""]


def sides(
    by_leaving: Any, by_arriving: Any, fall: Any, hold: Any, width: ScalarLike
) -> tuple[Array, Array, Array]:
    """(w_+, w_-, ln Q) at the fold from V_+, V_-, kappa, h, eps; NaN unless V_+ + V_- > 0 > V_-.

    Errors: O(eps^(3/2)) in v_d.
    """
    rho = -by_leaving / by_arriving
    log_q = jnp.log(4.0 * hold * jnp.sqrt(jnp.pi / (fall * width)))
    arriving = 0.5 * width * (jnp.log(rho - 1.0) - log_q)
    leaving = -0.5 * width * (log_q + jnp.log(rho / (rho - 1.0)))
    return leaving, arriving, log_q


def layer(by_leaving: Any, by_arriving: Any, fall: Any, hold: Any, width: ScalarLike) -> Layer:
    """The whole of the layer at the fold; arguments and errors as in `sides`."""
    leaving, arriving, log_q = sides(by_leaving, by_arriving, fall, hold, width)
    # exp(-2 w / eps) / Q = m, least where 2 tau m + 1 / pi^(1/2) = 0.
    start = 1.0 / (-by_leaving / by_arriving - 1.0)

    def least(tau: Array) -> Array:
        return start * jnp.exp(tau**2) + jnp.exp(tau**2 + log_ndtr(jnp.sqrt(2.0) * tau))

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        early = 2.0 * middle * least(middle) + jnp.pi**-0.5 < 0
        return jnp.where(early, middle, low), jnp.where(early, high, middle)

    ends = jnp.full_like(start, _EARLIEST), jnp.zeros_like(start)
    tau, _ = lax.fori_loop(0, _HALVINGS, halve, ends)
    closeness = -0.5 * (log_q + jnp.log(least(tau)))
    return Layer(leaving, arriving, closeness, tau * jnp.sqrt(width / fall))
