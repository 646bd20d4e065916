"""The linear stability of steady sliding against the chain's own Jacobian."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Chain, ExponentialDecay, TanhFriction, paper_chain, steady_sliding
from jaxchain.boundaries.hopf_scan import hopf_points
from jaxchain.model.sliding import (
    damping_outweighs,
    dry_damping,
    growth_rate,
    has_uniform_damping,
    sliding_damping,
    sliding_eigenvalues,
    stiffness_matrix,
)

LAW = ExponentialDecay(1.0, 0.5, 0.5)


def mistuned(n, ends="cyclic"):
    return Chain(
        n,
        TanhFriction(LAW, 0.1),
        belt_speed=0.3,
        damping_ratio=np.linspace(0.03, 0.08, n),
        coupling=np.linspace(0.1, 0.3, n if ends == "cyclic" else n - 1),
        stiffness=np.linspace(1.0, 2.0, n),
        normal_load=np.linspace(1.0, 1.4, n),
        ends=ends,
    )


@pytest.mark.parametrize(("n", "ends"), [(1, "cyclic"), (3, "free")])
def test_the_parts_make_up_the_jacobian(n, ends):
    chain = mistuned(n, ends)

    @jax.jit
    def computed(chain):
        speed = chain.belt_speed
        damping = [sliding_damping(chain, sign * speed) for sign in (1, -1)]
        jacobian = chain.jacobian(0.0, steady_sliding(chain))
        values, rate = sliding_eigenvalues(chain, speed), growth_rate(chain, speed)
        return jacobian, damping, stiffness_matrix(chain), values, rate

    jacobian, dampings, stiffness, values, rate = computed(chain)
    for damping in dampings:
        np.testing.assert_allclose(-np.diag(damping), jacobian[n:, n:], atol=1e-15)
    np.testing.assert_allclose(-stiffness, jacobian[n:, :n], atol=1e-15)
    wanted = np.sort_complex(np.linalg.eigvals(jacobian))
    np.testing.assert_allclose(np.sort_complex(np.asarray(values)), wanted, atol=1e-13)
    assert float(rate) == pytest.approx(np.real(wanted).max(), abs=1e-13)


def test_numbers_per_mass_count_as_different():
    each = jnp.ones(3)
    assert has_uniform_damping(paper_chain(3).with_(stiffness=each, coupling=each))
    for changes in ({"damping_ratio": 0.05 * each}, {"normal_load": each}, {"width": 0.1 * each},
                    {"v_ref": 0.5 * each}):  # fmt: skip
        assert not has_uniform_damping(paper_chain(3).with_(**changes)), changes


def test_dry_friction_damps_sliding_as_the_law_says_down_to_rest():
    """2 xi + mu'(v_d) = 0.1 - exp(-2 v_d), from the right at rest; no flank of a smoothed law."""
    dry, speeds = paper_chain(1, width=None), np.array([0.0, 1e-12, 0.5, 2.0])
    smoothed = dry.with_(width=0.2)
    damping, layered = jax.jit(jax.vmap(
        lambda speed: (sliding_damping(dry, speed), dry_damping(smoothed, speed))
    ))(speeds)  # fmt: skip
    for found in (damping, layered):  # the latter without its layer
        np.testing.assert_allclose(np.ravel(found), 0.1 - np.exp(-2 * speeds), atol=1e-14)
    assert [bool(damping_outweighs(dry.with_(damping_ratio=xi))) for xi in (0.49, 0.51)] == [
        False, True,
    ]  # fmt: skip
    points = hopf_points(dry, (0.0, 5.0))
    np.testing.assert_allclose(points.belt_speed, np.log(10) / 2, rtol=1e-14)
    assert points.kind == ("weakening friction",)


def test_growth_of_a_uniform_chain_is_that_of_each_of_its_modes():
    chain = paper_chain(5)

    @jax.jit
    def computed(speed):
        rate, slope = jax.value_and_grad(lambda v: growth_rate(chain, v))(speed)
        return sliding_eigenvalues(chain, speed), rate, slope

    for speed in (0.5, 1.5):
        values, rate, slope = computed(speed)
        np.testing.assert_allclose(np.real(values), float(rate), atol=1e-12)
        assert float(slope) == pytest.approx(-np.exp(-2 * speed), rel=1e-12)
