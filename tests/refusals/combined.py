"""Arguments that are refused together: words of the message, and the call."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxchain import Chain, excited_state, paper_chain, simulate, sweep
from jaxchain.model import ExponentialDecay, TanhFriction
from jaxchain.model.parameters import CHAIN

Case = tuple[str, Callable[[], object]]


def values() -> Iterator[Case]:
    chain, start = paper_chain(3, 1.2, 1e-2), (jnp.full(3, 2.0), jnp.zeros(3))
    run, swept = partial(simulate, chain, start), partial(sweep, chain, start, 1.0)
    for name in CHAIN:
        entries: dict[str, Any] = {"belt_speed": 1.0, name: [1.0, math.nan, 1.0]}
        yield r"index \(1,\)", partial(Chain, n=3, friction=chain.friction, **entries)
    coarse, state = paper_chain(1, 1.2, 1e-6), (jnp.full(1, 3.0), jnp.zeros(1))
    loose = "too loose for a regularization width"
    yield loose, partial(simulate, coarse, state, 50.0, rtol=1e-6)
    yield loose, partial(sweep, coarse, state, 50.0, over={"width": [1e-2, 1e-7]}, rtol=1e-6)
    yield loose, partial(run, 50.0, atol=1e3)
    yield "backward", partial(run, 1.0, t0=2)
    yield "mu_static", partial(chain.with_, mu_static=0.4)
    yield "mu_static", partial(swept, over={"mu_static": [0.6, 1], "mu_dynamic": [0.5, 0.8]})
    yield "finite", partial(swept, over={"v_ref": [1.0, math.inf]})
    yield "excited", partial(sweep, chain, excited_state, 1.0, over={"excited": [1, 4]})
    longer = jnp.ones(4), jnp.ones(4)
    yield "shape", partial(sweep, chain, longer, 1.0, over={"belt_speed": [1.0]})
    two = TanhFriction(ExponentialDecay(jnp.ones(2), 0.5, 0.5), 1e-3)
    yield "mu_static|friction", partial(Chain, 3, two, 1.0)

    def made_in_32_bits() -> object:
        with jax.enable_x64(False):
            own = paper_chain(3, 1.2, 1e-2)
        return simulate(own, start, 1.0)

    yield "64-bit floats", made_in_32_bits
