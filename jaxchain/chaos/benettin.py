"""Disturbances that travel along an orbit and are kept apart by QR: Benettin's method.

G. Benettin, L. Galgani, A. Giorgilli, J.-M. Strelcyn, Lyapunov characteristic exponents for smooth
dynamical systems, Meccanica 15, 9 (1980); for dry friction P. Mueller, Calculation of Lyapunov
exponents for dynamic systems with discontinuities, Chaos, Solitons and Fractals 5, 1671 (1995).
The order of states is (x_1 .. x_n, v_1 .. v_n).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._types import State
from ..model.oscillators import AbstractOscillators
from ..result import Result
from ..simulation.plan import AbstractPlan, Progress
from ..simulation.smoothed import SmoothedPlan

# What is left of a column after the ones before it have been taken out of it, relative to its
# length: below this it is rounding, that of some hundred steps times a condition of some thousand.
RESOLVED = 1e-10


class Frame(eqx.Module):
    """A run under way and orthonormal disturbances of its state, the columns of `basis`."""

    progress: Progress
    basis: Float[Array, "two_n count"]


class Span(eqx.Module):
    """`number` intervals of length `interval` from `start` on.

    The middle of interval k lies at the share `phase` + k `phase_step` of the whole window.
    """

    start: Float[Array, ""]
    interval: Float[Array, ""]
    number: Int[Array, ""]
    phase: Float[Array, ""]
    phase_step: Float[Array, ""]


class Growth(eqx.Module):
    """What was gathered in a span.

    - `logs`: sum of log R_ii; `weighted`: that of w log R_ii with the weights of `bump`, and
      `weights`: sum of w times the length of the interval.
    """

    logs: Float[Array, " count"]
    weighted: Float[Array, " count"]
    weights: Float[Array, ""]


def random_basis(seed: Any, dimension: int, count: int) -> Float[Array, "{dimension} {count}"]:
    """Orthonormal columns in arbitrary directions, the same for the same seed."""
    draws = jax.random.normal(jax.random.key(seed), (dimension, count), dtype=float)
    return jnp.linalg.qr(draws)[0]


def bump(share: Any) -> Any:
    """exp(-1 / (s (1 - s))), s in (0, 1): smooth, and zero at both ends with all derivatives."""
    product = share * (1.0 - share)
    inside = product > 0
    return jnp.where(inside, jnp.exp(-1.0 / jnp.where(inside, product, 1.0)), 0.0)


def orthonormalise(
    images: Float[Array, "two_n count"],
) -> tuple[Float[Array, "two_n count"], Float[Array, " count"]]:
    """(Q, log |R_ii|) of images = Q R, by Householder reflections.

    A column that depends on the ones before it, to rounding, has the log NaN.  Its place in Q is
    taken by some direction at right angles to all others, and the columns before it do not notice.

    >>> import jax.numpy as jnp
    >>> Q, logs = orthonormalise(jnp.array([[2.0, 2.0], [0.0, 0.0], [0.0, 0.0]]))
    >>> jnp.round(jnp.exp(logs), 12).tolist(), bool(jnp.allclose(Q.T @ Q, jnp.eye(2)))
    ([2.0, nan], True)
    """
    basis, R = jnp.linalg.qr(images)
    left, length = jnp.abs(jnp.diagonal(R)), jnp.linalg.norm(images, axis=0)
    seen = left > RESOLVED * length
    return basis, jnp.where(seen, jnp.log(jnp.where(seen, left, 1.0)), jnp.nan)


def advance_frame(
    plan: AbstractPlan, field: AbstractOscillators, frame: Frame, t1: Any, max_steps: int | None
) -> tuple[Frame, Float[Array, "two_n count"]]:
    """(the run at t1, with the basis as it was; the images of the basis there).

    The derivative of the discrete steps, sizes held; the steps themselves are computed once,
    however many disturbances there are.
    """
    n = frame.progress.state[0].shape[0]

    def after(flat: Array) -> tuple[Array, Progress]:
        begun = _resume(plan, field, frame.progress, (flat[:n], flat[n:]), t1)
        progress, _ = plan.advance(field, begun, t1, max_steps=max_steps)
        return jnp.concatenate(progress.state), progress

    start = jnp.concatenate(frame.progress.state)

    def push(direction: Array) -> tuple[Array, Array, Progress]:
        return jax.jvp(after, (start,), (direction,), has_aux=True)

    _, images, progress = jax.vmap(push, in_axes=1, out_axes=(None, 1, None))(frame.basis)
    return Frame(progress, frame.basis), images


def _resume(
    plan: AbstractPlan, field: AbstractOscillators, progress: Progress, state: State, t1: Any
) -> Progress:
    """The run with `state` in its place, and everything that depends on it smoothly made anew.

    A Runge-Kutta method may keep the slope at the end of a step for the next one.
    """
    moved = eqx.tree_at(lambda p: p.state, progress, state)
    if not isinstance(plan, SmoothedPlan):
        return moved  # sticking or sliding does not depend smoothly on anything
    fresh = plan.begin(field, state, progress.t, t1).memory
    kept = progress.memory
    memory = eqx.tree_at(
        lambda m: (m.step_size, m.controller), fresh, (kept.step_size, kept.controller)
    )
    return eqx.tree_at(lambda p: p.memory, moved, memory)


def advance_span(
    plan: AbstractPlan,
    field: AbstractOscillators,
    frame: Frame,
    span: Span,
    max_steps: int | None,
) -> tuple[Frame, Growth]:
    """The frame after a span, orthonormal again after every interval of it.

    Observers start anew with it.
    """
    begun, end = frame.progress, span.start + span.number * span.interval
    fresh = [o.init(field, begun.t, end, begun.state) for o in plan.observers]
    frame = eqx.tree_at(lambda f: f.progress.accumulators, frame, fresh)
    zero = jnp.zeros(frame.basis.shape[1])

    def one(k: Any, carry: tuple[Frame, Growth]) -> tuple[Frame, Growth]:
        frame, growth = carry
        end = span.start + (k + 1) * span.interval
        frame, images = advance_frame(plan, field, frame, end, max_steps)
        basis, logs = orthonormalise(images)
        progress = frame.progress
        lost = progress.running & jnp.any(jnp.isnan(images))
        result = Result.where(lost, Result.nonfinite, progress.result)
        progress = eqx.tree_at(lambda p: p.result, progress, result)
        weight = bump(span.phase + k * span.phase_step)
        return Frame(progress, basis), Growth(
            growth.logs + logs,
            growth.weighted + jnp.where(weight > 0, weight * logs, 0.0),
            growth.weights + weight * span.interval,
        )

    return lax.fori_loop(0, span.number, one, (frame, Growth(zero, zero, jnp.zeros(()))))
