"""How likely each state is: shares of starts, with error bars, over parameters.

A share is the mean of an indicator over a region.  All parameters use the same points, so that
differences are not due to the points.  Points come in replicates, independent sequences whose
scatter gives the error.  Points are added until every error bar is short enough.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

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
from .._statistics import student_reach, wilson
from .._types import Given, ScalarLike, State
from ..chaos.classification import verdicts
from ..datasets import Variable, along, dataset, oscillators
from ..model.arguments import as_chain, as_model
from ..model.model import AbstractModel
from ..result import ended_well
from ..sweeps.axes import Axes, check_axes, jobs, sizes
from ..sweeps.lanes import RunStarts, with_numbers
from ..sweeps.programs import starter
from ..sweeps.scheduler import lane_count
from ..sweeps.sweeping import SweepInterrupted, sweep
from .classifiers import AbstractClassifier, VibratingMasses
from .regions import AbstractRegion, Points, check_region

if TYPE_CHECKING:
    from xarray import Dataset

UNDECIDED, FAILED = "undecided", "failed"
# With fewer runs in (or out of) a state per replicate, the scatter is not a reliable error.
_FEW = 2


class Batch(NamedTuple):
    """The outcome of each run, over (parameters, replicates, starts)."""

    codes: Int[np.ndarray, "p r s m"]  # as the classifier merges them
    decided: Bool[np.ndarray, "p r s"]
    failed: Bool[np.ndarray, "p r s"]
    since: Float[np.ndarray, "p r s"]

    @staticmethod
    def read(data: Any, classify: AbstractClassifier, model: Any, shape: tuple) -> Batch:
        """From a dataset of `sweep`, whose last swept dimension is `start`."""
        lanes = data["result"].values
        codes = data["state"].values.reshape(lanes.size, -1)
        merged = classify.merge(codes, model)
        flat = {name: data[name].values.reshape(shape) for name in ("decided", "settling_time")}
        well = ended_well(lanes).reshape(shape)
        decided = well & (flat["decided"] != 0)
        return Batch(merged.reshape(*decided.shape, -1), decided, ~well, flat["settling_time"])


class Bars(NamedTuple):
    """Shares and their 95 % intervals over (parameters, states)."""

    share: Float[np.ndarray, "p k"]
    low: Float[np.ndarray, "p k"]
    high: Float[np.ndarray, "p k"]

    @property
    def longest(self) -> float:
        """Half the length of the longest bar."""
        return float(np.max(self.high - self.low) / 2)

    def widened(self, lost: Float[np.ndarray, "p k"], gained: Float[np.ndarray, "p k"]) -> Bars:
        """The bars, widened by the shares of wrong decisions."""
        lost, gained = np.nan_to_num(lost), np.nan_to_num(gained)
        low, high = np.maximum(self.low - lost, 0.0), np.minimum(self.high + gained, 1.0)
        return Bars(self.share, low, high)


def of_replicates(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean over replicates, and the half-width of its 95 % interval by Student's t."""
    count = values.shape[axis]
    spread = np.std(values, axis=axis, ddof=1) / count**0.5
    return np.mean(values, axis=axis), student_reach(0.95, count - 1) * spread


class Tally:
    """All runs so far; states are numbered in the order in which they were found."""

    def __init__(self, classify: AbstractClassifier, model: AbstractModel):
        self.classify, self.chain = classify, model
        self.codes: list[np.ndarray] = []
        self._numbers: dict[bytes, int] = {}
        self._batches: list[tuple[np.ndarray, ...]] = []

    @property
    def starts(self) -> int:
        """The number of starts of each replicate."""
        return sum(batch[0].shape[2] for batch in self._batches)

    @property
    def states(self) -> int:
        """The number of states found; "undecided" and "failed" come after them."""
        return len(self.codes)

    def number(self, batch: Batch) -> Int[np.ndarray, "p r s"]:
        """The number of the state of each run when it ended; 0 for a failed run."""
        well = ~batch.failed
        different, inverse = np.unique(batch.codes[well], axis=0, return_inverse=True)
        of_codes = []
        for code in different:
            key = code.tobytes()
            if key not in self._numbers:
                self._numbers[key] = len(self.codes)
                self.codes.append(code)
            of_codes.append(self._numbers[key])
        numbers = np.zeros(well.shape, int)
        numbers[well] = np.array(of_codes, int)[inverse.ravel()]
        return numbers

    def add(self, batch: Batch) -> None:
        """Counts another batch of runs."""
        self._batches.append((self.number(batch), batch.decided, batch.failed, batch.since))

    def _all(self, part: int) -> np.ndarray:
        return np.concatenate([batch[part] for batch in self._batches], axis=2)

    @property
    def at_end(self) -> Int[np.ndarray, "p r s"]:
        """The state of each run when it ended; -1 for a failed run."""
        return np.where(self._all(2), -1, self._all(0))

    @property
    def since(self) -> Float[np.ndarray, "p r s"]:
        """The time after which the state of each run did not change."""
        return self._all(3)

    @property
    def state(self) -> Int[np.ndarray, "p r s"]:
        """... or `states` if it was undecided, and one more if it failed."""
        state = np.where(self._all(1), self._all(0), self.states)
        return np.where(self._all(2), self.states + 1, state)

    def shares(self, numbers: Int[np.ndarray, "p r s"], states: int) -> Float[np.ndarray, "p r k"]:
        """The share of each state in each replicate."""
        p, r, s = numbers.shape
        flat = np.where(numbers < 0, states, numbers).reshape(p * r, s)
        rows = np.arange(p * r)[:, None] * (states + 1) + flat
        counts = np.bincount(rows.ravel(), minlength=p * r * (states + 1))
        return counts.reshape(p, r, states + 1)[..., :states] / s

    def bars(self, *, even: bool) -> Bars:
        """Bars of all states, "undecided" and "failed"; `even`: for points of a Sobol sequence."""
        shares = self.shares(self.state, self.states + 2)
        mean, reach = of_replicates(shares, 1)
        total = shares.shape[1] * self.starts
        count = np.round(mean * total)
        low, high = wilson(count, total)
        if even:
            enough = np.minimum(count, total - count) >= _FEW * shares.shape[1]
            low = np.where(enough, np.maximum(mean - reach, 0.0), low)
            high = np.where(enough, np.minimum(mean + reach, 1.0), high)
        return Bars(mean, low, high)


# Later changes of state are checked at this multiple of the time.
LATER = 4


class _From(eqx.Module):
    """The start at a point of a region."""

    region: Any

    def __call__(self, model: AbstractModel, point: Float[Array, " dimension"]) -> State:
        return self.region.start(model, point)


class Runs:
    """The runs from points of a region, at every combination of the parameters."""

    def __init__(
        self, model: AbstractModel, region: Any, n: int, over: Mapping[str, Any], classify: Any,
        t1: Any, progress: bool, numerics: dict[str, Any],
    ):  # fmt: skip
        self.chain, self.over, self.classify, self.t1 = model, over, classify, t1
        self.n = n
        self.initial = _From(region)
        self.numerics: dict[str, Any] = {**numerics, "progress": progress}
        # Over the parameters, without a start.
        nowhere = {"start": {"point": np.zeros((1, region.dimension(model)))}}
        self.axes: Axes = check_axes(model, self.initial, {**over, **nowhere})
        del self.axes["start"]
        self.coords: dict[str, Any] = {}
        self.attrs: dict[str, Any] = {}

    def at(self, indices: Int[np.ndarray, " runs"]) -> dict[str, np.ndarray]:
        """The parameters at these indices."""
        columns = jobs(self.axes) if self.axes else {}
        return {name: values[indices] for name, values in columns.items()}

    @property
    def shape(self) -> dict[str, int]:
        """The shape of the grid of parameters."""
        return sizes(self.axes)

    def of(self, points: Float[np.ndarray, "replicates starts dimension"]) -> Batch:
        """Runs from all points at every parameter."""
        over = {**self.over, "start": {"point": points.reshape(-1, points.shape[-1])}}
        name = f"shares of {points[..., 0].size} starts"
        data = self._sweep(over, self.classify, self.t1, name)
        first = data.isel(start=0, drop=True)
        named = {str(name): c.variable for name, c in first.coords.items()}
        varied = [name for name in named if name not in ("oscillator", "point")]
        self.coords = {name: named[name] for name in varied}
        self.attrs = data.attrs
        return Batch.read(data, self.classify, self.chain, (-1, *points.shape[:2]))

    def again(
        self, indices: Int[np.ndarray, " runs"], points: Float[np.ndarray, "runs d"], times: int
    ) -> Batch:
        """Runs from some points, each at the parameters of one index, for `times` the time."""
        over = {"start": {**self.at(indices), "point": points}}
        name = f"{len(indices)} starts again"
        data = self._sweep(over, self.classify.patient(), times * self.t1, name)
        return Batch.read(data, self.classify, self.chain, (1, 1, len(indices)))

    def _sweep(self, over: Mapping[str, Any], classify: Any, t1: Any, name: str) -> Dataset:
        with warnings.catch_warnings():
            # Failed runs are a separate state.
            warnings.filterwarnings("ignore", message=".* runs ended with")
            return sweep(
                self.chain,
                self.initial,
                t1,
                over=over,
                observe=classify,
                description=name,
                **self.numerics,
            )

    def starts(
        self, indices: Int[np.ndarray, " runs"], points: Float[np.ndarray, "runs d"]
    ) -> tuple[np.ndarray, ...]:
        """(x, v), or all m arrays of other cells, of shape (runs, n), from these points at the
        parameters of these indices."""
        values = {**self.at(indices), "point": points}
        columns = {name: jnp.asarray(column) for name, column in values.items()}
        starts = RunStarts(self.chain, self.initial, n=self.n)
        made = starter(jax.local_devices()[0], starts, columns)(columns)
        return tuple(np.asarray(part) for part in made.state)


def verdicts_of(
    runs: Runs, indices: Int[np.ndarray, " runs"], state: tuple[np.ndarray, ...], progress: bool
) -> list[str]:
    """The verdicts on the motions from these starts, each at the parameters of its index."""
    words = [""] * len(indices)
    for index in np.unique(indices):
        here = np.nonzero(indices == index)[0]
        values = runs.at(np.array([index]))
        chain = with_numbers(runs.chain, {name: value[0] for name, value in values.items()})
        settings: dict[str, Any] = {"solver": runs.numerics.get("solver"), "progress": progress}
        judged = verdicts(chain, tuple(jnp.asarray(part[here]) for part in state), **settings)
        for number, one in zip(here, judged, strict=True):
            words[number] = one.verdict
    return words


class Checked(NamedTuple):
    """The result of checking some runs again, as shares over (parameters, states)."""

    lost: Float[np.ndarray, "p k"]  # decided for the state, but in another one at the time t1
    gained: Float[np.ndarray, "p k"]
    leaving: Float[np.ndarray, "p k"]  # in another one later
    runs: int


def not_checked(tally: Tally) -> Checked:
    """The result without checks."""
    unknown = np.full((tally.at_end.shape[0], tally.states + 2), np.nan)
    return Checked(unknown, unknown, unknown, 0)


def check_again(
    runs: Runs, tally: Tally, points: Float[np.ndarray, "s d"], most: int, seed: int
) -> Checked:
    """Wrong decisions and later changes of state, from runs that do not end early.

    At each parameter it checks about `most` of the decisions, in proportion to the share of each
    state, and at least one per state if possible.
    """
    state = tally.state.reshape(tally.state.shape[0], -1)
    picks: list[tuple[int, int, int, float]] = []  # index, state, start, the share it stands for
    rng = np.random.default_rng([seed, 1])
    for index, reached in enumerate(state if runs.classify.patient() is not None else ()):
        present, counts = np.unique(reached[reached < tally.states], return_counts=True)
        left = 2 * most
        for k in np.argsort(-counts) if most else ():
            wanted = max(1, round(float(most * counts[k] / reached.size)))
            count = min(int(counts[k]), wanted, left)
            left -= count
            chosen = rng.choice(np.nonzero(reached == present[k])[0], count, replace=False)
            share = float(counts[k] / reached.size / max(count, 1))
            picks += [(index, int(present[k]), int(start), share) for start in chosen]
    if not picks:
        return not_checked(tally)
    indices, before, starts, shares = (np.array(column) for column in zip(*picks, strict=True))
    after, later = (
        np.where(batch.failed, before, tally.number(batch)).ravel()
        for batch in (runs.again(indices, points[starts], times) for times in (1, LATER))
    )
    lost, gained, leaving = (np.zeros((len(state), tally.states + 2)) for _ in range(3))
    wrong, gone = after != before, later != after
    np.add.at(lost, (indices[wrong], before[wrong]), shares[wrong])
    np.add.at(gained, (indices[wrong], after[wrong]), shares[wrong])
    np.add.at(leaving, (indices[gone], after[gone]), shares[gone])
    return Checked(lost, gained, leaving, len(picks))


def to_dataset(
    runs: Runs,
    tally: Tally,
    bars: Bars,
    seen: Checked,
    points: Float[np.ndarray, "s d"],
    judge: bool,
) -> Dataset:
    """Shares with their bars, and the other results for each state, over the parameters.

    **Arguments:** `points` of the cube, of all starts; `judge`, whether verdicts are wanted.
    """
    chain, classify, known_states = runs.chain, runs.classify, tally.states
    state, at_end = tally.state, tally.at_end
    numbers = [dict(classify.numbers(code, chain)) for code in tally.codes]
    failed = np.any(state > known_states)
    # States with more vibrating masses later; then by how likely they are.
    likely = -bars.share[:, :known_states].mean(0)
    order = sorted(range(known_states), key=lambda k: (*numbers[k].values(), likely[k]))
    order += [known_states, known_states + 1][: 1 + failed]
    names = [classify.name(code, chain) for code in tally.codes] + [UNDECIDED, FAILED]
    first, settling = _of_states(state, tally.since, known_states + 2)
    indices, states = np.nonzero(first >= 0)
    started = runs.starts(indices, points[first[indices, states]])
    starts = [np.full((*first.shape, runs.n), np.nan) for _ in started]
    for part, values in zip(starts, started, strict=True):
        part[indices, states] = values
    shape = tuple(runs.shape.values())

    def over(values: np.ndarray, text: str, *dims: str, units: str = "1") -> Variable:
        if "state" in dims:
            values = np.take(values, order, 1 + dims.index("state"))
        return Variable(values.reshape((*shape, *values.shape[1:])), dims, units, text)

    share, end = (tally.shares(numbers, known_states + 2) for numbers in (state, at_end))
    last = "share of the starts in the state when their runs ended"
    settled = "median time from which nothing changed"
    variables = {
        "share": over(bars.share, "share of the starts that end in the state", "state"),
        "low": over(bars.low, "lower end of the 95 % interval of the share", "state"),
        "high": over(bars.high, "upper end of the 95 % interval of the share", "state"),
        "share_at_end": over(end.mean(1), last, "state"),
        "settling_time": over(settling, settled, "state", units=chain.time_unit),
        "replicate_share": over(share, "share in one sequence of starts", "replicate", "state"),
    }
    for k, values in enumerate(starts):
        name, unit, _ = chain.variable(k)
        text = f"{name} of a start that ends in the state"
        variables[f"start_{name}"] = over(values, text, "state", "oscillator", units=unit)
    if judge:
        words = np.full(first.shape, "", dtype="<U32")
        progress = runs.numerics["progress"]
        words[indices, states] = verdicts_of(runs, indices, started, progress)
        variables["verdict"] = over(words, "verdict on the motion from that start", "state")
    undecided = bars.share[:, known_states]
    variables |= {
        "undecided": over(undecided, "share of the starts that are not decided"),
        "misclassified": over(seen.lost.sum(1), "share of the starts decided too early"),
        "changed_later": over(seen.leaving.sum(1), "share of the starts in another state later"),
    }
    all_names = np.array([names[k] for k in order])
    coords = {
        **runs.coords,
        "state": Variable(all_names, ("state",), None, "state in which a run ends"),
        "oscillator": oscillators(runs.n, "1"),
    }
    for name in numbers[0] if numbers else ():
        column = [numbers[k][name] if k < known_states else np.nan for k in order]
        text = f"{name}, as the classifier says of the state"
        coords[name] = Variable(np.array(column, float), ("state",), "1", text)
    return dataset(along(variables, *runs.shape), coords, runs.attrs)


def _of_states(state: np.ndarray, since: np.ndarray, states: int) -> tuple[np.ndarray, np.ndarray]:
    """(first start, -1 if none; median settling time) of each state at each parameter."""
    first, median = np.full((len(state), states), -1), np.full((len(state), states), np.nan)
    # Within a batch the replicates follow each other, like their points.
    rows = zip(state.reshape(len(state), -1), since.reshape(len(since), -1), strict=True)
    for index, (state_row, times) in enumerate(rows):
        order = np.argsort(state_row, kind="stable")
        kinds, begins = np.unique(state_row[order], return_index=True)
        first[index, kinds] = order[begins]
        for k, part in zip(kinds, np.split(times[order], begins[1:]), strict=True):
            median[index, k] = np.median(part) if k < states - 2 else np.nan
    return first, median


# Other arguments of `sweep` that may be given.
_NUMERICS = ("solver", "accuracy", "rtol", "atol", "max_step", "max_steps")
# Reserved names of dimensions.
_OWN = ("start", "point", "state", "replicate", "oscillator")
# Points of a replicate at first: enough to distinguish a share of 0 or 1 from others.
_FIRST = 32


def basin_shares(
    model: Given[AbstractModel],
    region: Given[AbstractRegion],
    over: Mapping[str, Any] | None = None,
    *,
    half_width: Given[ScalarLike] = 0.01,
    classify: Given[AbstractClassifier | None] = None,
    t1: Any = None,
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
    """The share of starts in a region that end in each state, with error bars.

    share_k = 1/n sum_i [start i ends in state k], with starts i from the region.

    **Arguments:**

    - `model`: a `Chain`, best with dry friction (`width=None`): a width changes the shares.  Or
      `AbstractOscillators` or `AbstractCells`, with `classify`; forced ones start at t = 0.
    - `region`: a `Box`, `Ball` or `Gaussian` of a `Chain`; a `Ranges` or `Sampler` of any model.
    - `over`: as for `sweep`, parameters of the chain such as `{"belt_speed": [1.2, 1.5]}`; all use
      the same starts.
    - `half_width`: starts are added until every 95 % bar is at most this half-width, or until
      there are `most` starts at every parameter.
    - `classify`: the definition of a state, an `AbstractClassifier`; by default
      `VibratingMasses()`, the number of vibrating masses, which needs a `Chain` or its `above`.
    - `t1`: the time at which the state is determined, 1000 in the unit of `natural_scales`.
      Decided runs end earlier; a run whose state still changes at `t1` is "undecided", which has a
      share like the others.
    - `points`: "sobol" (scrambled) or "random"; `replicates`: the number of independent sequences;
      `seed`.
    - `checked`: the number of decisions at each parameter that are checked by runs without an
      early end, to `t1` and to 4 `t1` (`classify.patient()`; 0: none).  Wrong decisions lengthen
      the bars, see below.
    - `judge`: whether to call `jaxchain.verdict` for one start of each state at each parameter:
      seconds for one mass, minutes for twenty.
    - `lanes`, `devices`, `progress`, and `solver`, `rtol`, `accuracy`, ... (`numerics`): as for
      `sweep`.

    **Returns:** an `xarray.Dataset` over the dimensions of `over` and `state`, whose coordinate
    names the states; the last one is "undecided", followed by "failed" if a run failed:

    - `share`; `low`, `high`: its 95 % interval.  For Sobol points it is Student's t interval of
      the replicates' shares.  For random points, and for states with (or without) fewer than two
      starts per replicate, it is Wilson's interval of a fraction.  If the checks assign the
      fraction e(k, l) of the decisions for k to l, `low` of k is lowered by share_k sum_l e(k, l),
      and `high` of l is raised by sum_k share_k e(k, l).
    - `share_at_end`: the share of starts in state k when their runs ended, decided or not.
    - `undecided`: also a separate variable; `misclassified`: sum_kl share_k e(k, l);
      `changed_later`: the share of starts that are in another state at 4 `t1`.
    - `settling_time`: the median time after which the state did not change; NaN without starts.
    - `start_displacement`, `start_velocity` (..., oscillator): a start that ends in this state;
      of cells `start_<component>` for each of their numbers.
    - `verdict`, with `judge`: for that start, see `jaxchain.chaos.Verdict`.
    - `replicate_share` (..., replicate, state): the input of `share_differences`.

    Attributes: `starts` at each parameter, `longest_half_width` of the bars before the checks,
    `checked`, seed, tolerances, versions; `warning`, also issued as a warning, if more starts
    change later than the bars allow.

    **Raises:** `ValueError` for bad input before anything is compiled; `SweepInterrupted` on
    Ctrl-C, with the shares of the finished rounds.

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
    model = as_model(model)
    check_concrete(
        "shares are counted on the host; `sliding_share` has derivatives.", model=model, over=over
    )
    n = check_region(region, model)
    if classify is None:
        as_chain(
            model,
            remedy="give `classify` for other models, as `VibratingMasses(above=1.0)`.",
            name="model",
        )
        classify = VibratingMasses()
    check_kind(
        "classify",
        classify,
        AbstractClassifier,
        "None or an `AbstractClassifier`",
        "`VibratingMasses()` counts the vibrating masses.",
    )
    t1 = 1000.0 * float(model.natural_scales()[0]) if t1 is None else t1
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
    lanes = lane_count(n, replicates * _FIRST, devices, lanes)
    numerics |= {"lanes": lanes, "devices": devices}
    runs = Runs(model, region, n, over, classify, t1, progress, numerics)
    cube = Points(region.dimension(model), replicates, points, seed)
    began, tally = time.perf_counter(), Tally(classify, model)
    count, drawn = _FIRST, []

    def result(seen: Checked, judge: bool) -> Dataset:
        at = np.concatenate(drawn, axis=1).reshape(-1, drawn[0].shape[-1])
        bars = tally.bars(even=points == "sobol")
        bars_kept = bars.widened(seen.lost, seen.gained)
        data = to_dataset(runs, tally, bars_kept, seen, at, judge)
        data.attrs |= {
            "starts": len(at),
            "replicates": replicates,
            "points": points,
            "seed": seed,
            "longest_half_width": bars.longest,
            "checked": seen.runs,
            "region": eqx.tree_pformat(region, short_arrays=False),
            "wall_time_s": round(time.perf_counter() - began, 3),
        }
        reach = np.max(bars_kept.high - bars_kept.low, axis=1) / 2
        changed = seen.leaving.sum(1)  # NaN where nothing was checked
        if np.any(late := changed > reach):
            worst = int(np.argmax(np.where(late, changed - reach, -np.inf)))
            data.attrs["warning"] = (
                f"{changed[worst]:.0%} of the starts are in another state at {LATER} t1, "
                f"more than the bars of {reach[worst]:.1%}: these are the shares at t1 = "
                f"{t1:g}, not the final ones. Raise `t1`, or state the time with the share."
            )
            warnings.warn(data.attrs["warning"], stacklevel=3)
        return data

    try:
        while True:
            new = cube.more(count)
            tally.add(runs.of(new))
            drawn.append(new)
            longest = tally.bars(even=points == "sobol").longest
            # As many as the bars need, which shrink with the square root; at most twice as many.
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
    """Differences of shares between neighbouring values of a parameter, with error bars.

    d_k = share_k(next) - share_k.  Both shares use the same starts, so their errors are
    correlated.  The error is Student's 95 % t interval of the differences of the replicates, much
    smaller than that of independent shares.

    **Arguments:** `shares`, the result of `basin_shares`; `dim`, a numeric dimension of it.

    **Returns:** a dataset with `difference`, `low`, `high` over the other dimensions, `state`, and
    `dim`, whose values are the midpoints.

    **Raises:** `ValueError` for a dimension that does not exist or has a single value.

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
    replicates = shares["replicate_share"].transpose(dim, ...)
    change = replicates[1:].values - replicates[:-1].values
    axis = replicates.dims.index("replicate")
    mean, reach = of_replicates(change, axis)
    dims = tuple(str(name) for name in replicates.dims if name != "replicate")
    at = shares[dim].values
    coords = {
        str(name): c for name, c in shares.coords.items() if dim not in c.dims and name in dims
    }
    text = "difference of the shares at neighbouring values"
    return dataset(
        {
            "difference": Variable(mean, dims, "1", text),
            "low": Variable(mean - reach, dims, "1", "lower end of its 95 % interval"),
            "high": Variable(mean + reach, dims, "1", "upper end of its 95 % interval"),
        },
        {**coords, dim: (dim, (at[1:] + at[:-1]) / 2, shares[dim].attrs)},
    )
