"""Independent, slow and simple solvers, to hold the package against.

    x_n'' + 2 xi_n x_n' + k_n x_n + springs = p_n F(w_n),    w_n = x_n' - v_d
    slip  (w != 0):  F = -mu(|w|) sign(w)
    stick (w = 0):   |F| <= mu_st, whatever holds the mass on the belt

Here are only the numbers of a chain. A witness forms the equations of motion from them in its own
way, and uses nothing of `jaxchain`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Numbers:
    """The numbers of a chain of n masses; arrays have shape (n,).

    - `friction`: mu(s), s of shape (n,). It must also take a slightly negative s, and be smooth
      across s = 0 as a formula: a step that ends just beyond w = 0 needs it there.
    - `springs`: (i, j, constant) for each spring that joins masses i and j.
    """

    friction: Callable[[Array], Array]
    mu_static: Array
    belt_speed: float
    damping_ratio: Array
    stiffness: Array
    load: Array
    springs: tuple[tuple[int, int, float], ...]

    @property
    def n(self) -> int:
        return self.stiffness.size


def numbers(
    n: int = 1,
    *,
    belt_speed: float,
    friction: Callable[[Array], Array] | None = None,
    mu_static: ArrayLike = 1.0,
    mu_dynamic: ArrayLike = 0.5,
    v_ref: ArrayLike = 0.5,
    mu_viscous: ArrayLike = 0.0,
    damping_ratio: ArrayLike = 0.05,
    stiffness: ArrayLike = 1.0,
    load: ArrayLike = 1.0,
    coupling: ArrayLike | None = None,
    ends: str = "cyclic",
) -> Numbers:
    """`Numbers` from single values or one per mass; by default the paper's, uncoupled.

    mu(s) = mu_d + (mu_st - mu_d) exp(-s / v0) + mu_v s / v0 unless `friction` is given. `coupling`
    is None, one constant for all springs, or one per spring: n in a ring, where spring i joins
    masses i and (i + 1) mod n, and n - 1 with free ends.
    """
    mu_st, mu_d = np.asarray(mu_static, float), np.asarray(mu_dynamic, float)
    v0, mu_v = np.asarray(v_ref, float), np.asarray(mu_viscous, float)

    def weakening(s: Array) -> Array:
        return mu_d + (mu_st - mu_d) * np.exp(-s / v0) + mu_v * s / v0

    count = n if ends == "cyclic" else n - 1
    constants = np.broadcast_to(0.0 if coupling is None else np.asarray(coupling, float), count)
    return Numbers(
        friction=weakening if friction is None else friction,
        mu_static=np.broadcast_to(mu_st, n),
        belt_speed=float(belt_speed),
        damping_ratio=np.broadcast_to(np.asarray(damping_ratio, float), n),
        stiffness=np.broadcast_to(np.asarray(stiffness, float), n),
        load=np.broadcast_to(np.asarray(load, float), n),
        springs=tuple((i, (i + 1) % n, float(c)) for i, c in enumerate(constants)),
    )


def numbers_of(chain: Any) -> Numbers:
    """The numbers of a `jaxchain.Chain`, whose regularization width plays no part here."""
    law: dict[str, Any] = {name: np.asarray(value) for name, value in vars(chain.law).items()}
    law.setdefault("mu_static", np.asarray(chain.law.mu_static))  # Coulomb's is mu_d
    return numbers(
        chain.n,
        belt_speed=float(chain.belt_speed),
        damping_ratio=np.asarray(chain.damping_ratio),
        stiffness=np.asarray(chain.stiffness),
        load=1.0 if chain.normal_load is None else np.asarray(chain.normal_load),
        coupling=None if chain.coupling is None else np.asarray(chain.coupling),
        ends=chain.ends,
        **law,
    )
