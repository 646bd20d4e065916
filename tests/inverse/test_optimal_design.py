"""Least-cost designs: optimality by three witnesses, and event-driven runs that confirm them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from two_runs import amplitudes, is_boundary, survives

from jaxchain.basins.blows import gentlest_blow
from jaxchain.boundaries.fold import fold_belt_speed
from jaxchain.boundaries.ranges import StabilityRange, stability_range
from jaxchain.inverse import optimal_design
from jaxchain.inverse.optimal_design import design
from jaxchain.model.chain import paper_chain, steady_sliding
from jaxchain.observers.amplitude import Amplitude
from jaxchain.result import SearchResult
from jaxchain.simulation.run import simulate

# Second looks, or minutes of compilation: not in every run of the tests.
pytestmark = pytest.mark.long

ONE = paper_chain(n=1, width=None)
START = jnp.array([0.05, 0.5])
PAPER_FOLD, PAPER_HOPF = 1.836600972208, np.log(10.0) / 2


def change(chain, theta):
    return chain.with_(damping_ratio=theta[0], mu_dynamic=theta[1])


def boundaries(found):
    assert found.range is not None
    return found.range


def improve(width, **options):
    return design(ONE, change, START, width_below=width, **options)


@pytest.fixture(scope="module")
def halved():
    return improve(0.3)


def hopf_of(theta):
    return 0.5 * np.log((1.0 - theta[1]) / theta[0])


def test_it_meets_the_aim_where_the_gradients_of_cost_and_aim_are_parallel(halved):
    assert halved.successful
    assert float(halved.range.width) == pytest.approx(0.3, abs=1e-6)
    assert float(halved.range.hopf) == pytest.approx(hopf_of(halved.theta), abs=1e-12)
    assert float(halved.multiplier) > 0.1
    assert float(halved.angle) < 1e-5
    taken = int(halved.evaluations)
    assert np.isfinite(halved.costs[:taken]).all()
    assert np.isnan(halved.costs[taken:]).all()
    assert halved.path.shape == (200, 2)


@pytest.mark.exhaustive
def test_scipy_finds_the_same_without_derivatives_of_ours(halved):
    fold = jax.jit(lambda theta: fold_belt_speed(change(ONE, theta)))

    def room(z):
        theta = START * (1.0 + z)
        return 0.3 - (float(fold(theta)) - hopf_of(theta))

    found = minimize(
        lambda z: 0.5 * np.sum(z**2),
        np.zeros(2),
        method="SLSQP",
        constraints={"type": "ineq", "fun": room},
        options={"ftol": 1e-12},
    )
    assert found.success
    np.testing.assert_allclose(halved.theta, START * (1.0 + found.x), rtol=1e-5)
    assert float(halved.cost) == pytest.approx(found.fun, rel=1e-5)


def test_the_multiplier_is_the_cost_of_a_further_unit_of_the_target(halved):
    tighter, looser = improve(0.299), improve(0.301)
    slope = (tighter.cost - looser.cost) / 0.002
    assert float(halved.multiplier) == pytest.approx(float(slope), rel=1e-4)


def test_vibration_dies_out_above_the_new_fold_and_survives_below_it(halved):
    fold = halved.range.fold
    assert float(fold) < PAPER_FOLD - 0.5
    assert is_boundary(halved.chain, fold)
    # Where the old chain vibrates and the new one does not.
    assert survives(ONE, [1.485, 1.515]) == [True, True]
    assert survives(halved.chain, [1.485, 1.515]) == [False, False]
    assert float(abs(amplitudes(halved.chain, [1.485, 1.515])).max()) < 1e-4


def test_a_chain_that_is_good_enough_stays_as_it_is():
    found = improve(0.9)
    assert (int(found.evaluations), float(found.cost), float(found.multiplier)) == (1, 0.0, 0.0)
    assert found.successful
    assert np.isnan(found.angle)
    assert found.theta.tolist() == START.tolist()


def test_designs_without_any_vibration_on_the_way_do_no_harm():
    found = improve(0.01)
    tried = found.aims[: int(found.evaluations)]
    assert (tried == 0.0).any()
    assert found.successful
    assert float(boundaries(found).width) == pytest.approx(0.01, abs=1e-6)
    assert float(found.angle) < 1e-4


def test_the_range_of_the_paper_and_of_chains_without_a_fold():
    paper = stability_range(ONE)
    assert float(paper.hopf) == pytest.approx(PAPER_HOPF, abs=1e-12)
    assert float(paper.width) == pytest.approx(PAPER_FOLD - PAPER_HOPF, abs=1e-9)
    # Weakening (mu_st - mu_d) / v0 = 1 never outweighs damping 2 xi = 1.2: there is no vibration.
    quiet = stability_range(ONE.with_(damping_ratio=0.6))
    assert np.isnan(quiet.hopf)
    assert np.isnan(quiet.fold)
    assert (bool(quiet.successful), float(quiet.highest), float(quiet.width)) == (True, 0.0, 0.0)
    assert survives(ONE.with_(damping_ratio=0.6), [0.495, 0.505]) == [False, False]
    # Without damping vibration has no end, which is no fold, either, but no success.
    undamped = stability_range(ONE.with_(damping_ratio=0.0))
    assert undamped.result == SearchResult.undamped
    assert not undamped.successful


def test_vibration_that_seems_to_set_in_gently_is_no_proof_of_no_fold():
    gentle = stability_range(paper_chain(1, width=0.35))
    assert np.isnan(gentle.fold)
    assert gentle.result == SearchResult.supercritical
    assert not gentle.successful
    assert np.isnan([gentle.highest, gentle.width]).all()
    assert "not a proof" in gentle.message


def weaker(chain, mu):
    return chain.with_(mu_static=mu)


def closed_form(chain, mass):
    """The Hopf speed of one mass for all of a `StabilityRange`, which compiles in seconds."""
    ratio = (chain.law.mu_static - chain.law.mu_dynamic) / (2 * chain.damping_ratio * 0.5)
    hopf = 0.5 * jnp.log(jnp.maximum(ratio, 1.0))
    values = {"hopf": hopf, "fold": hopf, "highest": hopf, "width": 0 * hopf}
    return StabilityRange(**values, result=SearchResult.successful, mass=mass)


def test_a_design_stays_where_static_friction_exceeds_dynamic_friction_and_says_so(monkeypatch):
    monkeypatch.setattr(optimal_design, "stability_range", closed_form)
    with pytest.warns(UserWarning, match="edge of the domain, `mu_static = mu_dynamic`"):
        found = design(ONE, weaker, 1.0, highest_below=1.7, cost=lambda mu: mu**2)
    assert found.successful
    assert float(found.theta) == pytest.approx(0.5, abs=1e-5)
    assert float(jnp.nanmin(found.path)) >= 0.5
    weaker(ONE, found.theta)  # the constructor accepts it


def test_a_start_whose_boundary_is_not_known_does_not_pretend_to_converge():
    found = design(ONE, change, jnp.array([0.0, 0.5]), width_below=0.3, scale=START)
    assert not found.successful
    assert int(found.evaluations) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "One of the arguments `width_below`, `highest_below` and `blow_above`"),
        ({"width_below": 0.3, "highest_below": 1.0}, "One of the arguments"),
        ({"highest_below": 1.0, "blow_above": 1.0}, "One of the arguments"),
        ({"blow_above": [1.0, 2.0]}, "`blow_above` must be one number"),
        ({"width_below": -0.3}, "`width_below` must be positive"),
        ({"highest_below": [1.0, 2.0]}, "`highest_below` must be one number"),
        ({"width_below": 0.3, "mass": 1}, "`mass` must be an integer in 0"),
        ({"width_below": 0.3, "steps": 0}, "`steps` must be"),
        ({"width_below": 0.3, "steps": None}, "`steps` must be an integer"),
        ({"width_below": 0.3, "scale": 0.0}, "`scale` must be positive"),
        ({"width_below": 0.3, "tolerance": 0.0}, "`tolerance` must be positive"),
        ({"width_below": 0.3, "start": ()}, "`start` must hold"),
    ],
)
def test_bad_input_is_named(options, message):
    start = options.pop("start", START)
    with pytest.raises(ValueError, match=message):
        design(ONE, change, start, **options)


@pytest.mark.exhaustive
def test_a_design_with_smoothed_friction_has_the_error_of_the_width():
    """The bias of the boundary goes into the design; dry friction still vibrates there."""
    smooth = ONE.with_(width=1e-2)
    found = design(smooth, change, START, highest_below=1.5)
    assert found.successful
    assert float(boundaries(found).fold) == pytest.approx(1.5, abs=1e-6)
    assert float(found.angle) < 1e-4
    dry = float(stability_range(found.chain.with_(width=None)).fold)
    assert 0.02 < dry - 1.5 < 0.06
    assert survives(found.chain, [1.485, 1.515]) == [True, True]
    assert is_boundary(found.chain, dry)


@pytest.mark.exhaustive
def test_mistuned_neighbours_lower_the_fold_of_the_mass_between_them():
    """Three masses: the fold of the second, moved by stiffness and damping of all."""
    three = paper_chain(n=3, width=None).with_(
        coupling=0.02, damping_ratio=jnp.full(3, 0.05), stiffness=jnp.ones(3)
    )

    def mistuned(chain, theta):
        return chain.with_(
            damping_ratio=0.05 * jnp.exp(theta["damping"]), stiffness=jnp.exp(theta["stiffness"])
        )

    start = {"damping": jnp.zeros(3), "stiffness": jnp.zeros(3)}
    old = stability_range(three)
    found = design(three, mistuned, start, highest_below=1.6)
    assert found.successful
    assert float(boundaries(found).highest) == pytest.approx(1.6, abs=1e-6)
    assert float(found.angle) < 1e-4
    # A ring of three: what the neighbours of the second get is the same.
    for moved in found.theta.values():
        assert float(moved[0]) == pytest.approx(float(moved[2]), abs=1e-5)
    assert is_boundary(three, old.fold)
    assert is_boundary(found.chain, boundaries(found).fold)
    # The gradient of the fold against differences, in the damping of a neighbour.
    raised = [three.with_(damping_ratio=jnp.array([0.05 + h, 0.05, 0.05])) for h in (1e-5, -1e-5)]
    slope = (stability_range(raised[0]).fold - stability_range(raised[1]).fold) / 2e-5
    gradient = jax.grad(lambda xi: stability_range(three.with_(damping_ratio=xi)).fold)
    assert float(gradient(jnp.full(3, 0.05))[0]) == pytest.approx(float(slope), rel=1e-4)


def test_one_mass_is_made_to_bear_a_harder_blow():
    """On the way it may raise the damping, or lower the static friction."""

    def change(chain, theta):
        return chain.with_(damping_ratio=theta[0], mu_static=theta[1])

    start = jnp.array([0.05, 1.0])
    chain = ONE.with_(belt_speed=1.4)
    before = float(gentlest_blow(chain).size)
    found = design(chain, change, start, blow_above=1.3)
    assert before < 1.05
    assert found.successful
    assert found.range is None
    assert found.blow is not None
    assert float(found.blow.size) == pytest.approx(1.3, abs=1e-6)
    assert float(found.angle) < 1e-4
    assert float(found.aims[0]) == pytest.approx(before)
    for share, vibrates in ((0.99, False), (1.01, True)):
        rest, _ = steady_sliding(found.chain)
        start = rest, share * found.blow.kick
        run = simulate(found.chain, start, 2000.0, observe=Amplitude(window=20.0))
        assert bool(run.observed[0] > 0.7) is vibrates
    # Half a per cent less of either change is too little.
    for k in range(2):
        theta = found.theta.at[k].add(-0.005 * (found.theta - jnp.array([0.05, 1.0]))[k])
        assert float(gentlest_blow(change(ONE.with_(belt_speed=1.4), theta)).size) < 1.3


def test_a_chain_is_made_to_bear_a_harder_blow_wherever_it_falls():
    chain = paper_chain(3, belt_speed=1.4, width=None)

    def damped(chain, xi):
        return chain.with_(damping_ratio=xi)

    # All alike: of masses that are changed one by one the weakest one changes.
    found = design(chain, damped, 0.05, blow_above=1.2)
    assert found.successful
    assert found.blow is not None
    assert float(found.blow.size) == pytest.approx(1.2, abs=1e-5)
    again = gentlest_blow(found.chain, tries=200)
    assert again.successful
    assert float(again.size) == pytest.approx(1.2, abs=1e-5)


def test_a_chain_that_slides_unsteadily_has_no_blow_to_raise():
    found = design(ONE.with_(belt_speed=1.0), change, START, blow_above=0.1, steps=20)
    assert found.result == SearchResult.nonfinite
    assert found.blow is not None
    assert not found.blow.successful
