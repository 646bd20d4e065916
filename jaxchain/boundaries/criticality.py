"""Whether a Hopf bifurcation is super- or subcritical: the first Lyapunov coefficient l1.

The force on a mass depends on that mass's velocity only, so the second and third derivatives of
the vector field, as forms B and C, are B(a, b)_n = g_n'' a_n b_n and C(a, b, c)_n = g_n''' a_n b_n
c_n in the velocities, and nothing in the displacements.  They come from nested `jvp` and hold for
complex vectors, because they are multilinear.

Where l1 = 0 the fold of cycles meets the Hopf point, the generalised Hopf (Bautin) point.  Along
the Hopf curve in the plane of the belt speed and another number, vibration sets in abruptly
where the first Lyapunov coefficient l1 is positive, with a stable state of rest beside a vibrating
one up to the fold; and gently where l1 is negative, without a fold.  At l1 = 0 the fold ends,
tangentially to the Hopf curve (Kuznetsov, Elements of Applied Bifurcation Theory, section 8.3).

For one mass l1 has the sign of F'''(-v_d).  Dry friction that weakens exponentially has
F''' > 0 throughout, so that its fold and Hopf point meet at a belt at rest only.  Smoothed
friction mu tanh(v_d / eps) has a peak, and F''' < 0 up to a few widths beyond it:

    v_d = (eps / 2) ln[16 mu_st v_0^3 / ((mu_st - mu_d) eps^3)]  to leading order,

and the damping there is about p (mu_st - mu_d) / (2 v_0), that of dry friction at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

from .._checks import as_array, check_one_of, check_positive_number, is_traced, shown
from .._final import final
from .._types import ScalarLike
from ..continuation.damped_newton import newton
from ..continuation.implicit import attach_derivative
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..model.initial_states import check_vibrating
from ..model.parameters import CHAIN
from ..model.sliding import dry_damping, sliding_damping, stiffness_matrix
from ..result import Outcome, SearchResult
from .hopf import hopf_belt_speed

# The zero of l1 lies close to the end of the Hopf curve where the width is small.
_GRID, _ZOOMS = 48, 5
# Third derivatives at a width eps err by rounding over eps^3.
_TOLERANCE = 1e-8


def first_lyapunov_coefficient(
    chain: Chain,
    belt_speed: ScalarLike,
    frequency: ScalarLike,
    shape: Complex[Array, " {chain.n}"],
    left: Complex[Array, " {chain.n}"] | None = None,
) -> Float[Array, ""]:
    """l1 of a Hopf point of steady sliding; negative: supercritical, positive: subcritical.

    With q = (u, i omega u) and p the right and left eigenvectors, <q, q> = <p, q> = 1, and J the
    Jacobian,

        l1 = 1 / (2 omega) Re [ <p, C(q, q, q*)> - 2 <p, B(q, J^-1 B(q, q*))>
                                + <p, B(q*, (2 i omega - J)^-1 B(q, q))> ].

    The middle term is zero here: a constant force moves the masses but gives them no velocity.
    The size of l1 depends on the normalisation, here <q, q> = 1, Euclidean, over (x, v).  On the
    centre manifold (x, v) = w q + w* q*, and w' = (alpha + i omega) w + omega l1 w |w|^2, so that
    cycles of |w|^2 = -alpha / (omega l1) branch off; see `square_amplitude_slope`.

    **Arguments:** the Hopf point (|v_d| counts), `shape` = u, over the masses, of any length;
    `left`, the left null vector l of K - omega^2 + i omega D, l^T A = 0, by default u, which is
    right for a simple pair, A being complex symmetric.  For a wave that travels around a
    homogeneous ring, one of a pair q, -q, it is conj u; for a standing wave u, real.  Both waves
    lie in a space that symmetry keeps to itself, so the formula holds for each of them.

    F is smooth except at w = 0, that is v_d = 0, which is no Hopf point.

    Source: Kuznetsov, Elements of Applied Bifurcation Theory, eq. (3.20) for the plane and
    section 5.4 for any dimension.

    **Returns:** l1, a number.

    >>> import jax, jax.numpy as jnp
    >>> from jaxchain import paper_chain
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.boundaries import first_lyapunov_coefficient
    >>> one = jnp.ones(1, dtype=complex)
    >>> l1 = first_lyapunov_coefficient(paper_chain(1), jnp.log(10.0) / 2, 1.0, one)
    >>> round(float(l1), 12)  # F''' / 8, F''' = (mu_st - mu_d) exp(-v_H / v0) / v0^3 = 0.4
    0.05
    """
    return jnp.real(jnp.sum(_terms(chain, belt_speed, frequency, shape, left)))


def relative_coefficient(
    chain: Chain,
    belt_speed: ScalarLike,
    frequency: ScalarLike,
    shape: Complex[Array, " {chain.n}"],
    left: Complex[Array, " {chain.n}"] | None = None,
) -> Float[Array, ""]:
    """l1 over the sum of the sizes of its terms: rounding errors only if l1 is truly zero."""
    terms = _terms(chain, belt_speed, frequency, shape, left)
    size = jnp.sum(jnp.abs(terms))
    return jnp.real(jnp.sum(terms)) / jnp.where(size > 0, size, 1.0)


def _mode(name: str, mode: Any, n: int) -> Array:
    """A shape of n complex amplitudes; NaN, of what was not found, is good."""
    dtype = getattr(mode, "dtype", None)
    number = dtype is not None and jnp.issubdtype(dtype, jnp.number)
    if not number or mode.shape != (n,):
        raise ValueError(
            f"Argument `{name}` must be an array of {n} complex numbers, one per mass, but is "
            f"{shown(mode)}: see `hopf_points` for mode shapes."
        )
    return mode


def _terms(
    chain: Chain, belt_speed: ScalarLike, frequency: ScalarLike, shape: Array, left: Array | None
) -> Array:
    """What l1 is the real part of the sum of; of shape (2 n,), mass by mass."""
    as_chain(chain)
    belt_speed = as_array("belt_speed", belt_speed, 0, 0)
    frequency = as_array("frequency", frequency, 0, 0)
    shape = _mode("shape", shape, chain.n)
    left = shape if left is None else _mode("left", left, chain.n)
    moving = chain.with_(belt_speed=jnp.abs(belt_speed))
    zero = jnp.zeros(chain.n)

    def derivative(f: Callable[[Array], Array]) -> Callable[[Array], Array]:
        return lambda v: jax.jvp(f, (v,), (jnp.ones_like(v),))[1]

    second = derivative(derivative(lambda v: moving.local_force(0.0, zero, v)))
    B, C = second(zero), derivative(second)(zero)
    D = jnp.broadcast_to(sliding_damping(chain, jnp.asarray(belt_speed)), (chain.n,))
    K = stiffness_matrix(chain).astype(shape.dtype)

    size = jnp.sqrt((1.0 + frequency**2) * jnp.sum(jnp.abs(shape) ** 2))
    u = shape / size
    v = 1j * frequency * u
    # The velocities of the left eigenvector, of which the displacements follow.
    p = left / jnp.sum(left * (2j * frequency + D) * u)
    # (2 i omega - J)^-1 (0, f), its velocities.
    doubled = K - jnp.diag(4.0 * frequency**2 - 2j * frequency * D)
    response = 2j * frequency * jnp.linalg.solve(doubled, B * v * v)
    cubic = p * C * v * v * jnp.conj(v)
    quadratic = p * B * jnp.conj(v) * response
    return jnp.concatenate([cubic, quadratic]) / (2.0 * frequency)


def growth_slopes(
    chain: Chain,
    belt_speed: ScalarLike,
    frequency: ScalarLike,
    shape: Complex[Array, " {chain.n}"],
    left: Complex[Array, " {chain.n}"] | None = None,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """d Re(lambda) / d|v_d| at a Hopf point: that of the chain, and what dry friction adds to it.

    lambda' = -i omega l^T D' u / [l^T (2 i omega + D) u]; the second number has D' = p mu''.
    """
    left = shape if left is None else left
    speed = jnp.abs(jnp.asarray(belt_speed))
    one = jnp.ones_like(speed)
    D, slope = jax.jvp(lambda s: sliding_damping(chain, s), (speed,), (one,))
    _, dry = jax.jvp(lambda s: dry_damping(chain, s), (speed,), (one,))
    weight = left * shape / jnp.sum(left * (2j * frequency + D) * shape)
    return (
        jnp.real(jnp.sum(-1j * frequency * slope * weight)),
        jnp.real(jnp.sum(-1j * frequency * dry * weight)),
    )


def square_amplitude_slope(
    coefficient: ScalarLike,
    growth_slope: ScalarLike,
    frequency: ScalarLike,
    shape: Complex[Array, " n"],
) -> Float[Array, ""]:
    """d(A^2) / d|v_d| of the cycles that branch off a Hopf point, A the greatest amplitude.

    A = max_n |x_n - mean| = 2 |w| max|u| / (sqrt(1 + omega^2) |u|) to leading order, and
    |w|^2 = -alpha' (v_d - v_H) / (omega l1).  Positive: the cycles exist above the Hopf speed.
    """
    size = jnp.sum(jnp.abs(shape) ** 2) * (1.0 + frequency**2)
    largest = jnp.max(jnp.abs(shape)) ** 2
    return -4.0 * largest * growth_slope / (size * frequency * coefficient)


@final
class GeneralisedHopf(Outcome):
    """A Hopf point with l1 = 0, at `value` of the parameter; NaN unless `successful`.

    - `value` and `belt_speed`, dimensionless: where the fold ends upon the Hopf curve.
    - `result`: a `SearchResult`, no_meeting if l1 has one sign between `low` and `high`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.boundaries import generalised_hopf
        >>> chain = paper_chain(n=1)
        >>> meeting = generalised_hopf(chain, "width", 0.05, 1.0)
        >>> round(float(meeting.value), 3), round(float(meeting.belt_speed), 3)
        (0.349, 1.093)
        >>> generalised_hopf(chain, "width", 0.001, 0.01).message.split(",")[0]
        'The first Lyapunov coefficient does not change its sign between `low` and `high`'
    """

    value: Float[Array, ""]
    belt_speed: Float[Array, ""]
    result: SearchResult


def generalised_hopf(chain: Chain, parameter: Any, low: Any, high: Any) -> GeneralisedHopf:
    """The point of the Hopf curve of one mass at which l1 = 0, where the fold ends.

    Solves d(v_d) = 0, l1 = 0 in (v_d, parameter): ever finer grids between `low` and `high`, in
    the logarithm, enclose the last change of sign of l1 along `hopf_belt_speed`; Newton's method
    follows.

    **Arguments:** `chain` of one mass; `parameter`, the name of its number that varies, such as
    "damping_ratio", "mu_static" or "width"; `low`, `high`, positive, between which.

    **Returns:** both dimensionless numbers, differentiable in every other number of the chain.
    Works under `jit` and `vmap`.

    **Raises:** `ValueError` for a chain of several masses, an unknown name or a bad interval.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.boundaries import generalised_hopf
    >>> meeting = generalised_hopf(paper_chain(n=1), "width", 0.05, 1.0)
    >>> round(float(meeting.value), 3)  # with wider layers vibration sets in gently
    0.349
    """
    check_vibrating(chain, 0)
    if chain.n != 1:
        raise ValueError(f"Argument `chain` must have one mass, but has {chain.n}.")
    own = [name for name, row in CHAIN.items() if row.per == "mass"]
    known = {*own, *chain.friction.numbers(), "width"}
    check_one_of("parameter", parameter, sorted(known))
    for name, end in (("low", low), ("high", high)):
        check_positive_number(name, end, "the values in between are spaced by their logarithm.")
    if not is_traced(low, high) and float(low) >= float(high):
        raise ValueError(f"Argument `low` = {low} must be below `high` = {high}.")
    return _meeting(chain, parameter, jnp.asarray(low, float), jnp.asarray(high, float))


@eqx.filter_jit
def _meeting(chain: Chain, parameter: str, low: Array, high: Array) -> GeneralisedHopf:
    frozen = jax.tree.map(lax.stop_gradient, chain)

    def kind(logarithm: Array) -> Array:
        own = frozen.with_(**{parameter: jnp.exp(logarithm)})
        return _coefficient(own, hopf_belt_speed(own))

    def zoom(_: Any, now: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """The last interval of a grid over which l1 changes sign, or else the Hopf curve ends."""
        low, high, _ = now
        grid = jnp.linspace(low, high, _GRID)
        kinds = jax.vmap(kind)(grid)
        left, right = kinds[:-1], kinds[1:]
        changes = left * right <= 0  # false for NaN
        changed = jnp.any(changes)
        ends = jnp.isnan(left) != jnp.isnan(right)
        at = jnp.max(jnp.where(jnp.where(changed, changes, ends), jnp.arange(_GRID - 1), -1))
        return grid[at], grid[at + 1], changed

    ends = jnp.log(low), jnp.log(high), jnp.asarray(False)
    start, _, changed = lax.fori_loop(0, _ZOOMS, zoom, ends)
    value = jnp.exp(start)
    speed = hopf_belt_speed(frozen.with_(**{parameter: value}))
    unit = jnp.stack([value, speed])
    system = _System(parameter)
    begin = jnp.where(changed, jnp.ones(2), jnp.nan)
    known = jnp.where(jnp.isnan(begin * unit), 1.0, begin)
    root = newton(system.scaled, known, (frozen, unit), tolerance=_TOLERANCE)
    result = SearchResult.where(changed, root.result, SearchResult.no_meeting)
    found = changed & root.successful
    both = attach_derivative(system, jnp.where(found, root.value * unit, jnp.nan), chain)
    return GeneralisedHopf(value=both[0], belt_speed=both[1], result=result)


class _System(eqx.Module):
    """(d, l1) over (value of the parameter, belt speed)."""

    parameter: str = eqx.field(static=True)

    def __call__(self, u: Float[Array, "2"], chain: Chain) -> Float[Array, "2"]:
        own = chain.with_(**{self.parameter: u[0]})
        return jnp.stack([sliding_damping(own, u[1]), _coefficient(own, u[1])])

    def scaled(self, u: Float[Array, "2"], args: tuple[Chain, Array]) -> Float[Array, "2"]:
        chain, unit = args
        return self(u * unit, chain)


def _coefficient(chain: Chain, belt_speed: Array) -> Array:
    """l1 of one mass, whose modes are all alike."""
    one = jnp.ones(1, dtype=complex)
    return first_lyapunov_coefficient(chain, belt_speed, jnp.sqrt(chain.stiffness), one)
