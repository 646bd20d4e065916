"""Localized vibrations of a few neighbours, to first order in the coupling: guesses of cycles.

A pattern in which all phases of the phase model grow at the same rate is *locked*; a cycle of the
chain is near it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from .._checks import (
    check_concrete,
    check_finite,
    check_kind,
    check_one_of,
    check_whole,
    shown,
    to_float,
)
from .._types import ArrayLike, Given, ScalarLike, State
from ..continuation.damped_newton import linearised, solve
from ..cycles.averaging import one_mass
from ..cycles.floquet import monodromy_matrix
from ..cycles.limit_cycle import find_limit_cycle
from ..model.arguments import as_chain
from ..model.chain import Chain, require_smoothed, steady_sliding
from ..model.initial_states import BLOCKS, reference_site
from ..model.sliding import has_uniform_damping, sliding_damping, stiffness_matrix
from ..observers.samples import Trajectory
from ..result import Printed
from ..simulation.run import simulate

_SAMPLES, _HARMONICS = 256, 8


class PhaseModel(Printed, eqx.Module):
    """The phase model of vibrating neighbours on a homogeneous ring, from `phase_model`.

    - `state` = (x, v), shape (1,), and `period`: the cycle of one mass, its neighbours fixed, at
      its greatest velocity, where theta = 0.
    - `interaction` (h,): H(s) = Re sum_h c_h exp(i h s), h = 0, 1, ...; `quiet`: H_q.
    - `displacement` (h,): x(theta) in the same form; `chain`: the ring.

    See `phase_model` for an example.
    """

    chain: Chain
    state: State
    period: Float[Array, ""]
    displacement: Complex[Array, " h"]
    interaction: Complex[Array, " h"]
    quiet: Float[Array, ""]

    def pull(self, difference: Float[Array, "*any"]) -> Float[Array, "*any"]:
        """H at the phase of a neighbour minus that of the mass."""
        h = jnp.arange(self.interaction.shape[0])
        turned = jnp.exp(1j * jnp.multiply.outer(difference, h))
        return jnp.real(turned @ self.interaction)

    def rates(self, phases: Float[Array, " k"]) -> Float[Array, " k"]:
        """(theta_n' / omega - 1) / eta_c of k neighbours, or of the whole ring for k = n."""
        theta, ring = phases, phases.shape[0] == self.chain.n
        forth = self.pull(jnp.roll(theta, -1) - theta)
        back = self.pull(jnp.roll(theta, 1) - theta)
        if not ring:
            forth = forth.at[-1].set(self.quiet)
            back = back.at[0].set(self.quiet)
        return forth + back


def phase_model(chain: Given[Chain]) -> PhaseModel:
    """The phase model of a weakly coupled homogeneous ring at its belt speed.

    **Arguments:** `chain`, a ring of equal masses with smoothed friction and little coupling.

    **Returns:** a `PhaseModel`.

    **Raises:** `ValueError` for a chain of another kind; `RuntimeError` if one mass has no
    stick-slip cycle there.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle, paper_chain
        >>> from jaxchain.localization import locked_patterns, pattern_guess, phase_model
        >>> chain = paper_chain(20, belt_speed=1.5)
        >>> model = phase_model(chain)
        >>> calmest, *_ = locked_patterns(model, 4)
        >>> state, period = pattern_guess(model, calmest.phases, first=10)
        >>> # All masses stick: rounding alone leaves a gap of some 1e-9 of the width.
        >>> cycle = find_limit_cycle(chain, state, period=period, mass=10, tolerance=1e-8)
        >>> round(calmest.growth, 5), round(float(cycle.energy), 4)
        (-0.00093, 4.9056)
    """
    _check_ring(chain)
    check_concrete("use `find_limit_cycle`.", chain=chain)
    require_smoothed(chain, "", "chain")
    alone = one_mass(chain, 0)
    cycle = find_limit_cycle(alone)
    state, period = cycle.state, cycle.period
    times = period * jnp.arange(_SAMPLES) / _SAMPLES
    xs, vs = simulate(alone, state, period, observe=Trajectory(times), rtol=_rtol(chain)).observed
    z = (jnp.fft.fft(_velocity_response(alone, xs, vs, period)) / _SAMPLES)[:_HARMONICS]
    twice = jnp.where(jnp.arange(_HARMONICS) == 0, 1.0, 2.0)
    displacement = twice * (jnp.fft.fft(xs[:, 0]) / _SAMPLES)[:_HARMONICS]
    one = jnp.arange(chain.n) == 0
    answer = _shaken(chain, period, jnp.where(one[None, :], displacement[:, None], 0.0), one)[:, 1]
    return PhaseModel(
        chain=chain,
        state=state,
        period=period,
        displacement=displacement,
        interaction=jnp.conj(z) * displacement,
        quiet=jnp.real(jnp.vdot(z, answer)),
    )


def _check_ring(chain: Any) -> None:
    as_chain(chain)
    same = has_uniform_damping(chain) and jnp.ndim(chain.stiffness) == 0
    ring = chain.coupling is not None and jnp.ndim(chain.coupling) == 0 and chain.ends == "cyclic"
    if not (same and ring and chain.n > 2):
        raise ValueError(
            "Argument `chain` must be a ring of at least three equal masses, with one number for "
            f"`coupling`, but is one of {chain.n} that is not: phases of unequal masses drift."
        )


def _rtol(chain: Chain) -> Array:
    """A tolerance at which the error of a sticking mass is small in units of the width."""
    return jnp.clip(1e-4 * chain.width, 1e-11, 1e-7)


@eqx.filter_jit
def _velocity_response(
    alone: Chain, xs: Float[Array, "m 1"], vs: Float[Array, "m 1"], period: Float[Array, ""]
) -> Float[Array, " m"]:
    """d(time gained)/d(velocity given) along a cycle, from left eigenvectors l with l . f = 1."""

    def at(x: Array, v: Array) -> Array:
        # M - 1 has rank one, and l is orthogonal to its columns.
        columns = monodromy_matrix(alone, (x, v), period) - jnp.eye(2)
        greater = jnp.argmax(jnp.sum(columns**2, axis=0))
        left = jnp.array([-columns[1, greater], columns[0, greater]])
        return left[1] / (left @ jnp.concatenate(alone(0.0, (x, v))))

    return jax.vmap(at)(xs, vs)


def _shaken(
    chain: Chain,
    period: Any,
    shapes: Complex[Array, "h n"],
    vibrating: Bool[Array, " n"],
) -> Complex[Array, "h n"]:
    """`shapes`, harmonics of x_n, completed by those of the other masses.

    These slide, driven by their neighbours: (K - (h omega)^2 + i h omega d) x = 0 in their rows,
    for x minus its value in steady sliding.
    """
    rest = jnp.zeros_like(shapes).at[0].set(steady_sliding(chain)[0])
    damping = sliding_damping(chain, chain.belt_speed)
    stiffness = stiffness_matrix(chain)

    def harmonic(h: Array, shape: Array) -> Array:
        omega = 2.0 * jnp.pi * h / period
        eye = jnp.eye(chain.n)
        A = stiffness - (omega**2 - 1j * omega * damping) * eye
        return jnp.linalg.solve(
            jnp.where(vibrating[:, None], eye, A), jnp.where(vibrating, shape, 0.0)
        )

    return rest + jax.vmap(harmonic)(jnp.arange(shapes.shape[0]), shapes - rest)


# The search for locked patterns: starts, Newton steps, the final ones, and tolerances for solved
# and equal patterns.
_STARTS, _NEWTON, _CLOSE, _SOLVED, _SAME = 300, 40, 1e-8, 1e-10, 1e-5


def _check_model(model: Any) -> None:
    check_kind("model", model, PhaseModel, "a `PhaseModel`", "`phase_model(chain)` makes one.")


def pattern_guess(
    model: PhaseModel,
    phases: Given[ArrayLike],
    *,
    block: str = "centred",
    first: Given[ScalarLike | None] = None,
) -> tuple[State, Float[Array, ""]]:
    """(state, period) near the locked cycle of k neighbours with the given phases.

    Each of them is on the cycle of one mass; they drive the sliding masses.  The state is that at
    the greatest velocity of mass `first`, for `find_limit_cycle(chain, state, period=period,
    mass=first)`.

    **Arguments:** `phases`, shape (k,), k <= n, as in `LockedPattern`; `block`, the position of
    these masses, see `excited_block`; `first`, the index of one of them, by default the middle
    one.

    **Returns:** ((x, v), period); x and v of shape (n,).

    **Raises:** `ValueError` for bad phases, or a `first` that does not vibrate.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, simulate
        >>> from jaxchain.localization import locked_patterns, pattern_guess, phase_model
        >>> chain = paper_chain(4, belt_speed=1.5, width=1e-2)
        >>> model = phase_model(chain)
        >>> state, period = pattern_guess(model, locked_patterns(model, 2)[0].phases, first=2)
        >>> again, _ = simulate(chain, state, period).state  # the guess comes back, nearly
        >>> bool(abs(again - state[0]).max() < 0.1), round(float(period), 1)
        (True, 6.2)
    """
    _check_model(model)
    check_one_of("block", block, BLOCKS)
    chain, n = model.chain, model.chain.n
    theta = to_float(phases, "phases", "one for each vibrating mass, in radians.")
    if theta.ndim != 1 or not 1 <= theta.shape[0] <= n:
        raise ValueError(
            f"Argument `phases` must have shape (k,) with 1 <= k <= {n}, but has {theta.shape}."
        )
    check_finite("phases", theta, "one for each vibrating mass, in radians.")
    k = theta.shape[0]
    sites = block_sites(n, k, block)
    mass = int(sites[k // 2]) if first is None else first
    if not isinstance(mass, int | np.integer) or mass not in sites:
        raise ValueError(
            f"Argument `first` must be one of the vibrating masses {sites.tolist()}, but is "
            f"{shown(mass)}."
        )
    theta = (theta - theta[int(np.flatnonzero(sites == mass)[0])]) % (2.0 * jnp.pi)
    order = jnp.argsort(theta)
    times = model.period * theta[order] / (2.0 * jnp.pi)
    alone = one_mass(chain, 0)
    run = simulate(alone, model.state, model.period, observe=Trajectory(times), rtol=_rtol(chain))
    h = jnp.arange(model.displacement.shape[0])
    wave = model.displacement[:, None] * jnp.exp(1j * jnp.multiply.outer(h, theta))
    vibrating = jnp.zeros(n, bool).at[sites].set(True)
    shapes = jnp.zeros((h.shape[0], n), complex).at[:, sites].set(wave)
    shapes = _shaken(chain, model.period, shapes, vibrating)
    omega = 2.0 * jnp.pi / model.period
    x = jnp.real(jnp.sum(shapes, axis=0))
    v = jnp.real(jnp.sum(1j * omega * h[:, None] * shapes, axis=0))
    x = x.at[sites[order]].set(run.observed[0][:, 0])
    v = v.at[sites[order]].set(run.observed[1][:, 0])
    rate, coupling = jnp.mean(model.rates(theta)), jnp.asarray(chain.coupling)
    return (x, v), model.period / (1.0 + coupling * rate)


def block_sites(n: int, k: int, block: str = "centred") -> np.ndarray:
    """Indices of k neighbours, in order along the ring; see `excited_block`.

    **Arguments:** `n` masses in the ring, `k` of them; `block`, "centred" about mass n // 2 or
    "forward" from it.

    **Returns:** integers from 0, of shape (k,).

    **Raises:** `ValueError` for k not in 1 ... n, or another block.

    !!! example

        >>> from jaxchain.localization import block_sites
        >>> block_sites(8, 3).tolist(), block_sites(8, 6, "forward").tolist()
        ([3, 4, 5], [4, 5, 6, 7, 0, 1])
    """
    check_whole("k", k, 1, check_whole("n", n), "it is the number of vibrating masses, of n.")
    check_one_of("block", block, BLOCKS)
    start = reference_site(n) - (0 if block == "forward" else k // 2)
    return (start + np.arange(k)) % n


@dataclass(frozen=True, repr=False)
class LockedPattern(Printed):
    """Locked phases of k neighbours.

    `phases` (k,), radians, theta = 0 of the first; `rate`, their common rate, as in
    `PhaseModel.rates`; `growth`, the greatest growth rate of a phase disturbance, in units of 1 /
    time: negative for a stable pattern.

    See `locked_patterns` for an example.
    """

    phases: Float[np.ndarray, " k"]
    rate: float
    growth: float

    @property
    def order(self) -> float:
        """Mean cosine of the phase differences of neighbours: 1 in phase, -1 alternating."""
        return float(np.mean(np.cos(np.diff(self.phases)))) if self.phases.size > 1 else 1.0

    @property
    def mirrored(self) -> bool:
        """Whether it is its own mirror image."""
        return bool(np.all(np.abs(_wrap(self.phases - self.phases[::-1])) < _SAME))

    def images(self, n: int) -> list[int] | None:
        """The symmetry of its centred cycle in a ring of n, for `find_limit_cycle(images=)`.

        In a mirrored block the left half moves like the right half.  In a ring with period two,
        two masses differ, or one.  None without a symmetry.

        !!! example

            >>> import numpy as np
            >>> from jaxchain.localization import LockedPattern
            >>> LockedPattern(np.zeros(2), rate=0.0, growth=0.0).images(4)
            [3, 2, 2, 3]
        """
        k = self.phases.size
        sites = block_sites(n, k)
        mass, total = int(sites[k // 2]), int(sites[0] + sites[-1])
        if k == n:
            turn = np.cos(np.diff(self.phases))
            if np.allclose(turn, 1.0):
                return [mass] * n
            alternates = np.allclose(turn, -1.0) and n % 2 == 0
            return [mass + (i - mass) % 2 for i in range(n)] if alternates else None
        if not self.mirrored:
            return None
        return [max(i, (total - i) % n) if i != mass else i for i in range(n)]


def locked_patterns(model: PhaseModel, count: Given[int]) -> tuple[LockedPattern, ...]:
    """The locked patterns of `count` neighbours, the most stable one first.

    Newton's method from a few hundred fixed starts; for more than about eight masses it misses
    some patterns.  Of a pattern and its mirror image one is returned.

    **Arguments:** `model`, from `phase_model`; `count`, the number of vibrating masses.

    **Returns:** a tuple of `LockedPattern`.

    **Raises:** `ValueError` for a count that is not an integer in 1 ... n.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.localization import locked_patterns, phase_model
        >>> model = phase_model(paper_chain(4, belt_speed=1.5, width=1e-2))
        >>> patterns = locked_patterns(model, 2)
        >>> patterns[0].growth < 0, patterns[0].phases.shape
        (True, (2,))
    """
    _check_model(model)
    k = check_whole("count", count, 1, model.chain.n)
    if k == 1:
        rate = float(model.rates(jnp.zeros(1))[0])
        return (LockedPattern(np.zeros(1), rate, -np.inf),)
    starts = np.random.default_rng(0).uniform(-np.pi, np.pi, (_STARTS, k - 1))
    locked, settled = jax.device_get(_lock(model, jnp.asarray(starts)))
    patterns: list[LockedPattern] = []
    kept: list[np.ndarray] = []
    for step, gap, rate, slope in zip(locked, *settled, strict=True):
        repeated = (np.max(np.abs(_wrap(step - old))) < _SAME for old in kept)
        if not gap < _SOLVED or any(repeated):
            continue
        kept += [step, -step[::-1]]
        phases = np.append(0.0, np.cumsum(_wrap(step)))
        patterns.append(LockedPattern(phases, float(rate), _growth(model, slope)))
    return tuple(sorted(patterns, key=lambda pattern: pattern.growth))


def rotating_wave(model: PhaseModel, turns: Given[int]) -> LockedPattern:
    """The whole ring vibrates, each mass ahead of the previous one by 2 pi `turns` / n.

    0 is in phase, n / 2 alternating; every such pattern is locked.

    **Arguments:** `model`, from `phase_model`; `turns`, an integer in -n ... n.

    **Returns:** a `LockedPattern` of n phases.

    **Raises:** `ValueError` for other `turns`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.localization import phase_model, rotating_wave
        >>> model = phase_model(paper_chain(4, belt_speed=1.5, width=1e-2))
        >>> waves = [rotating_wave(model, turns) for turns in (0, 1, 2)]
        >>> [wave.growth < 0 for wave in waves]  # in phase, travelling, alternating
        [False, False, True]
    """
    _check_model(model)
    n = model.chain.n
    check_whole("turns", turns, -n, n, "it is the number of turns of the phase around the ring.")
    phases = 2.0 * np.pi * turns * np.arange(n) / n
    _, rate, slope = _locking(model, jnp.diff(jnp.asarray(phases)))
    return LockedPattern(phases, float(rate), _growth(model, slope))


def _growth(model: PhaseModel, slope: Any) -> float:
    speed = 2.0 * np.pi / float(model.period) * float(model.chain.coupling)  # pyright: ignore[reportArgumentType]
    return speed * float(np.max(np.real(np.linalg.eigvals(np.asarray(slope)))))


def _phases(step: Array) -> Array:
    return jnp.concatenate([jnp.zeros(1), jnp.cumsum(step)])


def _drift(model: PhaseModel, step: Array) -> Array:
    return jnp.diff(model.rates(_phases(step)))


@eqx.filter_jit
def _locking(model: PhaseModel, step: Float[Array, " m"]) -> tuple[Array, Array, Array]:
    """(residual of locking, rate, slope) at these phase differences."""
    gap = jnp.max(jnp.abs(_drift(model, step)))
    return gap, model.rates(_phases(step))[0], jax.jacfwd(partial(_drift, model))(step)


@eqx.filter_jit
def _lock(
    model: PhaseModel, starts: Float[Array, "s m"]
) -> tuple[Array, tuple[Array, Array, Array]]:
    """(phase differences, the results of `_locking` there), for each of the starts."""
    weights = jnp.ones(starts.shape[1])
    both = linearised(partial(_drift, model), weights)

    def one(start: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        step, _, _ = solve(both, start, weights, _CLOSE, _NEWTON)
        return step, _locking(model, step)

    return jax.vmap(one)(starts)


def _wrap(angle: Any) -> Any:
    """An angle in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
