"""The `jaxchain` command.

A subcommand imports what it needs: help, and the list of scenes, are there at once.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from . import __version__
from ._commands import basin_words, boundary_words
from ._commands import scenes as scene_commands
from ._commands.scenes import add_no_cache, add_scene_options, configure_for
from ._terminal import run_command
from .model.parameters import parameter
from .scenes.errors import SceneError

_RUN_MORE = """\
examples:
  jaxchain run quickstart          a ring of six: data and a figure, in seconds
  jaxchain run quickstart --output first --set experiment.ladder.chain.n=10
  jaxchain run first               the same again, into results/quickstart

exit status:
  0              done
  1              a study, a figure, a store, or the writing of results failed
  2              a scene, an option or a folder is wrong
  130, 143, 129  stopped by Ctrl-C, SIGTERM, a closed terminal: what had ended is saved

An experiment of more than 4096 runs is kept in a store as its runs end, unless the scene says
numerics.store = false: `jaxchain status` tells how far it is, and `jaxchain resume` goes on where
a run was cut off.
"""
_RESUME_MORE = """\
examples:
  jaxchain resume results/first    what `jaxchain run ... --output results/first` has left
  jaxchain resume results/first & jaxchain resume results/first
                                   two processes, which share what is left

exit status: as that of `jaxchain run`
"""
_EXAMPLES = """\
examples:
  jaxchain run quickstart          a first look, in seconds: results/quickstart
  jaxchain scenes                  what else can be run
  jaxchain scenes quickstart       a scene file, to start one's own from
  jaxchain status results/mine     how far a large run is
  jaxchain resume results/mine     goes on where one was cut off
  jaxchain report results/mine     renews its report.html
  jaxchain COMMAND --help          the options of a command
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a subcommand; without one it prints its help.

    **Returns:** the exit status:

    - 0: done;
    - 1: failed: a study, a figure, results that could not be written where they were wanted,
      output on a full disk;
    - 2: misused: a scene, an option, a folder that cannot be made;
    - 130, 143, 129: stopped by Ctrl-C, SIGTERM or a closed terminal; what had ended is saved.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    # What `run` has done is in its folder; of other commands the print is all there is.
    return run_command(
        lambda: _run_command(arguments), print_matters=arguments[:1] not in (["run"], ["resume"])
    )


def _run_command(arguments: list[str]) -> int:
    options = _parser().parse_args(arguments, argparse.Namespace(arguments=arguments))
    try:
        return options.command(options)
    except SceneError as error:
        print(f"jaxchain: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxchain",
        description="Simulates chains of friction-excited oscillators.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"jaxchain {__version__}")
    parser.set_defaults(command=lambda options: parser.print_help() or 0)
    commands = parser.add_subparsers(metavar="COMMAND")

    run = commands.add_parser(
        "run",
        help="run a scene or study and draw its figure",
        description="Runs a scene or a study.",
        epilog=_RUN_MORE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    run.add_argument(
        "scene",
        help="name of a built-in scene or study, a TOML file, or a folder with results, to run "
        "again what was run there",
    )
    run.add_argument(
        "--output", metavar="DIR", type=_folder, help="folder for the results (results/SCENE)"
    )
    run.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], dest="overrides",
        help="change a key of the scene, e.g. experiment.ladder.chain.n=40 (repeatable)",
    )  # fmt: skip
    add_scene_options(run)
    run.set_defaults(command=scene_commands.run)

    resume = commands.add_parser(
        "resume",
        help="go on with a run that was cut off, or help one that is under way",
        description="Goes on with a run that was cut off, in its own folder: what is there stays, "
        "what is missing is computed. Any number of processes may do so at once, also on several "
        "computers that share a disk.",
        epilog=_RESUME_MORE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    resume.add_argument("folder", help="folder of results, or a store in it")
    add_scene_options(resume)
    resume.set_defaults(command=scene_commands.resume)

    status = commands.add_parser(
        "status",
        help="what is done of a run with stores, how fast, and what is left",
        description="Tells what is done of the stores of a run, by whom and how fast, while it is "
        "under way or afterwards.",
    )
    status.add_argument("folder", help="folder of results, or a store")
    status.add_argument("--json", action="store_true", help="print one JSON object")
    status.set_defaults(command=scene_commands.status)

    report = commands.add_parser(
        "report",
        help="write report.html of a folder of results anew",
        description="Writes report.html of a folder of results anew, from what lies there: one "
        "file that tells what was asked and what was found, and opens without a network.",
    )
    report.add_argument("folder", help="folder of results")
    report.set_defaults(command=_report)

    scenes = commands.add_parser(
        "scenes",
        help="list the built-in scenes and studies",
        description="Shows the built-in scenes and studies.",
    )
    scenes.add_argument("scene", nargs="?", help="print this scene file, to start one's own from")
    scenes.add_argument(
        "--schema",
        action="store_true",
        help="print the JSON schema of scene files, or of the files of a study, for editors",
    )
    scenes.set_defaults(command=_scenes)

    boundary = commands.add_parser(
        "boundary",
        help="at which belt speeds vibration starts by itself, and up to which it survives",
        description="Finds the Hopf speed and the fold of a chain: at the width asked and for dry "
        "friction, with error bars. Without options: one mass with the paper's parameters.",
    )
    boundary.add_argument("--n", type=int, default=1, help="number of masses in the ring (1)")
    _add_numbers(boundary, boundary_words.NUMBERS)
    boundary.add_argument("--json", action="store_true", help="print one JSON object")
    add_no_cache(boundary)
    boundary.set_defaults(command=_boundary)

    basins = commands.add_parser(
        "basins",
        help="from how many starts one mass slides, and how hard one must push it",
        description="Finds the exact share of a box of starts from which one mass comes to slide "
        "steadily, and the gentlest blows that make it vibrate: at the width asked and for dry "
        "friction. Without options: the paper's parameters.",
    )
    _add_numbers(basins, basin_words.NUMBERS)
    for name, usual in (("displacement", (-2.0, 2.0)), ("velocity", (0.0, 2.0))):
        basins.add_argument(
            f"--{name}", type=float, nargs=2, metavar=("LOW", "HIGH"), default=usual,
            help=f"{name} of the starts ({usual[0]:g} {usual[1]:g})",
        )  # fmt: skip
    basins.add_argument("--json", action="store_true", help="print one JSON object")
    add_no_cache(basins)
    basins.set_defaults(command=_basins)

    return parser


def _add_numbers(parser: argparse.ArgumentParser, names: Sequence[str]) -> None:
    """An option for each of these numbers of a chain."""
    for row in map(parameter, names):
        alone = row.per != "spring"
        parser.add_argument(
            f"--{row.name.replace('_', '-')}", type=float, default=row.usual if alone else None,
            help=f"{row.long_name} ({row.usual}{'' if alone else ' for several masses'})",
        )  # fmt: skip


def _folder(text: str) -> Path:
    """The folder of `--output`, which has a name of its own beside which others can stand."""
    path = Path(text)
    if not text.strip() or path.name in ("", ".."):
        raise argparse.ArgumentTypeError(
            f'must name a folder of its own, such as results/mine, but is "{text}"'
        )
    return path


def _scenes(options: argparse.Namespace) -> int:
    from .scenes.files import builtin_scenes, read_scene, scene_file

    wanted, builtin = options.scene, builtin_scenes()
    if not options.schema and wanted is None:
        for name in builtin:
            _, data = read_scene(name)
            print(f"{name:<12} {data['title']}")
        return 0
    # Here, as it takes longer than all of the list.
    from .scenes.reading import load_scene, schema
    from .scenes.scene import Scene

    if options.schema:
        model = Scene if wanted is None else type(load_scene(wanted).scene)
        print(json.dumps(schema(model), indent=2))
    else:
        load_scene(wanted)
        print(scene_file(wanted).read_text(encoding="utf-8"), end="")
    return 0


def _boundary(options: argparse.Namespace) -> int:
    def make() -> Any:
        from .boundaries.overview import hopf_and_fold

        if options.n == 1 and options.coupling is not None:
            raise ValueError(
                f"Argument `coupling` is {options.coupling:g}, but one mass has no neighbours: "
                "leave it out, or raise `n`."
            )
        coupling = 0.01 if options.coupling is None and options.n > 1 else options.coupling
        # The belt speed has no part in it.
        return hopf_and_fold, _chain(options, options.n, belt_speed=1.0, coupling=coupling)

    def find(hopf_and_fold: Any, chain: Any) -> tuple[Any, ...]:
        return chain, hopf_and_fold(chain)

    return _tell(options, make, find, boundary_words)


def _report(options: argparse.Namespace) -> int:
    from ._configure import configure
    from .scenes.pages.page import renew_page

    # What the page says is found with the precision of the run.
    configure(devices=0, whole_loops=False, cache=False)
    folder = Path(options.folder)
    try:
        print(renew_page(folder))
    except ValueError as error:
        print(f"jaxchain: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"jaxchain: cannot write {folder}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


def _basins(options: argparse.Namespace) -> int:
    def make() -> Any:
        from .basins.regions import Box

        chain = _chain(options, 1, belt_speed=options.belt_speed)
        return chain, Box(tuple(options.displacement), tuple(options.velocity))

    def find(chain: Any, box: Any) -> tuple[Any, ...]:
        from .basins.single_mass import sliding_basin
        from .boundaries.overview import hopf_and_fold

        kinds = chain, chain.with_(width=None)
        return chain, box, *(sliding_basin(own, box) for own in kinds), hopf_and_fold(chain)

    return _tell(options, make, find, basin_words)


def _chain(options: argparse.Namespace, n: int, **numbers: Any) -> Any:
    """The chain that the options of `_add_numbers` describe."""
    from .model.chain import Chain
    from .model.friction import ExponentialDecay, TanhFriction

    law = ExponentialDecay(options.mu_static, options.mu_dynamic, options.v_ref)
    friction = TanhFriction(law, options.width)
    return Chain(n, friction, damping_ratio=options.damping_ratio, **numbers)


def _tell(
    options: argparse.Namespace,
    make: Callable[[], Any],
    find: Callable[..., tuple[Any, ...]],
    words: Any,
) -> int:
    """Prints in `words` what `find` finds of what `make` makes, or what is wrong with that."""
    configure_for(options)
    try:
        asked = make()
    except ValueError as error:
        print(f"jaxchain: {error}", file=sys.stderr)
        return 2
    try:
        found = find(*asked)
    except KeyboardInterrupt:
        print("jaxchain: interrupted", file=sys.stderr)
        return 130
    print(json.dumps(words.report(*found)) if options.json else words.in_words(*found))
    return 0
