"""The two boundaries of vibration of one chain, with what smoothing does to each.

Just below the Hopf speed, the greatest where there are several, steady sliding is unstable, so
vibration starts by itself; up to the fold a vibration survives; between the two it depends on the
start.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._final import final
from ..model.chain import Chain
from ..model.initial_states import check_vibrating
from ..result import Printed
from .hopf import hopf_belt_speed
from .zero_width import fold_boundary

# Relative errors of a Hopf speed, and of a fold of dry friction.
_HOPF_ERROR, _DRY_ERROR = 1e-12, 1e-10


@final
class Boundaries(Printed, eqx.Module):
    """Belt speeds, dimensionless; NaN for what does not exist or was not found.

    - `hopf`: above it sliding is stable, just below it is not, at the chain's width;
      `hopf_nonsmooth`: for dry friction.
    - `fold`: up to it the vibration of one mass survives, at the chain's width.
    - `fold_nonsmooth`: the same for dry friction: found directly, else extrapolated to width 0.
    - `fold_limit`: extrapolated, a second opinion.
    - `..._error`: the bars of the values for dry friction.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.boundaries import hopf_and_fold
        >>> found = hopf_and_fold(paper_chain(1, width=1e-2))
        >>> round(float(found.fold), 6), round(float(found.fold_nonsmooth), 6)
        (1.792456, 1.836601)
        >>> apart = abs(found.fold_limit - found.fold_nonsmooth)  # two methods for dry friction
        >>> bool(apart < found.fold_limit_error), bool(found.fold_nonsmooth_error < 1e-9)
        (True, True)
    """

    hopf: Float[Array, ""]
    hopf_nonsmooth: Float[Array, ""]
    hopf_nonsmooth_error: Float[Array, ""]
    fold: Float[Array, ""]
    fold_nonsmooth: Float[Array, ""]
    fold_nonsmooth_error: Float[Array, ""]
    fold_limit: Float[Array, ""]
    fold_limit_error: Float[Array, ""]
    mass: int = eqx.field(static=True)


def hopf_and_fold(chain: Chain, vibrating: Any = None) -> Boundaries:
    """Both boundaries of a chain at its width, for dry friction, and the bars of the latter.

    The bar of the fold is that of the direct method, and more if the extrapolation from smoothed
    friction contradicts it: by as much as the two differ beyond the bar of the extrapolation.

    **Arguments:** `chain`, whose own `belt_speed` has no part in it; `vibrating`, the index of the
    mass whose vibration folds, by default n // 2.

    **Returns:** a `Boundaries`; works under `jit` and `vmap`, and is differentiable as
    `fold_boundary` is.

    **Raises:** `ValueError` as `fold_belt_speed` does.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.boundaries import hopf_and_fold
        >>> found = hopf_and_fold(paper_chain(n=1, width=1e-3))
        >>> round(float(found.hopf), 6), round(float(found.fold), 6)
        (1.151293, 1.83113)
        >>> round(float(found.fold_nonsmooth), 9)
        1.836600972
    """
    mass = check_vibrating(chain, vibrating)
    return _boundaries(chain, mass)


@eqx.filter_jit
def _boundaries(chain: Chain, mass: int) -> Boundaries:
    hopf_dry = hopf_belt_speed(chain.with_(width=None))
    fold = fold_boundary(chain, mass)
    direct = jnp.isfinite(fold.dry)
    apart = jnp.nan_to_num(jnp.abs(fold.dry - fold.limit))  # no second opinion, no contradiction
    contradicts = apart > jnp.nan_to_num(fold.error)
    bar = jnp.where(contradicts, apart, _DRY_ERROR * jnp.abs(fold.dry))
    return Boundaries(
        hopf=hopf_dry if chain.dry else hopf_belt_speed(chain),
        hopf_nonsmooth=hopf_dry,
        hopf_nonsmooth_error=_HOPF_ERROR * hopf_dry,
        fold=fold.value,
        fold_nonsmooth=jnp.where(direct, fold.dry, fold.limit),
        fold_nonsmooth_error=jnp.where(direct, bar, fold.error),
        fold_limit=fold.limit,
        fold_limit_error=fold.error,
        mass=mass,
    )
