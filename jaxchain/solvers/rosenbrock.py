"""Structured Rosenbrock solvers for chains, for use with `diffrax.diffeqsolve`.

A Rosenbrock stage solves (I/(h gamma) - J) U_j = r_j.  With J = [[0, I], [h_x - K, h_v]], where
h_x and h_v are diagonal, the displacement part of U_j can be eliminated, and because x' = v is
linear it can be eliminated *for good*: every displacement-like quantity of a step is a fixed
linear combination of v and of the velocity parts b_1 .. b_s.  With i = 1 / (h gamma) and the
stage's displacement X_j, velocity V_j and first right-hand side r_j / (h gamma), stage j is

    (i - h_v + (K - h_x) / i) b_j = h(t_j, X_j, V_j) - K (X_j + r_j) + h_x r_j + ...

A step then carries s arrays of N numbers, and a stage is one evaluation of the local force and
one (cyclic) tridiagonal solve.  No Newton iteration, no dense matrix.  X_j and r_j are needed
apart only where h depends on x.
"""

import abc
import functools as ft
import operator as op
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import check_positive_number, check_whole, numbers_of, shown
from .._computed_once import spread
from .._final import refuse_overrides
from .._types import ScalarLike, State
from ..model.cells import AbstractCells
from ..model.chain import Chain, spread_numbers
from ..model.oscillators import AbstractOscillators
from ..model.tridiagonal import Solver, spring_solver


class RosenbrockTableau:
    """Coefficients of a stiffly accurate Rosenbrock method in the transformed form.

    (I/(h gamma) - J) U_j = f(t + c_j h, y + sum_m a_jm U_m) + sum_m C_jm U_m / h + h d_j df/dt,
    y_1 = y + sum_m a_sm U_m + U_s,  error estimate U_s (Hairer and Wanner 1996, section IV.7).
    Dense output (theta in [0, 1]): y = (1-theta) y_0 + theta (y_1 + (1-theta) (k_1 + theta (k_2 +
    theta k_3))), k_i = sum_j H_ij U_j.

    The displacements are eliminated: the displacement part of U_j is h (alpha_j v + sum_m beta_jm
    b_m).

    **Arguments:** of a method of s stages,

    - `gamma`: the number on the diagonal.
    - `a`: rows 2 ... s of a_jm, of 1 ... s - 1 numbers.  Omitted last rows repeat the previous
      row, with U_{j-1} added.
    - `c_transformed`: rows 2 ... s of C_jm.
    - `c`, `d`: c_j and d_j, s numbers each.
    - `dense`: rows of H_ij, one to three of s numbers.

    **Raises:** `ValueError` for anything else.

    See `AbstractStructuredRosenbrock` for an example.
    """

    def __init__(
        self,
        gamma: float,
        a: list[list[float]],
        c_transformed: list[list[float]],
        c: list[float],
        d: list[float],
        dense: list[list[float]],
    ):
        check_positive_number("gamma", gamma)
        s = np.size(c)
        _check_rows("c", [c], [s], 1)
        _check_rows("d", [d], [s], 1)
        _check_rows("a", a, range(1, s), 0)
        _check_rows("c_transformed", c_transformed, range(1, s), s - 1)
        _check_rows("dense", dense, [s, s, s], 1)
        self.gamma = gamma
        self.a = np.zeros((s, s))
        self.C = np.zeros((s, s))
        for j in range(1, s):
            self.a[j, :j] = a[j - 1] if j <= len(a) else [*self.a[j - 1, : j - 1], 1.0]
            self.C[j, :j] = c_transformed[j - 1]
        self.c = np.array(c)
        self.d = np.array(d)
        self.H = np.array(dense)
        self.alpha = np.zeros(s)
        self.beta = np.zeros((s, s))
        for j in range(s):
            self.alpha[j] = gamma * (1.0 + self.C[j] @ self.alpha)
            self.beta[j] = gamma * (self.a[j] + np.eye(s)[j] + self.C[j] @ self.beta)
        # Stage displacement alone.
        self.place_v = self.a @ self.alpha
        self.place_b = self.a @ self.beta
        # Stage displacement plus h gamma (first right-hand side): what the stiffness acts upon.
        self.stage_v = self.a @ self.alpha + self.alpha
        self.stage_b = self.a @ self.beta + self.beta - gamma * np.eye(s)
        # How much the products C b may amplify the truncation of the sweeps.
        self.lag = 100.0 * (1.0 + np.max(np.sum(np.abs(self.stage_b), axis=1)) / gamma)
        # End of the step, and the dense output, in the same weights.
        self.end_v = self.stage_v[-1]
        self.end_b = self.a[-1] @ self.beta + self.beta[-1]
        self.dense_v = self.H @ self.alpha
        self.dense_b = self.H @ self.beta

    def _row(self, j: Any) -> "_Row":
        """The coefficients of stage j, which may be traced."""
        parts = (getattr(self, name) for name in _Row._fields)
        return _Row(*(part[j] if isinstance(j, int) else jnp.asarray(part)[j] for part in parts))


class _Row(NamedTuple):
    """Coefficients of one stage, as in `RosenbrockTableau`."""

    a: Any
    C: Any
    c: Any
    d: Any
    place_v: Any
    place_b: Any
    stage_v: Any
    stage_b: Any


def _check_rows(name: str, rows: Any, lengths: Sequence[int], least: int) -> None:
    """Raises `ValueError` unless at least `least` rows have these lengths and are finite."""
    count = len(rows) if isinstance(rows, list | tuple | np.ndarray) else -1
    good = least <= count <= len(lengths)
    if good:
        arrays = [numbers_of(name, row) for row in rows]
        good = all(
            row is not None and row.shape == (length,) and np.isfinite(row).all()
            for row, length in zip(arrays, lengths, strict=False)
        )
    if not good:
        shown_lengths = ", ".join(map(str, lengths))
        raise ValueError(
            f"Argument `{name}` must have rows of {shown_lengths} finite numbers, {least} rows "
            f"at least, but is {shown(rows)}."
        )


RODAS4 = RosenbrockTableau(
    gamma=0.25,
    a=[
        [1.544],
        [0.9466785280815826, 0.2557011698983284],
        [3.314825187068521, 2.896124015972201, 0.9986419139977817],
        [1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895],
    ],
    c_transformed=[
        [-5.6688],
        [-2.430093356833875, -0.2063599157091915],
        [-0.1073529058151375, -9.594562251023355, -20.47028614809616],
        [7.496443313967647, -10.24680431464352, -33.99990352819905, 11.7089089320616],
        [
            8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136,
            -6.058818238834054,
        ],
    ],
    c=[0.0, 0.386, 0.21, 0.63, 1.0, 1.0],
    d=[0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0],
    dense=[
        [
            10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823,
            1.025137723295662, 0.0,
        ],
        [
            -0.6762803392801253, 6.087714651680015, 16.43084320892478, 24.76722511418386,
            -6.594389125716872, 0.0,
        ],
    ],
)  # fmt: skip

RODAS5P = RosenbrockTableau(
    gamma=0.21193756319429014,
    a=[
        [3.0],
        [2.849394379747939, 0.45842242204463923],
        [-6.954028509809101, 2.489845061869568, -10.358996098473584],
        [2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641],
        [
            -7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
            0.030198172008377946,
        ],
    ],
    c_transformed=[
        [-14.155112264123755],
        [-17.97296035885952, -2.859693295451294],
        [147.12150275711716, -1.41221402718213, 71.68940251302358],
        [165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306],
        [
            24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125,
            -0.6610691825249471,
        ],
        [
            30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783,
            -19.097331116725623, -28.087943162872662,
        ],
        [
            37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047,
            -40.06618937091002, -54.66780262877968, -9.48861652309627,
        ],
    ],
    c=[
        0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0,
        1.0, 1.0,
    ],
    d=[
        0.21193756319429014, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734,
        2.325825639765069, 0.0, 0.0, 0.0,
    ],
    dense=[
        [
            25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204,
            0.524948541321073, 1.1241088310450404, 0.4272876194431874, -0.17202221070155493,
        ],
        [
            -9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796,
            20.176138334709044, 15.98066361424651, -6.789040303419874, -6.710236069923372,
        ],
        [
            11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643,
            -52.072871366152654, -59.78993625266729, -0.15582684282751913, 4.883087185713722,
        ],
    ],
)  # fmt: skip


# A step with a greater truncation is not trusted at any tolerance.
MOST_TRUNCATION = 1e-3
# Nor is one in which a disturbance grows by more than exp of this: an L-stable method damps it.
_MOST_GROWTH = 2.0
# Every sweep adds to the compiled program; far fewer already cost as much as the exact solve.
_MOST_SWEEPS = 100

# Names that a method cannot define.
_SOLVER = (
    "step", "init", "func", "order", "error_order", "strong_order", "term_structure",
    "term_compatible_contr_kwargs", "interpolation_cls",
)  # fmt: skip
_FINAL: dict[str, str] = dict.fromkeys(
    _SOLVER,
    "a method is its `tableau` and `method_order`; any other solver is one of diffrax, a subclass "
    "of `diffrax.AbstractAdaptiveSolver`.",
)

_Arrays: TypeAlias = Sequence[Float[Array, " n"]]


def _combine(weights: Any, arrays: _Arrays) -> Any:
    """sum_m weights_m arrays_m, without the zeros if known; the scalar 0 when nothing is left."""
    total: Any = 0.0
    for m, array in enumerate(arrays):
        w = weights[m]
        if isinstance(w, jax.Array) or w != 0.0:
            total = w * array if isinstance(total, float) else total + w * array
    return total


def _stages(
    tableau: RosenbrockTableau, stage: Callable[[Any, list], Any], like: Any, rolled: bool
) -> list:
    """`stage(its coefficients, the stages before)` of each; `like` has the shapes of one.

    A loop (`rolled`) gives a smaller program: the stages that follow count as 0.
    """
    s, done = len(tableau.c), []
    if not rolled:
        for j in range(s):
            done.append(stage(tableau._row(j), done))
        return done

    def listed(stacked: Any) -> list:
        return [jtu.tree_map(op.itemgetter(j), stacked) for j in range(s)]

    def add(j: Array, stacked: Any) -> Any:
        new = stage(tableau._row(j), listed(stacked)[:-1])
        return jtu.tree_map(lambda part, one: part.at[j].set(one), stacked, new)

    nothing = jtu.tree_map(lambda part: jnp.zeros((s, *part.shape)), like)
    return listed(lax.fori_loop(0, s, add, nothing))


def _inverse(h: Array) -> Array:
    """1 / h, or 1 for h = 0.

    Under `vmap` a run that has ended takes steps of length 0 until the others end.  Their values
    are discarded, but in reverse mode 0 times an infinite slope would be NaN.
    """
    return 1.0 / jnp.where(h == 0, 1.0, h)


def _growth(field: AbstractOscillators, h: Array, stiffness: Any, slope: Array) -> Array:
    """The greatest h Re(lambda) of single masses, lambda^2 - slope lambda + stiffness = 0.

    The springs of neighbours are assumed to have their greatest effect.
    """
    if field.springs is not None:
        stiffness = stiffness - field.springs.strength(slope.shape[0])
    half = 0.5 * slope
    oscillates = half**2 <= stiffness
    root = jnp.sqrt(jnp.where(oscillates, 1.0, half**2 - stiffness))
    return jnp.max(h * half + jnp.where(oscillates, 0.0, jnp.abs(h) * root))


class RosenbrockInterpolation(dfx.AbstractLocalInterpolation):
    """The method's own dense output between t0 and t1 (see `RosenbrockTableau`).

    It keeps the stages and combines them only on request, because most steps are not interpolated.
    """

    t0: Any
    t1: Any
    y0: Any
    y1: Any
    h: Any  # signed step
    b: Any  # velocity parts of the stages; of cells all parts, a list for each stage
    tableau: RosenbrockTableau = eqx.field(static=True)

    def at(self, theta: ScalarLike | Array, part: int) -> Array:
        """Component `part` (0 displacement, 1 velocity) at theta in [0, 1] (one or per mass)."""
        tab = self.tableau
        poly: Any = 0.0
        for i in reversed(range(tab.H.shape[0])):
            if isinstance(self.b[0], list):
                k = _combine(tab.H[i], [stage[part] for stage in self.b])
            elif part == 0:
                k = self.h * (tab.dense_v[i] * self.y0[1] + _combine(tab.dense_b[i], self.b))
            else:
                k = _combine(tab.H[i], self.b)
            poly = k + theta * poly
        rest = 1.0 - theta
        return rest * self.y0[part] + theta * (self.y1[part] + rest * poly)

    def evaluate(self, t0: Any, t1: Any | None = None, left: bool = True) -> State:
        del left
        if t1 is not None:
            return jtu.tree_map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        length = self.t1 - self.t0
        theta = jnp.where(length == 0, 0.0, (t0 - self.t0) / jnp.where(length == 0, 1.0, length))
        return tuple(self.at(theta, part) for part in range(len(self.y0)))


def _vector_field(terms: dfx.AbstractTerm) -> AbstractOscillators | AbstractCells:
    # diffeqsolve wraps the term to handle reversed time; the field sits below.
    inner = terms if isinstance(terms, dfx.ODETerm) else getattr(terms, "term", None)
    field = inner.vector_field if isinstance(inner, dfx.ODETerm) else None
    if not isinstance(field, AbstractOscillators | AbstractCells):
        raise ValueError(
            "A structured Rosenbrock solver needs `terms = ODETerm(chain)` with a `Chain` (or "
            "other `AbstractOscillators` or `AbstractCells`) as its vector field, but has "
            f"{field!r}. Use a stock diffrax solver such as `Kvaerno5` for any other one."
        )
    return field


class AbstractStructuredRosenbrock(dfx.AbstractAdaptiveSolver):
    """A Rosenbrock method with the linear algebra of a chain.

    **Arguments:**

    - `sweeps`: None solves the (cyclic) tridiagonal system of each stage exactly, in O(N). An
      integer solves it by that many Jacobi sweeps, several times faster for weak coupling. Its
      error is at most rho^(sweeps+1) / (1-rho) of a stage, with rho <= 2 eta_c (h gamma)^2 to
      leading order.  This bound is part of the error estimate of each step.  A step with a bound
      above 1e-3 is rejected, or fails with a constant step. `simulate` chooses `sweeps` from the
      parameters of the chain.

    It works with `diffeqsolve`, any controller, `SaveAt`, `vmap`, and forward- or reverse-mode
    differentiation; y0 is the pair (displacement, velocity).  Steps may run backward in time.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Rodas4, equation_8, paper_chain, simulate
        >>> from jaxchain.solvers import AbstractStructuredRosenbrock
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> exact = Rodas4()  # or Rodas5P()
        >>> isinstance(exact, AbstractStructuredRosenbrock), exact.with_sweeps(2)
        (True, Rodas4(sweeps=2))
        >>> start = equation_8(chain, 1)
        >>> one, two = (simulate(chain, start, 30.0, solver=s) for s in (exact, Rodas4(2)))
        >>> bool(abs(one.state[0] - two.state[0]).max() < 1e-4)
        True
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        refuse_overrides(cls, AbstractStructuredRosenbrock, _FINAL)

    tableau: eqx.AbstractClassVar[RosenbrockTableau]
    method_order: eqx.AbstractClassVar[int]
    sweeps: eqx.AbstractVar[int | None]

    def __check_init__(self) -> None:
        if self.sweeps is not None:
            remedy = "None solves exactly; 1 ... 3 are usual."
            check_whole("sweeps", self.sweeps, 0, _MOST_SWEEPS, remedy, or_="None or ")

    term_structure: ClassVar = dfx.ODETerm

    @property
    def interpolation_cls(self) -> Callable[..., RosenbrockInterpolation]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return ft.partial(RosenbrockInterpolation, tableau=self.tableau)

    @abc.abstractmethod
    def with_sweeps(self, sweeps: int | None) -> "AbstractStructuredRosenbrock":
        """The same method with another linear solve."""

    def order(self, terms: Any) -> int:
        del terms
        return self.method_order

    def init(self, terms: Any, t0: Any, t1: Any, y0: State, args: Any) -> None:
        del terms, t0, t1, y0, args

    def func(self, terms: Any, t0: Any, y0: State, args: Any) -> State:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: State,
        args: Any,
        solver_state: None,
        made_jump: Any,
        *,
        rolled: bool = False,
    ) -> tuple[State, State, dict, None, dfx.RESULTS]:
        """One step; `rolled`: with its stages in a loop; derivatives then compile faster."""
        del solver_state, made_jump, args
        tab = self.tableau
        field = _vector_field(terms)
        h = terms.contr(t0, t1)  # signed: negative when time runs backward
        # diffrax counts wrapped time upward; the field's own time is direction * t.
        t = jnp.where(h * (t1 - t0) < 0, -t0, t0)
        if not isinstance(field, AbstractOscillators):
            return self._step_of_cells(field, t, h, y0, rolled)
        x, v = y0
        n = x.shape[0]
        # In a batch the stages are computed `flat`, so from arrays of masses alone; other forces
        # than those of a chain may have single numbers.
        known = isinstance(field, Chain)
        field = spread_numbers(field, x) if known else field

        def local_force(*at: Any) -> Array:
            forces = field.local_force(*at)
            return forces if known or field.springs is None else spread(forces, x)

        hs, per_h = spread(h, x), spread(_inverse(h), x)
        hg = hs * tab.gamma
        force, slopes = field.local_force_and_slopes(t, x, v)
        h_t, h_x = slopes.time, slopes.displacement
        stiffness = spread(field.stiffness_diagonal(n), x)
        tangent_stiffness = stiffness if h_x is None else stiffness - h_x
        diagonal = per_h / tab.gamma - slopes.velocity + hg * tangent_stiffness
        springs = field.springs
        solver = spring_solver(diagonal, springs, hg, self.sweeps, flat=known)
        pulls = None if springs is None else [spread(springs.product(p), x) for p in y0]

        def stage(row: _Row, before: list) -> tuple[Array, Array | None]:
            """(b, C b)"""
            b, pull = [one for one, _ in before], [one for _, one in before]
            # z: the stage's displacement plus h gamma times its first right-hand side.
            z = x + hs * (row.stage_v * v + _combine(row.stage_b, b))
            position, here = x, force
            if before:
                velocity = v + _combine(row.a, b)
                if h_x is not None:
                    position = x + hs * (row.place_v * v + _combine(row.place_b, b))
                time = t if h_t is None else t + row.c * h
                here = local_force(time, position, velocity)
            rhs = here - stiffness * z + per_h * _combine(row.C, b)
            if h_x is not None:
                rhs = rhs + h_x * (z - position)
            if pulls is not None:  # C z, from the products of its parts
                products = row.stage_v * pulls[1] + _combine(row.stage_b, pull)
                rhs = rhs + pulls[0] + hs * products
            if h_t is not None:
                rhs = rhs + (row.d * hs) * h_t
            return solver.solve(rhs)

        like = v, None if springs is None else v
        b = [one for one, _ in _stages(tab, stage, like, rolled)]
        velocity = v + _combine(tab.a[-1], b[:-1])
        y1 = (x + hs * (tab.end_v * v + _combine(tab.end_b, b)), velocity + b[-1])
        error = (hs * (tab.alpha[-1] * v + _combine(tab.beta[-1], b)), b[-1])
        checks = []
        if jax.eval_shape(field.growth_time) is None:  # computes nothing
            checks.append(_growth(field, h, tangent_stiffness, slopes.velocity) <= _MOST_GROWTH)
        error, result = self._judged(solver, error, [[], b], checks)
        return y1, error, {"y0": y0, "y1": y1, "h": h, "b": tuple(b)}, None, result

    def _step_of_cells(
        self, field: AbstractCells, t: Array, h: Array, y0: State, rolled: bool
    ) -> tuple[State, State, dict, None, dfx.RESULTS]:
        """The same with all m variables of every stage: one block tridiagonal solve each."""
        tab, m = self.tableau, len(y0)
        per_h = _inverse(h)
        here = field.linearised(t, y0)
        solver = here.jacobian.shift(per_h / tab.gamma).solver(self.sweeps)

        def moved(row: _Row, before: list) -> State:
            return tuple(y0[k] + _combine(row.a, [stage[k] for stage in before]) for k in range(m))

        def stage(row: _Row, before: list) -> list[Array]:
            rate = field(t + row.c * h, moved(row, before)) if before else here.rate
            right = [
                rate[k] + per_h * _combine(row.C, [stage[k] for stage in before]) for k in range(m)
            ]
            right = [
                part if slope is None else part + (row.d * h) * slope
                for part, slope in zip(right, here.time, strict=True)
            ]
            return solver.solve(right)

        stages = _stages(tab, stage, list(y0), rolled)
        last = moved(tab._row(len(tab.c) - 1), stages[:-1])
        y1 = tuple(last[k] + stages[-1][k] for k in range(m))
        # A pivot of another sign than h: something grows by more than e^(1/gamma) in the step.
        checks = [jnp.all(jnp.stack([pivot * h for pivot in solver.pivots]) > 0)]
        error, result = self._judged(
            solver, tuple(stages[-1]), list(zip(*stages, strict=True)), checks
        )
        return y1, error, {"y0": y0, "y1": y1, "h": h, "b": tuple(stages)}, None, result

    def _judged(
        self, solver: Solver, error: State, stages: Sequence[_Arrays], checks: list[Array]
    ) -> tuple[State, dfx.RESULTS]:
        """(error, result) of a step, failed unless all `checks` hold and sweeps leave out little.

        `stages`: for each component its part of every stage, none where it is not solved for. What
        sweeps leave out is relative to these; it counts the error of b, and of later stages, which
        take over C b from the sweep before the last one.
        """
        if (rho := solver.contraction) is not None:
            sweeps = self.sweeps or 0
            truncation = self.tableau.lag * rho ** (sweeps + 1) / jnp.maximum(1.0 - rho, 1e-3)
            checks = [truncation <= MOST_TRUNCATION, *checks]
            error = tuple(
                jnp.abs(e) + truncation * sum(map(jnp.abs, parts)) if parts else e
                for e, parts in zip(error, stages, strict=True)
            )
        if not checks:
            return error, dfx.RESULTS.successful
        trusted = ft.reduce(op.and_, checks)
        error = jtu.tree_map(lambda e: jnp.where(trusted, e, jnp.inf), error)
        untrusted: Any = dfx.RESULTS.nonlinear_divergence
        return error, dfx.RESULTS.where(trusted, dfx.RESULTS.successful, untrusted)


class Rodas4(AbstractStructuredRosenbrock):
    """Rodas4: order 4(3), 6 stages, stiffly accurate and L-stable; dense output of order 3.

    E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, 2nd ed., Springer 1996,
    section VI.4.  Use it at tolerances of 1e-4 to 1e-7.

    **Arguments:** `sweeps`, see `AbstractStructuredRosenbrock`.

    !!! example

        >>> import diffrax, jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Rodas4, excited_state, paper_chain
        >>> chain = paper_chain(n=20, belt_speed=1.5)
        >>> solution = diffrax.diffeqsolve(
        ...     diffrax.ODETerm(chain), Rodas4(), t0=0.0, t1=10.0, dt0=None,
        ...     y0=excited_state(chain, 9),
        ...     stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-7),
        ... )
        >>> displacement, velocity = solution.ys
        >>> displacement.shape, velocity.shape
        ((1, 20), (1, 20))
    """

    tableau: ClassVar[RosenbrockTableau] = RODAS4
    method_order: ClassVar[int] = 4
    sweeps: int | None = eqx.field(static=True, default=None)

    def with_sweeps(self, sweeps: int | None) -> "Rodas4":
        return Rodas4(sweeps)


class Rodas5P(AbstractStructuredRosenbrock):
    """Rodas5P: order 5(4), 8 stages, stiffly accurate and L-stable; dense output of order 4.

    G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within
    the Julia Differential Equations package, BIT Numerical Mathematics 63, 27 (2023). Use it at
    tolerances below 1e-7.

    **Arguments:** `sweeps`, see `AbstractStructuredRosenbrock`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Rodas4, Rodas5P, equation_8, paper_chain, simulate
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> start = equation_8(chain, 1)
        >>> fifth, fourth = (
        ...     simulate(chain, start, 30.0, solver=s, rtol=1e-9) for s in (Rodas5P(), Rodas4())
        ... )
        >>> bool(fifth.steps < 0.8 * fourth.steps)  # fewer steps for the same tight tolerance
        True
    """

    tableau: ClassVar[RosenbrockTableau] = RODAS5P
    method_order: ClassVar[int] = 5
    sweeps: int | None = eqx.field(static=True, default=None)

    def with_sweeps(self, sweeps: int | None) -> "Rodas5P":
        return Rodas5P(sweeps)
