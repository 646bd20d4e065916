"""The chain's equations against the paper's, written out mass by mass."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import (
    Chain,
    ExponentialDecay,
    TanhFriction,
    WeakeningStrengthening,
    paper_chain,
    steady_sliding,
)
from jaxchain.model.chain import margins
from jaxchain.model.friction import AbstractFrictionLaw

LAW = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5)


def random_state(n, seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.normal(size=n)), jnp.asarray(rng.normal(size=n))


def mistuned(ends="cyclic", law: AbstractFrictionLaw = LAW):
    n = 6
    return Chain(
        n, TanhFriction(law, 0.05), belt_speed=0.7, damping_ratio=np.linspace(0.01, 0.1, n),
        coupling=np.linspace(0.1, 0.5, n if ends == "cyclic" else n - 1),
        stiffness=np.linspace(0.9, 1.1, n), normal_load=np.linspace(0.5, 1.5, n), ends=ends,
    )  # fmt: skip


CHAINS = {
    "one": paper_chain(1),
    "two": paper_chain(2, belt_speed=1.5, width=1e-3),
    "mistuned ring": mistuned(law=WeakeningStrengthening(1.0, 0.5, 0.5, 0.1)),
    "mistuned, free ends": mistuned("free"),
}


@pytest.mark.parametrize("n", [2, 3])
def test_vector_field_is_equation_5_of_the_paper(n):
    chain = paper_chain(n, belt_speed=1.3, width=0.01)
    x, v = random_state(n)
    x_, v_ = np.asarray(x), np.asarray(v)
    w = v_ - 1.3
    force = -(0.5 + 0.5 * np.exp(-np.abs(w) / 0.5)) * np.tanh(w / 0.01)
    acceleration = [
        force[i] - 0.1 * v_[i] - x_[i] - 0.01 * (2 * x_[i] - x_[(i + 1) % n] - x_[i - 1])
        for i in range(n)
    ]
    dx, dv = chain(0.0, (x, v))
    np.testing.assert_allclose(dx, v_, atol=0)
    np.testing.assert_allclose(dv, acceleration, atol=1e-14)


@pytest.mark.parametrize("name", CHAINS)
def test_the_structured_jacobian_and_steady_sliding(name):
    chain = CHAINS[name]
    n = chain.n

    @jax.jit
    def both(y):
        state = y[:n], y[n:]
        automatic = jax.jacfwd(lambda y: jnp.concatenate(chain(0.0, (y[:n], y[n:]))))
        sliding = steady_sliding(chain)
        return chain.jacobian(0.0, state), automatic(y), sliding, chain(0.0, sliding)

    structured, automatic, (x, v), derivative = both(jnp.concatenate(random_state(n)))
    np.testing.assert_allclose(structured, automatic, atol=1e-13)
    np.testing.assert_allclose(np.stack(derivative), 0.0, atol=1e-14)
    if name == "two":  # steady sliding of the paper is the friction force
        np.testing.assert_allclose(x, 0.5 + 0.5 * np.exp(-3.0), rtol=1e-15)
        assert not v.any()


def test_numbers_are_given_and_changed_by_name():
    assert paper_chain(1).springs is None
    chain: Any = paper_chain(3, 1.2, damping_ratio=0.1, v_ref=0.4, coupling=np.full(3, 0.1))
    assert (float(chain.damping_ratio), float(chain.friction.law.v_ref)) == (0.1, 0.4)
    assert (chain.coupling.shape, float(chain.belt_speed), float(chain.width)) == ((3,), 1.2, 1e-3)
    chain = chain.with_(belt_speed=0.4, width=0.2, mu_static=1.5, coupling=None)
    assert (float(chain.belt_speed), float(chain.width), chain.coupling) == (0.4, 0.2, None)
    assert (float(chain.law.mu_static), float(chain.law.mu_dynamic)) == (1.5, 0.5)
    zero = chain.with_(coupling=0.0).coupling
    assert zero is not None  # which is not the same
    with pytest.raises(ValueError, match=r"does not know \['damping'\]"):
        paper_chain(3, damping=0.1)


def test_a_number_of_the_size_of_si_units_is_warned_of():
    make = partial(Chain, 2, LAW, 1.5)
    for name, value in {"damping_ratio": 12.0, "normal_load": 150.0, "stiffness": 1e5}.items():
        with pytest.warns(UserWarning, match=f"`{name}` is {value:g}, .* SI units"):
            make().with_(**{name: value})
    make(stiffness=100.0, damping_ratio=-1e3, normal_load=100.0)  # warns of nothing


def test_a_law_alone_is_dry_friction():
    chain = Chain(3, LAW, 1.5, 0.05, 0.01, normal_load=np.array([1.0, 2.0, 0.5]))
    assert chain.dry
    smoothed = chain.with_(width=1e-3)
    assert not smoothed.dry
    assert eqx.tree_equal(smoothed.law, LAW)
    assert smoothed.with_(width=None, mu_static=1.2).dry
    assert float(chain.with_(mu_static=1.2).law.mu_static) == 1.2
    assert float(chain.width) == float(chain.stick_speed()) == 0.0
    assert "width" not in chain.parameters()
    # Slower than the belt, as fast, and faster: friction pulls forward, holds, and pulls back.
    v, mu = jnp.array([1.0, 1.5, 2.0]), 0.5 + 0.5 * np.exp(-1.0)
    pull = np.asarray(chain.local_force(0.0, jnp.zeros(3), v)) + 0.1 * np.asarray(v)
    np.testing.assert_allclose(pull, [mu, 0.0, -0.5 * mu], rtol=1e-14)
    own = jnp.ones(3), v
    assert np.all(np.isneginf(chain.excess_force(0.0, own, own, own)))
    # Both kinds agree where tanh is 1, in the force and in its slope.
    w = jnp.array([-1.0, 0.7])
    both = [friction.force_and_slope(w) for friction in (LAW, TanhFriction(LAW, 1e-3))]
    np.testing.assert_allclose(*both, rtol=1e-14)


def test_margins_are_positive_where_the_constructor_accepts_the_numbers():
    """Random numbers on both sides of every edge; damping alone is narrower in searches."""
    names = ["mu_static", "mu_dynamic", "v_ref", "stiffness", "coupling", "normal_load", "width"]
    chain = paper_chain(3, width=1e-2).with_(normal_load=jnp.ones(3))
    rng, accepted = np.random.default_rng(0), 0
    inside = jax.jit(lambda n: jnp.min(jnp.stack(
        [jnp.min(m) for m in margins(chain.with_(**n)).values()])) >= 0)  # fmt: skip
    for _ in range(200):
        numbers = {name: np.where(rng.uniform() < 0.9, 1, -1) * rng.uniform() for name in names}
        numbers["normal_load"] = rng.uniform(-0.1, 1.0, 3)
        try:
            chain.with_(**numbers)
            refused = False
        except ValueError:
            refused = True
        assert bool(inside(jax.tree.map(jnp.asarray, numbers))) != refused, numbers
        accepted += not refused
    assert 20 < accepted < 180
    assert margins(chain.with_(damping_ratio=-0.1))["damping_ratio = 0"] < 0
