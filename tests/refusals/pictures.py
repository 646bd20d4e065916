"""Bad calls of plotting."""

from __future__ import annotations

import math
from collections.abc import Iterator

import matplotlib as mpl

mpl.use("Agg")

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from synthetic import cycle_branch, ladder, special_curve

from jaxchain import plotting
from jaxchain.boundaries import complex_modes
from jaxchain.inverse import Profile
from jaxchain.model import paper_chain

from .runs import SOLVERS
from .table import A_CHAIN, COUNT, POSITIVE, WORD, Row, Told, optional, states

CHAIN = paper_chain(3, 1.2, 1e-2)
TIMES, FILM = np.arange(3.0), (np.ones((3, 3)), np.ones((3, 3)))
STATE = (jnp.full(3, 2.0), jnp.zeros(3))


def rows() -> Iterator[Row]:
    film = {"model": CHAIN, "times": TIMES, "states": FILM}
    frames = {
        "model": A_CHAIN,
        "times": (
            None, "x", {}, Told(3.0, r"\(\)"), Told([1.0], r"\(1,\)"), [1.0, math.nan, 2.0],
            Told([3.0, 2.0, 1.0], r"\(3,\)"),
        ),
        "states": (
            None, "x", {}, (1,), Told((1, 2), r"\(\)"), Told((np.ones((2, 3)),) * 2, r"\(2, 3\)"),
            (FILM[0], "x"),
        ),
        "masses": ("x", {}, 1.5, [], [3], [0, 0], [math.nan]),
    }  # fmt: skip
    bad = {**frames, "frames_per_second": POSITIVE}
    yield Row("animate", plotting.animate, film, bad)
    yield Row(
        "loop", plotting.loop, {"model": CHAIN, "state": STATE},
        {
            "model": A_CHAIN, "state": states(3), "frames": COUNT, "solver": SOLVERS,
            "longest": POSITIVE, "tolerance": POSITIVE,
        },
    )  # fmt: skip
    parts = (None, "x", {}, Told((1, 2), r"\(\)"), (FILM[0],), (FILM[0], np.ones((3, 2))))
    good = {"model": CHAIN, "states": FILM}
    yield Row("sticking", plotting.sticking, good, {"model": A_CHAIN, "states": parts})
    yield from _drawings()


def _drawings() -> Iterator[Row]:
    page = Figure()
    axes = page.subplots()
    bad = {"chain": optional(A_CHAIN), "masses": (*COUNT, 7), "axes": ("x", 3, axes)}
    yield Row("draw_model", plotting.draw_model, {}, bad)
    good, bad = {"page": page, "path": "page"}, {"page": (None, "x"), "path": (None, 3)}
    yield Row("save_figure", plotting.save_figure, good, bad)
    datasets = (None, "x", [], {}, {"a": 3})
    yield Row("figure", plotting.figure, {}, {"datasets": datasets})
    yield from _plots()


def _plots() -> Iterator[Row]:
    axes, scales = ("x", 3, []), ("x", 3)
    every = {"ax": axes, "scales": scales}
    masses = ("x", {}, 1.5, [], [3], [0, 0])
    film = {"times": TIMES, "states": FILM}
    times = (None, "x", Told(3.0, r"\(\)"), [1.0, math.nan, 2.0], Told([3.0, 2.0, 1.0], r"\(3,\)"))
    films = (None, "x", {}, (1,), Told((1, 2), r"\(\)"), (FILM[0], np.ones((3, 2))))
    motion = {**every, "states": films, "masses": masses, "model": optional(A_CHAIN)}
    bad = {**motion, "times": times, "y": WORD}
    yield Row("plot_time_series", plotting.plot_time_series, film, bad)
    yield Row(
        "plot_phase_portrait", plotting.plot_phase_portrait, film, {**motion, "times": times}
    )
    del bad["masses"]
    yield Row("plot_space_time", plotting.plot_space_time, film, bad)
    bad = {**every, "friction": (*A_CHAIN, None), "reach": optional(POSITIVE)}
    yield Row("plot_friction_law", plotting.plot_friction_law, {"friction": CHAIN}, bad)
    bad = {"profile": (None, "x", {}, 3.0), "name": (None, 3), "ax": axes}
    parts = map(jnp.asarray, (TIMES, (TIMES - 1.0) ** 2, 0.0, 0.0, 2.0, 0.68))
    good = {"profile": Profile(*parts), "name": "$v_0$"}
    yield Row("plot_profile", plotting.plot_profile, good, bad)
    runs = ladder()
    words = (3, "nonsense", ["a"])
    bad = {
        **every, "data": (None, "x", {}, Told(runs.isel(belt_speed=0, excited=0), "one value")),
        "y": (*words, "oscillator"), "x": (*words, "oscillator"), "hue": words,
        "col": words, "row": words,
    }  # fmt: skip
    yield Row("plot_sweep", plotting.plot_sweep, {"data": runs}, bad)
    grid = runs.assign_coords(law=("excited", [*"abcdefg"]))
    wrong = {
        **every, "x": words, "y": (*words, Told("law", "'a', 'b'")),
        "value": (
            *words, Told(lambda data: 3.0, "3.0"), Told(lambda data: data.energy * 1j, "Array"),
            Told(lambda data: data.energy[1:], "belt_speed"),
        ),
        "data": (
            None, "x", Told(grid.isel(excited=0), "'belt_speed': 10"),
            Told(grid.expand_dims(realisation=[1, 2]), "`excited` of 7"),
        ),
        "curves": (
            "x", {}, [], 3.0,
            Told(special_curve().to_dataset().assign_attrs(second="width"), "'width'"),
        ),
    }  # fmt: skip
    yield Row("plot_map", plotting.plot_map, {"data": grid, "x": "belt_speed"}, wrong)
    panels = {"data": runs, "x": "belt_speed", "col": "excited"}
    wrong = {"ax": ("x", 3, [], Told(Figure().subplots(), "holds 1 Axes"))}
    yield Row("plot_sweep, panels", plotting.plot_sweep, panels, wrong)
    branch = cycle_branch()
    data = branch.to_dataset()
    bad = {
        **every, "y": (*words, "amplitude", "special_energy"),
        "branch": (
            None, "x", {}, Told(runs, "belt_speed"), Told(data.isel(point=[0]), "1"),
            Told(data.drop_vars("belt_speed"), "belt_speed"),
        ),
    }  # fmt: skip
    yield Row("plot_branch", plotting.plot_branch, {"branch": branch}, bad)
    modes = complex_modes(paper_chain(2), over={"belt_speed": [1.0, 1.5]})
    bad = {"modes": (None, "x", {}, Told(runs, "excited")), "scales": scales}
    yield Row("plot_modes", plotting.plot_modes, {"modes": modes}, bad)
    wrong = {**every, "curves": (None, "x", {}, [], 3.0, Told(data, "Dataset"))}
    yield Row(
        "plot_special_curves", plotting.plot_special_curves, {"curves": special_curve()}, wrong
    )
