"""A structured Rosenbrock method for rings in C: what one would write by hand, for one chain.

The arithmetic of a step of `Rodas4` or `Rodas5P` and the step-size control of `simulate`, as a C
compiler makes them.  Shows how far jaxchain is from what the machine can do.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from peers import CompiledRing
from timing import Skipped

from jaxchain.simulation.method import MAX_STEP
from jaxchain.solvers import step_control

SOURCE = """
#include <math.h>
#include <string.h>

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

/* Advances x and v; returns the sum of the squared errors, each over its tolerance. */
static double step(double h, double rtol, double *x, double *v, const double *p) {{
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
            sum += step(h, 1, x + {n} * lane, v + {n} * lane, p + 8 * lane);
    return sum;
}}

/* The longest next step: see SwitchingController. `before` and `now` are (x, v). */
static double longest(double h, const double (*before)[{n}], const double *x, const double *v,
                      const double *p) {{
    double bound = {max_step!r};
    for (int i = 0; i < {n}; i++) {{
        double w = v[i] - p[0], change = v[i] - before[1][i], size = fabs(w) / p[1];
        double rate = fabs(change) / h, mean = rate;
        if (w * change < 0 && size > {NEAR!r}) {{
            double way = fabs(w) - {LANDING!r} * p[1];
            double bend = 6 / (h * h)
                * (0.5 * (v[i] + before[1][i]) - (x[i] - before[0][i]) / h);
            double curve = w > 0 ? -bend : bend, speed = rate + curve * h;
            double root = speed + sqrt(fmax(speed * speed + 4 * curve * way, 0));
            if (speed > 0) mean = fmin(fmax(0.5 * root, 0.5 * rate), 2 * rate);
            bound = fmin(bound, way / mean);
        }} else if (w * change < 0) {{
            bound = fmin(bound, {CROSSING!r} * p[1] / rate);
        }} else if (w * change > 0 && size > {CREEPS!r} && size < {RELEASED!r}) {{
            bound = fmin(bound, {CREEP!r} * p[1] / rate);
        }}
    }}
    return bound;
}}

/* Integrates `lanes` chains to t1, each with its own steps. */
void integrate(long lanes, double t1, double rtol, double *x, double *v, const double *p) {{
    for (long lane = 0; lane < lanes; lane++, x += {n}, v += {n}, p += 8) {{
        double t = 0, h = 1e-3, before[2][{n}], last_error = 1;
        while (t < t1) {{
            int last = t + h >= t1 * (1 - 1e-14);
            if (last) h = t1 - t;
            memcpy(before[0], x, sizeof before[0]);
            memcpy(before[1], v, sizeof before[1]);
            double error = sqrt(step(h, rtol, x, v, p) / (2 * {n}));
            double factor = 0.9 * pow(error, -1.0 / {order}) * pow(last_error, {p} / {order});
            if (error <= 1) {{
                t = last ? t1 : t + h;
                last_error = error;
                h = fmin(h * fmin(10, fmax(1, factor)), longest(h, before, x, v, p));
            }} else {{ /* or not a number */
                memcpy(x, before[0], sizeof before[0]);
                memcpy(v, before[1], sizeof before[1]);
                h *= error > 1 ? fmin(0.9, fmax(0.2, factor)) : 0.2;
            }}
        }}
    }}
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
        double ex = h * ({total(tab.beta[-1], tab.alpha[-1])}), ev = b[{stages - 1}][i];
        double xn = x[i - 1] + h * ({total(tab.end_b, tab.end_v)});
        double vn = v[i - 1] + {total(tab.a[-1])} + ev;
        double w = v[i - 1] - p[0], after = vn - p[0], change = fabs(after - w);
        if (fabs(w) < {step_control.FREE} * p[1] && fabs(after) > {step_control.RELEASED} * p[1]
                && after * (after - w) > 0)
            ev *= fmax(1, {step_control.SHARE} * p[5] * h
                / fmax(change, {step_control.STILL} * p[1]));
        ex /= rtol * (0.1 + fmax(fabs(x[i - 1]), fabs(xn)));
        ev /= rtol * (0.1 + fmax(fabs(v[i - 1]), fabs(vn)));
        sum += ex * ex + ev * ev;
        x[i - 1] = xn;
        v[i - 1] = vn;
    }}""")
    numbers = vars(step_control) | {"max_step": MAX_STEP, "p": 0.3}
    numbers |= {"n": n, "stages": stages, "gamma": tab.gamma, "order": solver.order(None)}
    return SOURCE.format(body="\n".join(lines), **numbers)


class CompiledMethod:
    """The method for several homogeneous rings, a lane each; states have shape (2, lanes, n).

    The flag -ffast-math lets the compiler reorder sums and use vector exponentials.
    """

    def __init__(self, chains: Sequence[Any], solver: Any, *flags: str):
        compiler = shutil.which("gcc") or shutil.which("cc")
        if compiler is None:
            raise Skipped("no C compiler found")
        self.shape = len(chains), chains[0].n
        self.parameters = np.concatenate([CompiledRing.parameters(chain) for chain in chains])
        with tempfile.TemporaryDirectory() as folder:
            file, library = Path(folder, "step.c"), Path(folder, "step.so")
            file.write_text(source(chains[0].n, solver))
            options = ["-O3", "-march=native", *flags, "-shared", "-fPIC", "-o", str(library)]
            subprocess.run([compiler, str(file), *options, "-lm"], check=True)
            self.library = ctypes.CDLL(str(library))
        pointer = np.ctypeslib.ndpointer(float, flags="C_CONTIGUOUS")
        number, state = [ctypes.c_double], [pointer, pointer, pointer]
        self.library.run.argtypes = [ctypes.c_long, ctypes.c_long, *number, *state]
        self.library.run.restype = ctypes.c_double
        self.library.integrate.argtypes = [ctypes.c_long, *number, *number, *state]
        self.library.integrate.restype = None

    def steps(self, count: int, h: float, x: Any, v: Any) -> np.ndarray:
        """(x, v) after `count` steps h."""
        state = np.array([np.broadcast_to(part, self.shape) for part in (x, v)], float)
        self.library.run(count, self.shape[0], h, state[0], state[1], self.parameters)
        return state

    def integrate(self, t1: float, rtol: float, x: Any, v: Any) -> np.ndarray:
        """(x, v) at t1, with the step sizes that `simulate` would take."""
        state = np.array([np.broadcast_to(part, self.shape) for part in (x, v)], float)
        self.library.integrate(self.shape[0], t1, rtol, state[0], state[1], self.parameters)
        return state
