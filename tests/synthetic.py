"""Made-up results that look like those of `sweep`, for everything that comes after it."""

import inspect
import json
from types import SimpleNamespace

import numpy as np
import xarray as xr

import jaxchain
from jaxchain.boundaries.special_curves import CurvePoint, SpecialCurve
from jaxchain.continuation.branch import Branch, SpecialPoint
from jaxchain.cycles.branches import CycleBranch, CyclePoint
from jaxchain.cycles.shooting import Shooting
from jaxchain.kinds.fold import Fold
from jaxchain.kinds.hopf import Hopf
from jaxchain.kinds.multipliers import PeriodDoubling, Torus
from jaxchain.model.chain import paper_chain
from jaxchain.result import NAMES
from jaxchain.solvers.rosenbrock import Rodas5P

KINDS = {kind.name: kind for kind in (Fold(), Hopf(), Torus(), PeriodDoubling())}
PAPER = {
    "ends": "cyclic", "belt_speed": "swept", "damping_ratio": 0.05, "coupling": 0.01,
    "stiffness": 1.0, "normal_load": None, "friction_law": "ExponentialDecay", "mu_static": 1.0,
    "mu_dynamic": 0.5, "v_ref": 0.5, "width": 1e-3,
}  # fmt: skip


def stored(path):
    """The datasets in `path`.zarr by name, read as a tree."""
    with xr.open_datatree(f"{path}.zarr") as tree:
        assert not tree.dataset.variables
        return {name: group.to_dataset().load() for name, group in tree.children.items()}


def results(axes, vibrating, n, **parameters):
    """Runs over `axes` in which the first `vibrating` masses vibrate at the speed of the belt.

    With the Hopf speed of the paper's chain, as scenes save it.

    `vibrating` has the shape of the runs, with -1 for a run that failed.
    """
    dims = tuple(axes)
    vibrating = np.asarray(vibrating)
    active = np.arange(1, n + 1) <= vibrating[..., None]
    amplitude = np.where(active, 1.5, 0.0)
    amplitude[vibrating < 0] = np.nan
    code = np.where(vibrating < 0, NAMES.index("nonfinite"), NAMES.index("successful"))
    return xr.Dataset(
        {
            "amplitude": ((*dims, "oscillator"), amplitude),
            "energy": (dims, 0.5 * (amplitude**2).sum(-1)),
            "active_count": (dims, np.where(vibrating < 0, np.nan, vibrating)),
            "result": (dims, code, {"flag_meanings": " ".join(NAMES)}),
            "end_time": (dims, np.full(vibrating.shape, 100.0)),
            "steps": (dims, np.full(vibrating.shape, 1000)),
            "hopf_belt_speed": ((), 0.5 * np.log(10)),
        },
        coords={**axes, "oscillator": np.arange(1, n + 1)},
        attrs={
            "parameters": json.dumps(PAPER | {"n": n} | parameters), "solver": "Rodas4()",
            "rtol": 1e-6, "t1": 100.0, "devices": "cpu:0", "wall_time_s": 1.0,
        },
    )  # fmt: skip


def recorded_sweep(calls, fails=False):
    """Stands for `sweep`: notes its arguments; the last run of three masses may fail."""

    def sweep(chain, initial, t1, *, over, **options):
        inspect.signature(jaxchain.sweep).bind(chain, initial, t1, over=over, **options)
        calls.append({"chain": chain, "initial": initial, "t1": t1, "over": over, **options})
        axes = {name: np.asarray(values) for name, values in over.items()}
        vibrating = np.ones(tuple(map(len, axes.values())), int)
        if fails and chain.n == 3:
            vibrating[-1, -1] = -1
        return results(axes, vibrating, chain.n)

    return sweep


def ladder():
    """Six masses at belt speeds 1.0 ... 1.9: fronts move at 1.0 ... 1.2 and at 1.7; none later."""
    speeds, excited = np.round(np.arange(1.0, 1.95, 0.1), 1), np.arange(7)
    rows = {1.7: [0, 1, 1, 2, 3, 5, 6], 1.8: [0] * 7, 1.9: [0] * 7}
    grows = [0, 6, 6, 6, 6, 6, 6]
    # A gap of one mass between vibrating neighbours closes, but that is no front.
    stays = [0, 1, 2, 3, 4, 6, 6]
    vibrating = [rows.get(v, grows if v < 1.25 else stays) for v in speeds.tolist()]
    return results({"belt_speed": speeds, "excited": excited}, vibrating, 6)


def single():
    """One mass: vibrates below 1.15 and, from a start of more than 1, up to 1.8."""
    speeds, start = np.array([0.5, 1.0, 1.3, 1.6, 1.9]), np.array([0.5, 0.9, 1.1, 2.0])
    vibrating = (speeds[:, None] < 1.15) | ((start > 1) & (speeds[:, None] < 1.8))
    return results(
        {"belt_speed": speeds, "displacement": start}, vibrating.astype(int), 1, coupling=None
    )


def cycle_branch(n=2, special=("fold", "hopf")):
    """A made-up branch of eight cycles: stable up to a fold at 1.85, then unstable to rest."""
    speed = np.array([1.5, 1.6, 1.7, 1.8, 1.8, 1.7, 1.5, 1.3])
    height = np.array([1.5, 1.6, 1.7, 1.8, 1.6, 1.3, 0.8, 0.3])
    amplitude = height[:, None] * 0.1 ** np.arange(n)
    multipliers = np.full((8, 2 * n - 1), 0.1 + 0.2j)
    multipliers[4:, 0] = 1.5
    chain = paper_chain(n, belt_speed=1.5, width=1e-2)
    shooting = Shooting(chain, 1e-10, Rodas5P(), 0, tuple(range(n)), "belt_speed")
    u = np.full((8, 2 * n), 0.5)
    at = {"fold": (3, 1.85, 1.7), "hopf": (7, 1.15, 1e-4), "torus": (5, 1.6, 1.1)}
    points = []
    for kind in special:
        index, p, top = at[kind]
        raw = SpecialPoint(kind, index, 0.0, u[0], p, np.ones(2 * n + 1), 0.0, 0.0, True, 1e-9)
        state, own = np.full(n, top), top * 0.1 ** np.arange(n)
        how = multipliers[0], True, 1e-9, raw, shooting, 0.5
        points.append(CyclePoint(KINDS[kind], p, (state, -state), 6.3, own, *how))
    tangents, none = np.ones((8, 2 * n + 1)), np.zeros(8)
    return CycleBranch(
        "belt_speed", speed, (amplitude, -amplitude), np.linspace(6.31, 6.28, 8), amplitude,
        np.linspace(3.0, -10.0, 8), multipliers, np.full(8, 1e-9), tuple(points),
        ((shooting, Branch(u, speed, np.arange(8.0), tangents, none, None, (), "stopped")),), 0,
    )  # fmt: skip


def special_curve(kind="fold"):
    """A made-up curve of folds or Hopf points that meet at (0.5, 0.3)."""
    second = np.array([0.1, 0.2, 0.3])
    first = 0.5 + (0.3 - second) * {"fold": 4.0, "hopf": 2.0}[kind]
    meeting = CurvePoint("generalised Hopf", 0.5, 0.3, 1e-9, 1, np.zeros(4))
    parts = np.zeros((3, 1))
    equations = (SimpleNamespace(field=paper_chain(1, width=1e-2), kind=KINDS[kind]),) * 3
    return SpecialCurve(
        kind, ("belt_speed", "damping_ratio"), first, second, (parts, parts), np.full(3, 6.3),
        parts, np.zeros(3), (meeting,), ("left_bounds", "generalised Hopf"), equations, parts,
    )  # fmt: skip
