"""One point of a branch of cycles: its linearisation, its multipliers, and what they cross.

A Jacobian of the shooting equations is one integration with the tangents of all 2n states and of
the parameter.  It holds the monodromy matrix, so that the stability of a point costs next to
nothing more, also that of an orbit with a symmetry, which has fewer equations.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .floquet import floquet_multipliers
from .least_period import Returns
from .limit_cycle import can_be_cycle, is_trusted
from .pushing import push
from .shooting import Shooting
from .variational import Along, flow

# How far from 1 a modulus may be where its test function vanishes.
_ON_THE_CIRCLE = 1e-4
# A multiplier is beyond the unit circle if it is by more than the integration may err.
_MARGIN = 1e-7
# A vibration this slow is none.  The equations are divided by it: nearer to zero they are noise.
_VANISHED = 1e-4


def count_unstable(multipliers: Complex[np.ndarray, "k others"]) -> Int[np.ndarray, " k"]:
    """How many multipliers of each cycle lie beyond the unit circle."""
    return np.sum(np.abs(multipliers) > 1.0 + _MARGIN, axis=1)


class CycleLinearisation(eqx.Module):
    """What `linearise` finds besides.

    - `x`, `v` (n,): the state on the section; `period`.
    - `speed`: of the mass where the orbit is cut, its greatest in the direction of the belt.
    - `times_round`: 2, 3, ... if the orbit closes after such a share of the period, else 1.
    - `amplitude` (n,): half peak-to-peak of each displacement over a period.
    - `monodromy` M = d(state after a period)/d(state), (2n, 2n), in the order (x, v).
    - `multipliers` (2n - 1,): the nontrivial ones, the greatest modulus first; `trivial_defect`
      = |M f - f| / |f|.
    - `sound`: whether it can be a cycle, and its trivial multiplier is 1.
    """

    x: Float[Array, " n"]
    v: Float[Array, " n"]
    period: Float[Array, ""]
    speed: Float[Array, ""]
    times_round: Int[Array, ""]
    amplitude: Float[Array, " n"]
    monodromy: Float[Array, "two_n two_n"]
    multipliers: Complex[Array, " others"]
    trivial_defect: Float[Array, ""]
    sound: Bool[Array, ""]


def linearise(
    u: Float[Array, " m"], parameter: Float[Array, ""], shooting: Shooting
) -> tuple[Float[Array, " m"], Float[Array, "m m_plus_1"], CycleLinearisation]:
    """(R, [R_u R_p], `CycleLinearisation`) of the shooting equations R, from one integration.

    With y = (x, v), y_1 the state after a period: dy_1 = M dy + f(y_1) dT + (dy_1/dp) dp, and dR
    follows from R = gap(u, y_1, p).
    """
    n, m = len(shooting.images), u.shape[0]
    z = jnp.append(u, parameter)

    def start(z: Array) -> Array:
        _, (x, v), period = shooting.unpack(z[:-1], z[-1])
        return jnp.concatenate([x, v, z[-1:], period[None]])

    def gap(both: Array) -> tuple[Array, Array]:
        u, p, y1 = both[:m], both[m], both[m + 1 :]
        r = shooting.gap(u, (y1[:n], y1[n:]), p)
        return r, r

    def rate(y: Array) -> Array:
        return jnp.concatenate(shooting.at(parameter)(0.0, (y[:n], y[n:])))

    y, inner = start(z), jax.jacfwd(start)(z)
    state, period = y[: 2 * n], y[-1]
    run = push(
        lambda y: (shooting.at(y[-1]), (y[:n], y[n:-1]), period), y[:-1],
        rtol=shooting.rtol, solver=shooting.solver, observers=[Along(), Returns()],
    )  # fmt: skip
    y1, ((amplitude, fastest, _), returned) = jnp.concatenate(run.end), run.observed
    outer = jnp.append(jnp.concatenate(run.slopes, axis=1), rate(y1)[None], axis=0).T
    slope, r = jax.jacfwd(gap, has_aux=True)(jnp.concatenate([z, y1]))
    jacobian = slope[:, : m + 1] + slope[:, m + 1 :] @ (outer @ inner)
    monodromy = outer[:, : 2 * n]
    found = floquet_multipliers(monodromy, rate(state))
    speed = shooting.at(parameter).belt_direction() * state[n + shooting.mass]
    sound = can_be_cycle(shooting.at(parameter), period, fastest)
    extra = CycleLinearisation(
        state[:n], state[n:], period, speed, returned.times_round, amplitude, monodromy,
        found.multipliers, found.defect, sound & is_trusted(found.multipliers, found.defect),
    )  # fmt: skip
    return r, jacobian, extra


@eqx.filter_jit
def orbit(
    u: Float[Array, " m"], parameter: Float[Array, ""], shooting: Shooting
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, ""], Float[Array, " n"]]:
    """(x, v, period, amplitude) of a solution, which `linearise` has of the iterate before it."""
    field, (x, v), period = shooting.unpack(u, parameter)
    _, _, ((amplitude, _, _),) = flow(
        field, (x, v), period, rtol=shooting.rtol, solver=shooting.solver,
        observers=[Along()],
    )  # fmt: skip
    return x, v, period, amplitude


def symmetry_breaking_basis(images: tuple[int, ...]) -> Float[np.ndarray, "two_n k"]:
    """An orthonormal basis of the disturbances (x, v) that break the symmetry of `images`."""
    own = np.asarray(images)[:, None] == np.unique(images)[None, :]
    rest = np.linalg.svd(own.astype(float))[0][:, own.shape[1] :]
    return np.kron(np.eye(2), rest)


def _signed(factors: Any) -> float:
    """Zero where one of the factors is: the least modulus, with the sign of their product.

    Linear in a factor that passes zero, whatever the others are; a product of dozens is not.
    """
    if factors.size == 0:
        return 1.0
    return float(np.sign(np.prod(np.sign(factors.real[factors.imag == 0]))) * np.min(abs(factors)))


def breaking(extra: CycleLinearisation, images: tuple[int, ...]) -> float:
    """Zero where a disturbance A that breaks the symmetry has a multiplier +1: of A^T M A - 1.

    M maps these onto themselves; the trivial multiplier belongs to those that do not.
    """
    basis = symmetry_breaking_basis(images)
    return _signed(np.linalg.eigvals(basis.T @ np.asarray(extra.monodromy) @ basis) - 1.0 + 0.0j)


def doubling(extra: CycleLinearisation) -> float:
    """Zero where a multiplier is -1."""
    return _signed(np.asarray(extra.multipliers) + 1.0)


def encircling(extra: CycleLinearisation) -> float:
    """Of |mu|^2 - 1 over pairs: it changes its sign as one leaves the unit circle.

    Pairs of real multipliers count, too, as mu_i mu_j - 1, so that the sign does not change where
    a pair becomes real.  Where such a factor vanishes nothing happens: `on_the_circle`.
    """
    mu: Any = np.asarray(extra.multipliers)
    real = mu[mu.imag == 0].real
    i, j = np.triu_indices(real.size, 1)
    pairs = np.abs(mu[mu.imag > 0]) ** 2 - 1.0
    return _signed(np.concatenate([pairs, real[i] * real[j] - 1.0]) + 0.0j)


def on_the_circle(extra: CycleLinearisation) -> bool:
    """Whether a complex pair of multipliers has modulus 1."""
    mu: Any = np.asarray(extra.multipliers)
    return bool(np.any(np.abs(np.abs(mu[mu.imag > 0]) - 1.0) < _ON_THE_CIRCLE))


def special_tests(shooting: Shooting) -> dict[str, Callable[..., float]]:
    """The tests of `continue_branch`: name -> function of (u, p, tangent, extra).

    "hopf": the amplitude vanishes, and the branch goes on as its own mirror image.
    """

    def vanishing(extra: CycleLinearisation) -> float:
        speed = float(extra.speed)
        return 0.0 if abs(speed) < _VANISHED else speed

    images = shooting.images
    of: dict[str, Callable[[Any], float]] = {"hopf": vanishing}
    if len(images) > 1:  # one mass has one multiplier besides the trivial one, never negative
        of |= {"period doubling": doubling, "torus": encircling}
    if len(set(images)) < len(images):
        of["symmetry breaking"] = lambda extra: breaking(extra, images)
    return {name: lambda u, p, tangent, extra, test=test: test(extra) for name, test in of.items()}
