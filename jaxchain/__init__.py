"""jaxchain: differentiable simulation of friction-excited oscillator chains on JAX.

What most scripts need stands here.  Everything else stands in its submodule:

- `model`: the chain: masses on a moving belt, springs, friction, initial states
- `continuation`: equations of any kind: roots, derivatives, branches of solutions
- `observers`: what is watched along a run
- `solvers`: how a step is made
- `simulation`: one run, smoothed or with true dry friction
- `sweeps`: ensembles, as labelled datasets
- `cycles`: limit cycles, Floquet multipliers, branches of cycles
- `boundaries`: where vibration starts (Hopf) and where it can survive (fold)
- `chaos`: Lyapunov exponents and verdicts
- `localization`: patterns, fronts, mistuning
- `basins`: how likely each state is, and how hard one must push
- `inverse`: design and identification
- `plotting`: figures, drawings, films
- `scenes`: experiments as TOML files

`help(jaxchain.boundaries)` lists a submodule's files and names.  Nothing is imported before it is
asked for.
"""

import sys
from typing import Any

import lazy_loader

__version__ = "0.2.0"

SUBMODULES = (
    "model", "continuation", "observers", "solvers", "simulation", "sweeps", "cycles",
    "boundaries", "chaos", "localization", "basins", "inverse", "plotting", "scenes",
)  # fmt: skip

_show, __dir__, _shown = lazy_loader.attach_stub(__name__, __file__)
__all__ = [name for name in _shown if name not in SUBMODULES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """A name of this module, or where else it stands."""
    if name in _shown:
        return _show(name)
    if not name.startswith("_"):
        for submodule in SUBMODULES:
            if name in getattr(_show(submodule), "__all__", ()):
                message = f"{__name__}.{name} moved to {__name__}.{submodule}.{name}"
                # `from jaxchain import name` asks whether it is there, and would hide the words of
                # an AttributeError.
                if sys._getframe(1).f_globals.get("__name__") == "importlib._bootstrap":
                    raise ImportError(message)
                raise AttributeError(message)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
