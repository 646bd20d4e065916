"""The greatest belt speed at which a vibration can survive: the fold of cycles."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._final import final
from .._types import PerMass, State
from ..continuation.fold_points import fold_residual
from ..continuation.implicit import attach_derivative, if_found
from ..cycles.limit_cycle import can_be_cycle
from ..cycles.shooting import Shooting
from ..cycles.shooting import residual as closure
from ..model.chain import Chain, require_smoothed
from ..model.initial_states import check_vibrating
from ..result import Outcome, SearchResult
from .fold_search import Place, Search, search, unknowns
from .fold_start import Start, at_least_wide, first_guess, narrowed
from .grazing import find_grazing


@final
class Fold(Outcome):
    """A fold of cycles: the greatest belt speed of one branch of vibrations.

    - `belt_speed`: v_d, NaN if no fold was found.
    - `period` and `state`: of the cycle there, cut at the greatest velocity of mass `mass`.
    - `closeness`: s = max w / eps of that mass; a mass with s < 0 never reaches the belt's speed.
    - `residual`: the gap after a period over the amplitude of velocity.
    - `result`: a `SearchResult`: successful; no_fold, which is proved; or why the search failed,
      which says nothing about whether there is a fold.  `message` puts it into words.
    - `width`: of the friction with which the cycle was closed, that of the chain or a little more:
      see `fold_belt_speed`.
    - `evaluations`: shooting Jacobians it took.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle, paper_chain
        >>> from jaxchain.boundaries import find_fold
        >>> chain = paper_chain(1, width=1e-2)
        >>> fold = find_fold(chain)
        >>> round(float(fold.belt_speed), 6), bool(fold.successful)
        (1.792456, True)
        >>> there = chain.with_(belt_speed=fold.belt_speed - 1e-3)  # its cycle leads to others
        >>> bool(find_limit_cycle(there, fold.state, period=fold.period).residual < 1e-9)
        True
    """

    belt_speed: Float[Array, ""]
    period: Float[Array, ""]
    state: State
    closeness: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    width: PerMass
    evaluations: Int[Array, ""]
    mass: int = eqx.field(static=True)


def fold_belt_speed(chain: Any, vibrating: Any = None) -> Float[Array, ""]:
    """The greatest belt speed at which the vibration of one mass survives.

    For dry friction that of `nonsmooth_fold_belt_speed`; for smoothed friction, as follows.

    The saddle-node of cycles at which the stick-slip cycle of mass `vibrating` (the others slide,
    shaken by it) and the unstable slip cycle meet: at a greater speed every vibration dies out.

    **Arguments:** `chain`, whose own `belt_speed` has no part in it; `vibrating`, the index (from
    0) of the mass, by default n // 2, oscillator 11 of 20.

    **Returns:** the dimensionless v_d, relative error about 1e-9; NaN where there is no fold or
    none is found: `find_fold` tells which, and why.  Below a width of 3e-8 of the speed of the
    problem (v_d, or twice that over which friction weakens) the fold is searched for at that width
    and moved on by the asymptotics of `Grazing.smoothed`, which err by less than 1e-9 of that
    speed there; below 3e-7, and by less than 3e-8, where friction weakens so fast that the slip
    cycle multiplies disturbances by more than 30.  Of its derivatives only that in the width knows
    of the move, so that the others err by about 1e-6.  Works under `jit`, `vmap` (no lane harms
    another), `grad` and `jvp`, in every number of the chain, once: as v_d is stationary along the
    branch, its first derivatives are those of a cycle with the closeness max w / eps held.

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
    return fold_and_result(chain, check_vibrating(chain, vibrating))[0]


def fold_and_result(chain: Chain, mass: int) -> tuple[Float[Array, ""], SearchResult]:
    """(`fold_belt_speed`, how the search for it ended)."""
    if chain.dry:
        fold = find_grazing(chain, mass)
        return fold.belt_speed, fold.result
    speed, _, result = smoothed_fold(chain, mass)
    return speed, result


def smoothed_fold(
    chain: Chain, mass: int
) -> tuple[Float[Array, ""], Float[Array, ""], SearchResult]:
    """(`fold_belt_speed`, s = max w / eps there, how the search ended) with a width."""
    start, found = _find(lax.stop_gradient(chain), mass)
    speed = _belt_speed(chain, mass, start, found)
    return speed, jnp.sinh(found.here.z), _result(start, found)


def _result(start: Start, found: Search) -> SearchResult:
    return SearchResult.where(found.found, SearchResult.successful, start.result)


@eqx.filter_jit
def _belt_speed(chain: Chain, mass: int, start: Start, found: Search) -> Array:
    """v_d with its derivatives."""
    held = _held(chain, start)
    q = attach_derivative(
        held_residual, found.here.q, (held, lax.stop_gradient(found.here.z)), once=_ONCE
    )
    return if_found(found.found, q[held.place] + _gained(chain, mass, start))


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

    Arguments, errors and transformations as there, but for smoothed friction alone (`find_grazing`
    is for dry friction); derivatives of any order, which cost more, of
    the whole orbit: they come from the bordered system [closure; singularity] = 0.

    **Returns:** a `Fold`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.boundaries import find_fold
    >>> fold = find_fold(paper_chain(n=1, width=1e-2))
    >>> bool(fold.successful), round(float(fold.period), 4), round(float(fold.closeness), 3)
    (True, 6.3028, -2.142)
    """
    mass = check_vibrating(chain, vibrating)
    require_smoothed(chain, "use `find_grazing`, or ")
    return _fold(chain, mass, *_find(lax.stop_gradient(chain), mass))


@eqx.filter_jit
def _fold(chain: Chain, mass: int, start: Start, found: Search) -> Fold:
    """The fold with the derivatives of its cycle."""
    held = _held(chain, start)
    u, speed = unknowns(start.shooting, found.here)
    borders = _borders(start.shooting, found)
    both = attach_derivative(_FOLD_RESIDUAL, jnp.append(u, speed), (held, borders))
    _, state, period = held.unpack(both[:-1], both[-1])
    return Fold(
        belt_speed=if_found(found.found, both[-1] + _gained(chain, mass, start)),
        period=period,
        state=state,
        closeness=jnp.sinh(both[held.place]),
        residual=found.residual,
        result=_result(start, found),
        width=held.field.width,  # pyright: ignore[reportAttributeAccessIssue]
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
def _find(chain: Chain, mass: int) -> tuple[Start, Search]:
    """The start, and the fold; nothing in here is to be differentiated.

    A program by itself, which values, derivatives and the whole `Fold` share.
    """
    start = first_guess(chain, mass)
    found = search(start.shooting, start.place, start.loose, start.hopeful, start.tame)
    field, (_, v), period = start.shooting.unpack(*unknowns(start.shooting, found.here))
    possible = can_be_cycle(field, period, jnp.abs(v))
    return start, eqx.tree_at(lambda s: s.found, found, found.found & possible)


def _held(chain: Chain, start: Start) -> Shooting:
    """The equations with the numbers of `chain`."""
    wide = at_least_wide(chain, lax.stop_gradient(start.width))
    return eqx.tree_at(lambda s: s.field, start.shooting, wide)


def _gained(chain: Chain, mass: int, start: Start) -> Array:
    """What the belt speed still gains from the width of the search to that of the chain."""
    width = chain.width
    return narrowed(start, width[mass] if width.ndim else width)
