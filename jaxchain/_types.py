"""Types and shapes used throughout."""

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Array, Float, Int

if TYPE_CHECKING:
    from numpy.typing import ArrayLike as ArrayLike  # of NumPy or JAX, and lists of numbers

    _T = TypeVar("_T")
    # An argument that a function checks itself, with an error that gives a remedy.
    Given = Annotated[_T, "checked by the function"]
else:
    from jaxtyping import ArrayLike as ArrayLike

    class Given:
        """To an editor the type in brackets; at run time any, for the function says what is wrong.

        Types are checked at run time in tests only, where the error would be another one.
        """

        def __class_getitem__(cls, _: Any) -> Any:
            return Any


# One number, from Python, NumPy or JAX, also traced.
ScalarLike: TypeAlias = float | int | np.number | Float[Array, ""] | Int[Array, ""]
# One number for the whole chain, or one per mass, shape (n,).
PerMass: TypeAlias = Float[Array, ""] | Float[Array, " n"]
# (displacement, velocity), both of shape (n,); of other cells one array for each of their numbers.
State: TypeAlias = tuple[Float[Array, " n"], ...]
# A state as a user gives it: of NumPy or JAX arrays, or lists of numbers.
StateLike: TypeAlias = tuple[ArrayLike, ...]
