"""Cells in any units: what counts as 1 follows from the cells and their motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import continue_cycle, find_limit_cycle, simulate, verdict
from jaxchain.model import (
    ExponentialDecay,
    MechanicalCells,
    StaticKinetic,
    Stop,
    Table,
    TabulatedFriction,
    TanhFriction,
)

# Metres and seconds of a squealing pad, and of something as slow as a glacier.
UNITS = ((1e-9, 1e-4), (1e6, 1e5))


class Cubic(eqx.Module):
    """A hardening spring."""

    factor: jax.Array

    def __call__(self, q, v):
        return (-self.factor * q[0] ** 3,)


class Pushing(eqx.Module):
    """The damper of van der Pol."""

    gain: jax.Array
    loss: jax.Array

    def __call__(self, q, v):
        return (self.gain * v[0] - self.loss * q[0] ** 2 * v[0],)


def sticking(length, time, smoothed):
    speed, force = length / time, length / time**2
    law = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5 * speed)
    friction = TanhFriction(law, 1e-2 * speed) if smoothed else law
    matrix = np.array([[1.0, 0.3], [0.3, 2.0]]) / time**2
    numbers = {"damping": 0.1 / time, "normal_load": force, "belt_speed": 0.5 * speed}
    return MechanicalCells(matrix, friction=friction, **numbers), "belt_speed", speed


def hitting(length, time):
    force = length / time**2
    stops = [Stop(1.0, 0.6 * length, 0.3), Stop(-1.0, 0.4 * length, 0.7)]
    cells = MechanicalCells(
        time**-2, damping=0.05 / time, friction=StaticKinetic(0.3, 0.2), normal_load=force,
        belt_speed=0.3 * length / time, force=0.9 * force, frequency=0.8 / time, stops=stops,
    )  # fmt: skip
    return cells, "force", force


def forced(length, time):
    force = length / time**2
    spring = Cubic(jnp.asarray(0.3 * force / length**3))
    drive = {"force": 0.5 * force, "frequency": 1.3 / time}
    cells = MechanicalCells(time**-2, damping=0.1 / time, local_force=spring, **drive)
    return cells, "force", force


def pushed(length, time):
    law = Pushing(jnp.asarray(0.3 / time), jnp.asarray(0.3 / time / length**2))
    return MechanicalCells(time**-2, local_force=law), "stiffness", time**-2


CELLS = {
    "dry": lambda *units: sticking(*units, smoothed=False),
    "smoothed": lambda *units: sticking(*units, smoothed=True),
    "with stops": hitting,
    "forced": forced,
    "pushed": pushed,
}


def run_in(make, length, time):
    """(the cells, a run, the units of its state)."""
    cells, *named = make(length, time)
    sizes = (length,) * cells.d + (length / time,) * cells.d
    run = simulate(cells, tuple(jnp.full(1, 0.2 * size) for size in sizes), 60.0 * time)
    return cells, run, sizes, *named


def seen(make, length, time):
    """A cycle and a branch, in these units."""
    cells, run, sizes, name, unit = run_in(make, length, time)
    cycle = find_limit_cycle(cells, run)
    branch = continue_cycle(cycle, parameter=name, bounds=(0.4 * unit, 1.1 * unit), max_points=12)
    state = [float(part[0] / size) for part, size in zip(cycle.state, sizes, strict=True)]
    multipliers = np.sort(np.abs(cycle.multipliers))
    special = [(point.kind, point.parameter / unit) for point in branch.special]
    ends = branch.parameter[-1] / unit, branch.amplitude[-1, 0] / length
    return cycle.stable, [float(cycle.period) / time, *state, *multipliers], ends, special


@pytest.mark.parametrize("kind", CELLS)
def test_a_run_in_other_units_takes_the_same_steps_to_the_same_end(kind):
    found = []
    for units in ((1.0, 1.0), *UNITS):
        _, run, sizes, *_ = run_in(CELLS[kind], *units)
        ends = [float(part[0] / size) for part, size in zip(run.state, sizes, strict=True)]
        found.append((int(run.steps), ends))
    for steps, ends in found[1:]:
        assert abs(steps - found[0][0]) <= 0.02 * found[0][0] + 1
        np.testing.assert_allclose(ends, found[0][1], rtol=0, atol=5e-6)


@pytest.mark.long
@pytest.mark.parametrize("kind", CELLS)
def test_cycles_and_branches_in_other_units_are_alike_and_compile_nothing(kind, compiled):
    """In one set of units, so does the closed form of `tests/cycles/test_several_places.py`."""
    stable, numbers, ends, special = seen(CELLS[kind], 1.0, 1.0)
    assert special or kind != "with stops"  # its branch ends at a grazing
    for units in UNITS:
        compiled.clear()
        others = seen(CELLS[kind], *units)
        assert not [name for name in compiled if name.startswith("jit(_")]
        assert others[0] == stable
        np.testing.assert_allclose(others[1], numbers, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(others[2], ends, rtol=1e-4)
        assert [kind for kind, _ in others[3]] == [kind for kind, _ in special]
        np.testing.assert_allclose(
            [value for _, value in others[3]], [value for _, value in special], rtol=1e-9
        )


@pytest.mark.long
@pytest.mark.parametrize("kind", ["smoothed", "pushed", "forced"])
def test_a_verdict_does_not_depend_on_the_units(kind):
    found = []
    for length, time in ((1.0, 1.0), *UNITS):
        cells, _, _ = CELLS[kind](length, time)
        start = tuple(jnp.full(1, 0.2 * s) for s in [length] * cells.d + [length / time] * cells.d)
        judged = verdict(cells, start, seeds=1)
        found.append((judged.verdict, round(float(judged.runs[-1].period) / time, 6)))
    assert found[0][0] == "periodic"
    assert found == found[:1] * len(found)


@pytest.mark.parametrize("force", [jnp.ones_like, lambda t: jnp.sin(2.0 * t)])
def test_a_run_from_rest_begins_as_exactly_in_any_units(force):
    found = []
    for length, time in ((1.0, 1.0), *UNITS):
        cells = MechanicalCells(
            time**-2, force=lambda t, a=length / time**2, b=time: a * force(t / b)
        )
        run = simulate(cells, (jnp.zeros(1), jnp.zeros(1)), 20.3 * time)
        found.append(float(run.state[0][0]) / length)
    exact = {True: 1.0 - np.cos(20.3), False: (2.0 * np.sin(20.3) - np.sin(40.6)) / 3.0}
    wanted = exact[force is jnp.ones_like]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=4e-6)


class Rising(eqx.Module):
    """A load that grows with the displacement, and lifts off."""

    load: jax.Array
    slope: jax.Array

    def __call__(self, t, q, v):
        return self.load + self.slope * q[0]


class Corners(eqx.Module):
    """An elastic stop on either side."""

    stiffness: jax.Array
    gap: jax.Array

    def __call__(self, q, v):
        beyond = jnp.maximum(q[0] - self.gap, 0.0) - jnp.maximum(-q[0] - self.gap, 0.0)
        return (-self.stiffness * beyond,)


def with_corners(length, time):
    """Cells with corners in force, load, drive and law."""
    force, speed = length / time**2, length / time
    speeds = np.array([0.0, 0.2, 0.5, 2.0]) * speed
    return MechanicalCells(
        time**-2, damping=0.05 / time, belt_speed=0.3 * speed,
        friction=TabulatedFriction(speeds, np.array([0.4, 0.35, 0.25, 0.3])),
        normal_load=Rising(jnp.asarray(0.4 * force), jnp.asarray(0.8 / time**2)),
        local_force=Corners(jnp.asarray(200.0 / time**2), jnp.asarray(0.6 * length)),
        force=Table(np.linspace(0.0, 30.0, 90) * time, np.sin(np.arange(90.0) ** 2) * force),
    )  # fmt: skip


def test_corners_are_found_as_exactly_in_any_units():
    found = []
    for length, time in ((1.0, 1.0), *UNITS, (1e-6, 1e-6)):
        start = jnp.full(1, 0.2 * length), jnp.full(1, 0.2 * length / time)
        run = simulate(with_corners(length, time), start, 30.0 * time, rtol=1e-10)
        ends = [
            part[0] / unit for part, unit in zip(run.state, (length, length / time), strict=True)
        ]
        found.append([float(run.steps), *map(float, ends)])
    np.testing.assert_allclose(found, found[:1] * len(found), rtol=0, atol=1e-10)
