"""Several contacts of a cell, belts under each mass, and rigid stops."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from witnesses.contacts import Rigid

from jaxchain import EventDriven, Result, StickTime, simulate
from jaxchain.model import Contact, Coulomb, MechanicalCells, StaticKinetic, Stop

# A series shorter than what suits the tolerance takes more steps, but compiles fast.
TIGHT: dict[str, Any] = {"rtol": 1e-13, "atol": 1e-14, "solver": EventDriven(9)}
QUICK: dict[str, Any] = {"solver": EventDriven(4)}
# A block on a belt, and two blocks on it.
DIRECTIONS = ((1, 0, 0), (-1, 1, 0), (-1, 0, 1))


@jax.jit
def blocks(K, M, mu_static, mu_kinetic, loads, belts, force, frequency) -> MechanicalCells:
    laws = [StaticKinetic(mu_static[i], mu_kinetic[i]) for i in range(3)]
    contacts = [Contact(*row) for row in zip(DIRECTIONS, laws, loads, belts, strict=True)]
    drive: dict[str, Any] = {"force": force, "frequency": frequency}
    return MechanicalCells(K, mass=M, damping=0.02, contacts=contacts, **drive)


def of_witness(contacts):
    """Contacts (e, mu_static, mu_kinetic, load, belt) as SciPy's program wants them."""
    return [
        (np.array(e, float), mu, lambda w, k=k: k, lambda t, q, v, p=p: p, lambda t, b=b: b)
        for e, mu, k, p, b in contacts
    ]


def time_of_sticking(events, contact: int, t1: float) -> float:
    """By the modes after each event."""
    ends = zip(events, [*events[1:], (t1, None)], strict=True)
    return sum(later - t for (t, mode), (later, _) in ends if mode[contact] == 0)


@pytest.mark.parametrize(
    ("seed", "drops", "upper"), [(1, False, (-0.1, 0.1)), (6, True, (-0.1, -0.2))]
)
def test_three_contacts_agree_with_scipy(seed: int, drops: bool, upper: tuple):
    draw = np.random.default_rng(seed)
    shear = draw.uniform(0.3, 1, (3, 3))
    K = np.diag(draw.uniform(0.8, 3, 3)) - 0.1 * (shear + shear.T) * (1 - np.eye(3))
    M, mu_static = np.diag(draw.uniform(0.5, 2, 3)), draw.uniform(0.3, 0.7, 3)
    mu_kinetic = mu_static * draw.uniform(0.4, 1, 3) if drops else mu_static
    loads, belts = np.array([2.5, 0.7, 0.6]), np.array([draw.uniform(0.2, 0.6), *upper])
    force, omega = np.array([0, *draw.uniform(0.3, 1.2, 2)]), draw.uniform(0.4, 1.3)
    start = draw.normal(0, 0.3, (6, 1))
    cells = blocks(K, M, mu_static, mu_kinetic, loads, belts, force, omega)
    watch = [StickTime(contact=i) for i in (0, 1)]
    run = simulate(cells, tuple(jnp.asarray(start)), 30.0, observe=watch, **TIGHT)
    contacts = of_witness(zip(DIRECTIONS, mu_static, mu_kinetic, loads, belts, strict=True))
    witness = Rigid(M, lambda t, q, v: force * np.cos(omega * t) - K @ q - 0.02 * v, contacts)
    expected, events = witness.run(start[:3, 0], start[3:, 0], 30.0)
    assert len(events) >= 20
    assert not witness.ambiguous
    np.testing.assert_allclose(np.ravel(run.state), expected, atol=1e-11)
    stuck = [time_of_sticking(events, i, 30.0) for i in (0, 1)]
    np.testing.assert_allclose(np.ravel(run.observed), stuck, atol=1e-8)
    assert max(stuck) > 1.0
    assert run.steps < 500


def test_cells_side_by_side_have_numbers_of_their_own():
    """Two masses between two belts each, which run against each other."""
    laws = StaticKinetic(jnp.array([0.5, 0.4]), 0.3), StaticKinetic(0.3, jnp.array([0.2, 0.1]))
    loads, belts = np.array([[1.0, 0.8], [0.5, 0.7]]), (0.3, -0.2)
    contacts = [Contact(1.0, *row) for row in zip(laws, loads, belts, strict=True)]
    two = MechanicalCells(
        1.0, damping=0.03, coupling=0.05, contacts=contacts, force=0.7, frequency=0.9
    )
    y = np.array([[0.1, 0.2], [0.0, 0.3]])
    run = simulate(two, tuple(map(jnp.asarray, y)), 20.0, **TIGHT)
    # A ring of two meets itself on both sides.
    K, units = np.eye(2) + 0.1 * np.array([[1, -1], [-1, 1]]), np.eye(2)
    force = lambda t, q, v: 0.7 * np.cos(0.9 * t) - K @ q - 0.03 * v
    numbers = zip((0.5, 0.4, 0.3, 0.3), (0.3, 0.3, 0.2, 0.1), loads.ravel(), strict=True)
    each = [(units[i % 2], *row, belts[i // 2]) for i, row in enumerate(numbers)]
    expected, events = Rigid(units, force, of_witness(each)).run(y[0], y[1], 20.0)
    assert len(events) >= 10
    np.testing.assert_allclose(np.ravel(run.state), expected, atol=1e-11)


def test_contacts_that_hold_the_same_twice_are_named():
    law = StaticKinetic(0.5, 0.3)
    twice = [Contact(1.0, law, 1.0, 0.2), Contact(1.0, law, 0.5, 0.2)]
    cells = MechanicalCells(1.0, damping=0.05, contacts=twice)
    zero = np.zeros(1)
    run = simulate(cells, (np.array([0.1]), zero), 20.0, throw=False, **QUICK)
    assert run.outcome == "forces_not_unique"
    assert run.t < 1.0  # where it first sticks
    # At rest from the start, or pulled away from both; and on belts of two speeds.
    for speeds, x, t1, outcome in (
        ((0.0, 0.0), 0.5, 1.0, "forces_not_unique"), ((0.0, 0.0), 1.5, 1.0, "successful"),
        ((0.2, -0.1), 0.1, 20.0, "successful"),
    ):  # fmt: skip
        belts = {f"contacts[{k}].belt_speed": speed for k, speed in enumerate(speeds)}
        run = simulate(cells.with_(**belts), (np.array([x]), zero), t1, throw=False, **QUICK)
        assert run.outcome == outcome


IMPACTS: dict[str, Any] = {"stops": [Stop(1.0, 0.6, 0.3), Stop(-1.0, 0.4, 0.7)]}
WAVE: dict[str, Any] = {"force": 0.9, "frequency": 0.8, "damping": 0.05}
RUBS = MechanicalCells(1.0, friction=StaticKinetic(0.3, 0.2), belt_speed=0.3, **WAVE, **IMPACTS)
BEGIN = jnp.array([0.1]), jnp.array([0.2])


NAMES = "stops[0].restitution", "stops[1].gap", "mu_kinetic", "force"


@jax.jit
def end_and_slopes(a, belt_speed, t1):
    """(x, v and time of sticking of RUBS, its derivatives by `NAMES` and the start, steps)."""

    def end(a):
        cells = RUBS.with_(belt_speed=belt_speed, **dict(zip(NAMES, a[:4], strict=True)))
        run = simulate(cells, (a[4:5], a[5:]), t1, observe=StickTime(), throw=False, **TIGHT)
        return jnp.concatenate([*run.state, run.observed]), run.steps

    def twice(a):
        found, steps = end(a)
        return found, (found, steps)

    slopes, (found, steps) = jax.jacfwd(twice, has_aux=True)(a)
    return found, slopes, steps


USUAL = np.array([0.3, 0.4, 0.2, 0.9, 0.1, 0.2])


def test_impacts_agree_with_scipy():
    found, _, steps = end_and_slopes(USUAL, 0.1, 60.0)
    one = np.ones(1)
    contacts, stops = of_witness([(one, 0.3, 0.2, 1.0, 0.1)]), [(one, 0.6, 0.3), (-one, 0.4, 0.7)]
    force = lambda t, q, v: 0.9 * np.cos(0.8 * t) - q - 0.05 * v
    expected, events = Rigid(1.0, force, contacts, stops).run([0.1], [0.2], 60.0)
    assert len(events) > 40
    stuck = time_of_sticking(events, 0, 60.0)
    assert stuck > 1.0
    np.testing.assert_allclose(found[:2], expected, atol=1e-11)
    assert found[2] == pytest.approx(stuck, abs=1e-8)
    assert steps < 1000


def test_gradients_of_impacts_releases_and_landings():
    _, slopes, _ = end_and_slopes(USUAL, 0.3, 12.0)
    differences = [
        (end_and_slopes(USUAL + h, 0.3, 12.0)[0] - end_and_slopes(USUAL - h, 0.3, 12.0)[0]) / 2e-5
        for h in 1e-5 * np.eye(6)
    ]
    np.testing.assert_allclose(slopes, np.transpose(differences), atol=2e-7, rtol=1e-6)


@pytest.mark.parametrize("restitution", [0.3, 0.9])
def test_bounces_that_accumulate_are_named_where_they_end(restitution: float):
    floor = Stop(-1.0, gap=0.5, restitution=restitution)
    ball = MechanicalCells(0.0, force=lambda t: -1.0, stops=[floor])
    run = simulate(ball, (jnp.zeros(1), jnp.zeros(1)), 300.0, throw=False, **QUICK)
    assert run.result == Result.bounces_accumulate
    # Falls for 1, and then bounces for 2 R, 2 R^2, ...
    assert run.t == pytest.approx(1.0 + 2.0 * restitution / (1.0 - restitution), rel=1e-9)


@pytest.mark.long
def test_two_cells_that_are_hit_at_one_time_are_disturbed_apart():
    def end(a, n):
        """Of n equal cells, whose first one has the load and the gap a."""
        load, gap = (jnp.array([a[k], usual])[:n] for k, usual in ((0, 1.0), (1, 0.6)))
        cells = MechanicalCells(
            1.0, friction=StaticKinetic(0.3, 0.2), belt_speed=0.3, normal_load=load,
            stops=[Stop(1.0, gap, 0.3)], **WAVE,
        )  # fmt: skip
        return jnp.stack(
            simulate(cells, tuple(jnp.tile(y, n) for y in BEGIN), 12.0, **TIGHT).state
        )

    alone, together = (jax.jacfwd(partial(end, n=n))(jnp.array([1.0, 0.6])) for n in (1, 2))
    assert np.abs(alone).min() > 1e-3
    np.testing.assert_allclose(together[:, 0], alone[:, 0], rtol=1e-9)
    np.testing.assert_allclose(together[:, 1], 0.0, atol=1e-12)


RUBBER, SMOOTH = Coulomb(0.3), Coulomb(0.3).with_(width=0.1)
PAD = Contact(1.0, RUBBER)


def test_wrong_contacts_and_stops_are_refused():
    cases: list[tuple[dict[str, Any], str]] = [
        ({"stops": [Stop((1, 0), 1.0)]}, r"stops\[0\].direction"),
        ({"friction": RUBBER, "contacts": [PAD]}, "exclude each other"),
        ({"friction": SMOOTH, "stops": [Stop(1.0, 1.0)]}, "dry friction"),
        ({"contacts": [PAD, Contact(1.0, SMOOTH)]}, "in all of them"),
    ]
    for parts, message in cases:
        with pytest.raises(ValueError, match=message):
            MechanicalCells(1.0, **parts)
    with pytest.raises(ValueError, match="beyond"):
        simulate(RUBS, (jnp.ones(1), jnp.zeros(1)), 1.0)
