"""Arguments that are refused together, or on the way: words of the message, and the call."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import Chain, EventDriven, excited_state, paper_chain, simulate, sweep
from jaxchain.model import ExponentialDecay, TanhFriction
from jaxchain.model.parameters import CHAIN
from jaxchain.scenes import load_scene

Case = tuple[str, Callable[[], object]]
# Every number of a scene, in the built-in one that is tried.
SCENE = "quickstart"
SCENE_NUMBERS = (
    *(f"chain.{name}" for name in CHAIN), "chain.friction.width", "chain.friction.mu_static",
    "chain.friction.mu_dynamic", "chain.friction.v_ref", "time.transient", "time.window",
    "observe.tolerance", "observe.quiet_below", "observe.repeats", "numerics.rtol",
    "numerics.atol", "numerics.max_step", "numerics.max_steps", "numerics.lanes", "chain.n",
)  # fmt: skip


def small() -> tuple[Chain, Any]:
    return paper_chain(3, 1.2, 1e-2), (jnp.full(3, 2.0), jnp.zeros(3))


def values() -> Iterator[Case]:
    """Known before anything runs."""
    chain, start = small()
    run = partial(simulate, chain, start)
    for name in CHAIN:
        entries: dict[str, Any] = {"belt_speed": 1.0, name: [1.0, math.nan, 1.0]}
        yield r"index \(1,\)", partial(Chain, n=3, friction=chain.friction, **entries)
    coarse, state = paper_chain(1, 1.2, 1e-6), (jnp.full(1, 3.0), jnp.zeros(1))
    loose = "too loose for a regularization width"
    yield loose, partial(simulate, coarse, state, 50.0, rtol=1e-6)
    yield loose, partial(sweep, coarse, state, 50.0, over={"width": [1e-2, 1e-7]}, rtol=1e-6)
    yield loose, partial(run, 50.0, atol=1e3)
    yield "backward", partial(run, -1.0)
    yield "backward", partial(run, 1.0, t0=2)
    yield "below 1", partial(run, 1.0, rtol=1.0)
    yield "mu_static", partial(chain.with_, mu_static=0.4)
    over = {"mu_static": [0.6, 1], "mu_dynamic": [0.5, 0.8]}
    yield "mu_static", partial(sweep, chain, start, 1.0, over=over)
    for name in (*CHAIN, *chain.friction.parameters()):
        yield "finite", partial(sweep, chain, start, 1.0, over={name: [1.0, math.inf]})
    yield "excited", partial(excited_state, chain, np.int64(4))
    yield "excited", partial(sweep, chain, excited_state, 1.0, over={"excited": [1, 4]})
    longer = jnp.ones(4), jnp.ones(4)
    yield "shape", partial(sweep, chain, longer, 1.0, over={"belt_speed": [1.0]})
    two = TanhFriction(ExponentialDecay(jnp.ones(2), 0.5, 0.5), 1e-3)
    yield "mu_static|friction", partial(Chain, 3, two, 1.0)

    def made_in_32_bits() -> object:
        with jax.enable_x64(False):
            own = small()[0]
        return simulate(own, start, 1.0)

    yield "64-bit floats", made_in_32_bits
    for key, value in itertools.product(SCENE_NUMBERS, ("nan", "inf", "-inf", "1e400")):
        setting = f"experiment.ladder.{key}={value}"
        words = "finite|whole number|valid integer|at least|Out of"
        yield words, partial(load_scene, SCENE, [setting])


def runs() -> Iterator[Case]:
    """Found out on the way: by an error of the run."""
    chain, start = small()
    one, state = paper_chain(1, 1.2, 1e-2), (jnp.full(1, 3.0), jnp.zeros(1))
    narrow = paper_chain(1, 1.2, 1e-14)
    yield "step_too_small", partial(simulate, narrow, state, 50.0, rtol=1e-15)
    for solver in (None, EventDriven()):
        yield (
            "max_steps_reached",
            partial(simulate, chain, start, 50.0, max_steps=20, solver=solver),
        )
        for ratio, end in [(-0.5, 1e4), (-10.0, 1e3), (-1e6, 5.0)]:
            run = partial(simulate, one.with_(damping_ratio=ratio), state, end, solver=solver)
            yield "step_too_small|nonfinite", partial(run, max_steps=2_000_000)
    huge = jnp.full(3, 1e200), jnp.zeros(3)
    yield "nonfinite|finite", partial(simulate, chain, huge, 1.0)

    def in_32_bits() -> object:
        with jax.enable_x64(False):
            return simulate(*small(), 1.0)

    yield "64-bit floats", in_32_bits
