"""Forces, loads and belts that are functions of time or of the state: SciPy with events."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from witnesses.driven import run

from jaxchain import (
    Coulomb,
    EventDriven,
    StaticKinetic,
    StickTime,
    continue_cycle,
    find_limit_cycle,
    simulate,
    sweep,
)
from jaxchain.model import Contact, MechanicalCells, Table
from jaxchain.model.drives import takes_state
from jaxchain.solvers.dry_friction import nominal_limit

LAW = StaticKinetic(1.1, 0.7)
K = np.array([[2.0, 0.3], [0.3, 1.0]])


def still(t):
    return 0.0, 0.0


def one(**drives) -> MechanicalCells:
    return MechanicalCells(1.0, damping=0.1, friction=LAW, **drives)


def free(force, damping=0.1):
    return lambda t, q, v: [force(t) - q[0] - damping * v[0]]


START = jnp.array([0.3]), jnp.array([0.1])


def test_a_driven_cell_is_that_of_scipy_with_its_slopes():
    """Mode coupling, on a belt of varying speed: q_2 presses the contact of q_1, or lifts it."""
    M = np.array([[1.0, 0.1], [0.1, 0.8]])
    cells = MechanicalCells(
        K, M, damping=[0.02, 0.03], friction=LAW,
        belt_speed=lambda t: 0.6 + 0.2 * jnp.sin(0.5 * t),
        force=lambda t: (0.0 * t, 0.6 + 0.9 * jnp.cos(1.1 * t)),
        normal_load=lambda t, q, v: 1.5 * q[1],
    )  # fmt: skip

    def force(t, q, v):
        push = np.array([0.0, 0.6 + 0.9 * np.cos(1.1 * t)])
        return np.linalg.solve(M, push - K @ q - np.array([0.02, 0.03]) * v)

    belt = lambda t: (0.6 + 0.2 * np.sin(0.5 * t), 0.1 * np.cos(0.5 * t))
    load = lambda t, q, v: 1.5 * q[1]
    y, share = [0.3, 0.2, 0.1, 0.0], np.linalg.inv(M)[:, 0]
    expected, stuck, events = run(force, share, belt, load, lambda s: 0.7, 1.1, y, 30.0)
    assert events >= 20
    assert stuck > 0.5

    @jax.jit
    def end(a):
        def ends(a):
            how = {"rtol": 1e-12, "observe": StickTime(), "solver": EventDriven(5)}
            own = cells.with_(mu_static=1.1 + a, mass=M * (1.0 - a), stiffness=K * (1.0 + 2.0 * a))
            start = tuple(jnp.array([part + a]) for part in y)
            done = simulate(own, start, 30.0, **how)
            return jnp.concatenate([*done.state, done.observed])

        return jax.jvp(ends, (a,), (jnp.ones(()),))

    found, slope = end(0.0)
    np.testing.assert_allclose(found, [*expected, stuck], atol=1e-10)
    difference = (end(1e-6)[0] - end(-1e-6)[0]) / 2e-6
    np.testing.assert_allclose(slope, difference, atol=1e-6, rtol=1e-6)


@pytest.mark.long
def test_a_periodic_load_has_cycles_of_its_period():
    load, pull = lambda t: 0.3 + 0.2 * jnp.cos(2 * t), lambda t: 1.2 * jnp.cos(2 * t)
    cycle = find_limit_cycle(one(normal_load=load, force=pull, frequency=2.0), START)
    assert float(cycle.period) == pytest.approx(np.pi)
    branch = continue_cycle(cycle, parameter="damping", bounds=(0.1, 0.3), max_points=4)
    assert branch.parameter[-1] > 0.1
    pressed = lambda t, q, v: 0.3 + 0.2 * np.cos(2 * t)
    for k in (0, -1):
        y = [float(part[k, 0]) for part in branch.state]
        force = free(lambda t: 1.2 * np.cos(2 * t), branch.parameter[k])
        end, _, _ = run(force, np.ones(1), still, pressed, lambda s: 0.7, 1.1, y, np.pi)
        np.testing.assert_allclose(end, y, atol=1e-8)
    with pytest.raises(ValueError, match=r"depend on time.*`forcing_period`"):
        find_limit_cycle(one(normal_load=load), START)


def test_a_sweep_of_what_moves_is_that_of_scipy():
    """Also of the numbers of a contact, by name."""
    load, belt = lambda t: 1.0 + 0.5 * jnp.cos(2 * t), lambda t: 0.1 * jnp.sin(2 * t)
    cells = MechanicalCells(
        1.0, contacts=[Contact(1.0, StaticKinetic(0.9, 0.3), load, belt)],
        force=lambda t: 1.2 * jnp.cos(2 * t), frequency=2.0,
    )  # fmt: skip
    over = {"damping": [0.1, 0.2], "contacts[0].mu_static": [0.8, 0.9]}
    how = {"observe": StickTime(), "solver": EventDriven(4), "rtol": 1e-9}
    data = sweep(cells, START, 20.0, over=over, **how)
    belt = lambda t: (0.1 * np.sin(2 * t), 0.2 * np.cos(2 * t))
    load = lambda t, q, v: 1.0 + 0.5 * np.cos(2 * t)
    for damping, mu in ((0.1, 0.9), (0.2, 0.8)):
        force = free(lambda t: 1.2 * np.cos(2 * t), damping)
        _, stuck, _ = run(force, np.ones(1), belt, load, lambda s: 0.3, mu, [0.3, 0.1], 20.0)
        found = data.stick_time.sel({"damping": damping, "contacts[0].mu_static": mu})
        np.testing.assert_allclose(found, [stuck], atol=1e-7)
    assert stuck > 0.1


def test_a_number_in_a_default_is_no_state():
    """`lambda t, k=k: ...` is a function of time alone; a nominal load of 0 has no limit 0."""
    assert not takes_state(lambda t, k=0.5: k + 0.0 * t)
    assert takes_state(lambda t, q, v: q[0])
    assert np.all(nominal_limit(one(normal_load=lambda t, q, v: 1.5 * q[0])) > 0.0)


@eqx.filter_jit
def at(table, times):
    """The values of a table, by one program."""
    return jax.vmap(table)(times)


def test_a_table_is_the_curve_through_its_points():
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0.0, 5.0, 12))
    times, values = np.append(rng.uniform(-1.0, 6.0, 40), t), rng.normal(size=(12, 2))
    linear = at(Table(t, values, kind="linear"), times)
    for i in range(2):
        np.testing.assert_allclose(linear[:, i], np.interp(times, t, values[:, i]), atol=1e-14)
    # It reproduces a parabola, except beside the ends, where it takes the slope of the chord.
    bent = lambda s: 1.0 - 2.0 * s + 0.7 * s**2
    inside = rng.uniform(t[1], t[-2], times.size)
    np.testing.assert_allclose(at(Table(t, bent(t)), inside), bent(inside), atol=1e-13)
    wave = np.arange(0.0, 3.0, 0.5)
    values = np.sin(2 * np.pi * wave / 3.0)
    again = Table(wave, values, 3.0)
    closed = Table(np.append(wave, 3.0), np.append(values, values[0]), 3.0)
    expected = at(again, inside)
    for table in (again, closed):
        np.testing.assert_allclose(at(table, inside + 6.0), expected, atol=1e-13)


def test_a_table_drives_a_dry_run_with_slopes_in_its_values():
    """Each of its times ends a step; SciPy is stopped at the corner of the ramp."""

    @jax.jit
    def end_and_slope(values, by):
        def end(values):
            cells = one(force=Table([0.0, 2.0, 4.0], values, kind="linear"))
            return simulate(cells, START, 4.0, rtol=1e-11, solver=EventDriven(6)).state[0][0]

        return jax.jvp(end, (values,), (by,))

    values, by, y = np.array([0.0, 3.0, 0.0]), np.array([1.0, -0.7, 0.5]), [0.3, 0.1]
    for ramp in (lambda t: 1.5 * t, lambda t: 3.0 - 1.5 * t):
        y, _, _ = run(
            free(ramp), np.ones(1), still, lambda *_: 1.0, lambda s: 0.7, 1.1, y, 2.0
        )  # fmt: skip
    (x, slope), (above, _), (below, _) = (
        end_and_slope(values + h * by, by) for h in (0.0, 1e-6, -1e-6)
    )
    assert float(x) == pytest.approx(y[0], abs=1e-11)
    assert float(slope) == pytest.approx(float(above - below) / 2e-6, abs=1e-7)


def test_a_table_is_read_from_a_file(tmp_path):
    file = tmp_path / "signal.csv"
    file.write_text("time; left; right\n0, 1, 2\n\n1, 3, 4 # kept\n2.5, 5, 6\n", encoding="utf-8")
    table = Table.from_csv(file, kind="linear")
    np.testing.assert_array_equal(table.t, [0.0, 1.0, 2.5])
    np.testing.assert_array_equal(at(table, np.array([0.5])), [[2.0, 3.0]])
    file.write_text("0, 1\n1\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must hold rows of numbers"):
        Table.from_csv(file)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: one(force=lambda t: jnp.ones(3)), "`force` must be a function .t. that returns"),
        (lambda: one(normal_load=lambda t: "x"), "`normal_load` must be a function .t. or .t, q"),
        (lambda: one(frequency=2.0, force=jnp.cos), "`frequency` = 2 must be that of all drives"),
        (lambda: Table([0.0, 2.0], [1.0, 3.0], period=2.0), "`values` must end as it begins"),
    ],
)
def test_bad_drives_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_belt_that_goes_to_and_fro_in_si_units():
    """20 x'' + 10 x' + 70 x = -294.3 sign(x' - 2 sin(2 pi t / 50)), by another program."""
    cells = MechanicalCells(
        70.0, 20.0, damping=10.0, friction=Coulomb(1.0), normal_load=294.3,
        belt_speed=lambda t: 2.0 * jnp.sin(2 * jnp.pi * t / 50),
    )  # fmt: skip
    x, _ = simulate(cells, (jnp.zeros(1),) * 2, 100.0, rtol=1e-12).state
    assert float(x[0]) == pytest.approx(-4.191208700, abs=1e-9)
