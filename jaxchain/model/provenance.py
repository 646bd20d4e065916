"""The provenance of numbers, as attributes that NetCDF can hold: chain, versions, time.

Every dataset of a sweep or a branch has them.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import importlib.metadata
import json
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .. import __version__
from .chain import Chain
from .friction import AbstractFrictionLaw, TanhFriction
from .model import AbstractModel
from .parameters import CHAIN


def versions() -> dict[str, str]:
    """The versions of jaxchain and of the packages that it computes with."""
    return dict(_versions())


@functools.cache  # looking them up takes longer than a small sweep
def _versions() -> dict[str, str]:
    packages = ("jax", "jaxlib", "diffrax", "equinox", "numpy")
    below = {package: importlib.metadata.version(package) for package in packages}
    return {"jaxchain": __version__, **below, "python": platform.python_version()}


def parameters_of(field: AbstractModel, n: int, swept: Sequence[str]) -> str:
    """The parameters of a chain and of its friction as JSON; "swept" for the swept ones.

    For other oscillators: their class, their number n and their `parameters`.
    """
    parameters = field.description(n)
    plain = {
        k: np.asarray(v).tolist() if hasattr(v, "shape") else v for k, v in parameters.items()
    }

    def leaves(part: Any) -> list[Any]:  # of a law that holds a neural network
        return [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(part)]

    plain |= {name: "swept" for name in swept if name in parameters}
    return json.dumps(plain, default=leaves)


def provenance_of(
    model: AbstractModel, n: int, swept: Sequence[str], **more: Any
) -> dict[str, Any]:
    """The attributes of a dataset: `parameters_of` the model, `more`, versions, device, time."""
    return {
        "parameters": parameters_of(model, n, swept),
        **more,
        "versions": json.dumps(versions()),
        "platform": jax.default_backend(),
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def chain_of(parameters: Mapping[str, Any]) -> Chain | None:
    """The chain with the numbers of `parameters_of`; None for a law of another package."""
    named = parameters.get("friction_law")
    laws = [law for law in AbstractFrictionLaw.__subclasses__() if law.__name__ == named]
    kind = next((law for law in laws if law.__module__.startswith(f"{__package__}.")), None)
    if kind is None:
        return None
    given: dict[str, Any] = {
        k: np.asarray(v) if isinstance(v, list) else v for k, v in parameters.items()
    }
    names = [field.name for field in dataclasses.fields(kind) if field.init]
    table = given.get("friction_table")
    if table is None and any(name not in given for name in names):  # another class with this name
        return None
    law = kind(*[given[name] for name in names] if table is None else table)
    if given["width"] is not None:
        law = TanhFriction(law, given["width"])
    return Chain(given["n"], law, ends=given["ends"], **{name: given[name] for name in CHAIN})
