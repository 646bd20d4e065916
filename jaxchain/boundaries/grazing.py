"""The fold of true dry friction: the slip cycle with the fastest belt, which mostly touches it.

While a mass slides behind the belt, F = p mu(v_d - v), smooth up to v = v_d and beyond.  A slip
cycle that touches the belt's speed has, at the touch,

    v_j = v_d,        v_j' = 0,        so        K_jj x_j = p_j mu_st - 2 xi_j v_d + (C x)_j,

and this is where the branch of unstable slip cycles meets that of stick-slip cycles: the
grazing-sliding fold (di Bernardo, Budd, Champneys, Kowalczyk, Piecewise-smooth Dynamical Systems,
Springer 2008, section 8.6).  The equations of the cycle at the touch are smooth and regular, for
one mass that grazes while all others slide.

Near the touch let a cycle leave with the greatest velocity v_d + w_+ and come back, if nothing
held it, with v_d + w_-.  The chain gives one relation of them,

    v_d = V + V_+ w_+ + V_- w_-,

and what happens at the belt the other: dry friction w_+ = min(w_-, 0).  So slip cycles lie along
v_d = V + (V_+ + V_-) w, w < 0, sticking ones along v_d = V + V_- w_-, w_- > 0, and V is a fold,
the greatest belt speed of both, where V_+ + V_- > 0 > V_-.

Where V_+ + V_- < 0, as for a law that is flat at rest, the belt is faster for slip cycles that do
not quite reach it.  The fold is then the greatest v_d(w), w < 0: a smooth saddle-node of slip
cycles, with a multiplier of +1 and V_+ + V_- = 0.  As a parameter makes w -> 0 it merges with the
touch.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._final import final
from .._types import ScalarLike, State
from ..continuation.elimination import solve
from ..continuation.fold_points import fold_residual
from ..continuation.implicit import attach_derivative, if_found
from ..cycles.averaging import dry_summits, one_mass
from ..cycles.limit_cycle import can_be_cycle
from ..model.chain import Chain
from ..model.initial_states import check_vibrating
from ..model.sliding import damping_outweighs
from ..result import Outcome, SearchResult
from .fold_start import without_fold
from .touch import Touch, shift, touch_residual, touch_slopes
from .touch_search import find_dry_fold

# A velocity above the belt's by this share of it is one that passes it.
_PASSES = 1e-9


@final
class Grazing(Outcome):
    """The slip cycle with the fastest belt: the fold of cycles for dry friction.

    - `belt_speed`: V, NaN if none was found; `period`, and `state` at the greatest velocity of the
      mass.
    - `touches`: whether that velocity is the belt's, so that the fold is a grazing; if not, it is
      a smooth saddle-node of slip cycles, see the head of this module.
    - `by_leaving`, `by_arriving`: V_+ and V_-, see there.  Their ratio -V_+ / V_- is, for one
      mass, the multiplier of the slip cycle, about 2 at a touch and 1 at a saddle-node.
    - `fall`: kappa = -v_j'', how fast the mass loses its acceleration there; `hold`: the
      greatest friction force on it, p mu_st.
    - `residual`: the greatest gap after a period over the belt speed.
    - `result`: successful if the cycle closes, no mass passes the belt's speed anywhere on it, and
      it is a fold.

    `belt_speed`, `period` and `state` are differentiable; the rest is not.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.boundaries import find_grazing
        >>> grazing = find_grazing(paper_chain(n=1))
        >>> x, v = grazing.state  # at the touch
        >>> round(float(grazing.period), 4), bool(abs(v[0] - grazing.belt_speed) < 1e-9)
        (6.304, True)
        >>> [round(float(grazing.smoothed(width)), 3) for width in (1e-2, 1e-3)]
        [1.792, 1.831]
    """

    belt_speed: Float[Array, ""]
    period: Float[Array, ""]
    state: State
    touches: Bool[Array, ""]
    by_leaving: Float[Array, ""]
    by_arriving: Float[Array, ""]
    fall: Float[Array, ""]
    hold: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    mass: int = eqx.field(static=True)

    def smoothed(self, width: ScalarLike) -> Float[Array, ""]:
        """About where the fold of smoothed friction is, to O(width^(3/2)); NaN if none was found.

        v_d = V - (V_+ + V_-) / 4 eps ln(1 / eps) + O(eps), the summit of the layer in
        `boundaries/touch.py`; V itself for a saddle-node, which smoothing hardly moves.

        **Arguments:** `width` = eps of the mass that grazes.
        """
        slopes = self.by_leaving, self.by_arriving
        return self.belt_speed + shift(*slopes, self.fall, self.hold, width)


def nonsmooth_fold_belt_speed(chain: Chain, vibrating: Any = None) -> Float[Array, ""]:
    """The greatest belt speed at which the vibration of one mass survives, for true dry friction.

    The limit of `fold_belt_speed` as the width vanishes, found directly: the grazing-sliding fold
    or, where friction is flat at rest, the saddle-node of slip cycles of the head of this module.
    Mass `vibrating` vibrates, the others slide.

    **Arguments:** `chain`, whose own `belt_speed` and width have no part in it; `vibrating`, the
    index (from 0) of the mass, by default n // 2, oscillator 11 of 20.

    **Returns:** the dimensionless v_d, relative error about 1e-11; NaN where there is none or none
    is found: `find_grazing` says which kind it is, or why there is none.  Works under `jit`,
    `vmap`, `grad`, `jvp` and `jax.hessian`, in every number of the chain.

    **Raises:** `ValueError` for anything but a `Chain`, or a mass it does not have.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import nonsmooth_fold_belt_speed, paper_chain
    >>> round(float(nonsmooth_fold_belt_speed(paper_chain(n=1))), 9)
    1.836600972
    """
    return find_grazing(chain, vibrating).belt_speed


def find_grazing(chain: Chain, vibrating: Any = None) -> Grazing:
    """The fold of `nonsmooth_fold_belt_speed` with its cycle.

    Arguments, errors and transformations as there.  Cycles on which other masses reach the belt's
    speed are not looked for: `belt_speed` is NaN then.

    **Returns:** a `Grazing`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.boundaries import find_grazing
    >>> grazing = find_grazing(paper_chain(n=1))
    >>> bool(grazing.successful), round(float(grazing.smoothed(1e-3)), 4)
    (True, 1.8311)
    """
    mass = check_vibrating(chain, vibrating)
    return _find(chain, mass)


@eqx.filter_jit
def _find(chain: Chain, mass: int) -> Grazing:
    frozen = lax.stop_gradient(chain)
    alone = one_mass(frozen, mass)
    averaged = dry_summits(alone)
    dry = find_dry_fold(frozen, mass, averaged=averaged)
    q, w = dry.q, dry.w
    touch = Touch(frozen, dry.steps, mass)
    gap, slopes, highest = touch_slopes(touch, q, w)
    by_leaving, by_arriving = -solve(slopes[:, :-2], slopes[:, -2:])[-1]
    (_, v), period, speed = touch.unpack(q, w)
    fall = touch.fall(v)
    slides = jnp.all(highest <= (1.0 + _PASSES) * speed)
    touches = dry.ratio >= 1.0
    folds = dry.turns & (by_arriving < 0) & (fall > 0)
    at_speed = eqx.tree_at(lambda c: c.belt_speed, frozen, speed)
    folds = folds & can_be_cycle(at_speed, period, jnp.abs(v))
    exists = jnp.isfinite(speed) & slides & folds
    of = SearchResult
    result = of.where(slides | jnp.isnan(speed), of.no_touch, of.passed)
    result = of.where(dry.turns | jnp.isnan(speed), result, of.no_turn)
    expected, damped = jnp.isfinite(averaged[1][0]), alone.damping_ratio > 0
    result = without_fold(result, expected, damped, damping_outweighs(frozen))
    result = of.where(exists, of.successful, result)
    # z = (q but for the belt speed, w, v_d), of the fold's equations.
    z = jnp.concatenate([q[:-1], jnp.stack([w, speed])])
    slope = jnp.concatenate([slopes[:, :-3], jnp.sum(slopes[:, -2:], axis=1)[:, None]], axis=1)
    left, _, right = jnp.linalg.svd(jnp.where(exists, slope, jnp.eye(slope.shape[0])))
    held = Touch(chain, dry.steps, mass), (left[:, -1], right[-1]), touches
    z = if_found(exists, attach_derivative(_fold_equations, z, held))
    state, period, speed = held[0].unpack(jnp.append(z[:-2], z[-1]), z[-2])
    return Grazing(
        belt_speed=speed, period=period, state=state, touches=touches, by_leaving=by_leaving,
        by_arriving=by_arriving, fall=fall, hold=touch.hold,
        residual=jnp.max(jnp.abs(gap)), result=result, mass=mass,
    )  # fmt: skip


def _closure(u: Float[Array, " m"], speed: Any, touch: Touch) -> Float[Array, " m"]:
    """The equations of the slip cycle with the unknowns (q but for the belt speed, w)."""
    return touch_residual(jnp.append(u[:-1], speed), touch, u[-1], u[-1])


_SADDLE_NODE = fold_residual(_closure)


def _fold_equations(z: Float[Array, " m_plus_1"], held: Any) -> Float[Array, " m_plus_1"]:
    """The slip cycle closes, and touches the belt's speed or is a saddle-node."""
    touch, borders, touches = held
    r = _SADDLE_NODE(z, (touch, borders))
    return r.at[-1].set(jnp.where(touches, z[-2], r[-1]))
