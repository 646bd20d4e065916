"""Disturbances carried along an orbit, against finite differences and exact flows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from jaxchain import EventDriven, excited_state, paper_chain, simulate
from jaxchain.chaos.lyapunov import Frame, advance_frame, bump, orthonormalise, random_basis
from jaxchain.observers.stick_time import MostSticking
from jaxchain.simulation import Method


@eqx.filter_jit
def images_after(solver, observer, field, state, ends, rtol, basis):
    """The images of `basis` at the last of `ends`, carried from one to the next as they are."""
    plan = Method(solver, rtol, 0.1 * rtol, 0.5).plan([observer], ends[-1])
    frame = Frame(plan.begin(field, state, 0.0, ends[-1]), basis)
    for end in ends:
        frame, images = advance_frame(plan, field, frame, end, None)
        frame = Frame(frame.progress, images)
    return frame.progress, frame.basis


def test_orthonormalise_allows_dependent_columns():
    rng = np.random.default_rng(0)
    whole = rng.normal(size=(6, 4))
    bases = jax.jit(orthonormalise)
    full, logs = (np.asarray(part) for part in bases(whole))
    np.testing.assert_allclose(full.T @ full, np.eye(4), atol=1e-14)
    volume = 0.5 * np.linalg.slogdet(whole.T @ whole)[1]
    assert np.sum(logs) == pytest.approx(volume, rel=1e-12)
    # The last two lie in the plane of the first two, or nowhere.
    flat = whole.copy()
    flat[:, 2] = flat[:, :2] @ [2.0, -3.0]
    flat[:, 3] = 0.0
    basis, reduced = (np.asarray(part) for part in bases(flat))
    np.testing.assert_allclose(basis.T @ basis, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(reduced[:2], logs[:2], rtol=1e-12)
    assert np.all(np.isnan(reduced[2:]))


def test_the_weight_is_smooth_and_integrable():
    area = quad(jax.jit(bump), 0.0, 1.0)[0]
    assert area == pytest.approx(0.00702986, rel=1e-5)
    shares = jnp.array([-0.1, 0.0, 0.2, 0.8, 1.0])
    weights, slopes = jax.jit(jax.vmap(jax.value_and_grad(bump)))(shares)
    np.testing.assert_allclose(weights, [0.0, 0.0, np.exp(-6.25), np.exp(-6.25), 0.0], rtol=1e-14)
    assert np.all(np.isfinite(slopes))


@pytest.mark.long
def test_dry_tangents_are_finite_differences_across_events():
    """Sticking and release of three masses, ten periods of it: 1e-6 of the greatest entry."""
    chain = paper_chain(3, 1.2)
    state = excited_state(chain, 2, velocity=0.1)
    basis = random_basis(1, 6, 3)
    flat = jnp.concatenate(state)

    @jax.jit
    @jax.vmap
    def end(flat):
        run = simulate(
            chain, (flat[:3], flat[3:]), 30.0, solver=EventDriven(), rtol=1e-13, throw=False
        )
        return jnp.concatenate(run.state)

    progress, images = images_after(
        EventDriven(), MostSticking(), chain, state, (8.0, 21.0, 30.0), 1e-13, basis
    )
    h = 1e-5
    moves = h * jnp.concatenate([basis.T, -basis.T, jnp.zeros((1, 6))])
    shifted = end(flat[None] + moves)
    differences = (shifted[:3] - shifted[3:6]).T / (2 * h)
    np.testing.assert_allclose(jnp.concatenate(progress.state), shifted[6], atol=1e-11)
    scale = float(jnp.max(jnp.abs(images)))
    assert scale > 0.1
    np.testing.assert_allclose(images, differences, atol=1e-6 * scale)
