"""Folds of many sets of numbers, on every device: a labelled dataset.

`vmap` of a search advances all sets until the hardest one has ended, and within each step of
Newton's method until the longest integration has: a few hard sets make all of them pay.  Here each
device takes a few sets at a time and finds their folds one after the other, in one compiled loop;
a device that has ended takes the next ones.  No set waits for another, and none knows of another:
the numbers are those of the search for one, bit for bit.  Nor would more lanes be faster: the
loops over the steps of one search are compiled whole, and leave little to be gained by a vector
of several.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from .._checks import check_concrete, check_flag
from .._progress import progress_bar
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..model.initial_states import check_vibrating
from ..model.parameters import parameter
from ..result import SearchResult
from ..sweeps.axes import Axes, check_axes, jobs, sizes
from ..sweeps.lanes import with_numbers
from ..sweeps.programs import place, ready
from ..sweeps.sweeping import SweepInterrupted
from .fold import find_fold
from .grazing import find_grazing

if TYPE_CHECKING:
    from xarray import Dataset

# Sets that a device takes at a time: some 10 ms of work, beside which the host's share is nothing.
_AT_ONCE = 8
_NAMES = (*SearchResult._name_to_item, "interrupted")  # pyright: ignore  # as in `result`
_INTERRUPTED = len(_NAMES) - 1
_LABELS = {
    "fold_belt_speed": ("greatest belt speed of a vibration", parameter("belt_speed").attrs),
    "period": ("period of the cycle there", {"units": "1 / omega_n"}),
    "result": ("how the search ended", {"units": "1"}),
}


def fold_belt_speeds(
    chain: Any, vibrating: Any = None, *, over: Mapping[str, Any], progress: bool = False
) -> Dataset:
    """`fold_belt_speed` for every combination of the values in `over`, on every device.

    The greatest belt speed v_d at which the vibration of mass `vibrating` survives, of smoothed or
    of dry friction, as `chain` is: for each set the same search, so the same numbers, as for one.

    **Arguments:**

    - `chain`, `vibrating`: as for `fold_belt_speed`.
    - `over`: as for `sweep`: from a number of the chain or of its friction law to its values, or
      from a dimension to a mapping or data frame of several that run along it together:
      `{"sample": {"damping_ratio": xi, "v_ref": speeds}}`.
    - `progress`: show a progress bar.

    **Returns:** an `xarray.Dataset` over the dimensions of `over`: `fold_belt_speed` and `period`
    of the cycle there, dimensionless, NaN where there is no fold or none was found, and `result`,
    an index into its `flag_meanings`, see `SearchResult`: how each search ended.  A set that fails
    harms no other.  Not to be differentiated: for that use `jax.vmap` of `fold_belt_speed`, in
    which all sets wait for the hardest one.

    Compiled once for any number of sets and any numbers.

    **Raises:** `ValueError` for what is not a chain, a mass it does not have, and values in `over`
    that cannot be, before anything is compiled; `SweepInterrupted` on Ctrl-C, with what was found.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.boundaries import fold_belt_speeds
        >>> found = fold_belt_speeds(
        ...     paper_chain(n=1, width=1e-2), over={"damping_ratio": [0.05, 0.06, 0.6]}
        ... )
        >>> found.fold_belt_speed.values.round(6)
        array([1.792456, 1.564241,      nan])
        >>> [found.result.flag_meanings.split()[code] for code in found.result.values]
        ['successful', 'successful', 'no_fold']
    """
    chain = as_chain(chain)
    check_concrete("use `jax.vmap` of `fold_belt_speed`.", chain=chain, over=over)
    mass = check_vibrating(chain, vibrating)
    check_flag("progress", progress)
    axes = check_axes(chain, None, over)
    values = jobs(axes)
    if "belt_speed" in values:
        raise ValueError(
            "Argument `over` names 'belt_speed', which has no part in a fold: its belt speed is "
            "what is looked for. Leave it out."
        )
    started = time.perf_counter()
    records = _blank(next(iter(values.values())).size)
    interrupted = False
    try:
        _compute(chain, mass, values, records, progress)
    except KeyboardInterrupt:
        interrupted = True
    attrs = {"vibrating": mass, "wall_time_s": round(time.perf_counter() - started, 3)}
    dataset = _to_dataset(chain, records, axes, attrs)
    if interrupted:
        raise SweepInterrupted(dataset)
    return dataset


def _blank(count: int) -> dict[str, np.ndarray]:
    return {
        "fold_belt_speed": np.full(count, np.nan),
        "period": np.full(count, np.nan),
        "result": np.full(count, _INTERRUPTED, np.int32),
    }


def _compute(
    chain: Chain,
    mass: int,
    values: Mapping[str, np.ndarray],
    records: dict[str, np.ndarray],
    show: bool,
) -> None:
    """Fills `records`, a device with the next few sets as soon as it is free."""
    total = records["result"].size
    begins = range(0, total, _AT_ONCE)
    devices = jax.local_devices()[: len(begins)]
    free: SimpleQueue = SimpleQueue()
    for device in devices:
        free.put((device, place(_Search(chain, mass), device)))

    def some(begin: int) -> tuple[slice, dict[str, Any]]:
        rows = slice(begin, min(begin + _AT_ONCE, total))
        count = rows.stop - rows.start
        own = {name: np.resize(column[rows], _AT_ONCE) for name, column in values.items()}
        device, here = free.get()
        try:
            given = jax.device_put((own, count), device)
            found = jax.device_get(ready(_find, device, here, *given)(*given))
        finally:
            free.put((device, here))
        return rows, {name: column[:count] for name, column in found.items()}

    with (
        progress_bar(total=total, desc="folds", unit="fold", show=show) as bar,
        ThreadPoolExecutor(len(devices)) as pool,
    ):
        waiting: list[Future] = [pool.submit(some, begin) for begin in begins]
        try:
            for future in as_completed(waiting):
                rows, found = future.result()
                for name, column in found.items():
                    records[name][rows] = column
                bar.update(rows.stop - rows.start)
        finally:  # after Ctrl-C or an error, what has not begun is left
            pool.shutdown(wait=False, cancel_futures=True)


class _Search(eqx.Module):
    """What is the same for all sets."""

    chain: Chain
    mass: int = eqx.field(static=True)


def _find(search: _Search, values: dict[str, Array], count: Int[Array, ""]) -> dict[str, Array]:
    """The folds of the first `count` sets, one after the other."""
    chain, mass = search.chain, search.mass

    def one(k: Array, found: dict[str, Array]) -> dict[str, Array]:
        own = with_numbers(chain, {name: column[k] for name, column in values.items()})
        fold = (find_grazing if chain.dry else find_fold)(own, mass)
        new = {
            "fold_belt_speed": fold.belt_speed,
            "period": jnp.where(fold.successful, fold.period, jnp.nan),
            "result": fold.result._value,  # pyright: ignore  # as in `result`
        }
        return {name: column.at[k].set(new[name]) for name, column in found.items()}

    blank = {name: jnp.asarray(column) for name, column in _blank(_AT_ONCE).items()}
    return lax.fori_loop(0, count, one, blank)


def _to_dataset(
    chain: Chain, records: Mapping[str, np.ndarray], axes: Axes, attrs: Mapping[str, Any]
) -> Dataset:
    # xarray brings pandas, which would double the time of the import.
    import xarray as xr

    from ..model.provenance import versions

    shape = sizes(axes)
    variables = {
        name: (tuple(shape), column.reshape(tuple(shape.values())), {"long_name": title, **own})
        for name, column in records.items()
        for title, own in [_LABELS[name]]
    }
    coords = {
        name: (dim, column, parameter(name).attrs)
        for dim, columns in axes.items()
        for name, column in columns.items()
    }
    about = {
        "chain": eqx.tree_pformat(chain, short_arrays=False),
        "versions": json.dumps(versions()),
        **attrs,
    }
    dataset = xr.Dataset(variables, coords=coords, attrs=about)
    dataset["result"].attrs |= {
        "flag_values": np.arange(len(_NAMES), dtype=np.int32), "flag_meanings": " ".join(_NAMES),
    }  # fmt: skip
    return dataset
