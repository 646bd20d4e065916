"""Bad calls of continuation and of limit cycles."""

from __future__ import annotations

import math
from collections.abc import Iterator

import jax.numpy as jnp
import optax

from jaxchain import continuation, cycles
from jaxchain.model import paper_chain

from .table import (
    A_CHAIN,
    COUNT,
    FLAG,
    FUNCTION,
    INDEX,
    NONNEGATIVE,
    NUMBER,
    POSITIVE,
    TREE,
    WORD,
    Row,
    Told,
    optional,
    states,
)  # fmt: skip

CHAIN, DRY = paper_chain(3, 1.2, 1e-2), paper_chain(3, 1.2, None)
STATE = (jnp.full(3, 2.0), jnp.zeros(3))
VECTOR = (None, "x", {}, 1.0, [], [[1.0]], [math.nan], [1j])
BOUNDS = ("x", 3, (1,), (2, 1), (math.nan, 1), ("a", "b"), {}, (3.0, 4.0))
STEPS = dict.fromkeys(("step", "min_step", "max_step"), POSITIVE)
FOLLOWED = {"stop": ("x", 3), "progress": ("x", 3)}
DIRECTION = (None, "x", 0, 2, [1.0, 2.0, 3.0], math.nan, {})
IMAGES = ("x", 3, {}, (0,), (1, 0, 2), (math.nan, 1, 2), ("a", 1, 2))
NO_DRY = Told(DRY, "dry friction")
VIBRATING = (*optional(INDEX), 3)


def branch(u, p, args):
    return u**2 - p


def root(u, args):
    return u**2 - 1.0


def rows() -> Iterator[Row]:
    yield from _searches()
    yield from _branches()
    yield from _cycles()


def _searches() -> Iterator[Row]:
    count = optional(COUNT)
    good = {"residual": root, "start": jnp.ones(1)}
    yield Row(
        "newton", continuation.newton, good,
        {
            "residual": (
                *FUNCTION, lambda u: u, Told(lambda u, args: jnp.ones(3), r"\(3,\)"),
                Told(lambda u, args: "text", "'text'"),
            ),
            "start": VECTOR, "tolerance": POSITIVE, "max_steps": count,
            "weights": ("x", {}, 3.0, [1.0, 1.0], [math.nan]),
        },
    )  # fmt: skip
    good = {"residual": branch, "u": jnp.ones(1), "p": 1.0}
    bad = {"residual": FUNCTION, "u": VECTOR, "p": NUMBER, "tolerance": POSITIVE}
    yield Row("fold_point", continuation.fold_point, good, {**bad, "max_steps": count})
    yield Row("fold_residual", continuation.fold_residual, {}, {"residual": FUNCTION})
    good = {"loss": lambda x: x**2, "start": 1.0, "optimiser": optax.sgd(0.1)}
    yield Row(
        "descend", continuation.descend, good,
        {
            "loss": FUNCTION, "start": TREE, "optimiser": (None, "x", 3, optax.adam),
            "steps": COUNT, "tolerance": NONNEGATIVE,
        },
    )  # fmt: skip
    good = {"residual": root, "solution": jnp.ones(1), "parameters": 1.0}
    bad = {"residual": FUNCTION, "solution": (None, "x", {}, 1.0, [[1.0]], [])}
    yield Row("attach_derivative", continuation.attach_derivative, good, bad)
    good = {"before": lambda x: x < 1, "low": jnp.zeros(()), "high": 1.0, "halvings": 3}
    end = (None, "x", {}, 1j)
    halvings = tuple(value for value in COUNT if value is True or value != 0)
    bad = {"before": FUNCTION, "low": end, "high": end, "halvings": halvings}
    yield Row("bisect", continuation.bisect, good, bad)


def _branches() -> Iterator[Row]:
    yield Row(
        "continue_branch", continuation.continue_branch,
        {"residual": branch, "start": jnp.ones(1), "parameter": 1.0},
        {
            **STEPS, **FOLLOWED, "residual": FUNCTION, "start": VECTOR, "parameter": NUMBER,
            "direction": DIRECTION, "max_points": optional(COUNT), "bounds": (None, *BOUNDS),
            "weights": ("x", {}, 3.0, [1.0], [1.0, math.nan]), "tests": ("x", 3, {"a": 3}),
            "value_and_jacobian": ("x", 3), "tolerance": POSITIVE, "max_turn": POSITIVE,
            "max_bend": POSITIVE, "keep_part": FLAG,
        },
    )  # fmt: skip
    good = {"residual": branch, "point": None}
    yield Row("switch_branch", continuation.switch_branch, good, {"point": (None, "x", 3)})


def _cycles() -> Iterator[Row]:
    yield Row(
        "find_limit_cycle", cycles.find_limit_cycle, {"model": CHAIN},
        {
            "model": A_CHAIN, "guess": optional(states(3)), "mass": VIBRATING,
            "branch": WORD, "images": IMAGES, "rtol": (*POSITIVE, 2.0), "tolerance": POSITIVE,
            "max_steps": optional(COUNT), "throw": FLAG, "period": (6.0, "x"),
        },
    )  # fmt: skip
    given = {"model": CHAIN, "guess": STATE, "period": 6.0}
    yield Row("find_limit_cycle, guess", cycles.find_limit_cycle, given,
              {"period": optional(POSITIVE)})  # fmt: skip
    many = tuple(jnp.stack([jnp.asarray(part)] * 2) for part in STATE)
    yield Row(
        "find_limit_cycles", cycles.find_limit_cycles,
        {"model": CHAIN, "guesses": (many, jnp.full(2, 6.0))},
        {
            "model": (*A_CHAIN, NO_DRY), "known": (None, 1.0, [STATE]), "mass": VIBRATING,
            "guesses": (None, "x", {}, object, 0, (STATE, 6.0), (many, jnp.full(3, 6.0))),
            "rounds": COUNT, "lanes": COUNT, "key": (None, "x", -1, 1.5), "rtol": (*POSITIVE, 2.0),
            "tolerance": POSITIVE, "max_steps": optional(COUNT), "progress": FLAG,
        },
    )  # fmt: skip
    orbit = {"model": CHAIN, "state": STATE, "period": 6.0}
    of_orbit = {
        "model": (*A_CHAIN, NO_DRY), "state": states(3), "period": POSITIVE,
        "rtol": (*POSITIVE, 2.0),
    }  # fmt: skip
    yield Row(
        "continue_cycle", cycles.continue_cycle, orbit,
        {
            **STEPS, **FOLLOWED, **of_orbit, "model": A_CHAIN, "parameter": WORD,
            "direction": tuple(value for value in DIRECTION), "bounds": BOUNDS,
            "mass": VIBRATING, "images": IMAGES, "max_points": optional(COUNT),
            "tolerance": POSITIVE, "keep_part": FLAG, "events": ("x", 3, {"a": 3}),
        },
    )  # fmt: skip
    yield Row(
        "continue_cycle, dry", cycles.continue_cycle, {**orbit, "model": DRY},
        {
            **STEPS, "parameter": WORD, "direction": (*DIRECTION, "slip"), "bounds": BOUNDS,
            "max_points": optional(COUNT), "tolerance": POSITIVE, "keep_part": FLAG,
        },
    )  # fmt: skip
    yield Row("continue_cycle, cycle", cycles.continue_cycle, {}, {"model": (*A_CHAIN, CHAIN)})
    yield Row(
        "cycle_symmetry",
        cycles.cycle_symmetry,
        orbit,
        {"model": A_CHAIN, "state": states(3), "period": POSITIVE, "tolerance": POSITIVE},
    )
    wrong = {"branch": None, "point": None}
    yield Row("switch_cycle", cycles.switch_cycle, wrong, {"branch": (None, "x", 3)})
    yield Row("liouville_determinant", cycles.liouville_determinant, orbit, of_orbit)
    both = of_orbit | {"model": A_CHAIN}  # dry or smoothed
    yield Row("monodromy_matrix", cycles.monodromy_matrix, orbit, both)
    matrix = (None, "x", {}, 3.0, jnp.ones(2), jnp.ones((2, 3)))
    yield Row(
        "floquet_multipliers", cycles.floquet_multipliers,
        {"monodromy": jnp.eye(2), "flow_direction": jnp.ones(2)},
        {
            "monodromy": matrix,
            "flow_direction": (
                None, "x", {}, 3.0, Told([1.0, 2.0, 3.0], r"\(3,\)"), Told((1.0,), r"\(1,\)"),
                jnp.zeros(2),
            ),
        },
    )  # fmt: skip
    good = {"monodromy": jnp.eye(2), "trace": 0.0}
    bad = {"monodromy": matrix, "trace": (None, "x", {}, [1.0, 2.0], 1j)}
    yield Row("liouville_defect", cycles.liouville_defect, good, bad)
    yield Row(
        "guess_from_simulation", cycles.guess_from_simulation, {"model": CHAIN, "state": STATE},
        {
            "model": A_CHAIN, "state": states(3), "mass": VIBRATING,
            "transient": NONNEGATIVE, "duration": POSITIVE,
        },
    )  # fmt: skip
