"""Linear stability of steady sliding: damping, stiffness, eigenvalues (floor 3).

A disturbance x = u exp(lambda t) of steady sliding obeys the quadratic eigenvalue problem

    (lambda^2 + lambda D + K) u = 0,        D = diag(d_n),  d_n = 2 xi_n - p_n F'(-v_d),

with K symmetric and positive definite.  Nothing depends on the sign of v_d, because F' is even.
lambda = 0 is never an eigenvalue, so stability changes by pairs +-i omega only: by Hopf
bifurcations.  If all d_n are positive, sliding is stable; if all are negative, all modes grow.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float

from ._types import PerMass
from .chain import Chain

# Singular values below this, relative to the greatest, belong to modes that cross together.
_TOGETHER = 1e-8


def has_uniform_damping(chain: Chain) -> bool:
    """Whether damping, friction and load are one number each, so that D = d I.

    Told by the shapes alone: numbers that are given per mass count as different.
    """
    numbers = [
        chain.damping_ratio,
        chain.normal_load,
        chain.friction.width,
        *vars(chain.friction.law).values(),
    ]
    return all(jnp.ndim(number) == 0 for number in numbers if number is not None)


def sliding_damping(chain: Chain, belt_speed: Float[Array, ""]) -> PerMass:
    """d = 2 xi - p F'(-v_d) of one mass, or of shape (n,): what damps steady sliding.

    With F' = dF/dw of the smoothed law, d = 2 xi + p [mu'(v_d) tanh(v_d / eps) + mu(v_d)
    sech^2(v_d / eps) / eps]: weakening friction makes it negative.

    >>> from jaxchain import paper_chain
    >>> round(float(sliding_damping(paper_chain(), jnp.asarray(0.5))), 6)  # 0.1 - 1/e
    -0.267879
    """
    _, slope = chain.friction.force_and_slope(-jnp.abs(belt_speed))
    return 2.0 * chain.damping_ratio - _load(chain) * slope


def dry_damping(chain: Chain, belt_speed: Float[Array, ""]) -> PerMass:
    """2 xi + p mu'(v_d), what `sliding_damping` would be without smoothing."""
    speed = jnp.abs(belt_speed)
    _, slope = jax.jvp(chain.friction.law.coefficient, (speed,), (jnp.ones_like(speed),))
    return 2.0 * chain.damping_ratio + _load(chain) * slope


def _load(chain: Chain) -> Any:
    return 1.0 if chain.normal_load is None else chain.normal_load


def stiffness_matrix(chain: Chain) -> Float[Array, "n n"]:
    """K, springs included: symmetric and positive definite."""
    n = chain.n
    K = jnp.diag(jnp.broadcast_to(chain.stiffness_diagonal(n), (n,)))
    if chain.springs is None:
        return K
    # By products with constants, which compile in no time, where the convolutions of
    # `Springs.dense` take seconds in programs that need K in many places.
    before, after = np.roll(np.eye(n), -1, axis=1), np.roll(np.eye(n), 1, axis=1)
    lower, upper = chain.springs.off_diagonals(n)
    return K - lower[:, None] * before - upper[:, None] * after


def sliding_eigenvalues(chain: Chain, belt_speed: Float[Array, ""]) -> Array:
    """All 2n eigenvalues lambda of steady sliding, complex, in no particular order.

    By `jnp.linalg.eigvals`, which JAX has for CPU and GPU, not for TPU.
    """
    n = chain.n
    damping = jnp.broadcast_to(sliding_damping(chain, belt_speed), (n,))
    top = jnp.concatenate([jnp.zeros((n, n)), jnp.eye(n)], axis=1)
    bottom = jnp.concatenate([-stiffness_matrix(chain), -jnp.diag(damping)], axis=1)
    return jnp.linalg.eigvals(jnp.concatenate([top, bottom]))


def growth_rate(chain: Chain, belt_speed: Float[Array, ""]) -> Float[Array, ""]:
    """The rate at which a disturbance of steady sliding grows; negative where sliding is stable.

    With uniform damping it is -d / 2, that of every mode that oscillates (of all of them near a
    Hopf point), which is smooth in v_d where the greatest real part of 2n equal ones is not.
    Otherwise it is the greatest real part of all eigenvalues.

    >>> from jaxchain import paper_chain
    >>> round(float(growth_rate(paper_chain(), jnp.asarray(0.5))), 6)
    0.13394
    """
    if has_uniform_damping(chain):
        return -0.5 * jnp.reshape(sliding_damping(chain, belt_speed), ())
    return jnp.max(jnp.real(sliding_eigenvalues(chain, belt_speed)))


def crossing_matrix(
    crossing: Float[Array, " 2"], chain: Chain
) -> Complex[Array, "{chain.n} {chain.n}"]:
    """A = K - omega^2 + i omega D(v_d) at `crossing` = (v_d, omega): singular at a Hopf point."""
    speed, frequency = crossing
    damping = jnp.broadcast_to(sliding_damping(chain, speed), (chain.n,))
    real = stiffness_matrix(chain) - jnp.diag(jnp.full(chain.n, frequency**2))
    return lax.complex(real, frequency * jnp.diag(damping))


def null_shape(
    crossing: Float[Array, " 2"], chain: Chain
) -> tuple[Complex[Array, " {chain.n}"], Bool[Array, ""]]:
    """A unit null vector u of the crossing matrix, and whether there are several.

    Of several (modes that cross together) it is the projection of an arbitrary real vector: real
    if the null space has real vectors, so that u^T u, which is 0 for a travelling wave, is not.
    """
    _, sizes, right = jnp.linalg.svd(crossing_matrix(crossing, chain))
    null = sizes <= _TOGETHER * sizes[0]
    together = jnp.sum(null) > 1
    seed = jnp.cos(1.0 + 1.7 * jnp.arange(chain.n)).astype(right.dtype)
    projected = jnp.conj(right).T @ jnp.where(null, right @ seed, 0.0)
    shape = jnp.where(together, projected, jnp.conj(right[-1]))
    return shape / jnp.linalg.norm(shape), together


def crossing_residual(
    crossing: Float[Array, " 2"], parameters: tuple[Chain, Array, Array]
) -> Float[Array, " 2"]:
    """(Re g, Im g), which vanish exactly where A of `crossing_matrix` is singular.

    `parameters` = (chain, u, whether other modes cross with it).  g is the last unknown of the
    bordered system [[A, conj u], [u^H, 0]] [y; g] = [0; 1], which is regular at a simple crossing
    (Govaerts, Numerical Methods for Bifurcations of Dynamical Equilibria, section 3.3: A is
    complex symmetric, so conj u is its left null vector).  Where several modes cross together it
    is not, and g = -u^T A u, which is right to first order in the parameters.
    """
    chain, shape, together = parameters
    A = crossing_matrix(crossing, chain)
    corner = jnp.zeros((1, 1), A.dtype)
    bordered = jnp.block([[A, jnp.conj(shape)[:, None]], [jnp.conj(shape)[None, :], corner]])
    unit = jnp.zeros(chain.n + 1, A.dtype).at[-1].set(1.0)
    g = jnp.where(together, -shape @ A @ shape, jnp.linalg.solve(bordered, unit)[-1])
    return jnp.stack([jnp.real(g), jnp.imag(g)])
