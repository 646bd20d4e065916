"""Whether a Hopf bifurcation is super- or subcritical: the first Lyapunov coefficient.

The force on a mass depends on that mass's velocity only, so the second and third derivatives of
the vector field, as forms B and C, are B(a, b)_n = g_n'' a_n b_n and C(a, b, c)_n = g_n''' a_n b_n
c_n in the velocities, and nothing in the displacements.  They come from nested `jvp` and hold for
complex vectors, because they are multilinear.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from .._checks import as_array, shown
from .._types import ScalarLike
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..model.sliding import dry_damping, sliding_damping, stiffness_matrix


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

    >>> from jaxchain import paper_chain
    >>> jax.config.update("jax_enable_x64", True)
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
