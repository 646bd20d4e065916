"""Complex modes: frequencies, growth rates and shapes of a linearised model over a parameter.

The table of every study of brake squeal: where two frequencies meet and a growth rate becomes
positive, friction makes the equilibrium flutter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Int

from .._checks import as_array, check_finite, check_flag, check_kind, is_traced, shown, to_float
from .._printing import Sketch
from .._types import Given, ScalarLike, State, StateLike
from ..continuation.damped_newton import check_tolerance
from ..continuation.implicit import attach_derivative, if_found
from ..datasets import Variable, along, dataset
from ..model.arguments import as_model, as_parameter
from ..model.locality import check_autonomous
from ..model.model import AbstractModel
from ..model.provenance import provenance_of
from ..result import Outcome, SearchResult
from .equilibria import Rates, equilibria_over, labels_of, near_equilibrium, rest_residual

if TYPE_CHECKING:
    from xarray import Dataset

# The relative difference of eigenvalues that are taken for equal.
_SAME = 1e-9


class ComplexModes(Outcome):
    """The modes Re[shape exp(lambda t)] of a linearised model at k values of a parameter.

    - `values` (k,) of the `parameter`; `state`: the equilibria, arrays of shape (k, n).
    - `eigenvalues` (k, modes): lambda = growth rate + i frequency.  A pair lambda, conj(lambda) is
      one mode.  A column is one mode, followed over the values; NaN where it does not exist, such
      as the second of two real eigenvalues before a pair becomes two.  Columns are in the order of
      their frequencies at the first value, those without one last.
    - `slopes` (k, modes): d lambda / d(value) along the equilibria; NaN for repeated eigenvalues
      that the parameter splits.
    - `shapes`: the right eigenvectors, arrays of shape (k, modes, n).  The greatest entry of the
      first half of the variables (the displacements of mechanical models) is 1.
    - `mac` (k, modes): the modal assurance criterion |v* w|^2 / (|v|^2 |w|^2) of the shape and the
      one at the value before; 1 if they are alike.  Below 0.5 take more values.
    - `residual`, `result`, `steps` (k,): of the search for each equilibrium.

    See `complex_modes` for an example.
    """

    chain: AbstractModel
    values: Float[Array, " k"]
    state: tuple[Float[Array, "k n"], ...]
    eigenvalues: Complex[Array, "k modes"]
    slopes: Complex[Array, "k modes"]
    shapes: tuple[Complex[Array, "k modes n"], ...]
    mac: Float[Array, "k modes"]
    residual: Float[Array, " k"]
    result: SearchResult
    steps: Int[Array, " k"]
    parameter: str | None = eqx.field(static=True)
    may_be_missing: ClassVar[tuple[str, ...]] = ("eigenvalues", "slopes", "shapes", "mac")

    def _sketch(self) -> Sketch | None:
        """The growth rates over the parameter; of one value the eigenvalues."""
        if np.size(self.values) > 1:
            zero = np.zeros_like(self.values)
            lines = [(self.values, self.growth_rate), (self.values, zero, zero > 0)]
            return Sketch(self.parameter or "value", "growth rate", lines)
        points = [(one.real, one.imag, "") for one in np.ravel(self.eigenvalues)]
        return Sketch("growth rate", "frequency", points=points)

    @property
    def frequency(self) -> Float[Array, "k modes"]:
        """omega = Im(lambda) >= 0, in radians per unit of time."""
        return jnp.imag(self.eigenvalues)

    @property
    def growth_rate(self) -> Float[Array, "k modes"]:
        """Re(lambda): a positive one is flutter, or divergence without a frequency."""
        return jnp.real(self.eigenvalues)

    @property
    def damping_ratio(self) -> Float[Array, "k modes"]:
        """-Re(lambda) / |lambda|."""
        return -self.growth_rate / jnp.abs(self.eigenvalues)

    def to_dataset(self) -> Dataset:
        """The table as an `xarray.Dataset` over the parameter and `mode`, counted from 1.

        **Returns:** `frequency`, `growth_rate`, `damping_ratio`, their derivatives in the
        parameter `frequency_slope` and `growth_slope`, `mac`; `shape_real` and `shape_imag` over
        (parameter, mode, component, oscillator), `equilibrium` over (parameter, component,
        oscillator); the coordinate of the parameter.

        **Raises:** `ValueError` for traced modes, and for the modes of many models.
        """
        if is_traced(self.eigenvalues) or self.eigenvalues.ndim != 2:
            raise ValueError(
                "`ComplexModes.to_dataset` needs the modes of one model, outside of `jit` and "
                f"`vmap`, but has eigenvalues of shape {self.eigenvalues.shape}."
            )
        name = self.parameter or "point"
        _, units, text, parts = labels_of(self.chain, len(self.state), name)
        rate = "1" if self.chain.time_unit == "1" else "omega_n"
        shapes: Any = np.stack([np.asarray(part) for part in self.shapes], axis=2)
        equilibrium = np.stack([np.asarray(part) for part in self.state], axis=1)
        per, n = f"{rate} per unit of {name}", self.state[0].shape[-1]
        each, mac = ("component", "oscillator"), "modal assurance criterion with the value before"
        of_modes = {
            "frequency": Variable(self.frequency, (), rate, "angular frequency"),
            "growth_rate": Variable(self.growth_rate, (), rate, "growth rate"),
            "damping_ratio": Variable(self.damping_ratio, (), "1", "damping ratio"),
            "frequency_slope": Variable(self.slopes.imag, (), per, f"d frequency / d {name}"),
            "growth_slope": Variable(self.slopes.real, (), per, f"d growth rate / d {name}"),
            "mac": Variable(self.mac, (), "1", mac),
            "shape_real": Variable(shapes.real, each, None, "mode shape, real part"),
            "shape_imag": Variable(shapes.imag, each, None, "mode shape, imaginary part"),
        }
        return dataset(
            along(of_modes, name, "mode")
            | {"equilibrium": Variable(equilibrium, (name, *each), None, "equilibrium")},
            {
                name: Variable(self.values, (name,), units, text),
                "mode": np.arange(1, self.eigenvalues.shape[1] + 1),
                "component": [part for part, *_ in parts],
                "oscillator": np.arange(1, n + 1),
            },
            provenance_of(self.chain, n, [name] if self.parameter else []),
        )


@jax.custom_jvp
def eigensystem(matrix: Float[Array, "m m"]) -> tuple[Complex[Array, " m"], Complex[Array, "m m"]]:
    """(eigenvalues, right eigenvectors as columns of length 1), with derivatives of both.

        d lambda_i = w_i dA v_i,
        d v_i = sum over j != i of v_j (w_j dA v_i) / (lambda_i - lambda_j),

    where w_j are the rows of the inverse of [v_1 ... v_m].  Along the eigenvectors themselves the
    derivative is set to 0: normalise what depends on it.  Of repeated eigenvalues only the mean
    has a derivative, unless the change leaves them equal.
    """
    values, vectors = jnp.linalg.eig(matrix)
    return values, vectors


@eigensystem.defjvp
def _eigensystem_jvp(primals: Any, tangents: Any) -> Any:
    values, vectors = eigensystem(*primals)
    within = within_modes(vectors, *tangents)
    gaps = values[None, :] - values[:, None]
    near = _same(values)
    moved = vectors @ jnp.where(near, 0.0, within / jnp.where(near, 1.0, gaps))
    return (values, vectors), (jnp.diagonal(within), moved)


def _same(values: Array) -> Array:
    return jnp.abs(values[None, :] - values[:, None]) <= _SAME * jnp.abs(values)[None, :]


@jax.custom_jvp
def _inverse(vectors: Array) -> Array:
    return _inverse_one_by_one(vectors)


@_inverse.defjvp
def _inverse_jvp(primals: Any, tangents: Any) -> Any:
    inverse = _inverse(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


@jax.custom_batching.sequential_vmap
def _inverse_one_by_one(vectors: Array) -> Array:
    """By LAPACK, one after another: XLA solves batches of triangular systems ten times slower."""
    lu, _, order = lax.linalg.lu(vectors)
    rows = jnp.eye(order.size, dtype=vectors.dtype)[order]
    half = lax.linalg.triangular_solve(lu, rows, left_side=True, lower=True, unit_diagonal=True)
    return lax.linalg.triangular_solve(lu, half, left_side=True)


def within_modes(vectors: Array, change: Array) -> Complex[Array, "m m"]:
    """w_i dA v_j."""
    return _inverse(vectors) @ change @ vectors


def slopes_of(values: Array, within: Array) -> Complex[Array, " m"]:
    """w_i dA v_i; NaN where equal eigenvalues are split by dA, which mixes their vectors."""
    others = _same(values) & ~jnp.eye(values.size, dtype=bool)
    size = jnp.abs(lax.stop_gradient(within))
    mixed = jnp.any(others & (size > 1e-6 * jnp.max(size)), axis=1)
    return if_found(~mixed, jnp.diagonal(within))


def complex_modes(
    model: Given[AbstractModel],
    guess: Given[StateLike | None] = None,
    *,
    over: Mapping[str, Any] | None = None,
    tolerance: Given[ScalarLike] = 1e-12,
    max_steps: Given[int] = 50,
    throw: bool = True,
) -> ComplexModes:
    """Frequencies, growth rates and shapes of the modes of a model, over one of its parameters.

    At each value the equilibrium is found by Newton's method, from the one before, and the
    linearised model y' = A y gives A v = lambda v.  With the left eigenvectors w

        d lambda / dp = w* (dA/dp) v / (w* v),

    where dA/dp includes the motion of the equilibrium.  From value to value a mode is followed
    by its shape (MAC) and by lambda extrapolated by its slope, through crossings and veering.

    **Arguments:**

    - `model`: any model without forcing.  With dry friction all masses slide, so the belt must
      move.
    - `guess`: a state near the equilibrium at the first value; by default as for
      `find_equilibrium`.
    - `over`: the name of a parameter and its increasing or decreasing values, such as
      `{"friction": jnp.linspace(0.0, 0.6, 100)}`; an entry of a matrix is named "stiffness[0, 1]".
      By default only the present model, k = 1.
    - `tolerance`, `max_steps`: see `jaxchain.continuation.newton`.

    **Returns:** `ComplexModes`; `to_dataset` gives the table, `jaxchain.plotting.plot_modes` the
    picture.  It works under `jit`, `vmap` and `grad`: eigenvalues and shapes have derivatives in
    every parameter.  There columns without a mode are kept (one for each variable), and `throw`
    has no effect.

    **Raises:** `ValueError` for bad input; `RuntimeError` if there is no equilibrium at any value.

    !!! example

        Friction couples two modes, which meet at mu = 1 and flutter beyond:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.boundaries import complex_modes
        >>> from jaxchain.model import ModeCoupling
        >>> pads = ModeCoupling(2.0, 1.0, 0.5, contact_stiffness=1.0, friction=0.0)
        >>> modes = complex_modes(pads, over={"friction": [0.0, 0.9, 1.1]})
        >>> print(modes.frequency.round(3))
        [[0.89  1.486]
         [1.13  1.313]
         [1.228 1.228]]
        >>> print(modes.growth_rate.max(axis=1).round(3) + 0.0)
        [0.    0.    0.091]
    """
    as_model(model)
    state = near_equilibrium(model, guess)
    check_autonomous(model, state)
    limit = check_tolerance(tolerance, max_steps)
    check_flag("throw", throw)
    check_kind("over", over, Mapping | None, "a dict of one parameter and its values", "")
    if over is not None and len(over) != 1:
        raise ValueError(
            f"Argument `over` must name one parameter, but is {shown(over)}: name it with its "
            'values, such as {"belt_speed": [1.0, 1.5]}.'
        )
    name, values = next(iter((over or {None: jnp.zeros(1)}).items()))
    if name is not None:
        as_parameter(model, name, "over")
        values = as_array(f"over[{name!r}]", values, 1, 1, "the values of the parameter.")
        check_finite(f"over[{name!r}]", values)
        signs = () if is_traced(values) else np.sign(np.diff(np.asarray(values)))
        if len(set(signs)) > 1 or 0.0 in set(signs):
            raise ValueError(
                f"Argument `over[{name!r}]` must increase or decrease, but is {shown(values)}: a "
                "mode is followed from value to value."
            )
        for end in (values[0], values[-1]):
            model.with_(**{name: end})  # raises for impossible values
    found = _modes(model, name, state, to_float(values), to_float(tolerance), jnp.asarray(limit))
    if is_traced(found.eigenvalues):
        return found
    if throw and not np.any(found.successful):
        raise RuntimeError(
            f"No equilibrium was found at any value, the last residual is "
            f"{float(found.residual[0]):.1e}: start closer (`guess`), and with dry friction let "
            "the belt move, because only sliding masses have modes."
        )
    kept = ~np.all(np.isnan(found.eigenvalues), axis=0)
    return eqx.tree_at(
        lambda f: (f.eigenvalues, f.slopes, f.mac, f.shapes), found,
        (found.eigenvalues[:, kept], found.slopes[:, kept], found.mac[:, kept],
         tuple(part[:, kept] for part in found.shapes)),
    )  # fmt: skip


@eqx.filter_jit
def _modes(
    model: Any, name: str | None, state: State, values: Array, tolerance: Array, limit: Array
) -> ComplexModes:
    m, fixed_model = len(state), lax.stop_gradient(model)
    start = lax.stop_gradient(jnp.concatenate(state))
    points = lax.stop_gradient(values)
    root = equilibria_over(Rates.of(fixed_model, m, name), start, points, tolerance, limit)

    def matrix(u: Array, p: Array) -> tuple[Array, Array]:
        rates = Rates.of(model if name is None else model.with_(**{name: p}), m)
        y = attach_derivative(rest_residual, u, rates)
        return jax.jacfwd(rates)(y), y

    def at(u: Array, p: Array) -> tuple[Array, ...]:
        A, y = matrix(u, p)
        lam, V = eigensystem(A)
        if name is None:
            return lam, V, jnp.full_like(lam, jnp.nan), y
        change = jax.jvp(lambda p: matrix(u, p)[0], (p,), (jnp.ones_like(p),))[1]
        return lam, V, slopes_of(lam, within_modes(V, change)), y

    def outcome(u: Array, p: Array, result: SearchResult) -> SearchResult:
        """A failure where a dry mass does not move over the belt: it has no linear model."""
        there: Any = fixed_model if name is None else fixed_model.with_(**{str(name): p})
        layer = there.layer(0.0, tuple(jnp.split(u, m))) if there.dry else None
        slides = True if layer is None else jnp.all(layer[0] != 0)
        return SearchResult.where(slides, result, SearchResult.nonfinite)

    result = jax.vmap(outcome)(root.value, points, root.result)
    good = result == SearchResult.successful
    lam, V, slopes, y = jax.vmap(at)(root.value, values)
    fixed = [lax.stop_gradient(a) for a in (lam, V, slopes)]
    order, mac = _followed(fixed[0], fixed[1], fixed[2], points, good)
    lam, slopes = (jnp.take_along_axis(a, order, 1) for a in (lam, slopes))
    V = jnp.swapaxes(jnp.take_along_axis(V, order[:, None, :], 2), 1, 2)  # (k, modes, mn)
    half = V[..., : max(1, m // 2) * state[0].size]
    greatest = jnp.argmax(jnp.abs(lax.stop_gradient(half)), axis=2)
    V = V / jnp.take_along_axis(V, greatest[..., None], 2)
    oscillates = jnp.imag(lax.stop_gradient(lam)) >= 0

    def known(table: Array) -> Array:
        """NaN for the conjugate of another column, and also of derivatives without a state."""
        more = (None,) * (table.ndim - 2)
        found = if_found(good[(slice(None), None, *more)], table)
        nothing = complex(np.nan, np.nan) if jnp.iscomplexobj(table) else np.nan
        return jnp.where(oscillates[(..., *more)], found, nothing)

    return ComplexModes(
        chain=model,
        parameter=name,
        values=values,
        state=tuple(jnp.split(y, m, axis=1)),
        eigenvalues=known(lam),
        slopes=known(slopes),
        shapes=tuple(jnp.split(known(V), m, axis=2)),
        mac=known(mac),
        residual=root.residual,
        result=result,
        steps=root.steps,
    )


def _followed(
    lam: Array, V: Array, slopes: Array, values: Array, good: Array
) -> tuple[Int[Array, "k m"], Float[Array, "k m"]]:
    """For each value the eigenvalue in each column, and the MAC with the one before."""
    m = lam.shape[1]

    def positive_first(order: Array, lam: Array) -> Array:
        """Of each pair, which LAPACK puts side by side, the positive one in the lower column."""
        index = jnp.arange(m)
        up, down = jnp.imag(lam) > 0, jnp.imag(lam) < 0
        partner = jnp.where(up, index + 1, jnp.where(down, index - 1, index))[order]
        column = jnp.zeros(m, int).at[order].set(index)[partner]
        swap = jnp.where(up[order], column < index, down[order] & (column > index))
        return jnp.where(swap, partner, order)

    def start(lam: Array) -> Array:
        group = jnp.where(jnp.imag(lam) > 0, 0, jnp.where(jnp.imag(lam) < 0, 2, 1))
        return jnp.lexsort((-jnp.real(lam), jnp.imag(lam), group))

    def match(score: Array) -> Array:
        """The greatest score first."""

        def take(_: Any, state: Any) -> Any:
            score, order = state
            i, j = jnp.divmod(jnp.argmax(score), m)
            return score.at[i, :].set(-jnp.inf).at[:, j].set(-jnp.inf), order.at[i].set(j)

        return lax.fori_loop(0, m, take, (score, jnp.zeros(m, int)))[1]

    def step(before: Any, now: Any) -> Any:
        known, last, shapes, rate, p = before
        lam, V, slope, q, good = now
        mac = jnp.abs(jnp.conj(shapes.T) @ V) ** 2  # columns have length 1
        moved = jnp.nan_to_num(rate * (q - p))
        most = 0.1 * jnp.abs(last)  # close to flutter the slope is infinite
        moved = moved * jnp.minimum(1.0, most / jnp.maximum(jnp.abs(moved), 1e-300))
        aim, lam_j = (last + moved)[:, None], lam[None, :]
        far = jnp.abs(lam_j - aim) / jnp.maximum(jnp.abs(lam_j) + jnp.abs(aim), 1e-300)
        score = mac - 2.0 * far
        best = jnp.argmax(score, axis=1)
        one_each = jnp.all(jnp.zeros(m, int).at[best].add(1) == 1)
        order = lax.cond(one_each, lambda: best, lambda: match(jnp.nan_to_num(score, nan=-9.0)))
        order = jnp.where(known, positive_first(order, lam), start(lam))
        order = jnp.where(good, order, jnp.arange(m))
        alike = jnp.where(known, mac[jnp.arange(m), order], jnp.nan)
        here = (jnp.asarray(True), lam[order], V[:, order], slope[order], q)
        after = jax.tree.map(lambda a, b: jnp.where(good, a, b), here, before)
        return after, (order, alike)

    none = (jnp.asarray(False), lam[0], V[0], slopes[0], values[0])
    return lax.scan(step, none, (lam, V, slopes, values, good))[1]
