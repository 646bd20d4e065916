"""What a branch of cycles starts from, checked: equations, unknowns, lengths, directions."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._checks import check_number, check_positive, require_64_bits, require_x64
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..model.locality import check_autonomous, check_local
from ..model.oscillators import AbstractOscillators
from ..simulation.accuracy import fit_linear_solve
from ..solvers.rosenbrock import Rodas5P
from .shooting import Shooting


def cycle_equations(
    chain: Any, state: Any, period: Any, parameter: str, vibrating: Any, images: Any, rtol: Any
) -> tuple[Shooting, np.ndarray, float]:
    """The shooting equations, and u and p of the cycle that is given."""
    require_x64()
    if state is None and period is None:
        chain, state, period, mass = _parts(chain)
        vibrating = mass if vibrating is None else vibrating
    if not isinstance(chain, AbstractOscillators):
        raise ValueError(
            "Argument `chain` must be a `Chain` or another `AbstractOscillators`, but is a "
            f"{type(chain).__name__}."
        )
    require_64_bits("chain", chain)
    x, v = (np.asarray(part, float) for part in (state or (None, None)))
    n = chain.n if isinstance(chain, Chain) else x.size
    if x.shape != (n,) or v.shape != (n,):
        raise ValueError(
            f"Argument `state` must be (x, v), both of shape ({n},), but has shapes {x.shape} and "
            f"{v.shape}."
        )
    check_number("period", period, "about 2 pi is usual.")
    check_positive("period", period, "about 2 pi is usual.")
    check_positive("rtol", rtol, "3e-11 is usual.")
    if not isinstance(chain, Chain):
        check_autonomous(chain, n)
        check_local(chain, 0.0, (jnp.asarray(x), jnp.asarray(v)))
    fastest = int(np.argmax(float(chain.belt_direction()) * v))
    mass = fastest if vibrating is None else check_mass(n, vibrating)
    value = chain.numbers()
    p = value.get(parameter)
    if p is None or np.shape(p) != ():
        single = sorted(name for name, number in value.items() if np.shape(number) == ())
        raise ValueError(
            f"Argument `parameter` must name a number of the chain, but is {parameter!r}: it may "
            f"be one of {single}."
        )
    shooting = Shooting(
        field=chain,
        rtol=rtol,
        solver=fit_linear_solve(Rodas5P(), chain, float(rtol)),
        mass=mass,
        images=_checked_images(images, mass, n),
        parameter=parameter,
    )
    u = np.asarray(shooting.pack((jnp.asarray(x), jnp.asarray(v)), period, p))
    return shooting, u, float(p)


def _parts(cycle: Any) -> tuple[Any, Any, Any, Any]:
    try:
        return cycle.chain, cycle.state, cycle.period, cycle.mass
    except AttributeError:
        raise ValueError(
            "Give a `LimitCycle`, or `chain`, `state` and `period`; the first argument is a "
            f"{type(cycle).__name__}."
        ) from None


def _checked_images(images: Any, mass: int, n: int) -> tuple[int, ...]:
    if images is None:
        return tuple(range(n))
    given = tuple(int(i) for i in images)
    good = len(given) == n and all(0 <= i < n and given[i] == i for i in given)
    if not good or given[mass] != mass:
        raise ValueError(
            f"Argument `images` must have {n} entries, entry i the index of the mass that i does "
            f"the same as, which is its own image, as mass {mass} is, but is {images!r}."
        )
    return given


def cycle_weights(shooting: Shooting, p: float) -> np.ndarray:
    """The masses but j share one unit; z_j, ln T and p / p_start have one each."""
    m = len(shooting.others) + len(shooting.solved) + 1
    weights = np.full(m + 1, len(shooting.solved) ** -0.5)
    weights[[shooting.place, m - 1]] = 1.0
    weights[m] = 1.0 / (abs(p) or 1.0)
    return weights


def as_heading(direction: Any, shooting: Shooting, m: int) -> Any:
    if not isinstance(direction, str):
        return direction
    if direction not in ("stick", "slip"):
        raise ValueError(
            f'Argument `direction` must be 1, -1, "stick" or "slip", but is {direction!r}.'
        )
    heading = np.zeros(m + 1)
    heading[shooting.place] = 1.0 if direction == "stick" else -1.0
    return heading
