"""The study `basins`: a small one, its summary, its picture."""

import numpy as np
import pytest

from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.studies.basins.figure import _broken, draw
from jaxchain.studies.basins.report import mean_count, summary
from jaxchain.studies.basins.study import run

RING = ["masses=3", "time=300", "half_width=0.1"]
SMALL = [
    "one_mass.belt_speed=[1.4, 1.9]", "one_mass.half_width=0.03", "one_mass.width=[1e-2]",
    "one_mass.curve.count=3", "plane.count=12",
    "over_belt_speed.belt_speed=[1.5, 1.9]", "over_coupling.coupling=[0.001, 0.01]",
    *(f"{part}.{key}" for part in ("over_belt_speed", "over_coupling") for key in RING),
]  # fmt: skip


@pytest.mark.long
def test_a_small_study_finds_saves_and_draws(tmp_path):
    said = []
    found = run(load_scene("basins", SMALL).scene, tmp_path, report=said.append)
    one, exact, plane = found["one_mass"], found["exact"], found["plane"]
    sliding = one.sel(state="sliding")
    assert np.all((sliding.low <= one.exact) & (one.exact <= sliding.high))
    assert exact.exact.dims == ("width", "curve")
    assert exact.exact[:, 0].values.tolist() == [0.0, 0.0]  # at 1.1, below the Hopf speed
    # Of a grid of starts those die that lie within the unstable cycle.
    x, v = plane.unstable_displacement.values, plane.unstable_velocity.values
    centre = float(one.attrs["t0"]) + np.array([0.5 + 0.5 * np.exp(-3.0), 0.0])
    turned = np.arctan2(v - centre[1], x - centre[0])
    order = np.argsort(turned)
    size = np.hypot(x - centre[0], v - centre[1])
    for at_x in plane.displacement.values:
        for at_v in plane.velocity.values:
            own = np.hypot(at_x - centre[0], at_v - centre[1])
            angle = np.arctan2(at_v - centre[1], at_x - centre[0])
            edge = np.interp(angle, turned[order], size[order], period=2 * np.pi)
            if abs(own - edge) > 0.02:
                vibrates = plane.vibrates.sel(displacement=at_x, velocity=at_v)
                assert bool(vibrates) == (own > edge)
    ring = found["over_belt_speed"]
    assert mean_count(ring)[1] == 0 < mean_count(ring)[0]
    assert [text.splitlines()[0][:22] for text in said] == [
        "one mass comes to slid", "share of sliding, exac", "how many masses vibrat",
        "how many masses vibrat",
    ]  # fmt: skip
    assert (tmp_path / "basins.png").exists()
    assert len(draw(found).axes) == 6  # two of them bars of colours
    assert summary("plane", plane) == ""


def test_a_line_is_not_drawn_through_a_jump():
    x, share = _broken(np.array([1.0, 2.0, 3.0]), np.array([0.4, 0.5, 1.0]))
    assert np.array_equal(x, [1.0, 2.0, np.nan, 3.0], equal_nan=True)
    assert np.array_equal(share, [0.4, 0.5, np.nan, 1.0], equal_nan=True)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("region.velocity=[2, 0]", "region.velocity: must be .low, high. with low < high"),
        ("over_coupling.belt_speed=[1.4, 1.5]", "over_coupling.belt_speed: must be one"),
        ("over_belt_speed.coupling=[0.1, 0.2]", "over_belt_speed.coupling: must be one"),
        ("region.displacement=[1]", "region.displacement"),
    ],
)
def test_impossible_tables_are_refused(change, told):
    with pytest.raises(SceneError, match=told):
        load_scene("basins", [change])
