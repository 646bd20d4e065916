"""The server of the explorer: for the command line, and for a notebook."""

from __future__ import annotations

import dataclasses
import html
import importlib.util
import logging
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._types import Given, StateLike

MISSING = "The explorer needs Panel: pip install 'jaxchain[explore]'"
# A model, its state, and stored sweeps: (parameter values, energies) by the parameter's name.
Explored = tuple[Any, Any, dict[str, Any]]


class Explorer:
    """A running explorer: `url` is its address; a notebook shows it in a frame.

    `stop()` ends it, `wait()` returns when it has ended.

    See `explore` for an example.
    """

    def __init__(self, server: Any, url: str, searcher: Any) -> None:
        self.url, self._server, self._searcher = url, server, searcher
        self._ended = threading.Event()

    def stop(self) -> None:
        """Ends the server and its searches."""
        # Tabs that are still open cut their connections: no fault.
        logs = {name: logging.getLogger(name) for name in ("asyncio", "bokeh", "tornado")}
        levels = {name: log.level for name, log in logs.items()}
        for log in logs.values():
            log.setLevel(logging.CRITICAL + 1)
        try:
            self._server.stop()
            self._searcher.stop()
        finally:
            for name, log in logs.items():
                log.setLevel(levels[name])
            self._ended.set()

    def wait(self) -> None:
        """Returns when the explorer has been stopped; Ctrl-C stops it."""
        try:
            while not self._ended.wait(0.5):
                pass
        finally:
            self.stop()

    def _repr_html_(self) -> str:
        address = html.escape(self.url, quote=True)
        return f'<iframe src="{address}" width="100%" height="820" frameborder="0"></iframe>'


def explore(
    model: Any,
    state: Given[StateLike],
    *,
    port: int = 0,
    address: str = "127.0.0.1",
    show: bool = False,
) -> Explorer:
    """Starts the explorer of a model: a run in the browser that goes on while sliders move.

    Every tab has a run of its own, which begins at `state`.  Returns at once; a notebook shows the
    page in its cell.

    **Arguments:** `model`, any that `simulate` takes; `state`, its initial state; `port`, 0 for
    any free one; `address`: where the server listens, by default for this computer alone; `show`:
    open a browser.

    **Raises:** `ValueError` for a state or a port that cannot be; `ImportError` without Panel.

    ```python
    chain = paper_chain(20, belt_speed=1.5)
    explorer = explore(chain, equation_8(chain, 5))
    explorer.url, explorer.stop()
    ```
    """
    from ..model.arguments import as_model, as_state

    state = as_state(as_model(model), state, "state")
    return serve(lambda: (model, state, {}), port, address, show)


def explored(
    scene: str | None, experiment: str | None, overrides: Sequence[str], custom: Any = None
) -> Explored:
    """An experiment of a scene, at the middle of its sweep; None: a ring of twenty.

    Of a folder of results also its sweeps, smoothed and dry, for the bifurcation diagram.

    **Raises:** `SceneError` for a scene that cannot be run or has no such experiment.
    """
    if scene is None:
        from ..model.chain import paper_chain
        from ..model.initial_states import equation_8

        chain = paper_chain(20, 1.5)
        return chain, equation_8(chain, 5), {}
    from ..scenes.building import Custom, build
    from ..scenes.files import SceneError
    from ..scenes.scene import load_scene

    loaded = load_scene(scene, overrides)
    known = loaded.scene.experiment
    name = [*known][-1] if experiment is None else experiment
    if name not in known:
        raise SceneError(scene, [f"has no experiment `{name}`; it has: {', '.join(known)}"])
    one = loaded.scene.model_copy(update={"experiment": {name: known[name]}})
    built = build(dataclasses.replace(loaded, scene=one), custom or Custom())[name]
    grid = {key: values[len(values) // 2] for key, values in known[name].grid().items()}
    numbers = {key: float(value) for key, value in grid.items() if built.model.has_parameter(key)}
    model = built.model.with_(**numbers)
    if known[name].numerics.model == "dry":
        model = model.with_(width=None)
    start = {key: value for key, value in grid.items() if key not in numbers}
    return (
        model,
        built.initial(model, **start),
        _stored(Path(scene), loaded.name, name, [*numbers]),
    )


def _stored(folder: Path, scene: str, name: str, axes: list[str]) -> dict[str, Any]:
    """Stored energies over each swept parameter, of a folder of results."""
    if not (folder / f"{scene}.zarr").is_dir():
        return {}
    from ..plotting import diagram
    from ..plotting.groups import DRY
    from ..scenes.folder import saved

    groups = saved(folder / f"{scene}.zarr")
    found: dict[str, Any] = {}
    for data in (groups[key] for key in (name, name + DRY) if key in groups):
        energy: Any = diagram.energy(data)
        if energy is None:
            continue
        for axis in axes:
            values = data[axis].broadcast_like(energy), energy
            parts = [np.asarray(part.values, float).ravel() for part in values]
            before = found.get(axis, ([], []))
            found[axis] = tuple(np.append(a, b) for a, b in zip(before, parts, strict=True))
    return found


def serve(make: Callable[[], Explored], port: int, address: str, show: bool) -> Explorer:
    """Serves what `make` makes, in a thread beside this one."""
    if not isinstance(port, int) or not 0 <= port < 65536:
        raise ValueError(f"Argument `port` must be 0 or a free port below 65536, but is {port}.")
    port = _free_port(address, port)
    if importlib.util.find_spec("panel") is None:
        raise ImportError(MISSING)
    made: list[Explored | Exception] = []

    def prepare() -> None:
        try:
            made.append(make())
            from . import page  # noqa: F401
        except Exception as error:
            made.append(error)

    # JAX loads while the server starts.
    preparing = threading.Thread(target=prepare, daemon=True)
    preparing.start()
    import panel as pn

    preparing.join()
    if isinstance(made[0], Exception):
        raise made[0]
    model, state, stored = made[0]
    from .page import visit
    from .searches import Searcher
    from .session import Session

    logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)
    logging.getLogger("asyncio").addFilter(_is_fault)
    searcher = Searcher()

    def of_visitor() -> Any:
        given = pn.state.session_args or {}
        query = {name: values[0].decode() for name, values in given.items()}
        return visit(Session(model, state), stored, searcher, query)

    host = "127.0.0.1" if address == "0.0.0.0" else address
    server = pn.serve(
        of_visitor, port=port, address=address, show=show, threaded=True, verbose=False,
        title="jaxchain explorer", websocket_origin=["*"] if address == "0.0.0.0" else
        [f"{host}:{port}", f"localhost:{port}"],
    )  # fmt: skip
    return Explorer(server, f"http://{host}:{port}/", searcher)


def _is_fault(record: logging.LogRecord) -> bool:
    """Whether a line of a log tells of a fault: not of a tab that was closed at the wrong time."""
    from tornado.iostream import StreamClosedError
    from tornado.websocket import WebSocketClosedError

    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, StreamClosedError | WebSocketClosedError | BrokenPipeError)


def _free_port(address: str, port: int) -> int:
    """The port, or a free one for 0; `ValueError` if another program listens there."""
    import socket

    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((address, port))
        except OSError as error:
            raise ValueError(
                f"Argument `port` = {port} cannot be used at {address} ({error.strerror}): give "
                "another one, or 0 for any."
            ) from None
        return trial.getsockname()[1]
