"""The structure of the equations of every chain.

A chain of N masses is the second-order system

    x' = v,        v' = h(t, x, v) - K x,        K = diag(k) - C,

where h acts mass by mass and C holds the couplings between nearest neighbours.  Its Jacobian is
[[0, I], [diag(dh/dx) - K, diag(dh/dv)]]; everything a Rosenbrock step has to solve is therefore
one (cyclic) tridiagonal system per stage, which `model/tridiagonal.py` solves.
"""

import abc
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._checks import require_signature
from .._final import refuse_overrides
from .._types import PerMass, ScalarLike, State
from .locality import FINAL, check_local, local_dependence
from .model import AbstractModel, StateVariable
from .parameters import SPEED
from .springs import Ends, Springs


class LocalSlopes(NamedTuple):
    """Derivatives of the local force, mass by mass; None for one that is always zero.

    dh_n/dt, dh_n/dx_n and dh_n/dv_n, each of shape (n,), from `local_force_and_slopes` of
    `AbstractOscillators`.

    See `AbstractOscillators` for an example.
    """

    time: Float[Array, " n"] | None
    displacement: Float[Array, " n"] | None
    velocity: Float[Array, " n"]


class AbstractOscillators(AbstractModel):
    """Masses with any local force, coupled by linear springs.

    x' = v,   v_n' = h_n(t, x_n, v_n) - k_n x_n + (C x)_n.

    A vector field in the sense of `diffrax.ODETerm`: call it with (t, (x, v), args).  A subclass
    gives `springs`, `local_force` and `stiffness_diagonal`, and may give `switching`,
    `release_acceleration`, `forcing_period`, `equilibrium`, `stick_speed`, `excess_force` and
    `growth_time`.  All other methods are final: defining one raises `TypeError`.  JAX computes the
    derivatives, and jaxchain detects whether h depends on t or x. For use with stock diffrax
    solvers only, a subclass may override `__call__` and `divergence`.

    !!! example

        Van der Pol's oscillators in a ring, x'' - mu (1 - x^2) x' + x + springs = 0:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, simulate
        >>> from jaxchain.model.springs import Springs
        >>> from jaxchain.model.oscillators import AbstractOscillators
        >>> class VanDerPol(AbstractOscillators):
        ...     mu: jax.Array
        ...     springs: Springs
        ...     def local_force(self, t, x, v):
        ...         return self.mu * (1.0 - x**2) * v
        ...     def stiffness_diagonal(self, n):
        ...         return 1.0 + self.springs.row_sum(n)
        >>> ring = VanDerPol(jnp.asarray(1.0), Springs(jnp.asarray(0.1), "cyclic"))
        >>> run = simulate(ring, (jnp.full(3, 2.0), jnp.zeros(3)), 8.0, observe=Amplitude())
        >>> [round(float(a), 4) for a in run.observed]
        [2.0085, 2.0085, 2.0085]
    """

    springs: eqx.AbstractVar[Springs | None]
    components = ("displacement", "velocity")
    time_unit = "1 / omega_n"

    @property
    def variables(self) -> tuple[StateVariable, ...]:
        """x_n and v_n."""
        x = StateVariable("displacement", "x0", "displacements x_n")
        return x, StateVariable("velocity", SPEED, "velocities v_n")

    def velocity_of(self, index: int) -> int | None:
        """1 of the displacement."""
        return 1 if index == 0 else None

    def check_locality(self, t: ScalarLike, y: State) -> None:
        """Raises `ValueError` unless the forces act mass by mass."""
        check_local(self, t, y)

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        refuse_overrides(cls, AbstractOscillators, FINAL)
        require_signature(cls, local_force="t, x, v", stiffness_diagonal="n", switching="t, v")
        if callable(vars(cls).get("rate")):  # a number of this name is welcome
            raise TypeError(
                f"Class `{cls.__name__}` defines `rate`, which some computations would ignore: "
                "give the forces in `local_force` and `springs`, or subclass `AbstractCells`."
            )

    @abc.abstractmethod
    def local_force(
        self, t: ScalarLike, x: Float[Array, " n"], v: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """h(t, x, v), mass by mass: all forces except those of the springs."""

    @abc.abstractmethod
    def stiffness_diagonal(self, n: int) -> PerMass:
        """The diagonal k of K, a scalar or of shape (n,); add the springs' `row_sum(n)` to it."""

    def local_force_and_slopes(
        self, t: ScalarLike, x: Float[Array, " n"], v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], LocalSlopes]:
        """(h, its derivatives).  h acts mass by mass: a tangent of ones carries the diagonal."""
        timed, displaced = self.uses(x.shape[0])
        one, ones = jnp.ones(()), jnp.ones_like(v)
        force, by_velocity = jax.jvp(lambda v: self.local_force(t, x, v), (v,), (ones,))
        by_time = by_displacement = None
        if timed:
            now = jnp.asarray(t, float)
            by_time = jax.jvp(lambda t: self.local_force(t, x, v), (now,), (one,))[1]
        if displaced:
            by_displacement = jax.jvp(lambda x: self.local_force(t, x, v), (x,), (ones,))[1]
        return force, LocalSlopes(by_time, by_displacement, by_velocity)

    @property
    def ends(self) -> Ends:
        """ "cyclic" or "free"; irrelevant without springs."""
        return "cyclic" if self.springs is None else self.springs.ends

    @property
    def structured(self) -> bool:
        """Whether structured solvers apply: `__call__` is that of this class."""
        return type(self).__call__ is AbstractOscillators.__call__

    def uses(self, n: int) -> tuple[bool, ...]:
        """Whether h depends on (time, displacement); see `local_dependence`."""
        if not self.structured:
            raise ValueError(
                f"{type(self).__name__} overrides `__call__`, which a structured solver does not "
                "see: give its forces in `local_force` and `springs`, or use a stock diffrax "
                "solver, `solver=diffrax.Tsit5()`."
            )
        return local_dependence(self, n)[:2]

    def balanced(self, n: int) -> bool:
        """Whether forces depend on displacement by -K x alone."""
        return not self.uses(n)[1]

    def restoring_force(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """-K x."""
        force = -self.stiffness_diagonal(x.shape[0]) * x
        return force if self.springs is None else force + self.springs.product(x)

    def __call__(self, t: ScalarLike, y: State, args: object = None) -> State:
        """The time derivative of the state (x, v); both of shape (n,)."""
        x, v = y
        return v, self.local_force(t, x, v) + self.restoring_force(x)

    def attracts(self, t: ScalarLike, y: State) -> Bool[Array, ""]:
        """Whether an equilibrium at y is certainly stable for all time.

        This holds if nothing depends on time, dh/dv < 0, and K - diag(dh/dx) > 0 by dominance.
        """
        x = y[0]
        _, slopes = self.local_force_and_slopes(t, x, jnp.zeros_like(x))
        if slopes.time is not None:
            return jnp.asarray(False)
        margin = self.stiffness_diagonal(x.shape[0])
        if slopes.displacement is not None:
            margin = margin - slopes.displacement
        if self.springs is not None:
            margin = margin - self.springs.strength(x.shape[0])
        return jnp.all(slopes.velocity < 0) & jnp.all(margin > 0)

    def divergence(self, t: ScalarLike, y: State) -> Float[Array, ""]:
        """tr J = sum of dh_n/dv_n."""
        return jnp.sum(self.local_force_and_slopes(t, *y)[1].velocity)

    def _selector(self, name: str) -> Callable[[Any], Any]:
        return operator.attrgetter("springs.constant" if name == "coupling" else name)

    def parameters(self) -> dict[str, Array]:
        """The arrays among the fields by name, and the springs' constant as `coupling`."""
        numbers = super().parameters()
        return numbers if self.springs is None else {"coupling": self.springs.constant, **numbers}
