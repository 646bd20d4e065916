"""Bad calls of continuation, of limit cycles, boundaries, designs and identifications."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
from synthetic import cycle_branch

from jaxchain.boundaries import HopfPoint
from jaxchain.cycles import continue_cycle, find_limit_cycle
from jaxchain.inverse import Identification, Measurements
from jaxchain.model import paper_chain
from jaxchain.result import SearchResult

from . import table as t
from .table import A_CHAIN, NUMBER, POSITIVE, Row, Told, row, states

CHAIN, DRY, ONE = paper_chain(3, 1.2, 1e-2), paper_chain(3, 1.2, None), paper_chain(1, 1.2, 1e-2)
STATE, REST = (jnp.full(3, 2.0), jnp.zeros(3)), (jnp.zeros(3), jnp.zeros(3))
VECTOR = (None, "x", {}, 1.0, [], [[1.0]], [math.nan], [1j])
NO_DRY = Told(DRY, "dry friction")
END = (None, "x", {}, 1j)
PAIRS = ("x", {}, 3.0, (1,), (2, 1), (math.nan, 1), ("a", "b"), (0, 1j))


def branch(u, p, args):
    return u**2 - p


def none(names):
    """These arguments are tried in other rows."""
    return dict.fromkeys(names.split(), ())


def root(u, args):
    return u**2 - 1.0


def rows() -> Iterator[Row]:
    yield from _continuation()
    yield from _cycles()
    yield from _equilibria()
    yield from _folds()
    yield from _inverse()


def _continuation() -> Iterator[Row]:
    one: dict[str, Any] = {"residual": root, "start": jnp.ones(1)}
    three, text = (
        Told(lambda u, args: jnp.ones(3), r"\(3,\)"),
        Told(lambda u, args: "text", "'text'"),
    )
    yield row(
        "newton", one, start=VECTOR, weights=("x", {}, 3.0, [1.0, 1.0], [math.nan]),
        residual=(*t.FUNCTION, lambda u: u, three, text),
    )  # fmt: skip
    good = {"before": lambda x: x < 1, "low": jnp.zeros(()), "high": 1.0, "halvings": 3}
    yield row("bisect", good, low=END, high=END, halvings=t.COUNT_0)
    yield row(
        "continue_branch", {"residual": branch, "start": jnp.ones(1), "parameter": 1.0},
        start=VECTOR, parameter=NUMBER, bounds=(None, *t.USUAL["bounds"]), both=(),
        weights=("x", {}, 3.0, [1.0], [1.0, math.nan]), tests=("x", 3, {"a": 3}),
        value_and_jacobian=("x", 3), stop=("x", 3), progress=("x", 3),
    )  # fmt: skip
    good, unused = {"residual": branch, "point": None}, none("residual step tolerance both")
    yield row("switch_branch", good, **unused, point=(None, "x", 3))


def _cycles() -> Iterator[Row]:
    guess = {"guess": states(3), "period": (6.0, "x")}
    yield row("find_limit_cycle", {"model": CHAIN}, branch=t.WORD, **guess)
    given = {"model": CHAIN, "guess": STATE, "period": 6.0}
    yield Row("find_limit_cycle, guess", find_limit_cycle, given, {"period": POSITIVE[1:]})
    many = tuple(jnp.stack([part] * 2) for part in STATE)
    yield row(
        "find_limit_cycles", {"model": CHAIN, "guesses": (many, jnp.full(2, 6.0))},
        model=(*A_CHAIN, NO_DRY), known=(None, 1.0, [STATE]),
        guesses=(None, "x", {}, object, 0, (STATE, 6.0), (many, jnp.full(3, 6.0))),
        key=(None, "x", -1, 1.5),
    )  # fmt: skip
    orbit: dict[str, Any] = {"model": CHAIN, "state": STATE, "period": 6.0}
    own = {"state": states(3), "period": POSITIVE}
    followed = {"stop": ("x", 3), "progress": ("x", 3)}
    # A cycle that is found stands for its model, state and period.
    yield row("continue_cycle", orbit, **own, **followed, events=("x", 3, {"a": 3}))
    direction = (*t.USUAL["direction"], "slip")
    dry = none("images mass rtol model progress")
    yield row("continue_cycle, dry", {**orbit, "model": DRY}, direction=direction, **dry)
    yield Row("continue_cycle, cycle", continue_cycle, {}, {"model": (*A_CHAIN, CHAIN)})
    yield row("cycle_symmetry", orbit, **own)
    good = {"branch": None, "point": None}
    yield row("switch_cycle", good, branch=(None, "x", 3), step=(), bounds=())
    yield row("monodromy_matrix", orbit, **own)
    matrix = (None, "x", {}, 3.0, jnp.ones(2), jnp.ones((2, 3)))
    flow = Told([1.0, 2.0, 3.0], r"\(3,\)"), Told((1.0,), r"\(1,\)"), jnp.zeros(2)
    good = {"monodromy": jnp.eye(2), "flow_direction": jnp.ones(2)}
    yield row("floquet_multipliers", good, monodromy=matrix, flow_direction=("x", {}, 3.0, *flow))
    good = {"monodromy": jnp.eye(2), "trace": 0.0}
    yield row("liouville_defect", good, monodromy=matrix, trace=(None, "x", {}, [1.0, 2.0], 1j))


def _equilibria() -> Iterator[Row]:
    unequal, unknown = (REST[0], jnp.zeros(2)), (REST[0], [math.nan] * 3)
    guess = ("x", 3.0, REST[0], (REST[0],), unequal, unknown)
    good: dict[str, Any] = {"model": CHAIN, "guess": REST}
    yield row("find_equilibrium", good, guess=guess)
    standing = Told(DRY.with_(belt_speed=0.0), "`belt_speed` = 0")
    named: dict[str, Any] = {"guess": guess, "model": (*A_CHAIN, standing)}
    own = good | {"parameter": "belt_speed"}
    yield row("find_hopf_point", own, **named, frequency=NUMBER, bounds=())
    over = ("x", 3.0, {}, {"belt_speed": [1.0], "width": [1.0]}, {"belt_speed": [1.0, 1.0]})
    yield row("complex_modes", {"model": CHAIN, "over": {"belt_speed": [1.0, 1.5]}}, over=over)
    good, unused = own | {"bounds": (0.5, 1.5)}, none("direction step max_step max_points")
    yield row("continue_equilibrium", good, **named, **unused, bounds=(None, *PAIRS))
    fold, hopf = cycle_branch(1).special
    speeds = [{"belt_speed": pair} for pair in (None, *PAIRS)]
    point = made(
        HopfPoint, chain=ONE, parameter="belt_speed", value=jnp.asarray(1.15),
        state=(jnp.ones(1), jnp.zeros(1)), frequency=jnp.asarray(1.0),
        mode=(jnp.ones(1) + 0j, 1j * jnp.ones(1)), result=SearchResult.successful,
    )  # fmt: skip
    yield row(
        "continue_special", {"point": point, "second": "damping_ratio"},
        point=(None, "x", {}, 3.0, ONE), second=(*t.WORD, "belt_speed"),
        bounds=("x", 3.0, [], {"width": (0.1, 0.2)}, {3: (0.1, 0.2)}, *speeds),
    )  # fmt: skip
    points = (None, "x", {}, 3.0, ONE, Told(hopf, "hopf"))
    yield row("find_special_cycle", {"point": fold}, parameter=(), mass=(), point=points)
    yield row("hopf_belt_speed", {})
    infinite = Told((0, math.inf), "inf")
    yield row("hopf_points", {"chain": CHAIN}, belt_speeds=(None, *PAIRS, infinite))
    yield row("hopf_by_descent", {"chain": CHAIN}, start=POSITIVE)


def _folds() -> Iterator[Row]:
    chain: dict[str, Any] = {"chain": CHAIN}
    for name in ("fold_belt_speed", "find_fold", "stability_range"):
        yield row(name, chain)
    yield row("fold_by_descent", chain, chain=(*A_CHAIN, NO_DRY), start=NUMBER)
    widths = ("x", {}, 3.0, [1e-2], [1, 1, 1, 1], [1, 2, 3, math.nan], [1, 2, 3, -1])
    yield row("extrapolated_fold", chain, widths=widths)
    yield row(
        "extrapolate", {"values": jnp.ones(4), "widths": jnp.arange(1.0, 5.0)},
        values=(None, "x", {}, 1.0, Told([1, 2], r"\(2,\)"), [1, 2, 3, 1j]),
        widths=(None, *widths), scale=POSITIVE, accuracy=POSITIVE,
    )  # fmt: skip


def _inverse() -> Iterator[Row]:
    one = ("x", 3, {}, (1,), (1.0, 0.0), (math.nan, 1), ("a", 1), Told((1, [1, 2]), r"\(2,\)"))
    lengths = Told(([1.0, 2.0], [1.0], 0.1), r"\(2,\), \(1,\)")
    wrong = (([1.0], [1.0], 0.0), ([1.0], [math.nan], 0.1), (["a"], [1.0], 0.1), lengths)
    names = ("amplitudes", "displacements", "periods", "means", "stick_shares")
    yield row(
        "Measurements", {"hopf": (1.15, 0.1)}, hopf=one, fold=one,
        harmonics=("x", 3, {}, ([1.0], [[math.nan]], 0.1), Told(([1.0], [1.0], 0.1), "(1,)")),
        correlation=("x", {}, [[math.nan]], Told([[2.0]], "diagonal of 1"), [1.0]),
        **dict.fromkeys(names, ("x", 3, {}, *wrong)),
    )  # fmt: skip
    values = ("a", [1.0, math.nan], {})
    yield row(
        "Signal", {"times": [0.0, 1.0], "values": [1.0, 2.0], "noise": 0.1},
        times=(*values, Told([1.0, 0.5], "1 is followed by 0.5")),
        values=(*values, Told([1.0], r"\(1,\) beside \(2,\)")),
        noise=(0.0, -1.0, math.nan, "a"), what=("speed", 3),
        start=("x", 3, {}, ("a", "b"), ([1.0], [math.nan])),
    )  # fmt: skip
    readings = {"measurements": (None, "x", {}, Measurements)}
    good: dict[str, Any] = {"chain": DRY, "measurements": Measurements(hopf=(1.0, 0.1))}
    for name in ("predict", "log_likelihood"):
        yield row(name, good, **readings)
    change = lambda chain, xi: chain.with_(damping_ratio=xi)
    more = {"change": change, "start": 0.05}
    three = Told(lambda chain, xi: 3, "is 3")
    bad = {"change": (*t.FUNCTION, lambda chain: chain, three), "start": t.TREE}
    yield row("identify", {**good, **more}, **bad, **readings)
    fit = made(Identification, theta=jnp.asarray(0.05), chain=DRY, standard_errors=0.01)
    yield row(
        "profile", {**good, "found": fit, "change": change, "place": 0}, **readings,
        found=(3, {}), place=(1, -1, 0.5, "a"), points=(2, 2.5, "a"), change=(), chain=(), mass=(),
        confidence=(0.0, 1.0, "a"),
    )  # fmt: skip
    yield row(
        "design", {"chain": DRY, **more, "width_below": 0.1}, **bad, width_below=POSITIVE[1:],
        highest_below=(1.0,), blow_above=(1.0,), cost=("x", 3),
        scale=("x", {}, math.nan, -1.0, 0.0, [1.0, 2.0]),
    )  # fmt: skip


def made(cls: Any, **fields: Any) -> Any:
    """A result with these fields alone; what is refused needs no others."""
    found = object.__new__(cls)
    for name, value in fields.items():
        object.__setattr__(found, name, value)
    return found
