"""Regions of initial states, and their sampling.

A region maps a point of the unit cube to a state.  So the same points give starts at every
parameter, and a low-discrepancy sequence fills any region.  `Box`, `Ball` and `Gaussian` need the
steady sliding of a `Chain`; `Ranges` and `Sampler` make states of any model.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Float
from scipy.stats import qmc

from .._checks import (
    as_array,
    check_finite,
    check_function,
    check_kind,
    check_positive_number,
    check_whole,
    is_traced,
    named,
    numbers_of,
    shown,
)
from .._printing import PrintedAsCall
from .._types import State
from ..model.arguments import as_chain
from ..model.chain import Chain, steady_sliding
from ..model.model import AbstractModel

_EDGES = "give (low, high), as (-2, 2)."
_STATE = "give m arrays of shape (n,), one for each number of a cell."
_MASSES = "give None for all masses, or indices from 0, as (0, 1)."
# The longest sequence of `scipy.stats.qmc.Sobol`: as many points of 64 bits.
_BITS = 62
# Where the normal distribution is cut off: at 8.2 standard deviations.
_LEAST = 2.0**-53


def _edges(name: str) -> Callable[[Any], Float[Array, "..."]]:
    return lambda value: as_array(name, value, 1, 1, _EDGES)


def _indices(value: Any) -> Any:
    """A tuple of whole numbers, or the argument as given, which the check then rejects."""
    if isinstance(value, list | tuple | range | np.ndarray):
        return tuple(value.tolist() if isinstance(value, np.ndarray) else value)
    return value


def _check_masses(masses: Any) -> None:
    if masses is None:
        return
    if not isinstance(masses, tuple) or not masses:
        raise ValueError(f"Argument `masses` must be indices, but is {shown(masses)}: {_MASSES}")
    for mass in masses:
        check_whole("masses", mass, 0, remedy=_MASSES)
    if len(set(masses)) < len(masses):
        raise ValueError(f"Argument `masses` must be different, but is {shown(masses)}: {_MASSES}")


class AbstractRegion(PrintedAsCall, eqx.Module):
    """A region of initial states: a map from the unit cube to states.

    Uniform points of the cube give states with the distribution of the region.  A subclass defines
    `dimension`, that of the cube, and `start`, which JAX must be able to trace.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, steady_sliding
        >>> from jaxchain.basins import AbstractRegion
        >>> class Shaken(AbstractRegion):  # all masses at one velocity, up to `most`
        ...     most: float
        ...     def dimension(self, chain):
        ...         return 1
        ...     def start(self, chain, point):
        ...         x, v = steady_sliding(chain)
        ...         return x, v + self.most * point[0]
        >>> x, v = Shaken(2.0).start(paper_chain(2), jnp.array([0.25]))
        >>> v.tolist()  # `basin_shares(chain, Shaken(2.0))` runs many of them
        [0.5, 0.5]
    """

    @abc.abstractmethod
    def dimension(self, model: AbstractModel) -> int:
        """The dimension of the cube."""

    @abc.abstractmethod
    def start(self, model: AbstractModel, point: Float[Array, " dimension"]) -> State:
        """The state of a point of the cube: (x, v), both of shape (n,), or all m arrays."""


def _pushed(masses: tuple[int, ...] | None, model: Any) -> tuple[int, ...]:
    """The indices of the disturbed masses; `ValueError` for one that does not exist."""
    as_chain(model, remedy="`Ranges` and `Sampler` are regions of other models.", name="model")
    masses = tuple(range(model.n)) if masses is None else masses
    for mass in masses:
        check_whole("masses", mass, 0, model.n - 1, _MASSES)
    return masses


def _about_sliding(masses: tuple[int, ...] | None, chain: Chain, x: Array, v: Array) -> State:
    """Steady sliding with (x, v) added for the disturbed masses."""
    sliding_x, sliding_v = steady_sliding(chain)
    at = jnp.asarray(_pushed(masses, chain))
    return sliding_x.at[at].add(x), sliding_v.at[at].add(v)


def _normal(point: Array) -> Array:
    """Standard normal numbers from uniform ones."""
    return ndtri(jnp.clip(point, _LEAST, 1.0 - _LEAST))


class Box(AbstractRegion):
    """Displacements and velocities between two numbers each, the same for every mass.

    a <= x_n <= b, c <= v_n <= d, for the disturbed masses n; the others slide steadily.

    **Arguments:** `displacement` = (a, b) and `velocity` = (c, d), dimensionless, differentiable;
    `masses`, None for all, or the indices (from 0) of the disturbed ones.

    **Raises:** `ValueError` unless a < b and c < d are finite, and `masses` are different indices.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.basins import Box
    >>> box = Box(displacement=(-2, 2), velocity=(0, 2))
    >>> box.displacement.tolist(), box.velocity.tolist(), box.masses
    ([-2.0, 2.0], [0.0, 2.0], None)
    """

    displacement: Float[Array, "2"] = eqx.field(
        converter=_edges("displacement"), default=(-2.0, 2.0)
    )
    velocity: Float[Array, "2"] = eqx.field(converter=_edges("velocity"), default=(0.0, 2.0))
    masses: tuple[int, ...] | None = eqx.field(converter=_indices, default=None, static=True)

    def __check_init__(self) -> None:
        for name in ("displacement", "velocity"):
            edges = getattr(self, name)
            if edges.shape != (2,):
                raise ValueError(
                    f"Argument `{name}` must be two numbers, but is {shown(edges)}: {_EDGES}"
                )
            check_finite(name, edges, _EDGES)
            numbers = None if is_traced(edges) else numbers_of(name, edges)
            if numbers is not None and not numbers[0] < numbers[1]:
                raise ValueError(
                    f"Argument `{name}` must be (low, high) with low < high, but is "
                    f"{tuple(numbers.tolist())}: {_EDGES}"
                )
        _check_masses(self.masses)

    def dimension(self, model: Any) -> int:
        return 2 * len(_pushed(self.masses, model))

    def start(self, model: Any, point: Float[Array, " dimension"]) -> State:
        (a, b), (c, d) = self.displacement, self.velocity
        x, v = jnp.split(point, 2)
        at = jnp.asarray(_pushed(self.masses, model))
        sliding_x, sliding_v = steady_sliding(model)
        return sliding_x.at[at].set(a + (b - a) * x), sliding_v.at[at].set(c + (d - c) * v)


class Ball(AbstractRegion):
    """The uniform distribution over a ball around steady sliding.

    sum over the disturbed masses of (x_n - x_s)^2 + v_n^2 <= radius^2.

    **Arguments:** `radius`, dimensionless; `masses` as in `Box`.

    **Raises:** `ValueError` for a radius that is not positive, or bad `masses`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.basins import Ball
    >>> Ball(0.5, masses=[3]).masses
    (3,)
    """

    radius: Float[Array, ""] = eqx.field(converter=named("radius"))
    masses: tuple[int, ...] | None = eqx.field(converter=_indices, default=None, static=True)

    def __check_init__(self) -> None:
        check_positive_number("radius", self.radius, "it is a distance, such as 1.")
        _check_masses(self.masses)

    def dimension(self, model: Any) -> int:
        return 2 * len(_pushed(self.masses, model)) + 1

    def start(self, model: Any, point: Float[Array, " dimension"]) -> State:
        # The direction of a normal vector is uniform.
        direction = _normal(point[:-1])
        length = self.radius * point[-1] ** (1.0 / direction.size)
        direction = direction * (length / jnp.maximum(jnp.linalg.norm(direction), 1e-300))
        x, v = jnp.split(direction, 2)
        return _about_sliding(self.masses, model, x, v)


class Gaussian(AbstractRegion):
    """Independent normal displacements and velocities around steady sliding.

    x_n - x_s ~ N(0, `displacement`^2), v_n ~ N(0, `velocity`^2).

    **Arguments:** the standard deviations `displacement` and `velocity`, dimensionless; `masses`
    as in `Box`.

    **Raises:** `ValueError` for deviations that are not positive, or bad `masses`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.basins import Gaussian
    >>> float(Gaussian(displacement=1.0, velocity=0.5).velocity)
    0.5
    """

    displacement: Float[Array, ""] = eqx.field(converter=named("displacement"))
    velocity: Float[Array, ""] = eqx.field(converter=named("velocity"))
    masses: tuple[int, ...] | None = eqx.field(converter=_indices, default=None, static=True)

    def __check_init__(self) -> None:
        for name in ("displacement", "velocity"):
            check_positive_number(name, getattr(self, name), "it is a standard deviation.")
        _check_masses(self.masses)

    def dimension(self, model: Any) -> int:
        return 2 * len(_pushed(self.masses, model))

    def start(self, model: Any, point: Float[Array, " dimension"]) -> State:
        x, v = jnp.split(_normal(point), 2)
        return _about_sliding(self.masses, model, self.displacement * x, self.velocity * v)


def _state(name: str) -> Callable[[Any], State]:
    def convert(value: Any) -> State:
        if not isinstance(value, tuple | list) or not value:
            raise ValueError(f"Argument `{name}` must be a state, but is {shown(value)}: {_STATE}")
        parts = tuple(as_array(name, part, 1, 1, _STATE) for part in value)
        for part in parts:
            check_finite(name, part, _STATE)
        return parts

    return convert


class Ranges(AbstractRegion):
    """Every number of every cell of any model between those of two states.

    low <= y <= high, uniformly; a number with low = high is fixed.

    **Arguments:** `low` and `high`, states: m arrays of shape (n,) each, (x, v) of masses.

    **Raises:** `ValueError` for anything else, or unless low <= high everywhere and low < high
    somewhere.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.basins import Ranges
    >>> from jaxchain.model import Duffing
    >>> wells = Duffing(force=0.0, frequency=1.0, damping=0.1, stiffness=-1.0, cubic=1.0)
    >>> box = Ranges(([-2.0], [-1.0]), ([2.0], [1.0]))
    >>> [part.tolist() for part in box.start(wells, jnp.array([0.25, 0.5]))]
    [[-1.0], [0.0]]
    """

    low: State = eqx.field(converter=_state("low"))
    high: State = eqx.field(converter=_state("high"))

    def __check_init__(self) -> None:
        shapes = [[part.shape for part in state] for state in (self.low, self.high)]
        if shapes[0] != shapes[1] or len(set(shapes[0])) > 1:
            raise ValueError(
                f"Arguments `low` and `high` must hold arrays of one shape, but have the shapes "
                f"{shapes[0]} and {shapes[1]}: {_STATE}"
            )
        low, high = jnp.stack(self.low), jnp.stack(self.high)
        if not is_traced(low, high) and not (jnp.all(low <= high) and jnp.any(low < high)):
            raise ValueError(
                f"Arguments `low` = {shown(low)} and `high` = {shown(high)} must have low <= high "
                "everywhere and low < high somewhere."
            )

    def dimension(self, model: AbstractModel) -> int:
        del model
        return sum(part.size for part in self.low)

    def start(self, model: AbstractModel, point: Float[Array, " dimension"]) -> State:
        del model
        shares = jnp.split(point, len(self.low))
        ranges = zip(self.low, self.high, shares, strict=True)
        return tuple(low + (high - low) * share for low, high, share in ranges)


class Sampler(AbstractRegion):
    """Your own region: a function from the unit cube to states.

    **Arguments:** `function`, (chain, point) -> (x, v), or all m arrays of other cells, which JAX
    can trace; `points`, the number of coordinates of a point, each in [0, 1).

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain, steady_sliding
    >>> from jaxchain.basins import Sampler
    >>> def shaken(chain, point):  # one number: the same velocity of all masses
    ...     x, v = steady_sliding(chain)
    ...     return x, v + 2.0 * point[0]
    >>> region = Sampler(shaken, 1)
    >>> region.start(paper_chain(2), jnp.array([0.25]))[1].tolist()
    [0.5, 0.5]
    """

    function: Callable[[Any, Array], State] = eqx.field(static=True)
    points: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        check_function("function", self.function, "(chain, point) -> (x, v)", 2)
        check_whole("points", self.points, remedy="it is the length of a point.")

    def dimension(self, model: AbstractModel) -> int:
        del model
        return self.points

    def start(self, model: AbstractModel, point: Float[Array, " dimension"]) -> Any:
        return self.function(model, point)


def check_region(region: Any, model: Any) -> int:
    """The number of cells, or `ValueError` unless it is a region of states of this chain."""
    kinds = "a `Box`, `Ball`, `Gaussian`, `Ranges` or `Sampler`"
    check_kind("region", region, AbstractRegion, kinds, "`Box()` is that of the literature.")
    state: Any = eqx.filter_eval_shape(region.start, model, jnp.zeros(region.dimension(model)))
    shapes = [part.shape for part in state] if isinstance(state, tuple | list) else []
    n = model.n or max(map(math.prod, shapes), default=1)
    m = len(model.variables) or len(shapes)
    if not shapes or len(shapes) != m or not set(shapes) <= {(), (n,)}:
        raise ValueError(
            f"Argument `region` must make {model.state_in_words} of shape ({n},) each, but makes "
            f"{shown(state)}."
        )
    model.dependence((jnp.zeros(n),) * m)  # raises unless there is a rate for each variable
    return n


class Points:
    """Independent sequences of points of the unit cube.

    "sobol": Sobol's sequence, scrambled separately for each replicate (A. B. Owen, J. Complexity
    14, 466 (1998)); its first 2^k points, and the next 2^k, fill the cube evenly. "random":
    uniform and independent.
    """

    def __init__(
        self, dimension: int, replicates: int, kind: Literal["sobol", "random"], seed: int
    ):
        self.dimension, self.replicates = dimension, replicates
        seeds = np.random.SeedSequence(seed).spawn(replicates)
        rngs = [np.random.default_rng(seed_i) for seed_i in seeds]
        if kind == "sobol":
            self._draw = [qmc.Sobol(dimension, rng=rng, bits=_BITS).random for rng in rngs]
        else:
            self._draw = [lambda count, rng=rng: rng.random((count, dimension)) for rng in rngs]

    def more(self, count: int) -> np.ndarray:
        """The next `count` points of each replicate, of shape (replicates, count, dimension)."""
        return np.stack([draw(count) for draw in self._draw])
