"""What `repr` says of every public class, made up from the types of its fields."""

import collections.abc
import dataclasses
import importlib
import inspect
import types
import typing
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Result, SearchResult, TanhFriction, paper_chain
from jaxchain._reprs import half, number, several, span, summary
from jaxchain.boundaries import BistableRange, Boundaries, FoldBoundary
from jaxchain.chaos import Evidence
from jaxchain.continuation import Branch, SpecialPoint
from jaxchain.cycles import CycleBranch
from jaxchain.inverse import Identification
from jaxchain.localization import Depinning
from jaxchain.model import AbstractFrictionLaw, AbstractOscillators, Chain
from jaxchain.model.friction import AbstractFriction
from jaxchain.solvers import AbstractStructuredRosenbrock, Rodas4

ROOMS = (
    "basins", "boundaries", "chaos", "continuation", "cycles", "inverse", "localization", "model",
    "observers", "simulation",
)  # fmt: skip
LONG = 400  # numbers along each axis of what is made up
CHAIN = paper_chain(LONG)
GIVEN: dict[Any, Any] = {
    AbstractOscillators: CHAIN, Chain: CHAIN, AbstractFriction: CHAIN.friction,
    AbstractFrictionLaw: CHAIN.law, AbstractStructuredRosenbrock: Rodas4(),
    dfx.AbstractSolver: Rodas4(), jax.Array: jnp.asarray(1.5), int: 3, float: 1.5, bool: True,
    str: "closed",
}  # fmt: skip


def public_classes():
    for room in ROOMS:
        module = importlib.import_module(f"jaxchain.{room}")
        for name in module.__all__:
            known = getattr(module, name)
            if inspect.isclass(known) and not inspect.isabstract(known):
                yield known


def array(hint):
    """An array as a jaxtyping annotation says."""
    shape = tuple(int(dim) if dim.isdigit() else LONG for dim in hint.dim_str.split())
    kind = {"Float": float, "Int": int, "Complex": complex, "Bool": bool}[
        hint.__name__.split("[")[0]
    ]
    values = np.linspace(1.0, 2.0, int(np.prod(shape))).astype(kind).reshape(shape)
    return values if hint.array_type is np.ndarray else jnp.asarray(values)


def made_up(hint: Any, ending: str) -> Any:
    """Some value of a type."""
    if hasattr(hint, "dim_str"):
        return array(hint)
    if hint in (Result, SearchResult):
        names = {"failed": "nonfinite", "successful": "successful"}
        return getattr(hint, names[ending])
    if hint is np.ndarray:
        return np.linspace(0.0, 1.0, LONG)
    if hint in GIVEN:
        return GIVEN[hint]
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        arrays = [one for one in inner if hasattr(one, "dim_str")]
        return made_up(inner[0] if inner[0] is float or not arrays else arrays[-1], ending)
    if origin is tuple:
        count = 3 if inner[0] is int else LONG
        several = [inner[0]] * count if inner[-1] is Ellipsis else inner
        return tuple(made_up(one, ending) for one in several)
    if origin is collections.abc.Callable:
        return jnp.cos
    if origin is typing.Literal:
        return inner[0]
    if inspect.isclass(hint) and (hasattr(hint, "_fields") or dataclasses.is_dataclass(hint)):
        return instance(hint, ending)
    return {"mu": jnp.asarray(0.5), "path": jnp.linspace(0.0, 1.0, LONG)}  # a pytree, or anything


def instance(cls: Any, ending: str) -> Any:
    hints = typing.get_type_hints(cls)
    if hasattr(cls, "_fields"):
        return cls(**{name: made_up(hints[name], ending) for name in cls._fields})
    made = object.__new__(cls)
    for field in dataclasses.fields(cls):
        object.__setattr__(made, field.name, made_up(hints[field.name], ending))
    return made


def short(text):
    lines = text.splitlines()
    return len(text) <= 800 and len(lines) <= 10


def ways_to_end(cls):
    ends = any(hint in (Result, SearchResult) for hint in typing.get_type_hints(cls).values())
    return ("successful", "failed") if ends else ("successful",)


CASES = [(cls, ending) for cls in public_classes() for ending in ways_to_end(cls)]


@pytest.mark.parametrize(("cls", "ending"), CASES)
def test_every_public_class_is_told_in_a_few_lines(cls, ending):
    """As it is, as one of a batch, without its arrays, and while it is traced."""
    made = instance(cls, ending)
    text = repr(made)
    assert short(text), text
    assert text.startswith(cls.__name__)
    assert "f64[" not in text
    arrays, static = eqx.partition(made, eqx.is_array)
    several = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), arrays)
    assert short(repr(eqx.combine(several, static)))
    assert short(repr(static))
    seen = []
    jax.eval_shape(lambda own: seen.append(repr(eqx.combine(own, static))), arrays)
    assert short(seen[0]), seen[0]
    if jax.tree.leaves(arrays):
        shapes = jax.eval_shape(lambda own: own, arrays)
        assert short(repr(eqx.combine(shapes, static)))


def test_a_number_has_as_many_digits_as_its_bar_warrants():
    told = {
        number(1.8366123456, 3e-9): "1.836612346 ± 3e-09",
        number(1.15, 0.01): "1.15 ± 0.01",
        number(12345.678, 30.0): "12346 ± 3e+01",
        number(1.23456e-9, 1e-12): "1.235e-09 ± 1e-12",
        number(-3.0, 0.0): "-3 ± 0",
        number(1.5, np.nan): "1.5 ± nan",
        number(np.nan, 1e-3): "nan",
        number(2.0): "2",
        number(True): "True",
        number(1 - 2j): "1-2j",
    }
    assert [*told] == [*told.values()]


def test_an_array_is_its_shape_and_its_range():
    values = np.array([[1.0, np.nan, 3.0], [2.0, 2.0, 2.0]])
    assert number(values) == "(2, 3) from 1 to 3, 1 nan"
    assert number(values, np.full((2, 3), 1e-4)) == "(2, 3) from 1 to 3, 1 nan, ± 0.0001 at most"
    assert number(jnp.arange(3)) == "[0, 1, 2]"
    assert number(np.ones(7)) == "(7,) all 1"
    assert number(np.full(7, np.nan)) == "(7,) nan"
    assert number(np.zeros(0)) == "(0,) none"
    assert number(np.arange(9) > 6) == "(9,) 2 true"
    assert number(1j * np.arange(9)) == "(9,) of modulus from 0 to 8"
    assert span(np.array([2.0, np.nan, 1.0])) == "1 ... 2"
    assert several(np.array([1.0, 2.0]), half(np.zeros(2), np.ones(2))) == "1.0 ± 0.5, 2.0 ± 0.5"


def test_keys_and_arrays_that_are_deleted_are_their_shapes():
    gone = jnp.ones(3)
    gone.delete()
    assert number(gone) == "f64[3]"
    assert "key" in number(jax.random.key(0))


def test_a_summary_is_cut_where_it_grows_too_long():
    text = summary("Long", {f"row {k}": "word " * 100 for k in range(30)} | {"missing": None})
    assert short(text)
    assert text.endswith("...")
    assert summary("Short", {"one": 1.0, "two": (2.0, 0.1), "three": "3"}) == (
        "Short\n  one: 1\n  two: 2.0 ± 0.1\n  three: 3"
    )


def test_results_say_how_they_ended():
    assert repr(Result.successful) == "jaxchain.result.Result<successful>"
    assert repr(SearchResult.no_fold).startswith(
        "jaxchain.result.SearchResult<no_fold: There is no fold: damping outweighs"
    )
    many = jax.vmap(lambda k: Result.where(k > 1, Result.quiet, Result.successful))(
        jnp.arange(999)
    )
    assert repr(many) == "jaxchain.result.Result<successful 2, quiet 997>"


def test_what_was_found_is_told_with_its_bars():
    found = [jnp.asarray(x) for x in (1.1513, 1.15129, 1e-6, 1.83, 1.8366009, 2e-7, 1.836, 1e-3)]
    lines = repr(Boundaries(*found, mass=0)).splitlines()
    assert lines[0] == "Boundaries, belt speeds"
    assert "  fold, dry friction: 1.8366009 ± 2e-07" in lines
    assert "  fold, extrapolated to width 0: 1.836 ± 0.001" in lines
    ends = jnp.asarray(1.0), jnp.asarray(1.25)
    assert repr(Depinning(*ends)).splitlines()[1] == "  belt speed: 1.1 ± 0.1"
    text = repr(FoldBoundary(*found[:4]))
    assert "extrapolated to width 0: 1.151290 ± 1e-06" in text


def test_what_was_not_found_is_left_out_and_the_reason_told():
    nan, why = jnp.asarray(jnp.nan), SearchResult.no_cycle
    text = repr(BistableRange(hopf=jnp.asarray(1.2), fold=nan, highest=nan, width=nan, result=why))
    assert text.splitlines()[0] == "BistableRange: not found"
    assert "no_cycle: No fold was found, though averaging has one" in text
    assert "Hopf speed: 1.2" in text
    assert "nan" not in text


def test_parameters_stand_on_lines_of_their_own():
    fit = instance(Identification, "successful")
    own = {"mu_static": jnp.asarray(1.01), "law": [jnp.asarray(0.5)]}
    bars = {"mu_static": jnp.asarray(0.02), "law": [jnp.asarray(0.1)]}
    fit = eqx.tree_at(lambda f: (f.theta, f.standard_errors), fit, (own, bars))
    lines = repr(fit).splitlines()
    assert lines[:3] == ["Identification: found", "  law.0: 0.5 ± 0.1", "  mu_static: 1.01 ± 0.02"]


def test_a_branch_tells_its_special_points_and_its_stability():
    raw = instance(SpecialPoint, "successful")
    points = [dataclasses.replace(raw, kind="fold", p=p, error=1e-3) for p in (1.8366, 1.162)]
    branch = dataclasses.replace(instance(Branch, "successful"), special=tuple(points))
    text = repr(branch)
    assert text.startswith(f"Branch: {LONG} points\n  p: 1 ... 2\n")
    assert "  fold: 2, at 1.837 ± 0.001, 1.162 ± 0.001" in text
    assert "  ended: closed: The branch came back to its first point" in text
    cycles = instance(CycleBranch, "successful")
    cycles = dataclasses.replace(cycles, multipliers=np.full((LONG, 3), 0.5 + 0j), special=())
    assert f"stable: {LONG}, unstable: 0" in repr(cycles)


def test_evidence_leaves_out_what_is_not_known():
    lines = repr(Evidence(noise=0.0, seed=3)).splitlines()
    assert lines == ["Evidence: open", "  noise: 0, seed 3", "  time: 0", "  active: 0 of 0"]


def test_a_chain_is_told_as_the_call_that_makes_it():
    chain = paper_chain(3, belt_speed=1.25, width=None)
    assert repr(chain) == (
        "Chain(n=3, friction=ExponentialDecay(mu_static=1, mu_dynamic=0.5, v_ref=0.5), "
        "belt_speed=1.25, damping_ratio=0.05, coupling=0.01, stiffness=1, ends='cyclic')"
    )
    assert repr(TanhFriction(chain.law, 1e-3)).endswith("width=0.001)")
