"""Forces, loads and belts that are functions of time or of the state: SciPy with events."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from witnesses.driven import run

from jaxchain import (
    Amplitude,
    Coulomb,
    EventDriven,
    StaticKinetic,
    StickTime,
    continue_cycle,
    find_limit_cycle,
    simulate,
    sweep,
)
from jaxchain.model import MechanicalCells, Table
from jaxchain.solvers.dry_friction import nominal_limit

LAW = StaticKinetic(1.1, 0.7)
K = np.array([[2.0, 0.3], [0.3, 1.0]])


def still(speed):
    return lambda t: (speed, 0.0)


def one(**drives) -> MechanicalCells:
    return MechanicalCells(1.0, damping=0.1, friction=LAW, **drives)


def free(force=lambda t: 0.0):
    return lambda t, q, v: [force(t) - q[0] - 0.1 * v[0]]


def base(t, xp):
    """k b + c b' of a base b = 0.8 sin(phase) whose frequency grows exponentially from 0.3."""
    phase, rate = 15.0 * (xp.exp(0.02 * t) - 1.0), 0.3 * xp.exp(0.02 * t)
    return 0.8 * (xp.sin(phase) + 0.1 * rate * xp.cos(phase))


# The cells, and what the witness needs: free, share, belt, load, y.
CASES: dict[str, Any] = {
    "load": (
        one(belt_speed=0.4, normal_load=lambda t: 1.0 + 0.3 * jnp.cos(2 * t)),
        (free(), [1.0], still(0.4), lambda t, q, v: 1.0 + 0.3 * np.cos(2 * t), [0.3, 0.1]),
    ),
    "belt": (
        one(belt_speed=lambda t: 0.4 + 0.3 * jnp.sin(0.5 * t)),
        (
            free(), [1.0], lambda t: (0.4 + 0.3 * np.sin(0.5 * t), 0.15 * np.cos(0.5 * t)),
            lambda t, q, v: 1.0, [0.3, 0.1],
        ),
    ),
    "base": (
        one(force=lambda t: base(t, jnp), normal_load=0.3),
        (free(lambda t: base(t, np)), [1.0], still(0.0), lambda t, q, v: 0.3, [0.3, 0.1]),
    ),
    # Mode coupling: q_2 presses the contact of q_1, and lifts it off.
    "lift-off": (
        MechanicalCells(
            K, damping=[0.02, 0.03], friction=LAW, belt_speed=0.6,
            force=lambda t: (0.0 * t, 0.6 + 0.9 * jnp.cos(1.1 * t)),
            normal_load=lambda t, q, v: 1.5 * q[1],
        ),
        (
            lambda t, q, v: (
                -K @ q - np.array([0.02, 0.03]) * v + np.array([0.0, 0.6 + 0.9 * np.cos(1.1 * t)])
            ),
            [1.0, 0.0], still(0.6), lambda t, q, v: 1.5 * q[1], [0.3, 0.2, 0.1, 0.0],
        ),
    ),
}  # fmt: skip
LONG = {"base", "load"}


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=[pytest.mark.long] if c in LONG else []) for c in CASES]
)
def test_a_driven_cell_is_that_of_scipy_with_its_slopes(case):
    cells, (force, share, belt, load, y) = CASES[case]
    expected, stuck, events = run(
        force, np.array(share), belt, load, lambda s: 0.7, 1.1, y, 60.0
    )  # fmt: skip
    assert events >= (40 if case == "lift-off" else 2)
    start = tuple(jnp.array([part]) for part in y)

    @jax.jit
    def end(mu):
        def ends(mu):
            own = cells.with_(mu_static=mu)
            done = simulate(
                own, start, 60.0, rtol=1e-12, observe=StickTime(), solver=EventDriven(9)
            )
            return jnp.concatenate([*done.state, done.observed])

        return jax.jvp(ends, (mu,), (jnp.ones(()),))

    found, slope = end(1.1)
    np.testing.assert_allclose(found[:-1], expected, atol=1e-10)
    assert stuck > 0.5
    assert float(found[-1]) == pytest.approx(stuck, abs=1e-10)
    difference = (end(1.1 + 1e-6)[0] - end(1.1 - 1e-6)[0]) / 2e-6
    np.testing.assert_allclose(slope, difference, atol=2e-7)


@pytest.mark.long
def test_a_periodic_load_has_cycles_of_its_period():
    def load(t):
        return 0.3 + 0.2 * jnp.cos(2 * t)

    def pull(t):
        return 1.2 * jnp.cos(2 * t)

    cells = one(normal_load=load, force=pull, frequency=2.0)
    start = jnp.array([0.3]), jnp.array([0.1])
    cycle = find_limit_cycle(cells, start)
    assert float(cycle.period) == pytest.approx(np.pi)
    y = [float(part[0]) for part in cycle.state]
    force = free(lambda t: 1.2 * np.cos(2 * t))
    pressed = lambda t, q, v: 0.3 + 0.2 * np.cos(2 * t)
    end, _, _ = run(force, np.ones(1), still(0.0), pressed, lambda s: 0.7, 1.1, y, np.pi)
    np.testing.assert_allclose(end, y, atol=1e-8)
    with pytest.raises(ValueError, match=r"depend on time.*`forcing_period`"):
        find_limit_cycle(one(normal_load=load), start)


def moving() -> MechanicalCells:
    return MechanicalCells(
        1.0, damping=0.1, friction=Coulomb(0.3), force=lambda t: 1.2 * jnp.cos(2 * t),
        frequency=2.0, normal_load=lambda t: 1.0 + 0.5 * jnp.cos(2 * t),
        belt_speed=lambda t: 0.1 * jnp.sin(2 * t),
    )  # fmt: skip


MOVING_START = jnp.array([0.3]), jnp.array([0.1])


def test_a_number_in_a_default_is_no_state():
    """`lambda t, k=k: ...` is a function of time alone; a nominal load of 0 has no limit 0."""
    cells = one(normal_load=lambda t, k=0.5: k + 0.0 * t)
    start = jnp.array([0.3]), jnp.array([0.1])
    expected = simulate(one(normal_load=0.5), start, 5.0).state
    np.testing.assert_allclose(simulate(cells, start, 5.0).state, expected, atol=1e-9)
    lifts = CASES["lift-off"][0]
    assert float(nominal_limit(lifts)) > 0.0


@pytest.mark.long
def test_branches_and_smoothed_runs_of_what_moves():
    """The branch agrees with single searches."""
    cells = moving()
    smoothed = simulate(cells.with_(width=1e-4), MOVING_START, 20.0, rtol=1e-8)
    dry = simulate(cells, MOVING_START, 20.0)
    np.testing.assert_allclose(smoothed.state, dry.state, atol=1e-3)
    cycle = find_limit_cycle(cells, MOVING_START)
    branch = continue_cycle(cycle, parameter="damping", bounds=(0.1, 0.3), max_points=4)
    last = cells.with_(damping=branch.parameter[-1])
    again = find_limit_cycle(last, tuple(jnp.asarray(part[-1]) for part in branch.state))
    assert branch.parameter[-1] > 0.1
    np.testing.assert_allclose(again.amplitude, branch.amplitude[-1], atol=1e-8)


def test_a_table_is_the_curve_through_its_points():
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0.0, 5.0, 12))
    at = np.append(rng.uniform(-1.0, 6.0, 40), t)
    values = rng.normal(size=(12, 2))
    linear = jax.vmap(Table(t, values, kind="linear"))(at)
    for i in range(2):
        np.testing.assert_allclose(linear[:, i], np.interp(at, t, values[:, i]), atol=1e-14)
    # It reproduces a parabola, except beside the ends, where it takes the slope of the chord.
    bent = lambda s: 1.0 - 2.0 * s + 0.7 * s**2
    inside = rng.uniform(t[1], t[-2], 40)
    np.testing.assert_allclose(jax.vmap(Table(t, bent(t)))(inside), bent(inside), atol=1e-13)
    wave = np.arange(0.0, 3.0, 0.5)
    for kind in ("cubic", "linear"):
        again = Table(wave, np.sin(2 * np.pi * wave / 3.0), period=3.0, kind=kind)
        closed = Table(np.append(wave, 3.0), np.append(again.values, again.values[0]), 3.0, kind)
        for one_of in (again, closed):
            found = jax.vmap(one_of)(inside + 6.0)
            np.testing.assert_allclose(found, jax.vmap(again)(inside), atol=1e-13)


def test_a_table_drives_a_dry_run_with_slopes_in_its_values():
    """Each of its times ends a step; against a linear ramp that is written out."""
    start = jnp.array([0.3]), jnp.array([0.1])

    def ramp(t):
        return 1.5 * jnp.where(t < 2.0, t, 4.0 - t)

    @jax.jit
    def end(values):
        table = Table([0.0, 2.0, 4.0], values, kind="linear")
        own = one(force=table)
        return simulate(own, start, 4.0, rtol=1e-11, solver=EventDriven(6)).state[0][0]

    values = jnp.array([0.0, 3.0, 0.0])
    written = simulate(one(force=ramp), start, 4.0, rtol=1e-11).state[0][0]
    assert float(end(values)) == pytest.approx(float(written), abs=1e-11)
    slope = jax.jacfwd(end)(values)
    for i, side in enumerate(1e-6 * np.eye(3)):
        difference = float(end(values + side) - end(values - side)) / 2e-6
        assert float(slope[i]) == pytest.approx(difference, abs=1e-7)


def test_a_table_is_read_from_a_file(tmp_path):
    file = tmp_path / "signal.csv"
    file.write_text("time; left; right\n0, 1, 2\n\n1, 3, 4 # kept\n2.5, 5, 6\n", encoding="utf-8")
    table = Table.from_csv(file, kind="linear")
    np.testing.assert_array_equal(table.t, [0.0, 1.0, 2.5])
    np.testing.assert_array_equal(table(0.5), [2.0, 3.0])
    file.write_text("0, 1\n1\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must hold rows of numbers"):
        Table.from_csv(file)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: one(force=lambda t: jnp.ones(3)), "`force` must be a function .t. that returns"),
        (lambda: one(normal_load=lambda t: "x"), "`normal_load` must be a function .t. or .t, q"),
        (lambda: one(belt_speed=lambda: 1.0), "`belt_speed` must be a function .t. that returns"),
        (lambda: one(frequency=2.0, force=jnp.cos), "`frequency` = 2 must be that of all drives"),
        (lambda: one(frequency=2.0), "`force` and `frequency` belong together"),
        (lambda: Table([0.0, 0.0], [1.0, 2.0]), "`t` must rise, but 0 is followed by 0"),
        (lambda: Table([0.0, 1.0], [1.0]), "as many times as values"),
        (lambda: Table([0.0, 2.0], [1.0, 1.0], period=1.0), "`period` must be at least 2"),
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


def test_a_sweep_of_what_moves_is_its_runs():
    cells, watch = moving(), (Amplitude(5.0), StickTime())
    data = sweep(cells, MOVING_START, 20.0, over={"damping": [0.1, 0.2]}, observe=watch)
    assert "active_count" not in data  # it is not known what is fast
    single = simulate(cells.with_(damping=0.2), MOVING_START, 20.0, observe=watch)
    np.testing.assert_allclose(data.amplitude[1], single.observed[0], rtol=1e-12)
