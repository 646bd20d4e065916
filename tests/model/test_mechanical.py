"""Cells from matrices and laws, with dry and smoothed friction."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from witnesses.contacts import Rigid

from jaxchain import Coulomb, EventDriven, ExponentialDecay, simulate, sweep
from jaxchain.boundaries import find_equilibrium
from jaxchain.model import AbstractCells, Chain, MechanicalCells

# Of low order, which compiles sooner.
QUICK: dict[str, Any] = {"solver": EventDriven(5), "rtol": 1e-12}
LAW = ExponentialDecay(1.0, 0.5, 0.5)


def cubic(elongations):
    return tuple(0.3 * e**3 for e in elongations)


def two_of_each(**changes) -> MechanicalCells:
    """Three cells of two displacements with every part that there is."""
    numbers = {
        "stiffness": [[1.0, 0.3], [0.1, 2.0]], "mass": [[1.0, 0.2], [0.2, 0.7]],
        "damping": [0.05, 0.1], "coupling": [[0.2, 0.0], [0.05, 0.1]],
        "coupling_damping": [[0.03, 0.0], [0.01, 0.05]], "force": [0.1, 0.3],
        "frequency": 1.3, "belt_speed": 0.4, "normal_load": [1.0, 0.8, 1.2],
    }  # fmt: skip
    laws = {"spring": cubic, "local_force": lambda q, v: (-0.2 * q[1] * q[0], -0.1 * v[1] ** 3)}
    return MechanicalCells(**{"friction": LAW, **numbers, **laws, **changes})


START = (
    jnp.array([0.5, -0.2, 1.0]), jnp.array([0.1, 0.0, -0.3]),
    jnp.array([0.4, 0.0, -0.2]), jnp.array([0.0, 0.5, 0.1]),
)  # fmt: skip


def by_events(cells: MechanicalCells, t1: float) -> tuple[np.ndarray, list]:
    """(The state at t1, the events), by SciPy, of three cells as one of six displacements."""
    K, C, B = (np.asarray(a) for a in (cells.stiffness, cells.coupling, cells.coupling_damping))
    D, load, speed = np.asarray(cells.damping), np.asarray(cells.normal_load), 0.4

    def force(t, q, v):
        q, v = q.reshape(2, 3), v.reshape(2, 3)
        ahead, behind = np.roll(q, -1, 1) - q, q - np.roll(q, 1, 1)
        h = C @ (ahead - behind) + 0.3 * (ahead**3 - behind**3) - D[:, None] * v
        h += B @ (np.roll(v, -1, 1) + np.roll(v, 1, 1) - 2 * v) - np.einsum("kij,jk->ik", K, q)
        h += np.stack([-0.2 * q[1] * q[0], -0.1 * v[1] ** 3])
        return np.ravel(h + np.array([[0.1], [0.3]]) * np.cos(1.3 * t))

    mu = lambda s: 0.5 + 0.5 * np.exp(-s / 0.5)
    rows = np.eye(6)[3 * cells.sliding :]
    contacts = [(rows[k], 1.0, mu, lambda *_, k=k: load[k], lambda t: speed) for k in range(3)]
    start = np.concatenate(START)
    return Rigid(np.kron(cells.mass, np.eye(3)), force, contacts).run(start[:6], start[6:], t1)


def test_dry_friction_at_one_of_two_displacements_agrees_with_scipys_events():
    each = np.array([1.0, 0.9, 1.2])[:, None, None] * np.array([[1.0, 0.3], [0.1, 2.0]])
    cells = two_of_each(sliding=1, stiffness=each)
    expected, events = by_events(cells, 12.0)
    assert len(events) >= 4
    found = simulate(cells, START, 12.0, **QUICK).state
    np.testing.assert_allclose(np.concatenate(found), expected, atol=1e-9)


def test_one_displacement_is_a_chain():
    rng = np.random.default_rng(0)
    xi, k, p = (rng.uniform(*span, 5) for span in ((0.02, 0.1), (0.5, 1.5), (0.7, 1.2)))
    chain = Chain(5, LAW, 0.7, xi, coupling=0.2, stiffness=k, normal_load=p)
    cells = MechanicalCells(
        k[:, None, None], damping=2 * xi[:, None, None], coupling=0.2, friction=LAW,
        belt_speed=0.7, normal_load=p,
    )  # fmt: skip
    rate = eqx.filter_jit(lambda model, y: model.with_(width=1e-2, mu_dynamic=0.4)(0.0, y))
    start = tuple(jnp.asarray(rng.normal(size=(2, 5))))
    expected, found = (rate(model, start) for model in (chain, cells))
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_one_number_does_not_replace_an_array_over_displacements():
    """It would drive, hold or damp all of them."""
    cells = two_of_each()
    shapes = {"stiffness": "2, 2", "mass": "2, 2", "damping": "2,", "force": "2,"}
    for name, shape in shapes.items():
        match = rf"`{name}` must have shape \({shape}\).*all 2 disp.*name one of them, `{name}"
        for call in (
            lambda number, name=name: cells.with_(**{name: number}),
            jax.jit(lambda number, name=name: cells.with_(**{name: number})),
            lambda number, name=name: sweep(cells, START, 1.0, over={name: [number]}),
        ):
            with pytest.raises(ValueError, match=match):
                call(0.2)
        changed = cells.with_(**{name: 2.0 * getattr(cells, name)}, normal_load=0.5)
        np.testing.assert_array_equal(getattr(changed, name), 2.0 * getattr(cells, name))


def _cubic(k, how):
    """-k q^3 as a function that has k in one of the ways in which Python's functions have one."""
    if how == "closure":
        return lambda q, v: (-k * q[0] ** 3,)
    if how == "nested":
        cube = lambda x: -k * x**3
        return lambda q, v: (cube(q[0]),)
    if how == "default":
        return lambda q, v, k=k: (-k * q[0] ** 3,)
    if how == "keyword":
        return lambda q, v, *, k=k: (-k * q[0] ** 3,)
    return functools.partial(lambda k, q, v: (-k["cube"] * q[0] ** 3,), {"cube": k})


WAYS = ("closure", "nested", "default", "keyword", "partial")


def test_derivatives_pass_through_the_closure_of_a_force():
    """x + k x^3 = mu in steady sliding, so that dx/dk = -x^3 / (1 + 3 k x^2)."""

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def steady(k):
        parts = [_cubic(0.2 * k, how) for how in WAYS]
        force = lambda q, v: (sum(part(q, v)[0] for part in parts),)
        cells = MechanicalCells(
            1.0, damping=0.1, friction=Coulomb(0.8), belt_speed=1.0, local_force=force
        )
        return find_equilibrium(cells, (jnp.zeros(1), jnp.zeros(1))).state[0][0]

    (start, x), (_, slope) = map(np.asarray, steady(np.array([0.0, 0.5])))
    assert start == pytest.approx(0.8, rel=1e-12)
    assert x + 0.5 * x**3 == pytest.approx(0.8, rel=1e-12)
    assert slope == pytest.approx(float(-(x**3) / (1 + 1.5 * x**2)), rel=1e-10)


def test_a_class_has_its_traced_numbers_as_fields():
    def period(k):
        class Cubic(AbstractCells):
            def rate(self, t, left, own, right):
                return own[1], -k * own[0] ** 3

        return simulate(Cubic(), (jnp.ones(1), jnp.zeros(1)), 1.0).state[0][0]

    with pytest.raises(TypeError, match=r"in its closure.*make it a field"):
        jax.grad(period)(1.0)
    assert period(1.0) < 1.0


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"frequency": None}, "Arguments `force` and `frequency` belong together"),
        ({"spring": lambda a, b: (a, b)}, r"`spring` must be a function \(e\) of tuples of 2"),
        ({"spring": lambda e: (e[0] + 1.0, e[1])}, "`spring` must return forces that vanish"),
        ({"local_force": lambda q, v: q[:1]}, "that returns a tuple of 2 forces"),
        ({"n": 4}, "Argument `normal_load` has 3 entries, but there are `n` = 4 cells"),
    ],
)
def test_bad_parts_are_refused(changes, names):
    with pytest.raises(ValueError, match=names):
        simulate(two_of_each(**changes), START, 1.0)


def test_a_force_without_a_series_is_refused():
    cells = MechanicalCells(1.0, friction=LAW, local_force=lambda q, v: (jax.lax.lgamma(q[0]),))
    with pytest.raises(ValueError, match="in a Taylor series: no rule for `lgamma`"):
        simulate(cells, (jnp.ones(1), jnp.zeros(1)), 1.0)


def test_a_release_accelerates_by_the_greatest_friction():
    cells = two_of_each(friction=LAW.with_(width=1e-2))
    share = np.linalg.inv(np.asarray(cells.mass))[cells.sliding, cells.sliding]
    found: Any = cells.release_acceleration()
    np.testing.assert_allclose(found, share * np.array([1.0, 0.8, 1.2]), rtol=1e-12)
    assert two_of_each().release_acceleration() is None
