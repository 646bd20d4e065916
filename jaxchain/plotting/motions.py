"""A run as a picture or as a film: over time, in the phase plane, masses on their moving belt."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.animation import FuncAnimation, writers
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from .._checks import (
    as_array,
    check_concrete,
    check_finite,
    check_positive_number,
    check_whole,
    numbers_of,
    shown,
)
from .._spelling import did_you_mean
from .._types import ArrayLike, Given, ScalarLike, StateLike
from ..cycles.limit_cycle import most_lively
from ..model.arguments import as_chain, as_model, as_state
from ..model.chain import Chain
from ..model.model import AbstractModel, StateVariable
from ..model.parameters import SPEED
from ..model.units import Scales
from ..observers.samples import Trajectory
from ..observers.section import Section
from ..simulation.method import Solver, custom_solver
from ..simulation.run import Simulation, simulate
from ..simulation.sticking import is_sticking
from .colours import BLUE, GREY, ORANGE
from .style import (
    PAGE_WIDTH,
    STYLE,
    add_colour_bar,
    add_legend,
    axis,
    check_scales,
    looks,
    on_axes,
)

LEAST_FRAMES, MOST_FRAMES = 2, 10**6
MOST_SHOWN = 8  # masses of a long chain
_UNITS = {"displacement": "x0", "velocity": SPEED}
# The band behind a line where its mass sticks.
_STUCK: dict[str, Any] = {"linewidth": 3.2, "alpha": 0.45, "solid_capstyle": "butt", "zorder": 1}
_STICKS: dict[str, Any] = {"facecolor": ORANGE, "hatch": "/////"}
_SLIDES: dict[str, Any] = {"facecolor": BLUE, "hatch": ""}
# Heights in the picture of the chain: a mass is 1 tall and stands on 0.
_BELT, _SPRING, _COUPLING, _CEILING = -0.55, 0.72, 0.25, 1.45


def plot_time_series(
    times: Given[ArrayLike],
    states: Given[StateLike | Simulation],
    model: AbstractModel | None = None,
    *,
    y: str | int = 0,
    masses: Any = None,
    ax: Axes | None = None,
    color: Any = None,
    label: str | None = None,
    scales: Scales | None = None,
) -> Axes:
    """Draws the displacement, the velocity or another component of masses over time.

    **Arguments:**

    - `times`: shape (times,), dimensionless, increasing.
    - `states`: (x, v), each of shape (times, n), or a `Simulation` that observed
      `Trajectory(times)`; of cells all m arrays.
    - `model`: adds a broad band behind a line where its mass sticks, and the belt speed to
      velocities.  Of `AbstractCells` it gives the names of the components.
    - `y`: "displacement" or "velocity"; of cells the name of a component.  Or its number, from 0.
    - `masses`: indices of the masses to draw; by default all.  More than seven have a colour bar.
    - `ax`: matplotlib axes; None makes new ones of a column's width (85 mm).
    - `color`, `label`: of the lines, to distinguish several runs on the same axes.
    - `scales`: for axes in SI units.

    **Returns:** the axes.

    **Raises:** `ValueError` for wrong shapes, numbers that are not finite, and bad arguments.

    !!! example

        >>> import numpy as np
        >>> from jaxchain.plotting import plot_time_series
        >>> times = np.linspace(0.0, 20.0, 200)
        >>> states = np.cos(times)[:, None], -np.sin(times)[:, None]  # any run of one mass
        >>> plot_time_series(times, states).get_ylabel()
        'displacement $\\\\tilde x_n$ (–)'
    """
    times = _checked_times(times)
    states = _checked_states(states, len(times))
    (part, up, y_label), (across, x_label) = _named(states, model, scales, y=y)
    picked, stuck = _checked(states, masses, model)
    lines = np.broadcast_to(across * times[:, None], part.shape), up * part
    belt = _belt(model, states, part, up)
    return _draw_curves(ax, lines, (x_label, y_label), picked, stuck, belt, color, label)


def plot_phase_portrait(
    times: Given[ArrayLike],
    states: Given[StateLike | Simulation],
    model: AbstractModel | None = None,
    *,
    x: str | int = 0,
    y: str | int = 1,
    masses: Any = None,
    ax: Axes | None = None,
    color: Any = None,
    label: str | None = None,
    scales: Scales | None = None,
) -> Axes:
    """Draws velocity over displacement of masses, or two other components of cells.

    **Arguments:** as for `plot_time_series`; `x`, `y`, the components; `model` adds the belt
    speed, and a broad band where a mass sticks.  `times` only say how many states there are.

    **Returns:** the axes.

    **Raises:** `ValueError` for wrong shapes, numbers that are not finite, and bad arguments.

    !!! example

        >>> import numpy as np
        >>> from jaxchain.plotting import plot_phase_portrait
        >>> times = np.linspace(0.0, 6.3, 100)
        >>> states = np.cos(times)[:, None], -np.sin(times)[:, None]  # any run of one mass
        >>> ax = plot_phase_portrait(times, states)
        >>> ax.get_xlabel(), len(ax.get_lines())
        ('displacement $\\\\tilde x_n$ (–)', 1)
    """
    times = _checked_times(times)
    states = _checked_states(states, len(times))
    (over, across, x_label), (part, up, y_label), _ = _named(states, model, scales, x=x, y=y)
    picked, stuck = _checked(states, masses, model)
    lines, belt = (across * over, up * part), _belt(model, states, part, up)
    return _draw_curves(ax, lines, (x_label, y_label), picked, stuck, belt, color, label)


def plot_space_time(
    times: Given[ArrayLike],
    states: Given[StateLike | Simulation],
    model: AbstractModel | None = None,
    *,
    y: str | int = 0,
    ax: Axes | None = None,
    scales: Scales | None = None,
) -> Axes:
    """Draws a component of all masses as colour, over time and the number of the mass.

    **Arguments:** as for `plot_time_series`.

    **Returns:** the axes, with a colour bar beside them.

    **Raises:** `ValueError` for wrong shapes, numbers that are not finite, and bad arguments.

    !!! example

        >>> import numpy as np
        >>> from jaxchain.plotting import plot_space_time
        >>> times, phase = np.linspace(0.0, 20.0, 200)[:, None], np.arange(12) / 2
        >>> states = np.cos(times - phase), -np.sin(times - phase)  # a wave
        >>> plot_space_time(times[:, 0], states).get_ylabel()
        'oscillator $n$'
    """
    times = _checked_times(times)
    states = _checked_states(states, len(times))
    (part, up, label), (across, x_label) = _named(states, model, scales, y=y)
    with on_axes(ax) as axes:
        mesh = axes.pcolormesh(
            across * times, np.arange(1, part.shape[1] + 1), up * part.T, rasterized=True
        )
        add_colour_bar([axes], mesh, label)
        axes.set(xlabel=x_label, ylabel="oscillator $n$")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    return axes


def _named(states: tuple[np.ndarray, ...], model: Any, scales: Any, **requested: Any) -> list[Any]:
    """(values, factor, label) of each requested component, and (factor, label) of time."""
    check_scales(scales)
    if model is not None:
        model = as_model(model)
    known = [] if model is None else model.variables
    if model is None and len(states) == 2:  # of a chain
        known = [StateVariable(name, unit) for name, unit in _UNITS.items()]
    if len(known or states) != len(states):
        raise ValueError(
            f"Argument `states` has {len(states)} parts, but a cell of `{type(model).__name__}` "
            f"has the {len(known)} components {', '.join(part.name for part in known)}."
        )
    if scales is not None and not (known and known[0].unit != "1"):
        raise ValueError("Argument `scales` is for a chain: leave it out for cells.")
    if not known:
        known = [StateVariable(str(k), "1", f"component {k}") for k in range(len(states))]
    names = [part.name for part in known]
    drawn: list[Any] = []
    for key, given in requested.items():
        if given not in names and given not in range(len(names)):
            raise ValueError(
                f"Argument `{key}` must be one of {', '.join(names)}, or its number from 0, but "
                f"is {shown(given)}{did_you_mean(given, names)}."
            )
        k = names.index(given) if given in names else int(given)
        attrs = {"units": known[k].unit}
        if known[k].unit == "1":
            attrs["long_name"] = known[k].long_name
        drawn.append((states[k], *axis(names[k], attrs, scales)))
    timed = {"units": "1", "long_name": "time $t$"}
    timed = timed if known[0].unit == "1" else {"units": "1 / omega_n"}
    return [*drawn, axis("time", timed, scales)]


def _belt(model: Any, states: tuple[np.ndarray, ...], part: Any, factor: float) -> float | None:
    """The belt speed in a picture of the velocity of a contact."""
    if model is None or not model.frictional or part is not states[model.contact]:
        return None
    belts = [c for c in model.frictional_contacts if c.displacement is not None]
    if len(belts) != 1 or belts[0].moving or np.ndim(belts[0].belt_speed):
        return None
    return factor * float(belts[0].belt_speed)


def _checked(
    states: tuple[np.ndarray, ...], masses: Any, model: Any
) -> tuple[list[int], np.ndarray | None]:
    """The masses to draw, and the times at which each mass sticks, if known."""
    n = states[0].shape[1]
    picked = [*range(n)] if masses is None else picked_masses(n, masses)
    return picked, _sticks(model, states)


def _draw_curves(
    ax: Axes | None,
    lines: tuple[np.ndarray, np.ndarray],
    names: tuple[str, str],
    picked: list[int],
    stuck: np.ndarray | None,
    belt: float | None,
    color: Any,
    label: str | None,
) -> Axes:
    shades, shade = looks(np.array(picked) + 1)
    several = len(picked) > 1 and color is None
    with on_axes(ax) as axes:
        for i, (mass, (shaded, _)) in enumerate(zip(picked, shades, strict=True)):
            name = f"oscillator {mass + 1}" if several and shade is None else None
            # Lines of one colour are one entry of the legend.
            words = [label if several or i == 0 else None, name]
            colour = shaded if color is None else color
            across, up = (part[:, mass] for part in lines)
            entry = ", ".join(filter(None, words)) or None
            axes.plot(across, up, color=colour, linewidth=1.0, label=entry)
            if stuck is not None and stuck[:, mass].any():
                axes.plot(across, np.where(stuck[:, mass], up, np.nan), color=colour, **_STUCK)
        if stuck is not None and stuck[:, picked].any():
            axes.plot([], [], color=GREY, **_STUCK, label="sticks")
        if shade is not None and color is None:
            add_colour_bar([axes], shade, "oscillator $n$")
        if belt is not None:
            dashed: Any = {"linewidth": 0.7, "linestyle": (0, (4, 2)), "zorder": 0}
            axes.axhline(belt, color="black", label="belt speed", **dashed)
        axes.set(xlabel=names[0], ylabel=names[1])
        axes.ticklabel_format(useOffset=False)  # of a mass that hardly moves
        add_legend(axes, place="beside" if len(picked) > 2 and color is None else "")
    return axes


def sticking(model: AbstractModel, states: Given[StateLike]) -> np.ndarray:
    """Which masses stick at each time, of shape (times, n).

    With dry friction a mass sticks while v = v_d; with smoothed friction while |v - v_d| is below
    the speed of greatest friction and the force on it, without friction, does not exceed p mu_st.
    For states of a smoothed chain from `EventDriven`, use `chain.with_(width=None)`.

    **Arguments:** `model`: a `Chain`, or `MechanicalCells` with friction; `states`, (x, v), of
    cells all m arrays, each of shape (times, n).

    **Returns:** booleans of that shape.

    !!! example

        >>> import jax, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Trajectory, equation_8, paper_chain, simulate
        >>> from jaxchain.plotting import sticking
        >>> chain = paper_chain(n=1, belt_speed=1.0, width=None)
        >>> watch = Trajectory(np.linspace(40.0, 46.4325, 101))  # one period
        >>> film = simulate(chain, equation_8(chain, 1), 60.0, observe=watch).observed
        >>> sticks = sticking(chain, film)
        >>> sticks.shape, round(float(sticks.mean()), 2)  # the share of the time
        ((101, 1), 0.16)
    """
    known: Any = as_model(model)
    if known.stick_speed() is None:
        raise ValueError(
            f"Argument `model` is a {type(model).__name__}, whose masses cannot stick: give a "
            "`Chain`, or `MechanicalCells` with friction."
        )
    m = len(model.variables)
    if not isinstance(states, tuple | list) or len(states) != m:
        raise ValueError(
            f"Argument `states` must be a tuple of {m} arrays, (x, v) of a chain, but is "
            f"{shown(states)}."
        )
    parts = tuple(as_array("states", part, 2, 2, "those of some times.") for part in states)
    shapes = {part.shape for part in parts}
    if len(shapes) > 1 or parts[0].shape[1] != (model.n or parts[0].shape[1]):
        raise ValueError(
            f"Argument `states` has parts of shapes {' and '.join(str(a.shape) for a in parts)}, "
            f"but all must have one shape, (times, {model.n or 'n'})."
        )
    return np.asarray(_sticking(model, parts))


@eqx.filter_jit
def _sticking(model: AbstractModel, states: Any) -> Any:
    return jax.vmap(lambda state: is_sticking(model, 0.0, state))(states)


def _sticks(model: Any, states: tuple[np.ndarray, ...]) -> np.ndarray | None:
    """`sticking`, or None where it is not known."""
    if model is None or model.stick_speed() is None:
        return None
    # The force that holds a contact under forcing depends on the time of a state.
    return sticking(model, states) if model.dry or model.forcing_period() is None else None


def loop(
    model: Given[AbstractModel],
    state: Given[StateLike],
    *,
    frames: Given[int] = 60,
    solver: Given[Solver | None] = None,
    longest: Given[ScalarLike] = 100.0,
    tolerance: Given[ScalarLike] = 1e-2,
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """A whole number of periods of the vibration through `state`, for a film in a loop.

    The motion begins at a turning point of the mass with the largest amplitude, and ends at a
    later one (after up to `longest` time units) whose displacements and velocities differ from
    those of the first by at most `tolerance`.

    **Arguments:** `state` = (x, v) after the transient; `frames`, the number of frames; `solver`
    as for `simulate`.

    **Returns:** (times, (x, v)) of shapes (frames,) and (frames, n), from time 0; the next frame
    would be the first again.

    **Raises:** `ValueError` for bad input; `RuntimeError` if nothing vibrates or the motion does
    not return.

    ```python
    chain = paper_chain(n=6, belt_speed=1.5, width=None)
    last = simulate(chain, equation_8(chain, 1), 1000.0).state
    times, states = loop(chain, last)
    animate(times, states, chain).save("chain.gif")
    ```
    """
    as_chain(model, name="model")
    check_whole("frames", frames, 1, MOST_FRAMES, "60 are usual.")
    check_positive_number("longest", longest, "100 is some sixteen periods.")
    check_positive_number("tolerance", tolerance, "1e-2 cannot be seen.")
    state, solver = as_state(model, state, "state"), custom_solver(model, solver)
    crossings = Section(most_lively(model, state), capacity=256)
    run = simulate(model, state, longest, observe=crossings, solver=solver)
    at, x, v = (np.asarray(part) for part in run.observed)
    if np.count_nonzero(np.isfinite(at)) < 2:
        raise RuntimeError(
            f"No loop was found: the liveliest mass does not turn twice within {longest} time "
            "units. Start from a state that vibrates, or raise `longest`."
        )
    apart = np.maximum(np.abs(x[1:] - x[0]).max(1), np.abs(v[1:] - v[0]).max(1))
    apart = np.where(np.isfinite(apart), apart, np.inf)
    if apart.min() > tolerance:
        raise RuntimeError(
            f"No loop was found: within {longest} time units no turn of the liveliest mass comes "
            f"closer than {apart.min():.1e} to the first. Let the transient pass, raise `longest` "
            "or `tolerance`, or make a film that does not close: `animate` takes any times."
        )
    back = 1 + int(np.argmax(apart <= max(2.0 * apart.min(), 0.1 * tolerance)))
    period = float(at[back] - at[0])
    times = period * np.arange(frames) / frames
    begin = (jnp.asarray(x[0]), jnp.asarray(v[0]))
    film = simulate(model, begin, period, observe=Trajectory(times), solver=solver)
    return times, (np.asarray(film.observed[0]), np.asarray(film.observed[1]))


def animate(
    times: Given[ArrayLike],
    states: Given[StateLike | Simulation],
    model: Given[Chain],
    *,
    masses: Any = None,
    frames_per_second: Given[ScalarLike] = 20,
) -> FuncAnimation:
    """Animates the chain on its moving belt, with the displacements and the phase plane below.

    Masses are displaced by x_n and hatched in orange while they stick.  The belt moves at v_d in
    the same unit, without a jump when the film repeats.

    **Arguments:**

    - `times`: shape (frames,), dimensionless, increasing; each is one frame.
    - `states`: (x, v), each of shape (frames, n), or a `Simulation` that observed
      `Trajectory(times)`; for films that close see `loop`.
    - `model` whose run `times` and `states` are, see `sticking`.
    - `masses`: indices of the masses to show; by default up to eight around the one with the
      largest amplitude.

    **Returns:** a matplotlib animation.  Its method `save("film.gif")` writes it, or
    `save("film.mp4")`, which needs the program ffmpeg.

    **Raises:** `ValueError` for wrong shapes, numbers that are not finite, and too few frames.

    !!! example

        >>> import jax, tempfile, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.plotting import animate
        >>> times = np.linspace(0.0, 5.0, 4)[:, None]
        >>> states = np.cos(times), -np.sin(times)  # any film of one mass
        >>> film = animate(times[:, 0], states, paper_chain(n=1))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     film.save(f"{folder}/film.gif", dpi=40)
    """
    moments, motion = _checked_film(times, states, model)
    check_positive_number("frames_per_second", frames_per_second, "20 is usual.")
    picked = _livelier(model, motion[0], masses)
    with matplotlib.rc_context(STYLE):
        page = Figure(figsize=(PAGE_WIDTH, 2.9), layout="constrained")
        page.get_layout_engine().set(h_pad=0.02)  # pyright: ignore[reportOptionalMemberAccess, reportCallIssue]
        parts: Any = page.subplot_mosaic("AAA;BBC", height_ratios=(0.9, 1.0))
        film = _Film(parts["A"], model, moments, motion, picked)
        film.add_curves(parts["B"], parts["C"], motion)
        film.explain()
        page.draw_without_rendering()  # settles the layout once
        page.set_layout_engine("none")
    return _Animation(
        page, film.show, frames=len(moments), interval=1000.0 / frames_per_second, blit=False
    )


class _Animation(FuncAnimation):
    """An animation that asks for a missing ffmpeg before it draws the first frame.

    A GIF is written without one.
    """

    def save(self, filename: Any, writer: Any = None, *arguments: Any, **options: Any) -> None:
        if writer is None:
            gif = Path(filename).suffix.lower() == ".gif"
            writer = "pillow" if gif else matplotlib.rcParams["animation.writer"]
        if writer == "ffmpeg" and not writers.is_available("ffmpeg"):
            raise RuntimeError(
                f"Argument `filename` = {str(filename)!r} needs the program ffmpeg, which is not "
                "installed: install it, or write a file that ends with .gif, which needs nothing "
                "else."
            )
        with matplotlib.rc_context(STYLE):
            super().save(filename, writer, *arguments, **options)


def _livelier(chain: Chain, x: np.ndarray, masses: Any) -> list[int]:
    """The masses to draw: neighbours of the one with the largest amplitude, around the ring."""
    n = chain.n
    if masses is not None:
        return picked_masses(n, masses)
    weight = np.ptp(x, axis=0) ** 2
    middle = np.angle(np.sum(weight * np.exp(2j * np.pi * np.arange(n) / n))) * n / (2 * np.pi)
    start = round(float(middle) - (MOST_SHOWN - 1) / 2)
    if chain.ends == "free":
        start = min(max(start % n, 0), n - MOST_SHOWN)
    return [*range(n)] if n <= MOST_SHOWN else [(start + i) % n for i in range(MOST_SHOWN)]


def _spring(start: float, end: float, height: float) -> np.ndarray:
    """Corners of a spring, straight at both ends."""
    swing = 0.1 * np.array([0, 0, 1, -1, 1, -1, 1, -1, 0, 0])
    share = np.array([0.0, 0.15, 0.2, 0.32, 0.44, 0.56, 0.68, 0.8, 0.85, 1.0])
    return np.stack([start + share * (end - start), height + swing], axis=1)


class _Film:
    """Masses, springs and belt, and points on the curves below, moved from frame to frame."""

    def __init__(
        self, axes: Axes, chain: Chain, times: np.ndarray, states: Any, picked: list[int]
    ):
        self.axes, self.chain, self.times, self.picked = axes, chain, times, picked
        self.sticks = sticking(chain, states)[:, picked]
        self.x, self.v = (part[:, picked] for part in states)
        self.cursor, self.dots = None, []
        low, high = float(self.x.min()), float(self.x.max())
        swing = max(high - low, 0.5)
        self.wide = 0.5 * swing
        self.post = low - 0.5 * self.wide - 0.3 * swing  # from where a mass has x = 0
        pitch = high + 0.5 * self.wide - self.post + 0.1 * swing
        self.home = pitch * np.arange(len(picked))
        self.left, self.right = self.post - 0.3 * swing, self.home[-1] + high + 0.6 * self.wide
        # Masses that are coupled to the next one on the right.
        ring = chain.ends == "cyclic"
        pairs = enumerate(itertools.pairwise(picked) if chain.coupling is not None else ())
        self.coupled = [i for i, (a, b) in pairs if b == a + 1 or (ring and b == 0)]
        # A whole number of marks passes in a film, slowly enough that they do not seem to run
        # backward.
        gap, speed = float(np.mean(np.diff(times))), abs(float(chain.belt_speed))
        way = speed * (times[-1] - times[0] + gap)
        marks = max(round(way / max(0.25 * pitch, 3.0 * speed * gap)), 1)
        self.stripe = way / marks if way > 0 else 0.25 * pitch
        self._draw_fixed()
        look: dict[str, Any] = {"linewidth": 0.8, "edgecolor": "black"}
        self.blocks: list[Any] = [
            axes.add_patch(Rectangle((0, 0), self.wide, 1.0, **look)) for _ in picked
        ]
        halo: dict[str, Any] = {"facecolor": "white", "linewidth": 0, "pad": 0.8}
        self.numbers = [
            axes.text(0, 0.5, str(i + 1), ha="center", va="center", fontsize=7, bbox=halo)
            for i in picked
        ]
        self.springs = LineCollection([], colors="black", linewidths=0.7)
        self.stripes = LineCollection([], colors=GREY, linewidths=1.0)
        for lines in (self.springs, self.stripes):
            axes.add_collection(lines, autolim=False)

    def _draw_fixed(self) -> None:
        """The belt with its arrow, and the ceiling with its posts."""
        axes = self.axes
        black: Any = {"color": "black"}
        axes.add_patch(
            Rectangle(
                (self.left, _BELT), self.right - self.left, -_BELT, facecolor="#eeeeee",
                edgecolor="black", linewidth=0.9, zorder=0,
            )
        )  # fmt: skip
        axes.plot([self.left, self.right], [_CEILING] * 2, linewidth=1.2, **black)
        for post in self.home + self.post:
            axes.plot([post] * 2, [_SPRING - 0.14, _CEILING], linewidth=1.4, **black)
        axes.set_xlim(self.left, self.right)
        axes.set_ylim(_BELT - 0.05, _CEILING + 0.05)
        axes.set_axis_off()
        way = 0.5 * self.wide * (1.0 if self.chain.belt_speed >= 0 else -1.0)
        middle = 0.5 * (self.left + self.right)
        arrow: Any = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, **black}
        ends = (middle + way, _BELT / 2), (middle - way, _BELT / 2)
        axes.annotate("", *ends, zorder=3, arrowprops=arrow)
        axes.text(
            middle + 1.1 * abs(way), _BELT / 2, r"$\tilde v_d$", va="center", fontsize=7, zorder=3,
            bbox={"facecolor": "#eeeeee", "linewidth": 0, "pad": 1.0},
        )  # fmt: skip

    def explain(self) -> None:
        """The legend, above the chain."""
        kinds = (("sticks", _STICKS), ("slides", _SLIDES))
        self.axes.legend(
            handles=[Patch(edgecolor="black", label=word, **look) for word, look in kinds],
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=2,
            frameon=False,
            borderpad=0.2,
            borderaxespad=0.0,
        )

    def add_curves(self, strip: Axes, plane: Axes, states: Any) -> None:
        """x over time and v over x, with a point for every mass that moves along them."""
        times, states = self._closed(states)
        look: Any = {"masses": self.picked, "color": BLUE}
        plot_time_series(times, states, self.chain, ax=strip, **look)
        plot_phase_portrait(times, states, self.chain, ax=plane, **look)
        for axes in (strip, plane):
            if (legend := axes.get_legend()) is not None:
                legend.remove()  # `explain` has the colours
            for marker, colour in (("s", ORANGE), ("o", BLUE)):
                dot: Any = {"color": colour, "markeredgecolor": "black", "markeredgewidth": 0.5}
                self.dots += axes.plot([], [], marker, markersize=4.5, zorder=4, **dot)
        self.cursor = strip.axvline(self.times[0], color=GREY, linewidth=0.7)
        strip.set_xlim(times[0], times[-1])

    def _closed(self, states: Any) -> tuple[np.ndarray, Any]:
        """Times and states; for a closed film with the first frame appended."""
        steps = [np.abs(np.diff(part, axis=0)).max() for part in states]
        leaps = [np.abs(part[-1] - part[0]).max() for part in states]
        if not all(gap <= 1.5 * step for gap, step in zip(leaps, steps, strict=True)):
            return self.times, states
        after = self.times[-1] + np.mean(np.diff(self.times))
        return np.append(self.times, after), tuple(np.vstack([p, p[:1]]) for p in states)

    def show(self, frame: int) -> list[Any]:
        """Moves everything to its position in a frame; returns what has changed."""
        time, x, v, stuck = (part[frame] for part in (self.times, self.x, self.v, self.sticks))
        middles, half = self.home + x, 0.5 * self.wide
        for block, number, middle, sticks in zip(
            self.blocks, self.numbers, middles, stuck, strict=True
        ):
            block.set(x=middle - half, **(_STICKS if sticks else _SLIDES))
            number.set_x(middle)
        ends = zip(self.home + self.post, middles - half, strict=True)
        springs = [_spring(a, b, _SPRING) for a, b in ends]
        springs += [
            _spring(middles[i] + half, middles[i + 1] - half, _COUPLING) for i in self.coupled
        ]
        self.springs.set_segments(springs)
        start = float(self.chain.belt_speed) * (time - self.times[0]) % self.stripe
        slant = 0.25 * self.stripe
        marks = np.arange(self.left + start, self.right - slant, self.stripe)
        self.stripes.set_segments([[(m, _BELT), (m + slant, 0.0)] for m in marks])
        artists = [*self.blocks, *self.numbers, self.springs, self.stripes, *self.dots]
        if self.cursor is None:
            return artists
        now = np.full_like(x, time)
        for dots, across, up, which in zip(
            self.dots, (now, now, x, x), (x, x, v, v), (stuck, ~stuck) * 2, strict=True
        ):
            dots.set_data(across[which], up[which])
        self.cursor.set_xdata([time] * 2)
        return [*artists, self.cursor]


def _checked_film(times: Any, states: Any, model: Any) -> tuple[np.ndarray, Any]:
    """Times and (x, v) as arrays of fitting shapes, or `ValueError`."""
    as_chain(model, name="model")
    times = _checked_times(times)
    return times, _checked_states(states, len(times), model.n)


def _checked_times(times: Any) -> np.ndarray:
    """Increasing times, or `ValueError`."""
    check_concrete("draw what it returns.", times=times)
    times = np.asarray(numbers_of("times", times, "one for each frame."))
    check_finite("times", times, "leave out such times.")
    if times.ndim != 1 or len(times) < LEAST_FRAMES or not np.all(np.diff(times) > 0):
        raise ValueError(
            f"Argument `times` must hold at least {LEAST_FRAMES} increasing times, one for each "
            f"frame, but has shape {times.shape}: observe `Trajectory(jnp.linspace(t0, t1, 60))`."
        )
    return times


def _checked_states(
    states: Any, times: int | None = None, n: int | None = None
) -> tuple[np.ndarray, ...]:
    """(x, v), or m arrays if `n` is None, of these many times and masses, or `ValueError`."""
    check_concrete("draw what it returns.", states=states)
    if isinstance(states, Simulation):
        states = states.observed
    pair = isinstance(states, tuple | list) and len(states) == 2
    if not isinstance(states, tuple | list) or not states or (n is not None and not pair):
        raise ValueError(
            "Argument `states` must be the pair (x, v), or a `Simulation` that observed one "
            f"`Trajectory` and nothing else, but is {type(states).__name__}."
        )
    parts = tuple(np.asarray(numbers_of("states", part)) for part in states)
    names = ("displacements", "velocities") if pair else map(str, range(len(parts)))
    first = parts[0]
    if first.ndim != 2:
        raise ValueError(
            f"Argument `states` has displacements of shape {first.shape}, but those of some times "
            "and masses have shape (times, n)."
        )
    times, n = len(first) if times is None else times, first.shape[1] if n is None else n
    for name, part in zip(names, parts, strict=True):
        if part.shape != (times, n):
            raise ValueError(
                f"Argument `states` has {name} of shape {part.shape}, but {times} times and "
                f"{n} masses need {(times, n)}."
            )
        check_finite(name, part, "a run that failed ends with NaN; see its `result`.")
    return parts


def picked_masses(n: int, masses: Any) -> list[int]:
    """Different indices of some of n masses, or `ValueError`."""
    given = masses if isinstance(masses, list | tuple | range | np.ndarray) else []
    whole = all(isinstance(i, int | np.integer) for i in given)
    picked = [int(i) for i in given] if whole else []
    if not picked or len(set(picked)) < len(picked) or not all(0 <= i < n for i in picked):
        raise ValueError(
            f"Argument `masses` must hold different indices of masses, 0 ... {n - 1}, but is "
            f"{shown(masses)}."
        )
    return picked
