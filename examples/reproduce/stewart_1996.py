"""Three blocks on the floor, joined by springs and dampers, come to rest one after the other.

Stewart, A numerical method for friction problems with multiple contacts, Journal of the
Australian Mathematical Society B 37 (1996): friction 0.3, all at rest by t = 3.92710442.
"""

import jax.numpy as jnp
from _report import report

from jaxchain import Coulomb, StickTime, simulate
from jaxchain.model import MechanicalCells

first = jnp.array([1.0, 0.0, 0.0])[:, None, None]  # only this block has a spring to the wall
blocks = MechanicalCells(first, damping=1.0, coupling=1.0, friction=Coulomb(0.3), ends="free")
start = jnp.array([-1.0, 1.0, -1.0]), jnp.array([-1.0, 1.0, 1.0])
run = simulate(blocks, start, 10.0, rtol=1e-12, observe=StickTime(window=10.0))
rest = run.state[0]
report(
    __doc__,
    ("the last block sticks at t", 3.92710442, 10.0 - jnp.min(run.observed), 1e-8),
    ("x_1 at rest", 0.11308084, rest[0], 1e-7),
    ("x_2 at rest", 0.18657982, rest[1], 1e-7),
    ("x_3 at rest", 0.23411724, rest[2], 1e-7),
)
