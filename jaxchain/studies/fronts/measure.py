"""The numbers of the study `fronts`."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.localization.front_theory import spreading_speed
from jaxchain.model.chain import Chain
from jaxchain.model.friction import ExponentialDecay, TanhFriction
from jaxchain.model.sliding import growth_rate
from jaxchain.observers.amplitude import Amplitude
from jaxchain.result import NAMES, STOPPED_WELL
from jaxchain.scenes.tables import Range
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.studies.fronts.prediction import predicted
from jaxchain.studies.fronts.runs import (
    PATTERNS,
    BlockStart,
    averaged,
    exponents,
    follow,
    follow_jobs,
)
from jaxchain.studies.fronts.table import Study

# Sliding beyond the width of the friction law: dry friction, for what takes it from the chain.
_WIDTH = 1e-3
# Masses that a front passes before it is taken to have settled, and the share of the run at most.
_PASSED, _SHARE = 2.0, 0.2
_CURVE = 41


def base_chain(study: Study, n: int, width: float = _WIDTH) -> Chain:
    """The ring, or one mass alone."""
    base = study.base
    friction = TanhFriction(ExponentialDecay(base.mu_static, base.mu_dynamic, base.v_ref), width)
    return Chain(n, friction, 1.5, base.damping_ratio, None if n == 1 else base.coupling)


def transients(chain: Chain, speeds: Any, couplings: Any, time: float) -> np.ndarray:
    """How long fronts are left to settle: what `_PASSED` masses take at the greatest speed."""
    growth = jax.vmap(lambda speed: growth_rate(chain, speed))(jnp.asarray(speeds, float))
    fastest = spreading_speed(jnp.asarray(couplings, float), jnp.maximum(growth, 0.0))
    return np.minimum(np.asarray(_PASSED / fastest), _SHARE * time)


def pictures(study: Study) -> xr.Dataset:
    """Amplitude over mass and time of blocks that grow, stand and shrink."""
    part = study.pictures
    chain = base_chain(study, part.masses)

    @jax.jit
    @jax.vmap
    def watch(speed: jax.Array) -> jax.Array:
        own = chain.with_(belt_speed=speed)
        start = BlockStart(part.block)(own, 0, False)
        return simulate(
            own, start, part.time, observe=Amplitude(), segments=part.windows, rtol=study.rtol,
            solver=EventDriven(), throw=False,
        ).observed  # fmt: skip

    amplitude = np.asarray(watch(jnp.asarray(part.belt_speed)))
    times = (np.arange(part.windows) + 0.5) * part.time / part.windows
    data = xr.Dataset(
        {"amplitude": (("belt_speed", "time", "oscillator"), amplitude)},
        coords={
            "belt_speed": part.belt_speed, "time": times,
            "oscillator": np.arange(1, part.masses + 1),
        },
    )  # fmt: skip
    data["amplitude"].attrs = {"long_name": "half peak-to-peak of displacement", "units": "x0"}
    return data


def over_belt_speed(study: Study, progress: bool) -> xr.Dataset:
    """Speeds of fronts over the belt speed, and that of linear spreading."""
    part = study.speed
    given = part.belt_speed
    speeds = given.array() if isinstance(given, Range) else np.asarray(given)
    chain = base_chain(study, part.masses)
    lanes = len(PATTERNS) * part.seeds
    waits = np.repeat(transients(chain, speeds, np.full(speeds.size, study.base.coupling),
                                 part.time), lanes)  # fmt: skip
    over = {"belt_speed": speeds, "pattern": list(PATTERNS), "seed": np.arange(part.seeds)}
    data = follow(
        chain, part.block, part.time, over, transient=waits, rtol=study.rtol, progress=progress,
        description="belt speed",
    )  # fmt: skip
    mean = averaged(data, ("pattern", "seed"))
    data["mean_speed"], data["mean_error"] = mean["speed"], mean["error"]
    growth = jax.vmap(lambda speed: growth_rate(chain, speed))
    curve = np.linspace(speeds.min(), float(hopf_belt_speed(chain)), _CURVE)
    spread = spreading_speed(
        jnp.full(_CURVE, study.base.coupling), jnp.maximum(growth(jnp.asarray(curve)), 0.0)
    )
    data["spreading"] = ("curve", np.asarray(spread))
    return data.assign_coords(curve=curve)


def over_coupling(study: Study, progress: bool) -> xr.Dataset:
    """Speeds over the coupling, exponents, and linear spreading below the Hopf speed."""
    part = study.coupling
    chain = base_chain(study, part.masses)
    speeds = np.asarray(part.belt_speed)
    parts = []
    for coupling in part.coupling:
        time = float(np.clip(part.per_coupling / coupling, 400.0, part.time))
        over = {"belt_speed": speeds, "coupling": [coupling], "pattern": list(PATTERNS)}
        waits = transients(chain, speeds, np.full(speeds.size, coupling), time)
        over["seed"] = [0]
        parts.append(
            follow(
                chain,
                part.block,
                time,
                over,
                transient=np.repeat(waits, len(PATTERNS)),
                rtol=study.rtol,
                progress=progress,
                description=f"coupling {coupling:g}",
            )
        )
    data: xr.Dataset = xr.concat(parts, "coupling").isel(seed=0)  # pyright: ignore
    mean = averaged(data, ("pattern",))
    data["mean_speed"], data["mean_error"] = mean["speed"], mean["error"]
    rows = [
        exponents(data["coupling"].values, *(mean[k].sel(belt_speed=v).values
                                             for k in ("speed", "error")))
        for v in speeds
    ]  # fmt: skip
    for name, column in zip(
        ("exponent", "exponent_error", "points"), zip(*rows, strict=True), strict=True
    ):
        data[name] = ("belt_speed", np.asarray(column))
    curve = np.geomspace(min(part.coupling), max(part.coupling), _CURVE)
    growth = np.array([float(growth_rate(chain, jnp.asarray(v))) for v in speeds])
    spread = [spreading_speed(jnp.asarray(curve), jnp.full(_CURVE, g)) for g in growth]
    data["spreading"] = (("belt_speed", "curve"), np.asarray(spread))
    return data.assign_coords(curve=curve)


def pinning(study: Study, progress: bool) -> xr.Dataset:
    """Where fronts come unstuck, over the coupling, and what is predicted.

    `stands` and `moves` (coupling, edge, pattern) enclose it: a front moves if it gains or loses a
    mass between a fifth of the time and its end.
    """
    part = study.pinning
    chain = base_chain(study, part.masses)
    couplings, edges = np.asarray(part.coupling), np.array([part.lowest, part.highest])
    names = np.meshgrid(couplings, edges, np.array(PATTERNS), indexing="ij")
    coupling, end, pattern = (a.ravel() for a in names)
    jobs = {"coupling": coupling, "pattern": pattern, "seed": np.zeros(coupling.size, int)}
    run = partial(
        follow_jobs, chain, part.block, part.time, transient=_SHARE * part.time, rtol=study.rtol,
        progress=progress,
    )  # fmt: skip

    well = np.full(coupling.size, True)

    def moved(speeds: np.ndarray, description: str) -> np.ndarray:
        found = run(jobs={**jobs, "belt_speed": speeds}, description=description)
        well[~np.isin(found["result"], [NAMES.index(name) for name in STOPPED_WELL])] = False
        # Fronts that met before their speed could be measured have moved.
        return (np.abs(found["moved"]) >= 1.0) | np.isnan(found["speed"])

    stands, moves = np.full(coupling.size, part.stands), end
    known = ~moved(stands, "pinned")
    known &= moved(moves, "moving")
    for index in range(part.halvings):
        middle = 0.5 * (stands + moves)
        went = moved(middle, f"halving {index + 1}/{part.halvings}")
        stands, moves = np.where(went, stands, middle), np.where(went, middle, moves)
    known &= well
    dims, shape = ("coupling", "edge", "pattern"), names[0].shape
    data = xr.Dataset(
        {
            name: (dims, np.where(known, values, np.nan).reshape(shape))
            for name, values in (("stands", stands), ("moves", moves))
        },
        coords={"coupling": couplings, "edge": ["grows", "shrinks"], "pattern": list(PATTERNS)},
    )
    return data.merge(predicted(base_chain(study, 1), part.highest))


def convergence(study: Study, progress: bool) -> xr.Dataset:
    """The same speeds on other rings and with smoothed friction: dimension `case`."""
    part = study.convergence
    speeds = np.asarray(part.belt_speed)
    cases = [(part.masses, 0.0)] + [(n, 0.0) for n in part.other_masses]
    cases += [(part.masses, width) for width in part.width]
    waits = transients(
        base_chain(study, 1), speeds, np.full(speeds.size, study.base.coupling), part.time
    )
    over = {"belt_speed": speeds, "pattern": list(PATTERNS), "seed": [0]}
    parts = []
    for n, width in cases:
        parts.append(
            follow(
                base_chain(study, n, width or _WIDTH),
                round(part.block * n / part.masses),
                part.time,
                over,
                transient=np.repeat(waits, len(PATTERNS)),
                rtol=study.rtol,
                dry=width == 0.0,
                progress=progress,
                description=f"{n} masses, width {width:g}",
            )
        )
    data: xr.Dataset = xr.concat(parts, "case").isel(seed=0)  # pyright: ignore
    mean = averaged(data, ("pattern",))
    data["mean_speed"], data["mean_error"] = mean["speed"], mean["error"]
    return data.assign_coords(
        masses=("case", [n for n, _ in cases]), width=("case", [w for _, w in cases])
    )
