"""Error against run time: which approach, which width and which tolerance?

One mass, a ring of twenty and one of a thousand, half of them excited, for thirty time units, as
one run and as 64 runs at once.  The error is the greatest of any displacement or velocity at the
end against true dry friction, so that of the width and that of the tolerance together: a user pays
for both.  The solvers of jaxchain and of diffrax, heyoka with events, LSODA, Radau (SciPy) and
CVODE with the compiled right side and Jacobian of the folder `benchmarks`, and Rodas4 written in C
for this one chain.  Heyoka, LSODA, Radau and CVODE need `pip install 'jaxchain[peers]'`, C needs a
compiler; what is missing is left out.  For a thousand masses those are left out that solve dense
systems, and heyoka compiles its loops as loops, because it would unroll them for minutes.

Prints the fastest setting for each error, and the fastest that smooths friction, with the time of
one run in ms, and what `simulate(accuracy=...)` gives (its accuracy stands for the
tolerance).  Some half an hour, alone on two cores:

    python examples/studies/work_precision.py
"""

import functools
import itertools
import math
import statistics
import sys
import time
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from _common import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILION, letters, options
from scipy.integrate import solve_ivp

from jaxchain import EventDriven, Rodas4, Rodas5P, equation_8, paper_chain, simulate
from jaxchain.plotting import save_figure

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
BELT_SPEED, DURATION = 1.3, 30.0
EXCITED = {1: 1, 20: 9, 1000: 450}  # by the number of masses
LANES, SPREAD = (1, 64), 0.1  # several lanes have belt speeds within this of `BELT_SPEED`
WIDTHS = [1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9]
RTOLS = [10.0**-k for k in range(3, 13)]
ACCURACIES = [10.0**-k for k in range(1, 7)]
PATIENCE = 1.0  # seconds; what is slower is left out
MOST_STEPS = 10**6  # of diffrax's solvers, whose steps may shrink to nothing
SATURATED = 0.95  # a tolerance that lowers the error by less meets that of the width
NAMES = ["event-driven", "Rodas5P", "Rodas4", "Rodas4 in C", "heyoka", "Tsit5", "Dopri8", "LSODA"]
NAMES += ["CVODE", "Radau", "Kvaerno3", "Kvaerno5", "KenCarp4"]
COLOURS = ["black", BLUE, SKY, SKY, GREY, ORANGE, ORANGE, PURPLE, PURPLE, VERMILION, *[GREEN] * 3]
LINES = ["-", "-", "-", ":", "--", "--", ":", "--", ":", "-.", "--", ":", "-."]
LOOKS = dict(zip(NAMES, zip(COLOURS, "osDDh^vPXd^v<", LINES)))
OWN, DRY = NAMES[:3], ("event-driven", "heyoka", "accuracy")  # jaxchain's; without a width
# Up to a hundred masses: those that solve dense systems.
MOST, FOR_FEW = 100, ("Radau", "Kvaerno3", "Kvaerno5", "KenCarp4")


def start(n, belt_speed, width):
    """The chain of one run and its initial state."""
    chain = paper_chain(n, belt_speed, width)
    return chain, equation_8(chain, EXCITED[n])


def over_lanes(run, speeds):
    """`run(belt_speed, *numbers)` for all belt speeds at once, compiled."""
    program = jax.jit(jax.vmap(run, in_axes=(0, None, None), out_axes=1))
    return lambda *numbers: jax.block_until_ready(program(jnp.asarray(speeds), *numbers))


def by_jaxchain(solver, n, speeds):
    def run(speed, width, rtol):
        options = {"solver": solver, "rtol": rtol, "throw": False}
        return jnp.stack(simulate(*start(n, speed, width), DURATION, **options).state)

    return over_lanes(run, speeds)


def by_diffrax(solver, n, speeds):
    """By diffrax alone, as one would without jaxchain."""
    terms = dfx.ODETerm(lambda t, y, chain: chain(t, y))
    if isinstance(solver, dfx.KenCarp4):  # stiff friction implicitly, the rest explicitly
        terms = dfx.MultiTerm(
            dfx.ODETerm(lambda t, y, chain: (y[1], chain.restoring_force(y[0]))),
            dfx.ODETerm(lambda t, y, chain: (0.0 * y[0], chain.local_force(t, *y))),
        )

    def run(speed, width, rtol):
        chain, initial = start(n, speed, width)
        controller = dfx.PIDController(rtol=rtol, atol=0.1 * rtol)
        ends = dfx.diffeqsolve(
            terms, solver, 0.0, DURATION, None, initial, chain, stepsize_controller=controller,
            adjoint=dfx.ForwardMode(), max_steps=MOST_STEPS, throw=False,
        ).ys  # fmt: skip
        return jnp.stack([y[0] for y in ends])

    return over_lanes(run, speeds)


def radau(ring, chain, initial, t1):
    """SciPy's Radau, whose loop is Python and whose linear algebra is dense."""
    start, p, matrix = ring.fold(initial), ring.parameters(chain), np.empty(2 * (2 * chain.n,))

    def jacobian(t, y, p):
        ring.full_jacobian_into(t, y, y, matrix, p)
        return matrix.copy()

    def run(rtol):
        options = {"args": (p,), "jac": jacobian, "rtol": rtol, "atol": 0.1 * rtol}
        return ring.unfold(solve_ivp(ring.force, (0.0, t1), start, "Radau", **options).y[:, -1])

    return run


def by_peer(name, n, speeds):
    """By heyoka in batches, or by LSODA, Radau, CVODE or C, one run after the other."""
    import peers  # of the folder `benchmarks`

    if name == "heyoka":
        import heyoka

        chain, batch = start(n, BELT_SPEED, None)[0], heyoka.recommended_simd_size()
        run = peers.heyoka(chain, speeds, EXCITED[n], DURATION, min(batch, len(speeds)))
        return lambda width, rtol: run(rtol)
    if name == "Rodas4 in C":
        from step_in_c import CompiledMethod

        def method(width):
            chains, states = zip(*[start(n, speed, width) for speed in speeds])
            own = CompiledMethod(chains, Rodas4(1), "-ffast-math")
            return lambda rtol: own.integrate(DURATION, rtol, *map(np.stack, zip(*states)))

        method = functools.cache(method)
        return lambda width, rtol: method(width)(rtol)
    ring = peers.CompiledRing(n)
    peer = {"LSODA": peers.lsoda, "CVODE": peers.cvode, "Radau": radau}[name]

    @functools.cache
    def runs(width):
        return [peer(ring, *start(n, speed, width), DURATION) for speed in speeds]

    runs(1e-3)  # raises at once if something is missing
    return lambda width, rtol: np.stack([run(rtol) for run in runs(width)], axis=1)


def approach(name, n, speeds):
    """A function (width, rtol) -> end states, shape (2, lanes, n)."""
    if name == "event-driven":
        series = {order: by_jaxchain(EventDriven(order), n, speeds) for order in (9, 15)}
        return lambda width, rtol: series[9 if rtol >= 1e-7 else 15](1e-3, rtol)
    if name in OWN:
        return by_jaxchain({"Rodas4": Rodas4(1), "Rodas5P": Rodas5P(1)}[name], n, speeds)
    if name in ("Rodas4 in C", "heyoka", "LSODA", "Radau", "CVODE"):
        return by_peer(name, n, speeds)
    if name != "accuracy":
        return by_diffrax(getattr(dfx, name)(), n, speeds)

    def run(speed, _, accuracy):
        chain, initial = start(n, speed, 1e-3)
        return jnp.stack(simulate(chain, initial, DURATION, accuracy=accuracy, throw=False).state)

    return over_lanes(run, speeds)


def timed(solve, *numbers):
    """What it returns, and the median seconds of up to five calls after the first."""
    result, seconds = solve(*numbers), []
    while len(seconds) < 5 and sum(seconds) < 0.3:
        begun = time.perf_counter()
        solve(*numbers)
        seconds.append(time.perf_counter() - begun)
    return result, statistics.median(seconds)


def scan(name, n, speeds, exact, widths, rtols):
    """Rows of one approach, from loose to tight and from wide to narrow.

    What is slower than `PATIENCE`, or no better than the row before, ends a series.  Of
    `simulate(accuracy=...)` the tolerance is the accuracy.
    """
    solve, slow = approach(name, n, speeds), 0.0
    for width in [math.nan] if name in DRY else widths:
        before = math.inf
        for rtol in rtols:
            if rtol <= slow:  # at a greater width it was too slow
                break
            state, seconds = timed(solve, width, rtol)
            error = float(np.max(np.abs(state - exact)))
            if math.isfinite(error):
                yield name, n, len(speeds), width, rtol, error, 1e3 * seconds / len(speeds)
            slow = rtol if seconds > PATIENCE else slow
            if slow == rtol or SATURATED * before < error < 0.5:
                break
            before = error


def winners(data):
    """For each case and error the fastest setting, of all and of those that smooth friction."""
    rows, fitting = [], data[data.approach.isin([*LOOKS])]
    every = fitting.groupby(["n", "lanes"]), 10.0 ** -np.arange(1, 9)
    for ((n, lanes), own), error in itertools.product(*every):
        row, fits = {"n": n, "lanes": lanes, "error": error}, own[own.error <= error]
        for kind, some in (("", fits), ("smoothed: ", fits[fits.width.notna()])):
            for best in some.nsmallest(1, "ms").itertuples():
                friction = "" if math.isnan(best.width) else f", width {best.width:.0e}"
                row[f"{kind}fastest"] = f"{best.approach}{friction}, rtol {best.rtol:.0e}"
                row[f"{kind}ms"] = best.ms
        rows.append(row)
    return pd.DataFrame(rows)


def draw(data):
    """Time of a run over the error: of each approach the settings that it does not beat itself."""
    sizes, counts = data.n.unique(), data.lanes.unique()
    size = (7.0, 1.3 + 2.1 * len(sizes))
    page, panels = plt.subplots(len(sizes), len(counts), figsize=size, sharey="row", squeeze=False)
    for axes, (n, lanes) in zip(panels.flat, itertools.product(sizes, counts)):
        own = data[(data.n == n) & (data.lanes == lanes)]
        for name, (colour, marker, line) in LOOKS.items():
            rows = own[own.approach == name].sort_values("ms")
            rows = rows[rows.error < rows.error.cummin().shift(fill_value=math.inf)]
            bold = name in OWN
            axes.plot(
                rows.error, rows.ms / 1e3, line, color=colour, marker=marker, label=name,
                markersize=4 if bold else 3, linewidth=1.4 if bold else 0.8, zorder=2 + bold,
                markerfacecolor=colour if bold else "white", markeredgewidth=0.8,
            )  # fmt: skip
        rows = own[own.approach == "accuracy"]
        axes.plot(rows.error, rows.ms / 1e3, "*", color=VERMILION, markersize=8, zorder=4,
                  markeredgecolor="white", markeredgewidth=0.5, label="accuracy = …")  # fmt: skip
        least = 1e-12 if data.error.min() < 1e-9 else 1e-9
        axes.set(xscale="log", yscale="log", xlim=(2.0, least))
        axes.grid(alpha=0.25, linewidth=0.5)
        axes.set_title(f"$N = {n}$, " + ("one run" if lanes == 1 else f"{lanes} runs at once"))
    letters(panels)
    for axes in panels[-1]:
        axes.set_xlabel(r"error at the end, $\max\,(|\delta\tilde x|, |\delta\tilde v|)$ (–)")
    for axes in panels[:, 0]:
        axes.set_ylabel("time of a run (s)")
    handles = panels[0, 0].get_legend_handles_labels()
    page.legend(*handles, loc="outside lower center", ncols=6, frameon=False)
    return page


def main():
    from timing import Skipped  # of the folder `benchmarks`

    quick, folder = options(__file__, __doc__)
    widths, rtols = ([1e-2, 1e-3], [1e-4, 1e-6]) if quick else (WIDTHS, RTOLS)
    names = ["event-driven", "Rodas4", "Rodas4 in C", "Tsit5", "LSODA"] if quick else NAMES
    rows = []
    for n, lanes in [(20, 1)] if quick else itertools.product(EXCITED, LANES):
        speeds = BELT_SPEED + (SPREAD * np.linspace(-1, 1, lanes) if lanes > 1 else np.zeros(1))
        exact = by_jaxchain(EventDriven(18), n, speeds)(1e-3, 1e-13)
        for name in names if n < MOST else [name for name in names if name not in FOR_FEW]:
            print(f"n = {n}, {lanes} lanes: {name}", flush=True)
            try:
                rows += scan(name, n, speeds, exact, widths, rtols)
            except (ImportError, Skipped) as missing:
                print(f"{name} is left out, {missing}: pip install 'jaxchain[peers]'")
        rows += scan("accuracy", n, speeds, exact, [], [1e-2, 1e-3] if quick else ACCURACIES)
    data = pd.DataFrame(rows, columns=["approach", "n", "lanes", "width", "rtol", "error", "ms"])
    data.to_csv(folder / "work_precision.csv", index=False)
    pd.options.display.float_format = "{:.3g}".format
    print(winners(data).to_string(index=False, na_rep="none"))
    print(data[data.approach == "accuracy"].to_string(index=False))
    save_figure(draw(data), folder / "work_precision")


if __name__ == "__main__":
    main()
