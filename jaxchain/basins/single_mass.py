"""The basin of steady sliding of one mass, exactly: the inside of its unstable cycle.

Between Hopf and fold a mass may slide steadily or vibrate.  Around steady sliding (x_s, 0) lies an
unstable cycle U on which it slides back and forth behind the belt, v < v_d throughout.  The starts
from which it comes to slide steadily are the inside of U:

- Nothing crosses U, in either direction.  On U and near it friction is a function of v of bounded
  slope, so that through each of its points there is one motion only, forward and backward in
  time, and this is U itself.  Dry friction makes motions meet, in Filippov's sense, but only where
  they stick, v = v_d, and there U is not.  So whatever starts outside stays outside: also what
  sticks and is let go, at x with k x = p mu_st - 2 xi v_d, from where it goes round U.
- What starts inside stays inside, where the field is that of sliding, with one state of rest.  If
  no other cycle lies inside, all of it comes to rest there, by Poincare and Bendixson: it stays
  bounded, and there is nothing else that it could approach.  Of several cycles around one another
  U is therefore the innermost unstable one: the first fixed point of the return map that moves
  away, see `basins/innermost.py`.

Where there is no cycle, above the fold, everything comes to slide: a motion that sticks is let go,
and the turn that it begins there comes back slower, inside of itself.  Cycles that overtake the
belt are not looked for.  By Green's theorem a cycle gains the integral of dF/dv over its inside.
If the turn that the belt lets go loses, one around it, which is as wide as L at v = v_d, would
have to make up for it: beyond that turn friction falls by 2 p mu_st L at the belt's speed, and
weakening gives no more than p L times all the falls of mu, as the circles show that such motions
nearly are.  Below the Hopf speed only steady sliding itself comes to slide.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._checks import check_kind
from .._final import final
from .._types import State
from ..continuation.implicit import attach_derivative
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..result import Outcome, SearchResult
from .innermost import find_innermost
from .regions import Box
from .turns import Mass, turn

# What may be left of the return, compared with the greatest velocity.
_CLOSED = 1e-9
_ONCE = (
    "Exact shares and blows of one mass can be differentiated once only: what they are made of "
    "knows its first derivatives."
)
# A turn about which nothing is asked: a share of the velocity at which a mass sticks.
_ANY = 0.5


@final
class SlidingBasin(Outcome):
    """From where one mass comes to slide steadily.

    - `share`: of the box; `area`: of what the box and the basin have in common, in units of
      x0^2 omega_n.
    - `state`: (x, v) of the unstable cycle where its velocity along the belt is greatest, each of
      shape (1,), and `period`; NaN where there is no cycle, because all motions come to slide
      (`share` 1) or none (`share` 0).
      `find_limit_cycle(chain, (basin.state, basin.period), vibrating=0)` tells more of it; near
      the fold it needs such a guess.
    - `up`, `down`: the kicks of `blow_of_one_mass`.
    - `gap`: by how much the greatest velocity differs after a period, relative; 0 without a cycle.
    - `result`: successful if the share is known, and else why it is NaN.

    All but `gap` and `result` have derivatives.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.basins import sliding_basin
        >>> basin = sliding_basin(paper_chain(1, belt_speed=1.5, width=None))
        >>> round(float(basin.share), 6), round(float(basin.area / 8.0), 6)  # of a box of 4 by 2
        (0.307126, 0.307126)
        >>> round(float(basin.up), 6), basin.state[1].shape  # a kick that leads out; the cycle
        (1.239855, (1,))
    """

    share: Float[Array, ""]
    area: Float[Array, ""]
    state: State
    period: Float[Array, ""]
    up: Float[Array, ""]
    down: Float[Array, ""]
    gap: Float[Array, ""]
    result: SearchResult


def sliding_share(chain: Chain, box: Box | None = None) -> Float[Array, ""]:
    """The share of a box from which one mass comes to slide steadily, without sampling.

    share = area of the box inside the unstable cycle / area of the box, see the head of this
    module; 1 where every motion comes to slide, as above the fold, and 0 where steady sliding is
    unstable, as below the Hopf speed.

    **Arguments:** `chain` of one mass, dry or smoothed; `box`, a `Box` of displacements and
    velocities, by default -2 ... 2 and 0 ... 2.

    **Returns:** a scalar, right to 1e-10 about; NaN where it is not known, for which
    `sliding_basin` has the reason.  Works under `jit`, `vmap`, `grad`, `jvp` and `jacfwd`, once,
    in every number of the chain and in the edges of the box.

    **Raises:** `ValueError` for a chain of several masses, or what is no `Box`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.basins import sliding_share
    >>> chain = paper_chain(1, belt_speed=1.5, width=None)
    >>> round(float(sliding_share(chain)), 9)
    0.307126138
    >>> slope = jax.grad(lambda speed: sliding_share(chain.with_(belt_speed=speed)))(1.5)
    >>> round(float(slope), 6)
    0.975818
    """
    return sliding_basin(chain, box).share


def sliding_basin(chain: Chain, box: Box | None = None) -> SlidingBasin:
    """The share of `sliding_share`, with the unstable cycle, and with the reason if it is NaN.

    Arguments, errors and transformations as there.

    **How:** the first fixed point of the return map of the greatest velocity that moves away, on
    a grid of some 60 velocities up to the belt's, closer looks at the first that rises and at the
    highest summit before it; then one turn of the cycle in steps of order 8,
    whose area within the box is integrated from step to step (`basins/enclosed_area.py`).

    **Result:** `at_hopf` so near a Hopf point that the cycle is smaller than the grid begins;
    `creeps` for a belt that rests, or is slower than twice the speed of greatest friction;
    `undamped` where no cycle is found, but no damping ends vibration, either;
    `max_steps_reached` where a turn does not end; `no_step_helps` where the cycle does not close
    to 1e-9, as one that multiplies disturbances by more than some 1e5.

    **Returns:** a `SlidingBasin`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.basins import sliding_basin
    >>> basin = sliding_basin(paper_chain(1, belt_speed=1.5, width=None))
    >>> round(float(basin.area), 6), round(float(basin.period), 6)
    (2.457009, 6.295335)
    >>> above = sliding_basin(paper_chain(1, belt_speed=1.9, width=None))
    >>> float(above.share), bool(above.successful)
    (1.0, True)
    """
    _check_single(chain)
    box = Box() if box is None else box
    wanted = "a `Box` of displacements and velocities"
    check_kind("box", box, Box, wanted, "`Box((-2, 2), (0, 2))` is usual.")
    box.dimension(chain)  # raises for a mass that is not there
    return _basin(chain, box)


def blow_of_one_mass(chain: Chain) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The gentlest blows from steady sliding that make one mass vibrate: (upward, downward).

    A blow changes the velocity at once, from 0 to +u or to -w at the displacement x_s of steady
    sliding.  The mass vibrates if that is outside of the unstable cycle: u and w are its
    velocities where it passes x_s.  u is meant with the axis of v: against the belt's motion where
    the belt speed is negative.

    **Arguments:** `chain` of one mass, dry or smoothed.

    **Returns:** (u, w), scalars, positive, in units of x0 omega_n; the energy of a blow is
    u^2 / 2.  0 where steady sliding is unstable; infinite where all motions come to slide; NaN
    where nothing is known, for which `sliding_basin` has the reason.  Errors and transformations
    as those of `sliding_share`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.basins import blow_of_one_mass
    >>> up, down = blow_of_one_mass(paper_chain(1, belt_speed=1.5, width=None))
    >>> round(float(up), 6), round(float(down), 6)
    (1.239855, 1.247852)
    """
    basin = sliding_basin(chain)
    return basin.up, basin.down


@eqx.filter_jit
def _basin(chain: Chain, box: Box) -> SlidingBasin:
    along = jnp.sign(lax.stop_gradient(chain.belt_speed))
    mass, edges = _ahead(chain, box)
    frozen = lax.stop_gradient(mass)
    innermost = find_innermost(frozen)
    exists = jnp.isfinite(innermost.fastest)
    # Without a cycle the equations are solved by numbers that nobody asks for, but are finite.
    known = jnp.isfinite(frozen.highest) & (frozen.highest > 0)
    safe = jax.tree.map(lambda of: jnp.where(known, of, 1.0), (mass, edges))
    top = jnp.where(exists, innermost.fastest, _ANY * lax.stop_gradient(safe[0].highest))
    once = turn(*lax.stop_gradient((safe[0], top, safe[1])))
    found = jnp.stack([top, once.period, once.area, once.up, once.down])
    gap = jnp.where(exists, jnp.abs(once.fastest / top - 1.0), 0.0)
    closed = once.ended & (gap <= _CLOSED) & jnp.all(jnp.isfinite(found))
    found = attach_derivative(_left_of_turn, found, safe, once=_ONCE)
    result = SearchResult.where(exists & ~closed, SearchResult.no_step_helps, innermost.result)
    cycle, plain = exists & closed, jnp.isfinite(innermost.share_of_plane)
    rather = jnp.where(plain, innermost.share_of_plane, 0.0)

    def where_it_is(of_cycle: Any, otherwise: Any = jnp.nan) -> Array:
        return jnp.where(cycle, of_cycle, jnp.where(plain, otherwise, jnp.nan))

    (a, b), (c, d) = edges
    whole = (b - a) * (d - c)
    area = where_it_is(found[2], rather * whole)
    far = jnp.where(rather == 1.0, jnp.inf, 0.0)
    up, down = where_it_is(found[3], far), where_it_is(-found[4], far)
    x = mass.force(found[0]) / mass.stiffness
    return SlidingBasin(
        share=area / whole,
        area=area,
        state=(where_it_is(along * x)[None], where_it_is(along * found[0])[None]),
        period=where_it_is(found[1]),
        up=jnp.where(along < 0, down, up),
        down=jnp.where(along < 0, up, down),
        gap=gap,
        result=result,
    )


def _ahead(chain: Chain, box: Box) -> tuple[Mass, tuple[Array, Array]]:
    """The chain and the edges of the box, or their mirror image if the belt runs backward."""
    back = chain.belt_speed < 0
    edges = tuple(jnp.where(back, -pair[::-1], pair) for pair in (box.displacement, box.velocity))
    return Mass.of(chain), edges  # pyright: ignore[reportReturnType]


def _left_of_turn(
    found: Float[Array, "5"], given: tuple[Mass, tuple[Array, Array]]
) -> Float[Array, "5"]:
    """What is left of the return, and of the other numbers of the turn."""
    mass, edges = given
    once = turn(mass, found[0], edges)
    numbers = jnp.stack([once.period, once.area, once.up, once.down])
    return jnp.append(numbers - found[1:], once.fastest / found[0] - 1.0)


def _check_single(chain: Any) -> None:
    if as_chain(chain).n != 1:
        raise ValueError(
            f"Argument `chain` must have one mass, but has {chain.n}: for several masses sample "
            "the box."
        )
