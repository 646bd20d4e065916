"""Shape aliases used throughout."""

from typing import TypeAlias

import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike as ArrayLike  # of NumPy or JAX, and lists of numbers

# One number, from Python, NumPy or JAX, also traced.
ScalarLike: TypeAlias = float | int | np.number | Float[Array, ""] | Int[Array, ""]
# One number for the whole chain, or one per mass, shape (n,).
PerMass: TypeAlias = Float[Array, ""] | Float[Array, " n"]
# (displacement, velocity), both of shape (n,); of other cells one array for each of their numbers.
State: TypeAlias = tuple[Float[Array, " n"], ...]
# A state as a user gives it: of NumPy or JAX arrays, or lists of numbers.
StateLike: TypeAlias = tuple[ArrayLike, ...]
