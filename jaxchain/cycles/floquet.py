"""How disturbances of an orbit grow within a period: monodromy matrix and Floquet multipliers.

The order of states is (x_1 .. x_n, v_1 .. v_n) everywhere.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Complex, Float

from .._checks import (
    as_array,
    check_positive_number,
    is_traced,
    shown,
    to_float,
)
from .._types import State
from ..model.arguments import as_chain, as_state
from ..model.chain import Chain, require_smoothed
from ..model.locality import check_autonomous
from ..model.oscillators import AbstractOscillators
from ..simulation.accuracy import MAX_STEP, check_tolerances, fit_linear_solve
from ..solvers.rosenbrock import Rodas5P
from .variational import Period, linearised_period

CYCLE_RTOL = 1e-10
# Roundings between a monodromy matrix and its eigenvalues: those of some hundred steps, and of a
# condition of some ten.
_ROUNDINGS = 1e3


_linearised = eqx.filter_jit(linearised_period)


def monodromy_matrix(
    chain: Any, state: Any = None, period: Any = None, *, rtol: Any = CYCLE_RTOL
) -> Float[Array, "two_n two_n"]:
    """M = d(state after `period`) / d(state), with states in the order (x_1 .. x_n, v_1 .. v_n).

    The derivative of the discrete steps of the structured solver, sizes held, forward.

    **Arguments:** a `LimitCycle` alone; or a `Chain` or other autonomous `AbstractOscillators`,
    `state` = (x, v), both of shape (n,), on a periodic orbit or not, and `period`, any positive
    dimensionless time.  `rtol`: the tolerance of the integration (absolute: a tenth).

    **Returns:** shape (2n, 2n); NaN where the integration fails.  Works under `jit` and `vmap`.

    **Raises:** `ValueError` for shapes that do not fit, numbers that are not finite, a period or
    a tolerance that cannot be; `RuntimeError` without 64-bit floats.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import monodromy_matrix, paper_chain
    >>> chain = paper_chain(1, belt_speed=9.0)  # sliding: a damped oscillator, nearly
    >>> M = monodromy_matrix(chain, (jnp.full(1, 0.5), jnp.zeros(1)), 1.0)
    >>> round(float(jnp.linalg.det(M)), 6)  # exp(-2 xi)
    0.904837
    """
    return _period(chain, state, period, rtol).monodromy


def trace_integral(
    chain: Any, state: Any = None, period: Any = None, *, rtol: Any = CYCLE_RTOL
) -> Float[Array, ""]:
    """L = integral of tr J over `period`, along the orbit from `state`.

    By Liouville's formula det M = exp(L).  Arguments and errors of `monodromy_matrix`.
    """
    return _period(chain, state, period, rtol).trace_integral


def liouville_determinant(
    chain: Any, state: Any = None, period: Any = None, *, rtol: Any = CYCLE_RTOL
) -> Float[Array, ""]:
    """exp(integral of tr J), what det M must be, by a quadrature that knows nothing of M.

    It underflows to zero where masses stick for long: at a width of 1e-3 tr J is -1000 then.
    `liouville_defect` compares the two with due regard to that.

    **Arguments** and errors are those of `monodromy_matrix`.

    **Returns:** a number, 0 ... 1 where damping outweighs what friction gives.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import monodromy_matrix, paper_chain
        >>> from jaxchain.cycles import liouville_determinant
        >>> chain = paper_chain(1, belt_speed=9.0)  # sliding: a damped oscillator, nearly
        >>> start = jnp.full(1, 0.5), jnp.zeros(1)
        >>> det = jnp.linalg.det(monodromy_matrix(chain, start, 1.0))
        >>> round(float(liouville_determinant(chain, start, 1.0)), 6), round(float(det), 6)
        (0.904837, 0.904837)
    """
    return jnp.exp(trace_integral(chain, state, period, rtol=rtol))


def liouville_defect(
    monodromy: Float[Array, "two_n two_n"], trace: Float[ArrayLike, ""]
) -> Float[Array, ""]:
    """By how much M would have to change for det M = exp(`trace`), `trace` the integral of tr J.

    |det M - exp(L)| / (sum_i prod_{k != i} s_k) with the singular values s_k of M: what stands
    below is by how much det M changes per unit of change of the s_k.  Where nothing contracts
    much it is the relative error of det M over 2n, or so.  Where a mass sticks one s_k and both
    determinants are zero to rounding, and the check says of that direction only that it is.

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
    found = as_array("monodromy", monodromy, 2, 2, "see `monodromy_matrix`.")
    if found.shape[0] != found.shape[1]:
        raise ValueError(
            f"Argument `monodromy` must be square, but has shape {found.shape}: see "
            "`monodromy_matrix`."
        )
    return found


class Floquet(NamedTuple):
    """Multipliers of a periodic orbit.

    - `multipliers`: all but the trivial one, (2n - 1,), complex, the greatest modulus first.
    - `trivial`: f^T M f / f^T f, which is 1 for an exact orbit; `defect` = |M f - f| / |f|.
    """

    multipliers: Complex[Array, " others"]
    trivial: Float[Array, ""]
    defect: Float[Array, ""]


def floquet_multipliers(monodromy: Any, flow_direction: Any = None) -> Floquet:
    """Floquet multipliers of a `LimitCycle`, or the eigenvalues of a monodromy matrix.

    The trivial one is known by its vector.

    A disturbance along the orbit, f = (x', v') at its start, comes back as it was: M f = f.  In an
    orthonormal basis Q that begins with f, M is [[1, *], [0, B]], and the other multipliers are
    those of B.  At a fold, where another one is 1 too and both are a defective pair of M, with an
    error of sqrt(rounding), B has it once, and well conditioned.

    **Arguments:** a `LimitCycle` alone; or M of shape (2n, 2n), with `flow_direction` = f, of
    shape (2n,) or as a pair (x', v').

    **Returns:** `Floquet`; of a cycle the multipliers and the defect that it has, and NaN for
    `trivial`, which it does not keep.  Works under `jit` and `vmap`; by `jnp.linalg.eigvals`,
    which JAX has for CPU and GPU.  NaN in M gives NaN.

    **Raises:** `ValueError` if the shapes do not fit.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import floquet_multipliers
    >>> found = floquet_multipliers(jnp.array([[1.0, 5.0], [0.0, 0.25]]), jnp.array([2.0, 0.0]))
    >>> complex(found.multipliers[0]), float(found.trivial), float(found.defect)
    ((0.25+0j), 1.0, 0.0)
    """
    if is_cycle(monodromy) and flow_direction is None:
        defect = monodromy.trivial_defect
        return Floquet(monodromy.multipliers, jnp.full_like(defect, jnp.nan), defect)
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


def multiplier_resolution(monodromy: Float[Array, "two_n two_n"]) -> Float[Array, ""]:
    """The modulus below which a computed multiplier is rounding: 1e3 times that of |M|.

    >>> import jax.numpy as jnp
    >>> bool(multiplier_resolution(jnp.eye(2)) < 1e-12)
    True
    """
    size = jnp.linalg.norm(monodromy)
    return _ROUNDINGS * jnp.finfo(monodromy.dtype).eps * size


def is_cycle(given: Any) -> bool:
    """Whether it is a `LimitCycle`."""
    from .limit_cycle import LimitCycle  # which needs this module

    return isinstance(given, LimitCycle)


def as_orbit(chain: Any, state: Any, period: Any) -> tuple[Any, Any, Any]:
    """The chain, a state and a period, also of a `LimitCycle` that is given alone."""
    if state is not None or period is not None:
        return chain, state, period
    if not is_cycle(chain):
        raise ValueError(
            "Argument `chain` must be a `LimitCycle`, or a chain for which `state` and `period` "
            f"are given, too, but is {shown(chain)}."
        )
    return chain.chain, chain.state, chain.period


def _period(chain: Any, state: Any, period: Any, rtol: Any) -> Period:
    chain, state, period = as_orbit(chain, state, period)
    state = check_orbit(chain, state, period, rtol)
    require_smoothed(
        chain, "use `floquet_multipliers(cycle)` or `close_orbit` for its multipliers, or "
    )
    given = 1e-9 if is_traced(rtol) else float(rtol)
    solver = fit_linear_solve(Rodas5P(), chain, given)
    return _linearised(chain, state, to_float(period), rtol=to_float(rtol), solver=solver)


def check_orbit(chain: Any, state: Any, period: Any, rtol: Any, name: str = "state") -> State:
    """The state as arrays, or `ValueError`."""
    as_chain(chain, AbstractOscillators)
    x, v = as_state(chain, state, name)
    check_positive_number("period", period, "about 2 pi is usual.")
    check_tolerances(rtol, None, MAX_STEP)
    if not isinstance(chain, Chain):
        check_autonomous(chain, x.shape[0])
    return x, v
