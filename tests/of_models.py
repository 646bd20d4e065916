"""The public functions that take a model: no table of them may forget one."""

import inspect
import re

import jaxchain


def functions_of_a_model() -> set[str]:
    """Names of all public functions with an argument `chain` or `model` that do not show it."""
    shows = ("plotting", "explorer")
    submodules = [getattr(jaxchain, name) for name in jaxchain.SUBMODULES if name not in shows]
    public = [getattr(m, name) for m in (jaxchain, *submodules) for name in m.__all__]
    functions = [f for f in public if inspect.isfunction(f) or hasattr(f, "__wrapped__")]
    functions = [f for f in functions if f.__module__.split(".")[1] not in shows]
    return {
        f.__name__
        for f in functions
        for name, of in inspect.signature(f).parameters.items()
        if name in ("chain", "model") and not re.search("PhaseModel|str", str(of.annotation))
    }
