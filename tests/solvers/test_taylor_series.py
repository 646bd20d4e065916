"""Series of composed functions against Taylor-mode differentiation and closed forms."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.jet import jet

from jaxchain.model.friction import WeakeningStrengthening
from jaxchain.solvers.taylor import composed, value

ORDER = 7
# s(t) of two masses, degree six.
PATH = [jnp.array([0.7, 0.1]), *(jnp.array([0.5, -0.3]) / k for k in range(1, ORDER))]

PLAIN = (
    jnp.exp2, jnp.log1p, jnp.square, jnp.tanh, jax.nn.sigmoid, jnp.sin, jnp.cos, jnp.sinh,
    jnp.cosh, jnp.arctan, jax.scipy.special.erf, jnp.tan, jnp.cbrt, jax.nn.silu,
)  # fmt: skip
FUNCTIONS: dict[str, Any] = {function.__name__: function for function in PLAIN} | {
    "add": lambda s: s + 0.3 + s,
    "subtract": lambda s: 0.3 - s - (s - 2.0),
    "multiply": lambda s: s * s * 0.4,
    "divide": lambda s: (1.0 + s) / (2.0 + s * s) + 1.0 / (1.0 + s) + s / 3.0,
    "exp": lambda s: jnp.exp(-s / 0.4),
    "expm1": lambda s: jnp.expm1(-s),
    "log": lambda s: jnp.log(1.0 + s),
    "sqrt": lambda s: jnp.sqrt(1.0 + s),
    "rsqrt": lambda s: jax.lax.rsqrt(1.0 + s),
    "cube": lambda s: s**3,
    "sixth power": lambda s: s**6,
    "seventh power": lambda s: s**7,
    "inverse square": lambda s: (1.0 + s) ** -2,
    "no power": lambda s: s**0 + s,
    "whole float power": lambda s: s**2.0,
    "real power": lambda s: s**1.7,
    "a number to the power": lambda s: 1.3**s,
    "power of itself": lambda s: s**s,
    "arc sine": lambda s: jnp.arcsin(0.5 * s),
    "arc cosine": lambda s: jnp.arccos(0.5 * s),
    "parts": lambda s: jnp.zeros(2).at[0].set(s[0]).at[1].add(jnp.split(s, 2)[1][0] ** 2),
    "jit": jax.jit(lambda s: jnp.exp(-s)),
    "matrix": lambda s: jnp.array([[1.0, 2.0], [0.5, -1.0]]) @ s,
    "shapes": lambda s: jnp.sum(jnp.stack([s, 2.0 * s])[:, ::-1], axis=0),
    "time has no part": lambda s: jnp.full_like(s, 0.3),
    "a law": WeakeningStrengthening(1.0, 0.5, 0.5, 0.1).coefficient,
}


def coefficients(function, path=PATH, **options):
    series = composed(function, path, **options)
    return jnp.stack([jnp.broadcast_to(series[k], (2,)) for k in range(ORDER)])


def by_jet(function, *paths):
    paths = paths or (PATH,)
    derivatives = [[math.factorial(k) * c for k, c in enumerate(p)][1:] for p in paths]
    first, rest = jet(function, [path[0] for path in paths], derivatives)
    return jnp.stack([first, *(c / math.factorial(k) for k, c in enumerate(rest, start=1))])


def computed(make):
    """What `make` returns, made of constants, by one program."""
    return jax.tree.map(np.asarray, jax.jit(make)())


def test_every_operation_has_the_coefficients_of_taylor_mode_differentiation():
    def one(function):
        own = coefficients(function)
        try:
            expected = by_jet(function)
        except KeyError:  # jet does not know all of these; the sum of the series tells
            expected = own
        # And the series has the sum that it should have: 1e-3^7 is below rounding.
        t = 1e-3
        return own, expected, value(list(own), t), function(value(PATH, t))

    found = computed(lambda: {name: one(function) for name, function in FUNCTIONS.items()})
    for name, (own, expected, total, known) in found.items():
        np.testing.assert_allclose(own, expected, rtol=1e-12, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(total, known, rtol=1e-14, err_msg=name)
    # The size of a speed is no choice.
    np.testing.assert_array_equal(coefficients(jnp.abs), coefficients(lambda s: s))


CHOICES = [
    (lambda s: jnp.where(s < 0.4, jnp.exp(s), s**2), (lambda s: s**2, jnp.exp)),
    (lambda s: jnp.maximum(s, 0.4 + 0 * s), (lambda s: s, lambda s: 0.4 + 0 * s)),
    (lambda s: jnp.minimum(s**2, 0.3), (lambda s: 0.3 + 0 * s, jnp.square)),
    (lambda s: jnp.abs(s - 0.4), (lambda s: s - 0.4, lambda s: 0.4 - s)),
    (lambda s: jnp.clip(s, 0.2, 2.0), (lambda s: s, lambda s: 0.2 + 0 * s)),
    (lambda s: jnp.sign(s - 0.4) * s, (lambda s: s, lambda s: -s)),
    (lambda s: jnp.array([1.0, 3.0])[(s > 0.4).astype(int)] * s, (lambda s: 3 * s, lambda s: s)),
]


def test_a_choice_by_speed_is_made_at_the_start_of_the_step_and_must_be_allowed():
    for chooses, _ in CHOICES:
        with pytest.raises(ValueError, match="give the law the field or property `knots`"):
            coefficients(chooses)

    def both():
        own = [coefficients(chooses, piecewise=True) for chooses, _ in CHOICES]
        # 0.7 is above, 0.1 below.
        return own, [[by_jet(f)[:, i] for i, f in enumerate(branch)] for _, branch in CHOICES]

    for k, (own, expected) in enumerate(zip(*computed(both), strict=True)):
        expected = np.stack(expected, axis=1)
        np.testing.assert_allclose(own, expected, rtol=1e-13, atol=1e-15, err_msg=str(k))
    # Where the cases meet, that of greater speeds is taken.
    path = [jnp.zeros(2), jnp.ones(2), *[jnp.zeros(2)] * (ORDER - 2)]
    kink = coefficients(lambda s: jnp.maximum(0.0, s), path, piecewise=True)
    np.testing.assert_array_equal(kink[1], [1.0, 1.0])


def test_a_series_grows_with_its_argument():
    """The solution of s' = -s^2 + exp(-s), order by order, against its derivatives."""

    def rate(s):
        return -(s**2) + jnp.exp(-s)

    def grown():
        path, derivative, expected = [jnp.array([0.3, 0.6])], rate, []
        series = composed(rate, path)
        for k in range(4):
            path.append(series[k] / (k + 1))
            expected.append(derivative(path[0]) / math.factorial(k + 1))
            derivative = _along(derivative, rate)
        return path[1:], expected

    np.testing.assert_allclose(*computed(grown), rtol=1e-12)


def _along(function, rate):
    return lambda s: jax.jvp(function, (s,), (rate(s),))[1]


def test_a_law_that_cannot_be_expanded_is_refused_with_a_reason():
    loop = lambda s: jax.lax.while_loop(lambda y: y[0] < 9.0, lambda y: y * (1.0 + s), 1.0 + s)
    with pytest.raises(ValueError, match=r"cannot be expanded in a Taylor series.*smoothed"):
        coefficients(loop)


# JAX chooses between cases in these, but only to be accurate.
SMOOTH = {
    "softplus": (
        lambda s: jax.nn.softplus(3 * s - 0.9), lambda s: jnp.log1p(jnp.exp(3 * s - 0.9))
    ),
    "where its cases meet": (
        lambda s: jax.nn.softplus(s - 0.7), lambda s: jnp.log1p(jnp.exp(s - 0.7))
    ),
    "logaddexp": (
        lambda s: jnp.logaddexp(s, 1.0 - s), lambda s: jnp.log(jnp.exp(s) + jnp.exp(1.0 - s))
    ),
    "logaddexp2": (lambda s: jnp.logaddexp2(s, 0.1), lambda s: jnp.log2(2.0**s + 2.0**0.1)),
}  # fmt: skip


# Forces of a displacement (here the path) and a velocity, and the case that each of two masses is
# in: they are at 0.7 and 0.1.
FORCES = {
    "damping by the square": (lambda q, v: v * jnp.abs(v), lambda q, v: v * v * SIGNS),
    "a stop": (lambda q, v: -jnp.maximum(q - 0.3, 0.0), lambda q, v: -(q - 0.3) * FIRST),
    "cases": (
        lambda q, v: jnp.where(q > 0.3, jnp.sin(q), q * v),
        lambda q, v: jnp.stack([jnp.sin(q)[0], (q * v)[1]]),
    ),
    "table": (
        lambda q, v: jnp.interp(q, jnp.array([0.0, 0.3, 1.0]), jnp.array([1.0, 4.0, 0.5])),
        lambda q, v: jnp.stack([4.0 - 5.0 * (q[0] - 0.3), 1.0 + 10.0 * q[1]]),
    ),
    "remainder": (lambda q, v: (q * q) % 0.3, lambda q, v: q * q - 0.3 * FIRST),
    "remainder of a negative": (lambda q, v: -q % 0.3, lambda q, v: jnp.array([0.9, 0.3]) - q),
    "division": (lambda q, v: q * (q // 0.3), lambda q, v: 2.0 * q * FIRST),
    "steps": (
        lambda q, v: jnp.round(q) * v + jnp.floor(2 * q) + jnp.sign(q - 0.3) + jnp.trunc(q),
        lambda q, v: FIRST * v + jnp.array([2.0, -1.0]),
    ),
    "greatest": (
        lambda q, v: jnp.max(jnp.stack([q, 1.0 - q, v]), axis=0),
        lambda q, v: jnp.stack([q[0], 1.0 - q[1]]),
    ),
    "logarithm of a sum": (
        lambda q, v: jax.nn.logsumexp(jnp.stack([q, v]), axis=0),
        lambda q, v: jnp.log(jnp.exp(q) + jnp.exp(v)),
    ),
}
SIGNS, FIRST = jnp.array([1.0, -1.0]), jnp.array([1.0, 0.0])
SPEED = [*(k * c for k, c in enumerate(PATH[1:], start=1)), jnp.zeros(2)]  # 0.5 and -0.3


def test_smooth_functions_that_jax_writes_with_cases_and_forces_that_choose():
    def both():
        smooth = {name: (coefficients(f), by_jet(closed)) for name, (f, closed) in SMOOTH.items()}
        forces = {}
        for name, (force, case) in FORCES.items():
            series = composed(force, PATH, SPEED)
            own = [jnp.broadcast_to(series[k], (2,)) for k in range(ORDER)]
            forces[name] = jnp.stack(own), by_jet(case, PATH, SPEED)
        return smooth, forces

    for found in computed(both):
        for name, (own, expected) in found.items():
            np.testing.assert_allclose(own, expected, rtol=1e-11, atol=1e-13, err_msg=name)


def test_at_a_corner_a_force_takes_the_side_to_which_the_motion_goes():
    """The sign of the slope decides, so that what moves down leaves a jump, too."""
    path, other = [jnp.zeros(2), jnp.array([1.0, -1.0])], [jnp.ones(2), jnp.zeros(2)]
    kink = composed(lambda q, v: jnp.abs(q) + q % 1.0, path, other, slopes=[path[1], 1.0])
    np.testing.assert_array_equal(kink[0], [0.0, 1.0])
    np.testing.assert_array_equal(kink[1], [2.0, 0.0])


def test_one_more_order_costs_as_many_operations_as_its_number():
    """The whole series is a program of O(order^2) operations; one jet per order makes it cubic."""

    def size(order):
        def run(path):
            series = composed(FUNCTIONS["real power"], path)
            return [series[k] for k in range(order)]

        return len(jax.make_jaxpr(run)([np.float64(0.5)] * order).eqns)

    assert size(32) < 1.2 * 4**2 * size(8)
