"""The `repr` of models and results, and how notebooks show them."""

import re
from typing import Any
from xml.etree import ElementTree

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from drawn import made_up_modes
from synthetic import cycle_branch

from jaxchain import (
    Chain,
    ExponentialDecay,
    Scales,
    SearchResult,
    TanhFriction,
    Trajectory,
    paper_chain,
)
from jaxchain._printing import Sketch, svg
from jaxchain.boundaries import StabilityRange
from jaxchain.cycles.limit_cycle import LimitCycle
from jaxchain.inverse import Profile
from jaxchain.model import DimensionalParameters, MechanicalCells, VanDerPol
from jaxchain.result import Outcome, Result
from jaxchain.simulation.dataset import Origin
from jaxchain.simulation.run import Simulation


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
    chain = paper_chain(20).with_(stiffness=np.linspace(0.9, 1.1, 20))
    assert "stiffness=<0.9 ... 1.1, shape (20,)>" in repr(chain).replace("\n ", "")
    assert "belt_speed=f64[]" in repr(jax.eval_shape(lambda chain: chain, chain))


CLASSES = {
    cls.__name__: cls
    for cls in (
        Chain, DimensionalParameters, ExponentialDecay, MechanicalCells, Scales,
        TanhFriction, VanDerPol,
    )
}  # fmt: skip


def test_models_print_as_the_call_that_makes_them_with_the_values_of_their_numbers():
    law = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.25)
    assert repr(law) == "ExponentialDecay(mu_static=1, mu_dynamic=0.5, v_ref=0.25)"
    assert repr(Chain(1, law, 1.5)) == (
        "Chain(n=1, friction=ExponentialDecay(mu_static=1, mu_dynamic=0.5, v_ref=0.25),\n"
        "  belt_speed=1.5, damping_ratio=0.05, stiffness=1, ends='cyclic')"
    )
    scales = Scales.from_dimensional(2.0, 2.0, 200.0, 2.0, 10.0)
    rows = [[1.0, 0.3], [0.3, 2.0]]
    for model in (
        Chain(3, TanhFriction(law, 1e-3), -1.5, 0.1, 0.01, 1.1, 2.0, "free"),
        MechanicalCells(rows, damping=0.1, friction=law, belt_speed=0.5, names=("a", "b")),
        VanDerPol([1.0, 2.0], coupling=0.1, ends="free"),
        scales,
        scales.parameters(),
    ):
        again = eval(repr(model), CLASSES)
        assert jax.tree.structure(again) == jax.tree.structure(model)
        assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(model)))
        assert max(map(len, repr(model).splitlines())) < 80


def test_without_a_boundary_its_reason_is_printed_and_not_a_zero():
    def printed(*numbers):
        names = ("hopf", "fold", "highest", "width")
        values = dict(zip(names, map(jnp.asarray, numbers), strict=True))
        return repr(StabilityRange(**values, result=SearchResult.successful, mass=0))

    lines = printed(np.nan, np.nan, 0.0, 0.0).splitlines()
    assert lines[1].startswith("  hopf: none: steady sliding is stable at every belt speed")
    assert lines[2].startswith("  fold: none: damping outweighs the weakening of friction")
    assert lines[3] == "  highest: no vibration survives at any belt speed"
    assert not any("width" in line for line in lines)
    assert "none" not in printed(1.15, 1.83, 1.83, 0.679)


def test_notebooks_show_models_and_results_as_an_escaped_table():
    chain = paper_chain(2, width=None)
    for shown, part in (
        (chain, '<td style="text-align: left">1.5</td>'),
        (chain.friction, ">mu_dynamic</th>"),
        (FOUND, "1.836612346 ± 3e-09"),
        (MechanicalCells(1.0, local_force=lambda q, v: (q[0],)), "&lt;lambda&gt;"),
    ):
        text = shown._repr_html_()
        assert text.startswith("<table>")
        assert part in text
        assert "<lambda>" not in text


def texts_of(picture):
    """The words of an SVG, which must be well-formed."""
    root = ElementTree.fromstring(picture)
    return ["".join(text.itertext()) for text in root.iter() if text.tag.endswith("}text")]


def sketch_of(shown):
    table, mark, picture = shown._repr_html_().partition("<svg")
    assert table.startswith("<table>")
    assert mark
    return texts_of(mark + picture)


def test_models_and_laws_are_drawn_by_their_friction_and_runs_over_time():
    chain = paper_chain(2, belt_speed=1.5, width=None)
    cells = MechanicalCells(1.0, friction=chain.law, belt_speed=lambda t: t)
    for shown in (chain, chain.with_(width=1e-2), chain.law, cells):
        assert "friction per load" in sketch_of(shown)
    assert "steady sliding" in sketch_of(chain)
    assert "steady sliding" not in sketch_of(cells)
    # The jump: a vertical stroke between the static limits, at the place of w = 0.
    sketch = chain.law._sketch()
    ((w, force),) = sketch.lines
    np.testing.assert_allclose(force[w == 0, 0], [1.0, -1.0])
    np.testing.assert_allclose(force[w > 0, 0], -chain.law.coefficient(w[w > 0]))
    path, count = (jnp.arange(12.0).reshape(6, 2), jnp.zeros((6, 2))), jnp.asarray(7)
    origin = Origin(chain, (Trajectory(np.arange(6.0)),), jax.tree.structure(0), t1=5.0)
    run = Simulation(
        t=jnp.asarray(5.0), state=(jnp.ones(2), jnp.zeros(2)), observed=path, steps=count,
        rejected=count, result=Result.successful, origin=origin,
    )  # fmt: skip
    assert "time" in sketch_of(run)
    sketch: Any = run._sketch()
    ((_, displacements),) = sketch.lines
    np.testing.assert_array_equal(displacements, path[0])


def test_cycles_branches_and_curves_are_drawn():
    one, nothing = jnp.ones(1), jnp.zeros(())
    cycle = LimitCycle(
        chain=paper_chain(1), state=(one, one), period=jnp.asarray(6.3), residual=nothing,
        result=SearchResult.successful, multipliers=jnp.array([0.5 + 0.1j]),
        trivial_defect=nothing, liouville_defect=nothing, amplitude=one, fastest=one,
        evaluations=jnp.asarray(1), mass=0,
    )  # fmt: skip
    followed = cycle_branch(1)
    assert "Re of multipliers" in sketch_of(cycle)
    assert {"belt_speed", "greatest amplitude", "fold", "hopf"} <= {*sketch_of(followed)}
    # Cycles between the fold and the Hopf point are unstable.
    assert followed._repr_html_().count("stroke-dasharray") == 1
    assert "special: fold at 1.85, hopf at 1.15" in repr(followed)
    ((_, equations),) = followed.pieces
    assert {"p", "u[0]"} <= {*sketch_of(equations)}
    assert {"belt_speed", "growth rate"} <= {*sketch_of(made_up_modes(1.0, 1.5))}
    of_one = map(jnp.asarray, ([0.0, 1.0, 2.0], [4.0, 1.0, jnp.nan], 1.0, 0.5, -jnp.inf, 0.95))
    text = Profile(*of_one)._repr_html_()
    assert "χ²" in text
    assert text.count("<circle") == 1  # the interval ends on one side
    assert "nan" not in text.partition("<svg")[2]


def test_a_sketch_leaves_out_what_is_not_finite_and_escapes_words():
    x = np.arange(4.0)
    drawn = svg(Sketch("a < b", "y", [(x, [1.0, np.nan, 3.0, 4.0])], [(np.inf, 1.0, "far")]))
    assert "a < b" in texts_of(drawn)
    assert "far" not in texts_of(drawn)
    (path,) = re.findall(r' d="([^"]*)"', drawn)
    assert re.sub("[^ML]", "", path) == "MML"
    assert svg(Sketch("x", "y", [(x, np.full(4, np.nan))])) == ""
