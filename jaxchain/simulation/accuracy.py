"""The choice of width, tolerance and solver for an accuracy against dry friction."""

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._checks import check_number, is_traced
from .._limits import LEAST_ACCURACY, MOST_ACCURACY
from .._printing import PrintedAsCall
from .._types import Given, ScalarLike
from ..model.arguments import as_model
from ..model.chain import require_smoothed
from ..model.model import AbstractModel
from ..solvers.rosenbrock import AbstractStructuredRosenbrock
from .method import choose_solver

# The remedy if `accuracy`, the error of smoothing, is given for a dry chain.
NO_ACCURACY = "give `rtol` instead of `accuracy`, which picks a width, or "
# The ratio of the error of smoothing to `_bias` that one in fifty exceeds; measured on 160 random
# chains of six masses, widths 0.03 to 1e-5, against dry friction.
_WORST = 6.0
# The error of integration is at most some 5 rtol, so at this share of the width it is small beside
# that of smoothing.
_RTOL_PER_WIDTH = 0.1


class Numerics(PrintedAsCall, eqx.Module):
    """The choice of `choose_numerics`: a regularization width, a tolerance and a solver.

    - `width`: eps, a speed in units of x0 omega_n; `rtol`: the relative tolerance of the steps.
    - `solver`: a `Rodas4` or `Rodas5P`, with a number of Jacobi sweeps that suits the coupling.

    See `choose_numerics` for an example.
    """

    width: Array
    rtol: Array
    solver: AbstractStructuredRosenbrock = eqx.field(static=True)


def choose_numerics(model: AbstractModel, accuracy: Given[ScalarLike]) -> Numerics:
    """The cheapest smoothed computation with an error of at most `accuracy`.

    The error is relative to dry friction and to the greatest amplitude of the run.

    **Promised:**

    - for 30 time units from the start, some five periods: every displacement and velocity, and so
      every amplitude;
    - at any later time: settled amplitudes, those that agree within `accuracy` in four successive
      windows of at least 20 time units each (see `settled`).

    Of 1000 random chains of two to six masses with couplings up to 0.05, run for 400 time units at
    accuracies of 0.1, 1e-2 and 1e-3, at most four at each accuracy broke the first promise, by a
    factor of up to 6.4.  The second one was broken by 21, 1 and 0 of them, whose smoothed chain
    had settled on another state than the dry one.

    **Not promised:** later states, because errors of the period add up; and later amplitudes that
    still change, while a mass starts or stops vibrating, while amplitudes beat, or for irregular
    motion.  There the chain amplifies every disturbance, and smoothing shifts the time at which a
    mass starts or stops vibrating.  8 % of the same runs had such a window (15 % above the Hopf
    speed, 2 % below), with errors of up to 110 times `accuracy`, and 2 % (4 % at 0.1) ended in
    one.  A tenth of `accuracy` takes 40 % more steps and leaves 1 %.  A second run with four times
    the accuracy reveals them: where the two differ by more than `accuracy`, the error may be
    greater (of 1000 last windows this missed 0 at 1e-3 and 2 at 1e-2).  `EventDriven()` has no
    width.

    The smoothed force is smaller than the dry one by

        dF = (eps s / 2) [ln(4 mu_st / (eps s)) + 1],    s = |mu'(0)|,

    at its maximum, and its transitions take times of order eps.  So the error is a measured
    multiple of (dF + eps) / A, with A^2 = v_d^2 + (mu_st - mu(2 v_d))^2 / 4 as an estimate of the
    amplitude.  In other models than a chain forces count by the velocity that they give to the
    mass at a contact, F / sqrt(k m); the promises were measured on chains.

    **Arguments:** `accuracy`, between 1e-8 and 0.3.

    **Returns:** a `Numerics`.

    **Raises:** `ValueError` for anything else.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.simulation import choose_numerics
    >>> chosen = choose_numerics(paper_chain(), accuracy=1e-2)
    >>> print(f"width {float(chosen.width):.1e}, rtol {float(chosen.rtol):.1e}, {chosen.solver}")
    width 4.2e-04, rtol 2.8e-05, Rodas4(sweeps=1)
    """
    _check(model, accuracy)
    law, load, speed, unit = cast(tuple, model.friction_scales())
    load = unit * jnp.max(load)  # forces count by the velocities that they give
    zero = jnp.zeros_like(jnp.asarray(law.mu_static, float))
    _, slope = jax.jvp(law.coefficient, (zero,), (jnp.ones_like(zero),))
    slope = load * jnp.maximum(jnp.max(jnp.abs(slope)), 1e-12)
    mu = load * jnp.max(law.mu_static)
    # Masses slide at up to twice the belt's speed.
    drop = load * jnp.max(law.mu_static - law.coefficient(2.0 * jnp.abs(speed)))
    amplitude = jnp.sqrt(speed**2 + (drop / 2) ** 2)
    allowed = accuracy * jnp.maximum(amplitude, 1e-3 * mu) / _WORST

    def shorter(_: Any, width: Array) -> Array:
        # allowed = dF + eps, solved for the eps outside the logarithm: contracts strongly.
        logarithm = jnp.log(jnp.maximum(4.0 * mu / (width * slope), 1.0))
        return allowed / (1.0 + 0.5 * slope * (logarithm + 1.0))

    width = lax.fori_loop(0, 30, shorter, jnp.asarray(allowed, float))
    rtol = _RTOL_PER_WIDTH * width / jnp.maximum(jnp.abs(speed), unit)
    solver = choose_solver(model, 1e-9 if is_traced(rtol) else float(rtol))
    return Numerics(*lax.stop_gradient((width, rtol)), solver)


def check_accuracy(model: AbstractModel, accuracy: Any, rtol: Any) -> None:
    """Raises `ValueError` unless `accuracy` can pick the width and `rtol` of a run."""
    require_smoothed(model, NO_ACCURACY)
    _check(model, accuracy)
    if rtol is not None:
        raise ValueError(
            "Argument `accuracy` picks the width and `rtol`: give either it or `rtol`, but "
            f"`rtol` is {rtol!r}."
        )


def _check(model: AbstractModel, accuracy: Any) -> None:
    as_model(model)
    if model.friction_scales() is None:
        raise ValueError(
            "Argument `accuracy` picks the width of smoothed friction at one contact, of which "
            f"this {type(model).__name__} has none: leave it out, and give `rtol`."
        )
    check_number("accuracy", accuracy, "1e-3 is 0.1 %.")
    if not is_traced(accuracy) and not LEAST_ACCURACY <= float(accuracy) <= MOST_ACCURACY:
        raise ValueError(
            f"Argument `accuracy` must lie between {LEAST_ACCURACY:g} and {MOST_ACCURACY:g}, but "
            f"is {accuracy}: it is a relative error. For less error use `EventDriven()`, which "
            "has no width."
        )
