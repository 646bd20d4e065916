"""The numbers of the study `basins`: shares of starts with true dry friction."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxchain.basins.classifiers import VibratingMasses
from jaxchain.basins.regions import Box
from jaxchain.basins.shares import basin_shares
from jaxchain.basins.single_mass import sliding_basin, sliding_share
from jaxchain.boundaries.grazing import nonsmooth_fold_belt_speed
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.cycles.search import find_limit_cycle
from jaxchain.model.chain import Chain
from jaxchain.observers.samples import Trajectory
from jaxchain.simulation.run import simulate
from jaxchain.studies._study import Job
from jaxchain.studies.basins.table import ChainShares, Study
from jaxchain.sweeps.sweeping import sweep

# Points of a cycle that is drawn, and time in which one mass is decided.
_POINTS, _TIME = 400, 600.0


def region(study: Study) -> Box:
    """The box from which the study's runs start."""
    return Box(study.region.displacement, study.region.velocity)


def one_mass(study: Study, job: Job) -> Iterator[tuple[str, xr.Dataset]]:
    """Shares of one mass that were sampled, and the exact ones over belt speed and width."""
    chain, own = study.base.chain(1), study.one_mass
    found = basin_shares(
        chain, region(study), {"belt_speed": own.belt_speed}, half_width=own.half_width,
        seed=study.seed, progress=job.progress,
    )  # fmt: skip
    found["exact"] = ("belt_speed", _exact(chain, study, np.asarray(own.belt_speed)))
    found["hopf"] = float(hopf_belt_speed(chain))
    found["fold"] = float(nonsmooth_fold_belt_speed(chain))
    yield "one_mass", found
    curve, widths = own.curve.array(), [0.0, *own.width]
    shares = []
    for width in job.bar(widths, unit="width"):
        shares.append(_exact(chain.with_(width=width or None), study, curve))
    yield (
        "exact",
        xr.Dataset(
            {"exact": (("width", "curve"), np.array(shares))},
            coords={"width": widths, "curve": curve},
        ),
    )


def _exact(chain: Chain, study: Study, speeds: np.ndarray) -> np.ndarray:
    box = region(study)
    share = jax.jit(lambda speed: sliding_share(chain.with_(belt_speed=speed), box))
    return np.array([float(share(speed)) for speed in speeds])


def plane(study: Study, job: Job) -> xr.Dataset:
    """Where starts of one mass lead on a grid, and the cycles between and around them."""
    own = study.plane
    chain = study.base.chain(1, own.belt_speed)
    (left, right), (low, high) = study.region.displacement, study.region.velocity
    x, v = np.linspace(left, right, own.count), np.linspace(low, high, own.count)
    runs = sweep(
        chain, lambda chain, displacement, velocity: (displacement, velocity), _TIME,
        over={"displacement": x, "velocity": v}, observe=VibratingMasses(),
        progress=job.progress, description="plane",
    )  # fmt: skip
    found = runs[["result"]].assign(
        vibrates=runs["state"].isel(oscillator=0, drop=True) > 0, decided=runs["decided"] != 0
    )
    found.attrs |= runs.attrs
    basin = sliding_basin(chain, region(study))
    cycles: dict[str, Any] = {"unstable": (basin.state, basin.period)}
    settled = find_limit_cycle(chain, throw=False)
    if settled.successful:
        cycles["stable"] = settled.state, settled.period
    for name, (state, period) in cycles.items():
        if np.isfinite(period):
            times = jnp.linspace(0.0, period, _POINTS)
            at_x, at_v = simulate(chain, state, period, observe=Trajectory(times)).observed
            found[f"{name}_displacement"] = ("point", np.asarray(at_x)[:, 0])
            found[f"{name}_velocity"] = ("point", np.asarray(at_v)[:, 0])
    return found.assign_coords(belt_speed=own.belt_speed).drop_vars("oscillator", errors="ignore")


def over_belt_speed(study: Study, job: Job) -> xr.Dataset:
    """How many masses of a ring vibrate, over the belt speed."""
    own = study.over_belt_speed
    return _of_ring(study, own, {"belt_speed": own.belt_speed}, job)


def over_coupling(study: Study, job: Job) -> xr.Dataset:
    """How many masses of a ring vibrate, over the coupling."""
    own = study.over_coupling
    return _of_ring(study, own, {"coupling": own.coupling}, job)


def _of_ring(study: Study, own: ChainShares, over: dict[str, Any], job: Job) -> xr.Dataset:
    chain = study.base.chain(own.masses, own.belt_speed[0], coupling=own.coupling[0])
    with warnings.catch_warnings():
        # The report says it, too.
        warnings.filterwarnings("ignore", message=".* of the starts are in another state")
        return basin_shares(
            chain, region(study), over, half_width=own.half_width, t1=own.time, seed=study.seed,
            progress=job.progress,
        )  # fmt: skip
