"""Mistuning: chains of unequal masses, and how it localizes the modes of the linear chain."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import (
    check_nonnegative,
    check_number,
    check_one_of,
    check_positive_number,
    check_whole,
    is_traced,
    require_x64,
    shown,
)
from .._types import Given, ScalarLike
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..model.sliding import stiffness_matrix
from ..observers.quantities import participation_ratio
from ..result import Printed

# Normal draws are cut off at this number of standard deviations, so no stiffness is negative.
_NORMAL_END = 4.0
_MOST = 10**8  # most masses drawn
# The greatest departure of a stiffness from its mean, in standard deviations.
FARTHEST = {"uniform": math.sqrt(3.0), "normal": _NORMAL_END}


def mistuned_stiffness(
    seed: Given[int], n: Given[int], disorder: Given[ScalarLike], distribution: str = "uniform"
) -> Float[Array, " n"]:
    """Random stiffnesses k_n = 1 + disorder u_n, u_n independent, of mean 0 and variance 1.

    **Arguments:**

    - `seed`: an integer, or a key of `jax.random`.  The u_n depend only on the seed, n and the
      distribution, so changing the disorder only scales them.
    - `n`: number of masses.
    - `disorder`: the standard deviation of the stiffness relative to its mean: 0.05 is called 5 %
      in the literature on mistuning (2.5 % of the natural frequencies).
    - `distribution`: "uniform", within 1 +- sqrt(3) disorder (Anderson's box, of full width
      W = sqrt(12) disorder), or "normal", cut off at 4 standard deviations.

    **Returns:** shape (n,).  Seed and disorder may be traced.

    **Raises:** `ValueError` for a negative disorder, one that allows a stiffness of zero (0.577
    and 0.25), an unknown distribution or a bad seed.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.localization.mistuning import mistuned_stiffness
    >>> chain = paper_chain(20).with_(stiffness=mistuned_stiffness(7, 20, 0.05))
    >>> bool(abs(chain.stiffness - 1.0).max() < 0.087)
    True
    """
    require_x64()
    masses = check_whole("n", n, 1, _MOST)
    _check_disorder(disorder, distribution)
    return 1.0 + disorder * _draw(_key(seed), masses, distribution)


def mistuned_chain(
    chain: Chain, seed: Given[int], disorder: Given[ScalarLike], distribution: str = "uniform"
) -> Chain:
    """The chain with each stiffness multiplied by one of `mistuned_stiffness`.

    Use it as `sweep(..., vary=mistuned_chain, over={"disorder": ..., "seed": ...})`.

    **Arguments:** `seed`, `disorder`, `distribution` as for `mistuned_stiffness`.

    **Returns:** a `Chain` with `stiffness` of shape (n,).

    **Raises:** `ValueError` as `mistuned_stiffness`.

    ```python
    states = sweep(
        paper_chain(width=None), lambda chain: equation_8(chain, 1), 600.0,
        vary=mistuned_chain, over={"disorder": [0.0, 0.05], "seed": range(10)},
    )
    ```

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.localization.mistuning import mistuned_chain
    >>> mistuned_chain(paper_chain(4), seed=1, disorder=0.05).stiffness.shape
    (4,)
    """
    factor = mistuned_stiffness(seed, as_chain(chain, belts=True).n, disorder, distribution)
    return chain.with_(stiffness=chain.stiffness * factor)


def _key(seed: Any) -> Array:
    if isinstance(seed, jax.Array) and jnp.issubdtype(seed.dtype, jax.dtypes.prng_key):
        return seed
    value = seed if is_traced(seed) else np.asarray(seed)
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.integer):
        raise ValueError(
            f"Argument `seed` must be an integer or a key of `jax.random`, but is {shown(seed)}."
        )
    return jax.random.key(seed)


def _check_disorder(disorder: Any, distribution: str) -> None:
    check_one_of("distribution", distribution, list(FARTHEST))
    check_number("disorder", disorder, "0.05 is a mistuning of 5 %.")
    check_nonnegative("disorder", disorder, "0.05 is a mistuning of 5 %.")
    if not is_traced(disorder) and FARTHEST[distribution] * float(disorder) >= 1.0:
        raise ValueError(
            f"Argument `disorder` = {disorder} lets a stiffness be zero: a {distribution} "
            f"distribution needs less than {1.0 / FARTHEST[distribution]:.3g}."
        )


def _draw(key: Array, count: int, distribution: str) -> Float[Array, " count"]:
    """Independent numbers of mean 0 and variance 1."""
    if distribution == "uniform":
        end = FARTHEST["uniform"]
        return jax.random.uniform(key, (count,), float, -end, end)
    end = _NORMAL_END
    density = math.exp(-0.5 * end**2) / math.sqrt(2.0 * math.pi)
    variance = 1.0 - 2.0 * end * density / math.erf(end / math.sqrt(2.0))
    return jax.random.truncated_normal(key, -end, end, (count,), float) / variance**0.5


class LinearModes(Printed, eqx.Module):
    """Modes of the chain without friction and damping: K u = omega^2 u, lowest first.

    - `frequency`: omega, shape (n,).
    - `shape`: shape (mode, mass), orthonormal rows.
    - `participation_ratio`: of each mode, from 1 (one mass alone) to n; shape (n,).
    - `return_probability`: p_n = sum_j u_jn^4 of each mass, shape (n,): the share of the energy
      given to mass n that remains there in the long run; 1 for a mass that moves alone in one mode
      (Anderson's measure of localization).

    See `linear_modes` for an example.
    """

    frequency: Float[Array, " n"]
    shape: Float[Array, "n n"]
    participation_ratio: Float[Array, " n"]
    return_probability: Float[Array, " n"]


def linear_modes(chain: Given[Chain]) -> LinearModes:
    """Natural frequencies and mode shapes of a chain.

    In a tuned ring omega_q^2 = k + 2 eta_c (1 - cos q), q = 2 pi m / n: a band of width 4 eta_c.
    Pairs q, -q are degenerate there, and only their plane is defined; any wave cos(q n + phase) in
    it has the participation ratio 2 n / 3 (except for multiples of pi / 2).  Random stiffnesses
    localize every mode of a long chain, depending on disorder / eta_c.

    **Returns:** `LinearModes`.

    **Raises:** `ValueError` for anything but a `Chain`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.localization.mistuning import linear_modes, mistuned_chain
    >>> tuned, mistuned = paper_chain(), mistuned_chain(paper_chain(), 0, 0.05)
    >>> [round(float(linear_modes(c).participation_ratio.mean())) for c in (tuned, mistuned)]
    [14, 1]
    """
    return _modes(as_chain(chain, belts=True))


@eqx.filter_jit  # one small program instead of a dozen
def _modes(chain: Chain) -> LinearModes:
    square, columns = jnp.linalg.eigh(stiffness_matrix(chain))
    shape = columns.T
    return LinearModes(
        jnp.sqrt(square), shape, participation_ratio(shape), jnp.sum(shape**4, axis=0)
    )


def localization_length(
    disorder: Given[ScalarLike],
    coupling: Given[ScalarLike],
    position: ScalarLike = 0.0,
    *,
    seed: Given[int] = 0,
    length: int = 100_000,
    distribution: str = "uniform",
) -> Float[Array, ""]:
    """The number of masses over which modes of a long mistuned chain decay by e: 1 / gamma.

    gamma is the mean of ln |r_n|, r_n = u_{n+1} / u_n, along a random chain (Lyapunov exponent of
    the transfer matrix), with r_n = (k_n + 2 eta_c - omega^2) / eta_c - 1 / r_{n-1}.  For weak
    disorder 1 / gamma = 8 eta_c^2 sin^2 q / disorder^2, and 105 / 96 of it in the middle of the
    band; it depends only on the ratio of the two.

    **Arguments:** `disorder`, the standard deviation of the stiffness; `coupling` eta_c > 0;
    `position` in the band, (1 + 2 eta_c - omega^2) / (2 eta_c) = cos q: -1 ... 1, 0 its middle;
    `length` of the random chain: the relative error is about sqrt(1 / (gamma length)).

    **Returns:** a number of masses; infinite without disorder.

    **Raises:** `ValueError` as `mistuned_stiffness`, and for a coupling that is not positive.

    Source: Thouless, in Ill-Condensed Matter (1979); Kappus and Wegner, Z. Phys. B 45, 15 (1981).

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.localization.mistuning import localization_length
    >>> round(float(localization_length(0.005, 0.01)))
    34
    """
    require_x64()
    check_positive_number("coupling", coupling, "the paper's chain has 0.01.")
    check_number("position", position, "0 is the middle of the band.")
    check_whole("length", length, 1, _MOST, "1e5 is usual.")
    _check_disorder(disorder, distribution)
    ratios = disorder / coupling * _draw(_key(seed), int(length), distribution)

    def pass_on(ratio: Array, departure: Array) -> tuple[Array, Array]:
        following = departure + 2.0 * position - 1.0 / ratio
        # A node: the mode continues as if the node were slightly shifted.
        following = jnp.where(jnp.abs(following) < 1e-12, 1e-12, following)
        return following, jnp.log(jnp.abs(following))

    _, growth = lax.scan(pass_on, jnp.ones(()), ratios)
    exponent = jnp.mean(growth)
    has = jnp.asarray(disorder) > 0
    return jnp.where(has, 1.0 / jnp.where(has, exponent, 1.0), jnp.inf)
