"""Variables as datasets: labels, dimensions, and counts on disk."""

import numpy as np
import pytest

from jaxchain.datasets import Variable, along, dataset, oscillators


def test_variables_get_dimensions_and_a_prefix():
    table = {"amplitude": Variable(np.ones((4, 2)), ("oscillator",), "x0", "amplitude")}
    special = along(table, "special", prefix="special_")
    data = dataset(special, {"oscillator": oscillators(2), "special": np.arange(4)}, {"n": 2})
    assert data.special_amplitude.dims == ("special", "oscillator")
    assert data.oscillator.values.tolist() == [1, 2]
    assert data.attrs == {"n": 2}
    assert table["amplitude"].dims == ("oscillator",)


@pytest.mark.parametrize(("values", "kind"), [([1.0, np.nan], np.float64), ([1, 2], np.int64)])
def test_a_count_is_an_integer_on_disk_and_missing_only_if_it_may_be(values, kind):
    data = dataset({"count": Variable(np.array(values), ("point",), is_count=True)})
    assert data["count"].dtype == kind
    may_be_missing = {"dtype": "int64", "_FillValue": -1} if kind is np.float64 else {}
    assert data["count"].encoding == may_be_missing
