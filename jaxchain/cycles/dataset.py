"""A branch of cycles as a labelled `xarray.Dataset`, with the names and units of a sweep's."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from ..continuation.branch import special_variables
from ..model.parameters import SPEED, parameter
from ..model.provenance import circumstances, parameters_of
from ..observers.amplitude import amplitude_variables
from .bifurcation_tests import count_unstable
from .special_points import CyclePoint

if TYPE_CHECKING:
    from xarray import Dataset

    from .branches import CycleBranch

_OSCILLATOR, _MULTIPLIER = ("oscillator",), ("multiplier",)


def branch_dataset(branch: CycleBranch) -> Dataset:
    """See `CycleBranch.to_dataset`."""
    # xarray brings pandas, which would double the time of the import.
    from xarray import Dataset

    field, n = branch.shooting.field, branch.x.shape[1]
    row = parameter(branch.name)
    own = _of_cycles(branch, branch.parameter, vars(branch))
    unstable = count_unstable(branch.multipliers)
    more = {
        "unstable_count": ((), unstable, "multipliers beyond the unit circle", "1"),
        "stable": ((), unstable == 0, "whether no multiplier is beyond the unit circle", "1"),
        "trivial_defect": ((), branch.trivial_defect, "error of the trivial multiplier", "1"),
    }
    places = [(point.index, point.refined) for point in branch.special]
    points = [(point.kind, point.parameter, point.error) for point in branch.special]
    if points:
        values = np.array([point.parameter for point in branch.special], float)
        special = _of_cycles(branch, values, _stacked(branch, n))
    else:
        special = {name: (said[0], said[1][:0], *said[2:]) for name, said in own.items()}
    return Dataset(
        {
            **_over("point", own | more),
            **special_variables(points, places, row.unit),
            **{f"special_{name}": v for name, v in _over("special", special).items()},
        },
        coords={
            branch.name: ("point", branch.parameter, row.attrs),
            "oscillator": ("oscillator", np.arange(1, n + 1), {"long_name": "oscillator n"}),
        },
        attrs={
            "parameters": parameters_of(field, n, [branch.name]),
            "parameter": branch.name,
            "ended": branch.ended,
            "message": branch.message,
            "solver": repr(branch.shooting.solver),
            "rtol": float(branch.shooting.rtol),
            "cut_at_oscillator": branch.shooting.mass + 1,
            "images": json.dumps(branch.shooting.images),
            **circumstances(),
        },
    )


def _stacked(branch: CycleBranch, n: int) -> dict[str, np.ndarray]:
    """What is known of the special points, stacked along a first axis."""

    def column(name: str, *shape: int, dtype: Any = float) -> np.ndarray:
        values = [getattr(point, name) for point in branch.special]
        return np.reshape(np.asarray(values, dtype), (-1, *shape))

    found = {name: column(name, n) for name in ("x", "v", "amplitude")}
    found["period"] = column("period")
    found["multipliers"] = column("multipliers", branch.multipliers.shape[1], dtype=complex)
    place = branch.shooting.place
    closeness = [_closeness(point, place) for point in branch.special]
    known = np.isfinite(branch.closeness).any()
    found["closeness"] = np.where(known, np.array(closeness, float), np.nan)
    return found


def _closeness(point: CyclePoint, place: int) -> float:
    return float(np.sinh(point.raw.u[place]))


def _of_cycles(
    branch: CycleBranch, values: np.ndarray, known: Mapping[str, Any]
) -> dict[str, tuple[tuple[str, ...], np.ndarray, str | None, str]]:
    """(dimensions, values, long name, unit) of what cycles are, one for each parameter value."""
    speed = values if branch.name == "belt_speed" else getattr(
        branch.shooting.field, "belt_speed", None
    )  # fmt: skip
    said = amplitude_variables(jnp.asarray(known["amplitude"]), speed)
    found: dict[str, Any] = {
        name: (label.dims, np.asarray(label.values), label.long_name, label.units)
        for name, label in said.items()
    }
    multipliers = known["multipliers"]
    return found | {
        "period": ((), known["period"], "least period T", "1 / omega_n"),
        "displacement": (_OSCILLATOR, known["x"], "displacement where the cycle is cut", "x0"),
        "velocity": (_OSCILLATOR, known["v"], "velocity where the cycle is cut", SPEED),
        "closeness": ((), known["closeness"], "max w / eps of the mass that is cut", "1"),
        "multiplier_real": (_MULTIPLIER, multipliers.real, "real part of the multiplier", "1"),
        "multiplier_imag": (_MULTIPLIER, multipliers.imag, "imaginary part of it", "1"),
    }


def _over(dim: str, variables: Mapping[str, tuple]) -> dict[str, tuple]:
    return {
        name: ((dim, *dims), values, {"long_name": text, "units": units})
        for name, (dims, values, text, units) in variables.items()
    }
