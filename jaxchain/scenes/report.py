"""The summary of a run: a few lines for the terminal, and the page `report.html`."""

from __future__ import annotations

import base64
import shlex
import textwrap
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path

import numpy as np
import xarray as xr

from ..plotting import diagram
from ..plotting.diagram import failed, swept
from ..result import NAMES, message
from ..sweeps.store import in_lines, status_of, stores_in
from .files import SceneError, scene_file
from .folder import is_whole, missing, saved, was_cut_off
from .scene import LoadedScene, load_scene

PAGE = "report.html"


def summary(name: str, data: xr.Dataset, store: Path | None = None) -> str:
    """The size, cost and outcome of a sweep, and where it vibrates; or where cycles fold.

    **Arguments:** `store`, of a sweep that is too large for memory.
    """
    title, rows, more = data.attrs.get("description", ""), [], []
    if "fold_belt_speed" in data:
        speed, amplitude = float(data["fold_belt_speed"]), float(data["fold_amplitude"])
        title = "cycles of one oscillator, stable and unstable"
        rows = [("fold", f"at belt speed {speed:.5g}, amplitude {amplitude:.4g} (no cycle above)")]
        rows += [("cut off", data.attrs["cut_off"])] if "cut_off" in data.attrs else []
    elif store is not None:
        rows = [*_settings(data), ("store", "too large for a figure and for memory")]
        more = [in_lines(status_of(store))]
    elif "result" in data:
        rows = [*_settings(data), *_states(data), *(("failed", text) for text in failures(data))]
    head = f"{name}: {title}" if title else name
    return "\n".join([head, *(_line(label, text) for label, text in rows), *more])


def failures(data: xr.Dataset) -> Iterator[str]:
    """The failed runs (the first five), and a remedy for each kind of failure."""
    codes = data["result"].values
    # The outcome includes interrupted runs, which the user knows of.
    indices = np.argwhere(failed(data).values & (codes != NAMES.index("interrupted")))
    for index in indices[:5]:
        values = (data[dim].values[i] for dim, i in zip(swept(data), index, strict=True))
        run = ", ".join(f"{dim} {v:g}" for dim, v in zip(swept(data), values, strict=True))
        yield f"{run}: {NAMES[codes[tuple(index)]]}"
    if len(indices) > 5:
        yield f"and {len(indices) - 5} more, see `result`"
    for kind in sorted({int(codes[tuple(index)]) for index in indices}):
        yield f"{NAMES[kind]}: {message(NAMES[kind])}"


def _line(label: str, text: str) -> str:
    first, more = f"  {label:<14}", " " * 16
    return textwrap.fill(text, 98, initial_indent=first, subsequent_indent=more,
                         break_long_words=False, break_on_hyphens=False)  # fmt: skip


def _settings(data: xr.Dataset) -> Iterator[tuple[str, str]]:
    attrs, chain = data.attrs, diagram.parameters(data)
    sizes = " x ".join(f"{data.sizes[dim]} {dim}" for dim in swept(data))
    took = f" in {attrs['wall_time_s']:.3g} s" if "wall_time_s" in attrs else ""
    yield "runs", f"{data['result'].size} ({sizes}){took} on {attrs['devices']}"
    # A run with dry friction has no width, even if the chain of its scene has one.
    dry = attrs.get("model") == "dry" or chain.get("width") is None
    left_out = {"n", "ends", "friction_law", "friction_table", "oscillators"}
    left_out |= {"width"} if dry else set()
    several = "in a list" if "oscillators" in chain else "per mass"
    numbers = [
        f"{name} {several if isinstance(value, list) else value}"
        for name, value in chain.items()
        if name not in left_out and value is not None
    ]
    if "oscillators" in chain:  # cells
        yield "model", "; ".join([f"{chain['oscillators']}, n {chain['n']}", *numbers])
    else:
        masses = "1 mass" if chain["n"] == 1 else f"{chain['n']} masses, {chain['ends']} ends"
        law = f"{chain['friction_law']}{', truly dry' if dry else ''}"
        yield "chain", f"{masses}; {law}; {', '.join(numbers)}"
    how = f"{attrs['solver']}, rtol {attrs['rtol']:g}, to t = {attrs['t1']:g}"
    yield "numerics", how


def _states(data: xr.Dataset) -> Iterator[tuple[str, str]]:
    good, codes = ~failed(data), data["result"].values
    counts = [(int(np.sum(codes == i)), name) for i, name in enumerate(NAMES)]
    yield "outcome", ", ".join(f"{count} {name}" for count, name in counts if count)
    energies = diagram.energy(data)
    if energies is not None and good.any():
        reached = energies.values[good.values]
        low, high = (0.0 if abs(e) < 1e-12 else e for e in (reached.min(), reached.max()))
        yield "energy", f"{low:.4g} to {high:.4g}"
    if "belt_speed" not in swept(data):
        return
    hopf, speeds = diagram.hopf_belt_speed(data), data["belt_speed"].values
    if hopf is not None:
        yield "Hopf speed", f"{hopf:.5g} (steady sliding is stable above)"
    if "active_count" in data:
        other = [dim for dim in swept(data) if dim != "belt_speed"]
        none, still = good & (data["active_count"] == 0), diagram.slides_steadily(data)
        stable = diagram.stable_sliding(data, hopf)
        kinds = {"vibrating": good & (data["active_count"] > 0)}
        word = "no mass"
        if still is not None:
            kinds["sliding"] = none & still & (True if stable is None else stable)
            none, word = none & ~still, "moves, but no mass"
        for label, runs in {**kinds, "weak": none}.items():
            if runs.any():
                end = f": {word} above v_d / 2" if label == "weak" else ""
                yield label, f"at belt speeds {_stretches(speeds, runs.any(other).values)}{end}"
    moving = diagram.moving_fronts(data)
    if moving is not None:
        yield "moving fronts", f"at belt speeds {_stretches(speeds, moving.values)}"


def _stretches(positions: np.ndarray, inside: np.ndarray) -> str:
    """ "1.0 to 1.3, 1.7": the swept values in each stretch where `inside` holds."""
    order = np.argsort(positions)
    positions, inside = positions[order], inside[order]
    runs = np.split(positions, np.flatnonzero(np.diff(inside)) + 1)
    chosen = runs[0 if inside[0] else 1 :: 2]
    ends = [f"{r[0]:g}" if len(r) == 1 else f"{r[0]:g} to {r[-1]:g}" for r in chosen]
    return ", ".join(ends) or "none"


def write_page(
    folder: Path, name: str, datasets: Mapping[str, xr.Dataset], loaded: LoadedScene | None = None
) -> Path:
    """Writes `report.html` of a folder: one file that needs no other files and no network.

    **Arguments:** `datasets`, those in the folder; `loaded`, the scene, if its file can be read.

    **Raises:** `OSError` if it cannot be written.
    """
    from jinja2 import Environment, StrictUndefined

    template = resources.files("jaxchain.scenes").joinpath("page.html").read_text("utf-8")
    # Texts of a scene or of data are escaped.
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    names = [group.name for group in loaded.scene.groups()] if loaded else []
    done = [key for key, data in datasets.items() if is_whole(data)]
    picture, toml = folder / f"{name}.png", folder / f"{name}.toml"
    text = environment.from_string(template).render(
        name=name,
        title=loaded.scene.title if loaded else name,
        description=loaded.scene.description if loaded else "",
        missing=missing(folder, name, names, done),
        cut_off=was_cut_off(folder),
        failures={
            key: lines
            for key, data in datasets.items()
            if "result" in data and (lines := list(failures(data)))
        },
        picture=base64.b64encode(picture.read_bytes()).decode() if picture.exists() else None,
        datasets={
            key: (summary(key, data), data._repr_html_()) for key, data in sorted(datasets.items())
        },
        stores={store.name: in_lines(status_of(store)) for store in stores_in(folder)},
        toml=toml.read_text("utf-8", errors="replace") if toml.exists() else "",
        folder=shlex.quote(f"./{folder.absolute().name}"),
    )
    part = folder / f".{PAGE}.part"
    try:
        part.write_text(text, encoding="utf-8")
        return part.replace(folder / PAGE)
    finally:
        part.unlink(missing_ok=True)


def renew_page(folder: Path) -> Path:
    """Writes `report.html` of a folder of results again, from its files.

    **Returns:** the path of the page.

    **Raises:** `ValueError` if it is not a folder of results; `OSError` if the page cannot be
    written.

    !!! example

        >>> import tempfile, xarray as xr
        >>> from pathlib import Path
        >>> from jaxchain.scenes import Results
        >>> from jaxchain.scenes.report import renew_page
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
    path = str(folder.absolute())  # a folder, also where a built-in scene has its name
    loaded = None
    try:
        name = scene_file(path).name.removesuffix(".toml")
        loaded = load_scene(path)
    except SceneError as error:
        stores = sorted(folder.glob("*.zarr"))
        if not stores:
            raise ValueError(f"{wanted} {error.problems[0]}.") from None
        name = stores[0].stem.partition(".")[0]
    return write_page(folder, name, saved(folder / f"{name}.zarr"), loaded)
