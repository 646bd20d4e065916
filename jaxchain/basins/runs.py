"""The runs behind shares: from all points at all parameters, and some of them for longer."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._types import State
from ..chaos.classification import verdicts
from ..model.chain import Chain
from ..sweeps.axes import Axes, check_axes, jobs, sizes
from ..sweeps.programs import starts_on
from ..sweeps.starts import Starts, with_numbers
from ..sweeps.sweeping import sweep
from .tally import Batch, Tally

if TYPE_CHECKING:
    from xarray import Dataset

# At how many times the time it is looked whether a state has changed later.
LATER = 4


class _From(eqx.Module):
    """The start at a point of a region."""

    region: Any

    def __call__(self, chain: Chain, point: Float[Array, " dimension"]) -> State:
        return self.region.start(chain, point)


class Runs:
    """The runs from points of a region, at every combination of the parameters."""

    def __init__(
        self, chain: Chain, region: Any, over: Mapping[str, Any], classify: Any, t1: Any,
        progress: bool, numerics: dict[str, Any],
    ):  # fmt: skip
        self.chain, self.over, self.classify, self.t1 = chain, over, classify, t1
        self.initial = _From(region)
        self.numerics: dict[str, Any] = {**numerics, "progress": progress}
        # Of the parameters, without a start.
        nowhere = {"start": {"point": np.zeros((1, region.dimension(chain)))}}
        self.axes: Axes = check_axes(chain, self.initial, {**over, **nowhere})
        del self.axes["start"]
        self.coords: dict[str, Any] = {}
        self.attrs: dict[str, Any] = {}

    def at(self, places: Int[np.ndarray, " runs"]) -> dict[str, np.ndarray]:
        """The parameters of these places."""
        own = jobs(self.axes) if self.axes else {}
        return {name: values[places] for name, values in own.items()}

    @property
    def shape(self) -> dict[str, int]:
        """Of the parameters."""
        return sizes(self.axes)

    def of(self, points: Float[np.ndarray, "replicates starts dimension"]) -> Batch:
        """From all points at every parameter."""
        over = {**self.over, "start": {"point": points.reshape(-1, points.shape[-1])}}
        name = f"shares of {points[..., 0].size} starts"
        data = self._sweep(over, self.classify, self.t1, name)
        first = data.isel(start=0, drop=True)
        named = {str(name): c.variable for name, c in first.coords.items()}
        own = [name for name in named if name not in ("oscillator", "point")]
        self.coords = {name: named[name] for name in own}
        self.attrs = data.attrs
        return Batch.read(data, self.classify, self.chain, (-1, *points.shape[:2]))

    def again(
        self, places: Int[np.ndarray, " runs"], points: Float[np.ndarray, "runs d"], times: int
    ) -> Batch:
        """From some points, each at the parameters of one place, for `times` the time."""
        over = {"start": {**self.at(places), "point": points}}
        name = f"{len(places)} starts again"
        data = self._sweep(over, self.classify.patient(), times * self.t1, name)
        return Batch.read(data, self.classify, self.chain, (1, 1, len(places)))

    def _sweep(self, over: Mapping[str, Any], classify: Any, t1: Any, name: str) -> Dataset:
        with warnings.catch_warnings():
            # They are a state of their own.
            warnings.filterwarnings("ignore", message=".* lanes ended with")
            return sweep(
                self.chain, self.initial, t1, over=over, observe=classify, description=name,
                **self.numerics,
            )  # fmt: skip

    def starts(
        self, places: Int[np.ndarray, " runs"], points: Float[np.ndarray, "runs d"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """(x, v), both of shape (runs, n), from these points at the parameters of these places."""
        values = {**self.at(places), "point": points}
        own = {name: jnp.asarray(column) for name, column in values.items()}
        made = starts_on(jax.local_devices()[0], Starts(self.chain, self.initial), own)
        x, v = made.state
        return np.asarray(x), np.asarray(v)


def verdicts_of(
    runs: Runs, places: Int[np.ndarray, " runs"], x: np.ndarray, v: np.ndarray, progress: bool
) -> list[str]:
    """The verdicts on the motions from these starts, each at the parameters of its place."""
    found = [""] * len(places)
    for place in np.unique(places):
        here = np.nonzero(places == place)[0]
        values = runs.at(np.array([place]))
        chain = with_numbers(runs.chain, {name: own[0] for name, own in values.items()})
        settings: dict[str, Any] = {"solver": runs.numerics.get("solver"), "progress": progress}
        own = verdicts(chain, (jnp.asarray(x[here]), jnp.asarray(v[here])), **settings)
        for number, one in zip(here, own, strict=True):
            found[number] = one.verdict
    return found


class Checked(NamedTuple):
    """What was found by looking at some runs again, as shares over (parameters, states)."""

    lost: Float[np.ndarray, "p k"]  # taken for the state, and in another one at the time t1
    gained: Float[np.ndarray, "p k"]
    leaving: Float[np.ndarray, "p k"]  # in another one later
    runs: int


def not_checked(tally: Tally) -> Checked:
    """Nothing is known of later."""
    unknown = np.full((tally.at_end.shape[0], tally.states + 2), np.nan)
    return Checked(unknown, unknown, unknown, 0)


def check_again(
    runs: Runs, tally: Tally, points: Float[np.ndarray, "s d"], most: int, seed: int
) -> Checked:
    """What was decided too early, and what changes later, by runs that do not end early.

    At each parameter about `most` of the decisions, as many of each state as its share, and at
    least one of each as far as they go.
    """
    state = tally.state.reshape(tally.state.shape[0], -1)
    picks: list[tuple[int, int, int, float]] = []  # place, state, start, the share it stands for
    rng = np.random.default_rng([seed, 1])
    for place, own in enumerate(state if runs.classify.patient() is not None else ()):
        found, counts = np.unique(own[own < tally.states], return_counts=True)
        left = 2 * most
        for k in np.argsort(-counts) if most else ():
            wanted = max(1, round(float(most * counts[k] / own.size)))
            count = min(int(counts[k]), wanted, left)
            left -= count
            chosen = rng.choice(np.nonzero(own == found[k])[0], count, replace=False)
            share = float(counts[k] / own.size / max(count, 1))
            picks += [(place, int(found[k]), int(start), share) for start in chosen]
    if not picks:
        return not_checked(tally)
    places, before, starts, shares = (np.array(column) for column in zip(*picks, strict=True))
    after, later = (
        np.where(batch.failed, before, tally.number(batch)).ravel()
        for batch in (runs.again(places, points[starts], times) for times in (1, LATER))
    )
    lost, gained, leaving = (np.zeros((len(state), tally.states + 2)) for _ in range(3))
    wrong, gone = after != before, later != after
    np.add.at(lost, (places[wrong], before[wrong]), shares[wrong])
    np.add.at(gained, (places[wrong], after[wrong]), shares[wrong])
    np.add.at(leaving, (places[gone], after[gone]), shares[gone])
    return Checked(lost, gained, leaving, len(picks))
