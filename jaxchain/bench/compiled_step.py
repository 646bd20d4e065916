"""One Rosenbrock step of a ring in C: the arithmetic of `solvers/rosenbrock.py`, compiled by gcc
or any other C compiler, to see how far the step is from what the machine can do."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxchain.bench.peers import CompiledRing, PeerMissingError
from jaxchain.model.chain import Chain
from jaxchain.solvers.tableaus import RosenbrockTableau

_SOURCE = """
#include <math.h>

static double force(double v, const double *p) {{
    double w = v - p[0];
    return -(p[6] + (p[5] - p[6]) * exp(-fabs(w) / p[7])) * tanh(w / p[1]) - 2 * p[2] * v;
}}

static double force_and_slope(double v, const double *p, double *slope) {{
    double w = v - p[0], direction = tanh(w / p[1]), decay = (p[5] - p[6]) * exp(-fabs(w) / p[7]);
    *slope = decay / p[7] * fabs(direction)
        - (p[6] + decay) * (1 - direction * direction) / p[1] - 2 * p[2];
    return -(p[6] + decay) * direction - 2 * p[2] * v;
}}

/* All arrays of a step have one ghost at each end. */
static void ghosts(double *z) {{ z[0] = z[{n}]; z[{n} + 1] = z[1]; }}

static double step(double h, double *x, double *v, const double *p) {{
    double b[{stages}][{n} + 2], z[{n} + 2], u[{n} + 2], inverse[{n} + 2], start[{n} + 2];
    double g[{n} + 2], sum = 0, per_h = 1 / h, hg = h * {gamma!r}, k = p[4] + 2 * p[3];
{body}
    return sum;
}}

/* `steps` steps of `lanes` chains with belt speeds p[8 lane]; returns the errors' squares. */
double run(long steps, long lanes, double h, double *x, double *v, const double *p) {{
    double sum = 0;
    for (long s = 0; s < steps; s++)
        for (long lane = 0; lane < lanes; lane++)
            sum += step(h, x + {n} * lane, v + {n} * lane, p + 8 * lane);
    return sum;
}}
"""


def _sum(weights: np.ndarray, lead: str = "") -> str:
    terms = [lead] if lead else []
    terms += [f"{float(w)!r} * b[{m}][i]" for m, w in enumerate(weights) if w != 0.0]
    return " + ".join(terms) or "0.0"


def source(n: int, tableau: RosenbrockTableau, sweeps: int) -> str:
    """The C source of a step for rings of n masses."""
    tab = tableau
    loop = f"    for (int i = 1; i <= {n}; i++) "
    stages = len(tab.c)
    lines = []
    for j in range(stages):
        if j == 0:
            lines += [
                loop + "{ double slope;",
                "        g[i] = force_and_slope(v[i - 1], p, &slope);",
                f"        inverse[i] = 1 / (per_h / {tab.gamma!r} - slope + hg * k); }}",
            ]
        else:
            lines.append(loop + f"g[i] = force({_sum(tab.a[j, :j], 'v[i - 1]')}, p);")
        displacement = _sum(tab.stage_b[j, :j], f"{float(tab.stage_v[j])!r} * v[i - 1]")
        lines += [
            loop + f"z[i] = x[i - 1] + h * ({displacement});",
            "    ghosts(z);",
            loop + f"u[i] = start[i] = inverse[i] * (g[i] - k * z[i] + per_h * "
            f"({_sum(tab.C[j, :j])}) + p[3] * (z[i - 1] + z[i + 1]));",
        ]
        for sweep in range(sweeps):
            last = sweep == sweeps - 1
            target = f"b[{j}]" if last else ("z" if sweep % 2 == 0 else "u")
            origin = "u" if sweep % 2 == 0 else "z"
            lines += [
                f"    ghosts({origin});",
                loop + f"{target}[i] = start[i] + hg * p[3] * inverse[i] * "
                f"({origin}[i - 1] + {origin}[i + 1]);",
            ]
    last = stages - 1
    lines += [
        loop + "{",
        f"        double e = h * ({_sum(tab.beta[-1], f'{float(tab.alpha[-1])!r} * v[i - 1]')});",
        f"        sum += e * e + b[{last}][i] * b[{last}][i];",
        f"        x[i - 1] += h * ({_sum(tab.end_b, f'{float(tab.end_v)!r} * v[i - 1]')});",
        f"        v[i - 1] += {_sum(tab.a[-1])} + b[{last}][i]; }}",
    ]
    return _SOURCE.format(n=n, stages=stages, gamma=tab.gamma, body="\n".join(lines))


def compiled_steps(
    chains: Sequence[Chain], tableau: RosenbrockTableau, sweeps: int, fast_math: bool = False
) -> Callable[[int, float, Any, Any], tuple[np.ndarray, np.ndarray]]:
    """A function (steps, h, x, v) -> (x, v) of shape (lanes, n), one homogeneous ring a lane.

    `fast_math` lets the compiler reorder sums and use vector exponentials.
    """
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise PeerMissingError("no C compiler found")
    n, lanes = chains[0].n, len(chains)
    parameters = np.concatenate([CompiledRing.parameters(chain) for chain in chains])
    with tempfile.TemporaryDirectory() as folder:
        file, library = Path(folder, "step.c"), Path(folder, "step.so")
        file.write_text(source(n, tableau, sweeps))
        flags = ["-O3", "-march=native", *(["-ffast-math"] if fast_math else [])]
        command = [compiler, *flags, "-shared", "-fPIC", str(file), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise PeerMissingError(f"the C compiler failed: {done.stderr.strip()[:200]}")
        function = ctypes.CDLL(str(library)).run
    pointer = np.ctypeslib.ndpointer(float, flags="C_CONTIGUOUS")
    function.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_double, pointer, pointer, pointer]
    function.restype = ctypes.c_double

    def run(steps: int, h: float, x: Any, v: Any) -> tuple[np.ndarray, np.ndarray]:
        x, v = (np.array(np.broadcast_to(part, (lanes, n)), float) for part in (x, v))
        function(steps, lanes, h, x, v, parameters)
        return x, v

    return run
