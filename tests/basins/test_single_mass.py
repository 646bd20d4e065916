"""The basin of steady sliding of one mass against SciPy, runs, differences, and itself."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxchain as jc
from jaxchain.basins import Box, sliding_basin, sliding_share
from jaxchain.basins.single_mass import Mass, area_of_step, innermost_unstable_cycle, return_map
from jaxchain.model import AbstractFrictionLaw, Chain, Coulomb
from jaxchain.result import SearchResult, name_of

from .planes import Plane

BOXES = (
    (-2.0, 2.0, -2.0, 2.0), (-0.5, 0.7, -0.2, 0.9), (-2.0, 0.3, 0.0, 2.0),
    (-0.9, 0.2, -1.5, -0.3), (0.1, 0.9, 0.2, 0.8), (1.2, 1.5, 0.0, 2.0), (-1.0, 1.0, -1.0, 1.0),
)  # fmt: skip


@jax.jit
def area(radius, box):
    """Of a circle, in 96 steps that begin anywhere."""
    times = jnp.linspace(0.0, 2.0 * jnp.pi, 97) + 0.1
    x, v = radius * jnp.sin(times), radius * jnp.cos(times)
    points = jnp.stack([x, v, -x], axis=1)
    step = lambda a, b: area_of_step(a, b, times[1] - times[0], box[:2], box[2:])
    return jnp.sum(jax.vmap(step)(points[:-1], points[1:]))


def exact(radius, box):
    a, b, c, d = box

    def height(x):
        half = np.sqrt(max(radius**2 - x**2, 0.0))
        return np.clip(half, c, d) - np.clip(-half, c, d)

    corners = [s * np.sqrt(radius**2 - e**2) for e in (c, d) if abs(e) < radius for s in (-1, 1)]
    inside = [x for x in corners if max(a, -radius) < x < min(b, radius)]
    ends = sorted([max(a, -radius), *inside, min(b, radius)])
    pairs = itertools.pairwise(ends)
    return sum(quad(height, *pair, epsabs=1e-13)[0] for pair in pairs if pair[0] < pair[1])


@pytest.mark.parametrize("box", BOXES)
def test_the_area_of_a_circle_in_a_box_is_that_of_calculus(box):
    """The last box touches the circle with all four edges."""
    assert float(area(1.0, jnp.asarray(box))) == pytest.approx(exact(1.0, box), abs=1e-11)


@pytest.mark.parametrize("box", BOXES[1:-1])
def test_it_has_its_derivatives_in_the_edges_and_in_the_curve(box):
    by_radius, by_box = jax.grad(area, (0, 1))(1.0, jnp.asarray(box))
    small = 1e-6
    for k in range(4):
        moved = small * np.eye(4)[k]
        slope = (exact(1.0, box + moved) - exact(1.0, box - moved)) / (2.0 * small)
        assert float(by_box[k]) == pytest.approx(slope, abs=1e-8)
    slope = (exact(1.0 + small, box) - exact(1.0 - small, box)) / (2.0 * small)
    assert float(by_radius) == pytest.approx(slope, abs=1e-8)


K, XI = 1.7, 0.03


def mass(xi=XI):
    """Friction that does not change: a linear oscillator behind the belt."""
    return Mass.of(Chain(1, Coulomb(0.5), belt_speed=-2.0, damping_ratio=xi, stiffness=K))


@jax.jit
def around(mass, fastest):
    return return_map(mass, fastest, (jnp.array([-5.0, 5.0]), jnp.array([-5.0, 5.0])))


def test_a_linear_turn_is_that_of_the_textbook():
    frequency = np.sqrt(K - XI**2)
    period = 2.0 * np.pi / frequency
    for fastest in (1e-3, 0.4, 1.9):
        found = around(mass(), fastest)
        assert bool(found.ended)
        assert not bool(found.sticks)
        assert float(found.period) == pytest.approx(period, abs=1e-11)
        lost = fastest * np.exp(-XI * period)
        assert float(found.fastest) == pytest.approx(lost, rel=1e-11)
        assert -float(found.down) < fastest


def test_without_damping_the_area_is_that_of_the_ellipse():
    found = around(mass(0.0), 0.8)
    assert float(found.area) == pytest.approx(np.pi * 0.8**2 / np.sqrt(K), abs=1e-11)
    assert float(found.up) == pytest.approx(0.8, abs=1e-12)
    assert float(found.down) == pytest.approx(-0.8, abs=1e-12)


def test_what_is_damped_so_much_that_it_does_not_turn_comes_to_rest():
    found = around(mass(3.0), 1.0)
    assert bool(found.ended)
    assert float(found.fastest) < 0.01


def test_what_comes_as_fast_as_the_belt_sticks():
    found = around(mass(-0.1), 1.9)
    assert bool(found.sticks)
    assert float(found.fastest) == 2.0


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
    found = innermost_unstable_cycle(Mass.of(chain))
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
        innermost_unstable_cycle(Mass.of(chain.with_(belt_speed=fold + off)))
        for off in (-1e-7, 1e-7)
    )
    assert 0.7 * fold < float(below.fastest) < fold
    assert np.isnan(above.fastest)
    assert float(above.share_of_plane) == 1.0
    assert name_of(above.result) == "successful"


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
    numbers = chain.parameters()
    for name, number in numbers.items():
        if number is None:
            continue
        small = SMALL * (0.01 if name == "width" else 1.0)
        ends = [share(chain.with_(**{name: number + s * small}), box) for s in (-1, 1)]
        slope = by_chain.parameters()[name]
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

    assert reason(belt_speed=0.0) == "belt_too_slow"
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
def test_it_goes_through_vmap_and_forward_mode():
    speeds = jnp.array([1.0, 1.5, 1.9])
    each = jax.jit(jax.vmap(jax.jacfwd(lambda speed: sliding_share(DRY.with_(belt_speed=speed)))))
    found = each(speeds)
    np.testing.assert_allclose(found, [0.0, 0.975818, 0.0], atol=1e-6)


@pytest.mark.long
def test_second_derivatives_are_refused():
    with pytest.raises(Exception, match="differentiated once only"):
        jax.hessian(lambda speed: sliding_share(DRY.with_(belt_speed=speed)))(1.5)
