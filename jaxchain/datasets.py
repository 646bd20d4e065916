"""Datasets: variables with names, units and meanings, and the only writer of labelled results.

The attributes that say how numbers were computed are in `jaxchain.model.provenance`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

if TYPE_CHECKING:
    import xarray as xr

# A count that may be missing is written as an integer, and a missing one as this.
_COUNT = {"dtype": "int64", "_FillValue": -1}


class Variable(eqx.Module):
    """A variable of a dataset, such as a value of an observer.

    **Arguments:** `values`, with an axis for each name in `dims`; "oscillator" is the one over all
    n masses.  `units` and `long_name`, as in the CF conventions; texts and truth values have the
    units None.  `is_count`: a count is an integer on disk; it is missing if it is NaN, and for
    failed runs.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, sweep
        >>> from jaxchain.observers import AbstractObserver, Variable
        >>> class Sticking(AbstractObserver):  # the most masses that stick as a step ends
        ...     def init(self, field, t0, t1, y0):
        ...         return jnp.zeros((), int)
        ...     def update(self, accumulator, step):
        ...         return jnp.maximum(accumulator, (step.y1[1] == step.field.belt_speed).sum())
        ...     def read(self, accumulator):
        ...         return accumulator
        ...     def label(self, value, model):
        ...         most = Variable(value, long_name="most masses that stuck", is_count=True)
        ...         return {"stuck": most}
        >>> chain = paper_chain(3, belt_speed=1.0, width=None)
        >>> data = sweep(chain, equation_8, 60.0, over={"excited": [0, 3]}, observe=Sticking())
        >>> data.stuck.values.tolist(), data.stuck.attrs["long_name"]
        ([0.0, 2.0], 'most masses that stuck')
    """

    values: Any
    dims: tuple[str, ...] = eqx.field(static=True, default=())
    units: str | None = eqx.field(static=True, default="1")
    long_name: str | None = eqx.field(static=True, default=None)
    is_count: bool = eqx.field(static=True, default=False)


def dataset(
    variables: Mapping[str, Variable],
    coords: Mapping[str, Any] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """A dataset of labelled variables.

    **Arguments:** `coords`: each a `Variable`, or anything that xarray takes for a coordinate;
    `attrs`: the attributes of the dataset, see `jaxchain.model.provenance.provenance_of`.

    >>> amplitude = Variable([1.5, 0.1], ("oscillator",), "x0", "amplitude")
    >>> data = dataset({"amplitude": amplitude}, {"oscillator": oscillators(2)})
    >>> data.amplitude.sel(oscillator=1).item(), data.amplitude.attrs
    (1.5, {'long_name': 'amplitude', 'units': 'x0'})
    """
    import xarray as xr  # it imports pandas, which would double the time of `import jaxchain`

    def written(named: Mapping[str, Any]) -> dict[str, Any]:
        return {k: labelled(v) if isinstance(v, Variable) else v for k, v in named.items()}

    return xr.Dataset(written(variables), coords=written(coords or {}), attrs=attrs)


def labelled(variable: Variable) -> xr.Variable:
    """One variable as xarray has it."""
    import xarray as xr

    attrs = {"long_name": variable.long_name, "units": variable.units}
    values = np.asarray(variable.values)
    may_be_missing = variable.is_count and np.issubdtype(values.dtype, np.floating)
    return xr.Variable(
        variable.dims,
        values,
        {name: text for name, text in attrs.items() if text is not None},
        _COUNT if may_be_missing else None,
    )


def along(variables: Mapping[str, Variable], *dims: str, prefix: str = "") -> dict[str, Variable]:
    """The variables with `dims` before their own dimensions, and `prefix` before their names."""
    return {
        prefix + name: replace(variable, dims=(*dims, *variable.dims))
        for name, variable in variables.items()
    }


def oscillators(n: int, units: str | None = None) -> Variable:
    """The coordinate of the masses or cells, counted from 1."""
    return Variable(np.arange(1, n + 1), ("oscillator",), units, "oscillator n")
