"""The basin of steady sliding of one mass against SciPy, runs, differences, and itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxchain as jc
from jaxchain.basins import Box, blow_of_one_mass, sliding_basin, sliding_share
from jaxchain.model import Chain, GaussianStribeck
from jaxchain.result import name_of

from .planes import Plane

# Belt speeds, and about how far to the right of rest the unstable cycle goes.
CYCLES = {1.16: 0.187, 1.3: 0.79, 1.45: 1.15, 1.6: 1.44, 1.75: 1.70, 1.83: 1.84}
SMALL = 1e-5
# With a load, so that all that is asked about them is compiled once.
DRY, WIDE = (jc.paper_chain(1, 1.5, width).with_(normal_load=1.0) for width in (None, 1e-2))


@eqx.filter_jit
def slopes(chain, box):
    """(share, its derivatives in every number of the chain and in the box's edges)."""
    return jax.value_and_grad(lambda given: sliding_share(*given))((chain, box))


@eqx.filter_jit
def basin(chain, box):
    return sliding_basin(chain, box)


def share(chain, box=None):
    return float(basin(chain, Box() if box is None else box).share)


def right_of(plane, about):
    return plane.cycle(0.9 * about, 1.1 * about)


@pytest.mark.parametrize("speed", CYCLES)
def test_the_share_is_that_of_another_quadrature(speed):
    plane = Plane.paper(speed)
    right = right_of(plane, CYCLES[speed])
    found = basin(DRY.with_(belt_speed=speed), Box())
    assert bool(found.successful)
    assert float(found.share) == pytest.approx(plane.area(right, (-2, 2), (0, 2)) / 8, abs=1e-11)
    up, down = plane.at_rest(right)
    assert float(found.up) == pytest.approx(up, abs=1e-9)
    assert float(found.down) == pytest.approx(down, abs=1e-9)
    assert float(found.gap) < 1e-12


@pytest.mark.parametrize("speed", [1.2, 1.5])
@pytest.mark.parametrize("width", [None, 0.05])
def test_edges_of_the_box_may_cut_the_cycle_anywhere(speed, width):
    plane = Plane.paper(speed, width)
    chain = (DRY if width is None else WIDE.with_(width=width)).with_(belt_speed=speed)
    cycle = basin(chain, Box())
    about = 0.45 if speed == 1.2 else 1.3
    right = right_of(plane, about)
    for x, v in (((-0.4, 0.7), (-0.3, 0.2)), ((0.6, 3.0), (-2.0, -0.1)), ((0.5, 0.6), (0, 0.1))):
        found = basin(chain, Box(x, v))
        assert float(found.area) == pytest.approx(plane.area(right, x, v), abs=1e-10)
        assert float(found.up) == float(cycle.up)


@pytest.mark.parametrize("chain", [DRY, pytest.param(WIDE, marks=pytest.mark.long)])
@pytest.mark.parametrize("speed", [1.16, 1.6, 1.78])
def test_it_has_its_derivatives_in_every_number_and_in_the_edges(chain, speed):
    # The load moves Hopf and fold.
    chain = chain.with_(belt_speed=1.05 * speed, normal_load=1.1)
    box = Box((-1.5, 1.0), (-0.1, 0.9))
    value, (by_chain, by_box) = slopes(chain, box)
    assert 0.0 < float(value) < 1.0
    numbers = chain.numbers()
    for name, number in numbers.items():
        if number is None:
            continue
        small = SMALL * (0.01 if name == "width" else 1.0)
        ends = [share(chain.with_(**{name: number + s * small}), box) for s in (-1, 1)]
        slope = by_chain.numbers()[name]
        assert float(slope) == pytest.approx(
            (ends[1] - ends[0]) / (2 * small), rel=1e-6, abs=1e-6
        ), name
    for name in ("displacement", "velocity"):
        edges = {"displacement": box.displacement, "velocity": box.velocity}
        for k in (0, 1):
            moved = [Box(**edges | {name: edges[name].at[k].add(s)}) for s in (-SMALL, SMALL)]
            ends = [share(chain, own) for own in moved]
            slope = getattr(by_box, name)[k]
            assert float(slope) == pytest.approx((ends[1] - ends[0]) / (2 * SMALL), abs=1e-6)


def test_outside_of_hopf_and_fold_it_is_all_or_nothing():
    hopf, fold = 1.151292546497023, 1.8366009722079242
    for speed, wanted in ((0.01, 0), (1.0, 0), (hopf - 1e-6, 0), (fold + 1e-8, 1), (2.5, 1)):
        found = basin(DRY.with_(belt_speed=speed), Box())
        assert float(found.share) == wanted
        assert bool(found.successful)
        assert float(found.up) == (np.inf if wanted else 0.0)
        assert np.isnan(found.period)
        _, (by_chain, by_box) = slopes(DRY.with_(belt_speed=speed), Box())
        assert all(float(jnp.max(jnp.abs(g))) == 0 for g in jax.tree.leaves((by_chain, by_box)))
    assert share(DRY.with_(belt_speed=hopf + 1e-6)) == pytest.approx(0.0, abs=1e-5)
    assert share(DRY.with_(belt_speed=fold - 1e-8)) == pytest.approx(0.61056, abs=1e-5)
    assert share(DRY.with_(damping_ratio=0.6, belt_speed=0.5)) == 1.0


@pytest.mark.parametrize("chain", [DRY, WIDE])
def test_what_cannot_be_known_is_refused_with_the_reason(chain):
    def reason(**changes):
        found = basin(chain.with_(**changes), Box())
        assert np.isnan(found.share)
        assert np.isnan(found.up)
        return name_of(found.result)

    assert reason(belt_speed=0.0) == "creeps"
    assert reason(belt_speed=float(jc.hopf_belt_speed(chain)) * (1 + 1e-10)) == "at_hopf"


@pytest.mark.long
def test_that_all_motions_come_to_rest_is_not_said_where_nothing_damps_them():
    law = jc.WeakeningStrengthening(1.0, 0.5, 0.5, 0.2)
    for xi, wanted in ((0.0, "undamped"), (0.01, "successful")):
        chain = Chain(1, law, belt_speed=1.0, damping_ratio=xi)
        assert name_of(sliding_basin(chain).result) == wanted


@pytest.mark.parametrize("chain", [DRY, WIDE])
def test_the_mirror_image_has_the_same_share(chain):
    box, other = Box((-1.0, 0.5), (-0.3, 2.0)), Box((-0.5, 1.0), (-2.0, 0.3))
    ahead, back = basin(chain, box), basin(chain.with_(belt_speed=-1.5), other)
    assert float(ahead.share) == pytest.approx(float(back.share), abs=1e-14)
    assert (float(ahead.up), float(ahead.down)) == (float(back.down), float(back.up))
    np.testing.assert_array_equal(ahead.state, -jnp.stack(back.state))


@pytest.mark.long
def test_units_of_length_and_time_do_not_matter():
    """x -> c x with loads and belt speed, v_ref; time by the stiffness."""
    c, omega = 2.0, 1.5
    chain = Chain(
        1, jc.ExponentialDecay(1.0, 0.5, 0.5 * c * omega), belt_speed=1.5 * c * omega,
        damping_ratio=0.05 * omega, normal_load=np.array([c * omega**2]),
        stiffness=np.array([omega**2]),
    )  # fmt: skip
    box = Box((-2 * c, 2 * c), (0, 2 * c * omega))
    assert share(chain, box) == pytest.approx(share(DRY), abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("speed", [1.2, -1.7])
def test_a_blow_a_little_lighter_dies_and_a_heavier_one_vibrates(speed):
    chain = DRY.with_(belt_speed=speed)
    x, _ = jc.steady_sliding(chain)
    for sign, kick in zip((1.0, -1.0), blow_of_one_mass(chain), strict=True):
        for share_of, vibrates in ((0.99, False), (1.01, True)):
            start = x, jnp.full(1, sign * share_of * float(kick))
            run = jc.simulate(chain, start, 1500.0, observe=jc.Amplitude(window=20.0))
            assert (float(run.observed[0]) > 0.5 * abs(speed)) == vibrates


@pytest.mark.long
def test_it_goes_through_vmap_and_forward_mode():
    speeds = jnp.array([1.0, 1.5, 1.9])
    each = jax.jit(jax.vmap(jax.jacfwd(lambda speed: sliding_share(DRY.with_(belt_speed=speed)))))
    found = each(speeds)
    np.testing.assert_allclose(found, [0.0, 0.975818, 0.0], atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("width", [None, 1e-3, 1e-2])
@pytest.mark.parametrize("speed", [1.152, 1.4, -1.6, 1.79, 1.83])
def test_its_cycle_is_that_of_find_limit_cycle(width, speed):
    chain = jc.paper_chain(1, speed, width)
    found = basin(chain, Box())
    if float(found.share) == 1.0:
        assert (width, speed) == (1e-2, 1.83)
        return
    guess = found.state, found.period
    cycle = jc.find_limit_cycle(chain, guess, vibrating=0, rtol=1e-11)
    assert float(jnp.abs(cycle.multipliers[0])) > 1.0
    np.testing.assert_allclose(found.state, cycle.state, atol=1e-9)
    assert float(found.period) == pytest.approx(float(cycle.period), abs=1e-10)
    if speed < 1.7:
        alone = jc.find_limit_cycle(chain, branch="unstable", rtol=1e-11)
        np.testing.assert_allclose(found.state, alone.state, atol=1e-9)


@pytest.mark.long
def test_of_a_law_with_a_flat_top_it_is_right_as_well():
    law = GaussianStribeck(1.0, 0.5, 0.3, 0.02)
    chain = Chain(1, law, belt_speed=1.0, damping_ratio=0.01)
    x, _ = jc.steady_sliding(chain)
    for sign, kick in zip((1.0, -1.0), blow_of_one_mass(chain), strict=True):
        for share_of, vibrates in ((0.999, False), (1.001, True)):
            start = x, jnp.full(1, sign * share_of * float(kick))
            run = jc.simulate(chain, start, 1500.0, observe=jc.Amplitude(window=20.0))
            assert (float(run.observed[0]) > 0.5) == vibrates


@pytest.mark.long
def test_second_derivatives_are_refused():
    with pytest.raises(Exception, match="differentiated once only"):
        jax.hessian(lambda speed: sliding_share(DRY.with_(belt_speed=speed)))(1.5)
