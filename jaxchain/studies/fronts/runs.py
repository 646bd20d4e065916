"""Many blocks at once: every lane a ring with one block, whose fronts are followed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, ArrayLike
from scipy.special import stdtrit

from jaxchain._types import State
from jaxchain.localization.fronts import FrontSpeed, read_speed
from jaxchain.model.chain import Chain
from jaxchain.model.initial_states import excited_block, excited_state
from jaxchain.observers.fronts import Fronts, FrontTrack
from jaxchain.result import Result
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.sweeps.sweeping import sweep

# Uniform noise on displacement and velocity of the masses that are excited.
NOISE = 0.1
# Where a window would be shorter, it would not hold a period.
_WINDOW, _WINDOWS = 6.6, 150
NUMBERS = ("speed", "error", "right", "left", "moved", "verdict")
PATTERNS = ["alternating", "in-phase"]


class BlockStart(eqx.Module):
    """A centred block as in eq. (8), signs alternating or alike, with a little noise inside.

    The quiet masses slide steadily: noise there would grow by itself below the Hopf speed.
    """

    block: int = eqx.field(static=True)

    def __call__(self, chain: Chain, seed: ArrayLike, in_phase: ArrayLike) -> State:
        x, v = excited_state(chain, self.block, block="centred")
        alike, _ = excited_state(chain, self.block, block="centred", pattern="in-phase")
        inside = excited_block(chain.n, self.block, "centred")
        keys = jax.random.split(jax.random.key(seed))
        shakes = [jax.random.uniform(key, (chain.n,), minval=-NOISE, maxval=NOISE) for key in keys]
        x = jnp.where(in_phase, alike, x) + jnp.where(inside, shakes[0], 0.0)
        return x, v + jnp.where(inside, shakes[1], 0.0)


def follow(
    chain: Chain,
    block: int,
    time: float,
    over: dict[str, Any],
    *,
    transient: Any,
    seeds: int = 1,
    vary: Callable[..., Chain] | None = None,
    dry: bool = True,
    **more: Any,
) -> xr.Dataset:
    """Speeds of the fronts of a block over the numbers in `over`, `pattern` and `seed`.

    **Arguments:** `transient`, a number or a data array over some of these; `vary` and `more`, as
    for `sweep`.  **Returns:** `NUMBERS` and `result`.
    """
    data = sweep(
        chain, BlockStart(block), time, over={**over, "in_phase": [0, 1], "seed": range(seeds)},
        vary=vary, observe=FrontTrack(min(int(time / _WINDOW), _WINDOWS)),
        solver=EventDriven() if dry else None, **more,
    )  # fmt: skip
    data = data.rename(in_phase="pattern").assign_coords(pattern=PATTERNS)
    codes = data["result"]
    fronts = [data[f"front_{name}"].values for name in ("right", "left", "count")]
    waits = (xr.zeros_like(codes, float) + transient).values
    read = jnp.vectorize(_read, signature="(w),(w),(w),(),(),(),()->(),(),(),(),(),()")
    n, t1 = jnp.asarray(chain.n), jnp.asarray(float(time))
    numbers = jax.jit(read)(*fronts, codes.values, waits, n, t1)
    found = {
        name: (codes.dims, np.asarray(own)) for name, own in zip(NUMBERS, numbers, strict=True)
    }
    return data[["result"]].assign(found).drop_vars("oscillator", errors="ignore")


def _read(
    right: Array, left: Array, count: Array, code: Array, wait: Array, n: Any, t1: Array
) -> tuple[Array, ...]:
    result = eqx.tree_at(lambda r: r._value, Result.successful, code)
    found: FrontSpeed = read_speed(Fronts(right, left, count), n, 0.0, t1, wait, result)
    return tuple(getattr(found, name) for name in NUMBERS)


def joined(parts: Sequence[xr.Dataset], dim: str) -> xr.Dataset:
    """Runs of one seed each, in a row; attributes that differ are left out."""
    data: Any = xr.concat(parts, dim, combine_attrs="drop_conflicts")
    return data.isel(seed=0)


def add_mean(data: xr.Dataset, over: tuple[str, ...]) -> xr.Dataset:
    """`data` with `mean_speed` of runs that differ in `over` only, and `mean_error`, its interval.

    The half-width is the greater of what the runs' own errors and what their scatter (Student's t
    at 95 %) say of the mean.
    """
    speed = data["speed"]
    count = speed.count(over)
    own = data["error"].mean(over) / np.sqrt(count)
    quantile = xr.apply_ufunc(lambda m: stdtrit(np.maximum(m - 1, 1), 0.975), count)
    scatter = xr.where(count > 1, quantile * speed.std(over, ddof=1) / np.sqrt(count), 0.0)
    error = xr.where(scatter > own, scatter, own)
    return data.assign(mean_speed=speed.mean(over), mean_error=error)


def exponents(coupling: np.ndarray, speed: np.ndarray, error: np.ndarray) -> tuple[float, ...]:
    """(p, half-width at 95 %, number of points) of |speed| ~ coupling^p, by least squares.

    In logarithms, over the couplings at which the front moves for certain.
    """
    use = np.abs(speed) > error
    if use.sum() < 3:
        return np.nan, np.nan, float(use.sum())
    x, y = np.log(coupling[use]), np.log(np.abs(speed[use]))
    slope, offset = np.polyfit(x, y, 1)
    rest = y - slope * x - offset
    spread = np.sqrt((rest**2).sum() / (x.size - 2) / ((x - x.mean()) ** 2).sum())
    return float(slope), float(stdtrit(x.size - 2, 0.975) * spread), float(x.size)
