"""The range of belt speeds at which a mass slides or vibrates, as it started.

Just below the Hopf speed, the greatest where there are several, steady sliding is unstable, so
vibration starts by itself; up to the fold a vibration survives; between the two it depends on the
start.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._checks import check_positive_number, is_traced, to_float
from .._final import final
from ..model.chain import Chain
from ..model.initial_states import check_mass, on_the_belt
from ..observers.amplitude import Amplitude
from ..observers.quantities import active
from ..result import Outcome, Printed, SearchResult
from ..simulation.event_driven import EventDriven
from ..simulation.run import simulate
from .fold import fold_speed_and_peak
from .hopf import hopf_belt_speed
from .limit import fold_boundary

_WINDOW = 20.0  # in which amplitudes are taken


@final
class BistableRange(Outcome):
    """The belt speeds at which a mass may slide or vibrate, depending on its start.

    - `hopf`: sliding is stable above it; NaN if it is at every speed.
    - `fold`: one mass can vibrate up to it; NaN if there is no fold.
    - `highest`: the greatest speed at which there is vibration at all, max(hopf, fold); 0 if there
      is none at any speed.
    - `width`: highest - hopf >= 0; 0 where there is proved to be no fold.
    - `result`: successful where the fold was found, or there is proved to be none.  Where it is
      not, it says why the search failed, and `highest` and `width` are NaN.

    See `bistable_range` for an example.
    """

    hopf: Float[Array, ""]
    fold: Float[Array, ""]
    highest: Float[Array, ""]
    width: Float[Array, ""]
    result: SearchResult


def bistable_range(chain: Chain, mass: Any = None) -> BistableRange:
    """Hopf and fold of one vibrating mass, and what lies between, dimensionless.

    **Arguments:** `chain`, dry or smoothed, whose own belt speed has no part in it; `mass`,
    the index of the mass, as in `fold_belt_speed`.

    Where damping outweighs the weakening of friction there is no fold, which is no failure: the
    width is 0.  Where the fold is not found the width is NaN, and `result` says why.  Works under
    `jit`, `vmap`, `jvp`, and, where there is a fold, `grad`.

    **Returns:** a `BistableRange`, in v_d.

    **Raises:** `ValueError` for anything but a `Chain`, or a mass that it does not have.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.boundaries import bistable_range
    >>> both = bistable_range(paper_chain(n=1, width=None))
    >>> round(float(both.hopf), 6), round(float(both.fold), 6), round(float(both.width), 6)
    (1.151293, 1.836601, 0.685308)
    """
    mass = check_mass(chain, mass)
    return _range(chain, mass)


@eqx.filter_jit
def _range(chain: Chain, mass: int) -> BistableRange:
    of = SearchResult
    fold, _, result = fold_speed_and_peak(chain, mass)
    hopf = hopf_belt_speed(chain)
    none = result == of.no_fold
    # Masses without damping vibrate at every speed, which has no fold, either.
    damped = jnp.min(chain.damping_ratio) > 0
    result = of.where(damped, of.where(none, of.successful, result), of.undamped)
    lowest = jnp.where(jnp.isnan(hopf), 0.0, hopf)
    highest = jnp.where(none, lowest, jnp.maximum(fold, lowest))
    highest = jnp.where(result == of.successful, highest, jnp.nan)
    return BistableRange(
        hopf=hopf, fold=fold, highest=highest, width=highest - lowest, result=result
    )


class BoundaryTrial(Printed, eqx.Module):
    """What became of one vibrating mass a little below and a little above a belt speed.

    `speeds`; `amplitudes` at the end, one row of n for each; `vibrates`: whether the mass still
    did; `holds`: whether it did below and rested above.
    """

    speeds: Float[Array, " two"]
    amplitudes: Float[Array, "two n"]
    vibrates: Bool[Array, " two"]
    holds: Bool[Array, ""]


def try_boundary(
    chain: Chain,
    belt_speed: Any,
    mass: Any = None,
    *,
    margin: Any = 0.01,
    time: Any = 400.0,
) -> BoundaryTrial:
    """Two event-driven runs with true dry friction: does the vibration of one mass end there?

    One mass starts on the belt, which carries it along, at belt speeds v (1 - margin) and
    v (1 + margin), and runs for `time`.  At true boundaries it survives below and dies above;
    but with neighbours that are strongly coupled (0.05 for three equal masses) this start may
    come to rest where another would not.  Under `jit` and `vmap`.

    **Arguments:** (dimensionless) `belt_speed` v, the boundary in question; `mass`, the index
    of the mass, by default n // 2; `margin`, a share of v; `time` long enough to die out: some
    multiples of 1 / xi.

    **Returns:** a `BoundaryTrial`: `speeds` (2,), `amplitudes` (2, n) at their ends, `vibrates`
    (2,), and `holds`, whether the mass vibrated below and rested above.

    **Raises:** `ValueError` for a speed, margin or time that is not positive.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import dry_fold_belt_speed, paper_chain
        >>> from jaxchain.boundaries import try_boundary
        >>> chain = paper_chain(n=1)
        >>> boundary = dry_fold_belt_speed(chain)
        >>> try_boundary(chain, boundary).vibrates.tolist()
        [True, False]
        >>> bool(try_boundary(chain, 0.9 * boundary).holds)  # that is no boundary
        False
    """
    mass = check_mass(chain, mass)
    for name, value, remedy in (
        ("belt_speed", belt_speed, "1.8 is usual."),
        ("margin", margin, "it is a share of the belt speed, such as 0.01."),
        ("time", time, "400 is usual."),
    ):
        check_positive_number(name, value, remedy)
    if not is_traced(margin) and float(margin) >= 1.0:
        raise ValueError(f"Argument `margin` must be below 1, but is {margin}: 0.01 is usual.")
    if not is_traced(time) and float(time) < _WINDOW:
        raise ValueError(
            f"Argument `time` must be at least {_WINDOW:g}, in which amplitudes are taken, but is "
            f"{time}: 400 is usual."
        )
    return _try(chain, to_float(belt_speed), mass, to_float(margin), to_float(time))


@eqx.filter_jit
def _try(chain: Chain, belt_speed: Array, mass: int, margin: Array, time: Array) -> BoundaryTrial:
    speeds = belt_speed * (1.0 + margin * jnp.array([-1.0, 1.0]))

    def amplitude(speed: Array) -> Array:
        chain_i = eqx.tree_at(lambda c: c.belt_speed, chain, speed)
        return simulate(
            chain_i,
            on_the_belt(chain_i, mass),
            time,
            observe=Amplitude(window=_WINDOW),
            solver=EventDriven(7),
            rtol=1e-8,
            throw=False,
        ).observed

    amplitudes = jax.vmap(amplitude)(speeds)
    vibrates = active(amplitudes, speeds)[:, mass]
    return BoundaryTrial(speeds, amplitudes, vibrates, vibrates[0] & ~vibrates[1])


@final
class Boundaries(Printed, eqx.Module):
    """Belt speeds, dimensionless; NaN for what does not exist or was not found.

    - `hopf`: above it sliding is stable, just below it is not, at the chain's width;
      `hopf_dry`: for dry friction.
    - `fold`: up to it the vibration of one mass survives, at the chain's width.
    - `fold_dry`: the same for dry friction: found directly, else extrapolated to width 0.
    - `fold_limit`: extrapolated, a second opinion.
    - `..._error`: the bars of the values for dry friction.

    See `hopf_and_fold` for an example.
    """

    hopf: Float[Array, ""]
    hopf_dry: Float[Array, ""]
    hopf_dry_error: Float[Array, ""]
    fold: Float[Array, ""]
    fold_dry: Float[Array, ""]
    fold_dry_error: Float[Array, ""]
    fold_limit: Float[Array, ""]
    fold_limit_error: Float[Array, ""]
    mass: int = eqx.field(static=True)


def hopf_and_fold(chain: Chain, mass: Any = None) -> Boundaries:
    """Both boundaries of a chain at its width, for dry friction, and the bars of the latter.

    The bar of the fold is that of the direct method, and more if the extrapolation from smoothed
    friction contradicts it: by as much as the two differ beyond the bar of the extrapolation.

    **Arguments:** `chain`, whose own `belt_speed` has no part in it; `mass`, the index of the
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
        >>> round(float(found.fold_dry), 9)
        1.836600972
    """
    mass = check_mass(chain, mass)
    return _boundaries(chain, mass)


@eqx.filter_jit
def _boundaries(chain: Chain, mass: int) -> Boundaries:
    hopf_dry = hopf_belt_speed(chain.with_(width=None))
    fold = fold_boundary(chain, mass)
    direct = jnp.isfinite(fold.dry)
    apart = jnp.nan_to_num(jnp.abs(fold.dry - fold.limit))  # no second opinion, no contradiction
    contradicts = apart > jnp.nan_to_num(fold.error)
    bar = jnp.where(contradicts, apart, 1e-10 * jnp.abs(fold.dry))
    return Boundaries(
        hopf=hopf_dry if chain.dry else hopf_belt_speed(chain),
        hopf_dry=hopf_dry,
        hopf_dry_error=1e-12 * hopf_dry,
        fold=fold.value,
        fold_dry=jnp.where(direct, fold.dry, fold.limit),
        fold_dry_error=jnp.where(direct, bar, fold.error),
        fold_limit=fold.limit,
        fold_limit_error=fold.error,
        mass=mass,
    )
