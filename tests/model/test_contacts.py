"""Several contacts of a cell, belts under each mass, and rigid stops."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from witnesses.contacts import Rigid

from jaxchain import (
    Amplitude,
    Chain,
    EventDriven,
    ExponentialDecay,
    Result,
    StickTime,
    find_limit_cycle,
    simulate,
    sweep,
)
from jaxchain.basins import VibratingMasses
from jaxchain.boundaries import find_equilibrium
from jaxchain.model import Contact, Coulomb, MechanicalCells, StaticKinetic, Stop

# A series shorter than what suits the tolerance takes more steps, but compiles fast.
TIGHT: dict[str, Any] = {"rtol": 1e-13, "atol": 1e-14, "solver": EventDriven(9)}
# A block on a belt, and two blocks on it.
DIRECTIONS = ((1, 0, 0), (-1, 1, 0), (-1, 0, 1))


@jax.jit
def blocks(K, M, mu_static, mu_kinetic, loads, belt, force, frequency) -> MechanicalCells:
    laws = [StaticKinetic(mu_static[i], mu_kinetic[i]) for i in range(3)]
    contacts = [
        Contact(e, law, loads[i], belt if i == 0 else 0.0)
        for i, (e, law) in enumerate(zip(DIRECTIONS, laws, strict=True))
    ]
    drive: dict[str, Any] = {"force": force, "frequency": frequency}
    return MechanicalCells(K, mass=M, damping=0.02, contacts=contacts, **drive)


@pytest.mark.parametrize(("seed", "drops"), [(1, False), (6, True)])
def test_three_contacts_agree_with_scipy(seed: int, drops: bool):
    draw = np.random.default_rng(seed)
    shear = draw.uniform(0.3, 1, (3, 3))
    K = np.diag(draw.uniform(0.8, 3, 3)) - 0.1 * (shear + shear.T) * (1 - np.eye(3))
    M, mu_static = np.diag(draw.uniform(0.5, 2, 3)), draw.uniform(0.3, 0.7, 3)
    mu_kinetic = mu_static * draw.uniform(0.4, 1, 3) if drops else mu_static
    loads, belt = np.array([2.5, 0.7, 0.6]), draw.uniform(0.2, 0.6)
    force, omega = np.array([0, *draw.uniform(0.3, 1.2, 2)]), draw.uniform(0.4, 1.3)
    start = draw.normal(0, 0.3, (6, 1))
    cells = blocks(K, M, mu_static, mu_kinetic, loads, belt, force, omega)
    run = simulate(cells, tuple(jnp.asarray(start)), 30.0, **TIGHT)
    contacts = [
        (np.array(e, float), mu, lambda w, k=k: k, lambda t, q, v, p=p: p, lambda t, b=b: b)
        for e, mu, k, p, b in zip(
            DIRECTIONS, mu_static, mu_kinetic, loads, (belt, 0, 0), strict=True
        )
    ]
    witness = Rigid(M, lambda t, q, v: force * np.cos(omega * t) - K @ q - 0.02 * v, contacts)
    expected, events = witness.run(start[:3, 0], start[3:, 0], 30.0)
    assert len(events) >= 20
    assert not witness.ambiguous
    np.testing.assert_allclose(np.ravel(run.state), expected, atol=1e-11)
    assert run.steps < 500


def test_the_time_for_which_each_contact_sticks():
    law = ExponentialDecay(1.0, 0.5, 0.5)
    speeds, start = [0.5, -0.8, 1.1], (jnp.array([0.3, 0.1, -0.2]), jnp.array([0.0, 0.2, 0.1]))
    chain = Chain(3, law, jnp.array(speeds), coupling=0.05)
    run = simulate(chain, start, 40.0, observe=StickTime(), **TIGHT)
    matrix = 1.15 * np.eye(3) - 0.05
    contacts = [Contact(np.eye(3)[i], law, 1.0, v) for i, v in enumerate(speeds)]
    cells = MechanicalCells(matrix, damping=0.1, contacts=contacts)
    each = [StickTime(contact=i) for i in range(3)]
    one_cell = tuple(jnp.concatenate(start)[:, None])
    other = simulate(cells, one_cell, 40.0, observe=each, **TIGHT)
    np.testing.assert_allclose(np.ravel(other.state), np.ravel(run.state), atol=1e-11)
    np.testing.assert_allclose(np.ravel(other.observed), run.observed, atol=1e-9)
    assert np.all(run.observed > 1.0)


def test_cells_side_by_side_have_numbers_of_their_own():
    K = np.array([[1.0, -0.2], [-0.2, 1.5]])
    law = StaticKinetic(jnp.array([0.5, 0.4]), 0.3)
    contact = Contact((1, -1), law, jnp.array([1.0, 0.8]))
    wave: dict[str, Any] = {"force": jnp.array([0.7, 0.0]), "frequency": 0.9}
    two = MechanicalCells(K, damping=0.03, coupling=0.05, contacts=[contact], **wave)
    y = jnp.array([[0.1, 0.2], [0.0, 0.1], [0.0, 0.3], [0.2, 0.0]])
    run = simulate(two, tuple(y), 20.0, **TIGHT)
    C = 0.1 * np.kron([[1, -1], [-1, 1]], np.eye(2))  # a ring of two meets itself on both sides
    contacts = [
        Contact((1, -1, 0, 0), StaticKinetic(0.5, 0.3)),
        Contact((0, 0, 1, -1), StaticKinetic(0.4, 0.3), 0.8),
    ]
    wave = {"force": jnp.array([0.7, 0.0, 0.7, 0.0]), "frequency": 0.9}
    one = MechanicalCells(np.kron(np.eye(2), K) + C, damping=0.03, contacts=contacts, **wave)
    start = jnp.concatenate([y[:2].T.ravel(), y[2:].T.ravel()])[:, None]
    other = simulate(one, tuple(start), 20.0, **TIGHT)
    state = np.stack(run.state)
    same = np.concatenate([state[:2].T.ravel(), state[2:].T.ravel()])
    np.testing.assert_allclose(np.ravel(other.state), same, atol=1e-11)


def test_contacts_that_hold_the_same_twice_are_named():
    law = StaticKinetic(0.5, 0.3)
    twice = [Contact(1.0, law, 1.0, 0.2), Contact(1.0, law, 0.5, 0.2)]
    cells = MechanicalCells(1.0, damping=0.05, contacts=twice)
    start = jnp.array([0.1]), jnp.zeros(1)
    run = simulate(cells, start, 20.0, throw=False)
    assert run.outcome == "forces_not_unique"
    assert run.t < 1.0  # where it first sticks
    with pytest.raises(RuntimeError, match="hold the same displacements twice"):
        simulate(cells, start, 20.0)
    # At rest from the start, but pulled away from both.
    stays, leaves = (jnp.array([x]) for x in (0.5, 1.5))
    zero = jnp.zeros(1)
    still = cells.with_(**{"contacts[0].belt_speed": 0.0, "contacts[1].belt_speed": 0.0})
    assert simulate(still, (stays, zero), 1.0, throw=False).outcome == "forces_not_unique"
    assert simulate(still, (leaves, zero), 1.0).outcome == "successful"
    # With belts of two speeds it sticks to one at a time.
    apart = cells.with_(**{"contacts[1].belt_speed": -0.1})
    assert simulate(apart, start, 20.0).outcome == "successful"


IMPACTS: dict[str, Any] = {"stops": [Stop(1.0, 0.6, 0.3), Stop(-1.0, 0.4, 0.7)]}
WAVE: dict[str, Any] = {"force": 0.9, "frequency": 0.8, "damping": 0.05}
RUBS = MechanicalCells(1.0, friction=StaticKinetic(0.3, 0.2), belt_speed=0.3, **WAVE, **IMPACTS)
BEGIN = jnp.array([0.1]), jnp.array([0.2])


def test_impacts_agree_with_scipy():
    cells = RUBS.with_(belt_speed=0.1)
    run = simulate(cells, BEGIN, 60.0, observe=StickTime(), **TIGHT)
    one = np.ones(1)
    belt = (one, 0.3, lambda w: 0.2, lambda t, q, v: 1.0, lambda t: 0.1)
    stops = [(one, 0.6, 0.3), (-one, 0.4, 0.7)]
    witness = Rigid(1.0, lambda t, q, v: 0.9 * np.cos(0.8 * t) - q - 0.05 * v, [belt], stops)
    expected, events = witness.run([0.1], [0.2], 60.0)
    assert len(events) > 40
    held = [later - t for (t, mode), (later, _) in itertools.pairwise(events) if mode == (0,)]
    assert run.observed[0] == pytest.approx(sum(held), abs=1e-8)
    assert sum(held) > 1.0
    np.testing.assert_allclose(np.ravel(run.state), expected, atol=1e-11)
    assert run.steps < 1000


@pytest.mark.parametrize("speed", [0.0, 1.5])
def test_a_list_of_one_contact_is_that_contact(speed: float):
    law = ExponentialDecay(1.0, 0.5, 0.5)
    one = MechanicalCells(1.0, damping=0.1, friction=law, belt_speed=speed)
    listed = MechanicalCells(1.0, damping=0.1, contacts=[Contact(1.0, law, 1.0, speed)])
    at = jnp.array([0.3]), jnp.zeros(1)
    expected, found = find_equilibrium(one, at), find_equilibrium(listed, at)
    np.testing.assert_array_equal(found.state, expected.state)
    np.testing.assert_array_equal(found.interval, expected.interval)
    names = [VibratingMasses(above=0.5).name(np.zeros(1, int), cells) for cells in (one, listed)]
    assert names[0] == names[1]


def test_impacts_have_no_units():
    # Lengths by 1e-6 and times by 1e-3, as in SI units of a small machine.
    stop = Stop(1.0, 0.6, 0.5)
    one = MechanicalCells(1.0, **WAVE, stops=[stop])
    length, time = 1e-6, 1e-3
    small = MechanicalCells(
        time**-2,
        damping=0.05 / time,
        force=0.9 * length / time**2,
        frequency=0.8 / time,
        stops=[Stop(1.0, 0.6 * length, 0.5)],
    )
    run = simulate(one, BEGIN, 40.0)
    begin = BEGIN[0] * length, BEGIN[1] * length / time
    scaled = simulate(small, begin, 40.0 * time)
    np.testing.assert_allclose(scaled.state[0] / length, run.state[0], rtol=1e-9)
    assert scaled.steps == run.steps


def test_an_impact_is_part_of_a_cycle():
    cells = MechanicalCells(1.0, **WAVE, stops=[Stop(1.0, 0.6, 0.5)])
    cycle = find_limit_cycle(cells, guess=simulate(cells, BEGIN, 100.0))
    # Free flight contracts areas by exp(-c T), each impact by R^2.
    area = 0.25 * np.exp(-0.05 * float(cycle.period))
    assert abs(np.prod(cycle.multipliers)) == pytest.approx(area, rel=1e-9)


@pytest.mark.parametrize("restitution", [0.3, 0.9])
def test_bounces_that_accumulate_are_named_where_they_end(restitution: float):
    floor = Stop(-1.0, gap=0.5, restitution=restitution)
    ball = MechanicalCells(0.0, force=lambda t: -1.0, stops=[floor])
    run = simulate(ball, (jnp.zeros(1), jnp.zeros(1)), 300.0, throw=False)
    assert run.result == Result.bounces_accumulate
    # Falls for 1, and then bounces for 2 R, 2 R^2, ...
    assert run.t == pytest.approx(1.0 + 2.0 * restitution / (1.0 - restitution), rel=1e-9)


def test_gradients_of_impacts_releases_and_landings():
    names = ["stops[0].restitution", "stops[1].gap", "mu_kinetic", "force"]

    def end(a):
        cells = RUBS.with_(**dict(zip(names, a, strict=True)))
        x = simulate(cells, BEGIN, 12.0, **TIGHT).state[0][0]
        return x, x

    a = jnp.array([0.3, 0.4, 0.2, 0.9])
    both = jax.jit(jax.jacfwd(end, has_aux=True))
    slopes, _ = both(a)
    h = 1e-5 * np.eye(4)
    differences = [(both(a + one)[1] - both(a - one)[1]) / 2e-5 for one in h]
    np.testing.assert_allclose(slopes, differences, atol=2e-8, rtol=1e-7)


@pytest.mark.long
def test_two_cells_that_are_hit_at_one_time_are_disturbed_apart():
    gap, load = jnp.array([0.6, 0.6]), jnp.ones(2)
    parts: dict[str, Any] = {"belt_speed": 0.3, "friction": StaticKinetic(0.3, 0.2), **WAVE}
    two = MechanicalCells(1.0, normal_load=load, stops=[Stop(1.0, gap, 0.3)], **parts)
    alone = MechanicalCells(1.0, stops=[Stop(1.0, 0.6, 0.3)], **parts)

    def end(cells, start, load, gap):
        cells = cells.with_(normal_load=load, **{"stops[0].gap": gap})
        run = simulate(cells, start, 12.0, **TIGHT)
        return jnp.stack(run.state)

    def of_two(a):
        both = tuple(jnp.tile(part, 2) for part in BEGIN)
        return end(two, both, load.at[0].set(a[0]), gap.at[0].set(a[1]))

    a = jnp.array([1.0, 0.6])
    together = jax.jacfwd(of_two)(a)
    by_itself = jax.jacfwd(lambda a: end(alone, BEGIN, *a)[:, 0])(a)
    assert np.abs(by_itself).min() > 1e-3
    np.testing.assert_allclose(together[:, 0], by_itself, rtol=1e-9)
    np.testing.assert_allclose(together[:, 1], 0.0, atol=1e-12)


def test_numbers_of_parts_are_swept_by_name():
    over = {"contacts[0].mu_static": [0.4, 0.5], "contacts[1].normal_load": [0.7, 0.9]}
    contacts = [Contact((1, 0), StaticKinetic(0.5, 0.3), 1.0, 0.4), Contact((1, -1), Coulomb(0.2))]
    cells = MechanicalCells([[1.0, 0.1], [0.1, 2.0]], contacts=contacts, damping=0.1)
    start = tuple(jnp.zeros((4, 1)))
    quick = {"observe": Amplitude(5.0), "solver": EventDriven(4)}
    found = sweep(cells, start, 10.0, over=over, **quick)
    one = {name: values[1] for name, values in over.items()}
    alone = simulate(cells.with_(**one), start, 10.0, **quick)
    np.testing.assert_allclose(found.amplitude.sel(one), alone.observed, rtol=1e-6)
    assert cells.value_of("contacts[1].normal_load") == 1.0
    with pytest.raises(ValueError, match=r"contacts\[2\]"):
        cells.with_(**{"contacts[2].normal_load": 1.0})


RUBBER, SMOOTH = Coulomb(0.3), Coulomb(0.3).with_(width=0.1)
PAD = Contact(1.0, RUBBER)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Contact((0, 0), Coulomb(0.3)), "not all 0"),
        (lambda: Contact((1, 0), 0.3), "friction law"),
        (lambda: Contact((1, 0), Coulomb(0.3), -1.0), "cannot pull"),
        (lambda: Stop(1.0, 0.5, 0.0), "positive"),
        (lambda: Stop(1.0, 0.5, 1.1), "at most 1"),
        (lambda: MechanicalCells(1.0, stops=[Stop((1, 0), 1.0)]), r"stops\[0\].direction"),
        (lambda: MechanicalCells(1.0, contacts=PAD), "a list"),
        (lambda: MechanicalCells(1.0, friction=RUBBER, contacts=[PAD]), "exclude each other"),
        (lambda: MechanicalCells(1.0, friction=SMOOTH, stops=[Stop(1.0, 1.0)]), "dry friction"),
        (lambda: MechanicalCells(1.0, contacts=[PAD, Contact(1.0, SMOOTH)]), "in all of them"),
        (lambda: simulate(RUBS, (jnp.ones(1), jnp.zeros(1)), 1.0), "beyond"),
    ],
)  # fmt: skip
def test_wrong_contacts_and_stops_are_refused(wrong, message: str):
    with pytest.raises(ValueError, match=message):
        wrong()
