"""Where eigenvalues of sliding cross the imaginary axis: by proof of where not."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.optimize import root_scalar

from ..continuation.damped_newton import linearised, solve
from ..model.chain import Chain
from ..model.sliding import (
    crossing_matrix,
    crossing_residual,
    has_uniform_damping,
    least_belt_speed,
    null_shape,
    sliding_damping,
    stiffness_matrix,
)

_RATIO = 1.1  # of an interval's ends
_SAMPLES, _SAFETY = 17, 1.5  # per interval, and on the greatest change of d among them
_RESOLUTION = 1e-5  # relative length of an interval that is searched, no longer divided
_MOST_INTERVALS = 5000  # of a chain whose eigenvalues cross the axis, and do not move along it
# Newton's last step, and how many at most; what is singular, and what is the same.
_CLOSE, _MOST, _SINGULAR, _SAME = 1e-9, 30, 1e-10, 1e-8


class Crossing(NamedTuple):
    """|v_d|, omega, u, the wavenumber (NaN outside a ring), how many modes cross with this one."""

    speed: float
    frequency: float
    shape: np.ndarray
    wavenumber: float
    multiplicity: int


def find_crossings(chain: Chain, least: float, greatest: float) -> Iterator[Crossing]:
    """Every crossing at speeds |v_d| from `least` to `greatest`; `hopf_points` has the proof.

    Concrete numbers only.  **Raises:** `RuntimeError` if counts of eigenvalues contradict what was
    found, or if an eigenvalue stays on the axis.
    """
    n, K = chain.n, np.asarray(stiffness_matrix(chain))
    if has_uniform_damping(chain):
        modes = list(_modes(chain, K))
        for speed in _roots(chain, 0, least, greatest):
            for frequency, shape, wavenumber, multiplicity in modes:
                yield Crossing(speed, frequency, shape, wavenumber, multiplicity)
    elif chain.springs is None or n == 1:  # no mass knows of the others
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
            square = (K[0] * np.exp(1j * q * np.arange(n))).sum().real
            yield float(np.sqrt(square)), wave, q, 1 if 2 * m in (0, n) else 2
        return
    # Of a diagonal matrix these are single masses.
    squares, shapes = np.linalg.eigh(K)
    for j in range(n):
        same = np.abs(squares - squares[j]) <= _SAME * squares[j]
        alone = springs is None
        yield float(np.sqrt(squares[j])), shapes[:, j], np.nan, 1 if alone else int(same.sum())


def _roots(chain: Chain, mass: int, least: float, greatest: float) -> list[float]:
    """Belt speeds at which d of one mass vanishes."""

    def damping(speed: float) -> float:
        return float(_damping(chain, np.array([speed]))[0, mass])

    found = []
    for low, high in _unproven(chain, least, greatest, mass=mass):
        at_low, at_high = damping(low), damping(high)
        if at_low == 0.0:
            found.append(low)
        elif at_high != 0.0 and (at_low > 0) != (at_high > 0):
            root = root_scalar(damping, bracket=(low, high), xtol=1e-300, rtol=1e-15).root
            found.append(float(root))
    return found


def _unproven(
    chain: Chain,
    least: float,
    greatest: float,
    mass: int | None = None,
    K: np.ndarray | None = None,
) -> list[tuple[float, float]]:
    """Short intervals, in order, outside of which nothing crosses: d of `mass`, or eigenvalues."""
    start = float(least_belt_speed(chain))
    count = max(2, 1 + int(np.ceil(np.log(max(greatest / start, 1.0)) / np.log(_RATIO))))
    inner = np.geomspace(start, max(greatest, 2.0 * start), count)
    edges = np.array([least, *inner[(inner > least) & (inner < greatest)], greatest])
    low, high = edges[:-1], edges[1:]
    left: list[tuple[float, float]] = []
    while low.size:
        parts = np.linspace(0.0, 1.0, _SAMPLES)
        points = low[:, None] + (high - low)[:, None] * parts
        d = _damping(chain, points.ravel()).reshape(low.size, _SAMPLES, chain.n)
        if mass is not None:
            d = d[:, :, mass : mass + 1]
        middle = d[:, _SAMPLES // 2]
        change = _SAFETY * np.abs(d - middle[:, None]).max(axis=1)
        # All positive: stable. All negative: every mode grows. Neither changes inside.
        proven = (middle > change).all(axis=1) | (middle < -change).all(axis=1)
        proven |= (change == 0.0).all(axis=1)
        if K is not None:
            for i in np.flatnonzero(~proven):
                proven[i] = not _reaches_axis(K, middle[i], change[i].max())
        short = high - low <= _RESOLUTION * high
        left += zip(low[~proven & short], high[~proven & short], strict=True)
        low, high = low[~proven & ~short], high[~proven & ~short]
        if low.size > _MOST_INTERVALS:
            raise RuntimeError(
                f"An eigenvalue of `chain` stays on the imaginary axis from {low.min()} to "
                f"{high.max()}, or close by: a mode without damping, where Hopf points mean "
                "nothing. Give every mass some damping, or narrow `belt_speeds`."
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
    # Rounding moves a double imaginary eigenvalue off the axis by the root of it.
    return bool((np.abs(values.real) <= 1e-7 * np.abs(values).max()).any())


def _coupled(chain: Chain, K: np.ndarray, least: float, greatest: float) -> Iterator[Crossing]:
    """Crossings of a chain whose damping differs from mass to mass."""
    n = chain.n

    def eigenvalues(speed: float) -> np.ndarray:
        D = np.diag(_damping(chain, np.array([speed]))[0])
        return np.linalg.eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [-K, -D]]))

    clusters: list[list[tuple[float, float]]] = []
    for low, high in _unproven(chain, least, greatest, K=K):
        if clusters and low <= clusters[-1][-1][1] * (1.0 + 1e-12):
            clusters[-1].append((low, high))
        else:
            clusters.append([(low, high)])

    for cluster in clusters:
        first, last = cluster[0][0], cluster[-1][1]
        found: list[Crossing] = []
        for low, high in cluster:
            centre, margin = 0.5 * (low + high), high - low
            d = _damping(chain, np.array([low, centre, high]))
            near = 10.0 * np.abs(d - d[1]).max()
            for value in eigenvalues(centre):
                if value.imag <= 0 or abs(value.real) > near:
                    continue
                (speed, frequency), shape, size, count = _refined(
                    chain, jnp.array([centre, value.imag])
                )
                speed, frequency = float(speed), float(frequency)
                new = all(
                    abs(speed - c.speed) > _SAME * speed
                    or abs(frequency - c.frequency) > _SAME * frequency
                    for c in found
                )
                inside = max(first, low - margin) <= speed <= min(last, high + margin)
                if inside and new and frequency > 0 and float(size) <= _SINGULAR:
                    found.append(Crossing(speed, frequency, np.asarray(shape), np.nan, int(count)))
        # What has crossed must be what there is: pairs to the right of the axis, on either side.
        unstable = [int((np.real(eigenvalues(speed)) > 0).sum()) // 2 for speed in (first, last)]
        gained = sum(c.multiplicity * _turns(chain, c) for c in found)
        if first > least and last < greatest and unstable[1] - unstable[0] != gained:
            raise RuntimeError(
                f"Between the belt speeds {first} and {last} the number of growing modes changes "
                f"from {unstable[0]} to {unstable[1]}, but the {len(found)} Hopf points found "
                f"there make that {gained:+d}. Two may be too close to tell apart: change a "
                "parameter a little, and please report these."
            )
        yield from found


def _turns(chain: Chain, crossing: Crossing) -> int:
    """+1 if the mode begins to grow as the speed grows, -1 if it ceases to."""
    step = 1e-7 * crossing.speed
    up, down = _damping(chain, np.array([crossing.speed + step, crossing.speed - step]))
    u, omega = crossing.shape, crossing.frequency
    D = _damping(chain, np.array([crossing.speed]))[0]
    slope = (u * u * (up - down)).sum() / (u * u * (2j * omega + D)).sum()
    return 1 if complex(-1j * omega * slope).real > 0 else -1


@eqx.filter_jit
def _refined(chain: Chain, start: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Newton's method: ((v_d, omega), u, relative least singular value, null vectors)."""

    weights = jnp.ones(2)

    def residual(z: jax.Array) -> jax.Array:
        return crossing_residual(z, (chain, *null_shape(lax.stop_gradient(z), chain)))

    z, _, _ = solve(linearised(residual, weights), start, weights, _CLOSE, _MOST)
    shape, _ = null_shape(z, chain)
    sizes = jnp.linalg.svd(crossing_matrix(z, chain), compute_uv=False)
    return z, shape, sizes[-1] / sizes[0], jnp.sum(sizes <= _SAME * sizes[0])


@eqx.filter_jit
def _damping_at(chain: Chain, speeds: jax.Array) -> jax.Array:
    return jax.vmap(lambda v: jnp.broadcast_to(sliding_damping(chain, v), (chain.n,)))(speeds)


def _damping(chain: Chain, speeds: np.ndarray) -> np.ndarray:
    """d_n at each of the speeds, of shape (speeds, n)."""
    room = 1 << max(4, int(np.ceil(np.log2(speeds.size))))  # few shapes, few compilations
    padded = np.concatenate([speeds, np.full(room - speeds.size, speeds[-1])])
    return np.asarray(_damping_at(chain, jnp.asarray(padded)))[: speeds.size]
