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


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_print_what_they_say(name):
    outcome = doctest.testmod(importlib.import_module(name))
    assert outcome.failed == 0
