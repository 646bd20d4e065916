"""The Hopf boundary by gradient descent with optax."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_positive, require_64_bits, require_x64
from ..continuation.gradient_descent import descend
from ..model.chain import Chain
from ..model.sliding import growth_rate


class HopfDescent(eqx.Module):
    """The Hopf speed by gradient descent, and the way there.

    - `belt_speed`, and `growth_rate` there, which is zero at the boundary.
    - `steps`: updates made.  `converged`: whether |growth rate| <= the tolerance.
    - `speeds`, `growth_rates`: of every iterate, from the start on; NaN after entry `steps`.
    """

    belt_speed: Float[Array, ""]
    growth_rate: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    speeds: Float[Array, " entries"]
    growth_rates: Float[Array, " entries"]


def hopf_by_descent(
    chain: Chain,
    start: Any = None,
    optimiser: optax.GradientTransformation | None = None,
    steps: Any = 1000,
    tolerance: Any = 1e-10,
) -> HopfDescent:
    """A Hopf speed by gradient descent on g(v_d)^2, g the growth rate of steady sliding.

    When to take which: `hopf_belt_speed`, a bracket and Newton's method, needs fewer than ten
    steps and finds the uppermost boundary from nowhere.  The descent, of some 300 steps of Adam,
    ends at the boundary that its start leads to; it is the one to extend where the growth rate is
    part of a greater optimisation.  It has no derivatives of its own: take those of
    `hopf_belt_speed`.

    **Arguments:** `chain`; `start`, a belt speed > 0 (default: the chain's own,
    whichever way it runs); `optimiser`, any
    optax transformation (default `optax.adam(0.1)`); `steps` at most, until |g| <= `tolerance`.

    **Raises:** `ValueError` for a start, a number of steps or a tolerance that is not positive.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import hopf_by_descent, paper_chain
    >>> found = hopf_by_descent(paper_chain(n=1))
    >>> bool(found.converged), round(float(found.belt_speed), 6)
    (True, 1.151293)
    """
    require_x64()
    require_64_bits("chain", chain)
    start = jnp.abs(chain.belt_speed) if start is None else start
    check_positive("start", start, "it is a belt speed, such as 1.5.")
    check_positive("tolerance", tolerance, "it is a growth rate, such as 1e-10.")
    optimiser = _ADAM if optimiser is None else optimiser
    begin, least = (jnp.asarray(value, float) for value in (start, tolerance))
    return _descend(chain, begin, optimiser, steps, least)


# An optimiser is part of the compiled program, and compared by identity.
_ADAM = optax.adam(0.1)


@eqx.filter_jit
def _descend(
    chain: Chain, start: Any, optimiser: optax.GradientTransformation, steps: Any, tolerance: Array
) -> HopfDescent:
    found = descend(
        lambda speed: growth_rate(chain, speed) ** 2, start, optimiser, steps, tolerance**2
    )
    rates = jax.vmap(lambda speed: growth_rate(chain, speed))(found.path)
    rate = growth_rate(chain, found.solution)
    return HopfDescent(found.solution, rate, found.steps, found.converged, found.path, rates)
