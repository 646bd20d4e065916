"""What every function says of every model: a mass with two contacts, in closed form and by SciPy.

x'' + c x' + k x = F(x' - v_d), F = -mu(|w|) sign(w) or -mu(|w|) tanh(w / eps),
mu(s) = 0.5 + 0.5 exp(-s / 0.5).  SciPy stops at every event.

Other tests hold chains, cells with one contact and forced cells to the same.  Then what needs a
width says in words what to do with a dry chain, and what a subclass may define.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIncompatibleMethodOverride=false

import functools
import importlib
import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from synthetic import cycle_branch

import jaxchain as jc
from jaxchain.basins import AbstractClassifier, AbstractRegion
from jaxchain.boundaries import continue_equilibrium, find_equilibrium, find_hopf_point
from jaxchain.cycles.floquet import liouville_determinant
from jaxchain.model import (
    AbstractCells,
    AbstractFrictionLaw,
    AbstractModel,
    AbstractOscillators,
    Contact,
    MechanicalCells,
)  # fmt: skip
from jaxchain.model.initial_states import release_state
from jaxchain.observers import AbstractObserver, Variable
from jaxchain.plotting.motions import loop
from jaxchain.solvers import AbstractStructuredRosenbrock

LAW, WIDTH, SPEED, END = jc.ExponentialDecay(1.0, 0.5, 0.5), 1e-2, 1.3, 30.0
# The second contact bears no load.
DRY, SMOOTHED = (
    MechanicalCells(
        1.0, damping=0.1, contacts=[Contact(1.0, law, 1.0, SPEED), Contact(1.0, law, 0.0, -SPEED)]
    )
    for law in (LAW, jc.TanhFriction(LAW, WIDTH))
)
FORCED = MechanicalCells(1.0, damping=0.1, friction=LAW, force=1.5, frequency=0.7)
BELT = "contacts[0].belt_speed"
START = jnp.array([1.9]), jnp.array([0.2])


def mu(s):
    return 0.5 + 0.5 * np.exp(-s / 0.5)


def by_scipy(dry=True, t1=END, stiffness=1.0, damping=0.1, start=(1.9, 0.2), speed=SPEED):
    """(x, v) at t1, and the time for which the mass sticks."""

    def pull(y):
        return -stiffness * y[0] - damping * y[1]

    def rate(t, y, mode):
        w = y[1] - speed
        if mode is None:
            return y[1], pull(y) - mu(abs(w)) * np.tanh(w / WIDTH)
        return (speed, 0.0) if mode == 0 else (y[1], pull(y) - mode * mu(mode * w))

    def lands(t, y, mode):
        return mode * (y[1] - speed)

    def lets_go(t, y, mode):
        return 1.0 - abs(pull(y))

    for event in (lands, lets_go):
        vars(event).update(terminal=True, direction=-1)
    t, y, stuck = 0.0, np.array(start), 0.0
    mode = np.sign(y[1] - speed) if dry else None
    while t < t1:
        events = None if mode is None else lets_go if mode == 0 else lands
        method = "Radau" if mode is None else "DOP853"
        out = solve_ivp(
            rate, (t, t1), y, method, args=(mode,), events=events, rtol=1e-11, atol=1e-12
        )
        stuck += float(mode == 0) * (out.t[-1] - t)
        t, y = out.t[-1], out.y[:, -1].copy()
        if t < t1:
            r, y[1] = pull(y), speed
            mode = np.sign(r) if mode == 0 or abs(r) > 1 else 0
    return y, stuck


@functools.cache
def cycle_of(model):
    start, _ = by_scipy(model.dry, 180.0)
    return jc.find_limit_cycle(model, tuple(jnp.array([part]) for part in start))


@functools.cache
def run_of(dry):
    """The end and what is observed, and its slopes; one program for all numbers of the model."""
    watch = jc.Amplitude(1.0), jc.StickTime()
    # A short series compiles fast.
    how = {"solver": jc.EventDriven(8)} if dry else {}

    @jax.jit
    def run(model):
        def ends(damping):
            own = model.with_(damping=damping)
            done = jc.simulate(own, START, END, rtol=1e-10, observe=watch, **how)
            return jnp.concatenate(done.state), done.observed

        return jax.jvp(ends, (model.damping,), (jnp.ones(()),))

    return run


def simulates(model):
    (end, (_, stuck)), (slope, _) = run_of(model.dry)(model)
    np.testing.assert_allclose(end, by_scipy(model.dry)[0], atol=1e-7)
    # A smoothed mass is released later and slower, by times of the order of its width.
    expected = by_scipy()[1]
    assert float(stuck[0]) == pytest.approx(expected, abs=1e-8 if model.dry else 0.15)
    assert expected > 0.5
    high, low = (by_scipy(model.dry, damping=d)[0] for d in (0.1 + 1e-5, 0.1 - 1e-5))
    np.testing.assert_allclose(slope, (high - low) / 2e-5, atol=2e-5)


def finds_and_continues_a_cycle(model):
    cycle = cycle_of(model)
    assert cycle.stable
    branch = jc.continue_cycle(cycle, parameter=BELT, bounds=(1.2, 1.6), max_points=5)
    speed, state = branch.parameter[-1], [float(part[-1, 0]) for part in branch.state]
    assert speed != SPEED
    end, _ = by_scipy(model.dry, branch.period[-1], start=state, speed=speed)
    np.testing.assert_allclose(end, state, atol=1e-8)


def finds_an_equilibrium(model):
    found = find_equilibrium(model, START)
    np.testing.assert_allclose(found.state, [[mu(SPEED)], [0.0]], atol=1e-12)
    assert found.stable is (hopf_speed(model) < SPEED)


def hopf_speed(model):
    """Where damping and the slope of friction cancel."""

    def damping(speed):
        tanh = 1.0 if model.dry else np.tanh(speed / WIDTH)
        return 0.1 - np.exp(-speed / 0.5) * tanh + mu(speed) * (1 - tanh**2) / WIDTH

    return float(brentq(damping, 0.5, 2.0, xtol=1e-14))


def finds_the_hopf_point(model):
    expected = hopf_speed(model)
    assert float(find_hopf_point(model, BELT, START).value) == pytest.approx(expected, abs=1e-11)
    branch = continue_equilibrium(model, START, BELT, (1.0, 1.5))
    (hopf,) = [point for point in branch.special if point.kind == "hopf"]
    assert float(hopf.p) == pytest.approx(expected, abs=1e-6)


def finds_exponents(model):
    cycle = cycle_of(model)
    period = float(cycle.period)
    found = jc.lyapunov_spectrum(model, cycle.state, 60 * period, transient=20 * period)
    assert abs(found.exponents[0]) < 1e-3
    assert float(found.exponents[1]) == -np.inf


def sweeps_over_the_stiffness(model):
    values, watch = [0.9, 1.2], jc.Amplitude(1.0)
    data = jc.sweep(model, START, END, over={"stiffness": values}, observe=watch, rtol=1e-10)
    for k, stiffness in enumerate(values):
        (end, (amplitude, _)), _ = run_of(model.dry)(model.with_(stiffness=stiffness))
        np.testing.assert_allclose(end, by_scipy(stiffness=stiffness)[0], atol=1e-7)
        np.testing.assert_allclose(data.amplitude[k], amplitude, rtol=1e-8)


def is_judged(model):
    assert jc.verdict(model, cycle_of(model).state).verdict == "periodic"


LONG = [
    (finds_and_continues_a_cycle, DRY), (finds_the_hopf_point, DRY), (finds_exponents, DRY),
    (sweeps_over_the_stiffness, DRY), (is_judged, DRY), (simulates, SMOOTHED),
    (finds_and_continues_a_cycle, SMOOTHED),
]  # fmt: skip


@pytest.mark.parametrize(
    ("function", "model"),
    [
        (simulates, DRY),
        (finds_an_equilibrium, DRY),
        *(pytest.param(*case, marks=pytest.mark.long) for case in LONG),
    ],
    ids=lambda case: getattr(case, "__name__", None) or ("dry" if case.dry else "smoothed"),
)
def test_every_function_works_for_contacts(function, model):
    function(model)


def test_what_moves_with_the_time_has_no_equilibrium():
    for search in (find_equilibrium, lambda *of: find_hopf_point(of[0], "belt_speed", of[1])):
        with pytest.raises(ValueError, match="time"):
            search(FORCED, START)


def c_start(chain):
    return release_state(chain, 0)


def simulated(chain, **how):
    return jc.simulate(chain, c_start(chain), 1.0, **how)


def swept(chain, name="belt_speed", **how):
    return jc.sweep(chain, c_start(chain), 1.0, over={name: [0.1]}, **how)


ROSENBROCK, FOLD = {"solver": jc.Rodas4()}, cycle_branch(1).special[0]
# For smoothed friction alone: the words that say what to do with a dry chain, and a call of it.
REFUSED = [
    ("leave out", lambda c: simulated(c, **ROSENBROCK)),
    ("give `rtol`", lambda c: simulated(c, accuracy=0.1)),
    ("leave out `solver`", lambda c: swept(c, **ROSENBROCK)),
    ("give `rtol`", lambda c: swept(c, accuracy=0.1)),
    ("to sweep `width`", lambda c: swept(c, "width")),
    ("`find_limit_cycle`", lambda c: liouville_determinant(c, c_start(c), 6.0)),
    ("`find_limit_cycle`", lambda c: jc.cycles.find_limit_cycles(c, 2)),
    ("give it a width", lambda c: jc.boundaries.find_special_cycle(FOLD, c)),
    ("`find_fold`", jc.boundaries.fold_by_descent),
    ("give it a width", lambda c: jc.localization.phase_model(jc.paper_chain(4, width=None))),
    ("leave out", lambda c: jc.lyapunov_spectrum(c, c_start(c), 9.0, **ROSENBROCK)),
    ("leave out `solver`", lambda c: jc.verdict(c, c_start(c), **ROSENBROCK)),
    ("leave out `solver`", lambda c: loop(c, c_start(c), **ROSENBROCK)),
]


def test_what_needs_a_width_says_what_to_do_without_one():
    for words, function in REFUSED:
        with pytest.raises(ValueError, match="dry friction") as caught:
            function(jc.paper_chain(1, width=None))
        assert words in str(caught.value)
        assert re.search(r"`(chain|model)\.with_\(width=1e-3\)`", str(caught.value))
    for model in (DRY, SMOOTHED):
        with pytest.raises(ValueError, match=r"dry friction|at one contact"):
            jc.simulate(model, START, END, accuracy=1e-2)


MODULES = (jc, *(importlib.import_module(f"jaxchain.{submodule}") for submodule in jc.SUBMODULES))
PUBLIC = {getattr(module, name) for module in MODULES for name in getattr(module, "__all__", ())}
# Only raised, and caught by their kind: nothing calls a method of theirs.
CLASSES = sorted(
    (c for c in PUBLIC if inspect.isclass(c) and not issubclass(c, BaseException)),
    key=lambda c: c.__name__,
)
OPEN = [c for c in CLASSES if c.__name__.startswith("Abstract") and c is not AbstractModel]
# What a subclass may define of each; anything else that it defines would be ignored.
MAY_DEFINE: dict[type, set[str]] = {
    cls: set(names.split())
    for cls, names in {
        AbstractModel: "n equilibrium",
        AbstractFrictionLaw: "mu_static coefficient knots",
        AbstractOscillators: "springs local_force stiffness_diagonal switching stick_speed "
        "excess_force belt_direction growth_time release_acceleration divergence forcing_period",
        AbstractCells: "rate forcing_period ends components contact switching belt_direction "
        "growth_time release_acceleration",
        AbstractObserver: "init update update_if settled rests read label finite fits",
        AbstractClassifier: "merge patient least_time name numbers",
        AbstractRegion: "dimension start",
        AbstractStructuredRosenbrock: "tableau method_order sweeps with_sweeps",
    }.items()
}


def names_of(cls):
    """What stands in a class, by this package and by diffrax, and does not begin with _."""
    bases = [c for c in cls.__mro__ if c.__module__.split(".")[0] in ("jaxchain", "diffrax")]
    names = {name for c in bases for name in (*vars(c), *vars(c).get("__annotations__", {}))}
    return {name for name in names if not name.startswith("_")} - {"model_config"}


def define(cls, **names):
    return type(cls)("Mine", (cls,), {"__module__": __name__, "__qualname__": "Mine", **names})


@pytest.mark.parametrize(
    ("cls", "instead"),
    [
        (jc.Chain, "`jaxchain.model.AbstractOscillators` for other forces, or"),
        (jc.TanhFriction, "subclass `jaxchain.model.AbstractFrictionLaw`"),
        (MechanicalCells, "subclass `jaxchain.model.AbstractCells`"),
    ],
)
def test_a_concrete_class_is_final_and_the_error_names_another(cls, instead):
    with pytest.raises(
        TypeError, match=f"`Mine` cannot be a subclass of `{cls.__name__}`.*{instead}"
    ):
        define(cls)


@pytest.mark.parametrize("cls", OPEN)
def test_a_method_that_would_be_ignored_cannot_be_defined(cls):
    allowed = set().union(*(MAY_DEFINE.get(c, set()) for c in cls.__mro__))
    assert allowed & names_of(cls)
    for name in names_of(cls) - allowed:
        # A subclass of a class of the user's is no other.
        for base in (cls, define(cls)):
            with pytest.raises(TypeError, match=rf"Class `Mine` defines `{name}`, which some"):
                define(base, **{name: lambda self: 1.0})


def test_functions_for_a_belt_refuse_other_forces():
    start = jnp.ones(1), jnp.ones(1)
    for use in (
        jc.hopf_belt_speed, jc.find_fold,
        lambda field: jc.sweep(field, jc.equation_8, 20.0, over={"excited": [1]}),
        lambda field: jc.simulate(field, start, 1.0, solver=jc.EventDriven()),
    ):  # fmt: skip
        with pytest.raises((ValueError, TypeError), match=r"\bChain\b"):
            use(Slow())


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


class Mass(AbstractCells):
    """x'' = -x with a weak spring to both neighbours; equal masses do not stretch it."""

    def rate(self, t, left, own, right):
        x, v = own
        return v, -x + 0.1 * (left[0] - 2.0 * x + right[0])


class Driven(Mass):
    def forcing_period(self):
        return 2.0


class Row(Mass):
    ends = "free"
    components = ("x", "speed")


class Switching(Mass):
    """Everything optional; as numbers, so that all of its runs are one program."""

    direction: jax.Array
    growth: jax.Array
    at: jax.Array
    width: jax.Array
    acceleration: jax.Array
    contact = 0

    def switching(self, t, v):
        return v - self.at, self.width

    def belt_direction(self):
        return self.direction

    def growth_time(self):
        return self.growth

    def release_acceleration(self):
        return self.acceleration


def test_what_cells_define_is_honoured():
    start = jnp.zeros(3), jnp.ones(3)  # x = sin t
    fastest = jc.Section(0, 1, of="velocity")
    usual = {"direction": 1.0, "growth": 1e3, "at": 50.0, "width": 1e-4, "acceleration": 0.0}

    def run(**other):
        cells = Switching(**{name: jnp.asarray(v) for name, v in (usual | other).items()})
        return jc.simulate(cells, start, 6.5, solver=jc.Rodas4(), observe=fastest, rtol=1e-8)

    plain = run()
    assert plain.steps < 300
    assert plain.observed[0] == pytest.approx(2.0 * np.pi, abs=1e-6)
    assert run(direction=-1.0).observed[0] == pytest.approx(np.pi, abs=1e-6)
    assert run(growth=0.01).steps >= 650
    assert run(at=0.1).steps > plain.steps
    slow, fast = (run(at=0.1, width=0.1, acceleration=a).steps for a in (0.0, 1e9))
    assert fast > slow + 20  # its error counts more
    assert "amplitude_speed" in jc.Amplitude(component=1).label(jnp.ones(3), Row())
    ring, row = (np.asarray(cells.jacobian(0.0, start)) for cells in (Mass(), Row()))
    # The last mass pulls the first one in a ring; at a free end there is one spring only.
    assert (ring[3, 2], row[3, 2]) == (0.1, 0.0)
    assert (ring[3, 0], row[3, 0]) == pytest.approx((-1.2, -1.1))
    with pytest.raises(ValueError, match="forced with the period 2"):
        jc.find_limit_cycle(Driven(), start, period=3.0)
    with pytest.raises(ValueError, match="but for 3 masses must be"):
        jc.simulate(TwoWells(), (jnp.ones(2), jnp.ones(2)), 1.0)
    assert find_equilibrium(TwoWells()).state[0] == pytest.approx(1.0)  # not that at 0


class Odd(AbstractObserver):
    """Counts by twos from 100; every optional method says what is not usual."""

    most: jax.Array

    def init(self, field, t0, t1, y0):
        return jnp.asarray(100.0)

    def fits(self, t0, t1):
        return t1 < 60.0

    def update(self, accumulator, step):
        return accumulator + 2.0

    def settled(self, accumulator):
        return accumulator >= 110.0

    def rests(self, accumulator):
        return accumulator >= 110.0

    def finite(self, accumulator):
        return accumulator < self.most

    def read(self, accumulator):
        return -accumulator

    def label(self, value, chain):
        return {"mine": Variable(value)}


def test_what_an_observer_defines_is_honoured():
    chain = jc.paper_chain(1, width=None)
    start = jc.equation_8(chain, 1)
    odd = Odd(jnp.asarray(200.0))
    for observer, outcome in ((odd, "quiet"), (Odd(jnp.asarray(105.0)), "nonfinite")):
        run = jc.simulate(chain, start, 50.0, observe=observer, throw=False)
        assert (float(run.observed), int(run.steps), run.outcome) == (-110.0, 5, outcome)
    for use in (
        lambda: jc.simulate(chain, start, 70.0, observe=odd),
        lambda: jc.sweep(chain, jc.equation_8, 70.0, over={"excited": [1]}, observe=odd),
    ):
        with pytest.raises(ValueError, match="does not fit into the run from t = 0 to 70"):
            use()
