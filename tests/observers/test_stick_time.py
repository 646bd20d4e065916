"""How long masses stick: between the steps of a run, beside neighbours that move."""

import jax.numpy as jnp
import numpy as np

from jaxchain import Chain, ExponentialDecay, StickTime, TanhFriction, Trajectory, simulate
from jaxchain.model import Contact, Coulomb, MechanicalCells
from jaxchain.plotting import sticking


def test_the_time_is_the_share_of_states_in_which_friction_holds_a_mass():
    """Springs pull on a mass with their force at that time, not at another one of the step."""
    law = TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 1e-2)
    stiffness = jnp.array([1.0, 1.3, 0.8])
    coupling = jnp.array([0.3, 0.1])
    chain = Chain(3, law, 1.0, coupling=coupling, stiffness=stiffness, ends="free")
    start = jnp.array([1.5, -0.7, 0.9]), jnp.array([0.2, 1.0, -0.3])
    windows = 6.0, 4.5, 3.0, 1.5  # the last ones begin while a mass sticks
    watch = *map(StickTime, windows), Trajectory(jnp.linspace(20.0, 26.0, 60_001))
    *found, states = simulate(chain, start, 26.0, observe=watch, rtol=1e-9).observed
    sticks = np.asarray(sticking(chain, states))
    assert np.any(np.mean(sticks, axis=0) > 0.1)
    for window, time in zip(windows, found, strict=True):
        share = np.mean(sticks[-round(window * 10_000) - 1 :], axis=0)
        np.testing.assert_allclose(time, window * share, atol=2e-4)  # a sample at each end


def test_the_times_of_several_smoothed_contacts_tend_to_those_of_dry_ones():
    """Three blocks, two on the third: what holds one contact has the friction of the others."""

    def times(width):
        laws = ExponentialDecay(0.5, 0.3, 0.5), ExponentialDecay(0.4, 0.25, 0.5), Coulomb(0.3)
        first, second, third = (law if width is None else law.with_(width=width) for law in laws)
        blocks = MechanicalCells(
            [[2.0, -0.3, -0.2], [-0.3, 1.1, 0.0], [-0.2, 0.0, 1.4]],
            mass=[2.0, 0.8, 0.7],
            damping=0.02,
            contacts=[
                Contact((1, 0, 0), first, 3.0, 0.4),
                Contact((-1, 1, 0), second, 0.8),
                Contact((-1, 0, 1), third, 0.7),
            ],
            force=jnp.array([0.0, 0.5, 0.4]),
            frequency=0.7,
        )
        watch = [StickTime(contact=i) for i in range(3)]
        run = simulate(blocks, (jnp.zeros(1),) * 6, 60.0, observe=watch, rtol=1e-9)
        return np.concatenate(run.observed)

    dry, (wide, narrow) = times(None), map(times, (1e-3, 1e-4))
    assert np.all(dry > 10.0)
    # Releases from smoothed friction are late by times of the order of sqrt(width).
    np.testing.assert_allclose(narrow, dry, atol=0.4)
    assert np.all(np.abs(narrow - dry) < 0.5 * np.abs(wide - dry))


def test_a_belt_that_speeds_up_releases_a_smoothed_mass_as_a_dry_one():
    """A mass without a spring on a belt with v_d = t^2 sticks while v_d' = 2 t <= mu_st."""

    def time(law):
        car = MechanicalCells(1e-9, contacts=[Contact(1.0, law, 1.0, lambda t: t**2)])
        run = simulate(car, (jnp.zeros(1), jnp.zeros(1)), 2.0, observe=StickTime(), rtol=1e-10)
        return float(run.observed[0])

    law = Coulomb(0.8)
    np.testing.assert_allclose(time(law), 0.4, atol=1e-6)
    np.testing.assert_allclose(time(law.with_(width=1e-5)), 0.4, atol=0.02)
