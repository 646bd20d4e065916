"""The branches behind the ladder of localized states: one snaking branch, or islands?

The cycles in which k neighbours of the paper's ring vibrate with locked phases, stable and
unstable, followed over the belt speed round all folds: in phase, alternating, and in the calmest
pattern, whose phases keep together best; and the branches that leave them where they lose their
symmetry.  Upon them runs of true dry friction from eq. (8), as in Fig. 3(b) of the paper; and
between which belt speeds the calmest patterns are stable, over the coupling.

A branch ends where it closes, where it meets a branch of more symmetric cycles, beyond which it is
its own mirror image, or at the end of the range.

Prints for each branch its symmetry and belt speeds, where it is stable, by how much its orbits
fail to close when they are integrated ten times finer, how both ways end, and its special points;
what true dry friction makes of stable cycles drawn by lot; and the ends of stability over the
coupling.  Some twenty minutes on two cores:

    python examples/studies/ladder.py
"""

from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from _common import BLUE, COUPLING, GREEN, GREY, PURPLE, SPEED, VERMILION, letters, options

import jaxchain as jc
from jaxchain import localization
from jaxchain.cycles import cycle_symmetry, switch_cycle
from jaxchain.plotting import plot_branch, save_figure

FULL = {
    "n": 20, "coupling": 0.01, "width": 1e-3,
    "counts": (1, 2, 3, 20, 4, 5, 6), "points": 1500,  # on each of the two ways of a branch
    "switched": (1, 2),  # of these the branches that leave where a symmetry breaks, too
    "speeds": np.arange(1.05, 1.86, 0.05), "transient": 1400.0,  # of the runs from eq. (8)
    "dry": 6, "dry_time": 2000.0,  # runs of dry friction from stable cycles
    # Tails of a localized vibration do not reach round a ring of ten.
    "couplings": (1e-3, 3e-3, 1e-2, 3e-2, 1e-1), "coupled": (1, 2, 3, 4), "coupled_n": 10,
    "coupled_points": 100,
}  # fmt: skip
QUICK = FULL | {
    "n": 4, "width": 0.05, "counts": (1, 2), "points": 6, "switched": (), "speeds": (1.4, 1.5),
    "transient": 50.0, "dry": 1, "dry_time": 150.0,
    "couplings": (0.01,), "coupled": (1,), "coupled_n": 4, "coupled_points": 4,
}  # fmt: skip
START, WINDOW, RTOL, FINE_RTOL = 1.5, 100.0, 1e-11, 1e-12
HOW = {"bounds": (1.1, 1.9), "tolerance": 1e-9, "min_step": 1e-8}  # branches are followed
PATTERNS = {"in-phase": BLUE, "alternating": "black", "calmest": GREEN}
LOSSES = ("fold", "symmetry breaking", "branch point", "period doubling", "torus")


def locked(model, k, names):
    """The locked patterns of k neighbours that go by these names, each once."""
    n = model.chain.n
    waves = (localization.rotating_wave(model, turns) for turns in range(n // 2 + 1))
    every = (
        localization.locked_patterns(model, k) if k < n else sorted(waves, key=lambda p: p.growth)
    )
    orders = [pattern.order for pattern in every]
    index = {"in-phase": np.argmax(orders), "alternating": np.argmin(orders), "calmest": 0}
    first = {index[name]: name for name in reversed(names)}
    return {"single" if k == 1 else first[i]: every[i] for i in sorted(first)}


def cycle_near(model, pattern):
    """The cycle of the whole ring near a locked pattern; it may not have converged."""
    n, k = model.chain.n, pattern.phases.size
    mass = int(localization.block_sites(n, k)[k // 2])
    state, period = localization.pattern_guess(model, pattern.phases, first=mass)
    return jc.find_limit_cycle(
        model.chain, state, period=period, mass=mass, images=pattern.images(n), rtol=1e-9,
        throw=False,
    )  # fmt: skip


def follow(cycle, points, **more):
    """The branch through a cycle, towards greater and towards smaller belt speeds."""
    more |= {"images": cycle_symmetry(cycle), "rtol": RTOL, "max_points": points, **HOW}
    return [jc.continue_cycle(cycle, direction=way, **more) for way in (1, -1)]


def symmetry_at(branch, parameter, state, period, **tolerance):
    """The label of the symmetry of a cycle of the branch."""
    return cycle_symmetry(branch.shooting.at(parameter), state, period, **tolerance).label


def own(branch):
    """(the branch up to where it meets one of more symmetric cycles, how it ends).

    Beyond such a point it is its own mirror image, or the other branch.
    """
    last, end = branch.parameter.size - 1, f"{branch.ended} at {branch.parameter[-1]:.6f}"
    if hopf := branch.of_kind("hopf"):
        end = f"Hopf point at {hopf[-1].parameter:.6f}"
    for p in branch.of_kind("branch point"):
        more = symmetry_at(branch, p.parameter, p.state, p.period, tolerance=1e-4)
        if more != branch.symmetry:
            last, end = p.index, f"meets {more} at {p.parameter:.6f}"
            break
    low, high = 0, last + 1  # the first cycle with more symmetry is in (low, high]
    while high - low > 1:
        i = last if high > last else (low + high) // 2
        state = tuple(part[i] for part in branch.state)
        more = symmetry_at(branch, branch.parameter[i], state, branch.period[i])
        if more == branch.symmetry:
            low = i
        else:
            high, end = i, f"meets {more} near {branch.parameter[i]:.6f}"
    names = ("parameter", "period", "amplitude", "scaled_peak_velocity", "multipliers",
             "trivial_defect")  # fmt: skip
    cut = {name: getattr(branch, name)[:high] for name in names}
    cut["state"] = tuple(part[:high] for part in branch.state)
    return replace(branch, **cut, special=tuple(p for p in branch.special if p.index < high)), end


def leaving(branch, points):
    """The branches that leave where the symmetry breaks, by their names."""
    for point in branch.of_kind("symmetry breaking"):
        for index, symmetry in enumerate(point.symmetries):
            for side in (1,) if symmetry.mirrored else (1, -1):
                name = f"{symmetry.label} from {point.parameter:.5f}" + " back" * (side < 0)
                how = {"symmetry": index, "side": side, "max_points": points, **HOW}
                try:
                    yield name, own(switch_cycle(branch, point, **how))
                except RuntimeError as error:
                    print(f"{name}: {error}", flush=True)


def all_branches(chain, s):
    """By (k, pattern) both ways of a branch, or the one way of what crosses it; and the ends."""
    model, branches, ends = localization.phase_model(chain), {}, {}
    for k in s.counts:
        for name, pattern in locked(model, k, [*PATTERNS]).items():
            cycle = cycle_near(model, pattern)
            print(f"k = {k}, {name}: {'' if cycle.successful else 'no '}cycle found", flush=True)
            if cycle.successful:
                ways = [own(way) for way in follow(cycle, s.points)]
                every = {name: ways}
                for way, _ in ways if k in s.switched else ():
                    every |= {f"{name}, {to}": [found] for to, found in leaving(way, s.points)}
                for to, ways in every.items():
                    branches[k, to] = [way for way, _ in ways]
                    ends[k, to] = ", ".join(end for _, end in ways)
    return branches, ends


def points_of(branches):
    """All points of each branch, from the end of the way down to the end of the way up."""
    names = ("parameter", "x", "v", "period", "energy", "unstable", "amplitude")
    return {
        key: {name: np.concatenate([*(getattr(way, name)[:0:-1] for way in down),
                                    getattr(up, name)]) for name in names}
        for key, (up, *down) in branches.items()
    }  # fmt: skip


@eqx.filter_jit
def closing_error(chain, x, v, period):
    """The residual of the shooting equations, integrated ten times finer."""
    x1, v1 = jc.simulate(chain, (x, v), period, rtol=FINE_RTOL, throw=False).state
    layer = jnp.hypot(v - chain.belt_speed, chain.width)
    return jnp.max(jnp.maximum(abs(x1 - x), abs(v1 - v) / layer)) / jnp.max(v)


def describe(chain, branches, ends, points):
    """A row for each branch; it is stable where no multiplier is beyond the unit circle."""
    for (k, name), ways in branches.items():
        speeds, x, v, period, _, unstable, amplitude = points[k, name].values()
        vibrate = jc.active(amplitude, speeds).sum(axis=1)
        errors = [closing_error(chain.with_(belt_speed=jnp.asarray(speed)), *orbit)
                  for speed, *orbit in zip(speeds, x, v, period)]  # fmt: skip
        edges = np.flatnonzero(np.diff([0, *(unstable == 0), 0])).reshape(-1, 2)
        stable = [np.sort(speeds[a:b])[[0, -1]] for a, b in edges]
        special = sorted((p.kind, p.parameter) for way in ways for p in way.special)
        yield {
            "k": k, "pattern": name, "symmetry": ways[0].symmetry, "points": speeds.size,
            "from": min(speeds), "to": max(speeds),
            "vibrate": ", ".join(map(str, np.unique(vibrate))),
            "stable at": ", ".join(f"{low:.4f} ... {high:.4f}" for low, high in stable),
            "closing error": float(max(errors)), "ends": ends[k, name],
            "special points": ", ".join(f"{kind} {speed:.5f}" for kind, speed in special),
        }  # fmt: skip


def dry_runs(chain, points, s):
    """Runs with dry friction from stable cycles, chosen at random."""
    watch = (jc.Amplitude(window=WINDOW),
             jc.PeakTimes(capacity=24, start=s.dry_time - WINDOW))  # fmt: skip
    every = [(key, i) for key, own in points.items() for i in np.flatnonzero(own["unstable"] == 0)]
    for pick in np.sort(np.random.default_rng(11).permutation(len(every))[: s.dry]):
        (k, name), i = every[pick]
        p = {part: values[i] for part, values in points[k, name].items()}
        own = chain.with_(width=None, belt_speed=float(p["parameter"]))
        run = jc.simulate(own, (p["x"], p["v"]), s.dry_time, observe=watch, rtol=1e-8)
        amplitude, times = run.observed
        gaps = np.diff(times[:, jc.active(amplitude, own.belt_speed)], axis=0)
        gaps = gaps[np.isfinite(gaps)]
        yield {"k": k, "pattern": name, "belt speed": p["parameter"],
               "E dry / smoothed": float(jc.energy(amplitude)) / p["energy"],
               "T dry / smoothed": np.mean(gaps) / p["period"] if gaps.size else np.nan,
               "spread of T": np.ptp(gaps) if gaps.size else np.nan}  # fmt: skip


def stable_ends(s):
    """Between which belt speeds the calmest cycles are stable, over the coupling."""
    for coupling in s.couplings:
        chain = jc.paper_chain(s.coupled_n, START, s.width, coupling=coupling)
        model = localization.phase_model(chain)
        for k in s.coupled:
            ((_, pattern),) = locked(model, k, ["calmest"]).items()
            cycle = cycle_near(model, pattern)
            row = {"coupling": coupling, "k": k, "phases alone": pattern.growth}
            if cycle.successful:
                row["grows as"] = float(np.log(abs(cycle.multipliers[0])) / cycle.period)
            if cycle.successful and cycle.stable:
                lost = lambda p, at: abs(at.multipliers[0]) > 1.0 + 1e-7  # noqa: E731
                ways = follow(cycle, s.coupled_points, stop=lost)
                for end, way in zip(("upper", "lower"), ways):
                    at = way.parameter[-1] if way.ended in ("stopped", "left_bounds") else np.nan
                    row |= {end: at, f"{end} end": way.ended}
                    for p in way.special[::-1] if way.ended == "stopped" else ():
                        if p.index >= way.parameter.size - 2 and p.kind in LOSSES:
                            row |= {end: p.parameter, f"{end} end": p.kind}
            yield row


def draw(branches, runs, ends):
    """(a) All branches and the runs, (b) the lowest rungs, (c) ends of stability."""
    page, panels = plt.subplot_mosaic("AA;BC", figsize=(7.0, 6.2), height_ratios=(1.1, 1.0))
    whole, zoom, limits = panels.values()
    low = {key: ways for key, ways in branches.items() if key[0] <= 3}
    for axes, some, size in ((whole, branches, 3.0), (zoom, low, 6.0)):
        for (_, name), ways in some.items():
            for way in ways:
                data = way.to_dataset()
                if axes is whole:
                    data = data.isel(special=data.special_kind.values == "fold")
                plot_branch(
                    data, "energy", ax=axes, color=PATTERNS.get(name.split(",")[0], "black")
                )
        for line in axes.lines:
            line.set(markersize=0.8 * size, linewidth=0.9)
        top = axes.get_ylim()[1]
        for speed in runs.belt_speed.values:
            energies = runs.energy.sel(belt_speed=speed)
            axes.scatter(np.full(energies.size, speed), energies, s=size, color=GREY, zorder=1)
        axes.set(xlabel=SPEED, ylabel=r"vibration energy $\tilde E$ (–)")
        axes.set_ylim(0.0, None if axes is whole else top)
        axes.get_legend().remove()
    colours = BLUE, VERMILION, GREEN, PURPLE, GREY
    for colour, (k, rows) in zip(colours, ends.groupby("k")):
        for end, marker in (("upper", "v-"), ("lower", "^--")):
            look = {"color": colour, "markersize": 3.5, "label": f"$k = {k}$, {end} end"}
            limits.plot(rows.coupling, rows[end], marker, **look)
    limits.set(xscale="log", xlabel=COUPLING, ylabel="belt speed, ends of stability")
    limits.legend()
    letters([*panels.values()])
    handles = dict(zip(*zoom.get_legend_handles_labels()[::-1]))
    handles |= {name: plt.Line2D([], [], color=colour) for name, colour in PATTERNS.items()}
    handles["runs, dry friction"] = plt.Line2D([], [], color=GREY, marker=".", linestyle="")
    page.legend(handles.values(), handles, loc="outside lower center", ncols=4, frameon=False)
    return page


def main():
    quick, folder = options(__file__, __doc__)
    s = SimpleNamespace(**(QUICK if quick else FULL))
    chain = jc.paper_chain(s.n, START, s.width, coupling=s.coupling)
    branches, ways_end = all_branches(chain, s)
    points = points_of(branches)
    runs = jc.sweep(
        chain.with_(width=None), jc.equation_8, s.transient + WINDOW,
        over={"belt_speed": s.speeds, "excited": np.arange(s.n + 1)},
        observe=jc.Amplitude(window=WINDOW), store=folder / "ensemble.zarr", progress=True,
    )  # fmt: skip
    tables = {
        "branches": describe(chain, branches, ways_end, points),
        "dry": dry_runs(chain, points, s), "couplings": stable_ends(s),
    }  # fmt: skip
    for name, rows in tables.items():
        tables[name] = pd.DataFrame(rows)
        tables[name].to_csv(folder / f"{name}.csv", index=False)
        print(f"\n{name}\n{tables[name].to_string(index=False, float_format='%.6g')}", flush=True)
    save_figure(draw(branches, runs, tables["couplings"]), folder / "ladder")


if __name__ == "__main__":
    main()
