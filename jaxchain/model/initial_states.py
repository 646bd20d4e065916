"""Initial states: eq. (8) and eq. (10) of the paper, excited blocks, and masses on the belt."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int

from .._checks import (
    check_finite,
    check_flag,
    check_one_of,
    check_whole,
    is_traced,
    shown,
    to_float,
)
from .._types import Given, State
from .arguments import as_chain, as_mass
from .chain import Chain, steady_sliding

BLOCKS = ("forward", "centred")


def reference_site(n: int) -> int:
    """Index (from 0) of the mass that every excited block contains: oscillator 11 of 20."""
    return n // 2


def check_mass(chain: Any, mass: Any, name: str = "mass") -> int:
    """The index of the vibrating mass (None: oscillator 11 of 20), or `ValueError`."""
    n = as_chain(chain).n
    return as_mass(n, mass, reference_site(n), name)


def excited_block(
    n: int, excited: int | Int[Array, ""], block: str = "forward"
) -> Bool[Array, " n"]:
    """The masses of a contiguous block of `excited` masses, as booleans of shape (n,).

    The block always contains oscillator 11 of 20 (index `n // 2`).  The paper does not say which
    block it is: "forward" is 11 ... 10 + k, going round the ring past N; "centred" is 11 - floor(k
    / 2) ... 10 + ceil(k / 2).
    """
    check_one_of("block", block, BLOCKS)
    start = reference_site(n) - (0 if block == "forward" else excited // 2)
    # NumPy for concrete numbers, because JAX compiles each small operation separately.
    index = jnp.arange(n) if is_traced(excited) else np.arange(n)
    return jnp.asarray((index - start) % n < excited, dtype=bool)


def alternating(n: int) -> Int[Array, " n"]:
    """(-1)^n for oscillators counted from 1: -1, 1, -1, ..."""
    return jnp.where(jnp.arange(n) % 2 == 0, -1, 1)


def excited_state(
    chain: Chain,
    excited: ArrayLike,
    *,
    amplitude: ArrayLike = 2.0,
    velocity: ArrayLike = 0.0,
    block: str = "forward",
    pattern: str = "alternating",
    mirrored: bool = False,
) -> State:
    """Steady sliding with some masses displaced; by default eq. (8) of the paper.

    x_n = x^s_n                          for a mass that is not excited,
    x_n = amplitude (-1)^n + x^s_n       for one that is (n counted from 1),   v_n = velocity.

    **Arguments:**

    - `excited`: the number of masses in a contiguous block (see `excited_block`; may be traced),
      or a boolean array of shape (n,).
    - `amplitude`, `velocity`: dimensionless, one number or shape (n,).
    - `block`: "forward", from mass n // 2 on (the paper's 11th of 20), or "centred" around it.
    - `pattern`: "alternating" signs as in the paper, or "in-phase".
    - `mirrored`: use -x^s instead of x^s.  By eq. (2) of the paper F(+v_d) = -F(-v_d), and eq.
      (10) has F(+v_d) where eq. (8) has F(-v_d).

    **Returns:** (x, v), both of shape (n,).

    **Raises:** `ValueError` for a count that is not an integer in 0 ... n, and for NaN.

    !!! example

        >>> import jax, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import excited_state, paper_chain
        >>> chain = paper_chain(4, belt_speed=1.5, width=1e-2)
        >>> x, v = excited_state(chain, 2, amplitude=1.0, pattern="in-phase")
        >>> print(x.round(3))
        [0.525 0.525 1.525 1.525]
        >>> x, v = excited_state(chain, np.array([True, False, False, True]), velocity=0.5)
        >>> print(x.round(3), v)
        [-1.475  0.525  0.525  2.525] [0.5 0.5 0.5 0.5]
    """
    as_chain(chain, belts=True)
    check_one_of("pattern", pattern, ("alternating", "in-phase"))
    check_one_of("block", block, BLOCKS)
    check_flag("mirrored", mirrored)
    check_finite("amplitude", amplitude, "2 is that of eq. (8).")
    check_finite("velocity", velocity, "eq. (8) has 0, eq. (10) 0.56.")
    amplitude, velocity = to_float(amplitude), to_float(velocity)
    for name, value in (("amplitude", amplitude), ("velocity", velocity)):
        if value.shape not in ((), (chain.n,)):
            raise ValueError(
                f"Argument `{name}` must be one number or one per mass, of shape ({chain.n},), "
                f"but has shape {value.shape}."
            )
    mask = _mask(chain.n, excited, block)
    return _pull_away(chain, mask, amplitude, velocity, pattern, mirrored)


def _mask(n: int, excited: Any, block: str) -> Array:
    """The excited masses, as booleans of shape (n,)."""
    given: Any = excited if is_traced(excited) else np.asarray(excited)
    if given.ndim == 1 and given.shape == (n,) and given.dtype == bool:
        return jnp.asarray(given)
    if given.ndim == 1:
        raise ValueError(
            f"Argument `excited` must be a count or have shape ({n},), but has shape "
            f"{given.shape} and holds {given.dtype}; a shape takes booleans."
        )
    if not is_traced(given):
        real = given.ndim == 0 and given.dtype.kind in "iuf"
        if not (real and 0 <= given <= n):
            raise ValueError(f"Argument `excited` must lie in 0 ... {n}, but is {shown(excited)}.")
        if given != np.round(given):
            raise ValueError(
                f"Argument `excited` must be a whole number, but is {shown(excited)}."
            )
        given = int(given)
    return excited_block(n, given, block)


@eqx.filter_jit  # one small program instead of a dozen
def _pull_away(
    chain: Chain, mask: Array, amplitude: Array, velocity: Array, pattern: str, mirrored: bool
) -> State:
    x, v = steady_sliding(chain)
    sign = alternating(chain.n) if pattern == "alternating" else jnp.ones(chain.n, dtype=int)
    offset = -x if mirrored else x
    return offset + jnp.where(mask, amplitude * sign, 0.0), v + velocity


def equation_8(chain: Chain, excited: ArrayLike, block: str = "forward") -> State:
    """Initial state of the paper's eq. (8): alternating displacements of 2, velocities 0.

    **Arguments**, results and errors are those of `excited_state`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain
        >>> x, v = equation_8(paper_chain(4, belt_speed=1.5, width=1e-2), 2)
        >>> print(x.round(3), v)  # steady sliding, and +-2 of the middle two
        [ 0.525  0.525 -1.475  2.525] [0. 0. 0. 0.]
    """
    return excited_state(chain, excited, block=block)


def equation_10(
    chain: Chain,
    excited: ArrayLike,
    block: str = "forward",
    reading: str = "as_equation_8",
) -> State:
    """Initial state of the paper's eq. (10): alternating displacements of 2, all velocities 0.56.

    **Arguments:** `chain`, `excited`, `block` as for `excited_state`.  `reading` of F(+v_d):
    "as_printed" is literal, F(+v_d) = -F(-v_d), and the masses start on the wrong side of steady
    sliding; "as_equation_8" reads it as F(-v_d).

    **Returns:** (x, v), both of shape (n,).

    **Raises:** `ValueError` as `excited_state`, and for another `reading`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_10, paper_chain
        >>> x, v = equation_10(paper_chain(4, belt_speed=1.5, width=1e-2), 2)
        >>> print(x.round(3), v)
        [ 0.525  0.525 -1.475  2.525] [0.56 0.56 0.56 0.56]
    """
    as_chain(chain, belts=True)
    check_one_of("reading", reading, ("as_printed", "as_equation_8"))
    return excited_state(
        chain, excited, velocity=0.56, block=block, mirrored=reading == "as_printed"
    )


def on_the_belt(chain: Chain, mass: Given[int | None] = None) -> State:
    """(x, v) with one mass carried by the belt past x = 0, and the others sliding.

    With one mass and dry friction it lies on the stick-slip cycle.

    **Arguments:** `mass`, the index (from 0) of that mass, by default n // 2.

    **Returns:** (x, v), both of shape (n,).

    **Raises:** `ValueError` for a mass that the chain does not have.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.model import on_the_belt
        >>> x, v = on_the_belt(paper_chain(3, belt_speed=1.5, width=None))
        >>> print(x.round(3), v)
        [0.525 0.    0.525] [0.  1.5 0. ]
    """
    n = as_chain(chain, belts=True).n
    return _carried(chain, as_mass(n, mass, reference_site(n)))


@eqx.filter_jit
def _carried(chain: Chain, mass: int) -> State:
    x, v = steady_sliding(chain)
    return x.at[mass].set(0.0), v.at[mass].set(jnp.broadcast_to(chain.belt_speed, v.shape)[mass])


def release_state(chain: Chain, mass: int) -> State:
    """Steady sliding, except that the belt carries mass `mass`, half way to its release.

    **Arguments:** `mass`, its index from 0.

    **Returns:** (x, v), both of shape (n,).

    **Raises:** `ValueError` for a mass that the chain does not have.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import StickTime, paper_chain, simulate
        >>> from jaxchain.model.initial_states import release_state
        >>> chain = paper_chain(3, belt_speed=1.5, width=None)
        >>> start = release_state(chain, 1)
        >>> run = simulate(chain, start, 1.0, observe=StickTime())
        >>> print(run.observed.round(3))  # so long until it is let go
        [0.    0.236 0.   ]
    """
    check_whole("mass", mass, 0, as_chain(chain, belts=True).n - 1, "it is the index of a mass.")
    return _released(chain, mass)


@eqx.filter_jit
def _released(chain: Chain, mass: int) -> State:
    x, v = steady_sliding(chain)
    unit = jnp.zeros(chain.n).at[mass].set(1.0)
    stiffness = -chain.restoring_force(unit)[mass]
    hold = jnp.broadcast_to(chain.static_limit(), (chain.n,))[mass]
    belt = jnp.broadcast_to(chain.belt_speed, v.shape)[mass]
    reach = 0.5 * jnp.sign(belt) * hold / stiffness
    return x + unit * (reach - x[mass]), v.at[mass].set(belt)
