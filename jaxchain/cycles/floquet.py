"""A limit cycle, and how disturbances of it grow within a period.

The order of states is (x_1 .. x_n, v_1 .. v_n) everywhere.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, Int

from .._checks import as_array, check_positive_number, is_traced, shown, to_float
from .._printing import Sketch
from .._types import Given, ScalarLike, State, StateLike
from ..model.arguments import as_model, as_state
from ..model.chain import require_smoothed
from ..model.locality import check_autonomous
from ..model.model import AbstractModel
from ..observers.quantities import energy
from ..result import Outcome, Result, SearchResult
from ..simulation.event_driven import EventDriven
from ..simulation.method import MAX_STEP, check_tolerances, fit_linear_solve
from ..simulation.run import simulate
from ..solvers.rosenbrock import AbstractStructuredRosenbrock, Rodas5P
from .variational import Period, linearised_period

CYCLE_RTOL = 1e-10
# The error of eigenvalues in roundings: some hundred steps times a condition number of some ten.
_ROUNDINGS = 1e3


def monodromy_matrix(
    model: Given[AbstractModel | LimitCycle],
    state: Given[StateLike | None] = None,
    period: Given[ScalarLike | None] = None,
    *,
    rtol: Given[ScalarLike] = CYCLE_RTOL,
) -> Float[Array, "two_n two_n"]:
    """M = d(state after `period`) / d(state), with states in the order (x_1 .. x_n, v_1 .. v_n).

    The forward derivative of the discrete steps of the structured solver, with fixed step sizes;
    with dry friction that of an event-driven run, with its saltation at sticking and release.  A
    mass that sticks at first, or at some time, makes M singular.

    **Arguments:** a `LimitCycle` alone; or a `Chain`, `AbstractOscillators` or `AbstractCells`,
    `state` = (x, v), both of shape (n,), on a periodic orbit or not, and `period`, any positive
    dimensionless time (of what is forced, from t = 0).  `rtol`: the tolerance of the integration
    (absolute: a tenth).

    **Returns:** shape (2n, 2n); NaN where the integration fails.  Works under `jit` and `vmap`.

    **Raises:** `ValueError` for wrong shapes, numbers that are not finite, a period or a tolerance
    that is not positive; `RuntimeError` without 64-bit floats.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import monodromy_matrix, paper_chain
    >>> chain = paper_chain(1, belt_speed=9.0)  # sliding: a damped oscillator, nearly
    >>> M = monodromy_matrix(chain, (jnp.full(1, 0.5), jnp.zeros(1)), 1.0)
    >>> round(float(jnp.linalg.det(M)), 6)  # exp(-2 xi)
    0.904837
    """
    model, state, period = as_orbit(model, state, period)
    if getattr(model, "dry", False):
        state = check_orbit(model, state, period, rtol)
        return _of_events(model, state, to_float(period), to_float(rtol))
    return _period(model, state, period, rtol).monodromy


@eqx.filter_jit
def _of_events(model: Any, state: State, period: Array, rtol: Array) -> Array:
    def end(y: Array) -> tuple[Array, Array]:
        how: Any = {"solver": EventDriven(), "rtol": rtol, "throw": False}
        run = simulate(model, tuple(jnp.split(y, len(state))), period, **how)
        return jnp.concatenate(run.state), run.result == Result.successful

    slopes, good = jax.jacfwd(end, has_aux=True)(jnp.concatenate(state))
    return jnp.where(good, slopes, jnp.nan)


def trace_integral(
    model: Any, state: Any = None, period: Any = None, *, rtol: Any = CYCLE_RTOL
) -> Float[Array, ""]:
    """L = integral of tr J over `period`, along the orbit from `state`.

    By Liouville's formula det M = exp(L).  Arguments and errors of `monodromy_matrix`.
    """
    return _period(model, state, period, rtol).trace_integral


def liouville_determinant(
    model: Given[AbstractModel | LimitCycle],
    state: Given[StateLike | None] = None,
    period: Given[ScalarLike | None] = None,
    *,
    rtol: Given[ScalarLike] = CYCLE_RTOL,
) -> Float[Array, ""]:
    """exp(integral of tr J), the exact det M, by a quadrature independent of M.

    It underflows to zero if masses stick for long: at a width of 1e-3 tr J is then -1000.
    `liouville_defect` compares the two in a way that allows for this.

    **Arguments** and errors are those of `monodromy_matrix`.

    **Returns:** a number, 0 ... 1 if damping exceeds the energy input of friction.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import monodromy_matrix, paper_chain
        >>> from jaxchain.cycles.floquet import liouville_determinant
        >>> chain = paper_chain(1, belt_speed=9.0)  # sliding: a damped oscillator, nearly
        >>> start = jnp.full(1, 0.5), jnp.zeros(1)
        >>> det = jnp.linalg.det(monodromy_matrix(chain, start, 1.0))
        >>> round(float(liouville_determinant(chain, start, 1.0)), 6), round(float(det), 6)
        (0.904837, 0.904837)
    """
    return jnp.exp(trace_integral(model, state, period, rtol=rtol))


def liouville_defect(
    monodromy: Float[Array, "two_n two_n"], trace: Float[ArrayLike, ""]
) -> Float[Array, ""]:
    """The change of M that would give det M = exp(`trace`), `trace` the integral of tr J.

    |det M - exp(L)| / (sum_i prod_{k != i} s_k) with the singular values s_k of M; the denominator
    is the change of det M per unit change of the s_k.  Without strong contraction it is about the
    relative error of det M over 2n.  If a mass sticks, one s_k and both determinants are zero to
    rounding, and the check confirms only this.

    **Arguments:** M of shape (2n, 2n), see `monodromy_matrix`; `trace` = L, one number.

    **Returns:** a number >= 0, NaN where M is.

    **Raises:** `ValueError` for a matrix that is not square.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.cycles import liouville_defect
        >>> M = jnp.diag(jnp.array([1.0, 0.5]))
        >>> right, wrong = jnp.log(0.5), jnp.log(0.6)
        >>> [round(float(liouville_defect(M, trace)), 4) for trace in (right, wrong)]
        [0.0, 0.0667]
    """
    monodromy, trace = _square(monodromy), as_array("trace", trace, 0, 0)
    sizes = jnp.linalg.svd(monodromy, compute_uv=False)
    logs = jnp.log(jnp.maximum(sizes, 1e-300))
    scale = jax.scipy.special.logsumexp(jnp.sum(logs) - logs)
    sign, log_determinant = jnp.linalg.slogdet(monodromy)
    return jnp.abs(sign * jnp.exp(log_determinant - scale) - jnp.exp(trace - scale))


def _square(monodromy: Any) -> Array:
    matrix = as_array("monodromy", monodromy, 2, 2, "see `monodromy_matrix`.")
    if matrix.shape[0] != matrix.shape[1]:
        raise ValueError(
            f"Argument `monodromy` must be square, but has shape {matrix.shape}: see "
            "`monodromy_matrix`."
        )
    return matrix


class Floquet(NamedTuple):
    """Multipliers of a periodic orbit.

    - `multipliers`: all but the trivial one, (2n - 1,), complex, the greatest modulus first.
    - `trivial`: f^T M f / f^T f, which is 1 for an exact orbit; `defect` = |M f - f| / |f|.
    """

    multipliers: Complex[Array, " others"]
    trivial: Float[Array, ""]
    defect: Float[Array, ""]


def floquet_multipliers(
    monodromy: Given[ArrayLike | LimitCycle],
    flow_direction: Given[ArrayLike | tuple[ArrayLike, ...] | None] = None,
) -> Floquet:
    """Floquet multipliers of a `LimitCycle`, or the eigenvalues of a monodromy matrix.

    The trivial multiplier is removed by its eigenvector.

    A disturbance along the orbit, f = (x', v') at its start, returns unchanged: M f = f.  In an
    orthonormal basis Q that begins with f, M is [[1, *], [0, B]], and the other multipliers are
    the eigenvalues of B.  At a fold M has a defective pair of eigenvalues 1, whose error is
    sqrt(rounding); B has a single one, which is well conditioned.

    **Arguments:** a `LimitCycle` alone; or M of shape (2n, 2n), with `flow_direction` = f, of
    shape (2n,) or as a pair (x', v').

    **Returns:** `Floquet`; for a cycle its stored multipliers and defect, and NaN for `trivial`.
    It works under `jit` and `vmap`, and uses `jnp.linalg.eigvals`, which JAX has for CPU and GPU.
    NaN in M gives NaN.

    **Raises:** `ValueError` if the shapes do not fit.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import floquet_multipliers
    >>> found = floquet_multipliers(jnp.array([[1.0, 5.0], [0.0, 0.25]]), jnp.array([2.0, 0.0]))
    >>> complex(found.multipliers[0]), float(found.trivial), float(found.defect)
    ((0.25+0j), 1.0, 0.0)
    """
    if is_cycle(monodromy) and flow_direction is None:
        cycle: Any = monodromy
        defect = cycle.trivial_defect
        return Floquet(cycle.multipliers, jnp.full_like(defect, jnp.nan), defect)
    monodromy = _square(monodromy)
    if flow_direction is None:
        raise ValueError(
            "Argument `flow_direction` must be given beside a matrix, but is None: it is the "
            "field at the state, `chain(0.0, state)`; or give a `LimitCycle` alone."
        )
    if isinstance(flow_direction, tuple | list):
        parts = [to_float(part, "flow_direction") for part in flow_direction]
        vectors = bool(parts) and all(part.ndim == 1 for part in parts)
        flow_direction = jnp.concatenate(parts) if vectors else flow_direction
    f = to_float(flow_direction, "flow_direction")
    if not is_traced(f) and not jnp.any(f):
        raise ValueError(
            f"Argument `flow_direction` must not be zero, but is {shown(f)}: it is the field at "
            "the state, `chain(0.0, state)`."
        )
    if f.shape != (monodromy.shape[0],):
        raise ValueError(
            f"Argument `flow_direction` must have shape ({monodromy.shape[0]},) like a column of "
            f"`monodromy`, but has shape {f.shape}."
        )
    length = jnp.linalg.norm(f)
    image = monodromy @ f
    basis, _ = jnp.linalg.qr(f[:, None], mode="complete")
    reduced = basis.T @ monodromy @ basis
    values = jnp.linalg.eigvals(reduced[1:, 1:])
    values = values[jnp.argsort(-jnp.abs(values))]
    return Floquet(values, f @ image / length**2, jnp.linalg.norm(image - f) / length)


def orbit_multipliers(monodromy: Float[Array, "d d"], f: Float[Array, " d"] | None) -> Floquet:
    """`floquet_multipliers`; all d of a forced orbit (f None), which has no trivial one."""
    if f is not None:
        return floquet_multipliers(monodromy, f)
    values = jnp.linalg.eigvals(monodromy)
    defect = jnp.where(jnp.all(jnp.isfinite(monodromy)), 0.0, jnp.nan)
    return Floquet(values[jnp.argsort(-jnp.abs(values))], jnp.ones(()), defect)


def multiplier_resolution(monodromy: Float[Array, "two_n two_n"]) -> Float[Array, ""]:
    """The modulus below which a computed multiplier is rounding: 1e3 times the rounding of |M|.

    >>> import jax.numpy as jnp
    >>> bool(multiplier_resolution(jnp.eye(2)) < 1e-12)
    True
    """
    size = jnp.linalg.norm(monodromy)
    return _ROUNDINGS * jnp.finfo(monodromy.dtype).eps * size


def is_cycle(given: Any) -> bool:
    """Whether the argument is a `LimitCycle`."""

    return isinstance(given, LimitCycle)


def as_orbit(model: Any, state: Any, period: Any) -> tuple[Any, Any, Any]:
    """The chain, a state and a period, from three arguments or a `LimitCycle` alone."""
    if state is not None or period is not None:
        return model, state, period
    if not is_cycle(model):
        raise ValueError(
            "Argument `model` must be a `LimitCycle`, or a model for which `state` and `period` "
            f"are given, too, but is {shown(model)}."
        )
    return model.chain, model.state, model.period


def _period(model: Any, state: Any, period: Any, rtol: Any) -> Period:
    model, state, period = as_orbit(model, state, period)
    state = check_orbit(model, state, period, rtol)
    require_smoothed(model, "use `find_limit_cycle` or `monodromy_matrix`, or ")
    solver = cycle_solver(model, rtol, state)
    return _linearised(model, state, to_float(period), to_float(rtol), solver)


def cycle_solver(model: AbstractModel, rtol: Any, state: State) -> AbstractStructuredRosenbrock:
    """The solver of runs over a period of smoothed friction."""
    given = 1e-9 if is_traced(rtol) else float(rtol)
    return fit_linear_solve(Rodas5P(), model, given, state=state)


@eqx.filter_jit
def _linearised(model: Any, state: State, period: Array, rtol: Array, solver: Any) -> Period:
    def make(y: Array) -> tuple[AbstractModel, State, Array]:
        return model, tuple(jnp.split(y, len(state))), period

    return linearised_period(make, jnp.concatenate(state), rtol=rtol, solver=solver)


def check_orbit(model: Any, state: Any, period: Any, rtol: Any, name: str = "state") -> State:
    """The state as arrays, or `ValueError`."""
    as_model(model)
    parts = as_state(model, state, name)
    check_positive_number("period", period, "about 2 pi is usual.")
    check_tolerances(rtol, None, MAX_STEP)
    check_force(model, parts)
    return parts


def check_force(model: AbstractModel, state: State) -> None:
    """Raises `ValueError` unless the rate is periodic in time, as `forcing_period` says."""
    forced = model.forcing_period()
    if forced is None:
        check_autonomous(model, state)
        return
    check_positive_number("forcing_period()", forced, "it is that of what depends on time.")
    if is_traced(model, forced, state):
        return
    for share in (0.0, 0.3, 0.7):
        now, later = (jnp.stack(model(t * forced, state)) for t in (share, share + 1.0))
        size = jnp.max(jnp.abs(now)) + jnp.max(jnp.abs(later))
        if bool(jnp.max(jnp.abs(now - later)) > 1e-9 * size):
            raise ValueError(
                f"The method `forcing_period` of {type(model).__name__} returns "
                f"{float(forced):.9g}, but the rate at a time and a period later differ: give "
                "the period of the force."
            )


def forcing_periods_of(model: AbstractModel, period: Any) -> int | None:
    """The number of periods of the force in `period`, or `ValueError`; None without forcing."""
    forced = model.forcing_period()
    if forced is None:
        return None
    if is_traced(period, forced):
        raise ValueError(
            "Argument `period` is traced, or the period of the force is, so that the number of "
            "forcing periods of the cycle is not known: give a forced `LimitCycle` as `guess`."
        )
    forcing_periods = round(float(period) / float(forced))
    if forcing_periods < 1 or abs(forcing_periods * float(forced) / float(period) - 1.0) > 1e-6:
        raise ValueError(
            f"Argument `period` is {float(period):.9g}, but the cells are forced with the period "
            f"{float(forced):.9g}: give a multiple of it, or leave `period` out."
        )
    return forcing_periods


def scaled_peak_velocity(model: AbstractModel, fastest: Float[Array, " n"]) -> Float[Array, " n"]:
    """max w / eps, from the greatest velocities in the direction of the belt."""
    along = model.belt_direction()
    switching = model.switching(0.0, along * fastest)
    if switching is None:
        return jnp.full_like(fastest, jnp.nan)
    w = along * switching[0]
    return jnp.where(w == 0, 0.0, w / switching[1])


# A mass that moves less counts as not moving.
LEAST_VELOCITY = 1e-6
# M is not trusted if the trivial multiplier or the determinant has a greater error.
_WORST_DEFECT = 1e-3


class LimitCycle(Outcome):
    """A periodic orbit.

    - `state`, `period`: a point where mass `mass` is fastest in the direction of the belt, and the
      minimal period.
    - `residual`: the gap after a period, relative to the size of the orbit or to the greatest
      velocity of that mass; velocities of a sticking mass are measured in widths.  `result`:
      successful for a cycle.
    - `multipliers`: the 2n - 1 Floquet multipliers except the trivial one, the greatest modulus
      first.  Dry friction: 0 also for those below rounding.
    - `trivial_defect`: |M f - f| / |f| for f = (x', v'), ideally 0.  `liouville_defect`: see the
      function of this name; NaN for dry friction.  Both are measured on this orbit.
    - `amplitude`: half peak-to-peak of each displacement, of cells that of the first one;
      `fastest`: each greatest velocity in the direction of the belt, of cells that of the
      displacement that slides on it.
    - `evaluations`: the number of linearised integrations; `chain`: the chain of this cycle.
    - `turns`: of a forced cycle, its period in periods of the force, its state that at t = 0, and
      all m N multipliers; None where nothing depends on time.  `times_round` is 1.

    With dry friction and a mass that sticks at some time, as many multipliers are exactly 0 as
    masses ever stick together, and the state at the cut is that where the belt releases the mass.

    See `find_limit_cycle` for an example.
    """

    may_be_missing = ("liouville_defect",)
    chain: AbstractModel
    state: State
    period: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    multipliers: Complex[Array, " others"]
    trivial_defect: Float[Array, ""]
    liouville_defect: Float[Array, ""]
    amplitude: Float[Array, " n"]
    fastest: Float[Array, " n"]
    evaluations: Int[Array, ""]
    mass: int = eqx.field(static=True)
    times_round: Int[Array, ""] = eqx.field(default_factory=lambda: jnp.ones((), int))
    turns: int | None = eqx.field(static=True, default=None)

    def _sketch(self) -> Sketch:
        """The multipliers and the unit circle; disturbances die out inside it."""
        angle = np.linspace(0.0, 2.0 * np.pi, 181)
        multipliers = np.ravel(self.multipliers)
        points = [(mu.real, mu.imag, "") for mu in multipliers]
        circle = (np.cos(angle), np.sin(angle))
        return Sketch("Re of multipliers", "Im", [circle], points, is_isotropic=True)

    @property
    def scaled_peak_velocity(self) -> Float[Array, " n"]:
        """max w / eps of each mass; negative if the mass never reaches the belt speed.

        With dry friction it is -inf for such a mass, 0 for one that sticks and is never faster
        than the belt, and inf for one that is.  NaN for cells without friction that switches.
        """
        return scaled_peak_velocity(self.chain, self.fastest)

    @property
    def energy(self) -> Float[Array, ""]:
        """E = 1/2 sum A_n^2."""
        return energy(self.amplitude)

    @property
    def uncertainty(self) -> Float[Array, ""]:
        """The uncertainty of the multipliers, estimated from the two defects."""
        defect = self.trivial_defect + jnp.nan_to_num(self.liouville_defect)
        return 1e-8 + 10.0 * (defect + self.residual)

    @property
    def stability_margin(self) -> Float[Array, ""]:
        """1 - the greatest modulus of a multiplier: negative for an unstable cycle."""
        return 1.0 - jnp.abs(self.multipliers[0])

    @property
    def stable(self) -> bool | None:
        """Whether disturbances die out; None if unknown: no cycle, a defect, or |mu| = 1 within
        its uncertainty.  For one cycle, not for a batch."""
        uncertainty, margin = float(self.uncertainty), float(self.stability_margin)
        sound = bool(self.successful) and uncertainty < _WORST_DEFECT
        if not sound or not abs(margin) > uncertainty:
            return None
        return margin > 0


def is_trusted(
    multipliers: Complex[Array, " others"], defect: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether the disturbance along the orbit returns unchanged, as on a cycle.

    An error of that disturbance grows like any other.
    """
    growth = 1.0 + jnp.max(jnp.nan_to_num(jnp.abs(multipliers)))  # those not resolved are small
    return defect <= _WORST_DEFECT * growth  # false for NaN
