"""One Rosenbrock step of a ring in C: the arithmetic of `Rodas4`, as a C compiler makes it.

Shows how far the step is from what the machine can do.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from peers import CompiledRing
from timing import Skipped

SOURCE = """
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


def source(n: int, solver: Any) -> str:
    """The C source of a step for rings of n masses; all loops over masses and stages unrolled."""
    tab, stages = solver.tableau, len(solver.tableau.c)

    def total(weights: Any, lead: float | str = "0.0") -> str:
        lead = lead if isinstance(lead, str) else f"{float(lead)!r} * v[i - 1]"
        return " + ".join(
            [lead, *(f"{float(w)!r} * b[{m}][i]" for m, w in enumerate(weights) if w != 0.0)]
        )

    masses = f"    for (int i = 1; i <= {n}; i++)"
    lines = []
    for j in range(stages):
        if j == 0:
            lines.append(f"""{masses} {{
        double slope;
        g[i] = force_and_slope(v[i - 1], p, &slope);
        inverse[i] = 1 / (per_h / {tab.gamma!r} - slope + hg * k);
    }}""")
        else:
            lines.append(f"{masses} g[i] = force({total(tab.a[j, :j], 'v[i - 1]')}, p);")
        lines.append(f"""\
{masses} z[i] = x[i - 1] + h * ({total(tab.stage_b[j, :j], tab.stage_v[j])});
    ghosts(z);
{masses} u[i] = start[i] = inverse[i] * (
        g[i] - k * z[i] + per_h * ({total(tab.C[j, :j])}) + p[3] * (z[i - 1] + z[i + 1]));""")
        origin, other = "u", "z"
        for sweep in range(solver.sweeps):
            target = f"b[{j}]" if sweep == solver.sweeps - 1 else other
            lines.append(f"""\
    ghosts({origin});
{masses} {target}[i] = start[i] + hg * p[3] * inverse[i] * ({origin}[i - 1] + {origin}[i + 1]);""")
            origin, other = other, origin
    lines.append(f"""{masses} {{
        double e = h * ({total(tab.beta[-1], tab.alpha[-1])});
        sum += e * e + b[{stages - 1}][i] * b[{stages - 1}][i];
        x[i - 1] += h * ({total(tab.end_b, tab.end_v)});
        v[i - 1] += {total(tab.a[-1])} + b[{stages - 1}][i];
    }}""")
    return SOURCE.format(n=n, stages=stages, gamma=tab.gamma, body="\n".join(lines))


def compiled_steps(chains: Sequence[Any], solver: Any, *flags: str) -> Callable[..., np.ndarray]:
    """A function (steps, h, x, v) -> (x, v), of shape (2, lanes, n), one homogeneous ring a lane.

    The flag -ffast-math lets the compiler reorder sums and use vector exponentials.
    """
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise Skipped("no C compiler found")
    shape = len(chains), chains[0].n
    parameters = np.concatenate([CompiledRing.parameters(chain) for chain in chains])
    with tempfile.TemporaryDirectory() as folder:
        file, library = Path(folder, "step.c"), Path(folder, "step.so")
        file.write_text(source(chains[0].n, solver))
        options = ["-O3", "-march=native", *flags, "-shared", "-fPIC", "-o", str(library)]
        subprocess.run([compiler, str(file), *options, "-lm"], check=True)
        function = ctypes.CDLL(str(library)).run
    pointer = np.ctypeslib.ndpointer(float, flags="C_CONTIGUOUS")
    function.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_double, pointer, pointer, pointer]
    function.restype = ctypes.c_double

    def run(steps: int, h: float, x: Any, v: Any) -> np.ndarray:
        state = np.array([np.broadcast_to(part, shape) for part in (x, v)], float)
        function(steps, shape[0], h, state[0], state[1], parameters)
        return state

    return run
