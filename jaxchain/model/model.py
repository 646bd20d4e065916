"""What every model answers: how many cells, which variables, which parameters, what friction.

Everything above this module works with these methods, and asks for no class.
"""

from __future__ import annotations

import abc
import operator
from collections.abc import Callable
from dataclasses import fields
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._checks import check_known, to_float
from .._printing import PrintedAsCall, Sketch
from .._types import PerMass, ScalarLike, State
from .contacts import Contact
from .entries import array_of, entry, with_entries
from .friction import AbstractFriction, AbstractFrictionLaw
from .locality import Dependence
from .parameters import Parameter, parameter
from .springs import neighbours


class StateVariable(NamedTuple):
    """One of the m variables of a cell: its name, its unit ("1" if not known), words for it."""

    name: str
    unit: str = "1"
    long_name: str = ""


class AbstractModel(PrintedAsCall, eqx.Module):
    """What all models share: a `Chain`, other `AbstractOscillators`, and `AbstractCells`.

    A vector field in the sense of `diffrax.ODETerm`: `field(t, y)` is the time derivative of a
    state y, a tuple of arrays of shape (n,), one for each variable of a cell; of a chain the pair
    (x, v).  Subclass one of those, not this class.

    See `AbstractCells` for an example.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        package = __name__.partition(".")[0]
        if AbstractModel in cls.__bases__ and cls.__module__.partition(".")[0] != package:
            raise TypeError(
                f"`{cls.__name__}` cannot be a subclass of `AbstractModel`, which no solver sees "
                "the structure of: subclass `AbstractCells` or `AbstractOscillators`."
            )

    def _sketch(self) -> Sketch | None:
        """The friction force, with steady sliding."""
        friction = self.given_friction
        if friction is None:
            return None
        speed: Any = vars(self).get("belt_speed")
        speed = float(speed) if eqx.is_array_like(speed) and np.ndim(speed) == 0 else None
        unit = float(np.max(self.natural_scales()[1]))
        return friction._sketch(max(1.25 * abs(speed or 0.0), unit), speed)

    # None of these is a field unless a subclass makes it one: with an annotation it would be.
    ends = "cyclic"
    n = None  # the number of cells; None: any, that of the state
    stops = ()  # each a `Stop`
    time_unit: ClassVar[str] = "1"
    components: ClassVar[tuple[str, ...]] = ()
    contact: ClassVar[int] = 1
    _symmetric: ClassVar[tuple[str, ...]] = ()
    # Whether it has what `EventDriven` integrates: friction in contacts, or stops.
    frictional: ClassVar[bool] = False
    frictional_contacts: ClassVar[tuple[Contact, ...]] = ()

    @property
    def variables(self) -> tuple[StateVariable, ...]:
        """The m variables of a cell; empty if `components` does not name them."""
        return tuple(StateVariable(name, "1", name) for name in self.components)

    def variable(self, index: int) -> StateVariable:
        """One of the `variables`; one without a name is called by its index."""
        known = self.variables
        named = StateVariable(str(index), "1", f"component {index}")
        return known[index] if index < len(known) else named

    @property
    def state_in_words(self) -> str:
        """What a state is, for messages."""
        names = [variable.name for variable in self.variables]
        what = {0: "a tuple of arrays", 2: "the pair"}.get(len(names), "the tuple")
        return f"{what} ({', '.join(names)})" if names else what

    def velocity_of(self, index: int) -> int | None:
        """The index of the variable that is the rate of this one; None if there is none."""
        del index

    def parameter(self, name: str) -> Parameter:
        """The description of a parameter: words, symbol, unit, domain."""
        law = {} if self.given_friction is None else self.given_friction.parameters()
        return Parameter(name, name, sign=parameter(name).sign if name in law else "any")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The names of the parameters that may differ from run to run of a sweep."""
        return tuple(self.parameters())

    def has_parameter(self, name: str) -> bool:
        """Whether this is one of the `parameter_names`, or an entry of one."""
        return (array_of(name) or name) in self.parameter_names

    def check_parameter(self, name: str, values: Any) -> bool:
        """Raises `ValueError` for impossible values; False if each must be tried by `with_`."""
        del name, values
        return False

    def smallest_scale(self, n: int) -> tuple[PerMass, PerMass] | None:
        """(eps, |v_d|): the width within which friction changes its sign, and at which velocity.

        A run that is to stick must resolve eps, by tolerances that are relative to |v_d|.  None if
        no force switches, or if friction is dry.
        """
        layer = None if self.dry else self.switching(jnp.zeros(()), jnp.zeros(n))
        return None if layer is None else (layer[1], jnp.abs(layer[0]))

    def friction_scales(self) -> tuple[AbstractFrictionLaw, Any, Any, Any] | None:
        """(law, load, belt speed, unit) of smoothed friction; None if it is not known.

        The unit is the velocity amplitude that a force of the nominal load P gives to a contact,
        for one mass P / sqrt(k m); the load is relative to P.
        """

    def natural_scales(self) -> tuple[Any, Any, Any]:
        """(time, velocity, force) that count as 1, for steps, tolerances and rounding."""
        return 1.0, 1.0, 1.0

    def sizes(self, y: State) -> tuple[Any, ...] | None:
        """What counts as 1 of each variable of a cell, by a state; None: all are in such units."""
        del y

    def times_of(self, variables: int) -> tuple[Any, ...]:
        """By variable of a cell, 1, or the unit of time where it has a velocity."""
        kinds = (self.velocity_of(k) for k in range(variables))
        return tuple(1.0 if kind is None else self.natural_scales()[0] for kind in kinds)

    def dependence(self, y: State) -> Dependence | None:
        """The variables on which each rate depends; None if that is not known."""
        del y

    def description(self, n: int) -> dict[str, Any]:
        """What tells this model of n cells from others, for the attributes of a dataset."""
        return {"n": n, "oscillators": type(self).__name__, **self.parameters()}

    def check_locality(self, t: ScalarLike, y: State) -> None:
        """Raises `ValueError` if the forces at a state are not those that a solver sees."""
        del t, y

    @abc.abstractmethod
    def __call__(self, t: ScalarLike, y: State, args: object = None) -> State:
        """The time derivative of the state y."""

    @abc.abstractmethod
    def divergence(self, t: ScalarLike, y: State) -> Float[Array, ""]:
        """tr J, the trace of the derivatives of y' in y."""

    def forcing_period(self) -> ScalarLike | None:
        """The period of what depends on time; None if nothing does."""
        return None

    def equilibrium(self) -> State | None:
        """An equilibrium in closed form; None if there is no formula."""
        return None

    def switching(
        self, t: ScalarLike, v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], PerMass] | None:
        """(w, width): velocities w whose sign a force follows within |w| < width, cell by cell.

        v is the variable `contact` of each cell.  None if no force switches.  Steps are shortened
        as a w approaches 0, see `SwitchingController`.
        """
        del t, v
        return None

    def layer(self, t: ScalarLike, y: State) -> tuple[Float[Array, " n"], PerMass] | None:
        """`switching` at a state: of the variable `contact`, or the last one of fewer."""
        return self.switching(t, y[min(self.contact, len(y) - 1)])

    def layers(self, t: ScalarLike, y: State) -> list[tuple[Array, PerMass, int | None]]:
        """(w, width, variable that slides or None) of each contact: of `layer` alone."""
        layer = self.layer(t, y)
        return [] if layer is None else [(*layer, min(self.contact, len(y) - 1))]

    def belt_direction(self) -> ScalarLike:
        """The sign of the velocity at which forces switch, 1 or -1; 1 if no force switches."""
        return 1.0

    def stick_speed(self) -> PerMass | None:
        """The |w| (see `switching`) up to which a mass sticks; None if no mass can stick."""
        return None

    def neighbours(self, y: State) -> tuple[State, State]:
        """(left, right): the neighbours of each cell; beyond a free end a copy of the last one."""
        ends = "mirrored" if self.ends == "free" else "cyclic"
        pairs = [neighbours(part, ends) for part in y]
        return tuple(pair[0] for pair in pairs), tuple(pair[1] for pair in pairs)

    def excess_force(
        self, t: Any, left: State, own: State, right: State, contact: int = 0
    ) -> PerMass:
        """The force on a mass minus the greatest friction force; negative if friction can hold it.

        A mass does not stick if this is positive.  Of several contacts this is the one `contact`.
        """
        del t, left, right, contact
        return jnp.full_like(own[0], -jnp.inf)

    def release_acceleration(self) -> PerMass | None:
        """The acceleration by the greatest friction force; None if it is not known."""
        return None

    def growth_time(self) -> ScalarLike | None:
        """The time in which velocities grow by e, which bounds the step; None if it is not known.

        A stiff solver mistakes a growth by more than e^2 within a step for a decay, unnoticed by
        its error estimate.  None: structured solvers use the Jacobian at the start of each step.
        """
        return None

    def attracts(self, t: ScalarLike, y: State) -> Bool[Array, ""]:
        """Whether an equilibrium at y is certainly stable for all time; here it is not known."""
        del t, y
        return jnp.asarray(False)

    def balanced(self, n: int) -> bool:
        """Whether the balance of forces gives the displacement of a mass from all else."""
        del n
        return False

    def can_be_cycle(self, period: Any, speed: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether a cycle can have this period, and masses as fast as `speed`.

        Always true where forces have no bound that is known.
        """
        del period, speed
        return jnp.asarray(True)

    def value_and_rate(
        self, t: ScalarLike, y: State, component: int = 0
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """(y_i, y_i'): one of the m variables of each cell, and its rate."""
        if component >= len(y):
            raise ValueError(
                f"Argument `component` is {component}, but a cell of {type(self).__name__} has "
                f"{len(y)} numbers, counted from 0."
            )
        velocity = self.velocity_of(component)
        rate = self(t, y)[component] if velocity is None else y[velocity]
        return y[component], rate

    def second_rate(self, t: ScalarLike, y: State, component: int = 0) -> Float[Array, " n"]:
        """y_i'', the rate of y_i' along the motion."""
        if (index := self.velocity_of(component)) is not None:
            return self(t, y)[index]

        def velocity(t: Any, y: State) -> Array:
            return self(t, y)[component]

        now = jnp.asarray(t, float)
        return jax.jvp(velocity, (now, y), (jnp.ones_like(now), self(t, y)))[1]

    def jacobian(self, t: ScalarLike, y: State) -> Float[Array, "mn mn"]:
        """dy'/dy, dense, in the order of the concatenated state."""
        n, m = y[0].shape[0], len(y)

        def rate(flat: Array) -> Array:
            return jnp.concatenate(self(t, tuple(flat.reshape(m, n))))

        return jax.jacfwd(rate)(jnp.concatenate(y))

    def with_(self, **changes: Any) -> Any:
        """A copy with other parameters, by the names of fields, checked as in a new model.

        Entries of arrays are parameters, too: `with_(**{"stiffness[0, 1]": 0.3})`.
        """
        field, known, of = self, self.parameters(), f"`{type(self).__name__}.with_`"
        changes = with_entries(changes, known, of, self._symmetric)
        if self.given_friction is not None:
            numbers = {k: changes.pop(k) for k in self.given_friction.parameters() if k in changes}
            if "width" in changes and "width" not in known:  # smooths dry friction
                numbers["width"] = changes.pop("width")
            if numbers:
                friction = self.given_friction.with_(**numbers)
                field = eqx.tree_at(lambda f: f.friction, field, friction)
        converters = {f.name: f.metadata.get("converter", to_float) for f in fields(self)}
        check_known(of, changes, known)
        for name, value in changes.items():
            number = to_float(converters.get(name, to_float)(value))
            self._check_change(name, number)
            field = eqx.tree_at(self._selector(name), field, number)
        for kind in type(field).__mro__:
            if check := vars(kind).get("__check_init__"):
                check(field)
        return field

    def _check_change(self, name: str, number: Array) -> None:
        """Raises `ValueError` if this parameter cannot replace the present one."""
        del name, number

    def _selector(self, name: str) -> Callable[[Any], Any]:
        """From a model to the array that holds this parameter."""
        return operator.attrgetter(name)

    @property
    def given_friction(self) -> AbstractFriction | None:
        """The field `friction` if it is a law, smoothed or not; its parameters are the model's."""
        friction = vars(self).get("friction")
        return friction if isinstance(friction, AbstractFriction) else None

    @property
    def dry(self) -> bool:
        """Whether friction is dry, which only `EventDriven` integrates."""
        return False

    def parameters(self) -> dict[str, Array]:
        """The arrays among the fields, and the parameters of the field `friction`, by name."""
        friction = {} if self.given_friction is None else self.given_friction.parameters()
        arrays = {name: value for name, value in vars(self).items() if eqx.is_array(value)}
        if taken := sorted(friction.keys() & arrays.keys()):
            raise ValueError(
                f"Friction law `{type(self.given_friction).__name__}` cannot have the field "
                f"`{taken[0]}`, which is the name of a number of {type(self).__name__}: rename it."
            )
        return {**friction, **arrays}

    def value_of(self, name: str) -> Array:
        """The parameter of this name, or an entry of one: `value_of("stiffness[0, 1]")`."""
        numbers = self.parameters()
        if array_of(name) is not None:
            return entry(name, numbers)
        check_known("The model", [name], numbers)
        return to_float(numbers[name])
