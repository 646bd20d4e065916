"""What is told of Lyapunov exponents: averages, their errors, and the dimension they imply."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import as_array, check_share
from .._final import final
from .._statistics import student_reach
from .._types import State
from ..result import NAMES, Printed, Result, code

# An exponent this small counts as 0: blocks of a periodic run scatter by less than rounding.
ZERO = 1e-9


@final
class LyapunovSpectrum(Printed, eqx.Module):
    """What `lyapunov_spectrum` found, per dimensionless time; arrays have shape (count,).

    - `exponents`: time averages over the window; -inf where a direction is annihilated, NaN
      where one became too small to be seen between two QR decompositions.  They stand in the order
      of that decomposition, which is descending but for some too close to be told apart.
    - `smooth`: averages with the weight exp(-1 / (s (1 - s))) over the share s of the window.  For
      regular motion (periodic, quasi-periodic, rest) of smooth systems they converge faster than
      any power of the window's length, `exponents` like 1 / length; for chaos nothing is gained.
      S. Das, Y. Saiki, E. Sander, J. A. Yorke, Quantitative quasiperiodicity, Nonlinearity 30,
      4111 (2017).
    - `low`, `high`: 95 % confidence interval of `exponents` from the means over blocks, by
      Student's t; `standard_error`: widened by sqrt[(1 + r) / (1 - r)] where `autocorrelation` = r
      of successive blocks is positive (then take longer blocks).  They know of scatter alone, not
      of a transient too short for the motion or the disturbances.
    - `block_exponents`: (blocks, count).
    - `sum`: of the exponents; for all of them the mean rate at which volumes grow.
    - `mean_divergence`: time average of tr J, which that must be; NaN for dry friction.
    - `kaplan_yorke`: dimension; exponents that are 0 within their interval count as 0.  NaN if
      more exponents are needed.
    - `t`, `state`: end of the run; go on from there with a call of its own.
    - `interval`: time between two QR decompositions.
    - `result`: see `Result`; if it is not `successful` the numbers are NaN.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import lyapunov_spectrum, paper_chain
        >>> chain = paper_chain(1, belt_speed=2.5, width=None)  # it comes to slide
        >>> start = jnp.array([0.6]), jnp.zeros(1)
        >>> found = lyapunov_spectrum(chain, start, 200.0, transient=50.0)
        >>> print(found.exponents.round(3))
        [-0.047 -0.047]
        >>> found.chaotic(), bool(abs(found.sum + 0.1) < 0.05)
        (False, True)
    """

    exponents: Float[Array, " count"]
    smooth: Float[Array, " count"]
    standard_error: Float[Array, " count"]
    low: Float[Array, " count"]
    high: Float[Array, " count"]
    autocorrelation: Float[Array, " count"]
    block_exponents: Float[Array, "blocks count"]
    sum: Float[Array, ""]
    mean_divergence: Float[Array, ""]
    kaplan_yorke: Float[Array, ""]
    t: Float[Array, ""]
    state: State
    interval: Float[Array, ""]
    result: Result

    @property
    def outcome(self) -> str:
        """The name of the result of one run (not of a batch), see `jaxchain.Result`."""
        return NAMES[int(code(self.result))]

    def chaotic(self, level: float = 0.95) -> bool | None:
        """Whether the greatest exponent is positive; None if its interval at `level` holds 0.

        For regular vibration it is 0, and None the right answer.
        """
        check_share("level", level, "0.95 is usual.")
        known = jnp.where(jnp.isnan(self.exponents), -jnp.inf, self.exponents)
        first = int(jnp.argmax(known))
        freedom = self.block_exponents.shape[0] - 1
        reach = student_reach(level, freedom) * self.standard_error[first]
        if not jnp.abs(self.exponents[first]) > reach + ZERO:
            return None
        return bool(self.exponents[first] > 0)


def batch_error(
    blocks: Float[Array, "blocks count"],
) -> tuple[Float[Array, " count"], Float[Array, " count"]]:
    """(standard error of the mean over blocks, correlation r of successive blocks).

    s / sqrt(blocks), times sqrt[(1 + r) / (1 - r)] where r > 0, as in a process in which the
    memory of a block fades by r a block.  Where all are -inf the error is 0; where only some are
    the mean is -inf without any doubt, too.
    """
    number = blocks.shape[0]
    gone = jnp.any(jnp.isneginf(blocks), axis=0, keepdims=True)
    own = jnp.where(gone, 0.0, blocks)
    apart = own - jnp.mean(own, axis=0, keepdims=True)
    square = jnp.sum(apart**2, axis=0)
    product = jnp.sum(apart[1:] * apart[:-1], axis=0)
    repeats = jnp.where(square > 0, product / jnp.where(square > 0, square, 1.0), 0.0)
    held = jnp.clip(repeats, 0.0, 0.99)
    variance = square / (number - 1) / number * (1.0 + held) / (1.0 - held)
    return jnp.sqrt(variance), repeats


def kaplan_yorke_dimension(exponents: Float[Array, " count"], complete: bool) -> Float[Array, ""]:
    """j + (lambda_1 + ... + lambda_j) / |lambda_{j+1}|, j the last one for which the sum is >= 0.

    **Arguments:** `exponents`, in descending order; `complete`, whether these are all.

    **Returns:** a number; NaN if they are not, and no sum is negative.

    J. L. Kaplan, J. A. Yorke, Chaotic behavior of multidimensional difference equations, Lecture
    Notes in Mathematics 730, 204 (1979).

    >>> import jax.numpy as jnp
    >>> from jaxchain.chaos import kaplan_yorke_dimension
    >>> round(float(kaplan_yorke_dimension(jnp.array([0.9056, 0.0, -14.5723]), True)), 3)
    2.062
    """
    exponents = as_array("exponents", exponents, 1, 1, "those of one motion.")
    ordered = -jnp.sort(-exponents)
    sums = jnp.cumsum(ordered)
    number = jnp.sum(sums >= 0)  # sums rise and then fall: no gaps
    last = jnp.minimum(number, exponents.shape[0] - 1)
    before = jnp.where(number > 0, sums[jnp.maximum(number - 1, 0)], 0.0)
    beyond = number + before / jnp.abs(ordered[last])
    all_of_them = jnp.where(complete, 1.0 * exponents.shape[0], jnp.nan)
    dimension = jnp.where(number == exponents.shape[0], all_of_them, beyond)
    return jnp.where(jnp.any(jnp.isnan(exponents)), jnp.nan, dimension)
