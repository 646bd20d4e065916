"""The basin of steady sliding of one mass against SciPy, runs, differences, and itself."""

import functools
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
@functools.partial(jax.value_and_grad, argnums=(0, 1))
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
def test_the_area_of_a_circle_in_a_box_and_its_derivatives_are_those_of_calculus(box):
    """The last box touches the circle with all four edges, where there are no derivatives."""
    found, (by_radius, by_box) = area(1.0, jnp.asarray(box))
    assert float(found) == pytest.approx(exact(1.0, box), abs=1e-11)
    if box == BOXES[-1]:
        return
    small = 1e-6
    moves = small * np.eye(4)
    slopes = [(exact(1.0, box + m) - exact(1.0, box - m)) / (2.0 * small) for m in moves]
    np.testing.assert_allclose(by_box, slopes, rtol=0, atol=1e-8)
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
CYCLES = {1.16: 0.187, 1.45: 1.15, 1.83: 1.84}
SMALL = 1e-5
# With a load, so that all that is asked about them is compiled once.
DRY, WIDE = (jc.paper_chain(1, 1.5, width).with_(normal_load=1.0) for width in (None, 1e-2))


@eqx.filter_jit
def with_slopes(chain, box):
    """(the basin, the derivatives of its share in every number of the chain and in the edges)."""

    def share(given):
        found = sliding_basin(*given)
        return found.share, found

    slopes, found = jax.grad(share, has_aux=True)((chain, box))
    return found, slopes


def basin(chain, box=None):
    return with_slopes(chain, Box() if box is None else box)[0]


def right_of(plane, about):
    return plane.cycle(0.9 * about, 1.1 * about)


@pytest.mark.parametrize("speed", CYCLES)
def test_the_share_is_that_of_another_quadrature(speed):
    plane = Plane.paper(speed)
    right = right_of(plane, CYCLES[speed])
    found = basin(DRY.with_(belt_speed=speed))
    assert bool(found.successful)
    assert float(found.share) == pytest.approx(plane.area(right, (-2, 2), (0, 2)) / 8, abs=1e-11)
    up, down = plane.at_rest(right)
    assert float(found.up) == pytest.approx(up, abs=1e-9)
    assert float(found.down) == pytest.approx(down, abs=1e-9)
    assert float(found.gap) < 1e-12


@pytest.mark.parametrize(("width", "speed", "about"), [(None, 1.5, 1.3), (0.05, 1.2, 0.45)])
def test_edges_of_the_box_may_cut_the_cycle_anywhere(width, speed, about):
    plane, find = Plane.paper(speed, width), eqx.filter_jit(sliding_basin) if width else basin
    chain = (WIDE.with_(width=width) if width else DRY).with_(belt_speed=speed)
    cycle, right = find(chain, Box()), right_of(plane, about)
    for x, v in (((-0.4, 0.7), (-0.3, 0.2)), ((0.6, 3.0), (-2.0, -0.1)), ((0.5, 0.6), (0, 0.1))):
        found = find(chain, Box(x, v))
        assert float(found.area) == pytest.approx(plane.area(right, x, v), abs=1e-10)
        assert float(found.up) == float(cycle.up)


@pytest.mark.parametrize("chain", [DRY, pytest.param(WIDE, marks=pytest.mark.long)])
@pytest.mark.parametrize("speed", [1.16, 1.78])
def test_it_has_its_derivatives_in_every_number_and_in_the_edges(chain, speed):
    # The load moves Hopf and fold.
    chain = chain.with_(belt_speed=1.05 * speed, normal_load=1.1)
    box = Box((-1.5, 1.0), (-0.1, 0.9))
    found, (by_chain, by_box) = with_slopes(chain, box)
    assert 0.0 < float(found.share) < 1.0
    slopes = by_chain.parameters()
    for name, number in chain.parameters().items():
        if number is None:
            continue
        small = SMALL * (0.01 if name == "width" else 1.0)
        low, high = (basin(chain.with_(**{name: number + s}), box) for s in (-small, small))
        slope = float(high.share - low.share) / (2 * small)
        assert float(slopes[name]) == pytest.approx(slope, rel=1e-6, abs=1e-6), name
    edges = {"displacement": box.displacement, "velocity": box.velocity}
    for name, k in itertools.product(edges, (0, 1)):
        low, high = (
            basin(chain, Box(**edges | {name: edges[name].at[k].add(s)})) for s in (-SMALL, SMALL)
        )
        slope = float(high.share - low.share) / (2 * SMALL)
        assert float(getattr(by_box, name)[k]) == pytest.approx(slope, abs=1e-6)


def test_outside_of_hopf_and_fold_it_is_all_or_nothing():
    hopf, fold = 1.151292546497023, 1.8366009722079242
    for speed, wanted in ((0.01, 0), (1.0, 0), (hopf - 1e-6, 0), (fold + 1e-8, 1), (2.5, 1)):
        found, slopes = with_slopes(DRY.with_(belt_speed=speed), Box())
        assert float(found.share) == wanted
        assert bool(found.successful)
        assert float(found.up) == (np.inf if wanted else 0.0)
        assert np.isnan(found.period)
        assert all(not np.any(slope) for slope in jax.tree.leaves(slopes))
    for changes, share in (
        ({"belt_speed": hopf + 1e-6}, 0.0),
        ({"belt_speed": fold - 1e-8}, 0.61056),
        ({"damping_ratio": 0.6, "belt_speed": 0.5}, 1.0),
    ):
        assert float(basin(DRY.with_(**changes)).share) == pytest.approx(share, abs=1e-5)


def test_what_cannot_be_known_is_refused_with_the_reason():
    at_hopf = float(jc.hopf_belt_speed(DRY)) * (1 + 1e-10)
    for speed, reason in ((0.0, "belt_too_slow"), (at_hopf, "at_hopf")):
        found = basin(DRY.with_(belt_speed=speed))
        assert np.isnan(found.share)
        assert np.isnan(found.up)
        assert name_of(found.result) == reason


@pytest.mark.long
def test_that_all_motions_come_to_rest_is_not_said_where_nothing_damps_them():
    law = jc.WeakeningStrengthening(1.0, 0.5, 0.5, 0.2)
    for xi, wanted in ((0.0, "undamped"), (0.01, "successful")):
        chain = Chain(1, law, belt_speed=1.0, damping_ratio=xi)
        assert name_of(sliding_basin(chain).result) == wanted


def test_the_mirror_image_has_the_same_share():
    box, other = Box((-1.0, 0.5), (-0.3, 2.0)), Box((-0.5, 1.0), (-2.0, 0.3))
    ahead, back = basin(DRY, box), basin(DRY.with_(belt_speed=-1.5), other)
    assert float(ahead.share) == pytest.approx(float(back.share), abs=1e-14)
    assert (float(ahead.up), float(ahead.down)) == (float(back.down), float(back.up))
    np.testing.assert_array_equal(ahead.state, -np.stack(back.state))


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
