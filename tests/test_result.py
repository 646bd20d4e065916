"""How runs end: names, codes and advice belong together."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.continuation.damped_newton import Root
from jaxchain.continuation.gradient_descent import Descent
from jaxchain.result import NAMES, SEARCH_NAMES, Result, SearchResult, code, ended_well, message


def test_names_stand_in_the_order_of_their_codes():
    assert len(NAMES) == len(Result)
    for index, name in enumerate(NAMES):
        assert int(code(getattr(Result, name))) == index
        said = message(name)
        assert bool(said) == (name != "successful")  # every failure has advice
        assert Result[getattr(Result, name)] == (f"{name}: {said}" if said else name)
    # Codes in results that were written earlier.
    assert (NAMES.index("nonfinite"), NAMES.index("interrupted")) == (6, 9)


def test_runs_that_ended_well_are_told_in_every_form():
    well = [name for name in NAMES if ended_well(name)]
    assert well == ["successful", "quiet", "steady"]
    codes = np.arange(len(NAMES))
    assert [NAMES[i] for i in codes[ended_well(codes)]] == well
    assert [name for name in NAMES if ended_well(getattr(Result, name))] == well


def test_a_search_with_a_number_that_is_not_finite_is_not_successful():
    """Of a batch only the search that has it; a failure keeps its reason."""
    good, none = SearchResult.successful, jnp.zeros((), int)

    def root(value, found):
        result = SearchResult.where(found, good, SearchResult.no_fold)
        return Root(value=value, residual=0.0 * value[0], result=result, steps=none).result

    values = jnp.array([[0.0, 1.0], [jnp.inf, 1.0], [jnp.nan, 1.0]])
    found = jnp.array([True, True, False])
    ends = ["successful", "nonfinite", "no_fold"]
    assert [SEARCH_NAMES[k] for k in code(jax.vmap(root)(values, found))] == ends
    path = jnp.array([1.0, jnp.nan])  # it ends before its last entry
    descent = Descent(
        solution=path[0], loss=path[0], steps=none, result=good, path=path, losses=path
    )
    assert bool(descent.successful)
