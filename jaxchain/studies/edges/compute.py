"""The numbers of the study `edges`: edge states, and the cycles that they are compared with."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from jaxchain._types import State
from jaxchain.basins.edges import EdgeState, edge_state
from jaxchain.basins.single_mass import sliding_basin
from jaxchain.boundaries.grazing import nonsmooth_fold_belt_speed
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.cycles.limit_cycle import LimitCycle
from jaxchain.cycles.search import find_limit_cycle
from jaxchain.model.chain import Chain, steady_sliding
from jaxchain.model.initial_states import equation_8, excited_state, reference_site
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.section import Section
from jaxchain.result import code
from jaxchain.simulation.run import simulate
from jaxchain.studies._study import Job
from jaxchain.studies.edges.table import Ring, Study
from jaxchain.sweeps.programs import map_lanes

# In the ring the bracket is wider than usual: edges that beat are compared to three digits.
_NEAR, _FAR, _TOLERANCE = 1e-8, 1e-5, 1e-7
# A period and a little more.
_PERIOD = 7.0


def _code(edge: EdgeState) -> Any:
    """How it ended, an index into the names of `SearchResult`."""
    result: Any = edge.result
    return code(result)


def _numbers(edge: EdgeState) -> dict[str, Array]:
    """What is kept of an edge."""
    return {
        "amplitude": edge.amplitude, "period": edge.period, "gap": edge.gap,
        "bracket": edge.distance, "vibrates": edge.vibrates, "mass": edge.mass + 1,
        "record": edge.amplitudes, "outcome": _code(edge),
    }  # fmt: skip


def _lanes(job: Job, unit: str, function: Any, chain: Chain, columns: list[np.ndarray]) -> Any:
    """`function(chain, *row)` of every row, on all devices."""
    count = columns[0].size
    with job.bar(total=count, unit=unit) as bar:
        share = -(-count // len(jax.local_devices()))
        return map_lanes(function, chain, columns, lanes=share, done=bar.update)


def turning_point(chain: Any, state: State, rtol: float) -> Array:
    """The displacement of one mass at which it turns back, v = 0 and v' < 0."""
    return simulate(
        chain, state, 2.0 * _PERIOD, observe=Section(0, 1), rtol=rtol, throw=False
    ).observed[1][0, 0]


def one_mass(study: Study, job: Job) -> xr.Dataset:
    """The edge of one mass over the belt speed, and both cycles by Newton's method."""
    part, rtol = study.one_mass, study.rtol
    chain, speeds = study.base.chain(1, 1.5), np.array(part.belt_speed)

    def edge(chain: Chain, speed: Any) -> dict[str, Array]:
        own = chain.with_(belt_speed=speed)
        weak, strong = (excited_state(own, 1, amplitude=a) for a in (part.weak, part.strong))
        found = edge_state(own, weak, strong, time=part.time, rtol=rtol)
        sticking = find_limit_cycle(own, throw=False)
        good = jnp.where(sticking.successful, sticking.amplitude[0], jnp.nan)
        cut = turning_point(own, found.state, rtol)
        return {**_numbers(found), "cut": cut, "sticking": good}

    found = _lanes(job, "edge", edge, chain, [speeds])
    cycles = slip_cycles(chain, speeds)
    exact = {
        "exact": [float(cycle.amplitude[0]) for cycle in cycles],
        "exact_period": [float(cycle.period) for cycle in cycles],
        "multiplier": [float(jnp.real(cycle.multipliers[0])) for cycle in cycles],
        "exact_cut": [
            float(turning_point(cycle.chain, cycle.state, rtol)) if cycle.successful else np.nan
            for cycle in cycles
        ],
    }  # fmt: skip
    names = ("period", "gap", "bracket", "outcome", "cut", "sticking")
    data = xr.Dataset(
        {name: ("belt_speed", found[name]) for name in names}
        | {name: ("belt_speed", values) for name, values in exact.items()}
        | {"amplitude": ("belt_speed", found["amplitude"][:, 0])},
        coords={"belt_speed": speeds},
    )
    return data.assign(
        hopf=float(hopf_belt_speed(chain)), fold=float(nonsmooth_fold_belt_speed(chain))
    )


def slip_cycles(chain: Chain, speeds: np.ndarray) -> list[LimitCycle]:
    """The unstable cycle at each of these belt speeds, closed from where its basin has it."""
    found: list[LimitCycle] = []
    for speed in speeds:
        own = chain.with_(belt_speed=float(speed))
        basin = sliding_basin(own)
        # Without a cycle the search is left to say so.
        guess = (basin.state, basin.period) if np.isfinite(basin.period) else None
        found.append(find_limit_cycle(own, guess, branch="unstable", throw=False))
    return found


def pulled(chain: Chain, count: Any, ring: Ring, rtol: float) -> tuple[State, State]:
    """A ring in which `count` masses vibrate, settled, and the same with the next one pulled."""
    start = equation_8(chain, count)
    x, v = simulate(chain, start, ring.settling, rtol=rtol, throw=False).state
    next_one = (reference_site(chain.n) + count) % chain.n == jnp.arange(chain.n)
    sliding, still = steady_sliding(chain)
    more = jnp.where(next_one, sliding + ring.pull, x), jnp.where(next_one, still, v)
    return (x, v), more


def _edge_of_ring(chain: Chain, count: Any, ring: Ring, rtol: float) -> EdgeState:
    quiet, more = pulled(chain, count, ring, rtol)
    return edge_state(
        chain, quiet, more, time=ring.time, near=_NEAR, far=_FAR, tolerance=_TOLERANCE, rtol=rtol
    )


def ladder(study: Study, job: Job) -> xr.Dataset:
    """Edges between k and k + 1 vibrating masses, over k and the belt speed."""
    part, rtol = study.ladder, study.rtol
    chain = study.base.chain(part.masses, 1.5, coupling=study.base.coupling)
    speeds, counts = np.array(part.belt_speed), np.array(part.vibrating)

    def edge(chain: Chain, speed: Any, count: Any) -> dict[str, Array]:
        return _numbers(_edge_of_ring(chain.with_(belt_speed=speed), count, part, rtol))

    grid = np.meshgrid(speeds, counts, indexing="ij")
    found = _lanes(job, "edge", edge, chain, [axis.ravel() for axis in grid])
    dims = {
        "amplitude": ("oscillator",), "record": ("time", "oscillator"),
        "vibrates": ("side", "oscillator"),
    }  # fmt: skip
    over, shape = ("belt_speed", "vibrating"), (speeds.size, counts.size)
    windows = found["record"].shape[1]
    data = xr.Dataset(
        {
            name: ((*over, *dims.get(name, ())), own.reshape(*shape, *own.shape[1:]))
            for name, own in found.items()
        },
        coords={
            "belt_speed": speeds, "vibrating": counts, "side": ["below", "above"],
            "oscillator": np.arange(1, part.masses + 1),
            "time": part.time / windows * (1 + np.arange(windows)),
        },
    )  # fmt: skip
    alone = slip_cycles(study.base.chain(1, 1.5), speeds)
    data["single"] = "belt_speed", [float(cycle.amplitude[0]) for cycle in alone]
    return add_ranges(data)


def add_ranges(data: xr.Dataset) -> xr.Dataset:
    """With the amplitude of the mass in question: least, mean and greatest of the later half."""
    own = data["record"].sel(oscillator=data["mass"])
    known = own.notnull()
    later = own.where(known.cumsum("time") > known.sum("time") / 2)
    return data.assign(
        mass_record=own.drop_vars("oscillator"),
        least=later.min("time").drop_vars("oscillator"),
        mean=later.mean("time").drop_vars("oscillator"),
        greatest=later.max("time").drop_vars("oscillator"),
    )


def tracking(study: Study, job: Job) -> xr.Dataset:
    """How one edge is followed, and how both ends of the bracket leave it."""
    del job
    part, rtol = study.tracking, study.rtol
    chain = study.base.chain(part.masses, part.belt_speed, coupling=study.base.coupling)
    windows = round(part.leaving / _PERIOD)

    @jax.jit
    def follow(chain: Chain) -> tuple[EdgeState, Array]:
        found = _edge_of_ring(chain, part.vibrating, part, rtol)

        def leave(state: State) -> Array:
            return simulate(
                chain, state, windows * _PERIOD, observe=Amplitude(), segments=windows, rtol=rtol,
                throw=False,
            ).observed[:, found.mass]  # fmt: skip

        ends: Any = jax.tree.map(lambda *parts: jnp.stack(parts), found.below, found.above)
        return found, jax.vmap(leave)(ends)

    edge, left = follow(chain)
    return xr.Dataset(
        {
            "edge": ("time", np.asarray(edge.amplitudes[:, edge.mass])),
            "distance": ("time", np.asarray(edge.distances)),
            "leaving": (("side", "after"), np.asarray(left)),
            "outcome": int(_code(edge)), "mass": int(edge.mass) + 1,
            "bracket": float(edge.distance),
        },
        coords={
            "time": np.asarray(edge.times), "side": ["below", "above"],
            "after": _PERIOD * (1 + np.arange(windows)), "belt_speed": part.belt_speed,
            "vibrating": part.vibrating,
        },
    )  # fmt: skip
