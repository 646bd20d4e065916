"""What `jaxchain run`, `resume` and `status` do.

Each imports what it needs once it is known to be needed: `status` and wrong scenes need no JAX.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import shlex
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .._configure import configure
from .._limits import MOST_WORKERS
from .._terminal import INTERRUPTED, Elsewhere
from ..scenes.errors import (
    FigureError,
    SceneError,
    StorageError,
    StudyFailedError,
)


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """The options of `run` and of `resume`."""
    parser.add_argument(
        "--law", metavar="FILE.py:CLASS",
        help="friction law of one's own, a subclass of jaxchain.model.AbstractFrictionLaw, for "
        "every experiment of the scene; the file is run. Its fields are the numbers of the "
        'scene\'s friction table, which may have other names if it says law = "own"',
    )  # fmt: skip
    parser.add_argument(
        "--observer", metavar="FILE.py:CLASS", action="append", default=[], dest="observers",
        help="observer of one's own, a subclass of jaxchain.observers.AbstractObserver, for every "
        "experiment of the scene; the file is run. Its fields may stand in the scene, in "
        'observe.others as { observer = "own", name = "CLASS", ... } (repeatable)',
    )  # fmt: skip
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", metavar="N", type=_workers,
        help="compute in so many processes of this computer, into stores",
    )  # fmt: skip
    where.add_argument(
        "--scheduler", metavar="ADDRESS", type=_scheduler,
        help="compute in the workers of a Dask scheduler, such as tcp://host:8786, into stores on "
        "a disk that all of them see",
    )  # fmt: skip
    parser.add_argument("--no-plot", action="store_true", help="compute and save only")
    parser.add_argument("--quiet", action="store_true", help="print errors only")
    add_no_cache(parser)


def add_no_cache(parser: argparse.ArgumentParser) -> None:
    """The option `--no-cache` of a command that computes."""
    parser.add_argument(
        "--no-cache", action="store_true",
        help="compile all programs anew, and keep none. They are kept in the folder jaxchain of "
        "XDG_CACHE_HOME or ~/.cache, which may be deleted at any time, and save the next run on "
        "this kind of machine seconds to minutes; results are the same to the last bit",
    )  # fmt: skip


def configure_for(options: argparse.Namespace) -> None:
    """Sets JAX up as the options of a command say."""
    configure(cache=not options.no_cache)
    if options.no_cache:
        import jax

        jax.config.update("jax_enable_compilation_cache", False)


def run(options: argparse.Namespace) -> int:
    """`jaxchain run`: the exit status."""
    from ..scenes.reading import load_scene

    # Before jax is imported, so that a wrong scene is reported at once.
    loaded = load_scene(options.scene, options.overrides)
    configure_for(options)
    from ..scenes.folders.saving import was_cut_off
    from ..scenes.running import run_scene
    from ..scenes.storage import Results, listing

    how = _how(options, loaded.name)
    wanted = options.output or Path("results") / loaded.name
    elsewhere = Elsewhere(loaded.name)
    with contextlib.ExitStack() as stack:
        client = _client(options, stack)
        try:
            results = Results.claim(wanted, loaded.name, elsewhere)
        except OSError as error:
            _complain(f"cannot create {wanted}: {error.strerror}")
            return 2
        with results:
            asked = results.folder
            if asked != wanted and was_cut_off(wanted):
                _complain(f"the run in {wanted} was cut off: {_resume(options, wanted)}")
                _complain(f"this one goes to {asked}")
            elif asked != wanted:
                _complain(f"{wanted} is in use, the results go to {asked}")

            def call() -> None:
                files = [Path(given.rpartition(":")[0]) for given in _own(options)]
                run_scene(loaded, results, own_files=files, client=client, **how)

            def anything() -> bool:
                return bool(results.datasets or results.unfinished)

            status = _ended(call, lambda: results.folder, anything, told=True)  # by `elsewhere`
            for folder in results.unfinished if status else ():
                _complain(_resume(options, folder))
    if status == 0:
        report: Callable[[str], None] = how["report"]
        report(f"\nresults in {results.folder}: {', '.join(listing(results.folder))}")
        _tell_how_to_open(results.folder, loaded.name, report)
    # A script must see that its results are not where it wants them.
    return 1 if status == 0 and elsewhere.forced else status


def resume(options: argparse.Namespace) -> int:
    """`jaxchain resume`: the exit status."""
    from ..scenes.reading import load_scene

    folder = _folder_of(Path(options.folder))
    loaded = load_scene(str(folder))
    configure_for(options)
    from ..scenes.folders.resuming import resume_scene
    from ..scenes.storage import listing

    how = _how(options, loaded.name)
    with contextlib.ExitStack() as stack:
        client = _client(options, stack)
        try:
            status = _ended(
                lambda: resume_scene(loaded, folder, client=client, **how),
                lambda: folder, lambda: bool(listing(folder)),
            )  # fmt: skip
        except SceneError as error:
            if isinstance(error.__cause__, ValueError):  # not the scene: what does not fit it
                print(f"jaxchain: {error}", file=sys.stderr)
                again = shlex.join(["jaxchain", "run", str(folder)])
                _complain(f"`{again}` runs all of it again, into another folder")
                return 2
            raise
    if status == 0:
        report: Callable[[str], None] = how["report"]
        report(f"\nresults in {folder}: {', '.join(listing(folder))}")
        _tell_how_to_open(folder, loaded.name, report)
    else:
        _complain(_resume(options, folder))
    return status


def status(options: argparse.Namespace) -> int:
    """`jaxchain status`: the exit status."""
    from ..scenes.folders.saving import was_cut_off
    from ..sweeps.store import in_lines, status_of, store_named, stores_in

    path = Path(options.folder)
    one = store_named(path)
    stores = stores_in(path) if one is None else [one]
    if not stores:
        _complain(f"{path} is no store, and no folder that holds one")
        return 2
    folder = stores[0].parent
    cut_off, told = was_cut_off(folder), [status_of(store) for store in stores]
    if options.json:
        print(json.dumps({"cut_off": cut_off, "stores": told}, indent=2))
        return 0
    print("\n".join(map(in_lines, told)))
    if cut_off:
        print(f"the run was cut off: {_resume(options, folder)}")
    return 0


def _how(options: argparse.Namespace, scene: str) -> dict[str, Any]:
    """What `run_scene` and `resume_scene` are told."""
    from ..scenes.own_code import load_law, load_observer

    kinds = [load_observer(given, scene) for given in options.observers]

    def report(text: str) -> None:
        if not options.quiet:
            print(text, flush=True)

    if options.quiet:
        warnings.simplefilter("ignore")
    return {
        "own_law": None if options.law is None else load_law(options.law, scene),
        "own_observers": {kind.__name__: kind for kind in kinds},
        "plot": not options.no_plot,
        "progress": not options.quiet,
        "report": report,
        "command": shlex.join(["jaxchain", *options.arguments]),
    }


def _ended(
    call: Callable[[], None],
    folder: Callable[[], Path],
    anything: Callable[[], bool],
    told: bool = False,
) -> int:
    """The exit status of what computes, with words for what went wrong.

    `told`: why something could not be saved has been said.
    """
    from ..sweeps.store import StoreError

    try:
        call()
    except StorageError as error:
        if not told:
            _complain(str(error))
        _complain(f"stopped: `{error.name}` could not be saved")
        return 1
    except (FigureError, StudyFailedError, StoreError, MemoryError) as error:
        _complain(str(error))
        return 1
    except SystemExit as error:  # of a law or an observer
        _complain(f"your own code ended the run (SystemExit: {error}): take out its `sys.exit`")
        return 1
    except KeyboardInterrupt:
        _complain(f"interrupted{f'; what was finished is in {folder()}' if anything() else ''}")
        return INTERRUPTED
    return 0


def _folder_of(path: Path) -> Path:
    """The folder of the scene that a store belongs to, or the folder itself.

    **Raises:** `SceneError` for a store that no scene has made.
    """
    from ..scenes.files import scene_file
    from ..scenes.folders.groups import is_store_of
    from ..sweeps.store import store_named

    store = store_named(path)
    if store is None and os.path.isdir(path):  # which never raises
        return path
    if store is None:
        raise SceneError(
            str(path),
            ["must be a folder of results, or a store in it, for a run to go on there: `jaxchain "
             "run` begins one from a scene file or the name of a scene"],
        )  # fmt: skip
    with contextlib.suppress(SceneError):
        if is_store_of(scene_file(str(store.parent)).name.removesuffix(".toml"), store):
            return store.parent
    raise SceneError(
        str(path),
        ["is a store that no scene has made: make the Python call again that began it, with the "
         "same `store`; it goes on where it was"],
    )  # fmt: skip


def _client(options: argparse.Namespace, stack: contextlib.ExitStack) -> Any:
    """A client of the workers that were asked for, for as long as the stack lasts, or None."""
    if options.workers is None and options.scheduler is None:
        return None
    from ..sweeps.dask_engine import cluster
    from ..sweeps.store import StoreError

    try:
        return stack.enter_context(cluster(options.workers, options.scheduler, not options.quiet))
    except StoreError as error:
        _complain(str(error))
        raise SystemExit(2) from None


def _workers(text: str) -> int:
    count = int(text) if text.isascii() and text.isdecimal() else 0
    if not 1 <= count <= MOST_WORKERS:
        raise argparse.ArgumentTypeError(f'must be a number of processes, but is "{text}"')
    _need_dask()
    return count


def _scheduler(text: str) -> str:
    _need_dask()
    return text


def _need_dask() -> None:
    if importlib.util.find_spec("distributed") is None:
        raise argparse.ArgumentTypeError("needs Dask: pip install 'jaxchain[dask]'")


def _own(options: argparse.Namespace) -> list[str]:
    """What the command line names of one's own code."""
    return [*([] if options.law is None else [options.law]), *options.observers]


def _resume(options: argparse.Namespace, folder: Path) -> str:
    law, observers = getattr(options, "law", None), getattr(options, "observers", [])
    more = [*([] if law is None else ["--law", law]), *(f"--observer={own}" for own in observers)]
    return f"`{shlex.join(['jaxchain', 'resume', str(folder), *more])}` goes on with it"


def _tell_how_to_open(folder: Path, name: str, report: Callable[[str], None]) -> None:
    from ..sweeps.store import stores_in

    store = folder / f"{name}.zarr"
    if store.exists():
        report(f"open with xarray.open_datatree({str(store)!r}); {name}.nc holds the same")
    for one in stores_in(folder):
        report(f"open with xarray.open_zarr({str(one)!r}) what was kept as it ended")


def _complain(text: str) -> None:
    print(f"jaxchain: {text}", file=sys.stderr)
