"""The `jaxchain` command.

A subcommand imports what it needs: help, and the list of scenes, are printed at once.
"""

from __future__ import annotations

import _thread
import argparse
import contextlib
import importlib.util
import json
import math
import os
import re
import shlex
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import __version__
from ._configure import configure
from ._limits import MOST_WORKERS
from .model.parameters import parameter
from .scenes.files import SceneError, builtin_scenes, read_scene, scene_file

if TYPE_CHECKING:
    from .scenes.scene import LoadedScene

# Of the command and of each subcommand: words after `jaxchain`, and what they do.
_EXAMPLES = {
    "": (
        ("explore", "turn knobs on a live run, in the browser"),
        ("run quickstart", "draw a first figure, in seconds"),
        ("scenes", "list the built-in scenes"),
        ("scenes quickstart", "print a scene file, to edit"),
        ("status results/mine", "show the progress of a large run"),
        ("resume results/mine", "continue an interrupted run"),
        ("report results/mine", "write its report.html again"),
        ("COMMAND --help", "list the options of a command, with examples"),
    ),
    "run": (
        ("run quickstart", "a built-in scene"),
        ("run my.toml --output second", "a scene file, into the folder second"),
        ("run quickstart --set experiment.ladder.chain.n=8", "with another number"),
        ("run results/my", "the same again, into another folder"),
        ("run my.toml --workers 8", "in eight processes"),
        ("run my.toml --law my_law.py:MyLaw", "with your own friction law"),
    ),
    "explore": (
        ("explore", "the paper's ring of twenty"),
        ("explore quickstart --port 5007", "the model of a scene, at another port"),
        ("explore --no-browser", "print the address only"),
    ),
    "resume": (
        ("resume results/my", "compute what is missing"),
        ("resume results/my --workers 8", "in eight processes"),
        ("resume results/my --law my_law.py:MyLaw", "a run with your own friction law"),
    ),
    "status": (
        ("status results/my", "a folder of results"),
        ("status plane.zarr --json", "the store of a sweep, for programs"),
    ),
    "report": (("report results/my", "write results/my/report.html again"),),
    "scenes": (
        ("scenes", "list the built-in scenes"),
        ("scenes quickstart > my.toml", "copy one, to edit"),
        ("scenes --schema > scene.json", "let an editor check your scenes"),
    ),
    "boundary": (
        ("boundary", "one mass with the paper's parameters"),
        ("boundary --n 20 --coupling 0.01", "one mass of a ring of twenty"),
        ("boundary --mu-static 0.6 --mu-dynamic 0.4 --v-ref 0.3", "another friction law"),
        ("boundary --damping-ratio 0.03 --json", "for programs"),
    ),
    "basins": (
        ("basins", "the paper's parameters"),
        ("basins --belt-speed 1.3 --width 1e-2", "another belt speed and width"),
        ("basins --displacement -1 1 --velocity 0 0.5", "starts in another box"),
    ),
}
_STATUS = (
    "exit status: 0 success, 1 failure, 2 wrong use, 130 interrupted (finished runs are saved)\n"
)

# The numbers that `boundary` and `basins` take, those of the paper by default.
_BOUNDARY = ("width", "damping_ratio", "coupling", "mu_static", "mu_dynamic", "v_ref")
_BASINS = ("width", "damping_ratio", "mu_static", "mu_dynamic", "v_ref", "belt_speed")
_BOUNDARIES = (
    *("hopf", "hopf_dry", "hopf_dry_error", "fold", "fold_dry", "fold_dry_error"),
    *("fold_limit", "fold_limit_error"),
)
_NO_FOLD = (
    "no fold was found: one mass cannot vibrate, or its vibration sets in supercritically at the "
    "Hopf speed, or there is no damping to end it, or the search failed "
    "(`find_fold(chain).message` gives the reason)"
)


# Those that end a command, after what is finished is saved.
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _MisusedError(Exception):
    """An argument of the command line is wrong."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a subcommand; without one it prints its help.

    **Returns:** the exit status:

    - 0: success;
    - 1: failure: of a figure, of writing results, or a closed output;
    - 2: wrong use: a scene, an option, a folder;
    - 130: interrupted by Ctrl-C, SIGTERM or a closed terminal; finished runs are saved.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    for number in _SIGNALS:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)
    try:
        try:
            options = _parser().parse_args(arguments, argparse.Namespace(arguments=arguments))
            with _interruptible():
                return options.command(options) or 0
        finally:  # also after --help, which exits
            sys.stdout.flush()
    except BrokenPipeError:  # the output is closed: Python must not flush at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        _complain("interrupted")
        return 130
    except (SceneError, _MisusedError) as error:
        _complain(str(error))
        return 2


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Raises `KeyboardInterrupt` on Ctrl-C, also where compiled code turns it into another error.

    JAX does so while it compares static arguments, Matplotlib while it draws a path.  In a
    callback, such as JAX's for the garbage collector, Python would report and forget it.
    """
    came: list[int] = []
    main_thread = threading.current_thread() is threading.main_thread()
    handlers = {int(number): signal.getsignal(number) for number in _SIGNALS if main_thread}
    usual = {number: handler for number, handler in handlers.items() if callable(handler)}

    def note(number: int, frame: Any) -> None:
        came.append(number)
        usual[number](number, frame)

    def interrupt() -> None:
        if hasattr(signal, "pthread_kill"):  # also ends what waits
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        else:
            _thread.interrupt_main()

    def again(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            threading.Timer(0.01, interrupt).start()  # after the callback
        else:
            reported(unraisable)

    reported, sys.unraisablehook = sys.unraisablehook, again
    for number in usual:
        signal.signal(number, note)
    try:
        yield
    except Exception:
        if came:
            raise KeyboardInterrupt from None
        raise
    finally:
        sys.unraisablehook = reported
        for number, handler in usual.items():
            signal.signal(number, handler)


def _import_jax() -> None:
    """Imports JAX as a whole: a signal counts when it is done.

    The C++ of JAX and numpy prints a traceback, or aborts, if an import of its own is interrupted.
    """
    came: list[int] = []
    main_thread = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in _SIGNALS if main_thread}
    for number in before:
        signal.signal(number, lambda number, frame: came.append(number))
    try:
        import jax  # noqa: F401
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        raise KeyboardInterrupt


def _layout(command: str = "") -> dict[str, Any]:
    """How help is set, with the examples of a subcommand."""
    examples = _EXAMPLES[command]
    width = max(len(words) for words, _ in examples)
    lines = [f"  jaxchain {words:<{width}}  {text}" for words, text in examples]
    epilog = "\n".join(["examples:", *lines, "", _STATUS])
    return {"formatter_class": argparse.RawDescriptionHelpFormatter, "epilog": epilog}


def _parser() -> argparse.ArgumentParser:
    about = "Simulates chains of friction-excited oscillators."
    parser = argparse.ArgumentParser("jaxchain", description=about, **_layout())
    parser.add_argument("--version", action="version", version=f"jaxchain {__version__}")
    help_ = "print what completes words on Tab in bash, zsh, fish, tcsh or powershell"
    parser.add_argument("--completion", metavar="SHELL", action=_Completion, help=help_)
    parser.set_defaults(command=lambda options: parser.print_help())
    commands = parser.add_subparsers(metavar="COMMAND")

    def add(command: Callable[..., int | None], text: str, *options: Any) -> Any:
        name = command.__name__.strip("_")
        one = commands.add_parser(
            name, help=re.split(r"\.\s|\.$", text)[0], description=text, **_layout(name)
        )
        one.set_defaults(command=command)
        for option in options:
            option(one)
        return one

    run = add(_run, "Run a scene and draw its figure.", _add_scene_options)
    help_ = "name of a built-in scene, a TOML file, or a folder with results, to run again"
    run.add_argument("scene", help=help_)
    run.add_argument("--output", metavar="DIR", type=_folder, help="folder (results/SCENE)")
    change = "change a key, e.g. experiment.ladder.chain.n=40 (repeatable)"
    run.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help=change)
    text = "Continue an interrupted run. Finished runs are kept, missing ones are computed."
    resume = add(_resume, text, _add_scene_options)
    resume.add_argument("folder", help="folder of results")
    status = add(_status, "Show the progress of a run or of a store.", _add_json)
    status.add_argument("folder", help="folder of results, or a store")
    report = add(_report, "Write report.html of a folder of results again.")
    report.add_argument("folder", help="folder of results")
    scenes = add(_scenes, "List the built-in scenes.")
    scenes.add_argument("scene", nargs="?", help="print this scene file, to edit")
    scenes.add_argument("--schema", action="store_true", help="print the JSON schema, for editors")

    text = "Explore a live run in the browser: sliders, pictures, cycles. Ctrl-C ends it."
    explore = add(_explore, text, _add_custom_classes, _add_no_cache)
    help_ = "a scene, as for `run`; a folder of results shows its sweeps (a ring of twenty)"
    explore.add_argument("scene", nargs="?", help=help_)
    explore.add_argument("--experiment", metavar="NAME", help="of the scene (the last one)")
    explore.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help=change)
    explore.add_argument("--port", type=int, default=0, help="port to listen on (any free one)")
    help_ = "address to listen on (127.0.0.1: this computer only)"
    explore.add_argument("--address", default="127.0.0.1", help=help_)
    explore.add_argument("--no-browser", action="store_true", help="print the address only")

    boundary = add(
        _boundary,
        "Find where vibration sets in and up to which belt speed it survives.\nThe Hopf speed "
        "and the fold, at the given width and for dry friction, with error bars.\nWithout "
        "options: one mass with the paper's parameters.",
    )
    boundary.add_argument("--n", type=int, default=1, help="number of masses in the ring (1)")
    _add_numbers(boundary, _BOUNDARY)
    basins = add(
        _basins,
        "Find how many starts end in sliding, and how hard a blow starts vibration.\nThe exact "
        "share of a box of starts, and the gentlest blows that make one mass vibrate, at the\n"
        "given width and for dry friction. Without options: the paper's parameters.",
    )
    _add_numbers(basins, _BASINS)
    for name, low in (("displacement", -2.0), ("velocity", 0.0)):
        box: Any = {"nargs": 2, "metavar": ("LOW", "HIGH"), "default": (low, 2.0)}
        basins.add_argument(f"--{name}", type=float, help=f"of the starts ({low:g} 2)", **box)
    return parser


class _Completion(argparse.Action):
    """Prints a script for a shell, which completes subcommands, options, files and scenes."""

    def __call__(
        self, parser: Any, namespace: Any, values: Any, option_string: str | None = None
    ) -> None:
        if importlib.util.find_spec("shtab") is None:
            parser.error("--completion needs shtab: pip install 'jaxchain[completion]'")
        import shtab

        if values not in shtab.SUPPORTED_SHELLS:
            parser.error(f'--completion knows {", ".join(shtab.SUPPORTED_SHELLS)}, not "{values}"')
        names = " ".join(builtin_scenes())
        both = "_jaxchain_scene_file"
        choose = f'{both}() {{ compgen -W "{names}" -- "$1"; compgen -f -- "$1"; }}'
        scenes = shtab.FILE | {"bash": both, "preamble": {"bash": choose}}
        kinds = {"scene": scenes, "folder": shtab.DIRECTORY, "output": shtab.DIRECTORY}
        kinds |= dict.fromkeys(("law", "model", "observer"), shtab.FILE)
        (commands,) = (one for one in parser._actions if isinstance(one.choices, dict))
        for action in (action for one in commands.choices.values() for action in one._actions):
            if action.dest in kinds:
                action.complete = kinds[action.dest]
        print(shtab.complete(parser, values))
        parser.exit()


def _add_scene_options(parser: argparse.ArgumentParser) -> None:
    """The options of `run` and of `resume`."""
    _add_custom_classes(parser)
    custom: Any = {"metavar": "FILE.py:CLASS"}
    help_ = "your observer, a subclass of jaxchain.observers.AbstractObserver (repeatable)"
    parser.add_argument("--observer", action="append", default=[], help=help_, **custom)
    where = parser.add_mutually_exclusive_group()
    help_ = "compute in N processes of this computer, into stores"
    where.add_argument("--workers", metavar="N", type=_workers, help=help_)
    help_ = "compute in the workers of a Dask scheduler, such as tcp://host:8786"
    where.add_argument("--scheduler", metavar="ADDRESS", type=_scheduler, help=help_)
    parser.add_argument("--no-plot", action="store_true", help="compute and save only")
    parser.add_argument("--netcdf", action="store_true", help="also write SCENE.nc")
    parser.add_argument("--quiet", action="store_true", help="print errors only")
    _add_no_cache(parser)


def _add_custom_classes(parser: argparse.ArgumentParser) -> None:
    """Your own law and models."""
    custom: Any = {"metavar": "FILE.py:CLASS"}
    help_ = "your friction law, a subclass of jaxchain.model.AbstractFrictionLaw; runs the file"
    parser.add_argument("--law", help=help_, **custom)
    help_ = "your model, a subclass of jaxchain.model.AbstractCells (repeatable)"
    parser.add_argument("--model", action="append", default=[], help=help_, **custom)


def _add_no_cache(parser: argparse.ArgumentParser) -> None:
    help_ = "do not keep compiled programs in XDG_CACHE_HOME/jaxchain or ~/.cache/jaxchain"
    parser.add_argument("--no-cache", action="store_true", help=help_)


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _add_numbers(parser: argparse.ArgumentParser, names: Sequence[str]) -> None:
    """An option for each of these parameters of a chain, and the options such commands share."""
    for row in map(parameter, names):
        alone = row.per != "spring"
        help_ = f"{row.long_name} ({row.usual}{'' if alone else ' for several masses'})"
        option, usual = f"--{row.name.replace('_', '-')}", row.usual if alone else None
        parser.add_argument(option, type=float, default=usual, help=help_)
    _add_json(parser)
    _add_no_cache(parser)


def _folder(text: str) -> Path:
    """The folder of `--output`, which must have a name that can be numbered."""
    path = Path(text)
    if not text.strip() or path.name in ("", ".."):
        raise argparse.ArgumentTypeError(
            f'must name a folder of its own, such as results/mine, but is "{text}"'
        )
    return path


def _workers(text: str) -> int:
    count = int(text) if text.isascii() and text.isdecimal() else 0
    if not 1 <= count <= MOST_WORKERS:
        raise argparse.ArgumentTypeError(f'must be a number of processes, but is "{text}"')
    return int(_scheduler(text))


def _scheduler(text: str) -> str:
    if importlib.util.find_spec("distributed") is None:
        raise argparse.ArgumentTypeError("needs Dask: pip install 'jaxchain[dask]'")
    return text


def _run(options: argparse.Namespace) -> int:
    _configure(options)
    from .scenes.folder import claimed, was_cut_off
    from .scenes.scene import load_scene

    loaded = load_scene(options.scene, options.set)
    wanted = options.output or Path("results") / loaded.name

    @contextlib.contextmanager
    def claim() -> Iterator[Path]:
        with claimed(wanted) as folder:
            if folder != wanted:
                cut = f"the run in {wanted} was cut off: {_goes_on(wanted)}"
                _complain(cut if was_cut_off(wanted) else f"{wanted} is in use")
                _complain(f"the results go to {folder}")
            yield folder

    return _filled(options, loaded, wanted, claim())


def _resume(options: argparse.Namespace) -> int:
    folder = Path(options.folder)
    if not os.path.isdir(folder) or folder.suffix == ".zarr":  # which never raises
        begins = "`jaxchain run` makes one; for a store made in Python repeat the same `sweep`"
        raise SceneError(options.folder, [f"must be a folder of results to continue: {begins}"])
    _configure(options)
    from .scenes.scene import load_scene

    path = os.path.join(".", folder)  # a folder, even if a built-in scene has its name
    return _filled(options, load_scene(path), folder, contextlib.nullcontext(folder))


def _how(options: argparse.Namespace, scene: str) -> dict[str, Any]:
    """The arguments of `run_scene` besides a scene and a folder."""
    from .scenes.building import load_law, load_model, load_observer

    kinds = [load_observer(given, scene) for given in options.observer]
    models = [load_model(given, scene) for given in options.model]
    code = [given for given in (options.law, *options.model, *options.observer) if given]
    if options.netcdf and importlib.util.find_spec("h5netcdf") is None:
        raise _MisusedError("--netcdf needs h5netcdf: pip install 'jaxchain[netcdf]'")
    if options.quiet:
        warnings.simplefilter("ignore")
    return {
        "custom_law": None if options.law is None else load_law(options.law, scene),
        "custom_observers": {kind.__name__: kind for kind in kinds},
        "custom_models": {kind.__name__: kind for kind in models},
        "custom_files": [Path(given.rpartition(":")[0]) for given in code],
        "plot": not options.no_plot,
        "netcdf": options.netcdf,
        "progress": not options.quiet,
        "report": (lambda text: None) if options.quiet else _print,
        "command": shlex.join(["jaxchain", *options.arguments]),
    }


def _filled(
    options: argparse.Namespace,
    loaded: LoadedScene,
    wanted: Path,
    claim: contextlib.AbstractContextManager[Path],
) -> int:
    """Fills a folder of results and reports errors; the exit status."""
    from .scenes.folder import FigureError, Results, StorageError, listing, was_cut_off
    from .scenes.running import run_scene
    from .sweeps.store import StoreError

    how, name = _how(options, loaded.name), loaded.name
    folder, status = None, 1
    try:
        with _client(options) as client, claim as folder, _interruptible():
            run_scene(loaded, folder, client=client, **how)
        status = 0
    except KeyboardInterrupt:
        _complain("interrupted")
        status = 130
    except StorageError as error:
        _complain(str(error))
        rescued = Results(Path(tempfile.mkdtemp(prefix="jaxchain-")), name)
        for group, data in error.datasets.items():
            rescued.save(group, data)
            _complain(f"`{group}` is saved in {rescued.store} instead")
    except (FigureError, StoreError, MemoryError) as error:
        _complain(str(error))
        status = 1 if folder else 2
    except SystemExit as error:  # of a law or an observer
        _complain(f"your own code ended the run (SystemExit: {error}): remove its `sys.exit`")
    except OSError as error:
        if folder:  # not for the folder, which has its own errors
            raise
        _complain(f"cannot write into {wanted}: {error.strerror}")
        status = 2
    if folder and status and was_cut_off(folder):
        _complain(f"what was finished is in {folder}: {_goes_on(folder)}")
    elif folder and not status and not options.quiet:
        _print(f"\nresults in {folder}: {', '.join(listing(folder))}")
        for store in sorted(folder.glob("*.zarr")):
            reader = "open_datatree" if store.name == f"{name}.zarr" else "open_zarr"
            _print(f"open with xarray.{reader}({str(store)!r})")
    return status


def _client(options: argparse.Namespace) -> contextlib.AbstractContextManager[Any]:
    """A client for the requested workers, or None."""
    if options.workers is None and options.scheduler is None:
        return contextlib.nullcontext()
    from .sweeps.dask_engine import cluster

    return cluster(options.workers, options.scheduler, not options.quiet)


def _goes_on(folder: Path) -> str:
    return f"`{shlex.join(['jaxchain', 'resume', str(folder)])}` goes on with it"


def _explore(options: argparse.Namespace) -> None:
    from .explorer.serving import explored, serve

    def make() -> Any:
        _configure(options)
        from .scenes.building import Custom, load_law, load_model

        name = options.scene or "explore"
        law = None if options.law is None else load_law(options.law, name)
        kinds = [load_model(given, name) for given in options.model]
        custom = Custom(law, {}, {kind.__name__: kind for kind in kinds})
        return explored(options.scene, options.experiment, options.set, custom)

    try:
        explorer = serve(make, options.port, options.address, not options.no_browser)
    except (ValueError, ImportError) as error:
        raise _MisusedError(str(error)) from None
    _print(f"exploring at {explorer.url} (Ctrl-C ends it)")
    with contextlib.suppress(KeyboardInterrupt):
        explorer.wait()


def _status(options: argparse.Namespace) -> None:
    from .sweeps.store import in_lines, status_of, store_named, stores_in

    path = Path(options.folder)
    one = store_named(path)
    stores = stores_in(path) if one is None else [one]
    run = None
    if one is None and os.path.isdir(path):  # which never raises
        from .scenes.folder import status_of_run

        run = status_of_run(path)
    if run is None and not stores:
        raise _MisusedError(f"{path} is neither a store nor a folder that contains one")
    states = [status_of(store) for store in stores]

    if options.json:
        print(json.dumps(({} if run is None else {"run": run}) | {"stores": states}, indent=2))
        return
    print("\n".join([*(() if run is None else _run_in_lines(run)), *map(in_lines, states)]))


def _run_in_lines(run: dict[str, Any]) -> Iterator[str]:
    state = "was cut off" if run["cut_off"] else "has ended"
    yield f"{run['folder']}: the run {'is under way' if run['under_way'] else state}"
    for name in ("saved", "missing"):
        yield f"  {name:<14}{', '.join(run[name]) or 'nothing'}"
    if run["cut_off"]:
        yield f"  {_goes_on(Path(run['folder']))}"


def _report(options: argparse.Namespace) -> None:
    _import_jax()
    configure(devices=0, whole_loops=False, cache=False)  # the page has the precision of the run
    from .scenes.report import renew_page

    try:
        print(renew_page(Path(options.folder)))
    except (ValueError, OSError) as error:
        raise _MisusedError(str(error)) from None


def _scenes(options: argparse.Namespace) -> None:
    if options.schema:
        from .scenes.scene import schema

        print(json.dumps(schema(), indent=2))
    elif options.scene is None:
        for name in builtin_scenes():
            print(f"{name:<12} {read_scene(name)[1]['title']}")
    else:
        from .scenes.scene import load_scene

        load_scene(options.scene)
        print(scene_file(options.scene).read_text(encoding="utf-8"), end="")


def _boundary(options: argparse.Namespace) -> None:
    _configure(options)
    from .boundaries.ranges import stability_range

    coupling = options.coupling
    if options.n == 1 and coupling is not None:
        raise _MisusedError(
            f"Argument `coupling` is {coupling:g}, but one mass has no neighbours: leave it out, "
            "or raise `n`."
        )
    coupling = 0.01 if coupling is None and options.n > 1 else coupling
    # It does not depend on the belt speed.
    chain = _chain(options, options.n, belt_speed=1.0, coupling=coupling)
    report = _boundary_report(chain, stability_range(chain, error_bars=True))
    print(json.dumps(report) if options.json else _boundary_text(report))


def _basins(options: argparse.Namespace) -> None:
    _configure(options)
    from .basins.regions import Box
    from .basins.single_mass import sliding_basin
    from .boundaries.ranges import stability_range

    chain = _chain(options, 1, belt_speed=options.belt_speed)
    try:
        box = Box(tuple(options.displacement), tuple(options.velocity))
    except ValueError as error:
        raise _MisusedError(str(error)) from None
    smoothed, dry = (sliding_basin(one, box) for one in (chain, chain.with_(width=None)))
    report = _basins_report(chain, box, smoothed, dry, stability_range(chain, error_bars=True))
    print(json.dumps(report) if options.json else _basins_text(report))


def _boundary_report(chain: Any, boundaries: Any) -> dict[str, Any]:
    """The output of `jaxchain boundary --json`: numbers, or null with a reason in `missing`."""
    from .boundaries.ranges import NO_HOPF

    reasons = {
        "hopf": f"{NO_HOPF}, at this width",
        "hopf_dry": f"{NO_HOPF}, for dry friction",
        "fold": f"{_NO_FOLD}, at this width",
        "fold_dry": f"{_NO_FOLD}, for dry friction; for several masses, also where the "
        "neighbours reach the speed of the belt",
        "fold_limit": "a fold is not found at one of the widths that are extrapolated from",
    }
    values = {name: getattr(boundaries, name) for name in _BOUNDARIES}
    mass = {"vibrating_oscillator": boundaries.mass + 1}  # from 1, as the paper counts
    return _answer(values, reasons, mass, {"n": chain.n, **_parameters(chain, _BOUNDARY)})


def _boundary_text(report: dict[str, Any]) -> str:
    """Both boundaries as a table: at the given width, and for dry friction with its bar."""
    parameters, fold, dry = report["parameters"], report["fold"], report["fold_dry"]
    single = f"the vibration of oscillator {report['vibrating_oscillator']} alone"
    who = "its vibration" if parameters["n"] == 1 else single
    rows = [
        ("belt speed", f"width {parameters['width']:g}", "dry friction", "meaning"),
        ("Hopf", *_pair(report, "hopf"), "just below it vibration starts by itself"),
        ("fold", *_pair(report, "fold"), f"up to it {who} survives"),
    ]
    if report["fold_limit"] is not None:
        limit = f"{report['fold_limit']:.9f} ± {report['fold_limit_error']:.0e}"
        rows.append(("", "", limit, "the same, extrapolated from smoothed friction"))
    lines = [f"{a:<12} {b:<14} {c:<24} {d}" for a, b, c, d in rows]
    hopf = report["hopf_dry"]
    if hopf is not None and dry is not None and hopf < dry:
        lines.append(
            f"From {hopf:.4f} to {dry:.4f} it depends on the start: steady sliding or vibration."
        )
    if fold is not None and dry is not None:
        lines.append(f"The width moves the fold by {100 * (fold / dry - 1.0):+.3g} %.")
    return "\n".join([*lines, *_reasons(report)])


def _basins_report(chain: Any, box: Any, smoothed: Any, dry: Any, edges: Any) -> dict[str, Any]:
    """The output of `jaxchain basins --json`: numbers, or null with a reason in `missing`."""
    values, reasons = {}, {}
    for ending, basin, kind in (
        ("", smoothed, "at this width"),
        ("_dry", dry, "for dry friction"),
    ):
        for name, field in (("share", "share"), ("blow_up", "up"), ("blow_down", "down")):
            value = values[name + ending] = float(getattr(basin, field))
            why = "every motion ends in steady sliding, for any blow"
            why = why if math.isinf(value) else basin.message.rstrip(".")
            reasons[name + ending] = f"{why}, {kind}"
        for name in ("hopf", "fold"):
            values[name + ending] = getattr(edges, name + ending)
            why = "there is none, or it was not found: see `jaxchain boundary`"
            reasons[name + ending] = f"{why}, {kind}"
    bounds = {"box": {key: getattr(box, key).tolist() for key in ("displacement", "velocity")}}
    return _answer(values, reasons, bounds, _parameters(chain, _BASINS))


def _basins_text(report: dict[str, Any]) -> str:
    """The share, the gentlest blows and the boundaries as a table, with reasons for gaps."""
    (a, b), (c, d) = report["box"].values()
    parameters = report["parameters"]
    rows = [
        ("", f"width {parameters['width']:g}", "dry friction", "meaning"),
        ("share", *_pair(report, "share"), "share of starts that end in steady sliding"),
        ("blow up", *_pair(report, "blow_up"), "least velocity that makes a sliding mass vibrate"),
        ("blow down", *_pair(report, "blow_down"), "the same, downward"),
        ("Hopf", *_pair(report, "hopf"), "belt speed just below which vibration starts by itself"),
        ("fold", *_pair(report, "fold"), "belt speed up to which it survives"),
    ]
    speed = parameters["belt_speed"]
    head = f"belt speed {speed:g}, starts with {a:g} <= x <= {b:g} and {c:g} <= v <= {d:g}"
    lines = [f"{one:<12} {two:<14} {three:<14} {four}" for one, two, three, four in rows]
    return "\n".join([head, *lines, *_reasons(report)])


def _answer(values: Any, reasons: Any, more: Any, parameters: Any) -> dict[str, Any]:
    """A JSON object: numbers, or null with a reason in `missing`."""
    finite = {name: float(v) if math.isfinite(v) else None for name, v in values.items()}
    missing = {name: why for name, why in reasons.items() if finite[name] is None}
    return {**finite, "missing": missing, **more, "parameters": parameters}


def _parameters(chain: Any, names: tuple[str, ...]) -> dict[str, float | None]:
    numbers = {name: chain.parameters().get(name) for name in names}
    return {name: None if value is None else float(value) for name, value in numbers.items()}


def _pair(report: dict[str, Any], name: str) -> Iterator[str]:
    """A number at this width and for dry friction, which may have an error bar."""
    for key in (name, f"{name}_dry"):
        value, bar = report[key], report.get(f"{key}_error")
        more = "" if bar is None else f" ± {bar:.0e}"
        yield "none" if value is None else f"{value:.9f}{more}"


def _reasons(report: dict[str, Any]) -> Iterator[str]:
    return (f"{name}: {why}." for name, why in report["missing"].items())


def _chain(options: argparse.Namespace, n: int, **numbers: Any) -> Any:
    """The chain that the options of `_add_numbers` describe."""
    from .model.chain import Chain
    from .model.friction import ExponentialDecay, TanhFriction

    try:
        law = ExponentialDecay(options.mu_static, options.mu_dynamic, options.v_ref)
        friction = TanhFriction(law, options.width)
        return Chain(n, friction, damping_ratio=options.damping_ratio, **numbers)
    except ValueError as error:
        raise _MisusedError(str(error)) from None


def _configure(options: argparse.Namespace) -> None:
    _import_jax()
    configure(cache=not options.no_cache)
    if options.no_cache:
        import jax

        jax.config.update("jax_enable_compilation_cache", False)


def _print(text: str) -> None:
    print(text, flush=True)


def _complain(text: str) -> None:
    print(f"jaxchain: {text}", file=sys.stderr)
