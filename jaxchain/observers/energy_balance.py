"""Energy balance along a run: work of the belt, losses to friction and damping, stored energy.

v_d sum p_n F_n = sum p_n |F_n w_n| + sum 2 xi_n v_n^2 + d/dt 1/2 (v . v + x . K x)
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import ScalarLike, State
from ..model.chain import Chain
from ..model.model import AbstractModel
from .base import AbstractObserver, Step, Variable, all_finite


class Divergence(AbstractObserver):
    """Integral of tr J along a run, by Gauss's rule of five points in every step.

    **Value:** a number, without derivatives: the logarithm of the factor by which a small volume
    of states around the run grows.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate
        >>> from jaxchain.observers import Divergence
        >>> chain = paper_chain(3, belt_speed=9.0, width=1e-2)  # hardly more than 3 damped masses
        >>> run = simulate(chain, equation_8(chain, 0), 10.0, observe=Divergence())
        >>> round(float(run.observed), 3)  # -3 * 2 xi * 10
        -3.0
    """

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del field, t0, t1, y0
        return jnp.zeros(())

    def update(self, accumulator: Any, step: Step) -> Any:
        step = step.frozen()
        return lax.stop_gradient(accumulator + step.integral(step.field.divergence))

    def finite(self, accumulator: Any) -> Bool[Array, ""]:
        return all_finite(accumulator)

    def read(self, accumulator: Any) -> Float[Array, ""]:
        return accumulator

    def label(self, value: Float[Array, ""], model: Any) -> dict[str, Variable]:
        del model
        return {"divergence": Variable(value, (), "1", "integral of tr J over the run")}


# A mass that sticks in an event-driven run has exactly the belt speed, except for interpolation.
_STUCK = 1e-9


class EnergyBalance(AbstractObserver):
    """(work of the belt, energy lost to friction and damping, growth of the stored energy).

    For a `Chain`, by Gauss's rule in every step, of three points and of five in the long steps of
    dry friction, which is more accurate than the interpolation.

    **Value:** shape (3,), in units of (P/k)^2 k; the first is the sum of the others, within the
    errors of the run.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate
        >>> from jaxchain.observers import EnergyBalance
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> run = simulate(chain, equation_8(chain, 1), 30.0, observe=EnergyBalance())
        >>> work, lost, stored = run.observed
        >>> bool(abs(work - lost - stored) < 1e-4 * work)
        True
    """

    def init(self, field: Any, t0: Any, t1: Any, y0: Any) -> tuple[Array, Array, Array]:
        del t0, t1
        if not isinstance(field, Chain):
            raise ValueError("`EnergyBalance` needs dampers and a belt, a `Chain`.")
        stored = _stored(field, *y0)
        return jnp.zeros(2), stored, stored

    def update(self, accumulator: Any, step: Step) -> Any:
        gained, start, _ = accumulator
        field: Any = step.field
        damping_ratio = field.damping_ratio

        def powers(t: Any, y: Any) -> Array:
            x, v = y
            w, width = field.switching(t, v)
            damping = 2.0 * damping_ratio * v
            sliding = field.local_force(t, x, v) + damping
            # Dry friction, with no width, holds a mass on the belt.
            sticks = (width == 0) & (jnp.abs(w) < _STUCK)
            force = jnp.where(sticks, damping - field.restoring_force(x), sliding)
            work = jnp.sum((v - w) * force)
            return jnp.stack([work, jnp.sum(damping * v - force * w)])

        points = 3 if step.rates is None else 5
        return gained + step.integral(powers, points), start, _stored(field, *step.y1)

    def finite(self, accumulator: Any) -> Bool[Array, ""]:
        return all_finite(accumulator)

    def read(self, accumulator: Any) -> Float[Array, "3"]:
        gained, start, end = accumulator
        return jnp.append(gained, end - start)

    def label(self, value: Float[Array, "3"], model: Any) -> dict[str, Variable]:
        del model
        names = {
            "belt_work": "work of the belt",
            "energy_lost": "energy lost to friction and damping",
            "energy_stored": "growth of the stored energy",
        }
        return {
            key: Variable(part, (), "x0^2", name)
            for part, (key, name) in zip(value, names.items(), strict=True)
        }


def _stored(field: Any, x: Array, v: Array) -> Array:
    return 0.5 * jnp.sum(v**2 - x * field.restoring_force(x))
