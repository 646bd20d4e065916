"""A cycle of stick and slip without damping, friction 1 / (1 + |w|), belt speed 0.2.

Dieci, Lopez, Sliding motion in Filippov differential systems: theoretical results and a
computational approach, SIAM Journal on Numerical Analysis 47 (2009), example 6.1.
"""

from _report import report

from jaxchain import Chain, StickTime, find_limit_cycle, simulate
from jaxchain.model import AbstractFrictionLaw


class Hyperbolic(AbstractFrictionLaw):
    mu_static: float = 1.0

    def coefficient(self, speed):
        return self.mu_static / (1.0 + speed)


chain = Chain(1, Hyperbolic(), belt_speed=0.2, damping_ratio=0.0)
cycle = find_limit_cycle(chain)
stuck = simulate(chain, cycle.state, cycle.period, observe=StickTime(), rtol=1e-12).observed[0]
released = cycle.state[0][0]  # the cycle is cut where the belt releases the mass
report(
    __doc__,
    ("period", 9.23077045808, cycle.period, 1e-10),
    ("time of slip", 4.70336499794, cycle.period - stuck, 1e-10),
    ("sticks again at x", 0.0945189079719, released - 0.2 * stuck, 1e-10),
)
