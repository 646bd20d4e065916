"""The speed of the fronts of a vibrating block, and the belt speed of their depinning.

A front that moves does so in hops, from mass to mass; one that is pinned does not move at all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._checks import (
    check_function,
    check_kind,
    check_nonnegative,
    check_number,
    check_positive_number,
    check_share,
    check_whole,
    is_traced,
    to_float,
)
from .._types import ArrayLike, Given, ScalarLike, StateLike
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..observers.fronts import Fronts, FrontTrack, apart, mean_speed
from ..result import Printed, Result, ended_well
from ..simulation.method import MAX_STEP, Solver, check_span, check_tolerances
from ..simulation.run import MOST_SEGMENTS, simulate

if TYPE_CHECKING:
    from xarray import Dataset

_SMALLEST = 12
VERDICTS = ("shrinks", "stands", "grows", "unknown")


class FrontSpeed(Printed, eqx.Module):
    """The speed of the fronts of a block, in masses per dimensionless time; > 0 if it grows.

    - `speed`, `error`: the mean of both fronts, and the half-width of its confidence interval (at
      least that of one front, because both fronts of a symmetric block move together).
    - `right`, `left`, `right_error`, `left_error`: each front.
    - `moved`: the distance in masses, averaged over both fronts.
    - `verdict`: +1 grows, -1 shrinks: the interval is above or below 0; 0 stands: it contains 0
      and the front moved by less than a mass; 2 unknown.  `outcome` is its name.
    - `times`, `fronts`: middles of the windows, and `Fronts`.
    - `result`: the outcome of the run.  A failed run has NaN for numbers and verdict 2.

    See `front_speed` for an example.
    """

    speed: Float[Array, ""]
    error: Float[Array, ""]
    right: Float[Array, ""]
    left: Float[Array, ""]
    right_error: Float[Array, ""]
    left_error: Float[Array, ""]
    moved: Float[Array, ""]
    verdict: Int[Array, ""]
    times: Float[Array, " windows"]
    fronts: Fronts
    result: Result

    @property
    def outcome(self) -> str:
        """ "grows", "stands", "shrinks" or "unknown", of one run (not of a batch)."""
        return VERDICTS[int(self.verdict) + 1]


@eqx.filter_jit
def _measure(
    fronts: Fronts,
    n: int,
    t0: ScalarLike,
    t1: ScalarLike,
    transient: ScalarLike,
    well: Any,
    level: Any,
) -> dict[str, Array]:
    """The numbers of a `FrontSpeed` from the record of a `FrontTrack` over [t0, t1].

    It leaves out the record before t0 + transient, and after a front first came within two masses
    of the middle of its block or three of the far side of the ring; `well`: whether the run
    succeeded.
    """
    windows = fronts.right.shape[-1]
    length = (t1 - t0) / windows
    times = t0 + (jnp.arange(windows) + 0.5) * length
    late = times - 0.5 * length >= t0 + transient

    def one(position: Array) -> tuple[Array, Array, Array]:
        valid = late & jnp.cumprod(apart(position, n)).astype(bool)
        speed, error = mean_speed(times, position, valid, level=level)
        last = jnp.max(jnp.where(valid, jnp.arange(windows), 0))
        moved = position[last] - position[jnp.argmax(valid)]
        return speed, error, jnp.where(jnp.any(valid), moved, jnp.nan)

    right, left = one(fronts.right), one(fronts.left)
    # Fronts of a symmetric block hop at the same time: their errors do not average out.
    speed, error, moved = (0.5 * (a + b) for a, b in zip(right, left, strict=True))
    verdict = jnp.where(jnp.abs(moved) < 1.0, 0, 2)
    verdict = jnp.where(jnp.abs(speed) > error, jnp.sign(speed).astype(int), verdict)
    numbers = {
        "speed": speed,
        "error": error,
        "right": right[0],
        "left": left[0],
        "right_error": right[1],
        "left_error": left[1],
        "moved": moved,
    }
    return {name: jnp.where(well, value, jnp.nan) for name, value in numbers.items()} | {
        "verdict": jnp.where(jnp.isfinite(speed) & well, verdict, 2)
    }


def front_speed(
    chain: Chain,
    initial: Given[StateLike],
    t1: ScalarLike,
    *,
    t0: ScalarLike = 0.0,
    transient: Given[ScalarLike | None] = None,
    windows: Given[int | None] = None,
    middle: Given[int | None] = None,
    level: Given[ScalarLike] = 0.95,
    solver: Given[Solver | None] = None,
    rtol: Given[ScalarLike] = 1e-6,
) -> FrontSpeed:
    """Runs a block of vibrating masses and measures how fast its fronts move.

    **Arguments:** (dimensionless)

    - `initial`: (x, v), such as `excited_state(chain, n // 2, block="centred")`.
    - `t1`, `t0`: end and start of the run.
    - `transient`: the time to leave out at the start (None: a fifth of the run).
    - `windows`: see `FrontTrack` (None: windows of 20 time units; required if t1 or t0 is traced).
    - `middle`: a mass inside the block (None: n // 2).
    - `level`: confidence level of errors and verdict, see `mean_speed`.
    - `solver`, `rtol`: as for `simulate`.

    It works under `jit` and `vmap`; a failed run is marked and raises no error.

    **Returns:** a `FrontSpeed`.

    **Raises:** `ValueError` for bad input before anything is compiled.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import excited_state, paper_chain
        >>> from jaxchain.localization import front_speed
        >>> chain = paper_chain(n=40, belt_speed=1.1, width=None)
        >>> found = front_speed(chain, excited_state(chain, 14, block="centred"), 800.0)
        >>> found.outcome, round(float(found.speed), 3)
        ('grows', 0.016)
    """
    middle = check_mass(chain, middle, "middle")
    _check_ring(chain)
    check_span(t0, t1)
    check_share("level", level, "0.95 is usual.")
    check_tolerances(rtol, None, MAX_STEP)
    windows = _window_count(windows, t0, t1)
    left_out = 0.2 * (t1 - t0) if transient is None else transient
    _check_transient(left_out, t0, t1)
    run = simulate(
        chain, initial, t1, t0=t0, observe=FrontTrack(windows, middle), rtol=rtol,
        solver=solver, throw=False,
    )  # fmt: skip
    speed = _measure(run.observed, chain.n, t0, t1, left_out, ended_well(run.result), level)
    times = t0 + (jnp.arange(windows) + 0.5) * (t1 - t0) / windows
    return FrontSpeed(**speed, times=times, fronts=run.observed, result=run.result)


def front_speeds(
    runs: Dataset, transient: Given[ArrayLike | None] = None, *, level: Given[ScalarLike] = 0.95
) -> Dataset:
    """The numbers of `front_speed` for every run of a sweep.

    **Arguments:** `runs`, from `sweep(..., observe=FrontTrack(windows))`; `transient`, the time to
    leave out at the start of a run (None: a fifth of it), one number or a data array over
    dimensions of `runs`; `level` as for `front_speed`.

    **Returns:** a dataset over the dimensions of `runs`: `speed`, `error`, `right`, `left`,
    `right_error`, `left_error`, `moved` and `verdict` as in `FrontSpeed`, and `result`.

    **Raises:** `ValueError` for a sweep without `FrontTrack`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import excited_state, paper_chain, sweep
        >>> from jaxchain.localization import front_speeds
        >>> from jaxchain.observers import FrontTrack
        >>> def block(chain):
        ...     return excited_state(chain, 6, block="centred")
        >>> runs = sweep(
        ...     paper_chain(16, width=None), block, 400.0, over={"belt_speed": [1.1, 1.5]},
        ...     observe=FrontTrack(40),
        ... )
        >>> front_speeds(runs, transient=40.0).verdict.values.tolist()  # grows, stands
        [1, 0]
    """
    import xarray as xr  # it imports pandas, which would double the time of `import jaxchain`

    check_kind("runs", runs, xr.Dataset, "a dataset", "`sweep(..., observe=FrontTrack(20))`.")
    if "front_right" not in runs:
        raise ValueError(
            "Argument `runs` must be a sweep that observed a `FrontTrack`, but has the variables "
            f"{[str(name) for name in runs]}: call `sweep(..., observe=FrontTrack(windows))`."
        )
    check_share("level", level, "0.95 is usual.")
    n, t0, t1 = runs.sizes["oscillator"], runs.attrs["t0"], runs.attrs["t1"]
    waits = xr.zeros_like(runs["result"], float)
    waits = waits + (0.2 * (t1 - t0) if transient is None else transient)
    well = xr.apply_ufunc(ended_well, runs["result"])

    names = (
        "speed", "error", "right", "left", "right_error", "left_error", "moved", "verdict",
    )  # fmt: skip

    def measure(right: Array, left: Array, wait: Array, well: Array) -> tuple[Array, ...]:
        speed = _measure(Fronts(right, left, left), n, t0, t1, wait, well, level)
        return tuple(speed[name] for name in names)  # a compiled function sorts its dictionary

    numbers = xr.apply_ufunc(
        jnp.vectorize(measure, signature="(w),(w),(),()->" + ",".join(["()"] * 8)),
        runs["front_right"],
        runs["front_left"],
        waits,
        well,
        input_core_dims=[["window"], ["window"], [], []],
        output_core_dims=[[]] * 8,
    )
    return runs[["result"]].assign(dict(zip(names, numbers, strict=True)))


def _check_ring(chain: Chain) -> None:
    if chain.springs is None or chain.ends != "cyclic" or chain.n < _SMALLEST:
        raise ValueError(
            f"Argument `chain` must be a coupled ring of at least {_SMALLEST} masses for two "
            f"fronts to move on, but has n = {chain.n} and ends {chain.ends!r}."
        )


def _check_transient(transient: Any, t0: Any, t1: Any) -> None:
    remedy = "a fifth of the run is usual."
    check_number("transient", transient, remedy)
    check_nonnegative("transient", transient, remedy)
    if not is_traced(transient, t0, t1) and float(transient) >= float(t1) - float(t0):
        raise ValueError(
            f"Argument `transient` = {transient} leaves nothing of a run that lasts "
            f"{float(t1) - float(t0):g}: {remedy}"
        )


def _window_count(windows: Any, t0: Any, t1: Any) -> int:
    if windows is None:
        if is_traced(t0, t1):
            raise ValueError("Argument `windows` is None: give it where `t1` or `t0` is traced.")
        return max(int((float(t1) - float(t0)) / 20.0), 1)
    return check_whole("windows", windows, 1, MOST_SEGMENTS, "one for 20 time units is usual.")


class Depinning(Printed, eqx.Module):
    """The depinning of fronts: they stand at the belt speed `stands` and move at `moves`.

    `middle` is between them and `error` is half their distance; NaN if the fronts do not stand and
    move at the given ends, or if a run failed.

    See `depinning_belt_speed` for an example.
    """

    stands: Float[Array, ""]
    moves: Float[Array, ""]

    @property
    def middle(self) -> Array:
        """The belt speed half way between `stands` and `moves`."""
        return 0.5 * (self.stands + self.moves)

    @property
    def error(self) -> Array:
        """Half the distance between `stands` and `moves`."""
        return 0.5 * jnp.abs(self.stands - self.moves)


def depinning_belt_speed(
    chain: Chain,
    initial: Given[Callable[[Chain], StateLike]],
    t1: ScalarLike,
    *,
    stands: Given[ScalarLike],
    moves: Given[ScalarLike],
    halvings: Given[int] = 6,
    transient: Given[ScalarLike | None] = None,
    windows: Given[int | None] = None,
    solver: Given[Solver | None] = None,
    rtol: Given[ScalarLike] = 1e-6,
) -> Depinning:
    """The belt speed at which the fronts of a block start to move, by bisection.

    Fronts move if the block gained or lost, on average, one mass at each front between the
    transient and t1.  So speeds below 1 / (t1 - transient) count as standing, and a longer run
    moves the answer towards `stands` (with the square of the time if depinning is a saddle-node).

    **Arguments:** `initial`, a function chain -> (x, v); `stands` and `moves`, belt speeds at
    which fronts stand and move, in either order; `halvings` of the distance between them; the rest
    as in `front_speed`.

    Works under `jit` and `vmap`.  **Raises:** `ValueError` for bad input.

    **Returns:** a `Depinning`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import excited_state, paper_chain
        >>> from jaxchain.localization import depinning_belt_speed
        >>> def block(chain):
        ...     return excited_state(chain, 14, block="centred")
        >>> chain = paper_chain(n=40)
        >>> found = depinning_belt_speed(chain, block, 2000.0, stands=1.5, moves=1.25)
        >>> round(float(found.middle), 1), round(float(found.error), 4)
        (1.3, 0.002)
    """
    check_mass(chain, None)
    _check_ring(chain)
    # Steady sliding moves with the belt speed, and so must the initial state.
    check_function("initial", initial, "chain -> (x, v)", 1)
    for name, value in (("stands", stands), ("moves", moves)):
        check_positive_number(name, value, "it is a belt speed, such as 1.5.")
    check_whole("halvings", halvings, 1, 1000, "each halves the bracket; 6 are usual.")
    check_span(0.0, t1)
    check_tolerances(rtol, None, MAX_STEP)
    _check_transient(0.2 * t1 if transient is None else transient, 0.0, t1)
    count = _window_count(windows, 0.0, t1)

    def moved(speed: Array) -> tuple[Array, Array]:
        chain_i = chain.with_(belt_speed=speed)
        run = front_speed(
            chain_i,
            initial(chain_i),
            t1,
            transient=transient,
            windows=count,
            solver=solver,
            rtol=rtol,
        )
        # Fronts that met before their speed could be measured count as moving.
        went = (jnp.abs(run.moved) >= 1.0) | jnp.isnan(run.speed)
        return went, ended_well(run.result)

    first = to_float(stands), to_float(moves)

    def look(ends: tuple[Array, Array], index: Array) -> tuple[Any, tuple[Array, Array]]:
        """Runs at both ends, then at the middle of the remaining interval."""
        still, moving = ends
        speed = jnp.where(index == 0, still, jnp.where(index == 1, moving, 0.5 * (still + moving)))
        went, well = moved(speed)
        halves = index >= 2
        new = (jnp.where(halves & ~went, speed, still), jnp.where(halves & went, speed, moving))
        return new, (went, well)

    (low, high), (went, well) = lax.scan(look, first, jnp.arange(halvings + 2))
    bracketed = ~went[0] & went[1] & jnp.all(well)
    return Depinning(jnp.where(bracketed, low, jnp.nan), jnp.where(bracketed, high, jnp.nan))
