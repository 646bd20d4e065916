"""The numbers of the study `fronts`: measured with true dry friction, and predicted."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from jaxchain.boundaries.grazing import nonsmooth_fold_belt_speed
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.localization.front_theory import (
    death_belt_speed,
    growth_coupling,
    single_cycle,
    spreading_speed,
)
from jaxchain.model.chain import Chain
from jaxchain.model.sliding import growth_rate
from jaxchain.observers.amplitude import Amplitude
from jaxchain.result import NAMES, STOPPED_WELL
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.studies._study import Job
from jaxchain.studies._tables import array
from jaxchain.studies.fronts.runs import PATTERNS, BlockStart, add_mean, exponents, follow, joined
from jaxchain.studies.fronts.table import Study

# Sliding beyond the width of the friction law: dry friction, for what takes it from the chain.
_WIDTH = 1e-3
# Masses that a front passes before it is taken to have settled, and the share of the run at most.
_PASSED, _SHARE = 2.0, 0.2
_CURVE = 41
_BOTH = ("pattern", "seed")


def base_chain(study: Study, n: int, width: float = _WIDTH) -> Chain:
    """The ring, or one mass alone."""
    coupling = None if n == 1 else study.base.coupling
    return study.base.chain(n, 1.5, width=width, coupling=coupling)


def spreading(chain: Chain, speeds: Any, coupling: Any) -> np.ndarray:
    """Speed of linear spreading at belt speeds and couplings of one shape."""
    growth = jax.vmap(partial(growth_rate, chain))(jnp.asarray(speeds, float))
    couplings = jnp.broadcast_to(jnp.asarray(coupling, float), growth.shape)
    return np.asarray(spreading_speed(couplings, jnp.maximum(growth, 0.0)))


def transients(chain: Chain, speeds: np.ndarray, coupling: float, time: float) -> xr.DataArray:
    """How long fronts are left to settle: what `_PASSED` masses take at the greatest speed."""
    waits = np.minimum(_PASSED / spreading(chain, speeds, coupling), _SHARE * time)
    return xr.DataArray(waits, {"belt_speed": speeds}, "belt_speed")


def pictures(study: Study, job: Job) -> xr.Dataset:
    """Amplitude over mass and time of blocks that grow, stand and shrink."""
    del job
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
    return xr.Dataset(
        {"amplitude": (("belt_speed", "time", "oscillator"), amplitude)},
        coords={
            "belt_speed": part.belt_speed,
            "time": (np.arange(part.windows) + 0.5) * part.time / part.windows,
            "oscillator": np.arange(1, part.masses + 1),
        },
    )


def over_belt_speed(study: Study, job: Job) -> xr.Dataset:
    """Speeds of fronts over the belt speed, and that of linear spreading."""
    part, coupling = study.speed, study.base.coupling
    speeds = array(part.belt_speed)
    chain = base_chain(study, part.masses)
    data = follow(
        chain, part.block, part.time, {"belt_speed": speeds}, seeds=part.seeds, rtol=study.rtol,
        transient=transients(chain, speeds, coupling, part.time), progress=job.progress,
        description="belt speed",
    )  # fmt: skip
    curve = np.linspace(speeds.min(), float(hopf_belt_speed(chain)), _CURVE)
    data["spreading"] = ("curve", spreading(chain, curve, coupling))
    return add_mean(data, _BOTH).assign_coords(curve=curve)


def over_coupling(study: Study, job: Job) -> xr.Dataset:
    """Speeds over the coupling, exponents, and linear spreading below the Hopf speed."""
    part = study.coupling
    chain = base_chain(study, part.masses)
    speeds = np.asarray(part.belt_speed)
    parts = []
    for coupling in part.coupling:
        time = float(np.clip(part.per_coupling / coupling, 400.0, part.time))
        parts.append(
            follow(
                chain, part.block, time, {"belt_speed": speeds, "coupling": [coupling]},
                transient=transients(chain, speeds, coupling, time), rtol=study.rtol,
                progress=job.progress, description=f"coupling {coupling:g}",
            )
        )  # fmt: skip
    data = add_mean(joined(parts, "coupling"), ("pattern",))
    rows = [
        exponents(
            data["coupling"].values,
            *(data[name].sel(belt_speed=v).values for name in ("mean_speed", "mean_error")),
        )
        for v in speeds
    ]
    for index, name in enumerate(("exponent", "exponent_error", "points")):
        data[name] = ("belt_speed", np.array(rows)[:, index])
    curve = np.geomspace(min(part.coupling), max(part.coupling), _CURVE)
    growth = np.array([float(growth_rate(chain, jnp.asarray(v))) for v in speeds])
    spread = [spreading_speed(jnp.asarray(curve), jnp.full(_CURVE, g)) for g in growth]
    data["spreading"] = (("belt_speed", "curve"), np.asarray(spread))
    return data.assign_coords(curve=curve)


class _Places(eqx.Module):
    """A belt speed of its own for each coupling, edge and pattern."""

    coupling: Array
    belt_speed: Array

    def __call__(self, chain: Chain, place: Array, edge: Array, in_phase: Array) -> Chain:
        speed = self.belt_speed[place, edge, in_phase]
        return chain.with_(coupling=self.coupling[place], belt_speed=speed)


def pinning(study: Study, job: Job) -> xr.Dataset:
    """Where fronts come unstuck, over the coupling, and what is predicted.

    `stands` and `moves` (coupling, edge, pattern) enclose it: a front moves if it gains or loses a
    mass between a fifth of the time and its end.
    """
    part = study.pinning
    chain, couplings = base_chain(study, part.masses), np.asarray(part.coupling)
    dims, shape = ("coupling", "edge", "pattern"), (couplings.size, 2, 2)
    known = np.full(shape, True)

    def moved(speeds: np.ndarray, description: str) -> np.ndarray:
        nonlocal known
        found = follow(
            chain, part.block, part.time, {"place": range(couplings.size), "edge": [0, 1]},
            vary=_Places(jnp.asarray(couplings), jnp.asarray(speeds)), rtol=study.rtol,
            transient=_SHARE * part.time, progress=job.progress, description=description,
        ).isel(seed=0)  # fmt: skip
        known &= np.isin(found["result"], [NAMES.index(name) for name in STOPPED_WELL])
        # Fronts that met before their speed could be measured have moved.
        return (np.abs(found["moved"].values) >= 1.0) | np.isnan(found["speed"].values)

    stands = np.full(shape, part.stands)
    moves = np.zeros(shape) + np.array([part.lowest, part.highest])[:, None]
    known &= ~moved(stands, "pinned")
    known &= moved(moves, "moving")
    for index in range(part.halvings):
        middle = 0.5 * (stands + moves)
        went = moved(middle, f"halving {index + 1}/{part.halvings}")
        stands, moves = np.where(went, stands, middle), np.where(went, middle, moves)
    data = xr.Dataset(
        {
            name: (dims, np.where(known, values, np.nan))
            for name, values in (("stands", stands), ("moves", moves))
        },
        coords={"coupling": couplings, "edge": ["grows", "shrinks"], "pattern": PATTERNS},
    )
    return data.merge(predicted(base_chain(study, 1), part.highest))


def predicted(chain: Chain, highest: float) -> xr.Dataset:
    """The edges as the theory of fronts has them; `chain` is one mass.

    `growth_coupling` over belt speeds (`curve`) between v_H and `highest` for two phases
    (`cosine`), and `death_belt_speed` over `death_coupling`.
    """
    speeds = np.linspace(float(hopf_belt_speed(chain)) + 0.01, highest, _CURVE)
    cosines = np.array([0.0, -1.0])

    @eqx.filter_jit
    @jax.vmap
    def growing(speed: Array) -> tuple[Array, Array, Array]:
        own = chain.with_(belt_speed=speed)
        detuning, amplitude = single_cycle(own)
        each = [growth_coupling(own, detuning, amplitude, cosine) for cosine in cosines]
        return jnp.stack(each), detuning, amplitude

    threshold, detuning, amplitude = growing(jnp.asarray(speeds))
    couplings = np.geomspace(1e-3, 0.05, _CURVE)
    # Where masses die the detuning hardly depends on the belt speed.
    late = float(np.interp(0.93 * highest, speeds, np.asarray(detuning)))
    death = jax.jit(
        jax.vmap(lambda eta: death_belt_speed(chain, eta, late, nonsmooth_fold_belt_speed))
    )
    return xr.Dataset(
        {
            "growth_coupling": (("curve", "cosine"), np.asarray(threshold)),
            "detuning": ("curve", np.asarray(detuning)),
            "cycle_amplitude": ("curve", np.asarray(amplitude)),
            "death_belt_speed": ("death_coupling", np.asarray(death(jnp.asarray(couplings)))),
        },
        coords={"curve": speeds, "cosine": cosines, "death_coupling": couplings},
    )


def convergence(study: Study, job: Job) -> xr.Dataset:
    """The same speeds on other rings and with smoothed friction: dimension `case`."""
    part = study.convergence
    speeds = np.asarray(part.belt_speed)
    cases = [(part.masses, 0.0)] + [(n, 0.0) for n in part.other_masses]
    cases += [(part.masses, width) for width in part.width]
    waits = transients(base_chain(study, 1), speeds, study.base.coupling, part.time)
    parts = [
        follow(
            base_chain(study, n, width or _WIDTH), round(part.block * n / part.masses), part.time,
            {"belt_speed": speeds}, transient=waits, rtol=study.rtol, dry=width == 0.0,
            progress=job.progress, description=f"{n} masses, width {width:g}",
        )
        for n, width in cases
    ]  # fmt: skip
    data = add_mean(joined(parts, "case"), ("pattern",))
    masses, widths = zip(*cases, strict=True)
    return data.assign_coords(masses=("case", list(masses)), width=("case", list(widths)))
