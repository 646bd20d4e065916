"""Steps by hand: observers see a motion that is known, without a run."""

from typing import Any

import equinox as eqx
import jax
import pytest

from jaxchain.observers import Step


@eqx.filter_jit
def _follow(watch: list, field: Any, motion: Any, edges: Any) -> list:
    """What observers see of motion(t), all numbers of the cells, by steps between the edges."""

    def take(seen: list, ends: Any) -> tuple[list, None]:
        t0, t1 = ends
        part = lambda theta, k: motion(t0 + theta * (t1 - t0))[k]
        step = Step(field, t0, t1, motion(t0), motion(t1), part)
        return [one.update(own, step) for one, own in zip(watch, seen, strict=True)], None

    first = [one.init(field, edges[0], edges[-1], motion(edges[0])) for one in watch]
    last = jax.lax.scan(take, first, (edges[:-1], edges[1:]))[0]
    return [one.read(own) for one, own in zip(watch, last, strict=True)]


@pytest.fixture(scope="session")
def follow() -> Any:
    return _follow
