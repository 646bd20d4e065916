"""What a branch of cycles starts from, checked: equations, unknowns, lengths, directions."""

from typing import Any

import numpy as np

from .._checks import check_concrete, check_one_of, shown
from ..model.arguments import as_images, as_mass
from ..model.chain import require_smoothed
from ..simulation.accuracy import fit_linear_solve
from ..solvers.rosenbrock import Rodas5P
from .floquet import as_orbit, check_orbit
from .shooting import Shooting


def cycle_equations(
    chain: Any, state: Any, period: Any, parameter: str, vibrating: Any, images: Any, rtol: Any
) -> tuple[Shooting, np.ndarray, float]:
    """The shooting equations, and u and p of the cycle that is given."""
    if state is None and period is None and vibrating is None:
        vibrating = getattr(chain, "mass", None)
    chain, state, period = as_orbit(chain, state, period)
    check_concrete("use `find_limit_cycle`.", chain=chain, state=state, period=period)
    require_smoothed(chain, "follow `find_limit_cycle` from one belt speed to the next, or ")
    x, v = check_orbit(chain, state, period, rtol)
    n, fastest = x.size, int(np.argmax(float(chain.belt_direction()) * np.asarray(v)))
    mass = as_mass(n, vibrating, fastest)
    value = chain.numbers()
    p = value.get(parameter) if isinstance(parameter, str) else None
    if p is None or np.shape(p) != ():
        single = sorted(name for name, number in value.items() if np.shape(number) == ())
        raise ValueError(
            f"Argument `parameter` must name a number of the chain, one of {single}, but is "
            f"{shown(parameter)}."
        )
    shooting = Shooting(
        field=chain,
        rtol=rtol,
        solver=fit_linear_solve(Rodas5P(), chain, float(rtol)),
        mass=mass,
        images=as_images(images, n, mass),
        parameter=parameter,
    )
    u = np.asarray(shooting.pack((x, v), period, p))
    return shooting, u, float(p)


def cycle_weights(shooting: Shooting, p: float) -> np.ndarray:
    """The masses but j share one unit; z_j, ln T and p / p_start have one each."""
    m = len(shooting.others) + len(shooting.solved) + 1
    weights = np.full(m + 1, len(shooting.solved) ** -0.5)
    weights[[shooting.place, m - 1]] = 1.0
    weights[m] = 1.0 / (abs(p) or 1.0)
    return weights


def as_heading(direction: Any, shooting: Shooting, m: int) -> Any:
    """A direction as `continue_branch` takes it: "stick" and "slip" as vectors (m + 1,)."""
    if not isinstance(direction, str):
        return direction
    check_one_of("direction", direction, ("stick", "slip"))
    heading = np.zeros(m + 1)
    heading[shooting.place] = 1.0 if direction == "stick" else -1.0
    return heading
