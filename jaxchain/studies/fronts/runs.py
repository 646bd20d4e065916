"""Many blocks at once: every lane a ring with one block, whose fronts are followed."""

from __future__ import annotations

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
from jaxchain.simulation.accuracy import MAX_STEP, choose_solver
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import build_plan
from jaxchain.sweeps.lanes import Task
from jaxchain.sweeps.scheduler import Pool

# Uniform noise on displacement and velocity of the masses that are excited.
NOISE = 0.1
# Where a window would be shorter, it would not hold a period.
_WINDOW, _WINDOWS = 6.6, 150
NUMBERS = ("speed", "error", "right", "left", "moved", "verdict")
PATTERNS = ("alternating", "in-phase")


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
    rtol: float = 1e-6,
    dry: bool = True,
    progress: bool = False,
    description: str = "fronts",
) -> xr.Dataset:
    """Speeds of the fronts of a block for every combination of the values in `over`.

    `over` holds numbers of the chain, `pattern` (names) and `seed`; `transient` is one number or
    one for each lane.  **Returns:** `NUMBERS` and `result` over the dimensions of `over`.
    """
    grid = np.meshgrid(*(np.asarray(a) for a in over.values()), indexing="ij")
    jobs = {name: values.ravel() for name, values in zip(over, grid, strict=True)}
    found = follow_jobs(
        chain, block, time, jobs, transient=transient, rtol=rtol, dry=dry, progress=progress,
        description=description,
    )  # fmt: skip
    shape = grid[0].shape
    return xr.Dataset(
        {name: (tuple(over), values.reshape(shape)) for name, values in found.items()},
        coords={name: np.asarray(values) for name, values in over.items()},
    )


def follow_jobs(
    chain: Chain,
    block: int,
    time: float,
    jobs: dict[str, np.ndarray],
    *,
    transient: Any,
    rtol: float = 1e-6,
    dry: bool = True,
    progress: bool = False,
    description: str = "fronts",
) -> dict[str, np.ndarray]:
    """As `follow`, for jobs given one by one as arrays of equal length."""
    jobs = dict(jobs)
    jobs["in_phase"] = jobs.pop("pattern") == PATTERNS[1]
    windows = min(int(time / _WINDOW), _WINDOWS)
    solver = EventDriven() if dry else choose_solver(chain, rtol, MAX_STEP)
    plan = build_plan(solver, [FrontTrack(windows)], rtol, 0.1 * rtol, MAX_STEP, time)
    t1 = jnp.asarray(float(time))
    pool = Pool(Task(plan, chain, BlockStart(block), jnp.zeros(()), t1), jobs, None, None)
    pool.run(progress, description)
    fronts = jax.tree.map(jnp.asarray, pool.records["observed"][0])
    codes = jnp.asarray(pool.records["result"])
    waits = jnp.broadcast_to(jnp.asarray(transient, float), codes.shape)
    found = _speeds(fronts, codes, waits, t1, chain.n)
    numbers = {name: np.asarray(getattr(found, name)) for name in NUMBERS}
    return numbers | {"result": pool.records["result"]}


@eqx.filter_jit
def _speeds(fronts: Fronts, codes: Array, waits: Array, t1: Array, n: int) -> FrontSpeed:
    def one(fronts: Fronts, code: Array, wait: Array) -> FrontSpeed:
        result = eqx.tree_at(lambda r: r._value, Result.successful, code)
        return read_speed(fronts, n, 0.0, t1, wait, result)

    return jax.vmap(one)(fronts, codes, waits)


def averaged(data: xr.Dataset, over: tuple[str, ...]) -> xr.Dataset:
    """`speed` and `error` of runs that differ in `over` only: their mean and its interval.

    The half-width is the greater of what the runs' own errors and what their scatter (Student's t
    at 95 %) say of the mean.
    """
    speed = data["speed"]
    count = speed.count(over)
    own = data["error"].mean(over) / np.sqrt(count)
    quantile = xr.apply_ufunc(lambda m: stdtrit(np.maximum(m - 1, 1), 0.975), count)
    scatter = xr.where(count > 1, quantile * speed.std(over, ddof=1) / np.sqrt(count), 0.0)
    error = xr.where(scatter > own, scatter, own)
    return xr.Dataset({"speed": speed.mean(over), "error": error})


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
