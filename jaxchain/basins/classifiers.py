"""Classifiers of the final state of a run: which masses vibrate, and in which phases.

They see runs of any model; `VibratingMasses` needs a `Chain`, or the amplitude `above` which a
cell vibrates.  A state is a row of integers, its code.  A run ends as soon as its code is decided;
no trajectory is stored, and no features are clustered.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import (
    check_flag,
    check_one_of,
    check_positive_number,
    check_share,
    check_whole,
    is_traced,
    named,
    optional,
    shown,
)
from .._internals import unvmap_any
from .._printing import PrintedAsCall
from .._types import ScalarLike, State
from ..continuation.damped_newton import where
from ..model.arguments import as_chain
from ..model.model import AbstractModel
from ..observers.base import AbstractObserver, Step, Variable, renamed
from ..observers.quantities import active_above
from ..result import Printed

# Amplitudes that may be rounding errors, as a share of the belt speed or of `above`.
_AT_REST = 1e-9
# Pairs of neighbours by the delay of the second, in shares of a period.
_PHASES = ("in phase", "out of phase", "in between")


class Settled(Printed, eqx.Module):
    """The final state of a run, the value of `VibratingMasses`.

    - `code`: the state, integers of shape (n,); `vibrates`: which masses vibrate, shape (n,).
    - `decided`: whether the state has persisted; `since`: the time from which it holds.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate
        >>> from jaxchain.basins import VibratingMasses
        >>> chain = paper_chain(6, belt_speed=1.5, width=None)
        >>> run = simulate(chain, equation_8(chain, 2), 300.0, observe=VibratingMasses())
        >>> end = run.observed
        >>> int(end.vibrates.sum()), bool(end.decided), bool(end.since < 300.0)
        (2, True, True)
    """

    code: Int[Array, " n"]
    vibrates: Bool[Array, " n"]
    decided: Bool[Array, ""]
    since: Float[Array, ""]


class AbstractClassifier(PrintedAsCall, AbstractObserver):
    """An observer that classifies the final state of a run, for `basin_shares`.

    Its `label` gives at least the variables `state`, integers of any shape, `decided`, whether the
    state is final, and `settling_time`; `settled` ends a decided run.  Two runs are in the same
    state if `state` is the same after `merge`.

    !!! example

        Which half of the displacements a mass ends in, decided at the end of the run:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.basins import AbstractClassifier, Box, basin_shares
        >>> from jaxchain.observers import Variable
        >>> class Side(AbstractClassifier):
        ...     def init(self, field, t0, t1, y0):
        ...         return y0[0]
        ...     def update(self, accumulator, step):
        ...         return step.y1[0]
        ...     def read(self, accumulator):
        ...         return accumulator
        ...     def label(self, value, chain):
        ...         done = Variable(jnp.asarray(True))
        ...         since = Variable(jnp.zeros(()))
        ...         side = Variable((value > 0).astype(int), ("oscillator",))
        ...         return {"state": side, "decided": done, "settling_time": since}
        ...     def name(self, code, chain):
        ...         return "right" if code[0] else "left"
        >>> chain = paper_chain(1, belt_speed=2.0, width=None)
        >>> shares = basin_shares(chain, Box(), classify=Side(), t1=200.0, half_width=0.2)
        >>> shares.state.values.tolist()  # above the fold all come to rest at F(-v_d) > 0
        ['right', 'undecided']
    """

    def merge(self, codes: Int[np.ndarray, "runs m"], model: Any) -> Int[np.ndarray, "runs k"]:
        """Makes equivalent codes equal; by default all codes are different states."""
        del model
        return codes

    def patient(self) -> Any:
        """A variant that ends no run early, as a check; None, the default, if there is none."""

    @property
    def least_time(self) -> float:
        """The least time after which a state can be known; 0 by default."""
        return 0.0

    @abc.abstractmethod
    def name(self, code: Int[np.ndarray, " k"], model: Any) -> str:
        """The name of a state, from its code after `merge`."""

    def numbers(self, code: Int[np.ndarray, " k"], model: Any) -> Mapping[str, int]:
        """Other numbers of a state, each a coordinate along `state`; by default none."""
        del code, model
        return {}


class _Looking(eqx.Module):
    low: Float[Array, " n"]  # of this window
    high: Float[Array, " n"]
    ends: Float[Array, ""]  # the window
    last: Float[Array, " n"]  # amplitude of the window before, NaN in the first
    code: Int[Array, " n"]
    quiet: Int[Array, " n"]  # windows since each mass last exceeded |v_d|/2
    lull: Int[Array, " n"]  # the greatest such number after which it exceeded that again
    same: Int[Array, ""]  # windows in succession that agree
    calm: Int[Array, ""]  # ... and in which nothing changes
    since: Float[Array, ""]
    peaks: Float[Array, "two n"] | None  # times of the latest maximum, and of the one before


class VibratingMasses(AbstractClassifier):
    """Which masses vibrate at the end of a run, and whether that can still change.

    Amplitudes A_n (half peak-to-peak) are measured in windows.  Mass n vibrates if A_n > |v_d|/2
    (see `active`), or if A_n > `above`, in one of the last `agree` + 1 windows, so that neighbours
    with slow beats both count.  No mass vibrates if none exceeds this value in the last window.
    The state is decided if it is the same in the last `agree` windows and the one before, and if
    no mass has been below the threshold for longer than in earlier beats.  A run ends early only
    if all masses do the same and this cannot change: in `calm` successive windows

        - all masses vibrate, each amplitude changes by at most the fraction `tolerance`, and
          `phases` is
      False; or
    - no mass vibrates, and sum A_n^2 falls.

    If some masses vibrate and others do not, the state may change after thousands of time units,
    because distant phases interact only through the masses between them.  So a state belongs to a
    time.

    The state in which no mass vibrates is called "sliding", of other models "quiet".  It includes
    vibrations below |v_d|/2, which a law with a supercritical Hopf bifurcation may have;
    `jaxchain.verdict` distinguishes them, see `judge` of `basin_shares`.

    **Arguments:**

    - `by`: the definition of a state: "count", the number of vibrating masses; "masses", the set
      of them; "ring", that set up to the rotations and reflections of a ring, or the reflection of
      a chain with free ends (for equal masses).
    - `phases`: whether to distinguish neighbours that vibrate in phase (delay within 1/8 of a
      period of 0), out of phase (within 1/8 of 1/2) or in between.
    - `window`: at least a period, 2 pi; `tolerance`; `agree`; `calm`, infinite to end no run
      early.
    - `above`: the amplitude above which a mass or cell vibrates; None for |v_d|/2 of a `Chain`,
      which other models do not have.  `component`: the variable of a cell that is observed.

    **Value:** `Settled`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate
        >>> from jaxchain.basins import VibratingMasses
        >>> chain = paper_chain(6, belt_speed=1.5, width=None)
        >>> run = simulate(chain, equation_8(chain, 2), 300.0, observe=VibratingMasses())
        >>> run.observed.vibrates.astype(int).tolist(), bool(run.observed.decided)
        ([0, 0, 0, 1, 1, 0], True)
        >>> run = simulate(chain, equation_8(chain, 6), 2000.0, observe=VibratingMasses())
        >>> bool(run.t < 300)  # all of them
        True
    """

    by: Literal["count", "masses", "ring"] = eqx.field(static=True, default="count")
    phases: bool = eqx.field(static=True, default=False)
    # Data, not part of the program: other values need no compilation.
    window: Float[Array, ""] = eqx.field(converter=named("window"), default=20.0)
    tolerance: Float[Array, ""] = eqx.field(converter=named("tolerance"), default=1e-3)
    agree: Float[Array, ""] = eqx.field(converter=named("agree"), default=3)
    calm: Float[Array, ""] = eqx.field(converter=named("calm"), default=3)
    above: Float[Array, ""] | None = eqx.field(converter=optional("above"), default=None)
    component: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        check_one_of("by", self.by, ("count", "masses", "ring"))
        check_flag("phases", self.phases)
        check_positive_number("window", self.window, "a period is about 2 pi; 20 is usual.")
        check_share("tolerance", self.tolerance, "1e-3 is usual.")
        check_positive_number("agree", self.agree, "3 windows are usual.")
        if self.calm.shape or not (is_traced(self.calm) or self.calm > 0):
            raise ValueError(
                f"Argument `calm` must be a number of windows, but is {shown(self.calm)}: 3 are "
                "usual."
            )
        if self.above is not None:
            check_positive_number("above", self.above, "it is an amplitude.")
        check_whole("component", self.component, 0, remedy="0 is the first number of a cell.")

    @property
    def least_time(self) -> float:
        return float(self.window)

    def patient(self) -> VibratingMasses:
        return eqx.tree_at(lambda c: c.calm, self, jnp.asarray(jnp.inf))

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> _Looking:
        del t1
        x = field.value_and_rate(t0, y0, self.component)[0]
        if self.above is None:
            as_chain(field, remedy="for other models give `above` to `VibratingMasses`.")
        none = jnp.zeros((), int)
        return _Looking(
            x, x, jnp.asarray(t0 + self.window, float), jnp.full_like(x, jnp.nan),
            jnp.full(x.shape, -1), jnp.full(x.shape, np.iinfo(np.int32).max // 2),
            jnp.zeros(x.shape, int), none, none, jnp.asarray(t0, float),
            jnp.full((2, *x.shape), jnp.nan) if self.phases else None,
        )  # fmt: skip

    def update(self, accumulator: _Looking, step: Step) -> _Looking:
        now, step = accumulator, step.of(self.component)
        end = step.y1[self.component]
        has_extreme, theta = step.turning_points()
        extreme = jnp.where(has_extreme, step.displacement(theta), end)
        low = jnp.minimum(now.low, jnp.minimum(extreme, end))
        high = jnp.maximum(now.high, jnp.maximum(extreme, end))
        now = eqx.tree_at(lambda a: (a.low, a.high), now, (low, high))
        if now.peaks is not None:
            peak, theta = step.maxima()
            latest = jnp.where(peak, step.time(theta), now.peaks[0])
            before = jnp.where(peak, now.peaks[0], now.peaks[1])
            now = eqx.tree_at(lambda a: a.peaks, now, jnp.stack([latest, before]))
        over = step.t1 >= now.ends
        # One branch for the whole batch; lanes whose window is not over do not change.
        look = lambda: self._look(now, step)
        looked = lax.cond(unvmap_any(over), look, lambda: now)
        return where(over, looked, now)

    def _look(self, now: _Looking, step: Step) -> _Looking:
        """Updates the state at the end of a window."""
        field: Any = step.field
        amplitude = (now.high - now.low) / 2
        size = jnp.abs(field.belt_speed) if self.above is None else self.above
        above = amplitude > (active_above(size) if self.above is None else size)
        quiet = jnp.where(above, 0, now.quiet + 1)
        # The amplitude of a beating mass falls below the threshold for a window at a time.
        vibrates = (quiet <= self.agree) & jnp.any(above)
        code = self._code(now, vibrates, field)
        same = jnp.all(code == now.code)
        steady = jnp.abs(amplitude - now.last) <= self.tolerance * amplitude
        rest = jnp.all(amplitude <= _AT_REST * size)
        dies = (jnp.sum(amplitude**2) < jnp.sum(now.last**2)) | rest
        # Phases still drift long after amplitudes are steady.
        even = jnp.all(above & steady) & (not self.phases)
        calm = even | (~jnp.any(above) & dies)
        # The first window decides nothing: it contains the transient.
        started = now.ends - self.window
        return _Looking(
            low=step.y1[self.component],
            high=step.y1[self.component],
            ends=now.ends + self.window,
            last=amplitude,
            code=code,
            quiet=quiet,
            lull=jnp.where(above & (now.quiet <= self.agree), now.quiet, 0).clip(min=now.lull),
            calm=jnp.where(same & calm, now.calm + 1, 0),
            same=jnp.where(same, now.same + 1, 0),
            since=jnp.where(same, now.since, started),
            peaks=now.peaks,
        )

    def _code(self, now: _Looking, vibrates: Array, model: Any) -> Array:
        """0: quiet, 1: vibrates; with phases plus 2, 4 or 6 for the delay to the previous mass."""
        code = vibrates.astype(int)
        n = vibrates.shape[0]
        if now.peaks is None or n == 1:
            return code
        latest, before = now.peaks
        share = ((latest - jnp.roll(latest, 1)) / (latest - before)) % 1.0
        beside = vibrates & jnp.roll(vibrates, 1)
        if model.ends != "cyclic":
            beside = beside & (jnp.arange(n) > 0)
        phase = jnp.where(jnp.abs(share - 0.5) < 0.125, 1, 2)
        phase = jnp.where(jnp.abs(share - 0.5) > 0.375, 0, phase)
        return code + jnp.where(beside, 2 * (phase + 1), 0)

    def settled(self, accumulator: _Looking) -> Bool[Array, ""]:
        return (accumulator.calm >= self.calm) & (accumulator.same >= self.agree)

    def rests(self, accumulator: _Looking) -> Bool[Array, ""]:
        return self.settled(accumulator) & jnp.all(accumulator.code == 0)

    def read(self, accumulator: _Looking) -> Settled:
        now = accumulator
        vibrates = now.code > 0
        # A mass that has stayed below the threshold for so long may have stopped vibrating.
        alive = jnp.all(~vibrates | (now.quiet <= now.lull))
        return Settled(now.code, vibrates, (now.same >= self.agree) & alive, now.since)

    def label(self, value: Settled, model: Any) -> dict[str, Variable]:
        variables = {
            "state": Variable(value.code, ("oscillator",), "1", "0: quiet, else vibrates"),
            "decided": Variable(value.decided, (), "1", "whether the state is settled"),
            "settling_time": Variable(
                value.since, (), "1 / omega_n", "time from which the same masses vibrate"
            ),
        }
        return renamed(variables, model, 0)

    def merge(self, codes: Int[np.ndarray, "runs m"], model: Any) -> Int[np.ndarray, "runs k"]:
        if self.by == "count":
            pairs = [np.sum(codes // 2 == kind + 1, axis=1) for kind in range(len(_PHASES))]
            counts = [np.sum(codes > 0, axis=1), *(pairs if self.phases else [])]
            return np.stack(counts, axis=1)
        if self.by == "ring":
            _check_alike(model)
            different, inverse = np.unique(codes, axis=0, return_inverse=True)
            return np.array([_canonical(code, model) for code in different])[inverse.ravel()]
        return codes

    def name(self, code: Int[np.ndarray, " k"], model: Any) -> str:
        count = self.numbers(code, model)["vibrating"]
        if count == 0:
            belts = [c.moving or np.any(c.belt_speed != 0) for c in model.frictional_contacts]
            return "sliding" if any(belts) else "quiet"
        if model.n == 1:
            return "vibrating"
        verb = "vibrates" if count == 1 else "vibrate"
        if self.by == "count":
            phases = ", ".join(
                f"{c} {word}" for c, word in zip(code[1:], _PHASES, strict=False) if c
            )
            return f"{count} {verb}" + (f": {phases}" if phases else "")
        who = []
        for mass, word in enumerate(code):
            if word > 0:
                phase = f" {_PHASES[word // 2 - 1]}" if word > 1 else ""
                who.append(f"{mass + 1}{phase}")
        return f"{', '.join(who)} {verb}"

    def numbers(self, code: Int[np.ndarray, " k"], model: Any) -> Mapping[str, int]:
        del model
        return {"vibrating": int(code[0] if self.by == "count" else np.sum(code > 0))}


def _check_alike(model: Any) -> None:
    """Raises unless the chain is invariant under rotation, or reflection with free ends."""
    for name, value in model.parameters().items():
        if value is not None and np.ndim(value) > 0 and np.ptp(np.asarray(value)) > 0:
            raise ValueError(
                'Argument `by` = "ring" takes rotated patterns for one state, but the masses or '
                f'springs of this chain differ in `{name}`: use "masses" or "count".'
            )


def _canonical(code: np.ndarray, model: Any) -> np.ndarray:
    """The lexicographically greatest image of a code under the chain's symmetries."""
    vibrates, phase = np.minimum(code, 1), code // 2
    # The phase of a pair is stored at its second mass, which is the first one after reflection.
    mirrored = vibrates[::-1] + 2 * np.roll(phase[::-1], 1)
    shifts = range(len(code) if model.ends == "cyclic" else 1)
    images = [np.roll(image, shift) for image in (code, mirrored) for shift in shifts]
    return max(images, key=tuple)
