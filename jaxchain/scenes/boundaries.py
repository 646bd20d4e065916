"""What a bifurcation diagram shows beside the runs of an experiment, computed and saved as data.

- the Hopf speed, a variable `hopf_belt_speed` of the dataset of the runs;
- the cycles of one oscillator through their fold, stable and unstable, a dataset of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from .._limits import MOST_LANES
from ..boundaries.fold import find_fold
from ..boundaries.hopf import hopf_belt_speed
from ..boundaries.single_mass import one_mass_branch
from ..model.chain import Chain
from ..model.sliding import has_uniform_damping

# A branch beside fewer belt speeds than these shows no more than where the runs end.
_LEAST_SPEEDS = 10
# The stick-slip branch is followed down to this belt speed, or to where the runs begin.
_LOWEST = 0.05
_SPEED, _LENGTH, _TIME = "x0 omega_n", "x0", "1 / omega_n"


def hopf_speed(chain: Chain, grid: Mapping[str, np.ndarray]) -> xr.DataArray | None:
    """The Hopf speed over whatever numbers of the chain are swept beside belt speed.

    None where no belt speed is swept, for numbers per mass, whose search costs eigenvalues, and
    for more combinations than fit into memory.
    """
    if "belt_speed" not in grid or not has_uniform_damping(chain):
        return None
    swept = [name for name in grid if name in chain.numbers() and name != "belt_speed"]
    if math.prod(len(grid[name]) for name in swept) > MOST_LANES:
        return None
    axes = np.meshgrid(*(grid[name] for name in swept), indexing="ij")

    def speed(*values: jax.Array) -> jax.Array:
        return hopf_belt_speed(chain.with_(**dict(zip(swept, values, strict=True))))

    found = jnp.vectorize(speed)(*axes) if swept else speed()
    about = {"long_name": "Hopf speed v_H: above it steady sliding is stable", "units": _SPEED}
    return xr.DataArray(np.asarray(found), dims=swept, attrs=about)


def cycles(chain: Chain, grid: Mapping[str, np.ndarray]) -> xr.Dataset | None:
    """All cycles of one oscillator with smoothed friction over the belt speed, through their fold.

    **Arguments:** `chain` and the swept values of the experiment whose runs they stand beside.

    **Returns:** a dataset over `point`, from rest at the Hopf speed through the fold to
    stick-slip; None for anything but one oscillator, of which no number is swept but at least ten
    belt speeds, from several starts at each; or if its cycles do not fold.
    """
    swept = [name for name in grid if name in chain.numbers()]
    if chain.n != 1 or swept != ["belt_speed"] or len(grid) < 2:
        return None
    speeds = grid["belt_speed"]
    if len(speeds) < _LEAST_SPEEDS:
        return None
    fold = find_fold(chain)
    if np.isnan(fold.belt_speed):
        return None
    # The sweep may lie above the fold altogether.
    lowest = min(max(float(np.min(speeds)), _LOWEST), 0.5 * float(fold.belt_speed))
    branch = one_mass_branch(chain, lowest, fold)
    known = np.isfinite(branch.belt_speed)
    stable = np.arange(known.size) > branch.fold

    def line(values: jax.Array, long_name: str, units: str) -> tuple:
        return "point", np.asarray(values)[known], {"long_name": long_name, "units": units}

    def one(values: jax.Array, long_name: str, units: str) -> tuple:
        return (), float(values[branch.fold]), {"long_name": long_name, "units": units}

    return xr.Dataset(
        {
            "belt_speed": line(branch.belt_speed, "belt speed v_d", _SPEED),
            "amplitude": line(branch.amplitude, "amplitude A, half peak-to-peak", _LENGTH),
            "period": line(branch.period, "period", _TIME),
            "stable": ("point", stable[known], {"long_name": "whether the cycle is stable"}),
            "fold_belt_speed": one(branch.belt_speed, "belt speed v_d of the fold", _SPEED),
            "fold_amplitude": one(branch.amplitude, "amplitude A at the fold", _LENGTH),
        }
    )
