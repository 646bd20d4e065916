"""Final methods and classes: an override that the package would ignore raises an error.

This module does not need JAX.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

_INSTEAD = {
    "AbstractOscillators": "subclass `jaxchain.model.AbstractOscillators` for other forces, or "
    "`jaxchain.model.AbstractFrictionLaw` for other friction.",
    "AbstractFriction": "subclass `jaxchain.model.AbstractFrictionLaw`.",
    "AbstractCells": "subclass `jaxchain.model.AbstractCells`.",
}

if TYPE_CHECKING:
    from typing import final
else:

    def final(cls: type) -> type:
        """Class decorator: subclassing `cls` raises a `TypeError` that gives an alternative."""
        bases = [base.__name__ for base in cls.__mro__]
        instead = "write a function that takes one, or a class that holds one."
        instead = next((_INSTEAD[name] for name in bases if name in _INSTEAD), instead)

        def refuse(subclass: type, **options: object) -> None:
            del options
            raise TypeError(
                f"Class `{subclass.__name__}` cannot be a subclass of `{cls.__name__}`, which is "
                f"final, because some computations would ignore what it overrides: {instead}"
            )

        cls.__init_subclass__ = classmethod(refuse)
        return cls


def refuse_overrides(cls: type, base: type, remedies: Mapping[str, str]) -> None:
    """Raises `TypeError` if `cls` defines a name in `remedies`, as a method or as a field.

    Classes of this package may define them, because they keep what the methods of `base` rely on.
    """
    below = [c for c in cls.__mro__ if c is not base and issubclass(c, base)]
    users = [c for c in below if c.__module__.partition(".")[0] != __package__]
    for name, remedy in remedies.items():
        if any(name in vars(c) or name in vars(c).get("__annotations__", {}) for c in users):
            raise TypeError(
                f"Class `{cls.__name__}` defines `{name}`, which some computations would "
                f"ignore: {remedy}"
            )
