"""jaxchain: differentiable simulation of friction-excited oscillator chains on JAX.

The most-used names can be imported from `jaxchain`; the rest live in submodules:

- `model`: the chain: masses on a moving belt, springs, friction, initial states
- `continuation`: roots of equations, their derivatives, and branches of solutions
- `kinds`: special points of cycles, on branches and on curves
- `observers`: quantities to measure along a run
- `solvers`: structured Rosenbrock methods and step-size control
- `simulation`: one run, smoothed or dry
- `sweeps`: ensembles, as labelled datasets
- `cycles`: limit cycles, Floquet multipliers, branches of cycles
- `boundaries`: where vibration sets in (Hopf), and up to which belt speed it survives (fold)
- `chaos`: Lyapunov exponents and verdicts
- `localization`: patterns, fronts, mistuning
- `basins`: how likely each state is, and how hard a blow starts vibration
- `inverse`: design and identification
- `plotting`: figures, drawings, films
- `scenes`: experiments as TOML files
- `explorer`: a live run in the browser, with sliders, pictures and searches

`help(jaxchain.boundaries)` lists the files and names of a submodule.  Names are imported on first
use.
"""

import sys
from typing import Any

import lazy_loader

__version__ = "0.2.0"

SUBMODULES = (
    "model", "continuation", "kinds", "observers", "solvers", "simulation", "sweeps", "cycles",
    "boundaries", "chaos", "localization", "basins", "inverse", "plotting", "scenes", "explorer",
)  # fmt: skip

_show, __dir__, _shown = lazy_loader.attach_stub(__name__, __file__)
__all__ = [name for name in _shown if name not in SUBMODULES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """A name of the top level, or an error that names its submodule."""
    if name in _shown:
        return _show(name)
    if not name.startswith("_"):
        for submodule in SUBMODULES:
            if name in getattr(_show(submodule), "__all__", ()):
                message = f"{__name__}.{name} moved to {__name__}.{submodule}.{name}"
                # `from jaxchain import name` would replace the message of an AttributeError by its
                # own.
                if sys._getframe(1).f_globals.get("__name__") == "importlib._bootstrap":
                    raise ImportError(message)
                raise AttributeError(message)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
