"""The present state of a session as a link, a scene file, a program and a table."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

import jaxchain

from ..model.contacts import Contact, Stop
from ..model.drives import OfTime, Table
from ..model.friction import AbstractFriction
from ..model.mechanical import Added
from ..scenes.files import to_toml
from ..scenes.tables import LAWS, LEAST
from .session import OTHER_WIDTH, WINDOW, WINDOWS, Session

_SNIPPET = '''\
"""A state found in the explorer of jaxchain {version}."""
import jax.numpy as jnp

import jaxchain

jaxchain.configure()
from jaxchain import Amplitude, simulate
{imports}

model = {model}
state = (
    {state},
)
t = {t!r}

# It goes on as in the explorer:
run = simulate(model, state, t + {window!r}, t0=t, observe=Amplitude())
print(run.observed)
'''


def _arguments(value: Any) -> dict[str, Any]:
    """The arguments of the constructor that made it, but for those that are None."""
    pairs = ((name, getattr(value, name)) for name in inspect.signature(type(value)).parameters)
    return {name: part for name, part in pairs if part is not None}


def _source(value: Any, imports: set[str]) -> str:
    """A model, or a part of one, as the expression that makes it, to the last digit."""
    if isinstance(value, str | int | float | bool | None):
        return repr(value)
    if isinstance(value, jax.Array | np.ndarray):
        text = repr(np.asarray(value).tolist())
        return f"jnp.array({text})" if np.ndim(value) else text
    if isinstance(value, tuple):
        return f"({''.join(f'{_source(part, imports)}, ' for part in value)})"
    if isinstance(value, Mapping):
        pairs = (f"{k!r}: {_source(part, imports)}" for k, part in value.items())
        return f"{{{', '.join(pairs)}}}"
    kind = type(value)
    if inspect.isroutine(value) or kind.__module__.startswith("jax."):
        raise ValueError(
            "This model holds a function of yours, which cannot be written down: build it by your "
            "own code, and take the state and the parameters from the link."
        )
    own = kind.__module__.partition(".")[0] != jaxchain.__name__
    home = jaxchain.__name__ if kind.__name__ in dir(jaxchain) else kind.__module__
    imports.add(f"from {kind.__module__ if own else home} import {kind.__name__}")
    parts = (f"{name}={_source(part, imports)}" for name, part in _arguments(value).items())
    return f"{kind.__name__}({', '.join(parts)})"


def snippet(session: Session) -> str:
    """A program that makes the model and the present state, the same numbers to the last digit.

    **Raises:** `ValueError` for a model that holds a function.
    """
    imports: set[str] = set()
    model = _source(session.model, imports)
    rows = ",\n    ".join(_source(np.asarray(part), imports) for part in session.run.state)
    return _SNIPPET.format(
        version=jaxchain.__version__, imports="\n".join(sorted(imports)), model=model, state=rows,
        t=session.run.t, window=WINDOW * session.run.unit,
    )  # fmt: skip


def scene(session: Session) -> str:
    """A scene file that begins with the present state.

    **Raises:** `ValueError` for a model that no scene names, or that holds functions.
    """
    model, state = session.model, [_listed(part) for part in session.run.state]
    table: dict[str, Any] = {"kind": type(model).__name__, "n": session.n}
    for name, part in _arguments(model).items():
        if isinstance(part, tuple) and not part:
            continue
        try:
            table[name] = _entry(part)
        except ValueError as error:
            raise ValueError(
                f"`{name}` of `{table['kind']}` cannot stand in a scene file: take the program."
            ) from error
    time = {"transient": 0.0, "window": WINDOW * session.run.unit}
    experiment: dict[str, Any] = {"model": table, "time": time}
    if model.dry:
        experiment["numerics"] = {"model": "dry"}
    if table["kind"] == "Chain":
        table["friction"].setdefault("width", OTHER_WIDTH)
        rest = np.asarray(model.equilibrium()[0])
        experiment["initial"] = {
            "kind": "excited", "excited": session.n, "pattern": "in-phase",
            "displacement": _listed(state[0] - rest), "velocity": state[1],
        }  # fmt: skip
    else:
        names = [variable.name for variable in model.variables] or map(str, range(len(state)))
        experiment["initial"] = dict(zip(names, state, strict=True))
        factors = {
            name: [float(part.factor)] for name, part in (vars(model).get("plus") or {}).items()
        }
        axis = {session.axis: [session.value(str(session.axis))]} if session.axis else {}
        experiment["sweep"] = factors | axis
    title = "A state found in the explorer"
    return to_toml({"title": title, "experiment": {"present": experiment}}) + "\n"


def _listed(part: Any) -> Any:
    """The numbers of an array for a scene, with tiny ones as 0."""
    return np.where(np.abs(part) < LEAST, 0.0, part).tolist()


def _entry(part: Any) -> Any:
    """What a scene has for an argument of a model, or of a part of one."""
    if isinstance(part, str | int | float):
        return part
    if isinstance(part, jax.Array | np.ndarray):
        return _listed(part)
    if isinstance(part, AbstractFriction):
        names = {kind: name for name, kind in LAWS.items()}
        numbers = {k: np.asarray(v).tolist() for k, v in part.parameters().items()}
        friction: Any = part
        return {"law": names.get(type(friction.law), "custom"), **numbers}
    if isinstance(part, tuple):
        return [_entry(one) for one in part]
    if isinstance(part, Mapping):
        return {name: _entry(one) for name, one in part.items()}
    if isinstance(part, Added):  # its factor is swept
        return _entry(part.matrices)
    if isinstance(part, OfTime):
        return _entry(part.function)
    if isinstance(part, Contact | Stop | Table):
        return {name: _entry(one) for name, one in _arguments(part).items()}
    raise ValueError(f"A scene has no `{type(part).__name__}`.")


def link(session: Session) -> dict[str, str]:
    """The query of a link: each slider, the mass that is shown, and the state."""
    query = {slider.name: repr(session.value(slider.name)) for slider in session.sliders}
    rows = (" ".join(map(repr, np.asarray(part).tolist())) for part in session.run.state)
    return query | {"mass": str(session.mass + 1), "state": ";".join(rows)}


def follow_link(session: Session, query: Mapping[str, str]) -> None:
    """Sets what the query of a link names, as numbers alone.

    **Raises:** `ValueError` for anything else than numbers, and as `Session.change`.
    """
    known = [slider.name for slider in session.sliders]
    changes = {}
    for name, text in query.items():
        if name in ("mass", "state"):
            continue
        if name not in known:
            raise ValueError(f"The link names `{name}`, but the parameters are {known}.")
        try:
            changes[name] = float(text)
        except ValueError:
            raise ValueError(f"The link has `{name}` = {text!r}, which is no number.") from None
    session.change(**changes)
    if (mass := query.get("mass", "1")).isdecimal() and "mass" in query:
        session.mass = min(max(int(mass) - 1, 0), session.n - 1)
    if "state" in query:
        session.restart_from("typed", typed=query["state"])


def table(session: Session) -> str:
    """The samples of the last four windows as CSV: a column for each variable of each mass."""
    times, parts = session.run.window(WINDOWS * WINDOW)
    names = [session.model.variable(k).name for k in range(len(session.run.state))]
    head = [f"{name}_{i + 1}" for name in names for i in range(session.n)]
    rows = np.column_stack([times, *parts[2:]])
    lines = [",".join(["time", *head]), *(",".join(map(repr, row)) for row in rows.tolist())]
    return "\n".join(lines) + "\n"
