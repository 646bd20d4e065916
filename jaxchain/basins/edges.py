"""Edge states: what moves for ever on the boundary between two basins."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_positive_number, is_traced, shown, to_float
from .._final import final
from .._types import State
from ..cycles.limit_cycle import LimitCycle, can_be_cycle
from ..cycles.search import find_limit_cycle
from ..model.arguments import as_chain, as_state
from ..model.chain import Chain
from ..observers.amplitude import Amplitude
from ..observers.section import Section
from ..result import Outcome, SearchResult, ended_well
from ..simulation.accuracy import MAX_STEP, check_resolved, check_tolerances, own_solver
from ..simulation.run import MOST_SEGMENTS, simulate
from .edge_tracking import Tracking, is_between, track

# Windows that are looked at in the end, and the states in them: one for each period.
_LAST, _RETURNS = 3, 24
# Of the size of the orbit: what may be missing where it closes.
_CLOSED = 1e-6
RTOL = 1e-11


@final
class EdgeState(Outcome):
    """The motion on the edge between two basins, as far as it was followed.

    - `state`: (x, v) on the edge at the end; `below` and `above`: the ends of the bracket there,
      on the quiet side and on the other; `distance`: between these, sqrt(|dx|^2 + |dv|^2).  Runs
      from there go to both sides if their `rtol` is that of the search, no coarser.
    - `amplitude`: half peak-to-peak of each mass over three windows from there, shape (n,).
    - `period`: of a motion that closes, NaN for any other; `gap`: the least distance, relative to
      the size of the orbit, at which it comes back within these.
    - `vibrates`: which masses go on vibrating from below and from above, shape (2, n).
    - `mass`: the one (from 0) in which the two sides differ most.
    - `times`, `amplitudes`, `distances`: ends of the windows of the tracking, shape (windows,),
      the amplitude of each mass in them, (windows, n), mean of both ends of the bracket, and the
      distance of the ends; NaN after the tracking has ended.
    - `result`: how it ended.  Unless the tracking itself ended well, numbers are NaN.
    - `chain`: whose state it is.

    Dimensionless: displacements in P/k, times in 1 / omega_n.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import excited_state, paper_chain
        >>> from jaxchain.basins import edge_state
        >>> chain = paper_chain(1, belt_speed=1.7, width=None)
        >>> weak, strong = (excited_state(chain, 1, amplitude=a) for a in (0.5, 2.5))
        >>> edge = edge_state(chain, weak, strong)
        >>> bool(edge.successful), edge.vibrates.tolist()  # from below, and from above
        (True, [[False], [True]])
        >>> bool(edge.distance < 1e-5), round(float(edge.period), 3)
        (True, 6.301)
    """

    chain: Chain
    state: State
    below: State
    above: State
    distance: Float[Array, ""]
    amplitude: Float[Array, " n"]
    period: Float[Array, ""]
    gap: Float[Array, ""]
    vibrates: Bool[Array, "2 n"]
    mass: Int[Array, ""]
    times: Float[Array, " windows"]
    amplitudes: Float[Array, "windows n"]
    distances: Float[Array, " windows"]
    result: SearchResult

    @property
    def periodic(self) -> Bool[Array, ""]:
        """Whether the motion closes, to 1e-6 of its size."""
        return jnp.isfinite(self.period)

    def cycle(self, **how: Any) -> LimitCycle:
        """The limit cycle that closes at `state`, by Newton's method: see `find_limit_cycle`.

        **Raises:** `RuntimeError` if there is none, `ValueError` if the motion is not periodic.
        """
        if not is_traced(self.period) and not bool(self.periodic):
            raise ValueError(
                "Argument `edge` is not periodic, so that there is no cycle to close: its `gap` "
                f"after a turn is {float(self.gap):.1e}."
            )
        vibrating = None if is_traced(self.mass) else int(self.mass)
        how = {"vibrating": vibrating} | how
        return find_limit_cycle(self.chain, (self.state, self.period), **how)


def edge_state(
    chain: Chain,
    quiet: Any,
    vibrating: Any,
    *,
    time: Any = 1000.0,
    window: Any = 20.0,
    patience: Any = 20000.0,
    near: Any = 1e-10,
    far: Any = 1e-6,
    tolerance: Any = 1e-8,
    rtol: Any = RTOL,
    solver: Any = None,
) -> EdgeState:
    """The state on the edge between the basins of two starts, by bisection and edge tracking.

    On the segment y(s) = y_quiet + s (y_vibrating - y_quiet) lies a point from which a run goes to
    neither side.  The bracket [a, b] about it is cut into thirds, by runs from both points in
    between, until |b - a| <= near A; then a and b run on as long as |b - a| <= far A, and the
    segment between the states where they have got to is cut again, and so on: the bracket
    stays about a motion that is unstable in one direction alone, and stable along the edge, to
    which it converges.  A is the greatest amplitude of the masses in question.

    First both starts settle, and tell the masses in question: those that vibrate from the one and
    not from the other.  A run is decided when each of these has for three windows been quiet, with
    an amplitude within 5 % (of the way between those of the two states) of the quiet one, or
    vibrated: within 10 % of the other amplitude, and sticking to the belt.  A mass on the edge
    slides throughout.  That amplitudes repeat themselves decides nothing: so they do there, too.

    **Arguments:** (dimensionless)

    - `chain`: a `Chain`, with dry friction or smoothed.
    - `quiet`, `vibrating`: (x, v), both of shape (n,), from which different masses go on
      vibrating.
    - `time`: how long the edge is followed, at most; it ends as soon as the amplitudes of five
      windows (of a narrow bracket) agree within `tolerance` A.  `window`: at least a period, 2 pi
      for masses as in the paper.  Both are numbers of Python.
    - `patience`: the time after which a run must be decided.
    - `near`, `far`: see above.
    - `rtol`, `solver`: as for `simulate`; the distance `near` asks for a small one.

    **Returns:** an `EdgeState`.  Works under `jit` and `vmap`, and many pairs are followed side by
    side, none waiting for another.  It has no derivatives (`RuntimeError`): those of the cycle on
    the edge are `find_limit_cycle`'s.  Its `result` is one of

    - "successful": amplitudes on the edge have settled;
    - "not_settled": followed for `time`, but amplitudes do not agree, as those of a motion with
      two frequencies; what was found is returned all the same;
    - "other_state": beyond the edge other masses vibrate than from `vibrating`;
    - "same_state", "undecided", "too_close", "edge_lost", "nonfinite": no edge is known.

    **Raises:** `ValueError` for bad input.

    Source: Skufca, Yorke and Eckhardt, Phys. Rev. Lett. 96, 174101 (2006); Battelino et al.,
    Physica D 32, 296 (1988).

    !!! example

        One mass: the edge is the unstable cycle, on which it slides throughout.

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import excited_state, find_limit_cycle, paper_chain
        >>> from jaxchain.basins import edge_state
        >>> chain = paper_chain(1, belt_speed=1.7, width=None)
        >>> weak, strong = (excited_state(chain, 1, amplitude=a) for a in (0.5, 2.5))
        >>> edge = edge_state(chain, weak, strong)
        >>> exact = find_limit_cycle(chain, branch="unstable")
        >>> bool(abs(edge.amplitude[0] - exact.amplitude[0]) < 1e-6), bool(edge.periodic)
        (True, True)
    """
    as_chain(chain)
    quiet, vibrating = as_state(chain, quiet, "quiet"), as_state(chain, vibrating, "vibrating")
    check_positive_number("window", window, "20, some three periods, is usual.")
    check_positive_number("time", time, "1000 is usual.")
    check_positive_number("patience", patience, "20000 is usual.")
    for name, value in (("near", near), ("far", far), ("tolerance", tolerance)):
        check_positive_number(name, value, "see `edge_state`.")
    for name, value in (("time", time), ("window", window), ("rtol", rtol)):
        if is_traced(value):
            raise ValueError(
                f"Argument `{name}` decides what is compiled, but is traced: use a number of "
                "Python, the same for every lane."
            )
    if not is_traced(near, far) and float(far) < 10.0 * float(near):
        raise ValueError(
            f"Argument `far` must be at least ten times `near` = {near}, but is {shown(far)}: "
            "the ends of the bracket run on from the one distance to the other."
        )
    check_tolerances(rtol, None, MAX_STEP)
    solver = own_solver(chain, solver)
    if not chain.dry:
        check_resolved(chain.n, chain.width, chain.belt_speed, rtol, None)
    windows = _count(time, window)
    how = Tracking(
        windows=windows, window=to_float(window), patience=to_float(patience) / to_float(window),
        near=to_float(near), far=to_float(far), tolerance=to_float(tolerance),
        rtol=float(rtol), solver=solver,
    )  # fmt: skip
    return _edge(chain, quiet, vibrating, how)


def _count(time: Any, window: Any) -> int:
    """How many windows the edge is followed for."""
    count = round(float(time) / float(window))
    if not 1 <= count <= MOST_SEGMENTS:
        raise ValueError(
            f"Argument `time` must be 1 ... {MOST_SEGMENTS} times the `window`, {window}, but is "
            f"{time}: 1000 is usual."
        )
    return count


@eqx.filter_jit
def _edge(chain: Chain, quiet: State, vibrating: State, how: Tracking) -> EdgeState:
    frozen, quiet, vibrating = eqxi.nondifferentiable(
        (chain, quiet, vibrating),
        msg="`edge_state` has no derivatives: find the edge state outside the function that is "
        "differentiated, and in there the cycle on it, `find_limit_cycle(chain, (edge.state, "
        "edge.period))`, which has them.",
    )
    found = track(frozen, quiet, vibrating, how)
    below, above = ((found.x[side], found.v[side]) for side in (0, 1))
    state = 0.5 * (below[0] + above[0]), 0.5 * (below[1] + above[1])
    difference = found.last_high[1] - found.last_high[0]
    differs = found.vibrates[0] != found.vibrates[1]
    mass = jnp.argmax(jnp.where(differs, jnp.abs(difference), -1.0))
    amplitude, period, missing, well = _last(frozen, state, mass, how)
    result = SearchResult.where(
        (found.result == SearchResult.successful) & ~well, SearchResult.nonfinite, found.result
    )
    close = (result == SearchResult.successful) & ~is_between(found, amplitude)
    result = SearchResult.where(close, SearchResult.too_close, result)
    followed = result == SearchResult.successful
    other = jnp.any(found.sides != found.vibrates)
    late = SearchResult.where(found.settled, result, SearchResult.not_settled)
    late = SearchResult.where(other, SearchResult.other_state, late)
    result = SearchResult.where(followed, late, result)

    def known(tree: Any) -> Any:
        return jax.tree.map(lambda a: jnp.where(followed, a, jnp.nan), tree)

    return EdgeState(
        chain=chain,
        state=known(state),
        below=known(below),
        above=known(above),
        distance=known(found.distance),
        amplitude=known(amplitude),
        period=known(period),
        gap=known(missing),
        vibrates=found.sides,
        mass=mass,
        times=how.window * (1.0 + jnp.arange(how.windows)),
        amplitudes=found.amplitudes,
        distances=found.distances,
        result=result,
    )


def _last(
    chain: Chain, state: State, mass: Array, how: Tracking
) -> tuple[Array, Array, Array, Array]:
    """(amplitudes, period, what is missing where it closes, whether the runs ended well).

    From the middle of the bracket.  Of the turning points of the mass in question the first is
    compared with later ones.
    """
    run = simulate(
        chain, state, _LAST * how.window, observe=(Amplitude(), Section(mass, _RETURNS)),
        solver=how.solver, rtol=how.rtol, throw=False,
    )  # fmt: skip
    amplitude, (times, x, v) = run.observed
    size = jnp.sqrt(jnp.sum(amplitude**2))
    away = jnp.sqrt(jnp.sum((x - x[:1]) ** 2 + (v - v[:1]) ** 2, axis=1)) / size
    away = jnp.where(jnp.isnan(away).at[0].set(True), jnp.inf, away)
    closes = jnp.argmax(away <= _CLOSED)  # the first time round, 0 for none
    period = times[closes] - times[0]
    closed = (closes > 0) & can_be_cycle(chain, period, jnp.abs(state[1]))
    period = jnp.where(closed, period, jnp.nan)
    return amplitude, period, jnp.min(away), ended_well(run.result)
