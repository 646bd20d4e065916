"""A module imports from strictly lower floors only, so that every part can be read from below."""

import ast
from pathlib import Path

import pytest

import jaxchain

FLOORS = [
    {"_types", "_checks", "result", "fold_result", "branch", "evidence"},
    {"locality"},
    {"springs", "friction", "tableaus", "units", "measures", "studies.bias", "spectrum"}
    | {"roots", "implicit", "descent", "criteria", "layer"}
    | {"studies.mistuning.statistics", "studies.mistuning.summary"}
    | {"studies.ladder.summary", "studies.verdicts.paper"},
    {"structure", "tridiagonal"},
    {"chain", "control", "polynomial", "rosenbrock", "augmented", "corrector"}
    | {"studies.verdicts.reasons", "studies.states.summary"},
    {"dry", "observe", "states", "choice", "special_points", "sliding", "averaging"},
    {"amplitude", "least_period", "sampling", "progress", "studies.balance", "studies.witnesses"}
    | {"walk", "lyapunov_coefficient", "crossings", "touch", "front_track", "mistuning"},
    {"touch_search", "observing_solver", "lanes", "dataset", "continuation", "hopf", "hopf_points"}
    | {"hopf_descent"},
    {"grazing", "engine", "filippov"},
    {"simulate", "shooting", "generalised_hopf", "linearised", "tangent"},
    {"axes", "pool", "fold_search", "floquet", "cycle_equations", "recurrence"}
    | {"studies.mistuning.capture", "studies.fronts.prediction"},
    {"fold_start"},
    {"ensemble", "tables", "fold", "cycle_guesses", "cycle_search", "cycle_points", "return_map"},
    {"lyapunov", "front", "film", "scene", "studies", "studies.__init__", "studies.cycles"}
    | {"one_mass", "extrapolate", "fold_descent", "bistable", "cycle_special"},
    {"diagram", "scenefile", "bench.peers", "bench.timing", "boundary"}
    | {"cycle_branch", "measurements", "design", "trial"}
    | {"studies.crosscheck_summary", "studies.crosscheck_table", "studies.extreme_table"}
    | {"studies.boundaries_table", "studies.states.table", "studies.verdicts.table"}
    | {"studies.ladder.table", "studies.mistuning.table"}
    | {"studies.fronts.table", "studies.fronts.runs", "studies.fronts.report"},
    {"cycle_reach"},
    {"cycle"},
    {"patterns"},
    {"plot", "summary", "bench.cstep", "bench.ensembles", "bench.solvers", "identification"}
    | {"orbit_judge", "studies.approaches", "studies.judge", "studies.boundaries_curves"}
    | {"studies.states.phases", "studies.ladder.branches", "studies.ladder.checks"}
    | {"studies.fronts.measure", "studies.mistuning.ensembles"},
    {"run", "verdict", "friction_drawing", "bench.size", "bench.steps"}
    | {"studies.extreme_cases", "studies.extremes_figure"}
    | {"studies.crosscheck_figure", "studies.work_precision_figure", "studies.boundaries_figure"}
    | {"studies.states.delay_plots", "studies.states.motion_plots", "studies.ladder.ends"}
    | {"studies.ladder.figure", "studies.fronts", "studies.fronts.figure"}
    | {"studies.mistuning.analysis", "studies.mistuning.figure"}
    | {"studies.verdicts.figure"},
    {"drawing", "bench", "bench.__init__", "studies.extreme_chains", "studies.extreme_inputs"}
    | {"studies.crosscheck", "studies.work_precision", "studies.boundaries"}
    | {"studies.states.runs", "studies.states.figure", "studies.ladder.__init__"}
    | {"studies.fronts.__init__", "studies.mistuning.__init__", "studies.verdicts.runs"},
    {"film_scene", "studies.extremes", "studies.states.__init__"} | {"studies.verdicts.__init__"},
    {"animation"},
    {"__main__"},
]
FLOOR = {module: floor for floor, modules in enumerate(FLOORS) for module in modules}
PACKAGE = Path(jaxchain.__path__[0])
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if path != PACKAGE / "__init__.py"  # the front door shows every floor
)


def imported_modules(source: str) -> set[str]:
    """Modules of jaxchain that `source` imports, also within functions; "" is the front door."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            dotted = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = f"jaxchain.{node.module or ''}".rstrip(".") if node.level else node.module or ""
            # `from . import a` may name a module or a public name of the front door.
            dotted = [
                f"{base}.{alias.name}" if base == "jaxchain" else base for alias in node.names
            ]
        else:
            continue
        for name in dotted:
            package, _, module = name.partition(".")
            if package == "jaxchain":
                names.add(module)
    return names


def complaints(module: str, source: str) -> list[str]:
    if module not in FLOOR:
        return [f"{module} has no floor: put it into FLOORS."]
    found = []
    for name in sorted(imported_modules(source)):
        if name not in FLOOR:
            found.append(
                f"{module} imports `{name}`, which has no floor: a module belongs into FLOORS; a "
                "public name is to be imported from its module, not from the front door."
            )
        elif FLOOR[name] >= FLOOR[module]:
            found.append(
                f"{module} (floor {FLOOR[module]}) imports {name} (floor {FLOOR[name]}): "
                "imports only point down."
            )
    return found


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_from_lower_floors_only(module):
    source = PACKAGE.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8")
    assert not complaints(module, source)


def test_no_module_stands_on_two_floors():
    assert sum(map(len, FLOORS)) == len(FLOOR)


@pytest.mark.parametrize(
    "source",
    [
        "from .fold import fold_belt_speed",
        "from . import fold",
        "from jaxchain.fold import fold_belt_speed",
        "import jaxchain.fold as fold",
        "def lazy():\n    from .fold import fold_belt_speed",
        "from .units import Scales",
        "from . import Chain",
        "from jaxchain import Chain",
        "import jaxchain",
    ],
)
def test_an_import_that_does_not_point_down_is_noticed(source):
    assert len(complaints("friction", source)) == 1


@pytest.mark.parametrize(
    "source", ["import jax", "from jax import lax", "from ._types import PerMass", "x = 1"]
)
def test_an_import_that_points_down_or_outside_is_fine(source):
    assert not complaints("friction", source)


def test_a_module_without_a_floor_is_noticed():
    assert complaints("attic", "x = 1") == ["attic has no floor: put it into FLOORS."]
