"""Ready-made cells: blocks pulled over a surface, mode coupling, pendulums, Duffing, van der Pol.

Each class is one model from the literature, an `AbstractCells` in a ring (`ends` = "cyclic") or a
row (`ends` = "free").  A number is one for all cells, or one per cell, of shape (n,).  Numbers may
be dimensionless or in any consistent units.

The state of a pulled block contains the stretch u of the spring that pulls it at the speed V, with
u' = V - v, because u is periodic while the block advances.  The position of the block is V t - u,
so a spring eta between neighbours acts on a block by -eta (u_{n-1} - 2 u_n + u_{n+1}).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import (
    check_finite,
    check_kind,
    check_nonnegative,
    check_number,
    check_one_of,
    check_per_mass,
    check_positive,
    to_float,
)
from .._types import PerMass, ScalarLike, State
from .cells import AbstractCells
from .friction import AbstractFrictionLaw, TanhFriction
from .springs import Ends

Rates = tuple[Float[Array, " n"], ...]


def _number(name: str, check: Callable[[str, Any], None] = check_positive) -> Callable[[Any], Any]:
    """The converter of the number of this name: to floats of the right sign."""

    def convert(value: Any) -> Array:
        number = to_float(value, name)
        check(name, number)
        return number

    return convert


def _bend(left: State, own: State, right: State) -> Float[Array, " n"]:
    """The second difference x_{n-1} - 2 x_n + x_{n+1} of the first variable."""
    return left[0] - 2.0 * own[0] + right[0]


class _AbstractReadyMade(AbstractCells):
    """Cells whose numbers are one for all cells, or one for each."""

    def __check_init__(self) -> None:
        check_one_of("ends", self.ends, get_args(Ends))
        check_per_mass(**self.parameters())

    @property
    def n(self) -> int | None:
        """The number of cells; None if every number is one for all."""
        return max((len(a) for a in self.parameters().values() if a.ndim), default=None)


class ModeCoupling(_AbstractReadyMade):
    """Two modes of one mass, which friction couples to flutter.

    x'' + c1 x' + k11 x + k3 x^3 + (k12 - mu k_c) y + eta (2 x_n - x_{n-1} - x_{n+1}) = 0,
    y'' + c2 y' + k12 x + k22 y = 0.

    x is the displacement along the belt and y the one normal to it, both from steady sliding; the
    mass is 1, and mu k_c y the change of the friction force of a mass that slides.  Without
    damping, cubic spring and coupling the two frequencies meet at

        mu_c = [k12 + (k11 - k22)^2 / (4 k12)] / k_c,

    and beyond one of the two modes grows.  The cubic spring bounds it.

    The mass slides at all times: it never sticks, because the direction of the friction force is
    fixed, also where x' exceeds the speed of the belt.  For flutter with sticking use
    `MechanicalCells` with friction and the stiffness matrix of both modes.

    Source: Hoffmann, Fischer, Allgaier, Gaul, A minimal model for studying properties of the
    mode-coupling type instability in friction induced oscillations, Mechanics Research
    Communications 29 (2002).  The cubic spring and the coupling are additions.

    **Arguments** (dimensionless): `stiffness_x` = k11, `stiffness_y` = k22 > 0;
    `stiffness_xy` = k12; `contact_stiffness` = k_c > 0; `friction` = mu >= 0; `damping_x` = c1,
    `damping_y` = c2 >= 0; `cubic` = k3 >= 0; `coupling` = eta.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.model import ModeCoupling
        >>> def growth(mu):
        ...     cells = ModeCoupling(2.0, 1.0, 0.5, contact_stiffness=1.0, friction=mu)
        ...     return jnp.linalg.eigvals(cells.jacobian(0.0, (jnp.zeros(1),) * 4)).real.max()
        >>> [round(float(growth(mu)), 4) + 0.0 for mu in (0.99, 1.0, 1.01)]  # mu_c is 1
        [0.0, 0.0, 0.0289]
    """

    stiffness_x: PerMass = eqx.field(converter=_number("stiffness_x"))
    stiffness_y: PerMass = eqx.field(converter=_number("stiffness_y"))
    stiffness_xy: PerMass = eqx.field(converter=_number("stiffness_xy", check_finite))
    contact_stiffness: PerMass = eqx.field(converter=_number("contact_stiffness"))
    friction: PerMass = eqx.field(converter=_number("friction", check_nonnegative))
    damping_x: PerMass = eqx.field(converter=_number("damping_x", check_nonnegative), default=0.0)
    damping_y: PerMass = eqx.field(converter=_number("damping_y", check_nonnegative), default=0.0)
    cubic: PerMass = eqx.field(converter=_number("cubic", check_nonnegative), default=0.0)
    coupling: PerMass = eqx.field(converter=_number("coupling", check_finite), default=0.0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    components = ("x", "y", "x'", "y'")
    contact = 2

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Rates:
        x, y, vx, vy = own
        friction = self.friction * self.contact_stiffness * y
        springs = self.coupling * _bend(left, own, right) - self.cubic * x**3
        force_x = friction + springs - self.stiffness_x * x - self.stiffness_xy * y
        force_y = -self.stiffness_xy * x - self.stiffness_y * y
        return vx, vy, force_x - self.damping_x * vx, force_y - self.damping_y * vy


class _AbstractPulled(_AbstractReadyMade):
    """Blocks pulled by springs, whose first variable is the stretch u, with u' = V - v."""

    def belt_direction(self) -> ScalarLike:
        """-1: a block is fastest where u' is least."""
        return -1.0


class LuGre(_AbstractPulled):
    """A block pulled over a surface that holds it by bristles: the LuGre model of friction.

    u' = V - v,   m v' = k u - F - eta (u_{n-1} - 2 u_n + u_{n+1}),
    z' = v - sigma0 |v| z / g(v),   g(v) = F_C + (F_S - F_C) exp[-(v / v_s)^2],
    F = sigma0 z + sigma1 z' + sigma2 v.

    u is the stretch of the spring that pulls the block at the speed V, v the velocity of the block
    and z the deflection of the bristles.  The third number of a state is sigma0 z, the force of
    the bristles: it is of the size of F_C, while z may be below the tolerances of a run.

    With sigma1 = 0 and F_S = F_C it is Dahl's model, which has hysteresis, but no stick-slip.
    After a path x in one direction from z = 0 the force of the bristles is there F_C [1 -
    exp(-sigma0 |x| / F_C)], whatever the speed.

    Source: Canudas de Wit, Olsson, Astrom, Lischinsky, A new model for control of systems with
    friction, IEEE Transactions on Automatic Control 40 (1995).  The default numbers are theirs
    for stick-slip, in SI units; sigma1 is sqrt(sigma0).  Dahl, Solid friction damping of
    mechanical vibrations, AIAA Journal 14 (1976).

    **Arguments:** `mass` = m, `stiffness` = k, `bristle_stiffness` = sigma0, `coulomb_force` =
    F_C, `static_force` = F_S and `stribeck_speed` = v_s, all > 0; `speed` = V; `bristle_damping` =
    sigma1, `viscosity` = sigma2 >= 0; `coupling` = eta.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle, simulate
        >>> from jaxchain.model import LuGre
        >>> block = LuGre()
        >>> run = simulate(block, (jnp.zeros(1),) * 3, 50.0)
        >>> cycle = find_limit_cycle(block, run, period=6.4)
        >>> round(float(cycle.period), 5), cycle.stable
        (6.36272, True)
    """

    mass: PerMass = eqx.field(converter=_number("mass"), default=1.0)
    stiffness: PerMass = eqx.field(converter=_number("stiffness"), default=2.0)
    speed: PerMass = eqx.field(converter=_number("speed", check_finite), default=0.1)
    bristle_stiffness: PerMass = eqx.field(converter=_number("bristle_stiffness"), default=1e5)
    bristle_damping: PerMass = eqx.field(
        converter=_number("bristle_damping", check_nonnegative), default=1e5**0.5
    )
    viscosity: PerMass = eqx.field(converter=_number("viscosity", check_nonnegative), default=0.4)
    coulomb_force: PerMass = eqx.field(converter=_number("coulomb_force"), default=1.0)
    static_force: PerMass = eqx.field(converter=_number("static_force"), default=1.5)
    stribeck_speed: PerMass = eqx.field(converter=_number("stribeck_speed"), default=0.001)
    coupling: PerMass = eqx.field(converter=_number("coupling", check_finite), default=0.0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    components = ("stretch", "velocity", "bristle_force")

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Rates:
        u, v, bristles = own
        drop = self.static_force - self.coulomb_force
        limit = self.coulomb_force + drop * jnp.exp(-((v / self.stribeck_speed) ** 2))
        bending = v - jnp.abs(v) * bristles / limit
        friction = bristles + self.bristle_damping * bending + self.viscosity * v
        force = self.stiffness * u - friction - self.coupling * _bend(left, own, right)
        return self.speed - v, force / self.mass, self.bristle_stiffness * bending


class RateAndState(_AbstractPulled):
    """A block of rock pulled at the speed of plates: rate-and-state friction.

    u' = V - v,   M v' = k u - tau - eta (u_{n-1} - 2 u_n + u_{n+1}),
    tau = sigma [mu0 + a ln(v / V0) + b ln(V0 theta / L)],
    theta' = 1 - v theta / L ("aging"),   or   theta' = -(v theta / L) ln(v theta / L) ("slip").

    u is the stretch of the spring, v > 0 the velocity and theta the age of the contacts.  A state
    is (u, ln v, ln theta), in which creep at 1e-9 m/s and a quake at 1 m/s are equally well
    resolved.  Steady sliding is ln v = ln V, ln theta = ln(L / V), k u = tau; for b > a a single
    block loses stability, with either law, as k falls below

        k_c = sigma (b - a) / L [1 + M V^2 / (sigma a L)],

    at the angular frequency sqrt[(k_c V / L) / (M V / L + sigma a / V)].

    Sources: Dieterich, Modeling of rock friction, Journal of Geophysical Research 84 (1979);
    Ruina, Slip instability and state variable friction laws, Journal of Geophysical Research 88
    (1983); k_c: Rice, Ruina, Stability of steady frictional slipping, Journal of Applied Mechanics
    50 (1983).

    **Arguments** (SI units, or any other system): `mass` = M (per area, kg/m^2), `stiffness` = k
    (Pa/m), `speed` = V, `normal_stress` = sigma, `direct_effect` = a, `evolution_effect` = b,
    `slip_length` = L, all > 0; `reference_friction` = mu0 and `reference_speed` = V0 > 0;
    `coupling` = eta; `law`, "aging" or "slip".

    **Raises:** `ValueError` for anything else.

    !!! example

        Steady sliding with a spring stiffer than k_c = 5.01, and with a softer one:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.model import RateAndState
        >>> rest = (jnp.zeros(1),) * 3  # tau = 0 for mu0 = 0
        >>> def growth(stiffness):
        ...     block = RateAndState(0.01, stiffness, 1.0, 10.0, 0.5, 1.0, 1.0, 0.0)
        ...     return jnp.linalg.eigvals(block.jacobian(0.0, rest)).real.max()
        >>> bool(growth(10.0) < 0), bool(growth(2.5) > 0)
        (True, True)
    """

    mass: PerMass = eqx.field(converter=_number("mass"))
    stiffness: PerMass = eqx.field(converter=_number("stiffness"))
    speed: PerMass = eqx.field(converter=_number("speed"))
    normal_stress: PerMass = eqx.field(converter=_number("normal_stress"))
    direct_effect: PerMass = eqx.field(converter=_number("direct_effect"))
    evolution_effect: PerMass = eqx.field(converter=_number("evolution_effect"))
    slip_length: PerMass = eqx.field(converter=_number("slip_length"))
    reference_friction: PerMass = eqx.field(converter=_number("reference_friction", check_finite))
    reference_speed: PerMass = eqx.field(converter=_number("reference_speed"), default=1.0)
    coupling: PerMass = eqx.field(converter=_number("coupling", check_finite), default=0.0)
    law: Literal["aging", "slip"] = eqx.field(static=True, default="aging")
    ends: Ends = eqx.field(static=True, default="cyclic")
    components = ("stretch", "log velocity", "log age")

    def __check_init__(self) -> None:
        check_one_of("law", self.law, ("aging", "slip"))

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Rates:
        u, log_v, log_age = own
        v, log_v0 = jnp.exp(log_v), jnp.log(self.reference_speed)
        ratio = log_v + log_age - jnp.log(self.slip_length)  # ln(v theta / L)
        direct = self.direct_effect * (log_v - log_v0)
        friction = self.reference_friction + direct
        friction = friction + self.evolution_effect * (ratio - log_v + log_v0)
        force = self.stiffness * u - self.coupling * _bend(left, own, right)
        force = force - self.normal_stress * friction
        slips = v / self.slip_length
        ages = jnp.exp(-log_age) - slips if self.law == "aging" else -slips * ratio
        return self.speed - v, force / (self.mass * v), ages


class Duffing(_AbstractReadyMade):
    """Driven oscillators with a cubic spring.

    m x'' + c x' + k x + k3 x^3 + eta (2 x_n - x_{n-1} - x_{n+1}) = F cos(omega t).

    Source: Duffing, Erzwungene Schwingungen bei veraenderlicher Eigenfrequenz (1918).

    **Arguments** (of any system of units): `force` = F; `frequency` = omega > 0, one number, the
    same for all masses; `mass` = m > 0; `damping` = c; `stiffness` = k and `cubic` = k3, of either
    sign; `coupling` = eta.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle
        >>> from jaxchain.model import Duffing
        >>> ring = Duffing(force=1.0, frequency=2.0, damping=0.1, cubic=2.0, coupling=0.1)
        >>> cycle = find_limit_cycle(ring, (jnp.zeros(3), jnp.zeros(3)))
        >>> round(float(cycle.period), 6), cycle.stable
        (3.141593, True)
    """

    force: PerMass = eqx.field(converter=_number("force", check_finite))
    frequency: Float[Array, ""] = eqx.field(converter=_number("frequency"))
    damping: PerMass = eqx.field(converter=_number("damping", check_finite), default=0.0)
    stiffness: PerMass = eqx.field(converter=_number("stiffness", check_finite), default=1.0)
    cubic: PerMass = eqx.field(converter=_number("cubic", check_finite), default=0.0)
    mass: PerMass = eqx.field(converter=_number("mass"), default=1.0)
    coupling: PerMass = eqx.field(converter=_number("coupling", check_finite), default=0.0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    components = ("displacement", "velocity")

    def __check_init__(self) -> None:
        check_number("frequency", self.frequency)

    def forcing_period(self) -> ScalarLike:
        """2 pi / omega."""
        return 2.0 * jnp.pi / self.frequency

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Rates:
        x, v = own
        force = self.force * jnp.cos(self.frequency * t) + self.coupling * _bend(left, own, right)
        force = force - self.damping * v - self.stiffness * x - self.cubic * x**3
        return v, force / self.mass


class Pendulums(_AbstractReadyMade):
    """Pendulums of any lengths on a support that is shaken vertically, with springs between bobs.

    l_n theta_n'' + c l_n theta_n' + [1 + A omega^2 cos(omega t)] sin theta_n = eta [
        l_{n-1} sin(theta_{n-1} - theta_n) + l_{n+1} sin(theta_{n+1} - theta_n)
        + (l_{n-1} + l_{n+1} - 2 l_n) sin theta_n].

    The springs are relaxed where all pendulums hang.  This flat state is an equilibrium at every
    amplitude; shaking makes it unstable beyond a least one.  Lengths are in units of the mean
    length, times in units of the inverse frequency of a pendulum of this length.

    Source: Nicolaou, Motter, Anharmonic classical time crystals: A coresonance pattern formation
    mechanism, Physical Review Research 3 (2021), with alternating lengths.  A ring of 32 with
    c = 0.1, eta = 1, omega = 3.5 and lengths 1 +- 0.25 loses stability at A = 0.0399428, by two
    modes that respond at frequencies incommensurate with omega.

    **Arguments** (dimensionless): `length` = l > 0; `amplitude` = A and `frequency` = omega > 0 of
    the support, one number each; `damping` = c >= 0; `coupling` = eta.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, simulate
        >>> from jaxchain.model import Pendulums
        >>> length = 1.0 + 0.25 * (-1.0) ** jnp.arange(8)
        >>> start = (1e-3 * jnp.sin(jnp.arange(8.0)), jnp.zeros(8))
        >>> for amplitude in (0.03, 0.06):
        ...     ring = Pendulums(length, amplitude, frequency=3.5)
        ...     run = simulate(ring, start, 200.0, observe=Amplitude(window=20.0))
        ...     print(bool(run.observed.max() > 0.1))
        False
        True
    """

    length: PerMass = eqx.field(converter=_number("length"))
    amplitude: Float[Array, ""] = eqx.field(converter=_number("amplitude", check_finite))
    frequency: Float[Array, ""] = eqx.field(converter=_number("frequency"))
    damping: PerMass = eqx.field(converter=_number("damping", check_nonnegative), default=0.1)
    coupling: PerMass = eqx.field(converter=_number("coupling", check_finite), default=1.0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    components = ("angle", "angular velocity")

    def __check_init__(self) -> None:
        check_number("amplitude", self.amplitude)
        check_number("frequency", self.frequency)

    def forcing_period(self) -> ScalarLike:
        """2 pi / omega."""
        return 2.0 * jnp.pi / self.frequency

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Rates:
        angle, v = own
        length = jnp.broadcast_to(self.length, angle.shape)
        (before,), (behind,) = self.neighbours((length,))
        pull = before * jnp.sin(left[0] - angle) + behind * jnp.sin(right[0] - angle)
        pull = pull + (before + behind - 2.0 * length) * jnp.sin(angle)
        shaken = 1.0 + self.amplitude * self.frequency**2 * jnp.cos(self.frequency * t)
        return v, (self.coupling * pull - shaken * jnp.sin(angle)) / length - self.damping * v


class VanDerPol(_AbstractReadyMade):
    """Van der Pol's oscillators, which excite themselves.

    x'' - mu (1 - x^2) x' + x + eta (2 x_n - x_{n-1} - x_{n+1}) = 0.

    Source: van der Pol, On relaxation-oscillations, Philosophical Magazine 2 (1926).

    **Arguments** (dimensionless): `mu` of either sign; `coupling` = eta.

    **Raises:** `ValueError` if one is not finite.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle
        >>> from jaxchain.model import VanDerPol
        >>> cycle = find_limit_cycle(VanDerPol(mu=1.0), (jnp.full(1, 2.0), jnp.zeros(1)))
        >>> round(float(cycle.period), 6)
        6.663287
    """

    mu: PerMass = eqx.field(converter=_number("mu", check_finite))
    coupling: PerMass = eqx.field(converter=_number("coupling", check_finite), default=0.0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    components = ("displacement", "velocity")

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Rates:
        x, v = own
        return v, self.mu * (1.0 - x**2) * v - x + self.coupling * _bend(left, own, right)


class BurridgeKnopoff(_AbstractPulled):
    """Blocks in a row between two plates of a fault: the model of earthquakes.

    u_n' = V - v_n,   m v_n' = k_p u_n - k_c (u_{n-1} - 2 u_n + u_{n+1}) + F(v_n).

    u is the stretch of the leaf spring by which the moving plate pulls a block at the speed V, and
    v the velocity of the block over the plate at rest.  F(v) = -mu(|v|) tanh(v / width) is
    smoothed friction, which weakens with speed; the normal load is 1.

    Sources: Burridge, Knopoff, Model and theoretical seismicity, Bulletin of the Seismological
    Society of America 57 (1967); Carlson, Langer, Mechanical model of an earthquake fault,
    Physical Review A 40 (1989).  Their blocks cannot slip backward; these can.

    **Arguments** (dimensionless): `friction`, a `TanhFriction`; `speed` = V; `stiffness` = k_p and
    `mass` = m > 0; `coupling` = k_c.  `with_` also takes the numbers of the friction by name.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import ExponentialDecay, TanhFriction, simulate
        >>> from jaxchain.model import BurridgeKnopoff
        >>> friction = TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), width=1e-2)
        >>> fault = BurridgeKnopoff(friction, speed=0.1, ends="free")
        >>> start = (0.1 * jnp.sin(jnp.arange(5.0)), jnp.zeros(5))
        >>> for t in (4.0, 12.0):
        ...     stretch, velocity = simulate(fault, start, t).state
        ...     print(bool((abs(velocity) < 0.02).all()))  # whether all blocks stick
        True
        False
    """

    friction: TanhFriction
    speed: PerMass = eqx.field(converter=_number("speed", check_finite))
    stiffness: PerMass = eqx.field(converter=_number("stiffness"), default=1.0)
    coupling: PerMass = eqx.field(converter=_number("coupling", check_finite), default=1.0)
    mass: PerMass = eqx.field(converter=_number("mass"), default=1.0)
    ends: Ends = eqx.field(static=True, default="cyclic")
    components = ("stretch", "velocity")

    def __check_init__(self) -> None:
        wanted = "smoothed friction, `TanhFriction(law, width)`"
        check_kind("friction", self.friction, TanhFriction, wanted)

    def switching(
        self, t: ScalarLike, v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], PerMass]:
        """(v, width): friction changes its sign as a block comes to rest."""
        return v, self.friction.width

    def release_acceleration(self) -> PerMass:
        """mu_st / m."""
        return self.friction.law.mu_static / self.mass

    def rate(self, t: ScalarLike, left: State, own: State, right: State) -> Rates:
        u, v = own
        pull = self.stiffness * u - self.coupling * _bend(left, own, right)
        return self.speed - v, (pull + self.friction.force(v)) / self.mass

    def friction_scales(self) -> tuple[AbstractFrictionLaw, Any, Any, Any]:
        """The block's own friction: the load is 1."""
        unit = 1.0 / jnp.sqrt(jnp.min(self.stiffness * self.mass))
        return self.friction.law, 1.0, jnp.max(jnp.abs(self.speed)), unit
