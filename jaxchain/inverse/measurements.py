"""Measurements of a chain, and their prediction by a chain."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import (
    check_finite,
    check_function,
    check_kind,
    check_positive,
    require_x64,
    shown,
    to_float,
)
from .._final import final
from ..boundaries.fold import fold_belt_speed
from ..boundaries.hopf import hopf_belt_speed
from ..model.chain import Chain, steady_sliding
from ..model.initial_states import check_mass, on_the_belt
from ..observers.amplitude import Amplitude
from ..observers.quantities import active
from ..result import Printed
from ..simulation.event_driven import EventDriven
from ..simulation.run import simulate

# Some periods: from the belt a run reaches its stick-slip cycle within one or two.
_SPAN, _WINDOW = 40.0, 14.0
# Amplitudes have errors of about 1e-9; a series of low order compiles in half the time.
_ORDER, _RTOL = 7, 1e-8


@final
class Measurements(Printed, eqx.Module):
    """Measurements of a chain, with the standard deviation of their noise (dimensionless).

    **Arguments:** None for what was not measured.

    - `hopf`, `fold`: (belt speed, noise).
    - `amplitudes`: (belt speeds, amplitudes of the vibrating mass, noise), shapes (k,); the noise
      may be one number.
    - `displacements`: (belt speeds, displacements of that mass in steady sliding, noise), with the
      same shapes. For one mass only these separate mu_static from mu_dynamic: an equal change of
      both changes only its position in steady sliding.

    **Raises:** `ValueError` for numbers that are not finite, noise that is not positive, different
    shapes, or no measurement.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.inverse import Measurements
    >>> Measurements(hopf=(1.15, 0.01), amplitudes=([1.0, 1.5], [1.4, 1.6], 0.01)).count
    3
    """

    hopf: tuple[Array, Array] | None
    fold: tuple[Array, Array] | None
    amplitudes: tuple[Array, Array, Array] | None
    displacements: tuple[Array, Array, Array] | None

    def __init__(
        self, hopf: Any = None, fold: Any = None, amplitudes: Any = None, displacements: Any = None
    ):
        require_x64()
        self.hopf = None if hopf is None else _reading("hopf", hopf, 0)
        self.fold = None if fold is None else _reading("fold", fold, 0)
        self.amplitudes = None if amplitudes is None else _reading("amplitudes", amplitudes, 1)
        self.displacements = (
            None if displacements is None else _reading("displacements", displacements, 1)
        )
        if not self._all():
            raise ValueError("`Measurements` must hold at least one measurement, but has none.")

    def _all(self) -> list:
        every = (self.hopf, self.fold, self.amplitudes, self.displacements)
        return [reading for reading in every if reading is not None]

    @property
    def values(self) -> Float[Array, " m"]:
        """All measured values: Hopf, fold, amplitudes, displacements."""
        return jnp.concatenate([jnp.atleast_1d(reading[-2]) for reading in self._all()])

    @property
    def noise(self) -> Float[Array, " m"]:
        """Standard deviations of all measured values, in the order of `values`, shape (m,)."""
        return jnp.concatenate([jnp.atleast_1d(reading[-1]) for reading in self._all()])

    @property
    def count(self) -> int:
        """The number of measured values, m."""
        return self.values.size


def _reading(name: str, given: Any, ndim: int) -> Any:
    length = 2 + ndim
    if not isinstance(given, tuple) or len(given) != length:
        wanted = "(belt speed, noise)" if ndim == 0 else "(belt speeds, values, noise)"
        raise ValueError(f"Argument `{name}` must be a tuple {wanted}, but is {shown(given)}.")
    parts = [to_float(part, name) for part in given]
    shape = parts[0].shape
    fits = len(shape) == ndim and parts[-2].shape == shape and parts[-1].shape in ((), shape)
    if not fits or parts[0].size == 0:
        raise ValueError(
            f"Argument `{name}` must hold {'numbers' if ndim == 0 else 'arrays of one length'}, "
            f"but has shapes {[part.shape for part in parts]}."
        )
    for part in parts[:-1]:
        check_finite(name, part, "leave out what could not be measured.")
    check_positive(
        f"{name}[-1]", parts[-1], "the last is the noise, a standard deviation such as 0.01."
    )
    return (*parts[:-1], jnp.broadcast_to(parts[-1], shape))


def check_measurements(measurements: Any) -> None:
    """Raises `ValueError` unless they are `Measurements`."""
    remedy = "`Measurements(hopf=(1.15, 0.01))`, say."
    check_kind("measurements", measurements, Measurements, "`Measurements`", remedy)


def check_change(change: Any, chain: Chain, theta: Any) -> None:
    """Raises `ValueError` unless `change` makes a chain of a chain and unknowns."""
    check_function("change", change, "chain, theta -> the chain with these numbers", 2)
    made = eqx.filter_eval_shape(change, chain, theta)
    check_kind("change", made, Chain, "a function that returns a `Chain`", "see `Chain.with_`.")


def predict(chain: Chain, measurements: Measurements, mass: Any = None) -> Float[Array, " m"]:
    """The values that `chain` predicts for `measurements.values`.

    For a dry chain: the Hopf speed, the grazing-sliding fold, and amplitudes (half peak-to-peak)
    of event-driven runs that start on the belt (`on_the_belt`).  For a smoothed chain: the same
    quantities at its width.  NaN if there is no such fold or vibration.  It has forward
    derivatives, including the jumps at sticking and release, and works under `jit` and `vmap`.

    **Arguments:** `measurements`: only their belt speeds are used;
    `mass`, the index (from 0) of the mass, by default n // 2.

    **Returns:** shape (m,), dimensionless, in the order of `measurements.values`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.inverse import Measurements, predict
    >>> lab = Measurements(hopf=(1.15, 0.01), displacements=([1.5], [0.5], 0.01))
    >>> predict(paper_chain(n=1, width=None), lab).round(4).tolist()
    [1.1513, 0.5249]
    """
    mass = check_mass(chain, mass)
    check_measurements(measurements)
    parts = []

    def at(speed: Array) -> Chain:
        return eqx.tree_at(lambda c: c.belt_speed, chain, speed)

    def amplitude(speed: Array) -> Array:
        run = simulate(
            at(speed),
            on_the_belt(at(speed), mass),
            _SPAN,
            observe=Amplitude(window=_WINDOW),
            solver=EventDriven(_ORDER) if chain.dry else None,
            rtol=_RTOL,
            throw=False,
        ).observed
        return jnp.where(active(run, speed)[mass], run[mass], jnp.nan)

    def displacement(speed: Array) -> Array:
        return steady_sliding(at(speed))[0][mass]

    if measurements.hopf is not None:
        parts.append(hopf_belt_speed(chain)[None])
    if measurements.fold is not None:
        parts.append(fold_belt_speed(chain, mass)[None])
    if measurements.amplitudes is not None:
        parts.append(jax.vmap(amplitude)(measurements.amplitudes[0]))
    if measurements.displacements is not None:
        parts.append(jax.vmap(displacement)(measurements.displacements[0]))
    return jnp.concatenate(parts)
