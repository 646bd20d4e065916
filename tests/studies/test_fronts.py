"""The study `fronts`: its table, its summary, its picture, and a small one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from synthetic import stored

from jaxchain.model.chain import paper_chain
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.studies.fronts.compute import BlockStart, add_mean, exponents
from jaxchain.studies.fronts.figure import draw
from jaxchain.studies.fronts.report import predicted_edges, summary, windows
from jaxchain.studies.fronts.study import run

SPEEDS = np.array([0.9, 1.0, 1.1, 1.4, 1.5, 1.7, 1.8])
PATTERNS = ["alternating", "in-phase"]


def made_up():
    """Datasets of the shape that the study has."""
    true = np.array([0.03, 0.02, 0.01, 0.0, 0.0, -0.01, -0.02])
    verdict = np.sign(true).astype(int)[:, None, None] + np.zeros((7, 2, 2), int)
    verdict[5, 0, 0] = 2
    lanes = ("belt_speed", "pattern", "seed")
    speed = true[:, None, None] + np.array([-1e-4, 1e-4])[:, None]
    first = xr.Dataset(
        {
            "speed": (lanes, speed + np.zeros((7, 2, 2))),
            "error": (lanes, np.full((7, 2, 2), 2e-4)),
            "verdict": (lanes, verdict), "result": (lanes, np.zeros((7, 2, 2), int)),
            "mean_speed": ("belt_speed", true), "mean_error": ("belt_speed", np.full(7, 1e-4)),
            "spreading": ("curve", np.array([0.03, 0.01])),
        },
        coords={
            "belt_speed": SPEEDS, "pattern": PATTERNS, "seed": [0, 1], "curve": [0.9, 1.15],
        },
    )  # fmt: skip
    amplitude = np.ones((3, 5, 12)) * (np.abs(np.arange(12) - 6) < 3)
    amplitude[0, -1], amplitude[2, -1] = 2.0, 0.0
    amplitude = 2.0 * amplitude
    pictures = xr.Dataset(
        {"amplitude": (("belt_speed", "time", "oscillator"), amplitude)},
        coords={
            "belt_speed": [1.1, 1.5, 1.75], "time": np.arange(5.0), "oscillator": np.arange(1, 13),
        },
    )  # fmt: skip
    eta = np.array([0.005, 0.01, 0.02])
    stands = np.empty((3, 2, 2))
    stands[:, 0], stands[:, 1] = 1.35, 1.69
    moves = np.empty((3, 2, 2))
    moves[:, 0], moves[:, 1] = 1.33, 1.71
    pinning = xr.Dataset(
        {
            "stands": (("coupling", "edge", "pattern"), stands),
            "moves": (("coupling", "edge", "pattern"), moves),
            "growth_coupling": (("curve", "cosine"), np.array([[0.004, 0.003], [0.03, 0.02]])),
            "death_belt_speed": ("death_coupling", np.array([1.8, 1.4])),
        },
        coords={
            "coupling": eta, "edge": ["grows", "shrinks"], "pattern": PATTERNS,
            "curve": [1.2, 1.5], "cosine": [0.0, -1.0], "death_coupling": [0.001, 0.041],
        },
    )  # fmt: skip
    law = np.stack([eta**0.5, eta])
    coupling = xr.Dataset(
        {
            "mean_speed": (("belt_speed", "coupling"), law),
            "mean_error": (("belt_speed", "coupling"), 0.05 * law),
            "verdict": (("coupling", "belt_speed", "pattern"), np.ones((3, 2, 2), int)),
            "exponent": ("belt_speed", [0.5, 1.0]), "exponent_error": ("belt_speed", [0.01, 0.02]),
            "points": ("belt_speed", [3.0, 3.0]),
            "spreading": (("belt_speed", "curve"), np.array([[0.1, 0.2], [np.nan, np.nan]])),
        },
        coords={
            "belt_speed": [0.95, 1.2], "coupling": eta, "pattern": PATTERNS, "curve": [5e-3, 2e-2],
        },
    )  # fmt: skip
    convergence = xr.Dataset(
        {
            "mean_speed": (("case", "belt_speed"), np.array([[0.02, -0.01], [0.021, -0.01]])),
            "mean_error": (("case", "belt_speed"), np.full((2, 2), 1e-3)),
            "masses": ("case", [40, 80]), "width": ("case", [0.0, 1e-3]),
        },
        coords={"belt_speed": [1.0, 1.75]},
    )  # fmt: skip
    return {
        "belt_speed": first, "pictures": pictures, "pinning": pinning, "coupling": coupling,
        "convergence": convergence,
    }  # fmt: skip


def test_windows_hold_speeds_at_which_all_runs_agree():
    assert windows(made_up()["belt_speed"]) == [
        ("grows", 0.9, 1.1), ("stands", 1.4, 1.5), ("mixed", 1.7, 1.7), ("shrinks", 1.8, 1.8)
    ]  # fmt: skip


def test_the_summary_names_windows_edges_and_exponents():
    said = "\n".join(summary(key, data) for key, data in made_up().items())
    assert "all 28 runs ended well\n  grows from 0.9 to 1.1\n  stands from 1.4" in said
    found = [" ".join(line.split()) for line in said.splitlines()]
    for row in (
        "1 +0.02000 +- 0.00010",
        "0.01" + 2 * " 1.3500 ... 1.3300" + 2 * " 1.6900 ... 1.7100" + " 1.324, 1.710",
        "0.95 0.500 +- 0.010 3", "80 0.001 +0.02100 +- 0.00100 -0.01000 +- 0.00100",
    ):  # fmt: skip
        assert row in found
    # In between, 0.01 is (0.01 - 0.003) / 0.017 of the way from 1.2 to 1.5.
    low, high = predicted_edges(made_up()["pinning"], 0.01)
    np.testing.assert_allclose([low, high], [1.2 + 0.3 * 7 / 17, 1.8 - 0.4 * 9 / 40])


def test_the_picture():
    page = draw(made_up())
    top, lower = page.subfigs
    assert [axes.get_title() for axes in top.axes[:3]] == [
        r"$\tilde v_d = 1.1$: grows", r"$\tilde v_d = 1.5$: stands",
        r"$\tilde v_d = 1.75$: shrinks",
    ]  # fmt: skip
    speed, _, coupling, _ = lower.axes
    lines = {line.get_label(): line for line in speed.get_lines()}
    np.testing.assert_allclose(np.asarray(lines["linear spreading"].get_ydata()), [30.0, 10.0])
    words = [text.get_text() for text in speed.texts]
    assert words == ["grows", "stands", "shrinks"]
    labels = coupling.get_legend_handles_labels()[1]
    assert r"$\tilde v_d = 0.95$: $p = 0.50 \pm 0.01$" in labels


def test_exponents_of_exact_and_of_noisy_power_laws():
    eta = np.geomspace(1e-3, 0.1, 9)
    p, error, points = exponents(eta, -0.3 * eta**0.7, np.zeros(9))
    np.testing.assert_allclose([p, error, points], [0.7, 0.0, 9], atol=1e-12)
    # What stands is left out.
    speed = np.where(eta < 5e-3, 0.0, eta)
    p, _, points = exponents(eta, speed, np.full(9, 1e-4))
    np.testing.assert_allclose([p, points], [1.0, 6.0])
    assert np.isnan(exponents(eta, np.zeros(9), np.full(9, 1e-4))[0])
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(200):
        p, error, _ = exponents(eta, eta * np.exp(rng.normal(0.0, 0.1, 9)), np.zeros(9))
        inside += abs(p - 1.0) <= error
    assert 183 <= inside <= 198


def test_means_have_the_greater_of_two_errors():
    lanes = np.array([[0.1, 0.1, 0.1, 0.1], [0.1, 0.2, 0.3, 0.4], [0.1, np.nan, np.nan, 0.3]])
    data = xr.Dataset(
        {"speed": (("belt_speed", "seed"), lanes), "error": (("belt_speed", "seed"),
         np.where(np.isnan(lanes), np.nan, 0.02))}
    )  # fmt: skip
    mean = add_mean(data, ("seed",))
    np.testing.assert_allclose(mean["mean_speed"], [0.1, 0.25, 0.2])
    scatter = [3.182446 * np.std(lanes[1], ddof=1) / 2, 12.706205 * 0.1 * 2**0.5 / 2**0.5]
    np.testing.assert_allclose(mean["mean_error"], [0.01, *scatter], rtol=1e-6)


def test_a_block_starts_with_noise_inside_and_sliding_outside():
    chain = paper_chain(30)
    sliding = float(-chain.friction.force(chain.belt_speed))
    starts = jax.jit(jax.vmap(lambda seed, alike: BlockStart(10)(chain, seed, alike)))
    xs, vs = starts(jnp.array([3, 4, 3]), jnp.array([False, False, True]))
    (x, other, alike), v = xs, vs[0]
    inside = np.zeros(30, bool)
    inside[10:20] = True
    assert np.all(np.asarray(x)[~inside] == np.asarray(x)[0])
    assert np.all(np.asarray(v)[~inside] == 0.0)
    np.testing.assert_allclose(np.abs(x - sliding)[inside], 2.0, atol=0.1)
    assert np.all(np.asarray(alike - sliding)[inside] > 1.8)
    assert np.all(np.asarray(x != other) == inside)


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("base.mu_dynamic=1.0", "mu_static"),
        ("speed.block=60", "lower `block`"),
        ("speed.seeds=0", "speed.seeds"),
        ("coupling.coupling=[0.01]", "coupling.coupling"),
        ("pinning.stands=1.0", "lowest"),
        ("pictures.windows=1", "pictures.windows"),
        ("rtol=0.1", "rtol"),
        ("colour=1", "colour"),
    ],
)
def test_a_bad_table_is_refused_with_its_key(override, key):
    with pytest.raises(SceneError, match=key):
        load_scene("fronts", [override])


SMALL = [
    "pictures={masses=20,block=8,time=100.0,belt_speed=[1.1],windows=10}",
    "speed={masses=20,block=8,time=200.0,belt_speed=[1.05,1.5],seeds=1}",
    "coupling={masses=20,block=8,time=200.0,belt_speed=[1.05],coupling=[0.01,0.02,0.03]}",
    "pinning={masses=20,block=8,time=200.0,coupling=[0.02],lowest=1.1,stands=1.5,highest=1.82,"
    "halvings=1}",
    "convergence={masses=20,block=8,time=200.0,belt_speed=[1.05],other_masses=[24],width=[1e-2]}",
]


@pytest.mark.exhaustive
def test_a_small_study(tmp_path):
    said = []
    data = run(load_scene("fronts", SMALL).scene, tmp_path, name="small", report=said.append)
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {"small.zarr", "small.nc", "small.png", "small.pdf", "report.html"}
    assert list(data) == ["belt_speed", "pictures", "pinning", "coupling", "convergence"]
    for name, saved in stored(tmp_path / "small").items():
        assert saved.identical(data[name])
    assert windows(data["belt_speed"]) == [("grows", 1.05, 1.05), ("stands", 1.5, 1.5)]
    assert "grows from 1.05 to 1.05" in said[0]
    assert len(said) == 4  # the pictures speak for themselves
    # The same ring, once more.
    first = data["belt_speed"]["speed"].sel(belt_speed=1.05, seed=0)
    again = data["convergence"]["speed"].isel(case=0).sel(belt_speed=1.05)
    np.testing.assert_allclose(first, again)
