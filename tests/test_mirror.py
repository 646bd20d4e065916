"""A belt that runs the other way: x -> -x, v -> -v, v_d -> -v_d changes nothing.

Every public function that takes a chain is asked about random chains and their mirror images.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from of_models import functions_of_a_model
from systems.orbits import closed_orbit

import jaxchain as jc
from jaxchain.cycles.floquet import liouville_determinant
from jaxchain.cycles.limit_cycle import guess_from_simulation
from jaxchain.localization.patterns import phase_model
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


def start(chain, sign):
    """On the belt and released, so that the middle mass vibrates."""
    x, v = jc.steady_sliding(chain)
    mass = chain.n // 2
    return x.at[mass].set(0.0), v.at[mass].set(sign * jnp.abs(chain.belt_speed))


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


def spectrum(solver):
    def case(chain, sign):
        found = jc.lyapunov_spectrum(
            chain, excited(chain, sign), 60.0, count=3, blocks=4, solver=solver, throw=False
        )
        # Volumes of dry friction have no rate.
        return found.exponents, *([] if solver is DRY else [found.mean_divergence])

    return case


def cycle(chain, sign):
    state, period = guess_from_simulation(chain, start(chain, sign), 0, transient=100.0)
    found = jc.find_limit_cycle(chain, (state, period), mass=0)
    names = ("period", "amplitude", "fastest", "scaled_peak_velocity", "multipliers")
    parts = [getattr(found, name) for name in names]
    return (turned(sign, state), period, turned(sign, found.state), *parts)


def dry_orbit(chain, sign):
    state = jc.simulate(chain, start(chain, sign), 200.0, solver=DRY, rtol=1e-9).state
    orbit = closed_orbit(chain, state, 6.3 / jnp.sqrt(chain.stiffness), solver=DRY)
    return turned(sign, orbit.state), orbit.period, jnp.abs(orbit.multipliers) > 1e-12


def linear(chain, sign):
    state = excited(chain, sign)
    determinant = liouville_determinant(chain, state, 6.0)
    return jc.monodromy_matrix(chain, state, 6.0), determinant


def design(chain):
    change = lambda chain, xi: chain.with_(damping_ratio=xi)  # noqa: E731
    dry = chain.with_(width=None)
    changed = jc.inverse.design(dry, change, 0.05, highest_below=1.7, steps=3)
    return changed.theta, changed.costs


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
LONG = {
    "simulate": run(None),
    "simulate dry": run(DRY),
    "lyapunov_spectrum": spectrum(None),
    "lyapunov_spectrum dry": spectrum(DRY),
    "monodromy_matrix": linear,
}
# The chain's own belt speed has no part in these.
SPEEDLESS = {
    "fold_belt_speed": jc.fold_belt_speed,
    "find_fold": lambda chain: arrays(jc.find_fold(chain)),
    "find_fold dry": lambda chain: arrays(jc.find_fold(chain.with_(width=None))),
    "extrapolated_fold": jc.boundaries.extrapolated_fold,
    "stability_range": lambda chain: arrays(jc.boundaries.stability_range(chain, error_bars=True)),
    "hopf_by_descent": lambda chain: jc.boundaries.hopf_by_descent(chain, steps=20).belt_speed,
    "fold_by_descent": lambda chain: jc.boundaries.fold_by_descent(chain, steps=3).belt_speed,
    "design": design,
}
# Of chains one by one, on the host.
SINGLE = (
    "find_hopf_point", "continue_equilibrium", "find_special_cycle", "find_limit_cycles",
    "cycle_symmetry",
    "continue_cycle", "depinning_belt_speed", "equation_8", "equation_10",
    "find_limit_cycle", "front_speed",
    "gentlest_blow",
    "hopf_points", "identify", "profile", "log_likelihood",
    "phase_model", "sweep", "verdict", "verdicts",
    "guess_from_simulation", "liouville_determinant",
    "predict",
    # Their mirror images are in tests/basins.
    "basin_shares", "sliding_share", "sliding_basin", "blow_of_one_mass", "edge_state",
)  # fmt: skip


def compare(case, chains, tolerance):
    each = eqx.filter_jit(lambda chains, sign: jax.vmap(lambda c: case(c, sign))(chains))
    ahead, back = each(chains, jnp.asarray(1.0)), each(mirrored(chains), jnp.asarray(-1.0))
    leaves, others = (jax.tree_util.tree_leaves_with_path(side) for side in (ahead, back))
    assert leaves
    for (path, a), (_, b) in zip(leaves, others, strict=True):
        assert np.mean(np.isfinite(a)) > 0.5, path
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance, err_msg=str(path))


def test_no_public_function_of_a_chain_is_forgotten():
    cases = {name.split()[0] for name in (*QUICK, *LONG, *SPEEDLESS, *SINGLE)}
    assert functions_of_a_model() <= cases


def test_the_mirror_image_does_the_same():
    def every(chain, sign):
        return {name: case(chain, sign) for name, case in QUICK.items()}

    compare(every, random_chains(), 1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", LONG)
def test_the_mirror_image_is_as_stable(name):
    compare(LONG[name], random_chains(), 1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", SPEEDLESS)
def test_boundaries_do_not_depend_on_the_belt_speed_of_the_chain(name):
    compare(lambda chain, sign: SPEEDLESS[name](chain), random_chains(n=1), 1e-12)


@pytest.mark.long
@pytest.mark.parametrize("case", [cycle, dry_orbit])
def test_the_mirror_image_has_the_same_cycles(case):
    compare(case, random_chains(n=1), 1e-8)


@pytest.mark.long
def test_fronts_and_patterns_are_mirrored():
    chain = jc.paper_chain(24, belt_speed=1.1, width=None)
    block = jc.excited_state(chain, 8, block="centred")
    fronts = [
        jc.localization.front_speed(own, tuple(sign * part for part in block), 300.0)
        for own, sign in ((chain, 1.0), (mirrored(chain), -1.0))
    ]
    assert float(fronts[0].speed) == float(fronts[1].speed) != 0
    assert fronts[0].outcome == fronts[1].outcome
    ring = jc.paper_chain(4, width=0.02)
    models = [phase_model(own) for own in (ring, mirrored(ring))]
    np.testing.assert_allclose(models[0].interaction, models[1].interaction, atol=1e-8)
    assert float(models[0].period) == pytest.approx(float(models[1].period), abs=1e-9)
