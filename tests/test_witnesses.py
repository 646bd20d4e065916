"""The witness of the non-smooth chain: exact cases, energy, and the chain away from the belt."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from witnesses import event_driven, numbers, numbers_of

from jaxchain import (
    Chain,
    Coulomb,
    ExponentialDecay,
    TanhFriction,
    WeakeningStrengthening,
)

# Amplitude, period and stick time of the paper's single oscillator at three belt speeds, from a
# Taylor series of the slip phase in 28 digits (mpmath's `odefun` and `findroot`).
CYCLES = {
    0.2: (0.44518421130240715, 8.210014578575952, 3.4433543998071224),
    1.3625: (1.4705944227640499, 6.3332387190989333, 0.63225465229808839),
    1.75: (1.7786981688643133, 6.3030267574377938, 0.23998462891947786),
}


def stiffness_matrix(n, stiffness, coupling, ends):
    K = np.diag(np.broadcast_to(stiffness, n)).astype(float)
    springs = n if ends == "cyclic" else n - 1
    for i, c in enumerate(np.broadcast_to(0.0 if coupling is None else coupling, springs)):
        stretch = np.eye(n)[i] - np.eye(n)[(i + 1) % n]
        K += c * np.outer(stretch, stretch)
    return K


@pytest.mark.parametrize("belt", CYCLES)
def test_the_papers_oscillator_has_the_cycle_of_a_taylor_series(belt):
    cycle = event_driven.vibrating_cycle(numbers(belt_speed=belt))
    assert cycle is not None
    np.testing.assert_allclose(cycle, CYCLES[belt], rtol=0, atol=3e-13)


def test_the_belts_work_is_what_is_lost_and_what_is_stored():
    n, belt, coupling = 3, 0.8, 0.1
    chain = numbers(n, belt_speed=belt, coupling=coupling)
    K = stiffness_matrix(n, 1.0, coupling, "cyclic")
    x, v = np.array([3.5, 1.0, -1.5]), np.array([0.0, 0.8, 0.0])
    events = event_driven.integrate(chain, x, v, 15.0).events
    assert {e.kind for e in events} == {"stick", "forward", "backward"}
    edges = np.unique([0.0, *(e.time for e in events), *range(16)])
    nodes, weights = np.polynomial.legendre.leggauss(12)
    length = np.diff(edges)
    times = (edges[:-1, None] + length[:, None] * (nodes + 1) / 2).ravel()
    weights = (length[:, None] * weights / 2).ravel()
    run = event_driven.integrate(chain, x, v, 15.0, times=times)
    w = run.sampled_v - belt
    holding = 0.1 * run.sampled_v + run.sampled_x @ K
    sliding = -(0.5 + 0.5 * np.exp(-np.abs(w) / 0.5)) * np.sign(w)
    friction = np.where(w == 0, holding, sliding)
    assert (np.abs(holding[w == 0]) <= 1 + 1e-12).all()
    assert 0.1 < (w == 0).mean() < 0.9
    belt_work = weights @ (friction * belt).sum(1)
    lost = weights @ (0.1 * run.sampled_v**2 - friction * w).sum(1)
    stored = [(b @ b + a @ K @ a) / 2 for a, b in ((x, v), (run.x, run.v))]
    assert belt_work > 1
    assert belt_work == pytest.approx(lost + stored[1] - stored[0], abs=1e-11)


CHAINS = [
    Chain(
        3,
        TanhFriction(ExponentialDecay(np.array([1.0, 0.9, 1.1]), 0.5, 0.4), 1e-3),
        belt_speed=1.2,
        damping_ratio=np.array([0.05, 0.1, 0.02]),
        coupling=np.array([0.1, 0.3]),
        stiffness=np.array([1.0, 2.0, 1.5]),
        normal_load=np.array([1.0, 0.5, 2.0]),
        ends="free",
    ),
    Chain(2, TanhFriction(WeakeningStrengthening(1.0, 0.5, 0.5, 0.1), 1e-3), -0.9, coupling=0.3),
    Chain(4, TanhFriction(Coulomb(0.4), 1e-3), 1.0, coupling=np.array([0.1, 0.2, 0.3, 0.4])),
    Chain(1, TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 1e-3), 1.5, coupling=0.2),
]


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: f"n={chain.n}")
def test_away_from_the_belts_speed_a_chain_and_its_witnesses_are_the_same(chain):
    # There tanh(w / width) is 1 to rounding, and both solve the same equations.
    x, v = np.linspace(0.5, -0.2, chain.n), np.linspace(-0.1, 0.1, chain.n)
    field = jax.jit(lambda y: jnp.concatenate(chain(0.0, (y[: chain.n], y[chain.n :]))))
    start = np.concatenate([x, v])
    path = solve_ivp(
        lambda _, y: np.asarray(field(y)), (0.0, 0.5), start, "DOP853", rtol=1e-11, atol=1e-12
    )
    own = path.y[:, -1]
    assert np.abs(own[chain.n :] - float(chain.belt_speed)).min() > 0.02
    events = event_driven.integrate(numbers_of(chain), x, v, 0.5)
    np.testing.assert_allclose(np.concatenate([events.x, events.v]), own, rtol=0, atol=1e-10)
