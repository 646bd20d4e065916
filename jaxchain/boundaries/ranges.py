"""Hopf speed, fold and the bistable range between them.

Just below the Hopf speed (the greatest, if there are several) steady sliding is unstable and
vibration starts by itself.  Up to the fold a vibration survives.  Between the two the start
decides.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import check_flag, is_traced
from .._types import Given
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..result import Outcome, SearchResult, advice_of
from .fold import fold_speed_and_peak
from .hopf import hopf_belt_speed
from .limit import fold_and_limit

# The reason of a missing Hopf speed, for the command line, too.
NO_HOPF = (
    "steady sliding is stable at every belt speed, or at no high one: friction weakens too little "
    "for the damping, or damping does not exceed 0"
)


class StabilityRange(Outcome):
    """Belt speeds at which vibration sets in and up to which it survives, dimensionless.

    - `hopf`: steady sliding is stable above it; NaN if it is stable at every speed.
    - `fold`: the vibration of one mass survives up to it; NaN if there is no fold.
    - `highest`: the greatest speed with vibration, max(hopf, fold); 0 if there is none.
    - `width`: highest - hopf >= 0, the bistable range; 0 if it is proved that there is no fold.
    - `result`: successful if the fold was found or is proved not to exist; otherwise it gives the
      reason, and `highest` and `width` are NaN.
    - `mass`: index of the mass that vibrates.

    With `error_bars=True` also the following, which are None without:

    - `hopf_dry`, `fold_dry`: the values for dry friction.  The fold is that of the grazing cycle,
      or extrapolated where that is not found.
    - `fold_limit`: the fold extrapolated from smoothed friction to width 0, a second method.
    - `hopf_dry_error`, `fold_dry_error`, `fold_limit_error`: bars, |value - truth| <= bar.

    See `stability_range` for an example.
    """

    may_be_missing = (
        "hopf",
        "fold",
        "hopf_dry",
        "hopf_dry_error",
        "fold_dry",
        "fold_dry_error",
        "fold_limit",
        "fold_limit_error",
    )
    hopf: Float[Array, ""]
    fold: Float[Array, ""]
    highest: Float[Array, ""]
    width: Float[Array, ""]
    result: SearchResult
    mass: int = eqx.field(static=True)
    hopf_dry: Float[Array, ""] | None = None
    hopf_dry_error: Float[Array, ""] | None = None
    fold_dry: Float[Array, ""] | None = None
    fold_dry_error: Float[Array, ""] | None = None
    fold_limit: Float[Array, ""] | None = None
    fold_limit_error: Float[Array, ""] | None = None

    def _instead(self) -> dict[str, str]:
        if jnp.ndim(self.hopf) or is_traced(self.hopf, self.fold):
            return {}
        no_hopf, no_fold = bool(jnp.isnan(self.hopf)), bool(jnp.isnan(self.fold))
        texts = {name: f"none: {NO_HOPF}" for name in ("hopf", "hopf_dry") if no_hopf}
        if no_fold and self.successful:
            why = advice_of(SearchResult.no_fold).partition(": ")[2].rstrip(".")
            texts |= dict.fromkeys(("fold", "fold_dry"), f"none: {why}")
            if no_hopf:
                texts |= {"highest": "no vibration survives at any belt speed", "width": ""}
        return texts


def stability_range(
    chain: Chain, mass: Given[int | None] = None, *, error_bars: Given[bool] = False
) -> StabilityRange:
    """Hopf speed, fold and the bistable range between them, for one vibrating mass.

    **Arguments:**

    - `chain`: dry or smoothed; its `belt_speed` is ignored.
    - `mass`: index of the mass, by default n // 2.
    - `error_bars`: also compute both speeds for dry friction, by two methods, with error bars.
      This takes about ten times as long.

    The bar of the dry fold is that of the direct method; if the extrapolation contradicts it, the
    bar is the difference of the two.  If damping outweighs the weakening of friction, there is no
    fold; this is a success, with width 0.

    **Returns:** a `StabilityRange`, in v_d.  Works under `jit`, `vmap`, `jvp`, and, where there is
    a fold, `grad`.

    **Raises:** `ValueError` unless `chain` is a `Chain` that has this mass.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain, stability_range
    >>> speeds = stability_range(paper_chain(n=1, width=None))
    >>> round(float(speeds.hopf), 6), round(float(speeds.fold), 6), round(float(speeds.width), 6)
    (1.151293, 1.836601, 0.685308)

    How far is the fold moved by a width of 0.01?

    >>> speeds = stability_range(paper_chain(n=1, width=1e-2), error_bars=True)
    >>> round(float(speeds.fold), 6), round(float(speeds.fold_dry), 6)
    (1.792456, 1.836601)
    """
    mass = check_mass(chain, mass)
    check_flag("error_bars", error_bars)
    return _range(chain, mass, bool(error_bars))


@eqx.filter_jit
def _range(chain: Chain, mass: int, error_bars: bool) -> StabilityRange:
    of = SearchResult
    hopf = hopf_belt_speed(chain)
    if error_bars:
        fold, result, limit, dry = fold_and_limit(chain, mass)
        # No second opinion, no contradiction.
        difference = jnp.nan_to_num(jnp.abs(dry - limit.value))
        contradicts = difference > jnp.nan_to_num(limit.error)
        bar = jnp.where(contradicts, difference, 1e-10 * jnp.abs(dry))
        direct = jnp.isfinite(dry)
        hopf_dry = hopf if chain.dry else hopf_belt_speed(chain.with_(width=None))
        bars = {
            "hopf_dry": hopf_dry,
            "hopf_dry_error": 1e-12 * hopf_dry,
            "fold_dry": jnp.where(direct, dry, limit.value),
            "fold_dry_error": jnp.where(direct, bar, limit.error),
            "fold_limit": limit.value,
            "fold_limit_error": limit.error,
        }
    else:
        (fold, _, result), bars = fold_speed_and_peak(chain, mass), {}
    none = result == of.no_fold
    # Masses without damping vibrate at every speed, so there is no fold either.
    damped = jnp.min(chain.damping_ratio) > 0
    result = of.where(damped, of.where(none, of.successful, result), of.undamped)
    lowest = jnp.where(jnp.isnan(hopf), 0.0, hopf)
    highest = jnp.where(none, lowest, jnp.maximum(fold, lowest))
    highest = jnp.where(result == of.successful, highest, jnp.nan)
    return StabilityRange(
        hopf=hopf,
        fold=fold,
        highest=highest,
        width=highest - lowest,
        result=result,
        mass=mass,
        **bars,
    )
