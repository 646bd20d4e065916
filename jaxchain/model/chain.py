"""The chain of friction-excited oscillators: parameters, vector field, steady sliding."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from .._checks import (
    check_kind,
    check_known,
    check_one_of,
    check_whole,
    is_traced,
    shown,
    to_float,
)
from .._computed_once import spread
from .._final import final
from .._types import PerMass, ScalarLike, State
from .contacts import Contact, Stop
from .entries import with_entries
from .friction import (
    AbstractFriction,
    AbstractFrictionLaw,
    ExponentialDecay,
    TanhFriction,
    as_law,
    check_numbers,
    friction_margins,
    number_margins,
    spread_friction,
)
from .model import AbstractModel
from .oscillators import AbstractOscillators
from .parameters import CHAIN, SPEED, Parameter, parameter
from .springs import Ends, Springs
from .tabulated import TabulatedFriction
from .tridiagonal import exact_solver
from .units import Scales

# Numbers beyond these are probably in SI units.
_PLAUSIBLE = {
    "damping_ratio": (10.0, "N s/m"),
    "stiffness": (100.0, "N/m"),
    "normal_load": (100.0, "N"),
}
# Shares of the belt speed at which mu is sampled; by how much its maximum may exceed that of the
# samples, and by which share a period may be below the bound.
_SHARES, _BETWEEN, _ROUNDING = np.linspace(0.0, 1.0, 33), 2.0, 1e-6
MAKE_CHAIN = "make one with `paper_chain()` or `Chain(...)`."


@final
class Chain(AbstractOscillators):
    """N masses on a moving belt, coupled to their nearest neighbours (dimensionless).

    x_n'' + 2 xi_n x_n' + k_n x_n + c_{n-1/2} (x_n - x_{n-1}) + c_{n+1/2} (x_n - x_{n+1})
        = p_n F(x_n' - v_d)

    The friction force F is dry, so that any number of masses may stick, or smoothed around w = 0.
    Every computation uses the friction of the chain.  For the homogeneous ring this is eq. (5) of
    Papangelo et al., Multiple spatially localized dynamical states in friction-excited oscillator
    chains.

    **Arguments** (all dimensionless; see `Chain.from_si` for SI units):

    - `n`: number of masses.
    - `friction`: a dry friction law such as `ExponentialDecay(...)`, or a smoothed one,
      `TanhFriction(law, width)`.
    - `belt_speed`: v_d; negative for a belt that runs the other way; one number, or shape (n,) for
      a belt under each mass, whose speeds searches over belt speeds do not know.
    - `damping_ratio`: xi, one number or shape (n,).
    - `coupling`: eta_c.  None: no springs between masses.  A number: equal springs.  An array: one
      constant per spring (n springs in a ring, n - 1 with free ends; spring i joins masses i and i
      + 1).
    - `stiffness`: k_n, one number or shape (n,), 1 for the nominal mass.
    - `normal_load`: p_n relative to the nominal load, one number or shape (n,); None is 1.
    - `ends`: "cyclic" (a ring) or "free".

    Every parameter is a leaf of a pytree, so `jit`, `vmap`, `grad` and `jvp` work.
    `chain.with_(belt_speed=...)` returns a changed copy.

    **Raises:** `ValueError` for a wrong shape or a non-finite or impossible value.  A damping
    ratio above 10, and a relative stiffness or load above 100, give a warning: they are probably
    SI units.

    !!! example

        >>> from jaxchain import Chain, ExponentialDecay, TanhFriction
        >>> law = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5)
        >>> chain = Chain(3, TanhFriction(law, 1e-3), belt_speed=1.5, coupling=0.01)
        >>> chain.coupling.shape, chain.dry
        ((), False)
    """

    friction: AbstractFriction
    belt_speed: Array
    damping_ratio: Array
    stiffness: Array
    normal_load: Array | None
    springs: Springs | None
    n: int = eqx.field(static=True)
    frictional = True

    def __init__(
        self,
        n: int,
        friction: Any,
        belt_speed: ArrayLike,
        damping_ratio: ArrayLike = 0.05,
        coupling: ArrayLike | None = None,
        stiffness: ArrayLike = 1.0,
        normal_load: ArrayLike | None = None,
        ends: str = "cyclic",
    ):
        check_one_of("ends", ends, get_args(Ends))
        if not isinstance(friction, AbstractFrictionLaw | TanhFriction):
            raise ValueError(
                "Argument `friction` must be a friction law (dry friction) or a smoothed one, "
                f"TanhFriction(law, width), but is {shown(friction)}."
            )
        self.n = check_whole("n", n)
        self.friction = as_law(friction) if isinstance(friction, AbstractFrictionLaw) else friction
        self.belt_speed = chain_number("belt_speed", belt_speed)
        self.damping_ratio = chain_number("damping_ratio", damping_ratio)
        self.stiffness = chain_number("stiffness", stiffness)
        self.normal_load = (
            None if normal_load is None else chain_number("normal_load", normal_load)
        )
        kind: Ends = "cyclic" if ends == "cyclic" else "free"
        self.springs = (
            None if coupling is None else Springs(chain_number("coupling", coupling), kind)
        )
        springs = self.n if ends == "cyclic" else self.n - 1
        counts = {"mass": self.n, "spring": springs}
        for name, value in {**_chain_numbers(self), **self.friction.parameters()}.items():
            per, shape = parameter(name).per, np.shape(value)  # () for None
            if shape not in ((), (counts[per],)):
                raise ValueError(
                    f"Argument `{name}` must be one number or one per {per}, of shape "
                    f"({counts[per]},), but has shape {shape}: the chain has {self.n} masses and "
                    f"{ends} ends; `jax.vmap` or `sweep` run many."
                )

    @classmethod
    def from_si(
        cls,
        n: int,
        friction: Any,
        belt_speed: Any,
        *,
        mass: ScalarLike,
        damping: ScalarLike,
        stiffness: ScalarLike,
        normal_load: ScalarLike,
        coupling_stiffness: ScalarLike | None = None,
        ends: str = "cyclic",
    ) -> tuple[Chain, Scales]:
        """The chain of a rig given in SI units, and the scales that convert its results.

        **Arguments:** `n`, the number of masses; `friction`, a law of `jaxchain.model`, dry or
        smoothed, with all speeds (`v_ref`, `width`, those of a table) in m/s; `belt_speed` v_d
        [m/s]; of each mass `mass` m [kg], `damping` c [N s/m], `stiffness` k [N/m] and
        `normal_load` P [N]; `coupling_stiffness` k_c [N/m], or None without springs between
        masses; `ends` as for `Chain`.

        **Returns:** (chain, scales).  The chain is dimensionless, as all results are;
        `scales.to_dimensional(value, "velocity")` gives them in m/s, and so on.

        **Raises:** `ValueError` as `Scales.from_dimensional` and `Chain`, and for a law of your
        own, whose speeds are not known.

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Chain, ExponentialDecay, steady_sliding
        >>> chain, scales = Chain.from_si(
        ...     1, ExponentialDecay(1.0, 0.5, v_ref=0.25), belt_speed=0.75,
        ...     mass=2.0, damping=2.0, stiffness=200.0, normal_load=10.0,
        ... )
        >>> chain
        Chain(n=1, friction=ExponentialDecay(mu_static=1, mu_dynamic=0.5, v_ref=0.5),
          belt_speed=1.5, damping_ratio=0.05, stiffness=1, ends='cyclic')
        >>> x, v = steady_sliding(chain)
        >>> print(scales.to_dimensional(x, "displacement").round(6))  # in m
        [0.026245]
        """
        wanted = "a friction law of `jaxchain.model`, or `TanhFriction` of one"
        check_kind("friction", friction, AbstractFriction, wanted)
        scales = Scales.from_dimensional(mass, damping, stiffness, coupling_stiffness, normal_load)
        unit = scales.unit("velocity")
        law = friction.law
        if not type(law).__module__.startswith(f"{__package__}."):
            raise ValueError(
                f"Argument `friction` is a `{type(law).__name__}`, which may have other speeds "
                'than `v_ref`: convert them by `Scales.to_dimensionless(value, "velocity")`, and '
                "use `Chain(...)`."
            )
        speeds = {
            name: value / unit
            for name, value in friction.parameters().items()
            if parameter(name).unit == SPEED
        }
        if isinstance(law, TabulatedFriction):
            law = TabulatedFriction(law.speed / unit, law.mu)
        friction = law.with_(**speeds)
        speed = to_float(belt_speed, "belt_speed", "give it in m/s.") / unit
        return cls(n, friction, speed, scales.damping_ratio, scales.coupling, ends=ends), scales

    @property
    def law(self) -> AbstractFrictionLaw:
        """The friction law mu(s), without smoothing."""
        friction: Any = self.friction
        return friction.law

    @property
    def dry(self) -> bool:
        """Whether friction is dry; static, so `jit` compiles a program for each kind."""
        return not isinstance(self.friction, TanhFriction)

    @property
    def width(self) -> PerMass:
        """eps, 0 with dry friction."""
        numbers = self.friction.parameters()
        return numbers["width"] if "width" in numbers else to_float(0.0)

    @property
    def coupling(self) -> Array | None:
        """eta_c: None, one number, or one per spring."""
        return None if self.springs is None else self.springs.constant

    @property
    def ends(self) -> Ends:
        """ "cyclic" or "free"; irrelevant without coupling."""
        return "cyclic" if self.springs is None else self.springs.ends

    @property
    def load(self) -> PerMass:
        """p: one number or one per mass, 1 where none is given."""
        return jnp.ones(()) if self.normal_load is None else self.normal_load

    @property
    def frictional_contacts(self) -> tuple[Contact, ...]:
        """The contact of a mass with the belt."""
        return (Contact((1.0,), self.friction, self.load, self.belt_speed),)

    def parameter(self, name: str) -> Parameter:
        """Words, symbol, unit and domain; of a parameter of your own law the name alone."""
        return parameter(name)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """All but `coupling` of a chain without springs."""
        names = [name for name in CHAIN if name != "coupling" or self.springs is not None]
        return *names, *self.friction.parameters()

    def check_parameter(self, name: str, values: Any) -> bool:
        """Checks those of the chain; parameters of a law may depend on each other."""
        if name in CHAIN:
            chain_number(name, values)
        return name in CHAIN

    def smallest_scale(self, n: int) -> tuple[PerMass, PerMass] | None:
        """(eps, |v_d|); None with dry friction."""
        del n
        return None if self.dry else (self.width, jnp.abs(self.belt_speed))

    def friction_scales(self) -> tuple[AbstractFrictionLaw, Any, Any, Any]:
        """In the units of the nominal mass."""
        return self.law, self.load, self.belt_speed, 1.0

    def description(self, n: int) -> dict[str, Any]:
        """All that `Chain` needs to build this chain again, see `chain_of`."""
        about = {
            "n": n,
            "ends": self.ends,
            **_chain_numbers(self),
            "friction_law": type(self.law).__name__,
            **self.friction.parameters(),
            "width": self.parameters().get("width"),
        }
        if isinstance(self.law, TabulatedFriction):
            about["friction_table"] = self.law.table
        return about

    def check_locality(self, t: ScalarLike, y: State) -> None:
        """Nothing: the forces of a chain act mass by mass."""
        del t, y

    def local_force(
        self, t: ScalarLike, x: Float[Array, " n"], v: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """p_n F(v_n - v_d) - 2 xi_n v_n."""
        del t, x
        return self.load * self.friction.force(v - self.belt_speed) - 2.0 * self.damping_ratio * v

    def switching(
        self, t: ScalarLike, v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], PerMass]:
        """(v - v_d, eps or 0): friction changes direction as a mass passes the belt speed."""
        del t
        return v - self.belt_speed, self.width

    def equilibrium(self) -> State:
        """`steady_sliding`; with dry friction and a belt that stands still, x = v = 0."""
        return steady_sliding(self)

    def belt_direction(self) -> ScalarLike:
        """The sign of v_d, of the first mass if each has its own; 1 for v_d = 0."""
        return jnp.where(jnp.ravel(self.belt_speed)[0] < 0, -1.0, 1.0)

    def stick_speed(self) -> PerMass:
        """The speed of greatest friction, up to which a mass sticks; 0 with dry friction."""
        return self.friction.stick_speed()

    def static_limit(self) -> PerMass:
        """p mu_st, the greatest friction force on a sticking mass."""
        return self.load * self.law.mu_static

    def release_acceleration(self) -> PerMass:
        """p mu_st: masses are 1."""
        return self.static_limit()

    def excess_force(
        self, t: Any, left: State, own: State, right: State, contact: int = 0
    ) -> Float[Array, " n"]:
        """|r| - p mu_st with r the `free_force`; with dry friction a mass with w = 0 sticks."""
        if self.dry:
            return super().excess_force(t, left, own, right)
        x, v = own
        force = -self.stiffness_diagonal(self.n) * x - 2.0 * self.damping_ratio * v
        if self.springs is not None:
            lower, upper = self.springs.off_diagonals(self.n)
            force = force + lower * left[0] + upper * right[0]
        return jnp.abs(force) - self.static_limit()

    def free_force(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        """r = -2 xi v - K x, the force on a mass without friction."""
        return self.restoring_force(x) - 2.0 * self.damping_ratio * v

    def can_be_cycle(self, period: Any, speed: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether a cycle can have this period, and masses as fast as `speed`.

        For x'' + 2 xi x' + K x = p F(x' - v_d) two means over a period T give bounds:

        - Friction and damping depend on v_n alone, so that the mean of v_n' times them is 0, and
          with L the greatest eigenvalue of K: <v'^T v'> = <v^T K v> <= L <v^T v>.  v has mean 0,
          so <v^T v> <= (T / 2 pi)^2 <v'^T v'> (Wirtinger's inequality): T >= 2 pi / L^(1/2).
        - Friction does work on a mass only between rest and the belt speed, at most p M |v_d| with
          M the greatest mu up to there.  Damping dissipates as much: 2 xi <v^T v> <= sum_n p_n M_n
          |v_d|, xi the least xi_n > 0.  Each v_n passes through 0: max v_n^2 <= T <|v_n v_n'|> <=
          T L^(1/2) <v^T v>.  Without damping, or with negative damping, nothing bounds v.
        """
        n, belt = self.n, jnp.abs(self.belt_speed)
        stiffest = self.stiffness_diagonal(n)
        if self.springs is not None:
            stiffest = stiffest + self.springs.strength(n)  # Gershgorin's bound
        frequency = jnp.sqrt(jnp.max(stiffest))
        mu = jax.vmap(lambda share: self.law.coefficient(share * belt * jnp.ones(n)))(_SHARES)
        mu = jnp.maximum(_BETWEEN * jnp.max(mu, axis=0), self.law.mu_static)
        work = jnp.sum(belt * self.load * mu * jnp.ones(n))
        damping = 2.0 * jnp.min(self.damping_ratio)
        slow = damping * jnp.max(speed**2) <= period * frequency * work
        long = period * frequency >= (1.0 - _ROUNDING) * 2.0 * jnp.pi
        return long & ((damping <= 0) | slow)

    def accelerations(self, t: ScalarLike, y: State) -> tuple[Float[Array, " n"]]:
        """The acceleration without friction, r: masses are 1."""
        del t
        return (self.free_force(*y),)

    def inverse_mass(self, touch: Contact | Stop) -> list[Any]:
        """The acceleration by a unit force at the contact."""
        del touch
        return [1.0]

    def growth_time(self) -> ScalarLike:
        """1 / (2 |xi|) where damping is negative, infinite elsewhere."""
        rate = -2.0 * jnp.min(lax.stop_gradient(self.damping_ratio))
        return jnp.where(rate > 0, 1.0 / jnp.where(rate > 0, rate, 1.0), jnp.inf)

    def stiffness_diagonal(self, n: int) -> PerMass:
        """k_n + the constants of the springs at mass n."""
        if self.springs is None:
            return self.stiffness
        return self.stiffness + self.springs.row_sum(n)

    def with_(self, **changes: Any) -> Chain:
        """A copy with other parameters; shapes may change, values may be traced.

        It takes the names of the constructor, and for the friction `width`, `mu_static`,
        `mu_dynamic`, `v_ref` or any other field of the law.  A `width` smooths dry friction; None
        makes it dry.  Entries of a parameter per mass are
        `with_(**{"damping_ratio[3]": 0.1})`.

        >>> from jaxchain import paper_chain
        >>> float(paper_chain().with_(belt_speed=1.2, width=1e-4).width)
        0.0001
        >>> paper_chain().with_(width=None).dry
        True
        """
        changes = with_entries(changes, self.parameters(), "`Chain.with_`")
        fields = {
            "n": self.n,
            "friction": self.friction,
            "ends": self.ends,
            **_chain_numbers(self),
        }
        friction = [*self.friction.parameters(), "width"]
        check_known("`Chain.with_`", changes, [*fields, *friction])
        of_friction = {name: changes.pop(name) for name in friction if name in changes}
        fields |= changes
        if of_friction:
            fields["friction"] = fields["friction"].with_(**of_friction)
        return Chain(**fields)

    def parameters(self) -> dict[str, Array]:
        """The parameters that `with_` takes by name, including those of the friction law."""
        return {**self.friction.parameters(), **super().parameters()}


# No method: equinox makes a module for each call of one.
def _chain_numbers(chain: Chain) -> dict[str, Array | None]:
    """The parameters of the chain without those of friction, by name."""
    return {name: getattr(chain, name) for name in CHAIN}


def chain_number(name: str, value: Any) -> Array:
    """`value` as floats, checked for the parameter of this name."""
    array = to_float(value, name, parameter(name).remedy)
    check_numbers({name: array})
    most, unit = _PLAUSIBLE.get(name, (np.inf, ""))
    if not is_traced(array) and np.any(np.asarray(array) > most):
        warnings.warn(
            f"Argument `{name}` is {np.max(array):g}, more than a dimensionless one is likely to "
            f"be: {parameter(name).usual:g} is usual. If it is in SI units ({unit}), take those "
            "of `Scales.from_dimensional`.",
            stacklevel=4,
        )
    return array


def margins(chain: Chain) -> dict[str, Array]:
    """How far the parameters of a chain are inside their domain, by words for its edges.

    They are at least 0 where `Chain` and its law accept the parameters, and where damping is not
    negative, and traceable: see `stay_inside` for searches that keep them so.

    >>> from jaxchain import paper_chain
    >>> {edge: round(float(margin), 3) for edge, margin in margins(paper_chain(1)).items()}
    {'damping_ratio = 0': 0.05, 'stiffness = 0': 1.0, 'mu_static = 0': 1.0, \
'mu_static = mu_dynamic': 0.5, 'mu_dynamic = 0': 0.5, 'v_ref = 0': 0.5, 'width = 0': 0.001}
    """
    own = {name: value for name, value in _chain_numbers(chain).items() if value is not None}
    return {**number_margins(own), **friction_margins(chain.friction)}


def map_numbers(change: Callable[[Any], Any], part: Any) -> Any:
    """A chain, or parts of one, with change(value) for each parameter, of all masses or one each.

    The weights of a neural network in a friction law are no such parameters.
    """
    own = Chain | AbstractFriction | Springs

    def foreign(inner: Any) -> bool:
        return isinstance(inner, eqx.Module) and not isinstance(inner, own)

    return jax.tree.map(lambda a: a if foreign(a) else change(a), part, is_leaf=foreign)


def spread_numbers(chain: Chain, like: Float[Array, " n"]) -> Chain:
    """The chain with one value for each mass in place of one for all: see `spread`.

    Springs stay as they are.
    """

    def parts(c: Chain) -> tuple:
        return c.friction, c.belt_speed, c.damping_ratio, c.stiffness, c.normal_load

    friction, *numbers = parts(chain)
    numbers = [a if a is None else spread(a, like) for a in numbers]
    new = spread_friction(friction, like), *numbers
    return eqx.tree_at(parts, chain, new, is_leaf=lambda a: a is None)


def require_smoothed(model: Any, instead: str, name: str = "model") -> None:
    """Raises `ValueError` for a model with dry friction; `instead`: an alternative, or ""."""
    if isinstance(model, AbstractModel) and model.dry:
        raise ValueError(
            f"Argument `{name}` has dry friction, but this is for smoothed friction: "
            f"{instead}give it a width, `{name}.with_(width=1e-3)`."
        )


def paper_chain(
    n: int = 20, belt_speed: ArrayLike = 1.5, width: ArrayLike | None = 1e-3, **numbers: Any
) -> Chain:
    """The parameter set of the paper, eq. (7): xi 0.05, mu_d 0.5, mu_st 1, v_0 0.5, eta_c 0.01.

    **Arguments:** number of masses, dimensionless belt speed v_d, and the regularization width of
    the friction law, or None for dry friction; any other parameter by its name in `Chain.with_`. A
    single mass has no coupling.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> paper_chain().n, float(paper_chain(3, damping_ratio=0.1).damping_ratio)
    (20, 0.1)
    """
    check_whole("n", n, remedy="20 is the paper's.")
    law = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5)
    return Chain(
        n,
        law if width is None else TanhFriction(law, width),
        belt_speed=belt_speed,
        damping_ratio=0.05,
        coupling=0.01 if n > 1 else None,
    ).with_(**numbers)


def steady_sliding(chain: Chain) -> State:
    """The equilibrium in which every mass slides at the belt's speed: K x = p F(-v_d), v = 0.

    **Returns:** (x, v), both of shape (n,).  Exact for any chain; for a homogeneous one it is
    x_n = F(-v_d) / k.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, steady_sliding
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> x, v = steady_sliding(chain)
        >>> print(x.round(6), v)
        [0.524894 0.524894 0.524894] [0. 0. 0.]
        >>> rate_of_x, rate_of_v = chain(0.0, (x, v), None)
        >>> bool(abs(rate_of_v).max() < 1e-12)  # it is an equilibrium
        True
    """
    check_kind("chain", chain, Chain, "a `Chain`", MAKE_CHAIN)
    zero = jnp.zeros(chain.n, dtype=chain.belt_speed.dtype)
    force = chain.local_force(0.0, zero, zero)
    uniform = all(
        jnp.ndim(a) == 0
        for a in (chain.stiffness, chain.load, chain.friction.force(-chain.belt_speed))
    )
    # Equal displacements stretch no spring.
    if chain.springs is None or uniform:
        return force / chain.stiffness, zero
    solve = exact_solver(
        jnp.broadcast_to(chain.stiffness_diagonal(chain.n), zero.shape), chain.springs, 1.0
    )
    return solve(force), zero
