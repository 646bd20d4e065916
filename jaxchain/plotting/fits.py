"""How well each value of a fitted number agrees with the measurements."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes

from .._checks import check_kind
from ..inverse import Profile
from .colours import BLUE, GREY, RED
from .style import on_axes


def plot_profile(profile: Profile, name: Any, *, ax: Axes | None = None) -> Axes:
    """Draws the profile likelihood of a number: chi^2 over its value, all others fitted anew.

    The interval, shaded, ends where the curve crosses the dashed line, the square of the quantile
    of its confidence.  The more the curve differs from a parabola, the less can
    `Identification.interval` be trusted.

    **Arguments:** `profile`, that of `jaxchain.inverse.profile`; `name` of the number, with its
    unit, for the axis; `ax`, matplotlib axes; None makes new ones of a column's width (85 mm).

    **Returns:** the axes.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.inverse import Measurements, identify, profile
        >>> from jaxchain.plotting import plot_profile
        >>> chain, law = paper_chain(n=1, width=None), lambda chain, v: chain.with_(v_ref=v)
        >>> lab = Measurements(hopf=(1.2, 0.05))
        >>> of_v = profile(identify(chain, law, jnp.array(0.6), lab), chain, law, lab, 0)
        >>> ax = plot_profile(of_v, r"$v_0$ (–)")
        >>> ax.get_ylabel()
        '$\\\\chi^2 - \\\\chi^2_\\\\mathrm{min}$ (–)'
    """
    check_kind("profile", profile, Profile, "a `Profile`", "`jaxchain.inverse.profile` makes one.")
    check_kind("name", name, str, "the name of the number", 'such as "$v_0$ (–)".')
    values, rise = np.asarray(profile.values), np.asarray(profile.chi_squared - profile.least)
    there = np.isfinite(rise)
    limit = float(jax.scipy.stats.norm.ppf(0.5 + 0.5 * profile.confidence)) ** 2
    with on_axes(ax) as axes:
        axes.plot(values[there], rise[there], ".-", color=BLUE)
        low, high = np.clip([profile.low, profile.high], values[0], values[-1])
        axes.axvspan(low, high, color=GREY, alpha=0.25, linewidth=0)
        label = f"{float(profile.confidence):.3g} confidence"
        axes.axhline(limit, color=RED, linestyle="--", label=label)
        axes.set(xlim=values[[0, -1]], ylim=(0.0, 3.0 * limit), xlabel=name)
        axes.set_ylabel(r"$\chi^2 - \chi^2_\mathrm{min}$ (–)")
        axes.legend(loc="upper center")
    return axes
