"""Friction laws mu(s), one small class each, and their smoothing.

A law gives the friction coefficient at the sliding speed s = |w| >= 0, where w = v - v_d is the
velocity of a mass relative to the belt. Everything is dimensionless: mu is friction force per
normal load, and speeds are in units of x0 omega_n (`jaxchain.model.units`). Every parameter is one
number, or one per mass (shape (n,), for mistuned chains), and a leaf of a pytree: `jit`,
`vmap`, `grad` and `jvp` work.
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._checks import (
    check_at_least,
    check_finite,
    check_known,
    check_nonnegative,
    check_per_mass,
    check_positive,
    is_traced,
    named,
    shown,
    to_float,
)
from .._computed_once import spread
from .._final import final, refuse_overrides
from .._printing import PrintedAsCall, Sketch
from .._types import PerMass
from .parameters import CHAIN, parameter

# Speeds at which a law is checked: from below any change to beyond any mass.
_SPEEDS = np.concatenate([[0.0], np.geomspace(1e-12, 1e2, 1121)])
# Of these, how many keep a search inside the domain of a law of your own.
_MARGINS = 33
# Shares of the greatest friction: a jump, and a difference that may hide one and is refined.
_JUMP, _STEEP = 1e-6, 1e-9
# The refinement repeatedly takes the steepest part of an interval, down to rounding.
_PARTS, _ROUNDS, _MOST = 16, 10, 32


def check_curve(name: str, coefficient: Callable[[Any], Any], mu_static: Any) -> None:
    """Raises `ValueError` with the speed at which mu is negative, not finite, or jumps.

    **Arguments:** `name` of the law, for the error; `coefficient` = mu of an array of speeds, of
    shape (speeds,) or (speeds, n), made of concrete numbers; `mu_static`, which mu(0) must be.
    """
    curve = f"Friction law `{name}`"

    def mu(speeds: np.ndarray) -> np.ndarray:
        """Of shape (speeds, 1), or (speeds, n)."""
        with jax.ensure_compile_time_eval():
            values = np.asarray(coefficient(jnp.asarray(speeds)), float)
        if values.shape[:1] != speeds.shape:
            raise ValueError(
                f"{curve} must take speeds element by element, but of an array of shape "
                f"{speeds.shape} it makes one of shape {values.shape}."
            )
        return values.reshape(speeds.size, -1)

    values = mu(_SPEEDS)
    for bad, what in ((~np.isfinite(values), "not finite"), (values < 0, "negative")):
        if np.any(bad):
            row, mass = np.argwhere(bad)[0]
            raise ValueError(
                f"{curve} is {what} at the speed {_SPEEDS[row]:.6g}: mu = {values[row, mass]:.6g}."
                f" Up to a speed of {_SPEEDS[-1]:g} it must be finite and at least 0."
            )
    least_jump = _JUMP * values.max()
    if np.any(values[0] > np.asarray(mu_static, float) + least_jump):
        raise ValueError(
            f"{curve} rises at the speed 0: `mu_static` is {mu_static}, but mu(0) is "
            f"{np.squeeze(values[0])}. Friction at rest must be at least mu(0): raise `mu_static`."
        )
    jump, speed = _greatest_jump(mu, values)
    if jump > least_jump:
        raise ValueError(
            f"{curve} jumps at the speed {speed:.6g}, by {jump:.6g}. mu(s) must be continuous: "
            "let it change over a small range of speeds."
        )


def _greatest_jump(
    mu: Callable[[np.ndarray], np.ndarray], values: np.ndarray
) -> tuple[float, float]:
    """(height, speed) of the greatest change between two speeds that are equal to rounding."""
    rise = np.max(np.abs(np.diff(values, axis=0)), axis=1)
    beside = np.pad(rise, 1)
    stands_out = rise > 3 * (beside[:-2] + beside[2:]) + _STEEP * values.max()
    steep = np.flatnonzero(stands_out)
    if steep.size == 0:
        return 0.0, 0.0
    steep = steep[np.argsort(-rise[steep])][:_MOST]
    low, high, row = _SPEEDS[steep], _SPEEDS[steep + 1], np.arange(min(steep.size, _MOST))
    for _ in range(_ROUNDS):
        parts = np.linspace(low, high, _PARTS + 1, axis=1)
        values = mu(parts.ravel()).reshape(*parts.shape, -1)
        change = np.max(np.abs(np.diff(values, axis=1)), axis=2)
        at = np.argmax(change, axis=1)
        low, high, rise = parts[row, at], parts[row, at + 1], change[row, at]
    greatest = np.argmax(rise)
    return float(rise[greatest]), float(high[greatest])


_SIGNS = {"any": check_finite, "nonnegative": check_nonnegative, "positive": check_positive}
# Names that a law cannot define: its curve is `coefficient` everywhere.
_FINAL = {
    "force": "it is -coefficient(|w|) sign(w).",
    "force_and_slope": "JAX differentiates `coefficient` by itself; leave it out.",
    "stick_speed": "dry friction sticks at speed 0; smooth the law by `TanhFriction`.",
    "law": "a law is its own; leave it out.",
    "parameters": "they are the fields that are not static.",
    "drop": "it is `mu_static` less mu(0).",
    "with_": "it changes the fields by their names; make each number a field.",
}


def _number(name: str) -> Callable[[Any], Array]:
    """The converter of a field that is the parameter of this name."""
    return named(name, parameter(name).remedy)


class AbstractFriction(PrintedAsCall, eqx.Module):
    """F(w), the force on a mass per normal load; w is its velocity relative to the belt.

    A subclass has mu(s) as `law`, smoothed or not.
    """

    @abc.abstractmethod
    def force(self, relative_velocity: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        """F(w), element by element; w of any shape, or (n,) if a parameter is given per mass."""

    @abc.abstractmethod
    def stick_speed(self) -> PerMass:
        """The |w| of greatest friction, the end of the branch on which a mass sticks."""

    @abc.abstractmethod
    def parameters(self) -> dict[str, Any]:
        """The names and values of the parameters that `with_` accepts, also `Chain.with_`."""

    @abc.abstractmethod
    def with_(self, **changes: Any) -> Any:
        """A copy with other parameters; a `width` smooths a law, and None makes friction dry."""

    def _sketch(self, reach: float = 1.0, belt_speed: Any = None) -> Sketch:
        """F over relative velocities up to `reach`; steady sliding on a belt of this speed."""
        speeds = reach * np.concatenate([np.geomspace(1e-7, 1e-3, 60), np.linspace(2e-3, 1, 200)])
        w = np.concatenate([-speeds[::-1], speeds])
        force = np.asarray(self.force(jnp.asarray(w)[:, None]))
        law: Any = vars(self).get("law", self)
        if law is self:  # dry: it jumps
            w = np.concatenate([w[:260], [0.0, 0.0], w[260:]])
            static = np.broadcast_to(to_float(law.mu_static), force.shape[1:])
            force = np.concatenate([force[:260], [static, -static], force[260:]])
        points = []
        if belt_speed is not None:
            forces = np.ravel(self.force(-to_float(belt_speed)))
            points = [(-belt_speed, force, "steady sliding") for force in forces]
        return Sketch("relative velocity", "friction per load", [(w, force)], points)

    def force_and_slope(
        self, relative_velocity: Float[ArrayLike, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """(F, dF/dw), which share their exp and tanh.

        F acts element by element, so one tangent of ones carries every slope.
        """
        w = jnp.asarray(relative_velocity)
        return jax.jvp(self.force, (w,), (jnp.ones_like(w),))


class AbstractFrictionLaw(AbstractFriction):
    """The friction coefficient as a function of the sliding speed alone.

    It is dry friction: F(w) = -mu(|w|) sign(w), and any force up to mu_st at w = 0.  Your own law
    needs a field or property `mu_static` and the method `coefficient`, written with `jax.numpy`.
    You can then smooth it with `TanhFriction`, simulate, sweep and differentiate it.  Its fields
    are numbers, one or one per mass; anything else, such as a whole exponent, is a static field,
    `p: int = equinox.field(static=True)`.

    mu(s) must be continuous for s > 0, and analytic except at the speeds in `knots`.  `mu_static`
    may exceed mu(0): friction then falls at once when a mass is released, see `StaticKinetic`.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Chain, equation_8, simulate
        >>> from jaxchain.model import AbstractFrictionLaw
        >>> class Rational(AbstractFrictionLaw):
        ...     mu_static: float
        ...     v_ref: float
        ...     def coefficient(self, speed):
        ...         return self.mu_static / (1.0 + speed / self.v_ref)
        >>> dry = Chain(1, Rational(1.0, 1.5), belt_speed=0.5)
        >>> start = equation_8(dry, 1)
        >>> runs = [simulate(own, start, 5.0) for own in (dry.with_(width=1e-4), dry)]
        >>> [round(float(run.state[0][0]), 3) for run in runs]
        [1.186, 1.186]
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        refuse_overrides(cls, AbstractFrictionLaw, _FINAL)

    mu_static: eqx.AbstractVar[PerMass]
    """Friction at rest, at least mu(0): a sticking mass holds while |force| <= mu_static."""
    _continuous: ClassVar[bool] = False  # whether mu(0) is `mu_static` by the formula
    _falls: ClassVar[bool] = False  # whether friction is meant to fall at a release

    @property
    def knots(self) -> ArrayLike | Sequence[float] | None:
        """Increasing speeds > 0 at which steps end, of shape (knots,) or (knots, n), or None.

        These are the speeds at which mu is not analytic.  A law with cases (`jnp.where`,
        `jnp.maximum`, ...) must list them, or `knots = ()` if there are none; otherwise it is
        refused.  List also a speed at which mu starts to change after being constant, which Taylor
        coefficients cannot show.
        """
        return None

    @abc.abstractmethod
    def coefficient(self, speed: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        """mu(speed), element by element.

        **Arguments:** `speed` = |w| >= 0, of any shape; of shape (n,) or () if a parameter is
        given per mass.
        """

    def drop(self) -> PerMass | None:
        """mu_static - mu(0), by which friction falls at a release; None if it never does."""
        if self._continuous:
            return None
        return self.mu_static - self.coefficient(jnp.zeros_like(to_float(self.mu_static)))

    def force(self, relative_velocity: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        """F(w) of a mass that slides, and 0 at w = 0."""
        w = jnp.asarray(relative_velocity)
        return -jnp.sign(w) * self.coefficient(jnp.abs(w))

    def stick_speed(self) -> PerMass:
        """0, because friction is dry."""
        return jnp.zeros(())

    @property
    def law(self) -> "AbstractFrictionLaw":
        """This law."""
        return self

    def parameters(self) -> dict[str, Any]:
        """The fields by name, except static ones: the names that `with_` accepts."""
        return {
            f.name: getattr(self, f.name) for f in fields(self) if not f.metadata.get("static")
        }

    def with_(self, **changes: Any) -> Any:
        width = changes.pop("width", None)
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        check_known(f"`{type(self).__name__}.with_`", changes, [*values, "width"])
        law = type(self)(**{**values, **changes}) if changes else self
        return law if width is None else TanhFriction(law, width)

    def __check_init__(self) -> None:
        # The laws of this module need no check beyond that of their parameters.
        if type(self).__module__ != __name__ and not is_traced(self):
            per_mass = any(np.ndim(number) for number in self.parameters().values())
            mu = jax.vmap(self.coefficient) if per_mass else self.coefficient
            check_curve(type(self).__name__, mu, self.mu_static)


class ExponentialDecay(AbstractFrictionLaw):
    """mu(s) = mu_d + (mu_st - mu_d) exp(-s / v0): friction that weakens with speed.

    Source: eq. (1) of "Multiple spatially localized dynamical states in friction-excited
    oscillator chains"; the example has its parameters, eq. (7).

    **Arguments:** `mu_static` = mu_st and `mu_dynamic` = mu_d, the friction coefficients at zero
    and at high speed, 0 <= mu_d <= mu_st; `v_ref` = v0 > 0, a speed in units of x0 omega_n.

    **Raises:** `ValueError` for anything else.

    >>> from jaxchain import ExponentialDecay
    >>> law = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5)
    >>> float(law.coefficient(0.0)), round(float(law.coefficient(0.5)), 6)
    (1.0, 0.68394)
    """

    _continuous = True
    mu_static: PerMass = eqx.field(converter=_number("mu_static"))
    mu_dynamic: PerMass = eqx.field(converter=_number("mu_dynamic"))
    v_ref: PerMass = eqx.field(converter=_number("v_ref"))

    def __check_init__(self) -> None:
        _check_weakening(self)

    def coefficient(self, speed: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        drop = self.mu_static - self.mu_dynamic
        scaled = speed * (1.0 / self.v_ref)  # a product costs less than a division per mass
        return self.mu_dynamic + drop * jnp.exp(-scaled)


class WeakeningStrengthening(AbstractFrictionLaw):
    """mu(s) = mu_d + (mu_st - mu_d) exp(-s / v0) + mu_v s / v0: weakens, then strengthens.

    Exponential decay plus viscous friction. For 0 < mu_v < mu_st - mu_d friction has its minimum
    at s = v0 ln[(mu_st - mu_d) / mu_v]. For a greater mu_v it only grows. For mu_v = 0 the law is
    `ExponentialDecay`.

    Source: the Stribeck curve with an exponential and a linear term, in the same form F_Coulomb +
    F_prop s + F_Stribeck exp(-f_exp s) in the Modelica Standard Library,
    `Mechanics.Translational.Components.MassWithStopAndFriction`. A law of this kind on one mass is
    the subject of Papangelo, Ciavarella, Hoffmann, "Subcritical bifurcation in a self-excited
    single-degree-of-freedom system with velocity weakening-strengthening friction law", Nonlinear
    Dynamics 90 (2017). We have not compared how that paper scales its terms: to reproduce it,
    check its parameters against the formula above.

    **Arguments:** `mu_static` = mu_st, `mu_dynamic` = mu_d and `v_ref` = v0 as in
    `ExponentialDecay`; `mu_viscous` = mu_v >= 0, the growth of friction per v0 of speed.

    **Raises:** `ValueError` for anything else.

    >>> from jaxchain import WeakeningStrengthening
    >>> law = WeakeningStrengthening(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5, mu_viscous=0.1)
    >>> [round(float(law.coefficient(s)), 4) for s in (0.0, 0.8, 5.0)]
    [1.0, 0.7609, 1.5]
    """

    _continuous = True
    mu_static: PerMass = eqx.field(converter=_number("mu_static"))
    mu_dynamic: PerMass = eqx.field(converter=_number("mu_dynamic"))
    v_ref: PerMass = eqx.field(converter=_number("v_ref"))
    mu_viscous: PerMass = eqx.field(converter=_number("mu_viscous"))

    def __check_init__(self) -> None:
        _check_weakening(self)

    def coefficient(self, speed: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        drop = self.mu_static - self.mu_dynamic
        scaled = speed * (1.0 / self.v_ref)  # a product costs less than a division per mass
        return self.mu_dynamic + drop * jnp.exp(-scaled) + self.mu_viscous * scaled


class GaussianStribeck(AbstractFrictionLaw):
    """mu(s) = mu_d + (mu_st - mu_d) exp(-(s / v_s)^2) + mu_v s / v_s: the Stribeck curve.

    `WeakeningStrengthening` weakens most at s = 0.  This law has the slope mu_v / v_s there and
    weakens most at s = v_s / sqrt(2), at the rate [(mu_st - mu_d) sqrt(2 / e) - mu_v] / v_s.

    Sources: B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, A survey of models, analysis
    tools and compensation methods for the control of machines with friction, Automatica 30 (1994);
    with the exponent 2, which is the most usual, C. Canudas de Wit, H. Olsson, K. J. Astrom,
    P. Lischinsky, A new model for control of systems with friction, IEEE Transactions on Automatic
    Control 40 (1995).  They write F_C = p mu_d, F_S = p mu_st, and F_v = p mu_v / v_s per speed.

    **Arguments:** `mu_static` = mu_st, `mu_dynamic` = mu_d and `mu_viscous` = mu_v as in
    `WeakeningStrengthening`; `v_ref` = v_s > 0, the Stribeck speed, in units of x0 omega_n.

    **Raises:** `ValueError` for anything else.

    >>> from jaxchain.model import GaussianStribeck
    >>> law = GaussianStribeck(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5, mu_viscous=0.1)
    >>> [round(float(law.coefficient(s)), 4) for s in (0.0, 0.5, 5.0)]
    [1.0, 0.7839, 1.5]
    """

    _continuous = True
    mu_static: PerMass = eqx.field(converter=_number("mu_static"))
    mu_dynamic: PerMass = eqx.field(converter=_number("mu_dynamic"))
    v_ref: PerMass = eqx.field(converter=_number("v_ref"))
    mu_viscous: PerMass = eqx.field(converter=_number("mu_viscous"))

    def __check_init__(self) -> None:
        _check_weakening(self)

    def coefficient(self, speed: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        drop = self.mu_static - self.mu_dynamic
        scaled = speed * (1.0 / self.v_ref)
        return self.mu_dynamic + drop * jnp.exp(-(scaled**2)) + self.mu_viscous * scaled

    @property
    def knots(self) -> Float[Array, "3 ..."]:
        # Beyond 6 v_s weakening is below rounding.
        return jnp.multiply.outer(jnp.array([2.0, 4.0, 6.0]), self.v_ref)


class Coulomb(AbstractFrictionLaw):
    """mu(s) = mu_d: the same friction at every speed.

    It feeds no energy into a mass, so steady sliding is stable at every belt speed.

    Source: Coulomb (1785); the limit v0 -> infinity or mu_st -> mu_d of `ExponentialDecay`.

    **Arguments:** `mu_dynamic` = mu_d >= 0.

    **Raises:** `ValueError` if it is negative or not finite.

    >>> from jaxchain import Coulomb
    >>> law = Coulomb(mu_dynamic=0.5)
    >>> float(law.coefficient(3.0)), float(law.mu_static)
    (0.5, 0.5)
    """

    _continuous = True
    mu_dynamic: PerMass

    # Written out, because a type checker takes the abstract `mu_static` for a first argument.
    def __init__(self, mu_dynamic: ArrayLike) -> None:
        self.mu_dynamic = _number("mu_dynamic")(mu_dynamic)

    def __check_init__(self) -> None:
        check_per_mass(**vars(self))
        check_numbers(vars(self))

    @property
    def mu_static(self) -> PerMass:
        return self.mu_dynamic

    def coefficient(self, speed: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        return self.mu_dynamic * jnp.ones_like(speed)


class StaticKinetic(AbstractFrictionLaw):
    """mu = mu_s at rest and mu(s) = mu_k at every speed s > 0: the two numbers of the handbooks.

    A sticking mass is let go where the force that holds it exceeds p mu_s; there friction falls at
    once to p mu_k, so that the mass leaves with the acceleration p (mu_s - mu_k).  It sticks again
    where it comes to rest on the belt with a force of at most p mu_s.  Between these two friction
    only dissipates, so steady sliding is stable, beside a vibration that sticks and slips.

    `TanhFriction` refuses it: a mass that creeps in a layer of any width never feels p mu_s.

    Source: D. Karnopp, Computer simulation of stick-slip friction in mechanical dynamic systems,
    Journal of Dynamic Systems, Measurement, and Control 107 (1985).

    **Arguments:** `mu_static` = mu_s and `mu_kinetic` = mu_k, 0 <= mu_k <= mu_s.

    **Raises:** `ValueError` for anything else.

    !!! example

        A block on a table is pulled through a spring whose end moves at the speed 1; it slips
        after the time mu_s:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Chain, StaticKinetic, StickTime, simulate
        >>> law = StaticKinetic(mu_static=0.6, mu_kinetic=0.4)
        >>> block = Chain(1, law, belt_speed=1.0, damping_ratio=0.0)
        >>> start = jnp.zeros(1), jnp.ones(1)
        >>> run = simulate(block, start, 2.0, observe=StickTime())
        >>> print(run.observed.round(6))
        [0.6]
    """

    _falls = True
    mu_static: PerMass = eqx.field(converter=_number("mu_static"))
    mu_kinetic: PerMass = eqx.field(converter=_number("mu_kinetic"))

    def __check_init__(self) -> None:
        _check_weakening(self)

    def coefficient(self, speed: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        return self.mu_kinetic * jnp.ones_like(speed)


def as_law(law: Any) -> AbstractFrictionLaw:
    """`law` with JAX arrays for all parameters; Python numbers would have no tangents.

    A function in it, such as the activation of a neural network, becomes part of its structure.

    **Raises:** `ValueError` for anything but an `AbstractFrictionLaw`, and for a field with the
    name of a parameter of the chain.
    """
    if not isinstance(law, AbstractFrictionLaw):
        raise ValueError(
            "Argument `law` must be an `AbstractFrictionLaw`, such as `ExponentialDecay(...)`, "
            f"but is {shown(law)}."
        )
    if taken := sorted({*CHAIN, "n", "ends", "friction", "width"} & set(law.parameters())):
        raise ValueError(
            f"Friction law `{type(law).__name__}` cannot have the field `{taken[0]}`, which is "
            "the name of a number of the chain: rename it."
        )
    kinds = (int, float, np.number, np.ndarray, jax.Array)

    def converted(leaf: Any) -> Any:
        if callable(leaf):
            return jax.tree_util.Partial(leaf)
        number = isinstance(leaf, kinds) and jnp.issubdtype(jnp.result_type(leaf), jnp.number)
        return to_float(leaf) if number else leaf

    if all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(law)):
        return law
    return jax.tree.map(converted, law)


@final
class TanhFriction(AbstractFriction):
    """F(w) = -mu(|w|) tanh(w / eps): a friction law smoothed around w = 0.

    F is the force on a mass per unit of its normal load, and w its velocity relative to the belt.
    eps is the regularization width. For |w| below about eps, a steep slope -mu_st / eps replaces
    the jump of dry friction from +mu_st to -mu_st, and a sticking mass creeps. F is once
    continuously differentiable; its second derivative jumps at w = 0, because mu depends on |w|.
    The greatest force falls short of mu_st by O(eps ln 1/eps): for `ExponentialDecay` with mu_st =
    1 and mu_d = v0 = 0.5 it is mu_st - (eps / 2) [ln(4 / eps) + 1] + O(eps^2 ln^2 eps).

    **Arguments:** `law`, any `AbstractFrictionLaw`; `width` = eps > 0, a speed in units of
    x0 omega_n, one number or one per mass.

    **Raises:** `ValueError` if `width` is not positive and finite.

    >>> from jaxchain import ExponentialDecay, TanhFriction
    >>> friction = TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), width=0.01)
    >>> force, slope = friction.force_and_slope(0.0)
    >>> float(force), float(slope)
    (-0.0, -100.0)
    """

    law: AbstractFrictionLaw = eqx.field(converter=as_law)
    width: PerMass = eqx.field(converter=_number("width"))

    def __check_init__(self) -> None:
        check_per_mass(mu_static=self.law.mu_static, width=self.width)
        check_numbers({"width": self.width})
        drop = self.law.drop()
        falls = self.law._falls if is_traced(drop) else drop is not None
        if falls and (is_traced(drop) or np.any(drop > _JUMP * np.max(self.law.mu_static))):
            raise ValueError(
                "Argument `width` smooths friction around rest, but this law falls there from "
                f"mu_static = {self.law.mu_static} to mu(0): a mass that creeps in the layer "
                "never feels `mu_static`. Leave `width` out (dry friction), or take a law that "
                "falls over a range of speeds, such as `ExponentialDecay`."
            )

    def force(self, relative_velocity: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        """F(w) of a velocity w relative to the belt, of the same shape."""
        # One division for the chain and products for the masses save a twentieth of a step.
        direction = jnp.tanh(relative_velocity * (1.0 / self.width))
        return -self.law.coefficient(jnp.abs(relative_velocity)) * direction

    def stick_speed(self) -> PerMass:
        """The |w| of greatest friction, the end of the branch on which a mass sticks.

        (eps / 2) ln [4 mu_st / (eps |mu'(0)|)] to leading order in eps.  Friction that does not
        weaken has no maximum and is treated as if it weakened by 1e-3 of mu_st per unit of speed.
        """
        zero = jnp.zeros_like(self.width + self.law.mu_static)
        _, slope = jax.jvp(self.law.coefficient, (zero,), (jnp.ones_like(zero),))
        weakening = jnp.maximum(-slope, 1e-3 * self.law.mu_static)
        ratio = 4.0 * self.law.mu_static / jnp.maximum(self.width * weakening, 1e-300)
        return 0.5 * self.width * jnp.log(jnp.maximum(ratio, jnp.e))

    def parameters(self) -> dict[str, Any]:
        return {**self.law.parameters(), "width": self.width}

    def with_(self, **changes: Any) -> Any:
        return self.law.with_(**{"width": self.width, **changes})


def spread_friction(friction: Any, like: Float[Array, " n"]) -> Any:
    """`friction` with one value for each mass in place of one for all: see `spread`.

    Laws of other modules, which may be written for single numbers, stay as they are.
    """
    known = type(friction.law).__module__ == __name__
    return jax.tree.map(lambda a: spread(a, like), friction) if known else friction


def check_numbers(numbers: Mapping[str, Any]) -> None:
    """Raises `ValueError` for a parameter outside its domain, see `model/parameters.py`."""
    for name, value in numbers.items():
        row = parameter(name)
        _SIGNS[row.sign](name, value, row.remedy)
        for floor in numbers.keys() & row.floors:
            check_at_least(name, value, floor, numbers[floor], row.floor_remedy)


def number_margins(numbers: Mapping[str, Any]) -> dict[str, Array]:
    """How far parameters are inside their domain, by words for its edges: at least 0 inside."""
    found = {}
    for name, value in numbers.items():
        row = parameter(name)
        if (row.searched or row.sign) != "any":
            found[f"{name} = 0"] = value
        for floor in numbers.keys() & row.floors:
            found[f"{name} = {floor}"] = value - numbers[floor]
    return found


def friction_margins(friction: Any) -> dict[str, Array]:
    """`number_margins` of a law, smoothed or not; of a law of your own its curve is at least 0."""
    law, numbers = friction.law, friction.parameters()
    if type(law).__module__ == __name__:
        return number_margins(numbers)
    speeds = jnp.asarray(_SPEEDS[:: _SPEEDS.size // _MARGINS])
    own = {"width": numbers["width"]} if "width" in numbers else {}
    return {"mu(s) = 0": jax.vmap(law.coefficient)(speeds), **number_margins(own)}


def _check_weakening(
    law: ExponentialDecay | WeakeningStrengthening | GaussianStribeck | StaticKinetic,
) -> None:
    check_per_mass(**vars(law))
    check_numbers(vars(law))
