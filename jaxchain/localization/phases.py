"""The phase model of weakly coupled neighbours: one phase for each mass that vibrates.

Each goes round the cycle of one mass alone, and only its phase theta_n is free.  Averaged over a
period (Kuramoto, Chemical Oscillations, Waves, and Turbulence, Springer 1984, chapter 5),

    theta_n' = omega [1 + eta_c (sum of H(theta_m - theta_n) over vibrating neighbours + b_n H_q)]
    H(s) = (1 / 2 pi) integral of Z(theta) x(theta + s) over theta

with Z = d(time gained)/d(velocity given) of the cycle, x its displacement, and b_n the number of
neighbours that do not vibrate on their own: H_q is the same mean with their response to it.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from .._checks import check_concrete
from .._final import final
from .._types import State
from ..cycles.averaging import one_mass
from ..cycles.floquet import monodromy_matrix
from ..cycles.search import find_limit_cycle
from ..model.arguments import as_chain
from ..model.chain import Chain, require_smoothed, steady_sliding
from ..model.sliding import has_uniform_damping, sliding_damping, stiffness_matrix
from ..observers.trajectory import Trajectory
from ..result import Printed
from ..simulation.run import simulate

_SAMPLES, _HARMONICS = 256, 8


@final
class PhaseModel(Printed, eqx.Module):
    """Phases of vibrating neighbours on a homogeneous ring, what `phase_model` returns.

    - `state` = (x, v), shape (1,), and `period`: the cycle of one mass, its neighbours held, at
      its greatest velocity, where theta = 0.
    - `interaction` (h,): H(s) = Re sum_h c_h exp(i h s), h = 0, 1, ...; `quiet`: H_q.
    - `displacement` (h,): x(theta) in the same way; `chain`: whose masses these are.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.localization import phase_model
        >>> model = phase_model(paper_chain(4, belt_speed=1.5, width=1e-2))
        >>> round(float(model.period), 4)
        6.2469
        >>> rates = model.rates(jnp.zeros(3))  # three in phase: the middle one differs
        >>> bool(abs(rates[0] - rates[2]) < 1e-9), bool(abs(rates[0] - rates[1]) > 1e-3)
        (True, True)
    """

    chain: Chain
    state: State
    period: Float[Array, ""]
    displacement: Complex[Array, " h"]
    interaction: Complex[Array, " h"]
    quiet: Float[Array, ""]

    def pull(self, difference: Float[Array, "*any"]) -> Float[Array, "*any"]:
        """H, of the phase of a neighbour less one's own."""
        h = jnp.arange(self.interaction.shape[0])
        turned = jnp.exp(1j * jnp.multiply.outer(difference, h))
        return jnp.real(turned @ self.interaction)

    def rates(self, phases: Float[Array, " k"]) -> Float[Array, " k"]:
        """(theta_n' / omega - 1) / eta_c of k neighbours, or of the whole ring for k = n."""
        own, ring = phases, phases.shape[0] == self.chain.n
        forth = self.pull(jnp.roll(own, -1) - own)
        back = self.pull(jnp.roll(own, 1) - own)
        if not ring:
            forth = forth.at[-1].set(self.quiet)
            back = back.at[0].set(self.quiet)
        return forth + back


def phase_model(chain: Any) -> PhaseModel:
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
        >>> cycle = find_limit_cycle(chain, state, period=period, vibrating=10)
        >>> round(calmest.growth, 5), round(float(cycle.energy), 4)
        (-0.00093, 4.9056)
    """
    _check_ring(chain)
    check_concrete("use `find_limit_cycle`.", chain=chain)
    require_smoothed(chain, "")
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
        chain=chain, state=state, period=period, displacement=displacement,
        interaction=jnp.conj(z) * displacement, quiet=jnp.real(jnp.vdot(z, answer)),
    )  # fmt: skip


def _check_ring(chain: Any) -> None:
    as_chain(chain)
    same = has_uniform_damping(chain) and jnp.ndim(chain.stiffness) == 0
    ring = chain.coupling is not None and jnp.ndim(chain.coupling) == 0 and chain.ends == "cyclic"
    if not (same and ring and chain.n > 2):
        raise ValueError(
            "Argument `chain` must be a ring of three masses or more, all alike, with a number "
            f"for `coupling`, but is one of {chain.n} that is not: phases of unlike masses drift."
        )


def _rtol(chain: Chain) -> Array:
    """A sticking mass errs by little in units of the width."""
    return jnp.clip(1e-4 * chain.width, 1e-11, 1e-7)


@eqx.filter_jit
def _velocity_response(
    alone: Chain, xs: Float[Array, "m 1"], vs: Float[Array, "m 1"], period: Float[Array, ""]
) -> Float[Array, " m"]:
    """d(time gained)/d(velocity given) along a cycle: of each left eigenvector l, l . f = 1."""

    def at(x: Array, v: Array) -> Array:
        # M - 1 has rank one, and l is square to its columns.
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
    """`shapes`, harmonics of x_n, with those of the other masses filled in.

    These slide, and their neighbours shake them: (K - (h omega)^2 + i h omega d) x = 0 in their
    rows, for x less that of steady sliding.
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
