"""What is observed along a run; whatever nobody observes is not computed.

An observer keeps a small accumulator that travels with the solver and is updated after every
accepted step from the step's own dense output, so that turning points are found between steps and
no trajectory is stored.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators


class Step(eqx.Module):
    """One accepted step as an observer sees it: from (t0, y0) to (t1, y1).

    `displacement(theta)` and `velocity(theta)` interpolate at theta in [0, 1], one number or one
    per mass.
    """

    field: AbstractOscillators
    t0: Any
    t1: Any
    y0: State
    y1: State
    displacement: Callable[[Any], Array]
    velocity: Callable[[Any], Array]

    def turning_points(self) -> tuple[Bool[Array, " n"], Float[Array, " n"]]:
        """(which masses turn within the step, at which theta).

        Secant for the zero of the velocity, then two Newton steps on the interpolant; the
        displacement there is accurate to second order in the error of theta.
        """
        v0, v1 = self.y0[1], self.y1[1]
        turns = (v0 > 0) & (v1 <= 0) | (v0 < 0) & (v1 >= 0)
        theta = jnp.where(turns, v0 / jnp.where(turns, v0 - v1, 1.0), 1.0)
        for _ in range(2):
            v, slope = jax.jvp(self.velocity, (theta,), (jnp.ones_like(theta),))
            slope = jnp.where(slope == 0, 1.0, slope)
            theta = jnp.clip(theta - jnp.where(turns, v / slope, 0.0), 0.0, 1.0)
        return turns, lax.stop_gradient(theta)


class AbstractObserver(eqx.Module):
    """init -> update after every accepted step -> read.

    `settled` says whether the observed value can be taken as final already; a run may stop early
    when every observer says so.
    """

    @abc.abstractmethod
    def init(self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        """The accumulator at the start of a run of `field` over [t0, t1]."""

    @abc.abstractmethod
    def update(self, accumulator: Any, step: Step) -> Any:
        """The accumulator after one more accepted step."""

    @abc.abstractmethod
    def settled(self, accumulator: Any) -> Bool[Array, ""] | None:
        """Whether the value is final; None if it never is before the end."""

    def rests(self, accumulator: Any) -> Bool[Array, ""]:
        """Whether it is final because every mass rests."""
        del accumulator
        return jnp.asarray(False)

    @abc.abstractmethod
    def read(self, accumulator: Any) -> Any:
        """The observed value."""
