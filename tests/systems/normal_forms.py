"""Equations F(u, p, args) = 0 with known folds and branch points, for continuation."""

import jax.numpy as jnp
from jax import lax


def circle(u, p, args):
    """Folds at p = 1 and -1."""
    return u**2 + p**2 - 1.0


def pitchfork(u, p, imperfection):
    """u = 0 and u^2 = p cross at 0; with an imperfection d, fold at p = 3 (d/2)^(2/3)."""
    return p * u - u**3 + imperfection


def cycles(u, m, a):
    """r' = r (m + a r^2 - r^4) with r divided out and u = r^2: fold at m = -a^2/4, u = a/2."""
    return m + a * u - u**2


def kink(u, p, d):
    """p = u - (3/2) d tanh(u / d): folds at cosh(u / d)^2 = 3/2, a distance O(d) apart."""
    return u - 1.5 * d * jnp.tanh(u / d) - p


def unfolded(u, p, e):
    """p = u^3 - 3 e^2 u: folds at u = -+e, p = +-2 e^3."""
    return u**3 - 3 * e**2 * u - p


def hyperbola(u, p, gap):
    """Two branches that bend away from each other, a distance 2 gap apart."""
    return u**2 - p**2 - gap**2


def sheets(u, p, gap):
    """u = sin(p) and u = sin(p) + gap: parallel branches."""
    return (u - jnp.sin(p)) * (u - jnp.sin(p) - gap)


def pair(u, p, c):
    """Two coupled pitchforks: u = 0; x = y at p = 0; x = -y, p = 2 c + x^2, from p = 2 c.

    From the last, at p = 3 c, a branch with x y = -c and x^2 + y^2 = p - c.
    """
    x, y = u
    return jnp.stack([p * x - x**3 + c * (y - x), p * y - y**3 + c * (x - y)])


def bratu(u, p, rows):
    """u'' + p exp(u) = 0 on (0, 1), u = 0 at both ends; rows times `rows`. Fold: 3.513830719."""
    v, h = jnp.pad(u, 1), 1.0 / (u.shape[0] + 1)
    return rows * ((v[2:] - 2 * u + v[:-2]) / h**2 + p * jnp.exp(u))


def upright(u, p, args):
    """p = 0.3 all along x2 = sin 3 x1, in two equations that mix both."""
    off, g = p - 0.3, u[1] - jnp.sin(3 * u[0])
    return jnp.stack([g * jnp.exp(u[1]) + off * (1 + u[0] ** 2), 2 * g - off / 3 + g * off])


def logistic(u, p, args):
    """Fixed point 1 - 1/p of p u (1 - u), whose multiplier, the extra, is -1 at p = 3."""
    return p * u * (1 - u) - u, p * (1 - 2 * u)


def looped(residual):
    """The same residual through a loop that only forward derivatives go through."""

    def through(u, p, args):
        def body(state):
            return state[0] + 1.0, 0.5 * (state[1] + u)

        return residual(lax.while_loop(lambda s: s[0] < 1.0, body, (0.0 * u[0], u))[1], p, args)

    return through
