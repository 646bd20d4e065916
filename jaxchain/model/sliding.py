"""Linear stability of steady sliding: damping, stiffness, eigenvalues.

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

from .._checks import as_array
from .._types import PerMass
from .arguments import as_chain
from .chain import Chain
from .tridiagonal import spring_matrix

# Range of belt speeds: from well inside the smoothed layer, or for dry friction from below any
# weakening of a law, to where friction no longer changes.
_LEAST_WIDTHS, _LEAST_SPEED, GREATEST_SPEED, _SPEEDS = 1e-2, 1e-11, 1e6, 1024
# Singular values below this, relative to the greatest, belong to modes that cross together.
_TOGETHER = 1e-8
# The rounding error of a sum of damping and weakening, relative to these.
_ROUNDING = 1e-12


def _one_speed(chain: Chain, belt_speed: Any) -> Float[Array, ""]:
    """The belt speed, one number; NaN, for a boundary that does not exist, is allowed."""
    as_chain(chain)
    return as_array("belt_speed", belt_speed, 0, 0, "use `jax.vmap` for several belt speeds.")


def has_uniform_damping(chain: Chain) -> bool:
    """Whether damping, friction and load are one number each, so that D = d I.

    Only the shapes count: numbers given per mass are treated as different.
    """
    numbers = [chain.damping_ratio, chain.load, *chain.friction.parameters().values()]
    return all(np.ndim(number) == 0 for number in numbers)


def sliding_damping(chain: Chain, belt_speed: Float[Array, ""]) -> PerMass:
    """The effective damping of steady sliding, d = 2 xi - p F'(-v_d), a number or of shape (n,).

    With F' = dF/dw of the smoothed law, d = 2 xi + p [mu'(v_d) tanh(v_d / eps) + mu(v_d)
    sech^2(v_d / eps) / eps], or 2 xi + p mu'(v_d) with dry friction: weakening makes it negative.

    **Arguments:** `belt_speed`, one dimensionless number, instead of that of the chain.

    **Returns:** a number, or of shape (n,) where parameters of the chain are given per mass.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.model.sliding import sliding_damping
    >>> round(float(sliding_damping(paper_chain(), jnp.asarray(0.5))), 6)  # 0.1 - 1/e
    -0.267879
    """
    belt_speed = _one_speed(chain, belt_speed)
    if chain.dry:
        return dry_damping(chain, belt_speed)
    _, slope = chain.friction.force_and_slope(-jnp.abs(belt_speed))
    return 2.0 * chain.damping_ratio - chain.load * slope


def dry_damping(chain: Chain, belt_speed: Float[Array, ""]) -> PerMass:
    """2 xi + p mu'(v_d), the `sliding_damping` without smoothing."""
    speed = jnp.abs(belt_speed)
    _, slope = jax.jvp(chain.law.coefficient, (speed,), (jnp.ones_like(speed),))
    return 2.0 * chain.damping_ratio + chain.load * slope


def least_belt_speed(chain: Chain) -> Float[Array, ""]:
    """The least belt speed of a search for changes."""
    return jnp.asarray(_LEAST_SPEED) if chain.dry else _LEAST_WIDTHS * jnp.min(chain.width)


def belt_speed_grid(chain: Chain) -> Float[Array, " speeds"]:
    """1024 belt speeds, equally spaced in the logarithm, for a search for changes."""
    least = jnp.log(least_belt_speed(chain))
    return jnp.exp(jnp.linspace(least, jnp.log(GREATEST_SPEED), _SPEEDS))


def damping_outweighs(chain: Chain) -> Bool[Array, ""]:
    """Whether 2 xi_n > p_n F'(w) for every mass at every relative velocity w.

    Then any two motions approach each other: the energy (v^T v + x^T K x) / 2 of their difference
    (x, v) falls at the rate sum_n v_n^2 (2 xi_n - p_n F'(w_n)) > 0, with w_n between their
    relative velocities.  So every motion approaches steady sliding, at any belt speed.

    A law whose friction falls at once at a release feeds energy into a mass there: never.

    F' = -mu'(s) tanh(s / eps) - mu(s) sech^2(s / eps) / eps, or -mu'(s) with dry friction (whose
    jump at w = 0 only adds damping), is bounded over each of the intervals between 1024 speeds s.
    This assumes that mu and mu' are monotone in each interval, as they are for every law of this
    package, except that mu of `WeakeningStrengthening` has a minimum in one of them.

    >>> from jaxchain import paper_chain
    >>> [bool(damping_outweighs(paper_chain(1).with_(damping_ratio=xi))) for xi in (0.4, 0.6)]
    [False, True]
    """
    speeds = jnp.concatenate([jnp.zeros(1), belt_speed_grid(chain)])

    def sample(speed: Array) -> tuple[Array, Array, Array, Array]:
        each = jnp.full(chain.n, speed)
        mu, slope = jax.jvp(chain.law.coefficient, (each,), (jnp.ones_like(each),))
        if chain.dry:
            return mu, slope, jnp.ones_like(each), jnp.zeros_like(each)
        ratio = each / chain.width
        # 1 - tanh^2 would lose digits, and cosh would overflow.
        half = jnp.exp(-ratio)
        return mu, slope, jnp.tanh(ratio), (2.0 * half / (1.0 + half**2)) ** 2 / chain.width

    mu, slope, rise, peak = jax.vmap(sample)(speeds)
    least = jnp.minimum(slope[:-1], slope[1:])
    weakening = least * jnp.where(least < 0, rise[1:], rise[:-1])
    change = weakening + jnp.minimum(mu[:-1], mu[1:]) * peak[1:]
    # One number, or one per mass, at each speed.
    damping = jnp.broadcast_to(2.0 * chain.damping_ratio, least.shape)
    load = jnp.broadcast_to(chain.load, least.shape)
    weakest = damping + load * change
    outweighs = jnp.all(weakest > _ROUNDING * (damping + load * jnp.abs(least)))
    drop = chain.law.drop()
    return outweighs if drop is None else outweighs & jnp.all(drop <= 0)


def stiffness_matrix(chain: Chain) -> Float[Array, "n n"]:
    """K, springs included: symmetric and positive definite.

    **Returns:** shape (n, n), dimensionless.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.model.sliding import stiffness_matrix
        >>> print(stiffness_matrix(paper_chain(4)))
        [[ 1.02 -0.01  0.   -0.01]
         [-0.01  1.02 -0.01  0.  ]
         [ 0.   -0.01  1.02 -0.01]
         [-0.01  0.   -0.01  1.02]]
    """
    n = as_chain(chain).n
    k = jnp.broadcast_to(chain.stiffness_diagonal(n), (n,))
    if chain.springs is None:
        return jnp.diag(k)
    return spring_matrix(chain.springs, n).shift(k).to_dense(n)


def sliding_eigenvalues(chain: Chain, belt_speed: Float[Array, ""]) -> Array:
    """All 2n eigenvalues lambda of steady sliding, complex, in no particular order.

    A disturbance grows as exp(lambda t); steady sliding is stable if every real part is negative.
    It uses `jnp.linalg.eigvals`, which JAX has for CPU and GPU, not for TPU.

    **Arguments:** `belt_speed`, one dimensionless number, instead of that of the chain.

    **Returns:** shape (2n,).

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.model.sliding import sliding_eigenvalues
        >>> chain = paper_chain(3, width=1e-2)
        >>> speeds = jnp.array([1.1, 1.2])  # on either side of the Hopf speed, 1.1513
        >>> [bool(sliding_eigenvalues(chain, v).real.max() > 0) for v in speeds]
        [True, False]
    """
    belt_speed = _one_speed(chain, belt_speed)
    n = chain.n
    damping = jnp.broadcast_to(sliding_damping(chain, belt_speed), (n,))
    top = jnp.concatenate([jnp.zeros((n, n)), jnp.eye(n)], axis=1)
    bottom = jnp.concatenate([-stiffness_matrix(chain), -jnp.diag(damping)], axis=1)
    return jnp.linalg.eigvals(jnp.concatenate([top, bottom]))


def growth_rate(chain: Chain, belt_speed: Float[Array, ""]) -> Float[Array, ""]:
    """The growth rate of disturbances of steady sliding; negative if sliding is stable.

    With uniform damping it is -d / 2, that of every mode that oscillates (of all of them near a
    Hopf point), which is smooth in v_d where the greatest real part of 2n equal ones is not.
    Otherwise it is the greatest real part of all eigenvalues.

    **Arguments:** `belt_speed`, one dimensionless number, instead of that of the chain.

    **Returns:** a number, in units of omega_n.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.model import growth_rate
    >>> round(float(growth_rate(paper_chain(), jnp.asarray(0.5))), 6)
    0.13394
    """
    belt_speed = _one_speed(chain, belt_speed)
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

    If several modes cross together, it is the projection of an arbitrary real vector: real if the
    null space has real vectors, so that u^T u is not 0, as it is for a travelling wave.
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
    complex symmetric, so conj u is its left null vector).  If several modes cross together, it is
    singular, and g = -u^T A u, which is correct to first order in the parameters.
    """
    chain, shape, together = parameters
    A = crossing_matrix(crossing, chain)
    corner = jnp.zeros((1, 1), A.dtype)
    bordered = jnp.block([[A, jnp.conj(shape)[:, None]], [jnp.conj(shape)[None, :], corner]])
    unit = jnp.zeros(chain.n + 1, A.dtype).at[-1].set(1.0)
    g = jnp.where(together, -shape @ A @ shape, jnp.linalg.solve(bordered, unit)[-1])
    return jnp.stack([jnp.real(g), jnp.imag(g)])
