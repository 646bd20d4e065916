"""Predictions of the speed of fronts, and of the belt speeds of their depinning.

With x_n = Re a_n exp(i w t), weak coupling and slow amplitudes,

    a_n' = -g(|a_n|) a_n - i D a_n - (i eta / 2) (a_{n-1} + a_{n+1}),      D = w - (1 + eta),

where g(r) = xi - (1 / r) <F cos> is the damping of a vibration of amplitude r (`averaging.gain`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxchain.continuation.bracket import bisect
from jaxchain.cycles.averaging import gain
from jaxchain.model.chain import Chain
from jaxchain.model.sliding import growth_rate

# Number of quiet masses in the response, and its time in multiples of 1 / damping.
_QUIET, _STEPS, _STEP = 4, 1500, 1.0


def spreading_speed(coupling: Any, growth: Any) -> Float[Array, "*batch"]:
    """u of the front of a small vibration that grows at rate s: linear spreading, s >= 0.

    Sliding amplifies at the same rate at all wavenumbers, so the amplitude at distance n is
    exp(s t) J_n(eta t); at n = u t it neither grows nor decays if

        u [arcosh(u / eta) - sqrt(1 - eta^2 / u^2)] = s,      u >= eta,

    which is u = eta, the greatest group velocity, at the Hopf speed, and s / ln(2 u / (e eta)) for
    vanishing coupling, on which it then hardly depends.  A front that starts from a block reaches
    it as u - 3 / (2 t arcosh(u / eta)).

    Source: W. van Saarloos, Front propagation into unstable states, Physics Reports 386, 29
    (2003).

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from _front_theory import spreading_speed
    >>> round(float(spreading_speed(0.01, 0.0)), 6), round(float(spreading_speed(0.01, 0.01)), 5)
    (0.01, 0.02073)
    """
    eta, s = jnp.broadcast_arrays(jnp.asarray(coupling, float), jnp.asarray(growth, float))

    def rate(u: Array) -> Array:
        ratio = jnp.maximum(u / eta, 1.0)
        return u * (jnp.arccosh(ratio) - jnp.sqrt(1.0 - 1.0 / ratio**2))

    # At u = 4 eta + s the expression in brackets exceeds 1.
    low, high = bisect(lambda u: rate(u) < s, eta, 4.0 * eta + s, 60)
    return jnp.where(s < 0, jnp.nan, 0.5 * (low + high))


def growth_coupling(
    chain: Chain, detuning: Any, amplitude: Any, cosine: Any, highest: Any = 0.2
) -> Float[Array, ""]:
    """The coupling above which the quiet neighbour of a block starts to vibrate.

    The last mass of the block vibrates with its `amplitude` at 1 + detuning + eta (1 - cosine/2),
    `cosine` that of its phase to the next mass of the block: 0 where phases drift past each other,
    -1 for the worst.  From rest, the response of the quiet masses stays low as long as there is a
    low one; where it folds, they reach the belt speed.  `chain` is one mass.
    """
    speed = jnp.abs(chain.belt_speed)  # friction is odd: the direction has no effect
    ratios = jnp.linspace(1e-3, 1.0, 200)
    dampings = -jax.vmap(lambda r: gain(chain, r, speed))(ratios) / (ratios * speed)

    def slope(a: Array, eta: Array) -> Array:
        damping = jnp.interp(jnp.abs(a) / speed, ratios, dampings)
        padded = jnp.concatenate([jnp.full(1, amplitude, complex), a, jnp.zeros(1, complex)])
        drive = 0.5j * eta * (padded[:-2] + padded[2:])
        return -(damping + 1j * (detuning - 0.5 * eta * cosine)) * a - drive

    def drawn_in(eta: Array) -> Array:
        def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            a, most = carry
            k1 = slope(a, eta)
            k2 = slope(a + 0.5 * _STEP * k1, eta)
            k3 = slope(a + 0.5 * _STEP * k2, eta)
            k4 = slope(a + _STEP * k3, eta)
            a = a + _STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            # Beyond the belt speed a mass sticks, and the damping here means nothing.
            most = jnp.maximum(most, jnp.abs(a[0]))
            return (jnp.where(most > speed, 0.0, a), most), None

        start = jnp.zeros(_QUIET, complex), jnp.zeros(())
        (_, most), _ = lax.scan(step, start, None, length=_STEPS)
        return most > speed

    ends = jnp.log(jnp.asarray(1e-4)), jnp.log(jnp.asarray(highest, float))
    low, high = bisect(lambda logarithm: ~drawn_in(jnp.exp(logarithm)), *ends, 12)
    return jnp.exp(0.5 * (low + high))


def death_belt_speed(
    chain: Chain, coupling: Any, detuning: Any, fold: Callable[[Chain], Array]
) -> Float[Array, ""]:
    """The belt speed above which the last mass of a block stops vibrating, at the worst phase.

    If it leads the next mass of the block by a quarter of a period, the spring between them acts
    like an additional damping of eta / 2; the quiet chain on its other side acts like

        Re [sqrt(z^2 + eta^2) - z] / 2,      z = g(0) + i detuning;

    the vibration of one mass with this additional damping ends at the fold.  `chain` is one mass;
    `fold` gives the belt speed up to which its vibration survives, such as
    `fold_belt_speed` of a dry chain.
    """
    eta = jnp.asarray(coupling, float)

    def of(speed: Array) -> Array:
        z = -growth_rate(chain, speed) + 1j * detuning
        leak = 0.5 * jnp.real(jnp.sqrt(z**2 + eta**2) - z)
        return fold(chain.with_(damping_ratio=chain.damping_ratio + 0.5 * eta + leak))

    # The radiation loss hardly depends on the belt speed: a few iterations converge.
    speed = of(jnp.asarray(1.7))
    return of(of(speed))
