"""How much error does the regularization width cause, and which width buys which accuracy?

The stick-slip cycle of one oscillator and some localized states of the paper's chain, with
smoothed and with true dry friction.  The relative error of each quantity follows

    smoothed / dry - 1 = a eps ln(1/eps) + b eps

Why?  The belt brings the force on a mass to mu_st at the rate k v_d, so a dry mass leaves it as
|w| = k v_d t^2 / 2.  Smoothed, |w|' = k v_d t + 2 mu_st exp(-2 |w| / eps) about, which is linear
in exp(2 |w| / eps): its solution is that of a dry mass that leaves the belt at a relative speed of
(eps/4) ln[16 pi mu_st^2 / (k v_d eps)].  So a = d ln Q / d|w| / 4 for every quantity Q, which dry
runs that leave the belt at a small speed give, without any fit.  (The greatest friction falls
short of mu_st by twice that; no mass that is pulled off at a finite rate waits for it.)

Prints a table: for each quantity and belt speed, and for each state, the dry value, a as expected
and as fitted, b, the greatest deviation of the fit, up to which width it holds, and the greatest
widths with errors of 1 %, 0.1 % and 0.01 %.  Two minutes on two cores:

    python examples/studies/crosscheck.py
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from _common import BLUE, GREEN, GREY, ORANGE, SPEED, letters, options

import jaxchain as jc
from jaxchain.model import on_the_belt
from jaxchain.plotting import save_figure
from jaxchain.result import ended_well

GOALS = [1e-2, 1e-3, 1e-4]
WIDTHS = [0.1, 0.05, 0.02, 0.01, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5]
# One oscillator; a vibration that cannot survive needs the transient to die.
SPEEDS = np.linspace(0.2, 1.8, 17)
TRANSIENT, WINDOW, RTOL = 150.0, 50.0, 1e-10
# States of the ring of twenty at belt speed 1.5, after the same time from the same start.
EXCITED = [1, 2, 4, 10]
STATE_TRANSIENT, STATE_RTOL = 300.0, 1e-9
# Of the dry runs, and of those that leave the belt at a small speed, in belt speeds.
DRY_RTOL, LEAVING_RTOL, LEAVING = 1e-12, 1e-9, 1e-4
# A cycle: its last two maxima, and the periods before them, agree as well as this.
SETTLED = 1e-8
# A law is taken as far as it fits this well; errors below 1000 rtol say nothing of the width.
WORST, FLOOR = 3e-3, 1e3
LOOKS = {"amplitude": (BLUE, "o"), "period": (ORANGE, "s"), "stick time": (GREEN, "D")}


def cycles(speeds, widths, rtol, solver=None):
    """Amplitude, period and stick time over belt speed and width; NaN where there is no cycle."""
    chain = jc.paper_chain(1)
    watch = [jc.Amplitude(window=WINDOW), jc.Section(0, capacity=int(WINDOW / 3), start=TRANSIENT)]
    runs = jc.sweep(
        chain, on_the_belt, TRANSIENT + WINDOW, over={"belt_speed": speeds, "width": widths},
        observe=watch, rtol=rtol, solver=solver,
    ).isel(oscillator=0)  # fmt: skip
    times, tops = runs.section_time.values, runs.section_displacement.values
    last = np.maximum(np.isfinite(times).sum(-1, keepdims=True) + np.arange(-3, 0), 0)
    times, tops = (np.take_along_axis(values, last, -1) for values in (times, tops))
    before, period = np.moveaxis(np.diff(times), -1, 0)

    @jax.jit
    @jnp.vectorize
    def stick_time(speed, width, top, period):
        # From one maximum to the next: no mass sticks there, where its velocity is 0.
        own, start = chain.with_(belt_speed=speed, width=width), (top[None], jnp.zeros(1))
        watch = jc.StickTime()
        run = jc.simulate(own, start, period, observe=watch, rtol=rtol, solver=solver, throw=False)
        return run.observed[0]

    speed = np.asarray(speeds)[:, None]
    amplitude = runs.amplitude.values
    sticks = stick_time(speed, np.asarray(widths), tops[..., -1], period)
    apart = np.maximum(abs(before / period - 1), abs(np.diff(tops)[..., 1]) / amplitude)
    good = (apart <= SETTLED) & (amplitude > speed / 2) & ended_well(runs.result.values)
    coords = {"quantity": [*LOOKS], "belt_speed": speeds, "width": widths}
    return xr.DataArray(np.where(good, [amplitude, period, sticks], np.nan), coords, [*coords])


def expected_factors(dry):
    """The factor a of dry cycles, (quantity, belt_speed), as leaving the belt lets expect it."""

    @jax.jit
    @jax.vmap
    def left_at(speed, w, duration):
        # From the release, with a relative speed of w, until the mass is on the belt again.
        chain = jc.paper_chain(1, belt_speed=speed, width=None)
        release = chain.law.mu_static - 2.0 * chain.damping_ratio * speed
        start, watch = (release[None], (speed - w)[None]), (jc.Amplitude(), jc.StickTime())
        run = jc.simulate(chain, start, duration, observe=watch, rtol=LEAVING_RTOL, throw=False)
        amplitude, stick = (value[0] for value in run.observed)
        rest = (release - run.state[0][0]) / speed  # of the way, until the next release
        return jnp.stack([amplitude, duration + rest, stick + rest])

    speed, (_, period, stick) = dry.belt_speed.values, dry.values
    w = LEAVING * speed
    once, twice = (left_at(speed, k * w, period - 0.5 * stick).T - dry.values for k in (1, 2))
    factors = np.array((2.0 * once - 0.5 * twice) / w / dry.values / 4.0)
    # A mass that lands counts as sticking from a speed of (eps/2) ln(1/eps) on; its deceleration
    # is the way on the belt, by which the spring is shorter than at the release.
    factors[2] += 0.5 / (speed * stick**2)
    return dry.copy(data=factors)


def law(width, a, b):
    """The relative error at a width."""
    return width * (a * np.log(1 / width) + b)


def fit(widths, errors, rtol):
    """a, b, the greatest deviation and the widest width of the law, then a width for each goal.

    From the three narrowest widths on, wider ones are added while all are met within `WORST`.
    """
    order = np.argsort(widths)
    widths, errors = np.asarray(widths)[order], np.asarray(errors)[order]
    clear = np.abs(errors) > FLOOR * rtol  # false for NaN
    eps, error = widths[clear], errors[clear]
    found = [np.nan] * 4
    for count in range(3, eps.size + 1):
        columns = law(eps[:count, None], *np.eye(2)) / error[:count, None]
        (a, b), *_ = np.linalg.lstsq(columns, np.ones(count))
        worst = np.max(np.abs(columns @ [a, b] - 1))
        if count > 3 and worst > WORST:
            break
        found = [a, b, worst, eps[count - 1]]
    # By the law as far as it holds, beyond it by what was measured.
    a, b, _, widest = found
    fine = np.geomspace(1e-8, widest, 20001)
    beyond = widths > widest
    at = np.append(fine, widths[beyond])
    size = np.abs(np.append(law(fine, a, b), errors[beyond]))
    return [*found, *(width_for(at, size, goal) for goal in GOALS)]


def width_for(widths, size, goal):
    """The width up to which all errors are at most `goal`; before one that is not known."""
    i = int(np.argmax(~(size <= goal)))
    if size[i] <= goal:  # all of them
        return widths[-1]
    if i == 0 or np.isnan(size[i]):
        return widths[i - 1] if i else np.nan
    share = np.log(goal / size[i - 1]) / np.log(size[i] / size[i - 1])
    return widths[i - 1] * (widths[i] / widths[i - 1]) ** share


def energies(n, excited, widths, rtol, solver=None):
    """Energy over the masses excited at the start and the width, and how many vibrate."""
    runs = jc.sweep(
        jc.paper_chain(n), jc.equation_8, STATE_TRANSIENT + WINDOW, solver=solver, rtol=rtol,
        over={"excited": excited, "width": widths}, observe=jc.Amplitude(window=WINDOW),
    )  # fmt: skip
    return runs.energy, runs.active_count


def main():
    quick, folder = options(__file__, __doc__)
    widths = [1e-3, 5e-4, 2e-4, 1e-4, 1e-5] if quick else WIDTHS
    n, speeds, excited = (3, [0.5, 1.5], [1]) if quick else (20, SPEEDS, EXCITED)

    smoothed = cycles(speeds, widths, RTOL)
    dry = cycles(speeds, widths[:1], DRY_RTOL, jc.EventDriven()).isel(width=0, drop=True)
    error, expected = smoothed / dry - 1, expected_factors(dry)
    energy, count = energies(n, excited, widths, STATE_RTOL)
    dry_states = energies(n, excited, widths[:1], DRY_RTOL, jc.EventDriven())
    true, true_count = (values.isel(width=0, drop=True) for values in dry_states)
    # Where other masses vibrate it is another state, which is not compared.
    energy_error = (energy / true - 1).where((count == true_count) & (true_count > 0))

    rows = [
        [name, f"v_d = {v:g}", dry.sel(at), expected.sel(at), *fit(widths, error.sel(at), RTOL)]
        for name in LOOKS
        for v in speeds
        for at in [{"quantity": name, "belt_speed": v}]
    ] + [
        ["energy", f"{k} of {n}", true.sel(excited=k), np.nan,
         *fit(widths, energy_error.sel(excited=k), STATE_RTOL)]
        for k in excited
    ]  # fmt: skip
    goals = [f"width for {100 * goal:g} %" for goal in GOALS]
    head = ["quantity", "at", "dry", "a expected", "a", "b", "off by", "up to width", *goals]
    table = pd.DataFrame(rows, columns=head).astype(dict.fromkeys(head[2:], float))
    print("relative error = a eps ln(1/eps) + b eps")
    print(table.to_string(index=False, na_rep="", float_format="%.4g"))

    table.to_csv(folder / "crosscheck.csv", index=False)
    save_figure(draw(error, energy_error, table), folder / "crosscheck")


def draw(error, energy_error, table):
    """(a)-(d) Errors over width; (e) width for an accuracy, (f) factor a, over belt speed."""
    page, panels = plt.subplots(2, 3, figsize=(7.0, 4.9))
    several = zip(panels.flat, [*LOOKS, "energy"], [*error, energy_error])
    for axes, name, data in several:
        over = data.dims[0]
        rows = table[table.quantity == name].reset_index()
        some = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), 5)).round().astype(int))
        for i, shade in zip(some, plt.cm.viridis(np.linspace(0, 0.88, some.size))):
            fine = np.geomspace(min(error.width), rows["up to width"][i], 60)
            axes.plot(fine, np.abs(law(fine, rows.a[i], rows.b[i])), color=shade, linewidth=0.7)
            # Points that lie upon each other are rings within rings.
            size = 2.9 if over == "belt_speed" else 2.9 + 1.2 * (some.size - 1 - i)
            face = shade if over == "belt_speed" else "none"
            axes.plot(data.width, np.abs(data[i]), "osD^v"[i % 5], color=shade, markersize=size,
                      markerfacecolor=face, markeredgewidth=0.6, label=rows["at"][i])  # fmt: skip
        for goal in GOALS:
            axes.axhline(goal, color=GREY, linewidth=0.4, zorder=0)
        size = np.abs(data.values)
        least = np.min(size, where=size > 2e-7, initial=1.5)
        axes.set(xscale="log", yscale="log", ylim=(0.5 * least, 1.5))
        axes.set(xlabel=r"regularization width $\varepsilon$", ylabel=f"relative error of {name}")
    panels[0, 0].legend(loc="lower right")
    panels[1, 0].legend(loc="lower right")
    for name, (colour, marker) in LOOKS.items():
        rows = table[table.quantity == name]
        panels[1, 1].plot([], [], marker + "-", color=colour, markersize=3, label=name)
        for goal, dashes in zip(GOALS, ("-", "--", ":")):
            widths, look = (
                rows[f"width for {100 * goal:g} %"],
                {"color": colour, "markersize": 2.2},
            )
            panels[1, 1].plot(error.belt_speed, widths, marker + dashes, linewidth=0.8, **look)
        panels[1, 2].plot(error.belt_speed, rows["a expected"], color=colour, linewidth=0.8)
        panels[1, 2].plot(
            error.belt_speed, rows.a, marker, color=colour, markersize=3, label=f"{name}, fitted"
        )
    panels[1, 2].plot([], [], color="black", linewidth=0.8, label="expected")
    for goal, dashes in zip(GOALS, ("-", "--", ":")):
        panels[1, 1].plot([], [], dashes, color="black", linewidth=0.8, label=f"{100 * goal:g} %")
    panels[1, 1].set(yscale="log", ylabel=r"width $\varepsilon$ for an accuracy")
    panels[1, 1].set_ylim(top=60 * panels[1, 1].get_ylim()[1])
    panels[1, 2].set_ylabel(r"factor $a$ of $\varepsilon\,\ln(1/\varepsilon)$")
    for axes in panels[1, 1:]:
        axes.set_xlabel(SPEED)
        axes.legend(ncols=2 if axes is panels[1, 1] else 1)
    letters(panels)
    return page


if __name__ == "__main__":
    main()
