"""Bad calls of plotting."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from drawn import made_up_modes
from matplotlib.figure import Figure
from synthetic import cycle_branch, ladder, special_curve

from jaxchain.inverse import Profile
from jaxchain.model import MechanicalCells, paper_chain

from .table import A_CHAIN, COUNT, WORD, Row, Told, row, states

CHAIN = paper_chain(3, 1.2, 1e-2)
TIMES, FILM = np.arange(3.0), (np.ones((3, 3)), np.ones((3, 3)))
WORDS = (3, "nonsense", ["a"])
MASSES = ("x", {}, 1.5, [], [3], [0, 0])


def rows() -> Iterator[Row]:
    yield from _motions()
    yield from _drawings()
    yield from _plots()


def _motions() -> Iterator[Row]:
    still, short = Told((1, 2), r"\(\)"), (FILM[0], np.ones((3, 2)))
    backward = Told([3.0, 2.0, 1.0], r"\(3,\)")
    times = (None, "x", Told(3.0, r"\(\)"), [1.0, math.nan, 2.0], backward)
    film: dict[str, Any] = {"times": TIMES, "states": FILM}
    two = Told((np.ones((2, 3)),) * 2, r"\(2, 3\)")
    frames = {"times": (*times, Told([1.0], r"\(1,\)")), "masses": (*MASSES, [math.nan])}
    own = {"model": CHAIN, **film}
    yield row("animate", own, **frames, states=(None, "x", {}, (1,), still, two, (FILM[0], "x")))
    good = {"model": CHAIN, "state": (jnp.full(3, 2.0), jnp.zeros(3))}
    yield row("loop", good, state=states(3))
    parts = (None, "x", {}, still, (FILM[0],), short)
    yield row("sticking", {"model": CHAIN, "states": FILM}, states=parts)
    motion = {"times": times, "states": (None, "x", {}, (1,), still, short)}
    yield row("plot_time_series", film, **motion, masses=MASSES, y=WORD)
    yield row("plot_phase_portrait", film, **motion, masses=MASSES)
    yield row("plot_space_time", film, **motion, y=WORD)


def _drawings() -> Iterator[Row]:
    page = Figure()
    axes = page.subplots()
    large = Told(MechanicalCells(np.eye(7)), "but has 7")
    yield row("draw_model", {}, chain=("x", 3, large), masses=(*COUNT, 7), axes=("x", 3, axes))
    yield row("save_figure", {"page": page, "path": "page"}, page=(None, "x"), path=(None, 3))
    yield row("figure", {}, datasets=(None, "x", [], {}, {"a": 3}))
    friction = (*A_CHAIN, None)
    yield row("plot_friction_law", {"friction": CHAIN}, friction=friction)


def _plots() -> Iterator[Row]:
    parts = map(jnp.asarray, (TIMES, (TIMES - 1.0) ** 2, 0.0, 0.0, 2.0, 0.68))
    good: dict[str, Any] = {"profile": Profile(*parts), "name": "$v_0$"}
    yield row("plot_profile", good, profile=(None, "x", {}, 3.0), name=(None, 3))
    runs = ladder()
    one = Told(runs.isel(belt_speed=0, excited=0), "one value")
    yield row(
        "plot_sweep", {"data": runs}, y=(*WORDS, "oscillator"), x=(*WORDS, "oscillator"),
        data=(None, "x", {}, one), **dict.fromkeys(("hue", "col", "row"), WORDS),
    )  # fmt: skip
    panels = {"data": runs, "x": "belt_speed", "col": "excited"}
    one = Told(Figure().subplots(), "holds 1 Axes")
    yield row("plot_sweep, panels", panels, ax=("x", 3, [], one))
    grid = runs.assign_coords(law=("excited", [*"abcdefg"]))
    curve = special_curve()
    numbers = Told(lambda data: 3.0, "3.0"), Told(lambda data: data.energy * 1j, "Array")
    part, other = Told(lambda data: data.energy[1:], "belt_speed"), curve.to_dataset()
    line = Told(grid.isel(excited=0), "'belt_speed': 10")
    cube = Told(grid.expand_dims(realisation=[1, 2]), "`excited` of 7")
    yield row(
        "plot_map", {"data": grid, "x": "belt_speed"}, x=WORDS, data=(None, "x", line, cube),
        y=(*WORDS, Told("law", "'a', 'b'")), value=(*WORDS, *numbers, part),
        curves=("x", {}, [], 3.0, Told(other.assign_attrs(second="width"), "'width'")),
    )  # fmt: skip
    branch = cycle_branch()
    data = branch.to_dataset()
    point, bare = Told(data.isel(point=[0]), "1"), Told(data.drop_vars("belt_speed"), "belt_speed")
    yield row(
        "plot_branch", {"branch": branch}, y=(*WORDS, "amplitude", "special_energy"),
        branch=(None, "x", {}, Told(runs, "belt_speed"), point, bare),
    )  # fmt: skip
    modes = {"modes": made_up_modes(1.0, 1.5)}
    yield row("plot_modes", modes, modes=(None, "x", {}, Told(runs, "excited")))
    wrong = (None, "x", {}, [], 3.0, Told(data, "Dataset"))
    yield row("plot_special_curves", {"curves": curve}, curves=wrong)
