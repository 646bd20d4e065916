"""Pictures on axes of their own belong to `pyplot`, which keeps them until they are closed."""

import pytest
from matplotlib import pyplot as plt


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")
