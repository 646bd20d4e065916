"""The table function x model: what every function says of every model.

First the same mass as a chain and as cells, dry and smoothed, and forced:

x'' + 0.1 x' + k x = F(x' - v_d) + f cos(omega t), F = -mu(|w|) sign(w) or -mu(|w|) tanh(w / eps),
mu(s) = 0.5 + 0.5 exp(-s / 0.5).  The witness is SciPy, which stops at every event.

Then what needs a width says in words what to do with a dry chain, and what a subclass may define.
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
from jaxchain import (
    Amplitude,
    Chain,
    ExponentialDecay,
    StickTime,
    TanhFriction,
    continue_cycle,
    find_limit_cycle,
    lyapunov_spectrum,
    simulate,
    sweep,
    verdict,
)  # fmt: skip
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

LAW, WIDTH, SPEED = ExponentialDecay(1.0, 0.5, 0.5), 1e-2, 1.3
FORCE, FREQUENCY = 1.5, 0.7
SMOOTH = TanhFriction(LAW, WIDTH)
MODELS = {
    "chain, dry": Chain(1, LAW, SPEED, 0.05),
    "chain, smoothed": Chain(1, SMOOTH, SPEED, 0.05),
    "cells, dry": MechanicalCells(1.0, damping=0.1, friction=LAW, belt_speed=SPEED),
    "cells, smoothed": MechanicalCells(1.0, damping=0.1, friction=SMOOTH, belt_speed=SPEED),
    "cells, dry, forced": MechanicalCells(
        1.0, damping=0.1, friction=LAW, force=FORCE, frequency=FREQUENCY
    ),
    # The second contact bears no load.
    "contacts, dry": MechanicalCells(
        1.0, damping=0.1, contacts=[Contact(1.0, LAW, 1.0, SPEED), Contact(1.0, LAW, 0.0, -SPEED)]
    ),
    "contacts, smoothed": MechanicalCells(
        1.0,
        damping=0.1,
        contacts=[Contact(1.0, SMOOTH, 1.0, SPEED), Contact(1.0, SMOOTH, 0.0, -SPEED)],
    ),
}
START = jnp.array([1.9]), jnp.array([0.2])
END = 30.0


def mu(s):
    return 0.5 + 0.5 * np.exp(-s / 0.5)


def by_scipy(
    name, t1=END, stiffness=1.0, damping=0.1, start=(1.9, 0.2), t0=0.0, speed=SPEED, force=FORCE
):
    """(t, x, v) at t1, the time for which the mass sticks, and the times at which it lets go."""
    forced = "forced" in name
    speed, force = (0.0, force) if forced else (speed, 0.0)

    def pull(t, y):
        return force * np.cos(FREQUENCY * t) - stiffness * y[0] - damping * y[1]

    def rate(t, y, mode):
        w = y[1] - speed
        if mode is None:
            return y[1], pull(t, y) - mu(abs(w)) * np.tanh(w / WIDTH)
        return (speed, 0.0) if mode == 0 else (y[1], pull(t, y) - mode * mu(mode * w))

    def lands(t, y, mode):
        return mode * (y[1] - speed)

    def lets_go(t, y, mode):
        return 1.0 - abs(pull(t, y))

    for event in (lands, lets_go):
        vars(event).update(terminal=True, direction=-1)
    t, y, stuck, released = t0, np.array(start), 0.0, []
    mode = None if "smoothed" in name else np.sign(y[1] - speed)
    while t < t1:
        events = None if mode is None else lets_go if mode == 0 else lands
        method = "Radau" if mode is None else "DOP853"
        out = solve_ivp(
            rate, (t, t1), y, method, args=(mode,), events=events, rtol=1e-11, atol=1e-12
        )
        stuck += float(mode == 0) * (out.t[-1] - t)
        t, y = out.t[-1], out.y[:, -1].copy()
        if t < t1:
            was, r = mode, pull(t, y)
            y[1] = speed
            mode = np.sign(r) if was == 0 or abs(r) > 1 else 0
            released += [t] * int(was == 0)
    return y, stuck, np.array(released)


def friction_force(name):
    """F(-v_d)."""
    return mu(SPEED) * (np.tanh(SPEED / WIDTH) if "smoothed" in name else 1.0)


@functools.cache
def cycle_of(name):
    start, _, _ = by_scipy(name, 20 * 2 * np.pi / FREQUENCY)
    return find_limit_cycle(MODELS[name], tuple(jnp.array([part]) for part in start))


@functools.cache
def run_of(name):
    """The end and what is observed, and its slopes; one program for all numbers of the model."""
    of = "damping_ratio" if "chain" in name else "damping"
    watch = Amplitude(1.0), StickTime()

    @jax.jit
    def run(model):
        def ends(damping):
            own = model.with_(**{of: damping})
            # A short series compiles fast.
            how = {"solver": jc.EventDriven(8)} if model.dry else {}
            done = simulate(own, START, END, rtol=1e-10, observe=watch, **how)
            return jnp.concatenate(done.state), done.observed

        return jax.jvp(ends, (getattr(model, of),), (jnp.ones(()),))

    return run


def belt(name):
    return "contacts[0].belt_speed" if "contacts" in name else "belt_speed"


def simulates(name, model):
    (end, (_, stuck)), _ = run_of(name)(model)
    y, expected, _ = by_scipy(name)
    np.testing.assert_allclose(end, y, atol=1e-7)
    if "smoothed" in name:
        _, expected, _ = by_scipy(name.replace("smoothed", "dry"))
    # A smoothed mass is released later and slower, by times of the order of its width.
    assert float(stuck[0]) == pytest.approx(expected, abs=0.15 if not model.dry else 1e-8)
    assert expected > 0.5


def differentiates(name, model):
    _, (slope, _) = run_of(name)(model)
    high, low = (by_scipy(name, damping=d)[0] for d in (0.1 + 1e-5, 0.1 - 1e-5))
    factor = 0.5 if "chain" in name else 1.0
    np.testing.assert_allclose(slope * factor, (high - low) / 2e-5, atol=2e-5)


def finds_a_cycle(name, model):
    cycle = cycle_of(name)
    assert cycle.stable
    start = [float(part[0]) for part in cycle.state]
    if "forced" in name:
        assert float(cycle.period) == pytest.approx(2 * np.pi / FREQUENCY)
    y, _, _ = by_scipy(name, float(cycle.period), start=start)
    np.testing.assert_allclose(y, start, atol=2e-8)
    return cycle


def continues_a_cycle(name, model):
    of, argument = ("force", "force") if "forced" in name else (belt(name), "speed")
    branch = continue_cycle(cycle_of(name), parameter=of, bounds=(1.2, 1.6), max_points=5)
    value, state = branch.parameter[-1], [float(part[-1, 0]) for part in branch.state]
    assert value not in (SPEED, FORCE)
    end, _, _ = by_scipy(name, branch.period[-1], start=state, **{argument: value})
    np.testing.assert_allclose(end, state, atol=1e-8)


def finds_an_equilibrium(name, model):
    if "forced" in name:
        with pytest.raises(ValueError, match="time"):
            find_equilibrium(model, START)
        return
    found = find_equilibrium(model, START)
    np.testing.assert_allclose(found.state, [[friction_force(name)], [0.0]], atol=1e-12)
    assert found.stable is (hopf_speed(name) < SPEED)


def hopf_speed(name):
    def damping(speed):
        slope = -np.exp(-speed / 0.5)  # of mu
        if "smoothed" not in name:
            return 0.1 + slope
        tanh = np.tanh(speed / WIDTH)
        return 0.1 + slope * tanh + mu(speed) * (1 - tanh**2) / WIDTH

    return float(brentq(damping, 0.5, 2.0, xtol=1e-14))


def finds_the_hopf_point(name, model):
    if "forced" in name:
        with pytest.raises(ValueError, match="time"):
            find_hopf_point(model, "belt_speed", START)
        return
    found = find_hopf_point(model, belt(name), START)
    assert float(found.value) == pytest.approx(hopf_speed(name), abs=1e-11)
    branch = continue_equilibrium(model, START, belt(name), (1.0, 1.5))
    (hopf,) = [point for point in branch.special if point.kind == "hopf"]
    assert float(hopf.p) == pytest.approx(hopf_speed(name), abs=1e-6)


def finds_exponents(name, model):
    cycle = cycle_of(name)
    period = float(cycle.period)
    found = lyapunov_spectrum(model, cycle.state, 60 * period, transient=20 * period)
    if "forced" in name:  # it slides throughout
        rates = np.log(np.abs(cycle.multipliers)) / period
        np.testing.assert_allclose(jnp.sum(found.exponents), np.sum(rates), rtol=1e-3)
        return
    assert abs(found.exponents[0]) < 1e-3
    last = float(found.exponents[1])
    assert last == -np.inf if model.dry else last < -1.0


def picks_a_width(name, model):
    if model.dry or "contacts" in name:
        with pytest.raises(ValueError, match=r"dry friction|at one contact"):
            simulate(model, START, END, accuracy=1e-2)
        return
    run = simulate(model, START, 20.0, accuracy=1e-3)
    y, _, _ = by_scipy(name.replace("smoothed", "dry"), 20.0)
    np.testing.assert_allclose(np.ravel(run.state), y, atol=2e-3)
    assert run.numerics is not None
    assert float(run.numerics.width) < 1e-3


def sweeps_over_the_stiffness(name, model):
    values = [0.9, 1.2]
    watch = Amplitude(1.0)
    data = sweep(model, START, END, over={"stiffness": values}, observe=watch, rtol=1e-10)
    for k, stiffness in enumerate(values):
        (end, (amplitude, _)), _ = run_of(name)(model.with_(stiffness=stiffness))
        y, _, _ = by_scipy(name, stiffness=stiffness)
        np.testing.assert_allclose(end, y, atol=1e-7)
        np.testing.assert_allclose(data.amplitude[k], amplitude, rtol=1e-8)


def is_judged(name, model):
    start = [float(part[0]) for part in cycle_of(name).state]
    assert verdict(model, tuple(jnp.array([a]) for a in start)).verdict == "periodic"


# In the default run. Other tests hold chains to all of these, dry cells to what concerns cycles,
# tests/cycles/test_dry_cells.py, and Hopf points, tests/boundaries/test_dry_equilibria.py, and
# forced ones to SciPy, tests/model/test_drives.py.
QUICK = {
    "cells, dry": (picks_a_width,),
    "cells, dry, forced": (finds_an_equilibrium, finds_the_hopf_point),
    "contacts, dry": (simulates, differentiates, finds_an_equilibrium, picks_a_width),
    "contacts, smoothed": (picks_a_width,),
}
FUNCTIONS = (
    simulates, differentiates, finds_a_cycle, continues_a_cycle, finds_an_equilibrium,
    finds_the_hopf_point, finds_exponents, picks_a_width, sweeps_over_the_stiffness, is_judged,
)  # fmt: skip
TABLE = [
    pytest.param(
        function, name, marks=() if function in QUICK.get(name, ()) else pytest.mark.long,
        id=f"{function.__name__}-{name}",
    )
    for name in MODELS
    for function in FUNCTIONS
]  # fmt: skip


@pytest.mark.parametrize(("function", "name"), TABLE)
def test_every_function_works_for_every_model(function, name):
    function(name, MODELS[name])


ONE = jc.paper_chain(1, width=None)


def c_start(chain):
    return release_state(chain, 0)


def film(chain):
    return loop(chain, c_start(chain), solver=jc.Rodas4())


# For smoothed friction alone: with a dry chain, the words that say what to do.
REFUSED = {
    "simulate": (lambda c: jc.simulate(c, c_start(c), 1.0, solver=jc.Rodas4()), "leave out"),
    "simulate accuracy": (lambda c: jc.simulate(c, c_start(c), 1.0, accuracy=0.1), "give `rtol`"),
    "sweep": (
        lambda c: jc.sweep(c, c_start(c), 1.0, over={"belt_speed": [1.0]}, solver=jc.Rodas4()),
        "leave out `solver`",
    ),
    "sweep accuracy": (
        lambda c: jc.sweep(c, c_start(c), 1.0, over={"belt_speed": [1.0]}, accuracy=0.1),
        "give `rtol`",
    ),
    "sweep width": (
        lambda c: jc.sweep(c, c_start(c), 1.0, over={"width": [0.1]}), "to sweep `width`"
    ),
    "liouville_determinant": (
        lambda c: liouville_determinant(c, c_start(c), 6.0), "`find_limit_cycle`"
    ),
    "find_limit_cycles": (lambda c: jc.cycles.find_limit_cycles(c, 2), "`find_limit_cycle`"),
    "find_special_cycle": (
        lambda c: jc.boundaries.find_special_cycle(cycle_branch(1).special[0], c),
        "give it a width",
    ),
    "fold_by_descent": (jc.boundaries.fold_by_descent, "`find_fold`"),
    "phase_model": (
        lambda c: jc.localization.phase_model(jc.paper_chain(4, width=None)), "give it a width"
    ),
    "lyapunov_spectrum": (
        lambda c: jc.lyapunov_spectrum(c, c_start(c), 9.0, solver=jc.Rodas4()), "leave out"
    ),
    "verdict": (lambda c: jc.verdict(c, c_start(c), solver=jc.Rodas4()), "leave out `solver`"),
    "loop": (film, "leave out `solver`"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_needs_a_width_says_what_to_do_without_one(name):
    function, words = REFUSED[name]
    with pytest.raises(ValueError, match="dry friction") as caught:
        function(ONE)
    assert words in str(caught.value)
    assert re.search(r"`(chain|model)\.with_\(width=1e-3\)`", str(caught.value))


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


@pytest.mark.parametrize("cls", [jc.Chain, MechanicalCells, jc.TanhFriction])
def test_a_concrete_class_is_final(cls):
    for name in names_of(cls) or {"anything"}:
        with pytest.raises(TypeError, match=rf"`Mine` cannot be a subclass of `{cls.__name__}`"):
            define(cls, **{name: lambda self: 1.0})


@pytest.mark.parametrize("cls", OPEN)
def test_a_method_that_would_be_ignored_cannot_be_defined(cls):
    allowed = set().union(*(MAY_DEFINE.get(c, set()) for c in cls.__mro__))
    assert allowed & names_of(cls)
    for name in names_of(cls) - allowed:
        # A subclass of a class of the user's is no other.
        for base in (cls, define(cls)):
            with pytest.raises(TypeError, match=rf"Class `Mine` defines `{name}`, which some"):
                define(base, **{name: lambda self: 1.0})


def test_the_error_names_the_class_to_subclass_instead():
    for cls, instead in {
        jc.Chain: "`jaxchain.model.AbstractOscillators` for other forces, or",
        jc.TanhFriction: "subclass `jaxchain.model.AbstractFrictionLaw`",
        MechanicalCells: "subclass `jaxchain.model.AbstractCells`",
    }.items():
        with pytest.raises(TypeError, match=instead):
            define(cls)


def test_functions_for_a_belt_refuse_other_forces():
    start = jnp.ones(1), jnp.ones(1)
    for use in (
        jc.hopf_belt_speed, jc.fold_belt_speed, jc.find_fold,
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


def test_the_number_of_cells_and_the_equilibrium_of_a_model_are_used():
    with pytest.raises(ValueError, match="but for 3 masses must be"):
        jc.simulate(TwoWells(), (jnp.ones(2), jnp.ones(2)), 1.0)
    assert find_equilibrium(TwoWells()).state[0] == pytest.approx(1.0)  # not that at 0


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
    for model in (Driven(), Swing()):
        with pytest.raises(ValueError, match="forced with the period 2"):
            jc.find_limit_cycle(model, start, period=3.0)


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
def test_an_observer_is_honoured_in_runs_and_sweeps():
    chain = jc.paper_chain(1, width=None)
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


def test_an_observer_that_does_not_fit_is_refused_in_runs_and_sweeps():
    chain = jc.paper_chain(1, width=None)
    with pytest.raises(ValueError, match="does not fit into the run from t = 0 to 50"):
        jc.simulate(chain, jc.equation_8(chain, 1), 50.0, observe=Late())
    with pytest.raises(ValueError, match="does not fit into the run from t = 0 to 50"):
        jc.sweep(chain, jc.equation_8, 50.0, over={"excited": [1]}, observe=Late())
