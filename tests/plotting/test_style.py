"""Words, symbols and units of axes."""

import numpy as np
import pytest
import xarray as xr
from drawn import SCALES

from jaxchain.plotting.style import axis, value_of


@pytest.mark.parametrize(
    ("name", "unit", "plain", "factor", "label"),
    [
        ("amplitude", "x0", "–", 0.05, "vibration amplitude $A_n$ (m)"),
        ("energy", "x0^2", "–", 0.0025, "vibration energy $E$ (m²)"),
        ("time", "1 / omega_n", "–", 0.1, "time $t$ (s)"),
        ("friction_force", "P", "–", 10.0, "friction force $F$ (N)"),
        ("mine", "percent", "percent", 1.0, "mine (percent)"),
        ("active_count", "1", None, 1.0, "vibrating oscillators"),
    ],
)
def test_an_axis_has_words_symbol_and_unit(name, unit, plain, factor, label):
    dimensionless = axis(name, {"units": unit}, None)
    assert dimensionless[0] == 1.0
    assert dimensionless[1].endswith(f"({plain})" if plain else "oscillators")
    found, text = axis(name, {"units": unit}, SCALES)
    assert found == pytest.approx(factor, rel=1e-14)
    assert text == label


def test_a_value_is_told_with_its_symbol_or_its_name():
    speed = xr.DataArray(1.5, name="belt_speed", attrs={"units": "x0 omega_n"})
    assert value_of(speed, None) == r"$\tilde v_d$ = 1.5"
    assert value_of(speed, SCALES) == "$v_d$ = 0.75 m/s"
    assert value_of(xr.DataArray(np.int64(3), name="seed"), None) == "seed = 3"
    assert value_of(xr.DataArray("dry", name="law"), None) == "law = dry"
