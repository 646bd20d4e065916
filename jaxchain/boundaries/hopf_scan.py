"""Every Hopf point of steady sliding in a range of belt speeds, and none missed."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .._checks import (
    check_concrete,
    check_finite,
    check_kind,
    check_pair,
    check_positive_number,
    check_whole,
    is_traced,
)
from .._final import final
from ..cycles.guesses import Guess
from ..model.arguments import as_chain, as_mass
from ..model.chain import Chain, steady_sliding
from ..model.sliding import GREATEST_SPEED
from ..result import Printed
from .axis_crossings import Crossing, find_crossings
from .criticality import (
    first_lyapunov_coefficient,
    growth_slopes,
    relative_coefficient,
    square_amplitude_slope,
)

FLANK, WEAKENING = "rising flank of the smoothed law", "weakening friction"
_TEXTS = ("direction", "criticality", "standing_criticality", "kind")
_VANISHING = 1e-9  # of the terms that make it up: then l1 is zero up to rounding


@final
class HopfPoints(Printed, eqx.Module):
    """Hopf points, sorted by belt speed, then frequency; one entry of every field for each.

    - `belt_speed`, `frequency` = omega; `mode_shape` = u, complex, greatest entry 1: a
      disturbance moves as Re[u exp(i omega t)].
    - `wavenumber`: q = 2 pi m / n, m = 0 ... n // 2, of the wave u_n = exp(i q n) in a homogeneous
      ring; NaN elsewhere.
    - `multiplicity`: how many modes cross at this speed with this frequency: 2 for a pair q, -q.
    - `growth_slope`: d Re(lambda) / d|v_d|.
    - `direction`: "falling speed" if the mode begins to grow as |v_d| falls, else "growing speed".
    - `lyapunov_coefficient` = l1 as in `first_lyapunov_coefficient`, of the travelling wave where
      there is a pair q, -q; `standing_lyapunov_coefficient`, that of the standing wave cos(q n),
      and the same as l1 where there is no pair.  NaN, and `criticality` "undetermined", where
      several modes cross together at one frequency in a chain that is not a homogeneous ring.
    - `criticality`, `standing_criticality`: "supercritical" (stable cycles grow out of the point,
      small at first), "subcritical" (unstable ones, and a jump) or "degenerate" (l1 = 0).
    - `square_amplitude_slope`, `standing_square_amplitude_slope`: d(A^2) / d|v_d| of the cycles
      that branch off, A the greatest amplitude of a mass.
    - `belt_speeds`: (low, high), between which every Hopf point is listed.
    - `kind`: "weakening friction", the physical one; or "rising flank of the smoothed law", an
      artefact of smoothing at a speed of a few widths, below which the belt drags the masses along
      in a creep that stands for sticking.

    In a homogeneous chain all n modes cross at one belt speed; each coefficient then is that of
    one wave alone, and its cycles are those of the full chain while their growth is slow compared
    with the differences of the frequencies.  If 4 q is a multiple of 2 pi there is a second
    standing wave, cos(q (n + 1/2)), with another coefficient.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.boundaries import hopf_points
        >>> points = hopf_points(paper_chain(4), (0.1, 5.0))
        >>> for k, q in enumerate(points.wavenumber):
        ...     print(f"{float(q):.4f} {int(points.multiplicity[k])} {points.criticality[k]}")
        0.0000 1 subcritical
        1.5708 2 subcritical
        3.1416 1 subcritical
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


def hopf_points(chain: Chain, belt_speeds: Any = (0.0, GREATEST_SPEED)) -> HopfPoints:
    """Every Hopf point of steady sliding at belt speeds between `belt_speeds` = (low, high).

    By default up to 1e6, as far as `hopf_belt_speed` looks.

    **Why none is missed:** in an interval of belt speeds over which no d_n changes by more than
    delta from its value in the middle, no eigenvalue crosses the imaginary axis if the least
    singular value of D + (K - omega^2) / (i omega) in the middle exceeds delta for every omega;
    that is |d| > delta for uniform damping, and otherwise holds if and only if a Hamiltonian
    matrix of order 4 n has no imaginary eigenvalue (Boyd, Balakrishnan, Kabamba, Math. Control
    Signals Systems 2 (1989)).  Intervals without this proof are halved down to 1e-5 of the speed,
    searched by Newton's method from every eigenvalue near the axis, and the number of unstable
    eigenvalues on either side is compared.  Two assumptions remain: d_n is sampled 17 times in
    intervals of at most a tenth of the speed, so a law must not hide anything between; and two
    points in opposite directions that are within 1e-5 of meeting may be taken for none.

    **Returns:** `HopfPoints`; at negative belt speeds the mirror image of those at positive ones.
    Concrete numbers only: not for use under `jit` (`hopf_belt_speed` is).

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
    entries = []
    for crossing in find_crossings(simple, least, max(abs(low), abs(high))):
        entry = _described(simple, crossing)
        signed = (crossing.speed, -crossing.speed)
        entries += [{**entry, "belt_speed": v} for v in signed if low <= v <= high]
    entries.sort(key=lambda entry: (entry["belt_speed"], entry["frequency"]))

    def column(name: str) -> Any:
        values = [entry[name] for entry in entries]
        if name in _TEXTS:
            return tuple(values)
        if name == "mode_shape":
            return jnp.asarray(np.reshape(values, (len(values), chain.n)).astype(complex))
        return jnp.asarray(np.array(values, dtype=int if name == "multiplicity" else float))

    names = [name for name in HopfPoints.__dataclass_fields__ if name != "belt_speeds"]
    return HopfPoints(**{name: column(name) for name in names}, belt_speeds=(low, high))


def _simplified(chain: Chain) -> Chain:
    """The same chain with one number where all masses have the same, and no springs of zero."""

    def one(value: Array) -> Array:
        if jnp.ndim(value) == 0 or not bool(jnp.all(value == value[0])):
            return value
        return value[0]

    chain = jax.tree.map(one, chain)
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
    at = (jnp.asarray(speed), jnp.asarray(frequency))
    results = [
        _numbers(chain, *at, jnp.asarray(u, complex), jnp.asarray(left, complex))
        for u, left in shapes
    ]
    if multiplicity > 1 and not pair:  # which combination of the modes, nothing tells
        slope, dry = results[0][2:4]
        results = [(np.nan, np.nan, slope, dry, np.nan)]
    (wave, size, slope, dry, rise), (standing, standing_size, _, _, standing_rise) = (
        results[0],
        results[-1],
    )
    return {
        "frequency": frequency,
        "mode_shape": shape,
        "wavenumber": wavenumber,
        "multiplicity": multiplicity,
        "growth_slope": float(slope),
        "lyapunov_coefficient": float(wave),
        "standing_lyapunov_coefficient": float(standing),
        "square_amplitude_slope": float(rise),
        "standing_square_amplitude_slope": float(standing_rise),
        "direction": "falling speed" if slope < 0 else "growing speed",
        "criticality": _criticality(float(size)),
        "standing_criticality": _criticality(float(standing_size)),
        # Without smoothing the mode would not begin to grow as the speed grows.
        "kind": FLANK if slope > 0 >= dry else WEAKENING,
    }


@eqx.filter_jit
def _numbers(
    chain: Chain, speed: Array, frequency: Array, u: Array, left: Array
) -> tuple[Array, ...]:
    point = (chain, speed, frequency, u, left)
    wave = first_lyapunov_coefficient(*point)
    slope, dry = growth_slopes(*point)
    rise = square_amplitude_slope(wave, slope, frequency, u)
    return wave, relative_coefficient(*point), slope, dry, rise


def _criticality(relative: float) -> str:
    if np.isnan(relative):
        return "undetermined"
    if abs(relative) <= _VANISHING:
        return "degenerate"
    return "supercritical" if relative < 0 else "subcritical"


def guess_from_hopf(
    chain: Chain,
    points: HopfPoints,
    index: int = 0,
    amplitude: Any = None,
    vibrating: int | None = None,
) -> Guess:
    """The small cycle that branches off Hopf point `index` of `points`, at the chain's belt speed.

    x = x_s + A Re[u exp(i omega t)], when mass `vibrating` (by default the one that moves most)
    is fastest in the direction of the belt.

    **Arguments:** `points` from `hopf_points(chain, ...)`; `amplitude` = A > 0 of displacement, of
    the mass that moves most, by default what `square_amplitude_slope` predicts.

    **Returns:** ((x, v), period), as `find_limit_cycle` takes them; x and v of shape (n,).

    **Raises:** `ValueError` if there is no such point, or no small cycle at this belt speed: a
    subcritical one lies on the stable side of its point.

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
    mass = as_mass(chain.n, vibrating)
    mass = int(jnp.argmax(jnp.abs(shape))) if mass is None else mass
    moving = 1j * omega * shape
    phase = chain.belt_direction() * jnp.conj(moving[mass]) / jnp.abs(moving[mass])
    x, _ = steady_sliding(chain)
    disturbed = x + amplitude * jnp.real(shape * phase)
    return (disturbed, amplitude * jnp.real(moving * phase)), 2 * jnp.pi / omega
