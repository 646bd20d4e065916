"""Every example in a docstring runs and prints what it says."""

import doctest
import importlib
import pkgutil

import pytest

import jaxchain

MODULES = [
    "jaxchain",
    *(module.name for module in pkgutil.walk_packages(jaxchain.__path__, "jaxchain.")),
]
# Their examples compile the integration of a period and its tangents, each for some ten seconds.
COSTLY = {
    "boundaries.bistable",
    "solvers.step_control",
    "sweeps.sweeping",
    "simulation.event_driven",
    "boundaries.overview",
    "cycles.search",
    "cycles.guesses",
    "inverse.optimal_design",
    "boundaries.zero_width",
    "cycles.floquet",
    "boundaries.fold",
    "boundaries.bautin",
    "boundaries.grazing",
    "boundaries.hopf",
    "boundaries.descent",
    "boundaries.hopf_scan",
    "inverse.identification",
    "boundaries.criticality",
    "inverse.measurements",
    "boundaries.single_mass",
    "model.sliding",
}


def _cost(name: str) -> object:
    costly = name.removeprefix("jaxchain.") in COSTLY
    return pytest.param(name, marks=pytest.mark.long) if costly else name


@pytest.mark.parametrize("name", [_cost(name) for name in MODULES])
def test_the_examples_of_a_module_print_what_they_say(name):
    outcome = doctest.testmod(importlib.import_module(name))
    assert outcome.failed == 0
