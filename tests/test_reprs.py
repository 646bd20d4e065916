"""The `repr` of results."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import SearchResult, paper_chain
from jaxchain.boundaries import find_fold
from jaxchain.result import Outcome, Printed


class Found(Outcome):
    speed: jax.Array
    speed_error: jax.Array
    path: jax.Array
    result: SearchResult
    missing: float = np.nan
    may_be_missing = ("missing",)


FOUND = Found(
    speed=jnp.asarray(1.8366123456), speed_error=jnp.asarray(3e-9), path=jnp.arange(9.0),
    result=SearchResult.successful,
)  # fmt: skip


def test_a_result_prints_numbers_with_their_errors_and_arrays_as_their_range():
    lines = repr(FOUND).splitlines()
    assert lines == [
        "Found: successful",
        "  speed: 1.836612346 ± 3e-09",
        "  path: 0 ... 8, shape (9,)",
    ]


def test_a_search_that_failed_prints_its_reason():
    failed = eqx.tree_at(lambda f: f.result, FOUND, SearchResult.no_cycle)
    assert repr(failed).splitlines()[:2] == [
        "Found: no_cycle",
        "  No fold was found, although averaging predicts one: the search for a ...",
    ]


def test_batches_traced_values_and_shapes_print_in_a_few_lines():
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), FOUND)
    assert repr(batch).startswith("Found: successful 3\n  speed: [1.836612346, ")
    seen = []
    shapes = jax.eval_shape(lambda found: seen.append(repr(found)) or found, FOUND)
    assert "speed: float64[]" in seen[0]
    assert "speed: float64[]" in repr(shapes)
    assert "Found" in repr(eqx.filter(FOUND, lambda _: False))


def test_a_real_result_prints_in_at_most_ten_short_lines():
    lines = repr(find_fold(paper_chain(1, 1.5, 1e-2))).splitlines()
    assert len(lines) <= 10
    assert max(map(len, lines)) < 80


def test_every_result_prints_alike():
    """A dataclass would bring a `__repr__` of its own."""
    import jaxchain

    for module in jaxchain.SUBMODULES:
        for name in getattr(getattr(jaxchain, module), "__all__", ()):
            cls = getattr(getattr(jaxchain, module), name)
            if isinstance(cls, type) and issubclass(cls, Printed):
                assert cls.__repr__ is Printed.__repr__
