"""The greatest belt speed at which a vibration can survive: the fold of cycles."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ._types import State
from .augmented import fold_residual
from .averaging import cycle_speed, fold_guess, greatest_speed, one_mass, speed_scale
from .chain import Chain
from .choice import fit_linear_solve
from .fold_search import (
    FOLD_RTOL,
    Place,
    Search,
    as_place,
    search,
    unknowns,
)
from .grazing import find_touch, touch_slopes
from .implicit import attach_derivative
from .layer import layer
from .rosenbrock import Rodas5P
from .shooting import Shooting
from .shooting import residual as closure
from .states import check_vibrating

_LOOSE, _LOOSE_PER_WIDTH = 1e-6, 1e-3
_POLISH, _THIN, _THICK = 1e-3, 1e-2, 0.1


class Fold(eqx.Module):
    """A fold of cycles: the greatest belt speed of one branch of vibrations.

    - `belt_speed`: v_d, NaN if no fold was found.
    - `period` and `state`: of the cycle there, cut at the greatest velocity of mass `mass`.
    - `closeness`: s = max w / eps of that mass; a mass with s < 0 never reaches the belt's speed.
    - `residual`: the gap after a period over the amplitude of velocity.
    - `found`: whether it is a fold of a closed cycle.
    - `expected`: whether averaging has a fold.  Where this is false there is none, and steady
      sliding is lost supercritically or not at all; where it is true and `found` is not, the
      search failed.
    - `evaluations`: shooting Jacobians it took.
    """

    belt_speed: Float[Array, ""]
    period: Float[Array, ""]
    state: State
    closeness: Float[Array, ""]
    residual: Float[Array, ""]
    found: Bool[Array, ""]
    expected: Bool[Array, ""]
    evaluations: Int[Array, ""]
    mass: int = eqx.field(static=True)


def fold_belt_speed(chain: Any, vibrating: Any = None) -> Float[Array, ""]:
    """The greatest belt speed at which the vibration of one mass survives, for smoothed friction.

    The saddle-node of cycles at which the stick-slip cycle of mass `vibrating` (the others slide,
    shaken by it) and the unstable slip cycle meet: at a greater speed every vibration dies out.

    **Arguments:** `chain`, whose own `belt_speed` has no part in it; `vibrating`, the index (from
    0) of the mass, by default n // 2, oscillator 11 of 20.

    **Returns:** the dimensionless v_d, relative error about 1e-9; NaN where there is no fold or
    none is found: `find_fold` tells.  Works under `jit`, `vmap` (no lane harms another),
    `grad` and `jvp`, in every number of the chain, once: as v_d is stationary along the branch,
    its first derivatives are those of a cycle with the closeness max w / eps held.

    **Raises:** `ValueError` for anything but a `Chain`, or a mass it does not have.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import fold_belt_speed, paper_chain
        >>> chain = paper_chain(n=1, width=1e-2)
        >>> round(float(fold_belt_speed(chain)), 6)
        1.792456
        >>> slope = jax.grad(lambda xi: fold_belt_speed(chain.with_(damping_ratio=xi)))(0.05)
        >>> round(float(slope), 3)  # more damping, less vibration
        -26.456
    """
    mass = check_vibrating(chain, vibrating)
    shooting, found, _ = _find(lax.stop_gradient(chain), mass)
    held = eqx.tree_at(lambda s: s.field, shooting, chain)
    q = attach_derivative(
        held_residual, found.here.q, (held, lax.stop_gradient(found.here.z)), once=_ONCE
    )
    return jnp.where(found.found, q[shooting.place], jnp.nan)


_ONCE = (
    "`fold_belt_speed` can be differentiated once only. For second derivatives take "
    "`find_fold(chain).belt_speed`."
)


def held_residual(q: Float[Array, " m"], held: tuple[Shooting, Array]) -> Float[Array, " m"]:
    """The equations of the cycle whose mass j has max w / eps = sinh z."""
    shooting, z = held
    return shooting.residual(*unknowns(shooting, Place(q, z)))


def find_fold(chain: Any, vibrating: Any = None) -> Fold:
    """The fold of `fold_belt_speed` with its cycle, all of it differentiable.

    Arguments, errors and transformations as there; derivatives of any order, which cost more, of
    the whole orbit: they come from the bordered system [closure; singularity] = 0.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import find_fold, paper_chain
    >>> fold = find_fold(paper_chain(n=1, width=1e-2))
    >>> bool(fold.found), round(float(fold.period), 4), round(float(fold.closeness), 3)
    (True, 6.3028, -2.142)
    """
    mass = check_vibrating(chain, vibrating)
    shooting, found, expected = _find(lax.stop_gradient(chain), mass)
    u, speed = unknowns(shooting, found.here)
    borders = _borders(shooting, found)
    held = eqx.tree_at(lambda s: s.field, shooting, chain)
    both = attach_derivative(_FOLD_RESIDUAL, jnp.append(u, speed), (held, borders))
    _, state, period = held.unpack(both[:-1], both[-1])
    return Fold(
        belt_speed=jnp.where(found.found, both[-1], jnp.nan),
        period=period,
        state=state,
        closeness=jnp.sinh(both[shooting.place]),
        residual=found.residual,
        found=found.found,
        expected=expected,
        evaluations=found.count,
        mass=mass,
    )


_FOLD_RESIDUAL = fold_residual(closure)


def _borders(shooting: Shooting, found: Search) -> tuple[Array, Array]:
    """(left, right) null vectors of dR/du at the fold."""
    slope = found.jacobian[:, :-1].at[:, shooting.place].set(found.jacobian[:, -1])
    left, _, right = jnp.linalg.svd(jnp.where(found.found, slope, jnp.eye(slope.shape[0])))
    return left[:, -1], right[-1]


@eqx.filter_jit
def _find(chain: Chain, mass: int) -> tuple[Shooting, Search, Bool[Array, ""]]:
    """The fold, and whether there should be one; nothing in here is to be differentiated."""
    shooting, place, expected, thin = first_guess(chain, mass)
    loose = jnp.where(thin, FOLD_RTOL, loose_rtol(chain))
    return shooting, search(shooting, place, loose, expected), expected


def loose_rtol(chain: Chain) -> Array:
    """The tolerance of integration that does on the way to a fold."""
    return jnp.clip(_LOOSE_PER_WIDTH * jnp.min(chain.friction.width), 1e-9, _LOOSE)


def first_guess(chain: Chain, mass: int) -> tuple[Shooting, Place, Bool[Array, ""]]:
    """(equations, a place near the fold, whether there should be a fold), from dry friction."""
    alone = one_mass(chain, mass)
    width = alone.friction.width
    averaged, averaged_s, exists = fold_guess(alone)
    # Averaging errs by the same factor for smoothed as for dry friction, or nearly so.
    dry = eqx.tree_at(lambda c: c.friction.width, alone, jnp.asarray(1e-9))
    dry_averaged = cycle_speed(dry, 1.0, greatest_speed(dry))
    scale = speed_scale(alone, dry_averaged)
    touch, q, _ = find_touch(chain, mass, exact=width < _POLISH * scale)
    slopes, _ = touch_slopes(touch, q)
    (_, v), _, touch_speed = touch.unpack(q)
    here = layer(*slopes[-1], touch.fall(v), touch.hold, width)
    moved = q + slopes @ jnp.stack([here.leaving, here.arriving])
    # The layer is thin, or else averaging knows better where it is, and what belt speed it has.
    thin, thick = width < _THIN * scale, width > _THICK * scale
    moved = jnp.where(thick, q, moved)
    speed = jnp.where(thin, moved[-1], averaged * touch_speed / dry_averaged)
    s = jnp.where(thick | ~jnp.isfinite(here.closeness), averaged_s, here.closeness)
    (x, v), period, _ = touch.unpack(moved)
    v = v.at[mass].set(speed + width * s)
    shooting = Shooting(
        field=chain, rtol=FOLD_RTOL, solver=fit_linear_solve(Rodas5P(), chain, FOLD_RTOL),
        mass=mass, images=tuple(range(chain.n)), parameter="belt_speed",
    )  # fmt: skip
    place = as_place(shooting, shooting.pack((x, v), period, speed), speed)
    return shooting, place, exists & jnp.all(jnp.isfinite(q)), thin
