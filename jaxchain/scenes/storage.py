"""The folder of results: datasets as zarr and netCDF, figures as PNG and PDF."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from ..plotting.style import save_figure
from .errors import FigureError


def new_folder(path: Path) -> Path:
    """Creates a folder for results that nothing else has used: `path`, or `path`-2, `path`-3, ...

    An empty folder counts as unused.

    **Raises:** `OSError` if no folder can be made there.
    """
    for count in itertools.count(1):
        folder = path if count == 1 else path.with_name(f"{path.name}-{count}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            if not folder.is_dir() or any(folder.iterdir()):
                continue
        return folder
    raise AssertionError  # the count never ends


def save(data: xr.Dataset, path: Path, group: str | None) -> None:
    """Writes `data` into `path`.zarr and `path`.nc, at the root (None) or as a group."""
    zarr_file, netcdf_file = path.with_name(path.name + ".zarr"), path.with_name(path.name + ".nc")
    # Format 2 is what other tools read, and what has consolidated metadata.
    data.to_zarr(zarr_file, group=group, mode="a", zarr_format=2, consolidated=True)
    data.to_netcdf(
        netcdf_file, group=group, mode="a" if netcdf_file.exists() else "w", engine="h5netcdf"
    )


def save_drawing(draw: Callable[[], Figure], path: Path) -> None:
    """Draws and writes `path`.png and `path`.pdf, once everything else is written.

    **Raises:** `FigureError` if that fails.
    """
    try:
        save_figure(draw(), path)
    except Exception as error:
        raise FigureError(
            f"the results are in {path.parent}, but drawing them failed: {error!r}"
        ) from error
