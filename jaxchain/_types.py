"""Shape aliases used throughout."""

from typing import TypeAlias

from jaxtyping import Array, Float, Int

# One number, from Python or traced.
ScalarLike: TypeAlias = float | int | Float[Array, ""] | Int[Array, ""]
# One number for the whole chain, or one per mass, shape (n,).
PerMass: TypeAlias = Float[Array, ""] | Float[Array, " n"]
# (displacement, velocity), both of shape (n,); of other cells one array for each of their numbers.
State: TypeAlias = tuple[Float[Array, " n"], ...]
