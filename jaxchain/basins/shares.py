"""How likely each state is: shares of starts, with error bars, over parameters.

A share is the mean of an indicator over a region.  The same points of the region are started from
at every parameter, so that what differs between parameters is not the points.  Points come in
replicates, sequences that are independent of each other, whose scatter is the error; they are
added until every error bar is as short as asked for.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import numpy as np

from .._checks import (
    check_concrete,
    check_count,
    check_flag,
    check_kind,
    check_one_of,
    check_positive_number,
    check_share,
    check_whole,
    shown,
)
from .._types import ScalarLike
from ..model.arguments import as_chain
from ..sweeps.scheduler import lane_count
from ..sweeps.sweeping import SweepInterrupted
from .classifiers import AbstractClassifier, VibratingMasses
from .dataset import to_dataset
from .regions import Points, check_region
from .runs import LATER, Checked, Runs, check_again, not_checked
from .tally import Tally, of_replicates

if TYPE_CHECKING:
    from xarray import Dataset

# What else of `sweep` may be given.
_NUMERICS = ("solver", "accuracy", "rtol", "atol", "max_step", "max_steps")
# The names of dimensions that are not the caller's.
_OWN = ("start", "point", "state", "replicate", "oscillator")
# Points of a replicate to begin with: of so few a share of 0 or 1 is told from others.
_FIRST = 32


def basin_shares(
    chain: Any,
    region: Any,
    over: Mapping[str, Any] | None = None,
    *,
    half_width: Any = 0.01,
    classify: Any = None,
    t1: ScalarLike = 1000.0,
    points: Literal["sobol", "random"] = "sobol",
    replicates: int = 32,
    most: int = 2**20,
    checked: int = 64,
    judge: bool = False,
    seed: int = 0,
    lanes: int | None = None,
    devices: Sequence[Any] | None = None,
    progress: bool = False,
    **numerics: Any,
) -> Dataset:
    """The share of a region from which a chain ends in each of its states, with error bars.

    share_k = 1/n sum_i [start i ends in state k], starts i spread over the region.

    **Arguments:**

    - `chain`: a `Chain`, best with dry friction (`width=None`): a width changes the shares.
    - `region`: a `Box`, `Ball`, `Gaussian` or `Sampler`.
    - `over`: as for `sweep`, numbers of the chain such as `{"belt_speed": [1.2, 1.5]}`; at each of
      them the same points are started from.
    - `half_width`: that of the longest of the 95 % bars of all shares at which no more starts are
      made; or `most` starts have been made at every parameter.
    - `classify`: what a state is, an `AbstractClassifier`; by default `VibratingMasses()`, how
      many masses vibrate.
    - `t1`: the time at which a start is in its state.  Runs end earlier where that is decided; one
      whose state still changes then is "undecided", which has a share like the others.
    - `points`: "sobol", scrambled Sobol points, or "random"; `replicates`, how many independent
      sequences of them; `seed`.
    - `checked`: how many decisions at each parameter are looked at again, by runs that do not end
      early, to `t1` and to four times that (`classify.patient()`; 0 for none).  Those that turn
      out otherwise at `t1` lengthen the bars, see below.
    - `judge`: whether `jaxchain.verdict` is asked of the motion from a start of each state at each
      parameter, "periodic" or "chaotic", say: seconds for one mass, minutes for each of twenty.
    - `lanes`, `devices`, `progress`, and `solver`, `rtol`, `accuracy`, ... (`numerics`): as for
      `sweep`.

    **Returns:** an `xarray.Dataset` over the dimensions of `over` and `state`, whose coordinate
    names the states; "undecided" is always the last, but for "failed" if a run did:

    - `share`; `low`, `high`: its 95 % interval.  Of Sobol points it is Student's t of the
      replicates' shares, of random points, and of a state in or out of which are fewer than two
      starts a replicate, Wilson's interval of a fraction.  If of the checked decisions for k the
      part e(k, l) turns out l, `low` of k is lowered by share_k sum_l e(k, l), and `high` of l
      raised by sum_k share_k e(k, l).
    - `share_at_end`: of the starts that were in state k when their runs ended, decided or not.
    - `undecided`, also as a variable of its own; `misclassified`: sum_kl share_k e(k, l);
      `changed_later`: the share of starts that are in another state at four times `t1`.
    - `settling_time`: the median time from which nothing changed any more, NaN where none is.
    - `start_displacement`, `start_velocity` (..., oscillator): a start that ends there.
    - `verdict`, with `judge`: on that start, see `jaxchain.chaos.Verdict`.
    - `replicate_share` (..., replicate, state), of which `share_differences` makes differences.

    Attributes: `starts` at each parameter, `longest_half_width` of the bars before the checks,
    `checked`, seed, tolerances, versions; `warning`, also given as one, where more starts change
    later than the bars tell.

    **Raises:** `ValueError` for bad input before anything is compiled; `SweepInterrupted` on
    Ctrl-C, with the shares of the rounds that were finished.

    Sources: P. J. Menck, J. Heitzig, N. Marwan, J. Kurths, Nature Physics 9, 89 (2013); replicates
    of scrambled sequences: P. L'Ecuyer, C. Lemieux, Recent advances in randomized quasi-Monte
    Carlo methods, in: Modeling Uncertainty, Kluwer 2002.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.basins import Box, basin_shares
        >>> chain = paper_chain(1, belt_speed=1.5, width=None)
        >>> shares = basin_shares(chain, Box(displacement=(-2, 2), velocity=(0, 2)))
        >>> shares.state.values.tolist()
        ['sliding', 'vibrating', 'undecided']
        >>> sliding = shares.sel(state="sliding")
        >>> bool(sliding.low < 0.307126 < sliding.high)  # what `sliding_share` says
        True
    """
    chain = as_chain(chain)
    check_concrete(
        "shares are counted on the host; `sliding_share` has derivatives.", chain=chain, over=over
    )
    check_region(region, chain)
    classify = VibratingMasses() if classify is None else classify
    check_kind(
        "classify", classify, AbstractClassifier, "None or an `AbstractClassifier`",
        "`VibratingMasses()` tells which masses vibrate.",
    )  # fmt: skip
    check_positive_number("t1", t1, "1000 is usual.")
    if t1 < classify.least_time:
        raise ValueError(
            f"Argument `t1` must be at least {classify.least_time:g}, the first time at which "
            f"`classify` knows a state, but is {shown(t1)}."
        )
    check_share("half_width", half_width, "0.01 is usual.")
    check_one_of("points", points, ("sobol", "random"))
    check_whole("replicates", replicates, 4, 1024, "32 are usual.")
    check_whole("most", most, replicates * _FIRST, remedy="starts at each parameter.")
    check_whole("checked", checked, 0, remedy="64 at each parameter are usual.")
    check_whole("seed", seed, 0, remedy="it is the seed of the points.")
    check_flag("judge", judge)
    check_flag("progress", progress)
    check_count("lanes", lanes)
    over = {} if over is None else over
    check_kind("over", over, Mapping, "None or a mapping", '{"belt_speed": [1.2, 1.5]}, say.')
    if taken := [name for name in over if name in _OWN]:
        raise ValueError(
            f"Argument `over` names {taken}, but dimensions of the result are called so: give "
            "them other names."
        )
    if unknown := [name for name in numerics if name not in _NUMERICS]:
        raise ValueError(
            f"Argument `{unknown[0]}` is none of `basin_shares`; of those of `sweep` it takes "
            f"{', '.join(f'`{name}`' for name in _NUMERICS)}."
        )
    devices = jax.local_devices() if devices is None else devices
    lanes = lane_count(chain.n, replicates * _FIRST, devices, lanes)
    numerics |= {"lanes": lanes, "devices": devices}
    runs = Runs(chain, region, over, classify, t1, progress, numerics)
    cube = Points(region.dimension(chain), replicates, points, seed)
    began, tally = time.perf_counter(), Tally(classify, chain)
    count, drawn = _FIRST, []

    def result(seen: Checked, judge: bool) -> Dataset:
        at = np.concatenate(drawn, axis=1).reshape(-1, drawn[0].shape[-1])
        bars = tally.bars(even=points == "sobol")
        bars_kept = bars.widened(seen.lost, seen.gained)
        found = to_dataset(runs, tally, bars_kept, seen, at, judge)
        found.attrs |= {
            "starts": len(at), "replicates": replicates, "points": points, "seed": seed,
            "longest_half_width": bars.longest, "checked": seen.runs,
            "region": eqx.tree_pformat(region, short_arrays=False),
            "wall_time_s": round(time.perf_counter() - began, 3),
        }  # fmt: skip
        reach = np.max(bars_kept.high - bars_kept.low, axis=1) / 2
        changed = seen.leaving.sum(1)  # NaN where nothing was checked
        if np.any(late := changed > reach):
            worst = int(np.argmax(np.where(late, changed - reach, -np.inf)))
            found.attrs["warning"] = (
                f"{changed[worst]:.0%} of the starts are in another state at {LATER} t1, "
                f"more than the bars of {reach[worst]:.1%}: these are the shares at t1 = "
                f"{t1:g}, not the final ones. Raise `t1`, or say the time with the share."
            )
            warnings.warn(found.attrs["warning"], stacklevel=3)
        return found

    try:
        while True:
            new = cube.more(count)
            tally.add(runs.of(new))
            drawn.append(new)
            longest = tally.bars(even=points == "sobol").longest
            # As many as the bars want, which shrink with the root of that; twice as many at most.
            wanted = min((longest / half_width) ** 2, 2.0) * tally.starts
            count = _FIRST * math.ceil((wanted - tally.starts) / _FIRST)
            if longest <= half_width or replicates * (tally.starts + count) > most:
                break
        at = np.concatenate(drawn, axis=1).reshape(-1, drawn[0].shape[-1])
        seen = check_again(runs, tally, at, checked, seed)
    except SweepInterrupted:
        if not drawn:
            raise
        raise SweepInterrupted(result(not_checked(tally), False)) from None
    if longest > half_width:
        warnings.warn(
            f"The longest bar is {longest:.2g}, not {half_width}, after "
            f"{replicates * tally.starts} starts: raise `most`.",
            stacklevel=2,
        )
    return result(seen, judge)


def share_differences(shares: Dataset, dim: str) -> Dataset:
    """By how much shares differ between neighbouring values of a parameter, with error bars.

    d_k = share_k(next) - share_k.  Both are of the same starts, so that most of what is random in
    them is the same: the error is that of the differences of the replicates, Student's t at 95 %,
    many times smaller than that of two shares whose starts have nothing in common.

    **Arguments:** `shares`, what `basin_shares` returns; `dim`, a dimension of it with numbers.

    **Returns:** a dataset with `difference`, `low`, `high` over the other dimensions, `state`, and
    `dim`, whose values are the middles.

    **Raises:** `ValueError` for a dimension that is not there or has a single value.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.basins import Box, basin_shares, share_differences
    >>> chain = paper_chain(1, width=None)
    >>> shares = basin_shares(chain, Box(), {"belt_speed": [1.4, 1.5]}, half_width=0.02)
    >>> rise = share_differences(shares, "belt_speed").difference.sel(state="sliding")
    >>> rise.belt_speed.values.tolist(), bool(rise[0] > 0.05)
    ([1.45], True)
    """
    from xarray import Dataset

    check_kind("shares", shares, Dataset, "a dataset of `basin_shares`")
    if dim not in shares.dims or dim in _OWN or shares.sizes[dim] < 2:
        raise ValueError(
            "Argument `dim` must be a swept dimension of at least two values, but is "
            f"{shown(dim)} of {dict(shares.sizes)}."
        )
    own = shares["replicate_share"].transpose(dim, ...)
    change = own[1:].values - own[:-1].values
    axis = own.dims.index("replicate")
    mean, reach = of_replicates(change, axis)
    dims = [name for name in own.dims if name != "replicate"]
    at = shares[dim].values
    coords = {name: c for name, c in shares.coords.items() if dim not in c.dims and name in dims}
    parts = {
        "difference": (mean, "difference of the shares at neighbouring values"),
        "low": (mean - reach, "lower end of its 95 % interval"),
        "high": (mean + reach, "upper end of its 95 % interval"),
    }
    return Dataset(
        {
            name: (dims, values, {"long_name": text, "units": "1"})
            for name, (values, text) in parts.items()
        },
        coords={**coords, dim: (dim, (at[1:] + at[:-1]) / 2, shares[dim].attrs)},
    )
