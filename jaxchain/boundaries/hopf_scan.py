"""Every Hopf point of steady sliding in a range of belt speeds, and its criticality.

**Super- or subcritical?**  The sign of the first Lyapunov coefficient l1 decides.  The force on a
mass depends on that mass's velocity only, so the second and third derivatives of the vector field,
as forms B and C, are B(a, b)_n = g_n'' a_n b_n and C(a, b, c)_n = g_n''' a_n b_n c_n in the
velocities, and nothing in the displacements.  They come from nested `jvp` and hold for complex
vectors, because they are multilinear.

Where l1 = 0 the fold of cycles meets the Hopf point, the generalised Hopf (Bautin) point.  Along
the Hopf curve in the plane of the belt speed and another number, vibration sets in abruptly if l1
is positive, with a bistable range up to the fold; and gradually if l1 is negative, without a
fold.  At l1 = 0 the fold ends, tangentially to the Hopf curve (Kuznetsov, Elements of Applied
Bifurcation Theory, section 8.3).

For one mass l1 has the sign of F'''(-v_d).  Dry friction that weakens exponentially has F''' > 0
throughout, so that its fold and Hopf point meet only at v_d = 0.  Smoothed friction mu tanh(v_d /
eps) has a peak, and F''' < 0 up to a few widths beyond it:

    v_d = (eps / 2) ln[16 mu_st v_0^3 / ((mu_st - mu_d) eps^3)]  to leading order,

and the damping there is about p (mu_st - mu_d) / (2 v_0), that of dry friction at v_d = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Int
from scipy.optimize import root_scalar

from .._checks import (
    as_array,
    check_concrete,
    check_finite,
    check_kind,
    check_one_of,
    check_pair,
    check_positive_number,
    check_whole,
    is_traced,
    shown,
)
from .._final import final
from .._types import ArrayLike, Given, ScalarLike
from ..continuation.damped_newton import linearised, newton, solve
from ..continuation.implicit import attach_derivative
from ..cycles.limit_cycle import Guess
from ..model.arguments import as_chain, as_mass
from ..model.chain import Chain, map_numbers, steady_sliding
from ..model.initial_states import check_mass
from ..model.parameters import CHAIN
from ..model.sliding import (
    GREATEST_SPEED,
    crossing_matrix,
    crossing_residual,
    dry_damping,
    has_uniform_damping,
    least_belt_speed,
    null_shape,
    sliding_damping,
    stiffness_matrix,
)
from ..result import Outcome, Printed, SearchResult
from .hopf import hopf_belt_speed

_SAME = 1e-8  # relative difference of speeds and frequencies of one point


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

    The middle term is zero: a constant force displaces the masses but gives them no velocity. The
    size of l1 depends on the normalisation, here <q, q> = 1, Euclidean, over (x, v).  On the
    centre manifold (x, v) = w q + w* q*, and w' = (alpha + i omega) w + omega l1 w |w|^2, so that
    cycles of |w|^2 = -alpha / (omega l1) branch off; see `square_amplitude_slope`.

    **Arguments:** the Hopf point (|v_d| counts), `shape` = u, over the masses, of any length;
    `left`, the left null vector l of K - omega^2 + i omega D, l^T A = 0, by default u, which is
    right for a simple pair, A being complex symmetric.  For a wave that travels around a
    homogeneous ring, one of a pair q, -q, it is conj u; for a standing wave u, real.  Each of
    these waves lies in a subspace that is invariant by symmetry, so the formula holds for each.

    F is smooth except at w = 0, that is v_d = 0, which is not a Hopf point.

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


def _mode(name: str, mode: Any, n: int) -> Array:
    """A shape of n complex amplitudes; NaN, from a failed search, is allowed."""
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
    """Terms with Re(their sum) = l1, mass by mass; of shape (2 n,)."""
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
    # The velocities of the left eigenvector; the displacements follow from them.
    p = left / jnp.sum(left * (2j * frequency + D) * u)
    # (2 i omega - J)^-1 (0, f), its velocities.
    doubled = K - jnp.diag(4.0 * frequency**2 - 2j * frequency * D)
    response = 2j * frequency * jnp.linalg.solve(doubled, B * v * v)
    terms = [p * C * v * v * jnp.conj(v), p * B * jnp.conj(v) * response]
    return jnp.concatenate(terms) / (2.0 * frequency)


@eqx.filter_jit
def _numbers(
    chain: Chain, speed: Array, frequency: Array, u: Array, left: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """(l1, l1 over the sizes of its terms, growth slope, that of dry friction, d(A^2) / d|v_d|).

    - If a coefficient is exactly zero, the sum of its terms consists of rounding errors.
    - lambda' = -i omega l^T D' u / [l^T (2 i omega + D) u], and D' = p mu'' for dry friction.
    - A = max_n |x_n - mean| = 2 |w| max|u| / (sqrt(1 + omega^2) |u|) to leading order, A the
      greatest amplitude, and |w|^2 = -alpha' (v_d - v_H) / (omega l1).
    """
    terms = _terms(chain, speed, frequency, u, left)
    l1, size = jnp.real(jnp.sum(terms)), jnp.sum(jnp.abs(terms))
    one = jnp.ones_like(speed)
    D, changes = jax.jvp(lambda s: sliding_damping(chain, s), (speed,), (one,))
    _, dry = jax.jvp(lambda s: dry_damping(chain, s), (speed,), (one,))
    weight = left * u / jnp.sum(left * (2j * frequency + D) * u)
    slope, dry = (jnp.real(jnp.sum(-1j * frequency * d * weight)) for d in (changes, dry))
    square = jnp.sum(jnp.abs(u) ** 2) * (1.0 + frequency**2)
    rise = -4.0 * jnp.max(jnp.abs(u)) ** 2 * slope / (square * frequency * l1)
    return l1, l1 / jnp.where(size > 0, size, 1.0), slope, dry, rise


@final
class GeneralisedHopf(Outcome):
    """A Hopf point with l1 = 0, at `value` of the parameter; NaN unless `successful`.

    - `value` and `belt_speed`, dimensionless: the point at which the fold ends on the Hopf curve.
    - `result`: a `SearchResult`, no_meeting if l1 has one sign between `low` and `high`.

    See `generalised_hopf` for an example.
    """

    value: Float[Array, ""]
    belt_speed: Float[Array, ""]
    result: SearchResult


def generalised_hopf(
    chain: Chain, parameter: Given[str], low: Given[ScalarLike], high: Given[ScalarLike]
) -> GeneralisedHopf:
    """The generalised Hopf (Bautin) point of one mass: l1 = 0, the end of the fold.

    Solves d(v_d) = 0, l1 = 0 in (v_d, parameter): successively finer logarithmic grids between
    `low` and `high` bracket the last change of sign of l1 along `hopf_belt_speed`; then Newton's
    method converges.

    **Arguments:** `chain` of one mass; `parameter`, the name of the varied number, such as
    "damping_ratio", "mu_static" or "width"; `low`, `high`, its positive bounds.

    **Returns:** both dimensionless numbers, differentiable in every other parameter of the chain.
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
    check_mass(chain, 0)
    if chain.n != 1:
        raise ValueError(f"Argument `chain` must have one mass, but has {chain.n}.")
    per_mass = [name for name, row in CHAIN.items() if row.per == "mass"]
    names = {*per_mass, *chain.friction.parameters(), "width"}
    check_one_of("parameter", parameter, sorted(names))
    for name, end in (("low", low), ("high", high)):
        check_positive_number(name, end, "the values in between are spaced by their logarithm.")
    if not is_traced(low, high) and float(low) >= float(high):
        raise ValueError(f"Argument `low` = {low} must be below `high` = {high}.")
    return _meeting(chain, parameter, jnp.asarray(low, float), jnp.asarray(high, float))


@eqx.filter_jit
def _meeting(chain: Chain, parameter: str, low: Array, high: Array) -> GeneralisedHopf:
    fixed = jax.tree.map(lax.stop_gradient, chain)

    def coefficient(chain: Chain, belt_speed: Array) -> Array:
        """l1 of one mass, whose modes are all alike."""
        one = jnp.ones(1, dtype=complex)
        return first_lyapunov_coefficient(chain, belt_speed, jnp.sqrt(chain.stiffness), one)

    def l1_on_the_hopf_curve(logarithm: Array) -> Array:
        varied = fixed.with_(**{parameter: jnp.exp(logarithm)})
        return coefficient(varied, hopf_belt_speed(varied))

    def zoom(_: Any, now: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """The last interval of a grid in which l1 changes sign, or in which the curve ends."""
        low, high, _ = now
        grid = jnp.linspace(low, high, 48)
        kinds = jax.vmap(l1_on_the_hopf_curve)(grid)
        left, right = kinds[:-1], kinds[1:]
        changes = left * right <= 0  # false for NaN
        changed = jnp.any(changes)
        ends = jnp.isnan(left) != jnp.isnan(right)
        at = jnp.max(jnp.where(jnp.where(changed, changes, ends), jnp.arange(47), -1))
        return grid[at], grid[at + 1], changed

    def system(u: Float[Array, "2"], args: tuple[Chain, Array]) -> Float[Array, "2"]:
        """(d, l1) over (value of the parameter, belt speed), in units."""
        chain, unit = args
        value, speed = u * unit
        varied = chain.with_(**{parameter: value})
        return jnp.stack([sliding_damping(varied, speed), coefficient(varied, speed)])

    # For a small width the zero of l1 lies close to the end of the Hopf curve.
    ends = jnp.log(low), jnp.log(high), jnp.asarray(False)
    start, _, changed = lax.fori_loop(0, 5, zoom, ends)
    value = jnp.exp(start)
    unit = jnp.stack([value, hopf_belt_speed(fixed.with_(**{parameter: value}))])
    # The error of third derivatives at a width eps is rounding over eps^3.
    root = newton(system, jnp.ones(2), (fixed, unit), tolerance=1e-8)
    result = SearchResult.where(changed, root.result, SearchResult.no_meeting)
    value = jnp.where(changed & root.successful, root.value, jnp.nan)
    value, speed = attach_derivative(system, value, (chain, unit)) * unit
    return GeneralisedHopf(value=value, belt_speed=speed, result=result)


class Crossing(NamedTuple):
    """|v_d|, omega, u, the wavenumber (NaN outside a ring), how many modes cross with this one."""

    speed: float
    frequency: float
    shape: np.ndarray
    wavenumber: float
    multiplicity: int


def find_crossings(chain: Chain, least: float, greatest: float) -> Iterator[Crossing]:
    """Every crossing at speeds |v_d| from `least` to `greatest`; `hopf_points` has the proof.

    It needs concrete numbers.  **Raises:** `RuntimeError` if counts of eigenvalues contradict the
    crossings found, or if an eigenvalue stays on the axis.
    """
    n, K = chain.n, np.asarray(stiffness_matrix(chain))
    if has_uniform_damping(chain):
        modes = list(_modes(chain, K))
        for speed in _roots(chain, 0, least, greatest):
            yield from (Crossing(speed, *mode) for mode in modes)
    elif chain.springs is None or n == 1:  # uncoupled masses
        for mass in range(n):
            for speed in _roots(chain, mass, least, greatest):
                yield Crossing(speed, float(np.sqrt(K[mass, mass])), np.eye(n)[mass], np.nan, 1)
    else:
        yield from _coupled(chain, K, least, greatest)


def _modes(chain: Chain, K: np.ndarray) -> Iterator[tuple[float, np.ndarray, float, int]]:
    """(omega, u, wavenumber, multiplicity) of each mode of K."""
    n, springs = chain.n, chain.springs
    ring = springs is not None and springs.ends == "cyclic" and springs.constant.ndim == 0
    if ring and chain.stiffness.ndim == 0:
        for m in range(n // 2 + 1):
            q = 2.0 * np.pi * m / n
            wave = np.exp(1j * q * np.arange(n))
            square = (K[0] * wave).sum().real
            yield float(np.sqrt(square)), wave, q, 1 if 2 * m in (0, n) else 2
        return
    # The modes of a diagonal matrix are single masses.
    squares, shapes = np.linalg.eigh(K)
    for j in range(n):
        same = 1 if springs is None else int((np.abs(squares / squares[j] - 1.0) <= _SAME).sum())
        yield float(np.sqrt(squares[j])), shapes[:, j], np.nan, same


def _roots(chain: Chain, mass: int, least: float, greatest: float) -> Iterator[float]:
    """Belt speeds at which d of one mass vanishes."""

    def damping(speed: float) -> float:
        return float(_damping(chain, np.array([speed]))[0, mass])

    for low, high in _unproven(chain, least, greatest, mass=mass):
        at_low, at_high = damping(low), damping(high)
        if at_low == 0.0:
            yield low
        elif at_high != 0.0 and (at_low > 0) != (at_high > 0):
            yield float(root_scalar(damping, bracket=(low, high), xtol=1e-300, rtol=1e-15).root)


def _unproven(
    chain: Chain,
    least: float,
    greatest: float,
    mass: int | None = None,
    K: np.ndarray | None = None,
) -> list[tuple[float, float]]:
    """Short intervals, in order, that contain all crossings: d of `mass`, or eigenvalues.

    Intervals whose ends are 1.1 times each other are halved down to 1e-5 of the speed.
    """
    start, samples = float(least_belt_speed(chain)), 17
    count = max(2, 1 + int(np.ceil(np.log(max(greatest / start, 1.0)) / np.log(1.1))))
    inner = np.geomspace(start, max(greatest, 2.0 * start), count)
    edges = np.array([least, *inner[(inner > least) & (inner < greatest)], greatest])
    low, high = edges[:-1], edges[1:]
    left: list[tuple[float, float]] = []
    while low.size:
        points = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, samples)
        d = _damping(chain, points.ravel()).reshape(low.size, samples, chain.n)
        if mass is not None:
            d = d[:, :, mass : mass + 1]
        middle = d[:, samples // 2]
        change = 1.5 * np.abs(d - middle[:, None]).max(axis=1)  # half as much again, for safety
        # All positive: stable. All negative: every mode grows. Neither changes inside.
        proven = (middle > change).all(axis=1) | (middle < -change).all(axis=1)
        proven |= (change == 0.0).all(axis=1)
        if K is not None:
            for i in np.flatnonzero(~proven):
                proven[i] = not _reaches_axis(K, middle[i], change[i].max())
        short = high - low <= 1e-5 * high
        left += zip(low[~proven & short], high[~proven & short], strict=True)
        low, high = low[~proven & ~short], high[~proven & ~short]
        if low.size > 5000:
            raise RuntimeError(
                f"An eigenvalue of `chain` stays on the imaginary axis from {low.min()} to "
                f"{high.max()}, or close by: a mode without damping, for which Hopf points are "
                "not defined. Give every mass some damping, or narrow `belt_speeds`."
            )
        centre = 0.5 * (low + high)
        low, high = np.concatenate([low, centre]), np.concatenate([centre, high])
    return [(float(a), float(b)) for a, b in sorted(left)]


def _reaches_axis(K: np.ndarray, damping: np.ndarray, change: float) -> bool:
    """Whether some |E| <= `change` might put an eigenvalue of K and D + E on the imaginary axis.

    1 / change is a singular value of i omega (K - omega^2 + i omega D)^-1 for some omega if and
    only if this Hamiltonian matrix has the eigenvalue i omega.
    """
    n = damping.size
    zero, one = np.zeros((n, n)), np.eye(n)
    J = np.block([[zero, one], [-K, -np.diag(damping)]])
    force = np.block([[zero, zero], [zero, change * one]])
    values = np.linalg.eigvals(np.block([[J, force], [-force, -J.T]]))
    # Rounding moves a double imaginary eigenvalue off the axis by the square root of the rounding.
    return bool((np.abs(values.real) <= 1e-7 * np.abs(values).max()).any())


def _coupled(chain: Chain, K: np.ndarray, least: float, greatest: float) -> Iterator[Crossing]:
    """Crossings of a chain whose damping differs from mass to mass."""
    n = chain.n

    def eigenvalues(speed: float) -> np.ndarray:
        D = np.diag(_damping(chain, np.array([speed]))[0])
        return np.linalg.eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [-K, -D]]))

    def same(a: float, b: float) -> bool:
        return abs(a - b) <= _SAME * abs(a)

    clusters: list[list[tuple[float, float]]] = []
    for low, high in _unproven(chain, least, greatest, K=K):
        if clusters and low <= clusters[-1][-1][1] * (1.0 + 1e-12):
            clusters[-1].append((low, high))
        else:
            clusters.append([(low, high)])

    for cluster in clusters:
        first, last = cluster[0][0], cluster[-1][1]
        points: list[Crossing] = []
        for low, high in cluster:
            centre, margin = 0.5 * (low + high), high - low
            d = _damping(chain, np.array([low, centre, high]))
            values: Any = eigenvalues(centre)
            near = np.abs(values.real) <= 10.0 * np.abs(d - d[1]).max()
            for value in values[near & (values.imag > 0)]:
                z, shape, size, count = _refined(chain, jnp.array([centre, value.imag]))
                speed, frequency = map(float, z)
                inside = max(first, low - margin) <= speed <= min(last, high + margin)
                new = not any(
                    same(speed, c.speed) and same(frequency, c.frequency) for c in points
                )
                if inside and new and frequency > 0 and float(size) <= 1e-10:  # singular
                    shape = np.asarray(shape)
                    points.append(Crossing(speed, frequency, shape, np.nan, int(count)))
        # The crossings must explain the change of the number of unstable pairs.
        unstable = [int((np.real(eigenvalues(speed)) > 0).sum()) // 2 for speed in (first, last)]
        gained = sum(c.multiplicity * _growth_direction(chain, c) for c in points)
        if first > least and last < greatest and unstable[1] - unstable[0] != gained:
            raise RuntimeError(
                f"Between the belt speeds {first} and {last} the number of growing modes changes "
                f"from {unstable[0]} to {unstable[1]}, but the {len(points)} Hopf points found "
                f"there make that {gained:+d}. Two may be too close to tell apart: change a "
                "parameter a little, and please report these."
            )
        yield from points


def _growth_direction(chain: Chain, crossing: Crossing) -> int:
    """+1 if the mode begins to grow as the speed grows, -1 if it ceases to."""
    speed, omega, u = crossing.speed, crossing.frequency, crossing.shape
    D, up, down = _damping(chain, speed * np.array([1.0, 1.0 + 1e-7, 1.0 - 1e-7]))
    slope = (u * u * (up - down)).sum() / (u * u * (2j * omega + D)).sum()
    return 1 if complex(-1j * omega * slope).real > 0 else -1


@eqx.filter_jit
def _refined(chain: Chain, start: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Newton's method: ((v_d, omega), u, relative least singular value, null vectors)."""

    weights = jnp.ones(2)

    def residual(z: jax.Array) -> jax.Array:
        return crossing_residual(z, (chain, *null_shape(lax.stop_gradient(z), chain)))

    z, _, _ = solve(linearised(residual, weights), start, weights, 1e-9, 30)
    shape, _ = null_shape(z, chain)
    sizes = jnp.linalg.svd(crossing_matrix(z, chain), compute_uv=False)
    return z, shape, sizes[-1] / sizes[0], jnp.sum(sizes <= _SAME * sizes[0])


def _damping(chain: Chain, speeds: np.ndarray) -> np.ndarray:
    """d_n at each of the speeds, of shape (speeds, n)."""
    size = 1 << max(4, int(np.ceil(np.log2(speeds.size))))  # few shapes, few compilations
    padded = np.concatenate([speeds, np.full(size - speeds.size, speeds[-1])])
    return np.asarray(_damping_at(chain, jnp.asarray(padded)))[: speeds.size]


@eqx.filter_jit
def _damping_at(chain: Chain, speeds: jax.Array) -> jax.Array:
    return jax.vmap(lambda v: jnp.broadcast_to(sliding_damping(chain, v), (chain.n,)))(speeds)


@final
class HopfPoints(Printed, eqx.Module):
    """Hopf points, sorted by belt speed, then frequency; every field has one entry per point.

    - `belt_speed`, `frequency` = omega; `mode_shape` = u, complex, greatest entry 1: a
      disturbance moves as Re[u exp(i omega t)].
    - `wavenumber`: q = 2 pi m / n, m = 0 ... n // 2, of the wave u_n = exp(i q n) in a homogeneous
      ring; NaN elsewhere.
    - `multiplicity`: the number of modes that cross at this speed and frequency: 2 for a pair q,
      -q.
    - `growth_slope`: d Re(lambda) / d|v_d|.
    - `direction`: "falling speed" if the mode starts to grow as |v_d| falls, else "growing speed".
    - `lyapunov_coefficient` = l1 as in `first_lyapunov_coefficient`, of the travelling wave where
      there is a pair q, -q; `standing_lyapunov_coefficient`, that of the standing wave cos(q n),
      and the same as l1 where there is no pair.  NaN, and `criticality` "undetermined", where
      several modes cross together at one frequency in a chain that is not a homogeneous ring.
    - `criticality`, `standing_criticality`: "supercritical" (stable cycles grow out of the point,
      small at first), "subcritical" (unstable ones, and a jump) or "degenerate" (l1 = 0).
    - `square_amplitude_slope`, `standing_square_amplitude_slope`: d(A^2) / d|v_d| of the cycles
      that branch off, A the greatest amplitude of a mass.
    - `belt_speeds`: (low, high), the range in which every Hopf point is listed.
    - `kind`: "weakening friction", the physical one; or "rising flank of the smoothed law", an
      artefact of smoothing at a speed of a few widths, below which the masses creep with the belt
      instead of sticking.

    In a homogeneous chain all n modes cross at one belt speed; each coefficient then is that of
    one wave alone.  Its cycles are cycles of the full chain while their growth is slow compared
    with the differences of the frequencies.  If 4 q is a multiple of 2 pi there is a second
    standing wave, cos(q (n + 1/2)), with another coefficient.

    See `hopf_points` for an example.
    """

    belt_speed: Float[Array, " points"]
    frequency: Float[Array, " points"]
    mode_shape: Complex[Array, "points n"]
    wavenumber: Float[Array, " points"]
    multiplicity: Int[Array, " points"]
    growth_slope: Float[Array, " points"]
    lyapunov_coefficient: Float[Array, " points"]
    standing_lyapunov_coefficient: Float[Array, " points"]
    square_amplitude_slope: Float[Array, " points"]
    standing_square_amplitude_slope: Float[Array, " points"]
    direction: tuple[str, ...] = eqx.field(static=True)
    criticality: tuple[str, ...] = eqx.field(static=True)
    standing_criticality: tuple[str, ...] = eqx.field(static=True)
    kind: tuple[str, ...] = eqx.field(static=True)
    belt_speeds: tuple[float, float] = eqx.field(static=True)


def hopf_points(chain: Chain, belt_speeds: Given[ArrayLike] = (0.0, GREATEST_SPEED)) -> HopfPoints:
    """Every Hopf point of steady sliding at belt speeds between `belt_speeds` = (low, high).

    The default upper bound is 1e6, as in `hopf_belt_speed`.

    **Why none is missed:** in an interval of belt speeds over which no d_n changes by more than
    delta from its value in the middle, no eigenvalue crosses the imaginary axis if the least
    singular value of D + (K - omega^2) / (i omega) in the middle exceeds delta for every omega;
    that is |d| > delta for uniform damping, and otherwise holds if and only if a Hamiltonian
    matrix of order 4 n has no imaginary eigenvalue (Boyd, Balakrishnan, Kabamba, Math. Control
    Signals Systems 2 (1989)).  Intervals without this proof are halved down to 1e-5 of the speed,
    searched by Newton's method from every eigenvalue near the axis, and the number of unstable
    eigenvalues on either side is compared.  Two assumptions remain: d_n is sampled 17 times in
    intervals of at most a tenth of the speed, so a law must not have narrower features; and two
    points of opposite direction within 1e-5 of each other may be missed.

    **Returns:** `HopfPoints`; at negative belt speeds the mirror image of those at positive ones.
    It needs concrete numbers and does not work under `jit`; `hopf_belt_speed` does.

    **Raises:** `ValueError` for a traced chain or an impossible range; `RuntimeError` without
    64-bit floats, or if the number of unstable eigenvalues contradicts the points found.

    >>> from jaxchain import paper_chain
    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.boundaries import hopf_points
    >>> points = hopf_points(paper_chain(4), (0.1, 5.0))
    >>> [round(float(v), 4) for v in points.belt_speed]
    [1.1513, 1.1513, 1.1513]
    >>> points.criticality[0], points.direction[0], points.kind[0]
    ('subcritical', 'falling speed', 'weakening friction')
    """
    as_chain(chain)
    check_concrete("use `hopf_belt_speed`.", chain=chain, belt_speeds=belt_speeds)
    low, high = check_pair("belt_speeds", belt_speeds, "the default is (0, 1e6).")
    check_finite("belt_speeds", (low, high), "the default is (0, 1e6).")
    simple = _simplified(chain)
    least = 0.0 if low <= 0 <= high else min(abs(low), abs(high))
    rows = []
    for crossing in find_crossings(simple, least, max(abs(low), abs(high))):
        row = _described(simple, crossing)
        signed = (crossing.speed, -crossing.speed)
        rows += [{**row, "belt_speed": v} for v in signed if low <= v <= high]
    rows.sort(key=lambda row: (row["belt_speed"], row["frequency"]))
    names = [name for name in HopfPoints.__dataclass_fields__ if name != "belt_speeds"]
    columns: dict[str, Any] = {name: [row[name] for row in rows] for name in names}
    for name, kind in HopfPoints.__annotations__.items():
        if kind.startswith("tuple"):
            columns[name] = (low, high) if name == "belt_speeds" else tuple(columns[name])
        else:
            dtype = {"mode_shape": complex, "multiplicity": int}.get(name, float)
            shape = (-1, chain.n) if name == "mode_shape" else (-1,)
            columns[name] = jnp.asarray(np.array(columns[name], dtype).reshape(shape))
    return HopfPoints(**columns)


def _simplified(chain: Chain) -> Chain:
    """The same chain; equal parameters per mass become one, and zero springs are removed."""

    def one(value: Array) -> Array:
        if jnp.ndim(value) == 0 or not bool(jnp.all(value == value[0])):
            return value
        return value[0]

    chain = map_numbers(one, chain)
    if chain.coupling is not None and (chain.n == 1 or not bool(jnp.any(chain.coupling))):
        chain = chain.with_(coupling=None)
    return chain


def _described(chain: Chain, crossing: Crossing) -> dict[str, Any]:
    speed, frequency, shape, wavenumber, multiplicity = crossing
    size = np.abs(shape)
    shape = shape / shape[np.argmax(size > (1.0 - 1e-9) * size.max())]  # the first of equals
    pair = multiplicity == 2 and not np.isnan(wavenumber)
    shapes = [(shape, np.conj(shape) if pair else shape)]
    if pair:
        standing = np.cos(wavenumber * np.arange(chain.n))
        shapes.append((standing, standing))
    at = jnp.asarray(speed), jnp.asarray(frequency)
    waves = [_numbers(chain, *at, *jnp.asarray(both, complex)) for both in shapes]
    _, _, slope, dry, _ = waves[0]
    row = {
        "frequency": frequency,
        "mode_shape": shape,
        "wavenumber": wavenumber,
        "multiplicity": multiplicity,
        "growth_slope": float(slope),
        "direction": "falling speed" if slope < 0 else "growing speed",
        # For dry friction the mode would not begin to grow as the speed grows.
        "kind": "rising flank of the smoothed law" if slope > 0 >= dry else "weakening friction",
    }
    for prefix, wave in (("", waves[0]), ("standing_", waves[-1])):
        l1, relative, _, _, rise = map(float, wave)
        if multiplicity > 1 and not pair:  # the combination of the modes is undetermined
            l1 = relative = rise = np.nan
        row |= {
            f"{prefix}lyapunov_coefficient": l1,
            f"{prefix}square_amplitude_slope": rise,
            f"{prefix}criticality": _criticality(relative),
        }
    return row


def _criticality(relative: float) -> str:
    if np.isnan(relative):
        return "undetermined"
    if abs(relative) <= 1e-9:  # zero up to rounding
        return "degenerate"
    return "supercritical" if relative < 0 else "subcritical"


def guess_from_hopf(
    chain: Chain,
    points: HopfPoints,
    index: int = 0,
    amplitude: Given[ScalarLike | None] = None,
    mass: int | None = None,
) -> Guess:
    """The small cycle that branches off Hopf point `index` of `points`, at the chain's belt speed.

    x = x_s + A Re[u exp(i omega t)], when mass `mass` (by default the one that moves most)
    is fastest in the direction of the belt.

    **Arguments:** `points` from `hopf_points(chain, ...)`; `amplitude` = A > 0 of displacement, of
    the mass that moves most, by default what `square_amplitude_slope` predicts.

    **Returns:** ((x, v), period), as `find_limit_cycle` takes them; x and v of shape (n,).

    **Raises:** `ValueError` if there is no such point, or no small cycle at this belt speed: a
    subcritical cycle exists on the stable side of its point.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.boundaries import guess_from_hopf, hopf_points
    >>> chain = paper_chain(1, belt_speed=1.2)
    >>> (x, v), period = guess_from_hopf(chain, hopf_points(chain, (1.0, 2.0)))
    >>> round(float(v[0]), 3), round(float(period), 3)
    (0.441, 6.283)
    """
    as_chain(chain)
    remedy = "`hopf_points(chain)` makes them."
    check_kind("points", points, HopfPoints, "the `HopfPoints` of the chain", remedy)
    count = len(points.kind)
    check_whole("index", index, 0, count - 1, "it is that of a Hopf point.")
    shape, omega = points.mode_shape[index], points.frequency[index]
    if amplitude is None:
        past = jnp.abs(chain.belt_speed) - jnp.abs(points.belt_speed[index])
        square = points.square_amplitude_slope[index] * past
        if not is_traced(square) and not square > 0:
            raise ValueError(
                f"Argument `chain` has belt speed {float(chain.belt_speed):g}, but the small "
                f"cycles at the Hopf point of {float(points.belt_speed[index]):g} lie on its "
                "other side, or its Lyapunov coefficient is not known. Change `belt_speed`, or "
                "give an `amplitude`."
            )
        amplitude = jnp.sqrt(square)
    check_positive_number("amplitude", amplitude, "0.1 is usual.")
    mass = as_mass(chain.n, mass)
    mass = int(jnp.argmax(jnp.abs(shape))) if mass is None else mass
    moving = 1j * omega * shape
    phase = chain.belt_direction() * jnp.conj(moving[mass]) / jnp.abs(moving[mass])
    x, _ = steady_sliding(chain)
    disturbed = x + amplitude * jnp.real(shape * phase)
    return (disturbed, amplitude * jnp.real(moving * phase)), 2 * jnp.pi / omega
