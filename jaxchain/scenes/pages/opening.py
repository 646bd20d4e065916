"""How the data of a folder are opened, in several languages."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import xarray as xr


def programs(
    name: str, datasets: Mapping[str, xr.Dataset], stores: Sequence[str]
) -> list[tuple[str, str]]:
    """Language and program, for the file `name`.nc and for stores beside it."""
    found = []
    if datasets:
        group = next(
            (key for key, data in datasets.items() if data.data_vars), next(iter(datasets))
        )
        found += _file(f"{name}.nc", group, _variable(datasets[group]))
    if stores:
        lines = ["import xarray as xr", *(f"runs = xr.open_zarr({store!r})" for store in stores)]
        found.append(("Python, the stores", "\n".join(lines)))
    return found


def _variable(data: xr.Dataset) -> str:
    """One to show: what was measured, before how the runs ended."""
    names = sorted(map(str, data.data_vars))
    known = [name for name in ("energy", "amplitude", "active_count") if name in names]
    return (known or names or [""])[0]


def _file(file: str, group: str, variable: str) -> list[tuple[str, str]]:
    matlab = file.replace('"', '""')
    julia = json.dumps(file, ensure_ascii=False).replace("$", r"\$")
    own = variable.isidentifier() and variable.isascii()
    held = variable if own else "values"
    return [
        (
            "Python",
            "import xarray as xr\n\n"
            f"tree = xr.open_datatree({file!r})\n"
            f"data = tree[{group!r}].to_dataset()\n"
            f"{held} = data[{variable!r}]\n"
            "data.to_dataframe()  # the same as a table of pandas",
        ),
        (
            "MATLAB",
            f'ncdisp("{matlab}")  % what there is\n'
            f'{held} = ncread("{matlab}", "/{group}/{variable}");  % last dimension first',
        ),
        (
            "Julia",
            "using NCDatasets\n\n"
            f"file = NCDataset({julia})\n"
            f'data = file.group["{group}"]\n'
            f'{held} = Array(data["{variable}"])  # last dimension first',
        ),
        (
            "R",
            "library(ncdf4)\n\n"
            f"file <- nc_open({json.dumps(file, ensure_ascii=False)})\n"
            f'{held} <- ncvar_get(file, "{group}/{variable}")  # last dimension first',
        ),
    ]
