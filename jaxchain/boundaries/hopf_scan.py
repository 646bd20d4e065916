"""Every Hopf point of steady sliding in a range of belt speeds, and its criticality.

Where l1 = 0, the generalised Hopf (Bautin) point, the fold of cycles meets the Hopf point.  Along
the Hopf curve in the plane of the belt speed and another number, vibration sets in abruptly if l1
is positive, with a bistable range up to the fold; and gradually if l1 is negative, without a
fold.  At l1 = 0 the fold ends, tangentially to the Hopf curve (Kuznetsov, Elements of Applied
Bifurcation Theory, section 8.3).  `continue_special` finds these points.

For one mass l1 has the sign of F'''(-v_d).  Dry friction that weakens exponentially has F''' > 0
throughout, so that its fold and Hopf point meet only at v_d = 0.  Smoothed friction mu tanh(v_d /
eps) has a peak, and F''' < 0 up to a few widths beyond it:

    v_d = (eps / 2) ln[16 mu_st v_0^3 / ((mu_st - mu_d) eps^3)]  to leading order,

and the damping there is about p (mu_st - mu_d) / (2 v_0), that of dry friction at v_d = 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .._checks import check_concrete, check_finite, check_pair
from .._types import ArrayLike, Given
from ..model.arguments import as_chain
from ..model.chain import Chain, map_numbers, steady_sliding
from ..model.sliding import (
    GREATEST_SPEED,
    crossing_matrix,
    dry_damping,
    has_uniform_damping,
    least_belt_speed,
    sliding_damping,
    sliding_eigenvalues,
    stiffness_matrix,
)
from ..result import Printed
from .equilibria import Rates, lyapunov_terms
from .hopf import damping_at, damping_root, refined_crossing

_SAME = 1e-8  # relative difference of speeds and frequencies of one point


@eqx.filter_jit
def _growth_slopes(
    chain: Chain, speed: Array, frequency: Array, u: Array, left: Array
) -> tuple[Array, Array]:
    """d Re(lambda) / d|v_d|, and its value for dry friction.

    lambda' = -i omega l^T D' u / [l^T (2 i omega + D) u], and D' = p mu'' for dry friction.
    """
    one = jnp.ones_like(speed)
    D, change = jax.jvp(lambda s: sliding_damping(chain, s), (speed,), (one,))
    _, dry = jax.jvp(lambda s: dry_damping(chain, s), (speed,), (one,))
    weight = left * u / jnp.sum(left * (2j * frequency + D) * u)
    slope, dry = (jnp.real(jnp.sum(-1j * frequency * d * weight)) for d in (change, dry))
    return slope, dry


@eqx.filter_jit
def _numbers(
    chain: Chain, speed: Array, frequency: Array, u: Array, left: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """(l1, l1 over the sizes of its terms, both of `_growth_slopes`, d(A^2) / d|v_d|).

    - `u`, and `left`, the left null vector of K - omega^2 + i omega D: for a simple pair u itself,
      because that matrix is symmetric; for a wave that travels around a homogeneous ring, one of a
      pair q, -q, conj u; for a standing wave u, real.  Each of these waves lies in a subspace that
      is invariant by symmetry; l1 describes the cycles in it.
    - If a coefficient is exactly zero, the sum of its terms consists of rounding errors.
    - A = max_n |x_n - mean| = 2 |w| max|u| / (sqrt(1 + omega^2) |u|) to leading order, A the
      greatest amplitude, and |w|^2 = -alpha' (v_d - v_H) / (omega l1).
    """
    slope, dry = _growth_slopes(chain, speed, frequency, u, left)
    moving = chain.with_(belt_speed=speed)
    y = jnp.concatenate(steady_sliding(moving))
    q = jnp.concatenate([u, 1j * frequency * u])
    p = jnp.concatenate([(1j * frequency + sliding_damping(chain, speed)) * left, left])
    terms = lyapunov_terms(Rates.of(moving, 2), y, frequency, q, p)
    l1, size = jnp.real(jnp.sum(terms)), jnp.sum(jnp.abs(terms))
    square = jnp.sum(jnp.abs(u) ** 2) * (1.0 + frequency**2)
    rise = -4.0 * jnp.max(jnp.abs(u)) ** 2 * slope / (square * frequency * l1)
    return l1, l1 / jnp.where(size > 0, size, 1.0), slope, dry, rise


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

    for low, high in _unproven(chain, least, greatest, mass=mass):
        at_low, at_high = _damping(chain, np.array([low, high]))[:, mass]
        if at_low == 0.0:
            yield low
        elif at_high != 0.0 and (at_low > 0) != (at_high > 0):
            yield float(damping_root(chain, mass, *jnp.array([low, high])))


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

    def eigenvalues(speed: float) -> np.ndarray:
        return np.asarray(_eigenvalues(chain, jnp.asarray(speed)))

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
                z, shape, _ = refined_crossing(chain, jnp.array([centre, value.imag]))
                speed, frequency = map(float, z)
                sizes = np.linalg.svd(crossing_matrix(z, chain), compute_uv=False)
                inside = max(first, low - margin) <= speed <= min(last, high + margin)
                new = not any(
                    same(speed, c.speed) and same(frequency, c.frequency) for c in points
                )
                if inside and new and frequency > 0 and sizes[-1] <= 1e-10 * sizes[0]:
                    shape, count = np.asarray(shape), int((sizes <= _SAME * sizes[0]).sum())
                    points.append(Crossing(speed, frequency, shape, np.nan, count))
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
    speed, frequency, u = map(jnp.asarray, crossing[:3])
    return 1 if _growth_slopes(chain, speed, frequency, u, u)[0] > 0 else -1


_damping_at, _eigenvalues = eqx.filter_jit(damping_at), eqx.filter_jit(sliding_eigenvalues)


def _damping(chain: Chain, speeds: np.ndarray) -> np.ndarray:
    """d_n at each of the speeds, of shape (speeds, n)."""
    size = 1 << max(4, int(np.ceil(np.log2(speeds.size))))  # few shapes, few compilations
    padded = np.concatenate([speeds, np.full(size - speeds.size, speeds[-1])])
    return np.asarray(_damping_at(chain, jnp.asarray(padded)))[: speeds.size]


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
    - `lyapunov_coefficient`: l1 as of a `HopfPoint`, of the travelling wave where there is a pair
      q, -q; `standing_lyapunov_coefficient`: l1 of the standing wave cos(q n), and the same number
      where there is no pair.  NaN, and `criticality` "undetermined", where
      several modes cross together at one frequency in a chain that is not a homogeneous ring.
    - `criticality`, `standing_criticality`: "supercritical" (stable cycles grow out of the point,
      small at first), "subcritical" (unstable ones, and a jump) or "degenerate" (l1 = 0).
    - `square_amplitude_slope`, `standing_square_amplitude_slope`: d(A^2) / d|v_d| of the cycles
      that branch off, A the greatest amplitude of a mass.
    - `belt_speeds`: (low, high), the range in which every Hopf point is listed.
    - `kind`: "weakening friction", the physical one; or "rising flank of the smoothed law", an
      artefact of smoothing at a speed of a few widths, below which the masses creep with the belt
      instead of sticking.

    In a homogeneous chain all n modes cross at one belt speed; then each coefficient belongs to
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
