"""The branches behind the ladder of localized states: snakes, islands or a stack?

The cycles in which k neighbours of the paper's ring vibrate with locked phases, stable and
unstable, followed over the belt speed round all folds at four couplings: in phase, alternating,
and in the calmest pattern, whose phases keep together best; at the paper's coupling also the
branches that leave them where they lose their symmetry.

A branch ends where it closes, where it meets a branch of more symmetric cycles, beyond which it is
its own mirror image, at a Hopf point, where it fills the ring, or at the end of the range.  It is
named after Taylor and Dawes, Snaking and isolas of localised states in bistable discrete lattices
(2010): an isola is closed; along a snake the number of vibrating masses changes at folds; in a
stack each number has a branch of its own.

Prints for each branch its name, its symmetry and belt speeds, how many masses vibrate, where it is
stable, by how much its orbits fail to close when they are integrated ten times finer, how both
ways end, branches with the same folds, and its special points.  What has been followed is kept in
the folder of the results, where `ladder.py`, which draws it beside dry friction, finds it.  Three
to four hours on one core:

    python examples/studies/snaking.py
"""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from _common import kept, options

import jaxchain as jc
from jaxchain import localization
from jaxchain.cycles import cycle_symmetry, switch_cycle

FULL = {
    "n": 20, "width": 1e-3, "couplings": (1e-2, 3e-3, 2e-2, 1e-3), "counts": (1, 2, 3, 4, 5, 6),
    "more": (20,), "switched": (1, 2),  # at the first coupling; the branches that leave these
    "points": 8000,  # on each of the two ways of a branch
}  # fmt: skip
QUICK = FULL | {
    "n": 4, "width": 0.05, "couplings": (0.01,), "counts": (1, 2), "more": (), "switched": (),
    "points": 6,
}  # fmt: skip
START, RTOL, FINE_RTOL = 1.5, 1e-12, 1e-13
# How branches are followed; Ctrl-C ends the program, so that no part is kept as a whole branch.
HOW = {"bounds": (1.1, 1.9), "tolerance": 1e-10, "min_step": 1e-11, "keep_part": False}
ROUGHLY = {"rtol": 10 * RTOL, "tolerance": 1e-9, "min_step": 1e-8}  # past bends too sharp for that
FILLS = "fills the ring"
PATTERNS = ["in-phase", "alternating", "calmest"]


def locked(model, k):
    """The locked patterns of k neighbours that have names, each once."""
    n = model.chain.n
    waves = (localization.rotating_wave(model, turns) for turns in range(n // 2 + 1))
    every = (
        localization.locked_patterns(model, k) if k < n else sorted(waves, key=lambda p: p.growth)
    )
    orders = [pattern.order for pattern in every]
    index = {"in-phase": np.argmax(orders), "alternating": np.argmin(orders), "calmest": 0}
    first = {index[name]: name for name in reversed(PATTERNS)}
    return {"single" if k == 1 else first[i]: every[i] for i in sorted(first)}


def cycle_near(model, pattern):
    """The cycle of the whole ring near a locked pattern; it may not have converged."""
    n, k = model.chain.n, pattern.phases.size
    mass = int(localization.block_sites(n, k)[k // 2])
    state, period = localization.pattern_guess(model, pattern.phases, first=mass)
    how = {"images": pattern.images(n), "rtol": 1e-9, "throw": False}
    return jc.find_limit_cycle(model.chain, state, period=period, mass=mass, **how)


def own(branch):
    """The branch up to where it meets one of more symmetric cycles, beyond which it is its own
    mirror image or the other branch; `end` says how it ends."""
    last, end = branch.parameter.size - 1, f"{branch.ended} at {branch.parameter[-1]:.6f}"
    if FILLS in branch.message:
        end = end.replace(branch.ended, FILLS)
    if hopf := branch.of_kind("hopf"):
        end = f"Hopf point at {hopf[-1].parameter:.6f}"

    def more(parameter, state, period, **tolerance):
        at = branch.orbit.at(parameter)
        label = cycle_symmetry(at, tuple(state), period, **tolerance).label
        return label if label != branch.symmetry else None

    met = [(p.index, p.parameter, p.state, p.period) for p in branch.of_kind("branch point")]
    if branch.ended == "step_too_small":  # the equations are singular where branches meet
        met.append((last, branch.parameter[-1], [x[-1] for x in branch.state], branch.period[-1]))
    for index, *cycle in met:
        if label := more(*cycle, tolerance=1e-4):
            last, end = index, f"meets {label} at {cycle[0]:.6f}"
            break
    low, high = 0, last + 1  # the first cycle with more symmetry is in (low, high]
    while high - low > 1:
        i = last if high > last else (low + high) // 2
        if label := more(
            branch.parameter[i], (part[i] for part in branch.state), branch.period[i]
        ):
            high, end = i, f"meets {label} near {branch.parameter[i]:.6f}"
        else:
            low = i
    data = branch.to_dataset().isel(point=slice(high))
    return data.isel(special=data.special_index.values < high).assign_attrs(end=end)


def fills(speed, at):
    """Ends a branch where all masses vibrate: from there on nothing is localized."""
    return FILLS if np.all(jc.active(at.amplitude, speed)) else False


def leaving(branch, points):
    """By their names the branches that leave where the symmetry breaks."""
    for point in branch.of_kind("symmetry breaking"):
        for index, symmetry in enumerate(point.symmetries):
            for side in (1,) if symmetry.mirrored else (1, -1):
                name = f"{symmetry.label} from {point.parameter:.5f}" + " back" * (side < 0)
                how = {"symmetry": index, "side": side, "max_points": points, **HOW}
                try:
                    yield name, [own(switch_cycle(branch, point, **how))]
                except RuntimeError as error:
                    print(f"{name}: {error}", flush=True)


def follow(k, points, switched, **numbers):
    """By pattern the branches of k neighbours: towards greater and towards smaller belt speeds;
    and what leaves them, in one direction."""
    model, found = localization.phase_model(jc.paper_chain(belt_speed=START, **numbers)), {}
    for name, pattern in locked(model, k).items():
        cycle = cycle_near(model, pattern)
        print(f"k = {k}, {name}: {'' if cycle.successful else 'no '}cycle found", flush=True)
        if cycle.successful:
            more = {"images": cycle_symmetry(cycle), "rtol": RTOL, "max_points": points, **HOW}
            more["stop"] = fills if k < model.chain.n else None
            ways = [jc.continue_cycle(cycle, direction=way, **more) for way in (1, -1)]
            found[name] = [own(way) for way in ways]
            for i in (0, 1):
                if "step_too_small" in found[name][i].attrs["end"]:
                    more |= {"direction": (1, -1)[i], **ROUGHLY}
                    ways[i] = jc.continue_cycle(cycle, **more)
                    found[name][i] = own(ways[i])
            for way in ways if switched else ():
                found |= {f"{name}, {to}": branch for to, branch in leaving(way, points)}
    return found


def in_blocks(function, *arrays, size=64):
    """A function of arrays, point by point; in blocks of one size it compiles once."""
    count, pad = len(arrays[0]), -len(arrays[0]) % size
    arrays = [np.concatenate([array, np.repeat(array[-1:], pad, axis=0)]) for array in arrays]
    parts = [function(*(array[i : i + size] for array in arrays)) for i in range(0, count, size)]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0, 0, 0))
def closing_error(chain, speed, x, v, period):
    """By how much a cycle fails to close, in its greatest velocity, integrated ten times finer."""
    chain = chain.with_(belt_speed=speed)
    x1, v1 = jc.simulate(chain, (x, v), period, rtol=FINE_RTOL, throw=False).state
    return jnp.maximum(abs(x1 - x), abs(v1 - v)).max() / v.max()


def points_of(data):
    return [data[name].values for name in ("belt_speed", "displacement", "velocity", "period")]


def name_of(ways):
    """(the name of a branch, the numbers of vibrating masses at its folds)."""
    ends = " ".join(way.attrs["end"] for way in ways)
    counts = np.concatenate([way.special_active_count[way.special_kind == "fold"] for way in ways])
    counts = np.unique(counts[counts > 0].astype(int)).tolist()
    if "closed" in ends:
        return "isola", counts
    if len(counts) > 1:
        return "snake", counts
    lost = any(word in ends for word in ("max_points", "step_too_small", "failed", "stopped"))
    return ("not named" if lost else "stack"), counts


def branches_at(coupling, size, folder):
    """By (k, pattern) the branches with this coupling, from the folder if they are there."""
    numbers, first = {"n": size.n, "width": size.width, "coupling": coupling}, size.couplings[0]
    branches, more = {}, size.more if coupling == first else ()
    for k in (*size.counts, *more):
        switched = coupling == first and k in size.switched
        settings = {"k": k, "points": size.points, "switched": switched, **numbers}
        file = folder / f"{coupling:g}_{k}.pickle"
        found = kept(file, settings, partial(follow, **settings))
        branches |= {(k, pattern): ways for pattern, ways in found.items()}
    return jc.paper_chain(**numbers), branches


def folds_of(ways):
    return np.concatenate([way.special_parameter[way.special_kind == "fold"] for way in ways])


def describe(chain, branches):
    """A row for each branch."""
    rows, folds = [], {key: folds_of(ways) for key, ways in branches.items()}
    for (k, pattern), ways in branches.items():
        data = xr.concat([way.drop_dims("special") for way in ways], "point")
        errors = in_blocks(partial(closing_error, chain), *points_of(data))
        name, counts = name_of(ways)
        shared = [f"{other} {at}" for (other, at), found in folds.items()
                  if (other, at) != (k, pattern) and np.isclose(
                      found[:, None], folds[k, pattern], rtol=0, atol=1e-6).any()]  # fmt: skip
        special = sorted(zip(*(np.concatenate([way[f"special_{part}"] for way in ways])
                               for part in ("kind", "parameter"))))  # fmt: skip
        stable = np.sort(data.belt_speed.values[data.stable.values])
        rows.append({
            "coupling": float(chain.coupling), "k": k, "pattern": pattern,
            "name": "" if "," in pattern else name,  # what leaves a branch has none
            "vibrate at folds": counts, "symmetry": ways[0].attrs["symmetry"],
            "points": data.point.size, "from": data.belt_speed.values.min(),
            "to": data.belt_speed.values.max(),
            "stable": f"{stable[0]:.4f} ... {stable[-1]:.4f}" if stable.size else "nowhere",
            "closing error": float(np.max(errors)),
            "ends": ", ".join(way.attrs["end"] for way in ways), "shares folds": ", ".join(shared),
            "special points": ", ".join(f"{kind} {speed:.5f}" for kind, speed in special),
        })  # fmt: skip
    return pd.DataFrame(rows)


def main():
    """Computes and prints."""
    quick, folder = options(__file__, __doc__)
    size, tables = SimpleNamespace(**(QUICK if quick else FULL)), []
    for coupling in size.couplings:
        tables.append(describe(*branches_at(coupling, size, folder)))
        print(f"\n{tables[-1].to_string(index=False, float_format='%.6g')}", flush=True)
    pd.concat(tables).to_csv(folder / "branches.csv", index=False)


if __name__ == "__main__":
    main()
