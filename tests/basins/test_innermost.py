"""The innermost unstable cycle: which one it is, and where there is none."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxchain as jc
from jaxchain.basins.innermost import find_innermost
from jaxchain.basins.turns import Mass
from jaxchain.model import AbstractFrictionLaw, Chain
from jaxchain.result import SearchResult, name_of


class Wavy(AbstractFrictionLaw):
    """About a belt speed of 1.5 friction feeds and takes by turns: cycles of 0.5, 0.8 and 1.1."""

    mu_static: float
    share: float

    def coefficient(self, speed):
        # What v^(2 k + 1) works over a period, v = A cos(theta), is A^(2 k + 1) over these.
        shares = 1.0, 0.75, 0.625, 35.0 / 64.0
        p, q, r = 0.25, 0.64, 1.21  # roots of the work as a function of A^2
        weights = -p * q * r, p * q + q * r + r * p, -(p + q + r), 1.0

        def wave(u):
            terms = [
                w / c * u ** (2 * k + 1)
                for k, (w, c) in enumerate(zip(weights, shares, strict=True))
            ]
            return sum(terms) * jnp.exp(-((u / 1.8) ** 16))

        return self.mu_static + self.share * (wave(1.5 - speed) - wave(1.5))


@pytest.mark.long
def test_of_nested_cycles_it_is_the_innermost_unstable_one():
    """Three cycles round each other: unstable, stable, unstable; the stable one slips only."""
    chain = Chain(1, Wavy(1.0, 0.02), belt_speed=1.5, damping_ratio=1e-9)
    found = find_innermost(Mass.of(chain))
    assert bool(found.result == SearchResult.successful)
    assert float(found.fastest) == pytest.approx(0.5, abs=0.02)
    x, _ = jc.steady_sliding(chain)
    for share_of, amplitude in ((0.97, 0.0), (1.03, 0.8)):
        start = x, jnp.full(1, share_of * float(found.fastest))
        run = jc.simulate(chain, start, 6000.0, observe=jc.Amplitude(window=20.0))
        assert float(run.observed[0]) == pytest.approx(amplitude, abs=0.05)


@pytest.mark.long
@pytest.mark.parametrize("width", [1e-5, 1e-3, 1e-2, 0.1])
def test_it_ends_where_the_fold_is(width):
    chain = jc.paper_chain(1, 1.5, width)
    fold = float(jc.fold_belt_speed(chain))
    below, above = (
        find_innermost(Mass.of(chain.with_(belt_speed=fold + off))) for off in (-1e-7, 1e-7)
    )
    assert 0.7 * fold < float(below.fastest) < fold
    assert np.isnan(above.fastest)
    assert float(above.share_of_plane) == 1.0
    assert name_of(above.result) == "successful"
