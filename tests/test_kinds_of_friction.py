"""Every public function of a chain is asked about dry friction and about smoothed friction.

With a narrow width both answer alike, within what the width costs; what is for smoothed friction
alone says in words what to do with a dry chain.
"""

import inspect
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import cycle_branch

import jaxchain as jc
from jaxchain.plotting.motions import loop, sticking

WIDTH = 1e-4
ONE, THREE = jc.paper_chain(1, width=None), jc.paper_chain(3, width=None)
SPEEDS = np.array([1.4, 1.5])
RING = jc.paper_chain(12, belt_speed=1.05, width=None)


def damped(chain, xi):
    return chain.with_(damping_ratio=xi)


def lab(chain):
    return jc.inverse.Measurements(hopf=(1.15, 0.01), fold=(1.84, 0.01))


def cycle(chain, kind="stable"):
    found = jc.find_limit_cycle(chain, branch=kind)
    return found.period, found.amplitude, found.energy, jnp.abs(found.multipliers)


def edge(chain):
    starts = (jc.excited_state(chain, 1, amplitude=pull) for pull in (0.5, 2.5))
    how = {"time": 200.0, "near": 1e-8, "far": 1e-6, "tolerance": 1e-7, "rtol": 1e-9}
    found = jc.basins.edge_state(chain, *starts, **how)
    return found.amplitude, found.period


def run(chain, start=None, **how):
    observe = jc.Amplitude(window=15.0), jc.StickTime()
    start = start or jc.equation_8(chain, 1)
    found = jc.simulate(chain, start, 30.0, observe=observe, **how)
    return found.observed, found.state


def motion(chain):
    """Amplitudes of a film that closes, and how much of it its mass sticks."""
    times, (x, v) = loop(chain, jc.find_limit_cycle(chain).state, frames=64)
    sticks = sticking(chain, (x, v))
    # One frame of 64 more or less.
    return np.ptp(x), times[-1], np.round(sticks.mean(), 1)


def small_verdict(chain):
    found = jc.verdict(
        chain, jc.excited_state(chain, 1), rtol=1e-6 if chain.dry else 1e-7, seeds=1,
        noise=(1e-6,), first=500.0, longest=500.0, exponent_time=50.0,
    )  # fmt: skip
    assert found.verdict == "periodic"
    return found.runs[0].period


def exponents(chain):
    start = jc.find_limit_cycle(chain).state
    return jc.lyapunov_spectrum(chain, start, 60.0, count=1, blocks=4).exponents


def near_hopf(chain):
    own = chain.with_(belt_speed=1.17)
    point = jc.boundaries.find_hopf_point(own, "belt_speed")
    found = jc.find_limit_cycle(own, point.guess(0.27))
    return found.period, found.amplitude, jnp.abs(found.multipliers)


# Name: what is computed of a chain, and by how much of itself a width of 1e-4 may move it.
QUICK = {
    "steady_sliding": (THREE, jc.steady_sliding, 1e-12),
    "excited_state": (THREE, lambda chain: jc.excited_state(chain, 2), 1e-12),
    "equation_8": (THREE, lambda chain: jc.equation_8(chain, 2), 1e-12),
    "equation_10": (jc.paper_chain(width=None), lambda c: jc.equation_10(c, 2), 1e-12),
    "on_the_belt": (THREE, jc.model.on_the_belt, 1e-12),
    "release_state": (THREE, lambda chain: jc.model.release_state(chain, 2), 1e-12),
    "stiffness_matrix": (THREE, jc.model.stiffness_matrix, 0.0),
    "sliding_damping": (THREE, lambda c: jc.model.sliding_damping(c, c.belt_speed), 1e-12),
    "sliding_eigenvalues": (
        THREE, lambda c: jnp.sort(jc.model.sliding_eigenvalues(c, c.belt_speed)), 1e-10,
    ),
    "growth_rate": (THREE, lambda c: jc.model.growth_rate(c, c.belt_speed), 1e-12),
    "mistuned_chain": (THREE, lambda c: jc.localization.mistuned_chain(c, 3, 0.1).stiffness, 0.0),
    "linear_modes": (THREE, lambda c: jc.localization.linear_modes(c).frequency, 0.0),
    "choose_numerics": (THREE, lambda c: jc.simulation.choose_numerics(c, 1e-2).width, 1e-12),
    "hopf_belt_speed": (THREE, jc.hopf_belt_speed, 1e-12),
    "hopf_points": (THREE, lambda c: jc.boundaries.hopf_points(c, (0.5, 3.0)).belt_speed, 1e-12),
    "complex_modes": (THREE, lambda c: jc.boundaries.complex_modes(c).eigenvalues, 1e-12),
    "find_equilibrium": (THREE, lambda c: jc.boundaries.find_equilibrium(c).state, 1e-12),
    "find_hopf_point": (
        THREE, lambda c: jc.boundaries.find_hopf_point(c, "belt_speed").value, 1e-12,
    ),
    "continue_equilibrium": (
        THREE,
        lambda c: jc.boundaries.continue_equilibrium(
            c, None, "belt_speed", (1.0, 1.6)
        ).of_kind("hopf")[0].p,
        1e-9,
    ),
    "find_hopf_point criticality": (
        THREE,
        lambda c: jc.boundaries.find_hopf_point(c, "belt_speed").lyapunov_coefficient,
        1e-9,
    ),
    "cycle_symmetry": (
        THREE,
        lambda c: jnp.asarray(jc.cycles.cycle_symmetry(c, jc.steady_sliding(c), 6.0).images),
        0,
    ),
}  # fmt: skip
LONG = {
    "simulate": (THREE, run, 5e-3),
    "sweep": (
        THREE,
        lambda c: jc.sweep(
            c, jc.excited_state(c, 1), 30.0, over={"belt_speed": SPEEDS}
        ).energy.values,
        5e-3,
    ),
    "find_limit_cycle": (ONE, cycle, 2e-3),
    "find_limit_cycle unstable": (ONE, lambda c: cycle(c, "unstable"), 1e-8),
    "continue_cycle": (
        ONE,
        lambda c: jc.continue_cycle(
            jc.find_limit_cycle(c, branch="unstable"), direction=-1
        ).of_kind("hopf")[0].parameter,
        1e-8,
    ),
    "guess_from_simulation": (
        ONE, lambda c: jc.cycles.guess_from_simulation(c, c_start(c), 0, transient=60.0)[1], 1e-3,
    ),
    "find_limit_cycle near Hopf": (ONE, near_hopf, 1e-8),
    "edge_state": (ONE, edge, 1e-6),
    "loop": (ONE, motion, 5e-3),
    "fold_belt_speed": (ONE, jc.fold_belt_speed, 1e-3),
    "find_fold": (ONE, lambda c: jc.find_fold(c).period, 1e-3),
    "extrapolated_fold": (ONE, lambda c: jc.boundaries.extrapolated_fold(c).value, 1e-12),
    "stability_range": (
        ONE, lambda c: jc.boundaries.stability_range(c, error_bars=True), 3e-3
    ),
    "hopf_by_descent": (ONE, lambda c: jc.boundaries.hopf_by_descent(c).belt_speed, 1e-9),
    "lyapunov_spectrum": (ONE, exponents, None),
    "verdict": (ONE, small_verdict, 1e-3),
    "front_speed": (
        RING,
        lambda c: jc.localization.front_speed(
            c, jc.excited_state(c, 4, block="centred"), 100.0, windows=5
        ).fronts.count[jnp.array([0, -1])],  # when a mass joins, they need not agree
        1e-12,
    ),
    "basin_shares": (
        ONE, lambda c: jc.basins.basin_shares(
            c, jc.basins.Box(), half_width=0.2, replicates=4, t1=200.0, checked=0
        ).share.values,
        0.02,
    ),
    "monodromy_matrix": (
        ONE, lambda c: jc.monodromy_matrix(c, (jnp.full(1, 0.6), jnp.zeros(1)), 6.0), 1e-7
    ),
    "sliding_share": (ONE, jc.basins.sliding_share, 1e-9),
    "sliding_basin": (ONE, lambda c: jc.basins.sliding_basin(c).period, 1e-9),
    "blow_of_one_mass": (ONE, jc.basins.blow_of_one_mass, 1e-9),
    "gentlest_blow": (ONE, lambda c: jc.basins.gentlest_blow(c).size, 1e-8),
    "gentlest_blow chain": (
        THREE.with_(belt_speed=1.6), lambda c: jc.basins.gentlest_blow(c).kick, 1e-4
    ),
    "predict": (ONE, lambda c: jc.inverse.predict(c, lab(c)), 1e-3),
    "log_likelihood": (ONE, lambda c: jc.inverse.log_likelihood(c, lab(c)) / 10, 1e-2),
    "identify": (ONE, lambda c: jc.inverse.identify(c, damped, 0.06, lab(c)).theta, 1e-2),
    "design": (
        ONE, lambda c: jc.inverse.design(c, damped, 0.05, highest_below=1.7, steps=3).costs, 0.1
    ),
}  # fmt: skip
# Of these others of the table are made, or their only part of friction is.
ELSEWHERE = {
    "verdicts": "verdict", "depinning_belt_speed": "front_speed", "profile": "identify",
}  # fmt: skip


def c_start(chain):
    return jc.model.release_state(chain, 0)


def film(chain):
    return loop(chain, c_start(chain), solver=jc.Rodas4())


# For smoothed friction alone: with a dry chain, the words that say what to do.
REFUSED = {
    "simulate": (lambda c: jc.simulate(c, c_start(c), 1.0, solver=jc.Rodas4()), "leave out"),
    "simulate accuracy": (lambda c: jc.simulate(c, c_start(c), 1.0, accuracy=0.1), "give `rtol`"),
    "sweep": (
        lambda c: jc.sweep(c, c_start(c), 1.0, over={"belt_speed": [1.0]}, solver=jc.Rodas4()),
        "leave out `solver`",
    ),
    "sweep accuracy": (
        lambda c: jc.sweep(c, c_start(c), 1.0, over={"belt_speed": [1.0]}, accuracy=0.1),
        "give `rtol`",
    ),
    "sweep width": (
        lambda c: jc.sweep(c, c_start(c), 1.0, over={"width": [0.1]}), "to sweep `width`"
    ),
    "liouville_determinant": (
        lambda c: jc.cycles.liouville_determinant(c, c_start(c), 6.0), "`find_limit_cycle`"
    ),
    "find_limit_cycles": (lambda c: jc.cycles.find_limit_cycles(c, 2), "`find_limit_cycle`"),
    "find_special_cycle": (
        lambda c: jc.boundaries.find_special_cycle(cycle_branch(1).special[0], c),
        "give it a width",
    ),
    "fold_by_descent": (jc.boundaries.fold_by_descent, "`find_fold`"),
    "phase_model": (
        lambda c: jc.localization.phase_model(jc.paper_chain(4, width=None)), "give it a width"
    ),
    "lyapunov_spectrum": (
        lambda c: jc.lyapunov_spectrum(c, c_start(c), 9.0, solver=jc.Rodas4()), "leave out"
    ),
    "verdict": (lambda c: jc.verdict(c, c_start(c), solver=jc.Rodas4()), "leave out `solver`"),
    "loop": (film, "leave out `solver`"),
}  # fmt: skip


def numbers(found):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(found, eqx.is_array_like))]


def compare(case):
    chain, function, tolerance = case
    dry, smoothed = (numbers(function(own)) for own in (chain, chain.with_(width=WIDTH)))
    assert dry
    for a, b in zip(dry, smoothed, strict=True):
        assert np.isfinite(a).all() == np.isfinite(b).all()
        if tolerance is not None:
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=max(tolerance, 1e-13))


def test_no_public_function_of_a_chain_is_forgotten():
    cases = {name.split()[0] for name in (*QUICK, *LONG, *REFUSED, *ELSEWHERE)}
    submodules = [
        jc,
        *(getattr(jc, submodule) for submodule in jc.SUBMODULES if submodule != "plotting"),
    ]
    public = [
        getattr(submodule, name)
        for submodule in submodules
        for name in getattr(submodule, "__all__", ())
    ]
    functions = [f for f in public if inspect.isfunction(f) or hasattr(f, "__wrapped__")]
    taking = {
        f.__name__
        for f in functions
        for name, of in inspect.signature(f).parameters.items()
        if name in ("chain", "model") and not re.search("PhaseModel|str", str(of.annotation))
    }
    assert taking <= cases


@pytest.mark.parametrize("name", QUICK)
def test_both_kinds_of_friction_are_served(name):
    compare(QUICK[name])


@pytest.mark.long
@pytest.mark.parametrize("name", LONG)
def test_both_kinds_of_friction_are_served_by_what_takes_longer(name):
    compare(LONG[name])


@pytest.mark.parametrize("name", REFUSED)
def test_what_needs_a_width_says_what_to_do_without_one(name):
    function, words = REFUSED[name]
    with pytest.raises(ValueError, match="dry friction") as caught:
        function(ONE)
    assert words in str(caught.value)
    assert re.search(r"`(chain|model)\.with_\(width=1e-3\)`", str(caught.value))


@pytest.mark.long
def test_one_program_serves_all_dry_chains(compiled):
    traces = []

    @eqx.filter_jit
    def kind(chain):
        traces.append(chain.dry)
        return chain.belt_speed

    first = THREE, THREE.with_(width=1e-2)
    others = (
        THREE.with_(belt_speed=1.3, mu_static=0.9), THREE.with_(damping_ratio=0.1),
        THREE.with_(width=2e-2),
    )  # fmt: skip
    for own in first:
        kind(own)
        run(own)
    assert traces == [True, False]
    compiled.clear()
    for own in others:
        kind(own)
        run(own)
    assert traces == [True, False]
    assert not compiled


@pytest.mark.long
def test_a_dry_chain_runs_as_a_smoothed_one_under_the_event_driven_solver():
    start = jc.equation_8(THREE, 1)
    dry, told = run(THREE, start), run(THREE.with_(width=0.3), start, solver=jc.EventDriven())
    for a, b in zip(numbers(dry), numbers(told), strict=True):
        np.testing.assert_array_equal(a, b)
