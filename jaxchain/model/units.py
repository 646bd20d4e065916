"""Between SI units and the dimensionless chain: eq. (4)-(6) of the paper.

omega_n = sqrt(k / m),  x0 = P / k,  eta_c = k_c / k,  xi = c / (2 sqrt(k m)),  tau = omega_n t
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._checks import (
    check_nonnegative,
    check_number,
    check_positive,
    check_positive_number,
    named,
    to_float,
)
from .._printing import PrintedAsCall
from .._spelling import did_you_mean
from .._types import ScalarLike

Quantity: TypeAlias = Literal["displacement", "velocity", "time", "force", "frequency"]


class DimensionalParameters(NamedTuple):
    """One mass of the chain in SI units, as in eq. (3) of the paper.

    The result of `Scales.parameters`, and the input of `Scales.from_dimensional`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Scales
        >>> from jaxchain.model import DimensionalParameters
        >>> steel = DimensionalParameters(
        ...     mass=2.0, damping=2.0, stiffness=200.0, coupling_stiffness=None, normal_load=10.0
        ... )
        >>> scales = Scales.from_dimensional(*steel)
        >>> stiffer = scales.parameters()._replace(stiffness=400.0)
        >>> round(float(Scales.from_dimensional(*stiffer).damping_ratio / scales.damping_ratio), 4)
        0.7071
    """

    mass: ScalarLike
    """m [kg]"""
    damping: ScalarLike
    """c [N s/m]"""
    stiffness: ScalarLike
    """k [N/m]"""
    coupling_stiffness: ScalarLike | None
    """k_c [N/m]; None where nothing joins the masses"""
    normal_load: ScalarLike
    """P [N]"""

    __repr__ = PrintedAsCall.__repr__
    _repr_html_ = PrintedAsCall._repr_html_
    _sketch = PrintedAsCall._sketch


FROM_SI = "`Scales.from_dimensional` makes it from SI units."


def _or_none(coupling: Any) -> Float[Array, ""] | None:
    return None if coupling is None else to_float(coupling, "coupling")


class Scales(PrintedAsCall, eqx.Module):
    """The units of a dimensionless chain, and its two dimensionless parameters.

    The units are x0 = P / k for displacement, 1 / omega_n for time, x0 omega_n for velocity and P
    (per mass) for force. The fields `displacement` [m], `angular_frequency` [rad/s] and
    `force` [N] hold the units; `damping_ratio` = c / (2 sqrt(k m)) and `coupling` = k_c / k are
    the parameters. Create it with `Scales.from_dimensional`. In a mistuned chain they are those of
    the nominal mass.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import Scales
    >>> scales = Scales.from_dimensional(
    ...     mass=2.0, damping=2.0, stiffness=200.0, coupling_stiffness=2.0, normal_load=10.0
    ... )
    >>> float(scales.damping_ratio), float(scales.coupling)
    (0.05, 0.01)
    >>> float(scales.to_dimensionless(0.75, "velocity"))  # 0.75 m/s
    1.5
    >>> float(scales.to_dimensional(1.5, "velocity"))
    0.75
    """

    angular_frequency: Float[Array, ""] = eqx.field(converter=named("angular_frequency"))
    """omega_n [rad/s]"""
    displacement: Float[Array, ""] = eqx.field(converter=named("displacement"))
    """x0 [m]"""
    force: Float[Array, ""] = eqx.field(converter=named("force"))
    """P [N]"""
    damping_ratio: Float[Array, ""] = eqx.field(converter=named("damping_ratio"))
    """xi, dimensionless"""
    coupling: Float[Array, ""] | None = eqx.field(converter=_or_none)
    """eta_c, dimensionless; None where nothing joins the masses"""

    def __check_init__(self) -> None:
        remedy = FROM_SI
        for name in ("angular_frequency", "displacement", "force"):
            check_positive_number(name, getattr(self, name), remedy)
        check_number("damping_ratio", self.damping_ratio, remedy)
        if self.coupling is not None:
            check_number("coupling", self.coupling, remedy)
            check_nonnegative("coupling", self.coupling, remedy)

    @classmethod
    def from_dimensional(
        cls,
        mass: ScalarLike,
        damping: ScalarLike,
        stiffness: ScalarLike,
        coupling_stiffness: ScalarLike | None,
        normal_load: ScalarLike,
    ) -> Scales:
        """The scales of one mass given in SI units.

        **Arguments:** `mass` m [kg], `damping` c [N s/m], `stiffness` k [N/m],
        `coupling_stiffness` k_c [N/m] or None, `normal_load` P [N]; one number each.

        **Raises:** `ValueError` unless m, k, P > 0 and c, k_c >= 0, all finite and scalar.
        """
        given = DimensionalParameters(mass, damping, stiffness, coupling_stiffness, normal_load)
        for name, value in given._asdict().items():
            if value is not None and jnp.ndim(to_float(value, name)) != 0:
                raise ValueError(
                    f"Argument `{name}` must be one number, but has shape {jnp.shape(value)}: for "
                    "a mistuned chain give its reference mass here and ratios to it in the chain."
                )
        check_positive("mass", mass, "give it in kg.")
        check_nonnegative("damping", damping, "give it in N s/m; friction is not part of it.")
        check_positive("stiffness", stiffness, "give it in N/m, the spring to the ground.")
        check_positive("normal_load", normal_load, "give it in N, as a pressing force.")
        if coupling_stiffness is not None:
            remedy = "give it in N/m, or None for masses that nothing joins."
            check_nonnegative("coupling_stiffness", coupling_stiffness, remedy)

        m, k = to_float(mass), to_float(stiffness)
        return cls(
            angular_frequency=jnp.sqrt(k / m),
            displacement=normal_load / k,
            force=normal_load,
            damping_ratio=damping / (2.0 * jnp.sqrt(k * m)),
            coupling=None if coupling_stiffness is None else coupling_stiffness / k,
        )

    def parameters(self) -> DimensionalParameters:
        """(m, c, k, k_c, P) in SI units: the inverse of `from_dimensional`."""
        stiffness = self.force / self.displacement
        mass = stiffness / self.angular_frequency**2
        return DimensionalParameters(
            mass=mass,
            damping=2.0 * self.damping_ratio * jnp.sqrt(stiffness * mass),
            stiffness=stiffness,
            coupling_stiffness=None if self.coupling is None else self.coupling * stiffness,
            normal_load=self.force,
        )

    def unit(self, quantity: Quantity) -> Float[Array, ""]:
        """The SI value of the dimensionless number 1, in m, m/s, s, N or rad/s.

        **Raises:** `ValueError` for a quantity that has no unit here.
        """
        match quantity:
            case "displacement":
                return self.displacement
            case "velocity":
                return self.displacement * self.angular_frequency
            case "time":
                return 1.0 / self.angular_frequency
            case "force":
                return self.force
            case "frequency":
                return self.angular_frequency
        near = did_you_mean(quantity, get_args(Quantity))
        allowed = ", ".join(get_args(Quantity))
        raise ValueError(f"Argument `quantity` must be one of {allowed}, but is {quantity}{near}.")

    def to_dimensionless(
        self, value: Float[ArrayLike, "..."], quantity: Quantity
    ) -> Float[Array, "..."]:
        """`value` in SI units (m, m/s, s, N, rad/s) as a dimensionless number; any shape."""
        return to_float(value, "value") / self.unit(quantity)

    def to_dimensional(
        self, value: Float[ArrayLike, "..."], quantity: Quantity
    ) -> Float[Array, "..."]:
        """The dimensionless `value` in SI units (m, m/s, s, N, rad/s); any shape."""
        return to_float(value, "value") * self.unit(quantity)
