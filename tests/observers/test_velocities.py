"""Velocities and energies of dry runs, whose steps are long."""

from jaxchain import equation_8, paper_chain, simulate
from jaxchain.observers import EnergyBalance


def test_energies_balance_as_far_as_the_motion_is_exact():
    """The powers balance at every instant, so that what is left is the error of the rule."""
    chain = paper_chain(3, belt_speed=0.5, width=None)
    run = simulate(chain, equation_8(chain, 1), 30.0, rtol=1e-10, observe=EnergyBalance())
    work, lost, stored = run.observed
    assert abs(work - lost - stored) < 1e-9 * work
