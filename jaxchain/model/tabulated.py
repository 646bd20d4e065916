"""Measured friction as a law: a smooth curve through the points of a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.interpolate import PchipInterpolator

from .._checks import (
    check_kind,
    check_nonnegative,
    check_number,
    numbers_of,
    shown,
    to_float,
)
from .._types import PerMass
from .friction import AbstractFrictionLaw
from .measured import check_measured, read_curve
from .units import FROM_SI, Scales


class TabulatedFriction(AbstractFrictionLaw):
    """mu(s) through measured points (s_i, mu_i), by piecewise cubic interpolation.

    The curve keeps the shape of the data (PCHIP): between two points it stays between their values
    and is monotone; its slope is zero at extrema of the data.  Beyond the last speed mu is
    constant; its slope may jump there.  The first speed must be 0, and its mu is `mu_static`.

    mu'' jumps at every point.  Event-driven steps end there (`knots`); with smoothed friction the
    error estimate accounts for it.

    Source: F. N. Fritsch, J. Butland, A method for constructing local monotone piecewise cubic
    interpolants, SIAM J. Sci. Stat. Comput. 5 (1984), as `scipy.interpolate.PchipInterpolator`.

    **Arguments:** `speed` = s_0 ... s_K, increasing from 0, in units of x0 omega_n; `mu` >= 0, of
    the same length.  All masses have the same curve; `Chain.with_` and sweeps cannot change its
    numbers.

    **Raises:** `ValueError` for anything else.

    >>> from jaxchain.model import TabulatedFriction
    >>> law = TabulatedFriction(speed=[0.0, 0.5, 1.0, 2.0], mu=[1.0, 0.7, 0.6, 0.6])
    >>> [round(float(law.coefficient(s)), 4) for s in (0.0, 0.5, 0.75, 9.0)]
    [1.0, 0.7, 0.6312, 0.6]
    """

    _continuous = True
    pieces: Float[Array, "5 knots"]
    """For each s_i: s_i, and the cubic in s - s_i from there on, lowest coefficient first."""

    def __init__(self, speed: Sequence[float] | ArrayLike, mu: Sequence[float] | ArrayLike):
        s, m = numbers_of("speed", speed), numbers_of("mu", mu)
        if s is None or m is None:
            raise ValueError(
                "`TabulatedFriction` takes measured numbers, which cannot be traced: make the law "
                "before `jit`, `vmap` or `grad`."
            )
        try:
            check_measured(s, m)
        except ValueError as error:
            raise ValueError(f"Arguments `speed` and `mu` are no friction law: {error}.") from None
        constant = np.array([[m[-1]], [0.0], [0.0], [0.0]])
        cubics = np.concatenate([PchipInterpolator(s, m).c[::-1], constant], axis=1)
        self.pieces = to_float(np.concatenate([s[None], cubics]))

    @classmethod
    def from_csv(
        cls, path: str | Path, *, scales: Scales | None = None, mu_static: Any = None
    ) -> TabulatedFriction:
        """Reads a file of two columns, speed and mu: see `read_curve` in `model/measured.py`.

        **Arguments:** `path` of the file; `scales`: if given, speeds are in m/s and are converted;
        `mu_static`, the friction at rest, for a file without a row at the speed 0.

        **Raises:** `ValueError` as the class, naming a line that is not a pair of numbers, or for
        a `mu_static` that contradicts the file; `OSError` if the file does not exist.

        >>> import pathlib, tempfile
        >>> from jaxchain import Scales
        >>> from jaxchain.model import TabulatedFriction
        >>> rig = Scales.from_dimensional(2.0, 2.0, 200.0, None, 10.0)  # 0.5 m/s is the speed 1
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "pad.csv")
        ...     _ = path.write_text("speed (m/s), mu\\n 0.25, 0.7\\n 0.5, 0.6\\n")
        ...     law = TabulatedFriction.from_csv(path, scales=rig, mu_static=1.0)
        >>> law
        TabulatedFriction(speed=[0, 0.5, 1], mu=[1, 0.7, 0.6])
        """
        check_kind("path", path, str | Path, "the name of a file")
        check_kind("scales", scales, Scales | None, "None or a `Scales`", FROM_SI)
        try:
            speed, mu = read_curve(path)
        except UnicodeDecodeError:
            raise ValueError(f"Argument `path` = {path} is not a text file in UTF-8.") from None
        if mu_static is not None:
            check_nonnegative("mu_static", mu_static, "it is the friction at rest.")
            check_number("mu_static", mu_static)
            if speed[:1] == [0.0] and mu[0] != float(mu_static):
                raise ValueError(
                    f"Argument `mu_static` is {shown(mu_static)}, but {path} has the friction "
                    f"{mu[0]:g} at the speed 0: leave one of them out."
                )
            if speed[:1] != [0.0]:
                speed, mu = [0.0, *speed], [float(mu_static), *mu]
        elif speed and speed[0] > 0:
            raise ValueError(
                f"Argument `path` = {path} has no row at the speed 0, its first speed is "
                f"{speed[0]:g}: give the friction at rest as `mu_static`."
            )
        unit = 1.0 if scales is None else float(scales.unit("velocity"))
        return cls([one / unit for one in speed], mu)

    @property
    def table(self) -> Float[Array, "2 knots"]:
        """The points: speeds, and friction coefficients."""
        return self.pieces[:2]

    @property
    def speed(self) -> Float[Array, " knots"]:
        """The speeds of the points."""
        return self.pieces[0]

    @property
    def mu(self) -> Float[Array, " knots"]:
        """The friction coefficients of the points."""
        return self.pieces[1]

    @property
    def mu_static(self) -> PerMass:
        return self.pieces[1, 0]

    @property
    def knots(self) -> Float[Array, " knots"]:
        return self.pieces[0, 1:]

    def parameters(self) -> dict[str, Any]:
        """Empty: the table has no numbers for `Chain.with_`."""
        return {}

    def coefficient(self, speed: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        s = jnp.asarray(speed)
        # The default is a loop, which suits tables of thousands of rows.
        piece = jnp.searchsorted(self.knots, s, side="right", method="compare_all")
        start, c0, c1, c2, c3 = self.pieces[:, piece]
        d = s - start
        return c0 + d * (c1 + d * (c2 + d * c3))
