"""Step-size control that anticipates the switching of friction, and times its release."""

from __future__ import annotations

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Float

from .._checks import (
    check_at_least,
    check_kind,
    check_nonnegative,
    check_number,
    check_positive_number,
    to_float,
)
from .._computed_once import materialize, spread
from .._types import ScalarLike, State
from ..model.chain import MAKE_CHAIN
from ..model.model import AbstractModel

# In units of the width, measured on the ring of twenty for widths 1e-2 to 1e-4 and errors of 1e-2
# to 1e-6.  The optimum is flat.  At 6 widths tanh is 1 to 1e-5, so that beyond them the force is
# smooth; the landing lies well within `NEAR`, or a step that falls a little short would be
# followed by a tiny one.
NEAR = 8.0
LANDING = 5.4
# The force falls within two widths on either side: three are the longest step that sees it.
CROSSING = 3.0
# While a sticking mass creeps outward between the first two |w|, in widths, a step changes w by a
# quarter of a width at the rate of the step before; at half a width some steps miss the release of
# narrow widths.  Between the last two an error of the velocity is hardly damped any more, and the
# mass is still slow.
CREEPS, RELEASED, FREE = 0.1, 2.25, 8.0
CREEP = 0.25
# A change by less than `STILL` widths in a step is not a release.  `SHARE` of the acceleration
# by friction is that of a released mass; the optimum is flat.
STILL, SHARE = 0.05, 0.5


class SwitchingController(dfx.AbstractAdaptiveStepSizeController):
    """Shortens the steps of another controller where a mass reaches the belt speed or leaves it.

    A controller that uses only past errors enters the layer |w| < 5 eps of smoothed friction with
    full steps, which are rejected.  This controller anticipates the layer.  With w = v - v_d at
    the end of an accepted step and a = dw/dt over it, the next step is at most

        (|w| - landing eps) / |a|   if |w| > near eps:  it ends at the edge of the layer,
        crossing eps / |a|          otherwise:  it crosses a part of the layer,

    for every mass that moves towards w = 0.  The way to the edge is corrected for the change of a,
    which the displacements of a step reveal.

    A mass is released when the force on it passes the greatest friction force.  A step over the
    release can end in the layer, as if the mass still stuck, with a small error estimate.  So a
    step that begins at |w| < 2.25 eps is at most 0.25 eps / |a| for a mass that moves away from
    w = 0.  In the rest of the layer, |w| < 8 eps, an error dw of the velocity is an error dw / |a|
    of the time of release; then the mass lags by A times that, with A half of the
    `release_acceleration` of the field, by which it slides.  So dw counts A / |a| times.  With
    both, the error of a run follows its tolerance; without, it is by orders of magnitude greater
    if the tolerance on velocities is not far below the width.

    The other controller decides everything else: acceptance, tolerances, and the step after a
    rejected one.  It sees states in the units of `field.sizes`, the greatest so far.  In a ring of
    thousands a single mass hardly affects the norm of the error at a loose tolerance.

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
        >>> tight, loose = (dfx.PIDController(rtol=r, atol=0.1 * r) for r in (1e-6, 1e-5))
        >>> bool(steps(SwitchingController(loose, chain)) < 0.7 * steps(tight))  # less error, too
        True
    """

    controller: dfx.AbstractAdaptiveStepSizeController
    field: AbstractModel
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
        check_kind("field", field, AbstractModel, wanted, MAKE_CHAIN)
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
        if (sizes := self._sizes(y0)) is None:
            return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        # From rest: what forces move in a unit of time, a little later, as a sine begins at 0.
        time = self.field.natural_scales()[0]
        rates = terms.vf(t0 + 0.1 * time, y0, args)
        soon: Any = self._sizes(tuple(a + time * b for a, b in zip(y0, rates, strict=True)))
        sizes = tuple(jnp.where(a > 0, a, b) for a, b in zip(sizes, soon, strict=True))

        def scaled(t: Any, y: State, args: Any) -> State:
            return _over(terms.vf(t, _times(y, sizes), args), sizes)

        own: Any = dfx.ODETerm(scaled)
        begin = _over(y0, sizes)
        end, state = self.controller.init(own, t0, t1, begin, dt0, args, func, error_order)
        return end, (state, sizes)

    def _sizes(self, y: State) -> tuple[Array, ...] | None:
        """What counts as 1 of each variable; 0 where nothing has moved yet."""
        sizes = lax.stop_gradient(self.field.sizes(y))
        return None if sizes is None else tuple(map(jnp.asarray, sizes))

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        before = self.field.layers(self.direction * t0, y0)
        after = self.field.layers(self.direction * t1, y1_candidate)
        moves = [
            ([spread(part, y0[0]) for part in (start, w, width, t1 - t0)], contact)
            for (start, _, contact), (w, width, _) in zip(before, after, strict=True)
        ]
        for moved, contact in moves:
            y_error = self._weighted(y_error, contact, *moved)
        sizes, seen = self._sizes(y1_candidate), (y0, y1_candidate, y_error)
        controller_state, so_far = (controller_state, ()) if sizes is None else controller_state
        y, y1, error = seen if sizes is None else (_over(part, so_far) for part in seen)
        kept, next_t0, next_t1, made_jump, state, result = self.controller.adapt_step_size(
            t0, t1, y, y1, args, error, error_order, controller_state
        )
        if sizes is not None:  # the greatest so far
            pairs = zip(so_far, sizes, strict=True)
            state = state, tuple(jnp.where(kept, jnp.fmax(a, b), a) for a, b in pairs)
        for moved, contact in moves:
            bend = self._curvature(contact, moved[-1], y0, y1_candidate)
            longest = jnp.where(kept, self._longest_step(bend, *moved), jnp.inf)
            longest = jnp.maximum(longest, self._shortest_step(lax.stop_gradient(t1)))
            next_t1 = jnp.minimum(next_t1, next_t0 + longest)
        return kept, next_t0, next_t1, made_jump, state, result

    def _weighted(
        self, error: Any, contact: int | None, start: Array, w: Array, width: Any, h: Any
    ) -> Any:
        """The error of a step from w = `start`, by its effect on the time of a release."""
        acceleration = self.field.release_acceleration()
        if acceleration is None or contact is None or not isinstance(error, tuple):
            return error
        change = jnp.abs(w - start)
        leaves = (w * (w - start) > 0.0) & (jnp.abs(start) < FREE * width)
        leaves = leaves & (jnp.abs(w) > RELEASED * width)
        slow = jnp.where(leaves, jnp.maximum(change, STILL * width), 1.0)
        weight = jnp.where(leaves, jnp.maximum(SHARE * acceleration * h / slow, 1.0), 1.0)
        weighted = lax.stop_gradient(weight) * error[contact]
        return (*error[:contact], weighted, *error[contact + 1 :])

    def _curvature(self, contact: int | None, h: Any, y0: State, y1: State) -> Any:
        """c of v = (1 - s / h) v_0 + (s / h) v_1 + c s (s - h) with the mean (x_1 - x_0) / h."""
        of = [k for k in range(len(y0)) if self.field.velocity_of(k) == contact]
        if contact is None or not of:
            return 0.0  # the integral of v need not be among the variables
        x = of[0]
        mean = (self.direction / h) * (y1[x] - y0[x])  # x' = -v while time runs backward
        ends = 0.5 * (y0[contact] + y1[contact])
        return (6.0 / h**2) * (ends - mean)

    def _longest_step(
        self, bend: Any, start: Array, w: Array, width: Any, h: Any
    ) -> Float[Array, ""]:
        """The least of the bounds over all masses after a step; infinite where none applies."""
        # In backward runs w is also a function of the increasing time, so no sign changes.
        w, width, change, h, bend = lax.stop_gradient((w, width, w - start, h, bend))
        size, moves = jnp.abs(w), w * change
        approaching = moves < 0.0
        creeps = (moves > 0.0) & (size > CREEPS * width) & (size < RELEASED * width)
        rate = (1.0 / h) * jnp.abs(change)
        # The edge is met where way = speed t + curve t^2, at a mean speed of half the root.
        way, curve = size - self.landing * width, -jnp.sign(w) * bend
        speed = rate + curve * h
        root = speed + jnp.sqrt(jnp.maximum(speed**2 + 4.0 * curve * way, 0.0))
        mean = jnp.where(speed > 0, jnp.clip(0.5 * root, 0.5 * rate, 2.0 * rate), rate)
        far = approaching & (size > self.near * width)
        way = jnp.where(far, way, jnp.where(creeps, CREEP, self.crossing) * width)
        bounded = approaching | creeps
        time = way / jnp.where(bounded, jnp.where(far, mean, rate), 1.0)
        # Computed before the reduction, which has no SIMD.
        return jnp.min(materialize(jnp.where(bounded, time, jnp.inf), flat=True))

    def _shortest_step(self, t: Any) -> Float[Array, ""]:
        """The lower limit of all bounds: a step that changes the time, or the controller's own."""
        t = jnp.asarray(t)
        shortest = 8 * jnp.finfo(t.dtype).eps * jnp.maximum(jnp.abs(t), 1e-2)
        if isinstance(self.controller, dfx.PIDController) and self.controller.dtmin is not None:
            shortest = jnp.maximum(shortest, lax.stop_gradient(self.controller.dtmin))
        return shortest


def _over(y: Any, sizes: tuple[Array, ...]) -> State:
    return tuple(a / jnp.where(b > 0, b, 1.0) for a, b in zip(y, sizes, strict=True))


def _times(y: State, sizes: tuple[Array, ...]) -> State:
    return tuple(a * jnp.where(b > 0, b, 1.0) for a, b in zip(y, sizes, strict=True))
