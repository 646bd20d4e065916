"""Orbits that are closed as verdicts close them."""

import jax.numpy as jnp

from jaxchain.cycles.limit_cycle import StateEquations
from jaxchain.simulation.method import custom_solver


def closed_orbit(model, state, period, *, solver=None):
    """The `ClosedOrbit` near a state that nearly returns after `period`."""
    solver = custom_solver(model, solver)
    equations = StateEquations(model, 1e-9, solver, len(state), state[0].size)
    return equations.close(state, jnp.asarray(period, float))
