"""Step-size control that anticipates the switching of friction."""

from __future__ import annotations

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from .._checks import (
    check_at_least,
    check_kind,
    check_nonnegative,
    check_number,
    check_positive_number,
    to_float,
)
from .._final import final
from .._types import ScalarLike, State
from ..model.cells import AbstractField
from ..model.chain import MAKE_CHAIN

# In units of the width, measured on the ring of twenty for widths 1e-2 to 1e-5 and tolerances 1e-4
# to 1e-9.  The optimum is flat: 4 or 8 for 6 and 2 or 4 for 3 change the steps by less than 3 %.
# At 6 widths tanh is 1 to 1e-5, so that beyond them the force is smooth; the landing lies a little
# within, or a step that falls short by a rounding error would be followed by a tiny one.
NEAR = 6.0
LANDING = 5.4
# The force falls within two widths on either side: three are the longest step that sees it.
CROSSING = 3.0


@final
class SwitchingController(dfx.AbstractAdaptiveStepSizeController):
    """Shortens the steps of another controller before a mass reaches the belt speed.

    A controller that uses only past errors enters the layer |w| < 5 eps of smoothed friction with
    full steps, which are rejected: two thirds of all rejected steps.  This controller anticipates
    the layer.  With w = v - v_d at the end of an accepted step and a = dw/dt over it, the next
    step is at most

        (|w| - landing eps) / |a|   if |w| > near eps:  it ends at the edge of the layer,
        crossing eps / |a|          otherwise:  it crosses a part of the layer,

    for every mass that moves towards w = 0.  The other controller decides everything else:
    acceptance, tolerances, and the step after a rejected one.  So the accuracy is that of the
    tolerances, with fewer steps: in a ring of twenty by 21 to 46 % at rtol 1e-5 and by 7 to 32 %
    at 1e-7 (widths 1e-3 to 1e-5; at 1e-2 by 10 and 3 %).  In a ring of thousands a single mass
    hardly affects the norm of the error at a loose tolerance; there the number of steps grows, by
    half at rtol 1e-5 and width 1e-2, and the error is smaller than requested.

    **Arguments:**

    - `controller`: another adaptive controller, such as `diffrax.PIDController`.
    - `field`: the `Chain`, `AbstractOscillators` or `AbstractCells`; its `switching` gives the
      velocities at which forces switch.  If it is None, nothing changes.
    - `near`, `landing`, `crossing`: see above, `near` >= `landing` >= 0 and `crossing` > 0.

    It works with `diffeqsolve`, any solver and every adjoint except `BacksolveAdjoint`, under
    `jit` and `vmap`, forward and backward in time; y0 is the pair (displacement, velocity).
    Derivatives treat step sizes as constants, as those of `diffrax.PIDController`. `simulate` and
    `sweep` use it by default.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import diffrax as dfx, jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Rodas4, equation_8, paper_chain
        >>> from jaxchain.solvers import SwitchingController
        >>> chain = paper_chain(n=20, belt_speed=1.3, width=1e-4)
        >>> def steps(controller):
        ...     return dfx.diffeqsolve(
        ...         dfx.ODETerm(chain), Rodas4(), t0=0.0, t1=30.0, dt0=None,
        ...         y0=equation_8(chain, 9), stepsize_controller=controller,
        ...     ).stats["num_steps"]
        >>> plain = dfx.PIDController(rtol=1e-6, atol=1e-7)
        >>> bool(steps(SwitchingController(plain, chain)) < 0.8 * steps(plain))
        True
    """

    controller: dfx.AbstractAdaptiveStepSizeController
    field: AbstractField
    near: Float[Array, ""]
    landing: Float[Array, ""]
    crossing: Float[Array, ""]
    direction: Any  # of time: 1, or -1 while diffrax counts a backward run upward

    def __init__(
        self,
        controller: Any,
        field: Any,
        near: ScalarLike = NEAR,
        landing: ScalarLike = LANDING,
        crossing: ScalarLike = CROSSING,
    ):
        kind = dfx.AbstractAdaptiveStepSizeController
        remedy = "such as `diffrax.PIDController(rtol=1e-6, atol=1e-7)`."
        check_kind("controller", controller, kind, "an adaptive step-size controller", remedy)
        wanted = "the `Chain` (`AbstractOscillators`, `AbstractCells`) that is integrated"
        check_kind("field", field, AbstractField, wanted, MAKE_CHAIN)
        check_number("landing", landing, f"{LANDING} is usual.")
        check_number("near", near, f"{NEAR} is usual.")
        check_nonnegative("landing", landing, f"{LANDING} is usual.")
        check_at_least("near", near, "landing", landing, f"{NEAR} is usual.")
        check_positive_number("crossing", crossing, f"{CROSSING} is usual.")
        self.controller, self.field = controller, field
        self.near, self.landing = to_float(near), to_float(landing)
        self.crossing = to_float(crossing)
        self.direction = 1

    @property
    def rtol(self):
        return self.controller.rtol

    @property
    def atol(self):
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.norm

    def wrap(self, direction: Any) -> SwitchingController:
        return eqx.tree_at(
            lambda c: (c.controller, c.direction),
            self,
            (self.controller.wrap(direction), direction),
        )

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        if not isinstance(y0, tuple) or len({jnp.shape(part) for part in y0}) != 1:
            raise ValueError(
                "`SwitchingController` needs a state y0 that is the pair (displacement, "
                "velocity), both of shape (n,), or of other cells a tuple of such arrays, but has "
                f"{jtu.tree_structure(y0)}."
            )
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        kept, next_t0, next_t1, made_jump, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )
        longest = self._longest_step(t0, t1, y0, y1_candidate, kept)
        if longest is not None:
            next_t1 = jnp.minimum(next_t1, next_t0 + longest)
        return kept, next_t0, next_t1, made_jump, state, result

    def _longest_step(
        self, t0: Any, t1: Any, y0: State, y1: State, kept: bool | Bool[ArrayLike, ""]
    ) -> Float[Array, ""] | None:
        """The least of the bounds over all masses; infinite where none is about to switch."""
        before = self.field.layer(self.direction * t0, y0)
        after = self.field.layer(self.direction * t1, y1)
        if before is None or after is None:
            return None
        # In backward runs w is also a function of the increasing time, so no sign changes.
        w, width, change, h = lax.stop_gradient((*after, after[0] - before[0], t1 - t0))
        approaching = kept & (w * change < 0.0)
        way = jnp.where(
            jnp.abs(w) > self.near * width,
            jnp.abs(w) - self.landing * width,
            self.crossing * width,
        )
        bound = way * h / jnp.where(approaching, jnp.abs(change), 1.0)
        bound = jnp.min(jnp.where(approaching, bound, jnp.inf))
        return jnp.maximum(bound, self._shortest_step(lax.stop_gradient(t1)))

    def _shortest_step(self, t: Any) -> Float[Array, ""]:
        """The lower limit of all bounds: a step that changes the time, or the controller's own."""
        t = jnp.asarray(t)
        shortest = 8 * jnp.finfo(t.dtype).eps * jnp.maximum(jnp.abs(t), 1e-2)
        if isinstance(self.controller, dfx.PIDController) and self.controller.dtmin is not None:
            shortest = jnp.maximum(shortest, lax.stop_gradient(self.controller.dtmin))
        return shortest
