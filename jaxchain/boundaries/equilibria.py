"""Equilibria of any model, their branches, and the Hopf points on them.

Steady sliding of a `Chain` is known in closed form, see `hopf_belt_speed` and `hopf_points`; here
equilibria are found by Newton's method from a guess.

**Dry friction.**  While the belt moves, all masses of an equilibrium slide over it at w = -v_d,
where friction is smooth: it keeps its direction, also beyond w = 0.  If the belt stands still,
they stick wherever friction can hold them, |r| <= p mu_st.  As the belt stops, steady sliding ends
where friction is at that limit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from .._checks import (
    check_concrete,
    check_flag,
    check_number,
    check_pair,
    check_positive_number,
    is_traced,
    shown,
    to_float,
)
from .._types import Given, ScalarLike, State, StateLike
from ..continuation.arclength import continue_branch
from ..continuation.branch import Branch, Labels
from ..continuation.damped_newton import check_tolerance, search
from ..continuation.implicit import attach_derivative, if_found
from ..model.arguments import as_model, as_parameter, as_state
from ..model.locality import check_autonomous
from ..model.model import AbstractModel
from ..result import Outcome, SearchResult, is_one
from ..solvers.dry_friction import (
    BACKWARD,
    FORWARD,
    STICK,
    alone,
    free_force,
    modes_at_rest,
    motion,
    nominal_limit,
)

# Beside the frequency: the real part of a pair of eigenvalues that counts as zero.
_ON_AXIS = 1e-6
# The relative difference of eigenvalues that are taken together.
_SAME = 1e-6


class Equilibrium(Outcome):
    """A state at which nothing changes.

    - `state`: m arrays of shape (n,); of a chain (x, v).
    - `eigenvalues` (m n,): of the Jacobian there, the greatest real part first; two of each mass
      that sticks are 0.
    - `residual`: the greatest |rate|; `result`: the outcome; `steps`: the number of Jacobians.
    - `sticking`: whether dry friction holds the masses on a belt that stands still; then
      `interval` (2, n) is the least and the greatest displacement of each contact, at which
      friction is at its limit p mu_st at all contacts, in one direction.  A single mass sticks at
      every displacement in between; coupled ones where |r| <= p mu_st at each.  NaN where masses
      slide, or an end was not found; None without dry friction.

    See `find_equilibrium` for an example.
    """

    may_be_missing = ("interval",)
    chain: AbstractModel
    state: State
    eigenvalues: Complex[Array, " mn"]
    residual: Float[Array, ""]
    result: SearchResult
    steps: Int[Array, ""]
    sticking: Bool[Array, ""]
    interval: Float[Array, "two n"] | None

    def _instead(self) -> dict[str, str]:
        slides = is_one(self.result) and not self.sticking
        return dict.fromkeys(("sticking", "interval"), "") if slides else {}

    @property
    def stable(self) -> bool | None:
        """Whether all eigenvalues have negative real parts; None if no equilibrium was found.

        Those of masses that stick do not count: a disturbance comes to rest in the interval.
        """
        if not self.successful:
            return None
        still = 2 * self.state[0].size * int(self.sticking)
        return int(jnp.sum(jnp.real(self.eigenvalues) < 0)) >= self.eigenvalues.size - still


class HopfPoint(Outcome):
    """An equilibrium with a pair of eigenvalues +-i omega.

    - `parameter`: the name of the parameter that was varied; `value`: its value at the point.
    - `state`; `frequency`: omega > 0; `mode`: the complex eigenvector as m arrays of shape (n,):
      a disturbance moves as Re[mode exp(i omega t)].
    - `growth_slope`: d Re(lambda) / d(value); the equilibrium loses its stability in the direction
      of its sign if all other eigenvalues have negative real parts.
    - `chain`: the model with this value; `residual`, `result`, `steps`: of the search.

    See `find_hopf_point` for an example.
    """

    chain: AbstractModel
    value: Float[Array, ""]
    state: State
    frequency: Float[Array, ""]
    mode: tuple[Complex[Array, " n"], ...]
    growth_slope: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    steps: Int[Array, ""]
    parameter: str = eqx.field(static=True)

    @property
    def lyapunov_coefficient(self) -> Float[Array, ""]:
        """l1, the first Lyapunov coefficient, with derivatives.

        If l1 < 0, a stable cycle grows out of the point (supercritical), if l1 > 0, an unstable
        one.  NaN if several pairs of eigenvalues cross together.  Its size
        belongs to eigenvectors with <q, q> = <p, q> = 1, Euclidean.
        """
        rates = Rates.of(self.chain, len(self.state))
        return lyapunov_coefficient(rates, jnp.concatenate(self.state), self.frequency)

    def guess(self, amplitude: Any) -> tuple[State, Array]:
        """(state, period) of a small cycle, for `find_limit_cycle` close to the point.

        `amplitude` is that of the greatest entry of the mode.
        """
        greatest = jnp.max(jnp.abs(jnp.stack(self.mode)))
        size = to_float(amplitude, "amplitude") / greatest
        state = tuple(a + size * jnp.real(b) for a, b in zip(self.state, self.mode, strict=True))
        return state, 2.0 * jnp.pi / self.frequency


class Rates(eqx.Module):
    """The rates of a model as a function of the concatenated state, and of one of its parameters.

    `direction`: in which each dry contact slides, or STICK; None for a smooth model.
    """

    field: AbstractModel
    m: int = eqx.field(static=True)
    parameter: str | None = eqx.field(static=True, default=None)
    direction: Float[Array, " contacts"] | None = None

    @classmethod
    def of(cls, field: Any, m: int, parameter: str | None = None) -> Rates:
        """Those of masses at rest, which a moving belt slides past."""
        direction = lax.stop_gradient(modes_at_rest(field)) if field.dry else None
        return cls(field, m, parameter, direction)

    def at(self, p: Any = None) -> AbstractModel:
        """The model, with the parameter set to p."""
        return self.field if p is None else self.field.with_(**{str(self.parameter): p})

    def __call__(self, u: Float[Array, " mn"], p: Any = None) -> Float[Array, " mn"]:
        field: Any = self.at(p)
        y = tuple(jnp.split(u, self.m))
        if self.direction is None:
            return jnp.concatenate(field(0.0, y))
        return jnp.concatenate(motion(field, 0.0, y, self.direction))


def rest_residual(u: Array, rates: Rates) -> Array:
    """The rates, which vanish at an equilibrium."""
    return rates(u)


def _balance(u: Array, args: tuple[Rates, Array]) -> Array:
    """The rates with dry friction; for the contact of masses that stick, a displacement.

    It vanishes at the given displacement if friction can hold the mass there, and otherwise where
    friction is at its limit, on the side that the mass moves to.
    """
    rates, given = args
    field: Any = rates.field
    y, parts = jnp.split(u, rates.m), jnp.split(rates(u), rates.m)
    r, limit = free_force(field, 0.0, tuple(y)), nominal_limit(field)
    moved = jnp.clip(y[field.contact - rates.m // 2] - given, -limit - r, limit - r)
    parts[field.contact] = jnp.where(rates.direction == STICK, moved, parts[field.contact])
    return jnp.concatenate(parts)


@eqx.filter_jit
def lyapunov_coefficient(
    rates: Any, y: Float[Array, " mn"], frequency: Float[Array, ""]
) -> Float[Array, ""]:
    """The first Lyapunov coefficient of a Hopf point y of y' = rates(y) of frequency omega.

        l1 = 1 / (2 omega) Re [ <p, C(q, q, q*)> - 2 <p, B(q, J^-1 B(q, q*))>
                                + <p, B(q*, (2 i omega - J)^-1 B(q, q))> ],

    with the right and left eigenvectors q and p of i omega, <q, q> = <p, q> = 1 (Euclidean), and B
    and C the second and third derivatives of the rates, from nested `jvp`.  On the centre manifold
    y = w q + w* q*, and w' = (alpha + i omega) w + omega l1 w |w|^2, so that cycles of |w|^2 =
    -alpha / (omega l1) branch off.  If l1 < 0, a stable cycle grows out of the point
    (supercritical), if l1 > 0, an unstable one.  NaN if several pairs of eigenvalues cross
    together: the combination of modes is undetermined.

    Source: Kuznetsov, Elements of Applied Bifurcation Theory, section 5.4.
    """
    J = jax.jacfwd(rates)(y)
    values, vectors = jnp.linalg.eig(lax.stop_gradient(J))
    at = jnp.argmin(jnp.abs(values - 1j * frequency))
    # A bordered matrix gives eigenvectors with derivatives; JAX has none for `eig`.
    one = jnp.zeros(y.size + 1, complex).at[-1].set(1.0)
    right, left = vectors[:, at], jnp.linalg.solve(vectors.T, jnp.zeros_like(values).at[at].set(1))
    bordered = jnp.block([
        [J - 1j * frequency * jnp.eye(y.size), jnp.conj(left)[:, None]],
        [jnp.conj(right)[None], jnp.zeros((1, 1))],
    ])  # fmt: skip
    q, p = (jnp.linalg.solve(matrix, one)[:-1] for matrix in (bordered, bordered.T))
    several = jnp.sum(jnp.abs(values - values[at]) <= _SAME * jnp.abs(values[at])) > 1
    l1 = jnp.sum(jnp.real(lyapunov_terms(rates, y, frequency, q, p)))
    return jnp.where(several, jnp.nan, l1)


def lyapunov_terms(
    rates: Any, y: Float[Array, " mn"], frequency: Any, q: Array, p: Array
) -> Complex[Array, "three mn"]:
    """Terms, the sum of whose real parts is the first Lyapunov coefficient of one mode.

    `q` and `p`: the right and left eigenvectors, of any size; one may be chosen out of several.
    """
    J = jax.jacfwd(rates)(y)
    q = q / jnp.linalg.norm(q)

    def along(function: Any, direction: Array) -> Any:
        """The derivative of a function along a complex direction."""

        def slope(y: Array) -> Array:
            parts = (jax.jvp(function, (y,), (d,))[1] for d in (direction.real, direction.imag))
            return next(parts) + 1j * next(parts)

        return slope

    second = along(along(rates, q), jnp.conj(q))
    constant = jnp.linalg.solve(J.astype(q.dtype), second(y))
    doubled = 2j * frequency * jnp.eye(y.size) - J
    doubled = jnp.linalg.solve(doubled, along(along(rates, q), q)(y))
    terms = [
        along(second, q)(y),
        -2.0 * along(along(rates, q), constant)(y),
        along(along(rates, jnp.conj(q)), doubled)(y),
    ]
    return jnp.stack([p * term for term in terms]) / (p @ q * 2.0 * frequency)


def find_equilibrium(
    model: Given[AbstractModel],
    guess: Given[StateLike | None] = None,
    *,
    tolerance: Given[ScalarLike] = 1e-12,
    max_steps: Given[int] = 50,
    throw: bool = True,
) -> Equilibrium:
    """The equilibrium of a model near a state, stable or not, by damped Newton steps.

    With dry friction all masses slide, at w = -v_d; if the belt stands still they stick, and the
    equilibria fill an `interval`.  Then the contacts keep the displacements of `guess`
    where friction can hold them; other masses move until it can.

    **Arguments:** `model`: a `Chain`, `AbstractCells` or `AbstractOscillators`, without forcing;
    `guess`: a state, by default the closed form `chain.equilibrium()` or zeros; `tolerance` and
    `max_steps`: see `jaxchain.continuation.newton`.

    **Returns:** an `Equilibrium`, whose state has derivatives in every parameter of the model.  It
    works under `jit` and `vmap`; there `throw` has no effect.

    **Raises:** `ValueError` for bad input, `RuntimeError` if no equilibrium is found.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, steady_sliding
        >>> from jaxchain.boundaries import find_equilibrium
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> found = find_equilibrium(chain, (jnp.ones(3), jnp.zeros(3)))
        >>> bool(abs(found.state[0] - steady_sliding(chain)[0]).max() < 1e-12), found.stable
        (True, True)

        On a belt that stands still a mass with mu_st = 1 sticks at any displacement up to 1:

        >>> stuck = find_equilibrium(paper_chain(1, belt_speed=0.0, width=None))
        >>> bool(stuck.sticking), stuck.interval.ravel().tolist()
        (True, [-1.0, 1.0])
    """
    state, limit = _checked(model, guess, tolerance, max_steps)
    check_flag("throw", throw)
    if _some_stick(model) and not alone(cast(Any, model)):
        raise ValueError(
            "Argument `model` must have belts that move under all of its contacts, as several "
            "that stick share forces that are not known: run it, `simulate(model, ...)`."
        )
    found = _equilibrium(model, state, to_float(tolerance), jnp.asarray(limit))
    if throw and not is_traced(found.successful) and not found.successful:
        raise RuntimeError(
            f"No equilibrium was found near `guess`: {found.message} The greatest rate is "
            f"{float(found.residual):.1e}. Start closer, for example from a run that has settled."
        )
    return found


def near_equilibrium(model: AbstractModel, guess: Any) -> State:
    """The guess; for None the closed form of the model, or zeros."""
    if guess is None:
        guess = model.equilibrium() or (jnp.zeros(model.n or 1),) * len(model.variables)
    return as_state(model, guess, "guess")


def _checked(model: Any, guess: Any, tolerance: Any, max_steps: Any) -> tuple[State, int]:
    as_model(model)
    state = near_equilibrium(model, guess)
    check_autonomous(model, state)
    if model.dry:  # beyond the speed of the belt a law need not be defined
        half = len(state) // 2
        state = (*state[:half], *map(jnp.zeros_like, state[half:]))
    return state, check_tolerance(tolerance, max_steps)


def _check_sliding(model: Any) -> None:
    if _some_stick(model):
        raise ValueError(
            "Argument `model` must have belts that move, but has dry friction and `belt_speed` "
            "= 0: masses stick there, each in an interval of displacements (`find_equilibrium`), "
            "in which there is no Hopf point. Give it a speed, `chain.with_(belt_speed=1.0)`."
        )


def _some_stick(model: Any) -> bool:
    """Whether a dry contact stands still at rest; False if that is not known while tracing."""
    modes = modes_at_rest(model) if model.dry else jnp.ones(())
    return not is_traced(modes) and bool(np.any(np.asarray(modes) == STICK))


@eqx.filter_jit
def _equilibrium(model: Any, guess: State, tolerance: Array, limit: Array) -> Equilibrium:
    m, start = len(guess), lax.stop_gradient(jnp.concatenate(guess))
    weights = jnp.full(start.shape, start.shape[0] ** -0.5)
    live, fixed = Rates.of(model, m), Rates.of(lax.stop_gradient(model), m)

    def solved(residual: Any, args: Any, frozen_args: Any) -> tuple[Any, Array]:
        root = search(residual, start, frozen_args, tolerance, limit, weights)
        return root, attach_derivative(residual, root.value, args)

    sticking, interval = jnp.asarray(False), None
    if fixed.direction is None or not alone(model):
        root, u = solved(rest_residual, live, fixed)
        J = jax.jacfwd(fixed)(root.value)
    else:
        contact, sticking = model.contact, fixed.direction == STICK
        given = guess[contact - m // 2]
        root, u = solved(_balance, (live, given), (fixed, lax.stop_gradient(given)))
        # Contacts that stick are left out, so that their eigenvalues are exactly 0.
        moves = [jnp.full(given.shape, True)] * m
        moves[contact] = moves[contact - m // 2] = jnp.broadcast_to(~sticking, given.shape)
        free = jnp.concatenate(moves)
        J = jnp.where(jnp.outer(free, free), jax.jacfwd(fixed)(root.value), 0.0)

        def end(direction: Array) -> Array:
            def at_limit(field: Any) -> Rates:
                own = "" if "belt_speed" in field.parameters() else "contacts[0]."
                return Rates(field.with_(**{f"{own}belt_speed": 0.0}), m, None, direction)

            root, u = solved(rest_residual, at_limit(model), at_limit(fixed.field))
            return if_found(sticking & root.successful, jnp.split(u, m)[contact - m // 2])

        interval = jnp.sort(jax.vmap(end)(jnp.array([FORWARD, BACKWARD])), axis=0)
    values = jnp.linalg.eigvals(J)
    return Equilibrium(
        chain=model,
        state=tuple(jnp.split(u, m)),
        eigenvalues=values[jnp.argsort(-jnp.real(values))],
        residual=root.residual,
        result=root.result,
        steps=root.steps,
        sticking=sticking,
        interval=interval,
    )


def equilibria_over(
    rates: Rates, start: Array, values: Array, tolerance: Array, limit: Array
) -> Any:
    """The equilibria at successive values of the parameter, each from the last one found.

    The `Root` of a search for each; `start` is the guess at the first value.
    """
    weights = jnp.full(start.shape, start.shape[0] ** -0.5)

    def follow(u: Array, p: Array) -> tuple[Array, Any]:
        field = rates.at(None if rates.parameter is None else p)
        at_p = Rates.of(field, rates.m)  # a belt may change its direction
        root = search(rest_residual, u, at_p, tolerance, limit, weights)
        return jnp.where(root.successful, root.value, u), root

    return lax.scan(follow, start, values)[1]


class HopfSystem(eqx.Module):
    """f(y, p) = 0 and lambda(y, p) = i omega, in u = (y, omega, p).

    lambda is the mean of the eigenvalues that agree with the one closest to `near`.  In a ring of
    equal cells they are double, and their mean is smooth where a single one is not.
    """

    rates: Rates
    near: Complex[Array, ""]

    def eigenvalue(self, y: Array, p: Array) -> Complex[Array, ""]:
        """lambda; JAX differentiates eigenvalues, not eigenvectors."""
        values = jnp.linalg.eigvals(jax.jacfwd(self.rates)(y, p))
        fixed = lax.stop_gradient(values)
        at = fixed[jnp.argmin(jnp.abs(fixed - lax.stop_gradient(self.near)))]
        same = jnp.abs(fixed - at) <= _SAME * jnp.abs(at)
        return jnp.sum(jnp.where(same, values, 0.0)) / jnp.sum(same)

    def slope(self, y: Array, p: Array) -> Array:
        """d Re(lambda) / dp along the equilibria: dy/dp = -J^{-1} f_p."""
        J, by_p = jax.jacfwd(self.rates, argnums=(0, 1))(y, p)
        moved = -jnp.linalg.solve(J, by_p)
        return jnp.real(jax.jvp(self.eigenvalue, (y, p), (moved, jnp.ones_like(p)))[1])


def _hopf_residual(u: Array, system: HopfSystem) -> Array:
    y, omega, p = u[:-2], u[-2], u[-1]
    value = system.eigenvalue(y, p)
    ends = jnp.stack([jnp.real(value), jnp.imag(value) - omega])
    return jnp.concatenate([system.rates(y, p), ends])


def find_hopf_point(
    model: Given[AbstractModel],
    parameter: str,
    guess: Given[StateLike | None] = None,
    *,
    bounds: tuple[Any, Any] | None = None,
    frequency: Given[ScalarLike | None] = None,
    tolerance: Given[ScalarLike] = 1e-12,
    max_steps: Given[int] = 50,
    throw: bool = True,
) -> HopfPoint:
    """The Hopf point of an equilibrium near a state and the present value of one parameter.

    It solves f(y, p) = 0 and lambda(y, p) = i omega together by damped Newton steps; lambda is the
    eigenvalue that is closest to the imaginary axis at `guess`.  Waves q and -q of a ring, whose
    eigenvalues are equal, are found as well.  With dry friction it is a Hopf point of steady
    sliding; masses that stick, on a belt that stands still, have none.  To find all Hopf points in
    a range, see `continue_equilibrium`.

    With `bounds` the present value may be anywhere in this range: the equilibrium is followed to
    both ends in 64 steps each, and the Hopf point is the nearest one at which the greatest growth
    rate of an oscillation changes its sign, such as the onset of flutter.  A rate that changes its
    sign twice within one step is not seen: give a narrower range, or look at `complex_modes`.

    **Arguments:** `model`, `guess`, `tolerance`, `max_steps`: as for `find_equilibrium`;
    `parameter`: the name of a parameter that `chain.with_` takes, one for all cells; `frequency`:
    choose the pair whose frequency is closest to this instead; `bounds`: (low, high), finite.

    **Returns:** a `HopfPoint`.  `value`, `state` and `frequency` have derivatives in all other
    parameters of the model.  It works under `jit` and `vmap`; there `throw` has no effect.

    **Raises:** `ValueError` for bad input; `RuntimeError` if no point is found.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import hopf_belt_speed, paper_chain, steady_sliding
        >>> from jaxchain.boundaries import find_hopf_point
        >>> chain = paper_chain(1, belt_speed=1.3, width=1e-2)
        >>> point = find_hopf_point(chain, "belt_speed", steady_sliding(chain))
        >>> bool(abs(point.value - hopf_belt_speed(chain)) < 1e-10)
        True
        >>> round(float(point.frequency), 9)
        1.0
    """
    state, limit = _checked(model, guess, tolerance, max_steps)
    check_flag("throw", throw)
    as_parameter(model, parameter)
    _check_sliding(model)
    if frequency is not None:
        check_number("frequency", frequency, "it chooses one of several pairs of eigenvalues.")
    if bounds is not None:
        bounds = _range_around(model, parameter, bounds, True)
    found, growth = _hopf_point(
        model, parameter, state, None if bounds is None else jnp.asarray(bounds),
        None if frequency is None else to_float(frequency), to_float(tolerance),
        jnp.asarray(limit),
    )  # fmt: skip
    if throw and not is_traced(found.successful) and not found.successful:
        where, remedy = "near `guess`", "Start closer, or give `bounds`, the range to search."
        if bounds is not None:
            where = f"between {bounds[0]:.6g} and {bounds[1]:.6g}"
            remedy = "The greatest growth rate of an oscillation there is "
            remedy += f"{float(growth[0]):.3g} to {float(growth[1]):.3g}"
            remedy += ": without a change of sign no oscillation sets in. Choose another range, "
            remedy += "or a narrower one where two changes may lie within one of 64 steps."
        raise RuntimeError(
            f"No Hopf point in `{parameter}` was found {where}: {found.message} {remedy}"
        )
    return found


def _range_around(model: Any, parameter: str, bounds: Any, finite: bool) -> tuple[Any, Any]:
    """(low, high), the range of a parameter around its value in the model."""
    low, high = check_pair("bounds", bounds, f"it is the range of `{parameter}`.")
    p = model.value_of(parameter)
    if (finite and not np.isfinite(high - low)) or not (is_traced(p) or low <= p <= high):
        what = "finite and " if finite else ""
        raise ValueError(
            f"Argument `bounds` must be {what}around `{parameter}` = {shown(p)} of the model, but "
            f"is {shown(bounds)}: change one of them, as `model.with_({parameter}={low:.6g})`."
        )
    return low, high


# Steps of a scan from the present value to each end of a range, and how often it is repeated
# within one step.
_SCAN, _ROUNDS = 64, 3


def _nearest_onset(
    rates: Rates, y: Array, p: Array, bounds: Array, growth: Any, tolerance: Array, limit: Array
) -> tuple[Array, Array, Array, Array]:
    """(y, p, exists, (least, greatest)): where `growth` of the Jacobian changes its sign next."""

    def closer(k: Any, now: Any) -> Any:  # one loop, because each copy of the model is compiled
        y, p, ends, exists, extremes = now

        def follow(end: Array) -> tuple[Array, Array, Array]:
            values = jnp.linspace(p, end, _SCAN + 1)
            found = equilibria_over(rates, y, values, tolerance, limit)
            rate = jax.vmap(lambda u, p: growth(jax.jacfwd(rates)(u, p)))(found.value, values)
            return values, found.value, jnp.where(found.successful, rate, jnp.nan)

        values, states, rate = (
            jnp.concatenate([side[0, :0:-1], side[1]]) for side in jax.vmap(follow)(ends)
        )
        padded = jnp.append(rate, jnp.nan)  # comparisons with NaN are false
        next_but_one = rate[:-1] * padded[2:] < 0  # also where the rate between them is 0
        changes = next_but_one | (rate[:-1] * rate[1:] < 0)
        middle = 0.5 * (values[:-1] + values[1:])
        at = jnp.argmin(jnp.where(changes, jnp.abs(middle - p), jnp.inf))
        end = values[at + 1 + jnp.where(next_but_one[at], 1, 0)]
        spread = jnp.stack([jnp.nanmin(rate), jnp.nanmax(rate)])
        extremes = jnp.where(k == 0, spread, extremes)
        return states[at], values[at], jnp.stack([end, end]), exists & jnp.any(changes), extremes

    now = y, p, bounds, jnp.asarray(True), jnp.zeros(2)
    y, p, _, exists, extremes = lax.fori_loop(0, _ROUNDS, closer, now)
    return y, p, exists, extremes


@eqx.filter_jit
def _hopf_point(
    model: Any,
    parameter: str,
    guess: State,
    bounds: Any,
    frequency: Any,
    tolerance: Array,
    limit: Array,
) -> tuple[HopfPoint, Any]:
    m, fixed = len(guess), lax.stop_gradient(model)
    rates = Rates.of(fixed, m, parameter)
    p = fixed.value_of(parameter)
    y = lax.stop_gradient(jnp.concatenate(guess))
    weights = jnp.full(y.shape, y.shape[0] ** -0.5)
    y = search(rest_residual, y, Rates.of(fixed, m), tolerance, limit, weights).value

    def nearest(values: Array, far: Array) -> Array:
        return values[jnp.argmin(jnp.where(jnp.imag(values) > 0, far, jnp.inf))]

    def growth(J: Array) -> Array:
        """Of the oscillation that grows most, or is closest to `frequency`; NaN without one."""
        values = jnp.linalg.eigvals(J)
        far = -values.real if frequency is None else jnp.abs(values.imag - frequency)
        # Rounding is no growth: of undamped oscillations none grows or decays.
        value, least = nearest(values, far), 1e-12 * jnp.max(jnp.abs(values))
        rate = jnp.where(jnp.abs(value.real) > least, value.real, 0.0)
        return jnp.where(value.imag > 0, rate, jnp.nan)

    exists, rate = jnp.asarray(True), None
    if bounds is not None:
        y, p, exists, rate = _nearest_onset(rates, y, p, bounds, growth, tolerance, limit)
    values = jnp.linalg.eigvals(jax.jacfwd(rates)(y, p))
    far = jnp.abs(jnp.real(values)) / jnp.abs(values)
    if frequency is not None:
        far = jnp.abs(jnp.imag(values) - frequency)
    near = nearest(values, far)
    omega = jnp.imag(near)
    start = jnp.concatenate([y, jnp.stack([omega, p])])
    size = jnp.concatenate([1.0 + jnp.abs(y), jnp.abs(start[-2:]) + 1e-300])
    system = HopfSystem(rates, near)
    root = search(_hopf_residual, start, system, tolerance, limit, 1.0 / size)
    # A real eigenvalue that vanishes solves the equations as well.
    good = root.successful & (root.value[-2] > _ON_AXIS * omega) & (omega > 0) & exists
    if bounds is not None:
        good = good & (bounds[0] <= root.value[-1]) & (root.value[-1] <= bounds[1])
    none = SearchResult.where(root.successful, SearchResult.no_step_helps, root.result)
    live = Rates.of(model, m, parameter)
    u = attach_derivative(_hopf_residual, root.value, HopfSystem(live, near))
    y, p = (root.value[:-2], root.value[-1])
    if rates.direction is not None:
        field: Any = rates.at(p)
        slides = jnp.all(rates.direction * modes_at_rest(field) > 0)
        good, none = good & slides, SearchResult.where(slides, none, SearchResult.sticking)
    values, vectors = jnp.linalg.eig(jax.jacfwd(rates)(y, p))
    mode = vectors[:, jnp.argmin(jnp.abs(values - 1j * root.value[-2]))]
    point = HopfPoint(
        chain=live.at(u[-1]),
        parameter=parameter,
        value=u[-1],
        state=tuple(jnp.split(u[:-2], m)),
        frequency=u[-2],
        mode=tuple(jnp.split(mode, m)),
        growth_slope=system.slope(y, p),
        residual=root.residual,
        result=SearchResult.where(good, root.result, none),
        steps=root.steps,
    )
    return point, rate


def _linearised(u: Array, p: Array, rates: Rates) -> tuple[Array, Array, Array]:
    """(f, [f_u f_p], the eigenvalues of f_u)."""
    by_u, by_p = jax.jacfwd(rates, argnums=(0, 1))(u, p)
    values = jnp.linalg.eigvals(by_u)
    columns = jnp.concatenate([by_u, by_p[:, None]], axis=1)
    return rates(u, p), columns, values[jnp.argsort(-jnp.real(values))]


def _plain(u: Array, p: Array, rates: Rates) -> Array:
    return rates(u, p)


def _pair_sums(values: Any) -> np.ndarray:
    """Sums of two eigenvalues that are real: one of them is 0 at a Hopf point."""
    real = values[values.imag == 0].real
    i, j = np.triu_indices(real.size, 1)
    return np.concatenate([2.0 * values[values.imag > 0].real, real[i] + real[j]])


def _hopf_test(u: np.ndarray, p: float, tangent: np.ndarray, values: Any) -> np.ndarray:
    """Each by itself, the greatest first: in a product those that cross together would cancel."""
    del u, p, tangent
    return -np.sort(-_pair_sums(np.asarray(values)))


def continue_equilibrium(
    model: Given[AbstractModel],
    guess: Given[StateLike | None],
    parameter: str,
    bounds: tuple[Any, Any],
    *,
    direction: Given[ScalarLike | None] = None,
    step: Given[ScalarLike | None] = None,
    max_step: Given[ScalarLike] = 0.02,
    max_points: Given[int] = 1000,
    **options: Any,
) -> Branch:
    """Follows an equilibrium as a parameter changes, around folds, with its Hopf points.

    **Arguments:**

    - `model`, `guess`: as for `find_equilibrium`.
    - `parameter`: the name of a parameter that `chain.with_` takes, one for all cells; `bounds`:
      its range, which contains the value of the chain, and at whose ends the branch ends.  With
      dry friction it ends at "belt_speed = 0", where the masses stick.
    - `direction`: 1 or -1, the sign of the first change of the parameter; by default both.
    - `step`, `max_step`: the first and the longest step, by default at most 0.01 and 0.02.
      Lengths are ((change of the parameter / its range)^2 + (mean of squared changes of the state)
      / (its greatest entry, at least 1)^2)^(1/2): some 50 points or more in the whole range.
    - `max_points` in each direction; `options`: others of `jaxchain.continuation.continue_branch`.

    **Returns:** a `Branch`: `u` (k, m n) the concatenated states, `p` (k,) the parameter, `extra`
    (k, m n) the eigenvalues, the greatest real part first, `stable` (k,), and `special`, the
    points of kind "fold", "branch point" and "hopf".  `find_hopf_point` gives such a point to all
    digits, with derivatives; `plot_branch` draws the branch.

    **Raises:** `ValueError` for bad input; `RuntimeError` if there is no equilibrium near `guess`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain, steady_sliding
        >>> from jaxchain.boundaries import continue_equilibrium
        >>> chain = paper_chain(1, belt_speed=1.0, width=1e-2)
        >>> branch = continue_equilibrium(chain, steady_sliding(chain), "belt_speed", (0.9, 1.4))
        >>> [(point.kind, round(point.p, 6)) for point in branch.special]
        [('hopf', 1.151293)]
    """
    check_concrete("use `find_hopf_point`.", model=model, guess=guess)
    as_model(model)
    p = float(as_parameter(model, parameter))
    _check_sliding(model)
    low, high = _range_around(model, parameter, bounds, False)
    check_positive_number("max_step", max_step, "0.02 of the range is usual.")
    state = find_equilibrium(model, guess).state
    rates, start = Rates.of(model, len(state), parameter), np.concatenate(state)
    width = high - low if 0.0 < high - low < np.inf else max(abs(p), 1.0)
    size = np.full(start.size, max(1.0, np.max(np.abs(start)))) * start.size**0.5
    options = {
        "step": min(0.01, float(max_step)) if step is None else step,
        "max_step": max_step,
        "max_points": max_points,
        "weights": np.append(1.0 / size, 1.0 / width),
        **options,
    }

    if stops := model.dry and parameter == "belt_speed":
        low, high = (max(low, 0.0), high) if p > 0 else (low, min(high, 0.0))

    branch = continue_branch(
        _plain,
        start,
        p,
        rates,
        direction=1 if direction is None else direction,
        both=direction is None,
        bounds=(low, high),
        tests={"hopf": _hopf_test},
        value_and_jacobian=_linearised,
        **options,
    )
    if stops and branch.p.size:  # masses that do not slide stick, and do not go on
        for name, speed in ("ended_first", branch.p[0]), ("ended", branch.p[-1]):
            if getattr(branch, name) == "left_bounds" and speed == 0.0:
                branch = replace(branch, **{name: "belt_speed = 0"})

    def happens(point: Any) -> bool:
        """False where the sum of two real eigenvalues vanishes, which is no Hopf point."""
        values: Any = np.asarray(point.extra)
        on_axis = np.abs(values.real) <= _ON_AXIS * np.abs(values)
        return point.kind != "hopf" or bool(np.any(on_axis & (values.imag > 0)))

    stable = None if branch.extra is None else np.real(branch.extra[:, 0]) < 0.0
    special = tuple(filter(happens, branch.special))
    return replace(
        branch, special=special, stable=stable, labels=labels_of(model, len(state), parameter)
    )


def labels_of(model: AbstractModel, m: int, name: str) -> Labels:
    """Of a branch of equilibria."""
    row, parts = model.parameter(name), [model.variable(i) for i in range(m)]
    if model.components:
        parts = [part._replace(long_name=part.name) for part in parts]
    return Labels(name, row.unit, row.long_name, parts)
