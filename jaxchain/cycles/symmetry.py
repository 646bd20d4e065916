"""The rotations and reflections of a ring, and the ways in which a cycle may lose some of them.

A motion is an index array: the image of a state has y[motion] for y.  The motions that leave a
cycle unchanged make masses move alike: `images` has for each mass the least index of those that
move like it.  A disturbance v of a multiplier +1 has an isotropy subgroup, the motions with
v[motion] = v.  Where several multipliers are +1 together, a branch leaves along each v whose
subgroup leaves no other disturbance of these unchanged, up to a factor (the equivariant branching
lemma: Golubitsky, Stewart, Schaeffer, Singularities and Groups in Bifurcation Theory II, Springer
1988, chapter XIII).  Among the disturbances with this subgroup it is a simple branch point.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .._types import State
from ..model.cells import AbstractField

# Of the force, beside 0, at which a symmetry must hold, too.
_PHASE = 0.37
# Two entries of a disturbance of length 1 that are the same.
_SAME = 1e-5


def ring_motions(field: AbstractField, state: State) -> list[np.ndarray]:
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
    """A subgroup to which a cycle may lose its symmetry.

    - `label`: "D4" for 4 rotations and as many reflections, "Z4" without reflections; of a single
      reflection also where its axis passes.
    - `images`: entry i is the index of the mass that moves like mass i.
    - `mirrored`: whether both halves of the branch are images of each other.
    """

    label: str
    images: tuple[int, ...]
    mirrored: bool


def alike(motions: list[np.ndarray], n: int) -> tuple[int, ...]:
    """`images` of the cycles that all these motions leave unchanged."""
    images = np.arange(n)
    for _ in range(n):
        for at in motions:
            images = np.minimum(images, images[at])
    return tuple(images.tolist())


def keeping(motions: list[np.ndarray], images: tuple[int, ...]) -> list[np.ndarray]:
    """The motions that leave cycles with these `images` unchanged."""
    classes = np.asarray(images)
    return [at for at in motions if np.array_equal(classes[at], classes)]


def label_of(motions: list[np.ndarray], images: tuple[int, ...]) -> str:
    """The name of the subgroup of motions that leave cycles with these `images` unchanged."""
    kept, sites = keeping(motions, images), np.arange(len(images))
    turns = [at for at in kept if np.array_equal(at, (at[0] + sites) % len(sites))]
    if len(sites) < 3 or len(turns) == len(kept):
        return f"Z{len(kept)}"
    if len(turns) > 1:
        return f"D{len(turns)}"
    (axis,) = (at for at in kept if not np.array_equal(at, sites))
    through = np.flatnonzero(axis == sites)
    return f"D1 (axis through mass {through[0]})" if through.size else "D1 (axis between masses)"


def finer(motions: list[np.ndarray], images: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The `images` of cycles with less symmetry, one of each class of conjugate subgroups.

    The first has none.
    """
    n, group = len(images), keeping(motions, images)
    found = {tuple(range(n)): tuple(range(n))}
    for pair in itertools.combinations_with_replacement(group, 2):
        less = alike(list(pair), n)
        if len(set(less)) > len(set(images)):
            conjugate = min(_canonical(np.asarray(less)[at]) for at in group)
            found.setdefault(conjugate, less)
    return list(found.values())


def _canonical(classes: np.ndarray) -> tuple[int, ...]:
    first = {c: i for i, c in reversed(list(enumerate(classes.tolist())))}
    return tuple(first[c] for c in classes.tolist())


def isotropy(
    motions: list[np.ndarray], images: tuple[int, ...], v: np.ndarray
) -> tuple[tuple[int, ...], bool]:
    """(`images` of cycles disturbed by v of shape (m, n), whether a motion maps v onto -v)."""
    group = keeping(motions, images)
    same = [at for at in group if np.max(np.abs(v[:, at] - v)) < _SAME]
    opposite = any(np.max(np.abs(v[:, at] + v)) < _SAME for at in group)
    return alike(same, v.shape[1]), opposite
