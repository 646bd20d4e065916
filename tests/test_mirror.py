"""A belt that runs the other way: x -> -x, v -> -v, v_d -> -v_d changes nothing.

And what does not touch the layer of smoothing is the same for dry friction and a narrow width.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxchain as jc
from jaxchain.model.initial_states import release_state
from jaxchain.model.sliding import sliding_damping, sliding_eigenvalues, stiffness_matrix

COUNT, N = 20, 3
DRY = jc.EventDriven()


def random_chains(n=N, count=COUNT, seed=0, speeds=(1.2, 1.6)):
    """Chains whose single mass may vibrate, most of them, stacked along axis 0."""
    rng = np.random.default_rng(seed)

    def draw(low, high):
        return jnp.asarray(rng.uniform(low, high, count))

    numbers = {
        "belt_speed": draw(*speeds), "damping_ratio": draw(0.03, 0.07), "width": draw(0.02, 0.05),
        "mu_static": draw(0.9, 1.2), "mu_dynamic": draw(0.4, 0.6), "v_ref": draw(0.4, 0.6),
        "stiffness": draw(0.8, 1.2),
    }  # fmt: skip
    if n > 1:
        numbers["coupling"] = draw(0.003, 0.03)
    return jax.vmap(lambda own: jc.paper_chain(n).with_(**own))(numbers)


def mirrored(chains):
    return eqx.tree_at(lambda c: c.belt_speed, chains, -chains.belt_speed)


def excited(chain, sign):
    return jc.excited_state(chain, 2, amplitude=sign * 2.0, velocity=sign * 0.3)


def arrays(found):
    return eqx.filter(found, eqx.is_array)


def turned(sign, state):
    return jnp.stack(state) * sign


def run(solver):
    def case(chain, sign):
        observe = {
            "amplitude": jc.Amplitude(window=20.0), "stick": jc.StickTime(),
            "path": jc.Trajectory(jnp.linspace(1.0, 59.0, 8)),
        }  # fmt: skip
        found = jc.simulate(chain, excited(chain, sign), 60.0, observe=observe, solver=solver)
        x, v = found.observed["path"]
        return (
            turned(sign, found.state), turned(sign, (x, v)), found.observed["amplitude"],
            found.observed["stick"], found.steps,
        )  # fmt: skip

    return case


QUICK = {
    "complex_modes": lambda chain, sign: (
        jc.boundaries.complex_modes(chain, guess=jc.steady_sliding(chain)).eigenvalues[:, :3]
    ),
    "find_equilibrium": lambda chain, sign: turned(
        sign, jc.boundaries.find_equilibrium(chain, jc.steady_sliding(chain)).state
    ),
    "steady_sliding": lambda chain, sign: turned(sign, jc.steady_sliding(chain)),
    "excited_state": lambda chain, sign: turned(sign, excited(chain, sign)),
    "on_the_belt": lambda chain, sign: turned(sign, jc.model.on_the_belt(chain)),
    "release_state": lambda chain, sign: turned(sign, release_state(chain, 2)),
    "stiffness_matrix": lambda chain, sign: stiffness_matrix(chain),
    "sliding_damping": lambda chain, sign: sliding_damping(chain, chain.belt_speed),
    "sliding_eigenvalues": lambda chain, sign: jnp.sort(
        sliding_eigenvalues(chain, chain.belt_speed).real
    ),
    "growth_rate": lambda chain, sign: jc.model.growth_rate(chain, chain.belt_speed),
    "hopf_belt_speed": lambda chain, sign: jc.hopf_belt_speed(chain),
    "choose_numerics": lambda chain, sign: jc.simulation.choose_numerics(chain, 1e-2).width,
    "mistuned_chain": lambda chain, sign: jc.localization.mistuned_chain(chain, 3, 0.1).stiffness,
    "linear_modes": lambda chain, sign: arrays(jc.localization.linear_modes(chain)),
}  # fmt: skip


def every(chain, sign):
    return {name: case(chain, sign) for name, case in QUICK.items()}


def with_width(chains, width):
    return jax.vmap(lambda chain: chain.with_(width=width))(chains)


def compare(case, chains, others, sign, tolerance):
    each = eqx.filter_jit(lambda chains, sign: jax.vmap(lambda c: case(c, sign))(chains))
    ahead, back = each(chains, jnp.asarray(1.0)), each(others, jnp.asarray(sign))
    leaves, others = (jax.tree_util.tree_leaves_with_path(side) for side in (ahead, back))
    assert leaves
    for (path, a), (_, b) in zip(leaves, others, strict=True):
        assert np.mean(np.isfinite(a)) > 0.5, path
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance, err_msg=str(path))


def test_the_mirror_image_does_the_same():
    chains = random_chains()
    compare(every, chains, mirrored(chains), -1.0, 1e-9)


@pytest.mark.long
@pytest.mark.parametrize("solver", [None, DRY])
def test_the_mirror_image_runs_alike(solver):
    chains = random_chains()
    compare(run(solver), chains, mirrored(chains), -1.0, 1e-9)


def test_dry_friction_is_the_limit_of_a_narrow_width():
    chains = random_chains()
    compare(every, with_width(chains, None), with_width(chains, 1e-4), 1.0, 1e-9)
