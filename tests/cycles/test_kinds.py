"""The equations and tests of special points, on monodromy matrices that are known."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Rodas5P, paper_chain
from jaxchain.cycles.shooting import Shooting
from jaxchain.cycles.symmetry import symmetry_breaking_basis
from jaxchain.kinds.changes import Change
from jaxchain.kinds.fold import Fold
from jaxchain.kinds.kind import Unknowns
from jaxchain.kinds.multipliers import PeriodDoubling, SymmetryBreaking, Torus

RNG = np.random.default_rng(4)
BASIS, OTHER = RNG.normal(size=(2, 4, 4)) + 2 * np.eye(4)
KEPT = ((0, 1, 2, 3), None)


def seen(*multipliers, **parts):
    return SimpleNamespace(multipliers=np.array(multipliers, complex), **parts)


def known(block):
    """M(u) with the eigenvalues of block(u), 2 x 2, and two that move beside them."""

    def matrix(u):
        inner = jnp.diag(jnp.array([0.0, 0.0, 0.3, -0.4])).at[:2, :2].set(block(u))
        return (BASIS + 0.1 * u[0] * OTHER) @ inner @ jnp.linalg.inv(BASIS + 0.1 * u[0] * OTHER)

    return matrix


def equations(kind, matrix, kappa=0.2):
    """u -> (g, its slopes by `fixed`, those by differences)."""
    orbit = SimpleNamespace(
        residual=lambda u, p: matrix(0.0 * u) @ u + 0.5 * u**2,
        image=lambda z, one: matrix(z.u) @ one,
        breaking_block=lambda part, kept: (jnp.eye(4), part, 1.0),
        breaking_image=lambda z, one, kept: matrix(z.u) @ one,
    )

    def unknowns(u):
        return Unknowns(u, (jnp.zeros(()),), jnp.asarray(kappa))

    def both(u):
        M = jax.jacfwd(lambda u: orbit.residual(u, 0.0))(u) if kind == Fold() else matrix(u)
        return kind.equation(orbit, unknowns(u), M, SimpleNamespace(monodromy=M, part=M))

    @jax.jit
    def at(u):
        g, vectors = both(u)
        return g, jax.jacfwd(lambda u: kind.fixed(orbit, unknowns(u), vectors))(u)

    def with_differences(u):
        near = [(at(u + s)[0] - at(u - s)[0]) / 2e-6 for s in 1e-6 * np.eye(u.size)]
        return *at(u), np.stack(near, axis=-1)

    return with_differences


def pair(u):
    """A pair r exp(+-i phi), u = (r, phi)."""
    r, phi = u[0], u[1]
    return r * jnp.array([[jnp.cos(phi), -jnp.sin(phi)], [jnp.sin(phi), jnp.cos(phi)]])


def test_a_torus_has_a_pair_on_the_unit_circle_with_this_mean():
    at = equations(Torus(), known(pair), 0.4)
    for r, phi in ((1.0, 1.1), (0.9, 0.7)):
        g, slopes, near = at(np.array([r, phi]))
        exact = [[2 * r, 0.0], [np.cos(phi), -r * np.sin(phi)]]
        np.testing.assert_allclose(g, [r**2 - 1, r * np.cos(phi) - 0.4], atol=1e-12)
        np.testing.assert_allclose(slopes[:, :2], exact, atol=1e-9)
        np.testing.assert_allclose(near, exact, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "at"), [(PeriodDoubling(), -1.0), (SymmetryBreaking(KEPT), 1.0), (Fold(), 0.0)]
)
def test_the_least_singular_value_passes_zero_with_its_multiplier(kind, at):
    def block(u):
        return jnp.array([[at + u[0], u[1]], [0.0, 1.7]])

    constant = known(lambda u: jnp.diag(jnp.array([0.0, 1.7])))
    solve = equations(kind, constant if kind == Fold() else known(block))
    u, one = np.array([0.0, 0.2, 0.1, -0.3]) * (kind != Fold()), np.eye(4)[0]
    values = [float(solve(u + d * one)[0][0]) for d in (-1e-3, 0.0, 1e-3)]
    _, slopes, near = solve(u + 1e-7 * one)  # beside the zero, where the sign is known
    np.testing.assert_allclose(slopes, near, rtol=1e-5, atol=1e-7)
    assert values[0] * values[2] < 0
    assert abs(values[1]) < 1e-12


def test_tests_change_their_sign_at_the_unit_circle_alone():
    inside, outside = 0.9 * np.exp(0.3j), 1.1 * np.exp(0.3j)

    def torus(*multipliers):
        return Torus().test(None, seen(*multipliers))

    assert torus(inside, np.conj(inside), 0.2) * torus(outside, np.conj(outside), 0.2) < 0
    # A pair outside or inside becomes real: the same sign.
    for size in (0.9, 1.2):
        pair, real = size + 1e-9j, (size + 0.01, size - 0.01)
        assert torus(pair, np.conj(pair), 0.2) * torus(*real, 0.2) > 0
    on = np.exp(0.3j)
    assert Torus().happens(seen(on, np.conj(on), 0.2))
    # mu_1 mu_2 = 1 for real ones is no torus, though the product vanishes there.
    assert not Torus().happens(seen(2.0, 0.5, 0.2))
    assert torus(2.0, 0.5, 0.2) == 0
    doubling = [PeriodDoubling().test(None, seen(mu, 0.3, 0.1)) for mu in (-0.9, -1.1, -1.0)]
    assert doubling[0] * doubling[1] < 0
    assert doubling[2] == 0
    for kind, name, at in ((Fold(), "1:1", 1.0), (PeriodDoubling(), "1:2", -1.0)):
        test = kind.curve_tests(SimpleNamespace(curve_tests=lambda folds: {}))[name]
        one, other = (test(None, 0.0, None, seen(at, at + d, 0.3)) for d in (0.01, -0.01))
        assert one * other < 0
    lines = Torus().curve_tests(SimpleNamespace(curve_tests=lambda folds: {}))
    for n in (1, 2, 3, 4):  # kappa is the last unknown but one
        assert abs(lines[f"1:{n}"](np.array([0.3, np.cos(2 * np.pi / n), 1.4]))) < 1e-15


def test_a_grazing_that_is_followed_is_a_fold_of_a_slip_cycle_alone():
    refined, rough = SimpleNamespace(refined=True), SimpleNamespace(refined=False)
    for slips, name in ((True, "grazing fold"), (False, "grazing")):
        orbit = SimpleNamespace(special=np.array([0, 0, 0]), slips=slips)
        kind, unknowns = Change("grazing", turns=True).followed(orbit, refined)
        assert (kind.name, unknowns) == (name, [])
        with pytest.raises(ValueError, match="not solved for to all digits"):
            Change("grazing").followed(orbit, rough)


def test_the_symmetry_test_sees_what_breaks_the_symmetry_alone():
    basis = symmetry_breaking_basis((0, 1, 0))
    np.testing.assert_allclose(basis.T @ basis, np.eye(2), atol=1e-15)
    np.testing.assert_allclose(basis[[0, 3]], -basis[[2, 5]], atol=1e-15)
    np.testing.assert_allclose(basis[[1, 4]], 0.0, atol=1e-15)
    growth = np.diag([0.5, 0.4])
    M = np.eye(6) + basis @ (growth - np.eye(2)) @ basis.T  # 1 for symmetric disturbances
    shooting = Shooting(paper_chain(3, width=0.05), 1e-9, Rodas5P(), 1, (0, 1, 0))
    test = SymmetryBreaking(((0, 1, 2), None)).test(
        shooting, seen(*np.ones(5), part=jnp.asarray(M))
    )
    assert test == pytest.approx(0.5)
