"""The rotations and reflections of a ring, and the ways in which a cycle may lose some of them.

A motion is an index array: the image of a state has y[motion] for y.  The motions that leave a
cycle unchanged make masses move alike: `images` has for each mass the least index of those that
move like it.  Others leave it unchanged up to a shift of time, x_motion[n](t + T j / k) = x_n(t),
as in antiphase states and rotating waves; they are those of `shift` = (motion, k), j = 1, and
what it makes together with the first.  One motion has one shift.

An element acts on a disturbance v of a multiplier +1 as v -> (D v)[motion], D the derivative of
the flow over the time of its shift.  The isotropy subgroup of v has the elements that leave it
unchanged.  Where several multipliers are +1 together, a branch leaves along each v whose subgroup
leaves no other disturbance of these unchanged, up to a factor (the equivariant branching lemma:
Golubitsky, Stewart, Schaeffer, Singularities and Groups in Bifurcation Theory II, Springer 1988,
chapter XIII).  Among the disturbances with this subgroup it is a simple branch point.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Iterable
from fractions import Fraction
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._checks import check_concrete, check_positive_number, is_traced, shown
from .._types import Given, ScalarLike, State, StateLike
from ..model.arguments import as_images
from ..model.model import AbstractModel
from ..observers.samples import Trajectory
from ..simulation.run import simulate
from .floquet import CYCLE_RTOL, LimitCycle, as_orbit, check_orbit
from .variational import Shift, powers

# Of the force, beside 0, at which a symmetry must hold, too.
_PHASE = 0.37
# Two entries of a disturbance of length 1 that are the same.
_SAME = 1e-5
# How close to +1 multipliers of one special point are.
_UNIT = 1e-5


def ring_motions(field: AbstractModel, state: State) -> list[np.ndarray]:
    """The rotations and reflections under which the equations keep their form.

    **Returns:** index arrays of shape (n,): the image of a state has y[image] for y.  A motion
    counts if the rate of an image is the image of the rate near the state, of a forced model at
    two phases of the force.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain, steady_sliding
    >>> from jaxchain.cycles.symmetry import ring_motions
    >>> ring = paper_chain(6)
    >>> row = ring.with_(ends="free")
    >>> [len(ring_motions(chain, steady_sliding(chain))) for chain in (ring, row)]
    [12, 2]
    """
    n, sites = state[0].shape[0], np.arange(state[0].shape[0])
    draws = np.random.default_rng(0).normal(size=(len(state), n))
    near = tuple(part + (1.0 + jnp.abs(part)) * d for part, d in zip(state, draws, strict=True))
    forced = field.forcing_period()
    times = (0.0,) if forced is None else (0.0, _PHASE * float(forced))

    def rate(at: np.ndarray) -> np.ndarray:
        moved = tuple(part[at] for part in near)
        return np.stack([np.stack([np.asarray(part) for part in field(t, moved)]) for t in times])

    here = rate(sites)
    images = {tuple((s + way * sites) % n) for s in range(n) for way in (1, -1)}
    motions = [np.array(image) for image in sorted(images)]
    least = 1e-9 * np.max(np.abs(here))
    return [at for at in motions if np.max(np.abs(rate(at) - here[..., at])) <= least]


class CycleSymmetry(NamedTuple):
    """The symmetry of a cycle, or a subgroup to which it may lose it.

    - `label`: "D4" for 4 rotations and as many reflections, "Z4" without reflections; of a single
      reflection also where its axis passes; "Z4, T/4" if some belong to shifts of time, by a
      quarter of the period at least.
    - `images`: entry i is the index of the mass that moves like mass i.
    - `mirrored`: whether both halves of the branch that leaves are images of each other.
    - `shift`: (motion, k) if mass motion[n] moves like mass n a time T / k later, or None.

    See `cycle_symmetry` for an example.
    """

    label: str
    images: tuple[int, ...]
    mirrored: bool = False
    shift: Shift | None = None


# `images` and `shift`.
Symmetry = tuple[tuple[int, ...], Shift | None]
# What a cycle keeps: its motions as tuples, with their shifts as shares of the period.
Elements = dict[tuple[int, ...], Fraction]


def cycle_symmetry(
    model: Given[AbstractModel | LimitCycle],
    state: Given[StateLike | None] = None,
    period: Given[ScalarLike | None] = None,
    *,
    tolerance: Given[ScalarLike] = 1e-6,
) -> CycleSymmetry:
    """The rotations and reflections of a ring that leave a cycle unchanged, also up to a shift.

    **Arguments:** a `LimitCycle` alone, or a model with a state on the cycle and its period;
    `tolerance`: the greatest distance of two states that are the same, relative to the size of
    the orbit.

    **Returns:** a `CycleSymmetry`, for the argument `images` of `find_limit_cycle` and
    `continue_cycle`.  A forced cycle has no shift.

    **Raises:** `ValueError` for bad input.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle, paper_chain
        >>> from jaxchain.cycles import cycle_symmetry
        >>> alone = find_limit_cycle(paper_chain(1, belt_speed=1.2, width=0.1))
        >>> half = (-alone.state[0] + 0.6, -alone.state[1])  # nearly half a period later
        >>> start = tuple(jnp.tile(jnp.concatenate(pair), 2) for pair in zip(alone.state, half))
        >>> ring = paper_chain(4, belt_speed=1.2, width=0.1)
        >>> cycle_symmetry(find_limit_cycle(ring, (start, alone.period))).label
        'D4, T/2'
    """
    field, state, time = as_orbit(model, state, period)
    check_concrete("call it outside `jit`.", model=field, state=state, period=time)
    state = check_orbit(field, state, time, CYCLE_RTOL)
    check_positive_number("tolerance", tolerance, "1e-6 is usual.")
    n, forced = state[0].size, field.forcing_period() is not None
    motions, k = ring_motions(field, state), 1 if forced else int(np.lcm(n, 2))
    times = float(time) * np.arange(k + 1) / k
    run = simulate(field, state, times[-1], observe=Trajectory(times), rtol=1e-9)
    orbit = np.stack(run.observed)  # (m, k + 1, n)
    size = np.max(np.ptp(orbit, axis=1)) or 1.0
    found: Elements = {}
    for at in motions:
        gaps = np.max(np.abs(orbit[:, :-1, at] - np.stack(state)[:, None]), axis=(0, 2))
        if np.any(same := gaps <= tolerance * size):
            found[tuple(at.tolist())] = Fraction(int(np.argmax(same)), k)
    images, shift = _described(found)
    return CycleSymmetry(label_of(motions, images, shift), images, shift=shift)


def as_symmetry(
    images: Any, model: AbstractModel, state: State, mass: int | None = None
) -> Symmetry:
    """(`images`, `shift`) from `images` or a `CycleSymmetry`, with `mass` solved for."""
    n = state[0].shape[0]
    if not isinstance(images, CycleSymmetry):
        return as_images(images, n, mass), None
    same, shift = as_images(images.images, n), images.shift
    if mass is not None:
        same = tuple(mass if image == same[mass] else image for image in same)
    if shift is None:
        return same, None
    motion, k = shift
    if model.forcing_period() is not None:
        raise ValueError(
            f"Argument `images` has the shift {shown(shift)}, but the cells are forced: a force "
            "that acts on all of them has no symmetry under a shift of time."
        )
    traced = is_traced(model, state)
    every = [] if traced else [tuple(at.tolist()) for at in ring_motions(model, state)]
    whole = isinstance(k, int) and k > 1 and (traced or tuple(motion) in every)
    if not whole or not _fits(same, (tuple(motion), k)):
        raise ValueError(
            f"Argument `images` has the shift {shown(shift)}, but it must be (motion, k) with a "
            "rotation or reflection of the ring that leads after k times to masses that move "
            "alike: `cycle_symmetry` finds it."
        )
    return same, (tuple(motion), k)


def _fits(images: tuple[int, ...], shift: Shift) -> bool:
    """Whether masses that move alike do so after the motion, and k motions lead to such."""
    motion, k = shift
    classes = np.asarray(images)
    last = powers((motion, k + 1))[-1]
    moved = classes[np.asarray(motion)]
    alike = moved[:, None] == moved
    kept = np.array_equal(alike, classes[:, None] == classes)
    return kept and np.array_equal(classes[last], classes)


def alike(motions: Iterable[Any], n: int) -> tuple[int, ...]:
    """`images` of the cycles that a group of motions leaves unchanged."""
    return tuple(np.min([np.arange(n), *map(np.asarray, motions)], axis=0).tolist())


def elements(
    motions: list[np.ndarray], images: tuple[int, ...], shift: Shift | None = None
) -> Elements:
    """What leaves cycles with these `images` and this `shift` unchanged."""
    classes = np.asarray(images)
    kept = [at for at in motions if np.array_equal(classes[at], classes)]
    every = [np.arange(len(images))] if shift is None else powers(shift)
    return {
        tuple(at[power].tolist()): Fraction(j, len(every))
        for j, power in enumerate(every)
        for at in kept
    }


def _described(group: Elements) -> Symmetry:
    """`images` and `shift` of what leaves a cycle unchanged."""
    n = len(next(iter(group)))
    images = alike((at for at, share in group.items() if share == 0), n)
    least, at = min(((share, at) for at, share in group.items() if share > 0), default=(1, ()))
    return images, (at, Fraction(least).denominator) if at else None


def label_of(
    motions: list[np.ndarray], images: tuple[int, ...], shift: Shift | None = None
) -> str:
    """The name of the subgroup that leaves cycles with this symmetry unchanged."""
    kept, sites = [np.array(at) for at in elements(motions, images, shift)], np.arange(len(images))
    rotations = [at for at in kept if np.array_equal(at, (at[0] + sites) % len(sites))]
    name = f"Z{len(kept)}"
    if len(sites) > 2 and len(rotations) < len(kept):
        name = f"D{len(rotations)}"
    if name == "D1":
        (axis,) = (at for at in kept if not np.array_equal(at, sites))
        through = np.flatnonzero(axis == sites)
        where = f"through mass {through[0]}" if through.size else "between masses"
        name = f"D1 (axis {where})"
    return name if shift is None else f"{name}, T/{shift[1]}"


def _composed(one: tuple[int, ...], other: tuple[int, ...]) -> tuple[int, ...]:
    """One motion after the other."""
    return tuple(one[i] for i in other)


def _generated(group: Elements, pair: Iterable[tuple[int, ...]]) -> Elements:
    """What two elements make together."""
    first = tuple(range(len(next(iter(group)))))
    found, new, pair = {first: Fraction(0)}, [first], list(pair)
    while new:
        at = new.pop()
        for other in pair:
            both = _composed(other, at)
            if both not in found:
                found[both] = group[both]
                new.append(both)
    return found


def finer(
    motions: list[np.ndarray], images: tuple[int, ...], shift: Shift | None = None
) -> list[Symmetry]:
    """(`images`, `shift`) of cycles with less symmetry, one of each class of conjugate subgroups.

    The first has none.
    """
    group = elements(motions, images, shift)
    seen: set[frozenset] = set()
    found = []
    for pair in itertools.combinations_with_replacement(group, 2):
        # All that leaves the cycles of these two unchanged.
        fewer, later = _described(_generated(group, pair))
        own = elements(motions, fewer, later)
        if len(set(fewer)) == len(set(images)):
            fewer = images
        # Masses that move alike and lose a part of their shifts only: a half, by a multiplier -1.
        thirds = fewer == images and len(group) != 2 * len(own)
        if len(own) == len(group) or thirds or frozenset(own) in seen:
            continue
        for at in group:
            back = tuple(np.argsort(at).tolist())
            seen.add(frozenset(_composed(at, _composed(g, back)) for g in own))
        found.append((fewer, later))
    return sorted(found, key=lambda less: (-len(set(less[0])), less[1] is not None))


def action(part: Any, shift: Shift | None, at: Iterable[int], power: int, m: int) -> Any:
    """The matrix of v -> (D v)[at], D over the time `power` T / k; `part` is Q of `shift`.

    D = P^-power Q^power, P the motion of `shift`; without one k = 1 and Q = M.
    """
    Q = functools.reduce(operator.matmul, [part] * power) if power else np.eye(len(part))
    at, n = np.asarray(at), len(part) // m
    if shift is not None:
        at = np.argsort(powers((shift[0], power + 1))[-1])[at]
    return Q.reshape(m, n, -1)[:, at].reshape(m * n, -1)


def isotropy(
    motions: list[np.ndarray],
    images: tuple[int, ...],
    v: np.ndarray,
    shift: Shift | None = None,
    part: Any = None,
) -> tuple[Symmetry, bool]:
    """((`images`, `shift`) of cycles disturbed by v of shape (m, n), whether v maps onto -v).

    With a shift `part` is its Q.
    """
    group, (m, n), k = elements(motions, images, shift), v.shape, 1 if shift is None else shift[1]
    part, w = np.eye(m * n) if part is None else part, v.reshape(-1)
    moved = {g: action(part, shift, g, int(share * k), m) @ w for g, share in group.items()}
    same = {g: group[g] for g, image in moved.items() if np.max(np.abs(image - w)) < _SAME}
    return _described(same), any(np.max(np.abs(image + w)) < _SAME for image in moved.values())


def symmetry_breaking_basis(
    images: tuple[int, ...], m: int = 2, kept: tuple[int, ...] | None = None
) -> Float[np.ndarray, "two_n k"]:
    """An orthonormal basis of the disturbances of a state that break the symmetry of `images`.

    Those only that keep the symmetry of `kept`, by default none; all of these if it is the same.
    """
    groups = np.asarray(images)[:, None] == np.unique(images)[None, :]
    less = np.asarray(range(len(images)) if kept is None else kept)
    within = (less[:, None] == np.unique(less)[None, :]).astype(float)
    within /= np.sqrt(np.sum(within, axis=0))
    rest = np.linalg.svd(within.T @ groups)[0][:, groups.shape[1] :]
    return np.kron(np.eye(m), within if kept == images else within @ rest)


def breaking_block(
    part: Any, symmetry: Symmetry, kept: Symmetry, m: int
) -> tuple[Any, Any, float]:
    """(basis A, block, at): all but `kept` breaks where the block has the eigenvalue `at`.

    The block is A^T Q A, Q the derivative over the shift of `kept`; `part` is the derivative over
    the shift of `symmetry`.
    If only shifts are lost, it is Q itself in disturbances that keep `images`, and `at` = -1.
    """
    images, shift = symmetry
    basis = symmetry_breaking_basis(images, m, kept[0])
    if kept[0] == images:
        return basis, basis.T @ part @ basis, -1.0
    at, share = kept[1] or (range(len(images)), 1)
    whole = 1 if shift is None else shift[1]
    return basis, basis.T @ action(part, shift, at, whole // share, m) @ basis, 1.0


def breaking_disturbance(
    part: Any, symmetry: Symmetry, kept: Symmetry, m: int
) -> tuple[int, Float[np.ndarray, " two_n"]]:
    """(how many multipliers are +1, a disturbance of the last of them)."""
    basis, block, at = breaking_block(np.asarray(part), symmetry, kept, m)
    null = basis @ np.linalg.svd(block - at * np.eye(len(block)))[2][-1]
    return int(np.sum(np.abs(np.linalg.eigvals(block) - at) < _UNIT)), null


def subgroups(
    part: Any, symmetry: Symmetry, motions: list[np.ndarray], m: int
) -> tuple[CycleSymmetry, ...]:
    """The subgroups along which branches leave a symmetry breaking."""
    (images, shift), found = symmetry, []
    for kept in finer(motions, images, shift):
        count, null = breaking_disturbance(part, symmetry, kept, m)
        less, mirrored = isotropy(motions, images, null.reshape(m, -1), shift, np.asarray(part))
        if count == 1 and elements(motions, *less) == elements(motions, *kept):
            label = label_of(motions, *kept)
            found.append(CycleSymmetry(label, kept[0], mirrored, kept[1]))
    return tuple(found)
