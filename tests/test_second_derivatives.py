"""Which derivatives are supported; other errors name an alternative."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import (
    Trajectory,
    continue_cycle,
    find_limit_cycle,
    lyapunov_spectrum,
    paper_chain,
    simulate,
    sweep,
    verdict,
)  # fmt: skip
from jaxchain.boundaries import hopf_points
from jaxchain.localization import phase_model

START = (jnp.full(1, 2.0), jnp.zeros(1))
SMOOTHED, DRY = paper_chain(1, 1.2, 1e-2), paper_chain(1, 1.2, None)
XI = jnp.asarray(0.05)


def last(chain, **options):
    """The displacement at the end of a short run, over the damping ratio."""
    return lambda xi: simulate(chain.with_(damping_ratio=xi), START, 2.0, **options).state[0][0]


def on_the_host(function):
    return lambda xi: jnp.asarray(function(SMOOTHED.with_(damping_ratio=xi)))


@pytest.mark.parametrize(
    ("function", "instead"),
    [
        (lambda c: hopf_points(c).belt_speed[0], "`hopf_belt_speed`"),
        (lambda c: continue_cycle(c, START, 6.0).period[0], "`find_limit_cycle`"),
        (lambda c: phase_model(paper_chain(3, 1.2 + 0 * c.damping_ratio)).period, "`find_limit"),
        (lambda c: verdict(c, START).runs[0].energy, "`simulate`"),
        (lambda c: sweep(c, START, 5.0, over={"belt_speed": [1.0]}).energy, "`jax.vmap`"),
    ],
)
def test_what_runs_on_the_host_says_so(function, instead):
    for transform in (jax.grad, jax.jit):
        with pytest.raises(ValueError, match=f"is traced.*{instead}"):
            transform(on_the_host(function))(XI)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "transform", "error", "instead"),
    [
        (last(SMOOTHED), lambda f: jax.grad(jax.grad(f)), RuntimeError, "jacfwd(jax.grad(f))"),
        (last(SMOOTHED, observe=Trajectory(jnp.ones(1))), jax.hessian, NotImplementedError,
         "jacfwd(jax.jacfwd(f))"),
        (last(SMOOTHED, adjoint=dfx.ForwardMode()), jax.grad, RuntimeError, "leave out `adjoint`"),
    ],
)  # fmt: skip
def test_what_cannot_go_back_says_what_to_take(function, transform, error, instead):
    with pytest.raises(error) as raised:
        jax.eval_shape(transform(function), XI)  # which compiles nothing
    assert instead in str(raised.value)


@pytest.mark.long
def test_exponents_and_cycles_that_cannot_go_back_say_what_to_take():
    def exponent(xi):
        chain = SMOOTHED.with_(damping_ratio=xi)
        return lyapunov_spectrum(chain, START, 20.0, blocks=2, count=1).exponents[0]

    def period(xi):
        return find_limit_cycle(SMOOTHED.with_(damping_ratio=xi)).period

    for function in (jax.grad(exponent), jax.grad(jax.grad(period))):
        with pytest.raises(RuntimeError, match="forward"):
            jax.eval_shape(function, XI)  # which compiles nothing


@pytest.mark.long
@pytest.mark.parametrize("chain", [SMOOTHED, DRY])
def test_second_derivatives_of_runs_agree_with_differences(chain):
    end, step = last(chain, rtol=1e-10), 1e-5
    slope = jax.jit(jax.jacfwd(end))
    difference = (slope(XI + step) - slope(XI - step)) / (2 * step)
    np.testing.assert_allclose(jax.hessian(end)(XI), difference, rtol=1e-4)
