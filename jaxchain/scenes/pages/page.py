"""`report.html`: written when a run ends, however it ends, or renewed from what lies there."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

from ..._terminal import undisturbed
from ...sweeps.store import stores_in
from ..errors import SceneError
from ..files import scene_file
from ..folders.datasets import aside, saved
from ..folders.saving import was_cut_off
from ..reading import load_scene
from .contents import told
from .picture import as_text

if TYPE_CHECKING:
    from ..storage import Results

PAGE = "report.html"
MOST_CHARACTERS = 2_900_000


def html(
    folder: Path,
    name: str,
    datasets: Mapping[str, xr.Dataset],
    scene: Any = None,
    cut_off: bool = False,
) -> str:
    """The page of a folder, see `told`; one file that needs no other and no network."""
    from jinja2 import Environment, StrictUndefined

    text = (
        resources.files("jaxchain.scenes.pages")
        .joinpath("template.html")
        .read_text(encoding="utf-8")
    )
    # Whatever stands in a scene or in data is text of a stranger.
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(text)
    content = told(folder, name, datasets, scene, cut_off)
    bare = template.render(content, picture=None, sharp=True)
    room = MOST_CHARACTERS - len(bare.encode())
    found = as_text(folder / f"{name}.png", room)
    if found is None:
        return bare
    return template.render(content, picture=found[0], sharp=found[1])


def write_page(
    folder: Path,
    name: str,
    datasets: Mapping[str, xr.Dataset],
    scene: Any = None,
    cut_off: bool = False,
) -> Path:
    """Writes the page, whole or not at all.

    **Raises:** `OSError` if it cannot be written.
    """
    text = html(folder, name, datasets, scene, cut_off)
    with aside(folder / PAGE) as part:
        part.write_text(text, encoding="utf-8")
        return part.replace(folder / PAGE)


@contextlib.contextmanager
def page_behind(results: Results, scene: Any) -> Iterator[None]:
    """Writes the page at the end of the block, however it ends, wherever anything was saved.

    A page that cannot be written is told of on the standard error, and changes nothing else.
    """
    try:
        yield
    finally:
        for folder, whole in results.whole.items():
            if whole or stores_in(folder):
                datasets = {key: results.datasets[key] for key in whole}
                try:
                    with undisturbed():
                        write_page(folder, results.name, datasets, scene)
                except Exception as error:
                    why = getattr(error, "strerror", None) or repr(error)
                    print(f"jaxchain: cannot write {folder / PAGE}: {why}", file=sys.stderr)


def renew_page(folder: Path) -> Path:
    """Writes the page of a folder of results, `report.html`, anew, from what lies there.

    **Returns:** the path of the page.

    **Raises:** `ValueError` if it is no folder of results; `OSError` if the page cannot be
    written.

    !!! example

        >>> import tempfile, xarray as xr
        >>> from pathlib import Path
        >>> from jaxchain.scenes import Results, renew_page
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data = xr.Dataset({"amplitude": ("belt_speed", [1.6, 1.7])})
        ...     Results(Path(folder), "mine").save("run", data)
        ...     page = renew_page(Path(folder))
        ...     print(page.name, "amplitude" in page.read_text())
        report.html True
    """
    wanted = f"Argument `folder` must be a folder of results, but {folder}"
    if not folder.is_dir():
        it_is = f"a file: its folder is {folder.parent}" if folder.is_file() else "none"
        raise ValueError(f"{wanted} is {it_is}.")
    # A folder, also where a scene that comes with jaxchain has its name.
    where = str(folder.absolute())
    try:
        name = scene_file(where).name.removesuffix(".toml")
    except SceneError as error:
        files = sorted(folder.glob("*.nc"))
        if len(files) != 1:
            raise ValueError(f"{wanted} {error.problems[0]}.") from None
        name = files[0].stem  # a study that was called from Python
    try:
        scene = load_scene(where).scene
    except SceneError:  # of another version: its text is there in any case
        scene = None
    return write_page(folder, name, saved(folder / name), scene, was_cut_off(folder))
