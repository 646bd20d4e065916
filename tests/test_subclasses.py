"""Overrides of a subclass are used, or refused when it is defined."""
# pyright: reportArgumentType=false, reportCallIssue=false, reportIncompatibleMethodOverride=false

import importlib
import inspect
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.oscillators import Rayleigh, VanDerPol

import jaxchain as jc
from jaxchain.basins import AbstractClassifier, AbstractRegion, basin_shares
from jaxchain.boundaries import find_equilibrium
from jaxchain.model import (
    AbstractCells,
    AbstractFrictionLaw,
    AbstractModel,
    AbstractOscillators,
    MechanicalCells,
)
from jaxchain.observers import AbstractObserver, Divergence, Variable
from jaxchain.simulation.method import fit_linear_solve
from jaxchain.solvers import AbstractStructuredRosenbrock
from jaxchain.solvers.rosenbrock import RODAS4, RODAS5P

MODULES = (jc, *(importlib.import_module(f"jaxchain.{submodule}") for submodule in jc.SUBMODULES))
PUBLIC = {getattr(module, name) for module in MODULES for name in getattr(module, "__all__", ())}
# Only raised, and caught by their kind: nothing calls a method of theirs.
CLASSES = sorted(
    (c for c in PUBLIC if inspect.isclass(c) and not issubclass(c, BaseException)),
    key=lambda c: c.__name__,
)
OPEN = [c for c in CLASSES if c.__name__.startswith("Abstract") and c is not AbstractModel]
HONOURED: dict[type, set[str]] = {}


def names_of(cls):
    """What stands in a class, by this package and by diffrax, and does not begin with _."""
    bases = [c for c in cls.__mro__ if c.__module__.split(".")[0] in ("jaxchain", "diffrax")]
    names = {name for c in bases for name in (*vars(c), *vars(c).get("__annotations__", {}))}
    return {name for name in names if not name.startswith("_")} - {"model_config"}


def define(cls, **names):
    return type(cls)("Mine", (cls,), {"__module__": __name__, "__qualname__": "Mine", **names})


def honours(cls, *names):
    """Marks a test that sees the overrides of these names, in all that takes such a class."""
    HONOURED.setdefault(cls, set()).update(names)
    return lambda test: test


@pytest.mark.parametrize("cls", [jc.Chain, MechanicalCells, jc.TanhFriction])
def test_a_concrete_class_is_final(cls):
    for name in names_of(cls) or {"anything"}:
        with pytest.raises(TypeError, match=rf"`Mine` cannot be a subclass of `{cls.__name__}`"):
            define(cls, **{name: lambda self: 1.0})


@pytest.mark.parametrize("cls", OPEN)
def test_a_method_of_an_abstract_class_is_honoured_or_final(cls):
    honoured = set().union(*(HONOURED.get(c, set()) for c in cls.__mro__))
    assert honoured & names_of(cls)
    for name in names_of(cls) - honoured:
        with pytest.raises(TypeError, match=rf"Class `Mine` defines `{name}`, which some"):
            define(cls, **{name: lambda self: 1.0})
    # A subclass of a class of the user's is no other.
    for name in names_of(cls) - honoured:
        with pytest.raises(TypeError, match=f"defines `{name}`"):
            define(define(cls), **{name: lambda self: 1.0})


@pytest.mark.parametrize(
    ("cls", "instead"),
    [
        (jc.Chain, "`jaxchain.model.AbstractOscillators` for other forces, or"),
        (jc.TanhFriction, "subclass `jaxchain.model.AbstractFrictionLaw`"),
    ],
)
def test_the_error_names_the_class_to_subclass_instead(cls, instead):
    with pytest.raises(TypeError, match=instead):
        define(cls)


class Hyperbolic(AbstractFrictionLaw):
    top: float
    v_ref: float

    @property
    def mu_static(self):
        return self.top

    def coefficient(self, speed: Any) -> Any:
        return self.top / (1.0 + speed / self.v_ref)


class Changed(Hyperbolic):
    """Exponential decay from 0.9 `top`, and constant beyond the speed 6."""

    @property
    def mu_static(self):
        return 0.9 * self.top

    @property
    def knots(self):
        return jnp.array([6.0])

    def coefficient(self, speed: Any) -> Any:
        drop = jnp.exp(-jnp.minimum(speed, 6.0) / self.v_ref)
        return 0.5 * self.mu_static * (1.0 + drop)


def twins(width):
    """The changed law in a chain, and the shipped one, which it is below the speed 6."""
    for law in (Changed(1.0, 0.5), jc.ExponentialDecay(0.9, 0.45, 0.5)):
        yield jc.Chain(1, law, belt_speed=1.2).with_(width=width)


def same(of, width=None):
    changed, shipped = (of(chain) for chain in twins(width))
    assert np.all(np.isfinite(shipped))
    np.testing.assert_allclose(changed, shipped, rtol=1e-7, atol=1e-9)


def swept(chain):
    return jc.sweep(chain, jc.equation_8, 20.0, over={"excited": [1]}).amplitude.values


@pytest.mark.long
@honours(AbstractFrictionLaw, "mu_static", "coefficient", "knots")
@pytest.mark.parametrize("width", [None, 1e-2])
def test_a_law_is_honoured_in_runs_and_sweeps(width):
    same(lambda chain: jc.simulate(chain, jc.equation_8(chain, 1), 20.0).state[0], width=width)
    same(swept, width=width)


@pytest.mark.exhaustive
def test_a_law_is_honoured_in_folds_cycles_and_branches():
    same(jc.hopf_belt_speed)
    for width in (None, 1e-2):
        same(jc.fold_belt_speed, width=width)
        same(lambda chain: jc.find_limit_cycle(chain).period, width=width)
    same(lambda chain: jc.continue_cycle(jc.find_limit_cycle(chain)).special[0].parameter,
         width=1e-2)  # fmt: skip


@pytest.mark.long
@honours(AbstractOscillators, "springs", "local_force", "stiffness_diagonal")
def test_forces_are_honoured_in_runs():
    class Other(VanDerPol):
        def local_force(self, t, x, v):
            return Rayleigh.local_force(self, t, x, v)

        def stiffness_diagonal(self, n):
            return 4.0

    start = jnp.array([0.5]), jnp.zeros(1)
    strength = jnp.asarray(0.3)
    own = jc.simulate(Other(strength, None), start, 5.0, rtol=1e-9).state
    y = jc.simulate(Plain(strength), start, 5.0, rtol=1e-9).state
    np.testing.assert_allclose(own, y, rtol=1e-6)


class Plain(AbstractOscillators):
    """The same, from nothing."""

    strength: jax.Array
    springs: None = None

    def local_force(self, t, x, v):
        return self.strength * (1.0 - v**2 / 3.0) * v

    def stiffness_diagonal(self, n):
        return 4.0


@pytest.mark.long
def test_forces_are_honoured_in_cycles_and_branches():
    class Other(VanDerPol):
        def local_force(self, t, x, v):
            return Rayleigh.local_force(self, t, x, v)

    state = jnp.array([0.0]), jnp.array([2.0])
    own, plain = (
        jc.continue_cycle(
            jc.find_limit_cycle(kind(jnp.asarray(0.3), None), state, period=6.3, mass=0),
            parameter="strength", direction=1, bounds=(0.2, 0.5),
        )
        for kind in (Other, Rayleigh)
    )  # fmt: skip
    np.testing.assert_allclose(own.amplitude, plain.amplitude, atol=1e-8)


def test_functions_for_a_belt_refuse_other_forces():
    field = Plain(jnp.asarray(0.3))
    for use in (
        jc.hopf_belt_speed, jc.fold_belt_speed, jc.find_fold, swept,
        lambda field: jc.simulate(field, (jnp.ones(1), jnp.ones(1)), 1.0, solver=jc.EventDriven()),
    ):  # fmt: skip
        with pytest.raises((ValueError, TypeError), match=r"\bChain\b"):
            use(field)


class Slow(AbstractOscillators):
    """A free mass that defines only the required methods."""

    springs: None = None

    def local_force(self, t, x, v):
        return 0.0 * v

    def stiffness_diagonal(self, n):
        return 1.0


class TwoWells(AbstractCells):
    n = 3
    components = ("x", "v")

    def rate(self, t, left, own, right):
        x, v = own
        return v, x - x**3 - 0.1 * v

    def equilibrium(self):
        return jnp.full(3, 0.8), jnp.zeros(3)


@honours(AbstractModel, "n", "equilibrium")
def test_the_number_of_cells_and_the_equilibrium_of_a_model_are_used():
    with pytest.raises(ValueError, match="but for 3 masses must be"):
        jc.simulate(TwoWells(), (jnp.ones(2), jnp.ones(2)), 1.0)
    assert find_equilibrium(TwoWells()).state[0] == pytest.approx(1.0)  # not that at 0


class Told(Slow):
    def switching(self, t, v):
        return v - 1.0, jnp.asarray(0.5)

    def stick_speed(self):
        return jnp.asarray(0.5)

    def excess_force(self, t, left, own, right):
        return -own[0]

    def belt_direction(self):
        return -1.0

    def growth_time(self):
        return 0.01

    def divergence(self, t, y):
        return jnp.asarray(7.0)


class Weighted(Slow):
    acceleration: float = 1e9

    def switching(self, t, v):
        return v, jnp.asarray(0.5)

    def release_acceleration(self):
        return self.acceleration


@pytest.mark.long
@honours(
    AbstractOscillators, "switching", "stick_speed", "excess_force", "belt_direction",
    "growth_time", "release_acceleration", "divergence",
)  # fmt: skip
def test_optional_methods_of_a_field_are_used():
    start = jnp.zeros(1), jnp.ones(1)  # x = sin t, v = cos t
    section = jc.Section(0, 1, of="velocity")
    observe = jc.StickTime(), section, Divergence()
    run = jc.simulate(Told(), start, 2 * np.pi, observe=observe, rtol=1e-8)
    stick, (times, *_), rate = run.observed
    # v > 0.5 until t = pi / 3, with x > 0; from 5 pi / 3 on x < 0: not held.
    assert stick[0] == pytest.approx(np.pi / 3, abs=1e-4)
    assert times[0] == pytest.approx(np.pi, abs=1e-4)  # the least velocity
    assert rate == pytest.approx(14.0 * np.pi)
    assert run.steps >= 600
    # It leaves the belt at t = 1 or so: with a greater weight its error asks for more steps.
    heavy = jc.simulate(Weighted(), start, 2 * np.pi, rtol=1e-8)
    assert (
        heavy.steps
        > jc.simulate(Weighted(acceleration=0.0), start, 2 * np.pi, rtol=1e-8).steps + 10
    )
    plain = jc.simulate(Slow(), start, 2 * np.pi, observe=(section, Divergence()), rtol=1e-8)
    assert plain.observed[1] == 0.0
    assert plain.steps < 300
    assert not np.isclose(plain.observed[0][0][0], np.pi, atol=1.0)


class Swing(AbstractOscillators):
    """Driven by a force of period 2."""

    springs: None = None

    def local_force(self, t, x, v):
        return jnp.cos(jnp.pi * t) - 0.5 * v

    def stiffness_diagonal(self, n):
        return 1.0

    def forcing_period(self):
        return 2.0


class Mass(AbstractCells):
    """x'' = -x with a weak spring to both neighbours; equal masses do not stretch it."""

    def rate(self, t, left, own, right):
        x, v = own
        return v, -x + 0.1 * (left[0] - 2.0 * x + right[0])


class Driven(Mass):
    def rate(self, t, left, own, right):
        v, force = super().rate(t, left, own, right)
        return v, force + jnp.cos(jnp.pi * t) - 0.5 * v

    def forcing_period(self):
        return 2.0


class Row(Mass):
    ends = "free"
    components = ("x", "speed")


class Hasty(Mass):
    def growth_time(self):
        return 0.01


class Switching(Mass):
    contact = 0

    def switching(self, t, v):
        return v - 0.1, jnp.asarray(1e-4)

    def belt_direction(self):
        return -1.0


class Released(Switching):
    def switching(self, t, v):
        return v - 0.1, jnp.asarray(0.1)

    def release_acceleration(self):
        return 1e9


@honours(
    AbstractCells, "rate", "forcing_period", "ends", "components", "contact", "switching",
    "belt_direction", "growth_time", "release_acceleration",
)  # fmt: skip
@honours(AbstractOscillators, "forcing_period")
def test_what_cells_define_is_honoured():
    start = jnp.zeros(3), jnp.ones(3)  # x = sin t
    fastest = jc.Section(0, 1, of="velocity")

    def run(cells):
        return jc.simulate(cells, start, 6.5, solver=jc.Rodas4(), observe=fastest, rtol=1e-8)

    plain, hasty, switching = map(run, (Mass(), Hasty(), Switching()))
    assert plain.observed[0] == pytest.approx(2.0 * np.pi, abs=1e-6)
    assert switching.observed[0] == pytest.approx(np.pi, abs=1e-6)  # the belt runs backward
    assert hasty.steps >= 650 > 300 > plain.steps
    assert switching.steps > plain.steps
    assert run(Released()).steps > plain.steps + 20  # its error counts more
    data = jc.sweep(
        Row(), start, 6.5, vary=lambda cells, k: cells, over={"k": [0]},
        observe=jc.Amplitude(component=1),
    )  # fmt: skip
    assert data.amplitude_speed.values == pytest.approx(1.0, abs=1e-4)
    ring, row = (np.asarray(cells.jacobian(0.0, start)) for cells in (Mass(), Row()))
    # The last mass pulls the first one in a ring; at a free end there is one spring only.
    assert (ring[3, 2], row[3, 2]) == (0.1, 0.0)
    assert (ring[3, 0], row[3, 0]) == pytest.approx((-1.2, -1.1))
    with pytest.raises(ValueError, match="forced with the period 2"):
        jc.find_limit_cycle(Driven(), start, period=3.0)
    cycle = jc.find_limit_cycle(Swing(), (jnp.zeros(3), jnp.zeros(3)))
    assert (cycle.turns, float(cycle.period)) == (1, 2.0)


class Count(AbstractObserver):
    def init(self, field, t0, t1, y0):
        return jnp.zeros(())

    def update(self, accumulator, step):
        return accumulator + 1.0

    def read(self, accumulator):
        return accumulator

    def label(self, value, chain):
        return {"steps_seen": Variable(value)}


class Other(Count):
    def init(self, field, t0, t1, y0):
        return jnp.asarray(100.0)

    def update(self, accumulator, step):
        return accumulator + 2.0

    def settled(self, accumulator):
        return accumulator >= 110.0

    def rests(self, accumulator):
        return accumulator >= 110.0

    def read(self, accumulator):
        return -accumulator

    def label(self, value, chain):
        return {"mine": Variable(value)}


class Double(Count):
    def update_if(self, counts, accumulator, step):
        return accumulator + jnp.where(counts, 2.0, 0.0)


@pytest.mark.long
@honours(AbstractObserver, "init", "update", "update_if", "settled", "rests", "read", "label")
@pytest.mark.parametrize("width", [None, 1e-2])
def test_an_observer_is_honoured_in_runs_and_sweeps(width):
    chain = jc.paper_chain(1, width=width)
    run = jc.simulate(chain, jc.equation_8(chain, 1), 50.0, observe=Other())
    assert (float(run.observed), int(run.steps), run.outcome) == (-110.0, 5, "quiet")
    data = jc.sweep(chain, jc.equation_8, 50.0, over={"excited": [1]}, observe=Other())
    assert data.mine.values.tolist() == [-110.0]
    assert data.steps.values.tolist() == [5]
    plain = jc.simulate(chain, jc.equation_8(chain, 1), 50.0, observe=Count())
    assert float(plain.observed) == int(plain.steps) > 5
    data = jc.sweep(chain, jc.equation_8, 50.0, over={"excited": [1]}, observe=Double())
    assert data.steps_seen.values == 2 * data.steps.values


class Unsound(Count):
    def finite(self, accumulator):
        return accumulator < 1.0


@honours(AbstractObserver, "finite")
def test_an_observer_decides_whether_its_value_is_finite():
    chain = jc.paper_chain(1, width=None)
    run = jc.simulate(chain, jc.equation_8(chain, 1), 5.0, observe=Unsound(), throw=False)
    assert run.outcome == "nonfinite"


class Late(AbstractObserver):
    """What is so only after the time 60."""

    def init(self, field, t0, t1, y0):
        return y0[0]

    def fits(self, t0, t1):
        return t1 > 60.0

    def update(self, accumulator, step):
        return step.y1[0]

    def read(self, accumulator):
        return accumulator

    def label(self, value, chain):
        return {"late": Variable(value, ("oscillator",))}


@honours(AbstractObserver, "fits")
def test_an_observer_that_does_not_fit_is_refused_in_runs_and_sweeps():
    chain = jc.paper_chain(1, width=None)
    with pytest.raises(ValueError, match="does not fit into the run from t = 0 to 50"):
        jc.simulate(chain, jc.equation_8(chain, 1), 50.0, observe=Late())
    with pytest.raises(ValueError, match="does not fit into the run from t = 0 to 50"):
        jc.sweep(chain, jc.equation_8, 50.0, over={"excited": [1]}, observe=Late())


class Side(AbstractClassifier):
    """Of steady sliding; which it says at once, or at the end."""

    waits: bool = False

    def init(self, field, t0, t1, y0):
        return y0[0]

    def update(self, accumulator, step):
        return step.y1[0] if self.waits else accumulator

    def read(self, accumulator):
        return accumulator

    def label(self, value, chain):
        return {
            "state": Variable((value > 0.6).astype(int), ("oscillator",)),
            "decided": Variable(jnp.asarray(True)), "settling_time": Variable(jnp.zeros(())),
        }  # fmt: skip

    def name(self, code, chain):
        return "right" if code[0] else "left"


class Named(Side):
    def merge(self, codes, chain):
        return codes + 5

    def patient(self):
        return Named(waits=True)

    @property
    def least_time(self):
        return 2.0

    def name(self, code, chain):
        return f"code {code[0]}"

    def numbers(self, code, chain):
        return {"side": int(code[0])}


class Line(AbstractRegion):
    """Displacements to the right of steady sliding."""

    def dimension(self, chain):
        return 1

    def start(self, chain, point):
        return 0.7 + point, jnp.zeros(1)


class LeftAndRight(Line):
    def dimension(self, chain):
        return 2

    def start(self, chain, point):
        return jnp.where(point[1] < 0.5, -1.0, 1.0) + 0.1 * point[:1], jnp.zeros(1)


@pytest.mark.long
@honours(AbstractClassifier, "merge", "patient", "least_time", "name", "numbers")
@honours(AbstractRegion, "dimension", "start")
def test_classifiers_and_regions_are_honoured_by_shares():
    chain = jc.paper_chain(1, belt_speed=2.0, width=None)
    ask = {"t1": 3.0, "half_width": 0.2}
    with pytest.warns(UserWarning, match="in another state at 4 t1"):
        found = basin_shares(chain, LeftAndRight(), classify=Named(), **ask)
    assert sorted(found.state.values.tolist()) == ["code 5", "code 6", "undecided"]
    assert found.side.sel(state="code 6") == 6
    assert found.share.sel(state="code 5") == pytest.approx(0.5, abs=0.1)
    assert found.misclassified > 0.5  # half a period turns all of them round
    plain = basin_shares(chain, Line(), classify=Side(), **ask)
    assert plain.state.values.tolist() == ["right", "undecided"]
    with pytest.raises(ValueError, match="`t1` must be at least 2, the first time"):
        basin_shares(chain, Line(), classify=Named(), t1=1.0)


class Fifth(AbstractStructuredRosenbrock):
    tableau: ClassVar = RODAS5P
    method_order: ClassVar[int] = 5
    sweeps: int | None = eqx.field(static=True, default=None)

    def with_sweeps(self, sweeps):
        return Fifth(sweeps)


class Fourth(Fifth):
    tableau: ClassVar = RODAS4
    method_order: ClassVar[int] = 4
    sweeps: int | None = eqx.field(static=True, default=2)

    def with_sweeps(self, sweeps):
        return Fourth(7)


@pytest.mark.long
@honours(AbstractStructuredRosenbrock, "tableau", "method_order", "sweeps", "with_sweeps")
def test_a_solver_is_honoured():
    chain = jc.paper_chain(3, width=1e-2)
    start = jc.equation_8(chain, 1)
    four, shipped, five = (
        jc.simulate(chain, start, 20.0, solver=solver, rtol=1e-6)
        for solver in (Fourth(), jc.Rodas4(2), Fifth())
    )
    np.testing.assert_array_equal(four.state, shipped.state)
    assert int(four.steps) == int(shipped.steps) != int(five.steps)
    assert fit_linear_solve(Fourth(), chain, 1e-6) == Fourth(7)
    options = {"over": {"excited": [1]}, "solver": Fourth(), "rtol": 1e-6}
    assert jc.sweep(chain, jc.equation_8, 20.0, **options).steps.values == shipped.steps
