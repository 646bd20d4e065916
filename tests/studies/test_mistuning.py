"""The study `mistuning`: table, statistics, what is counted, summary, picture, a small run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from synthetic import stored

from jaxchain import equation_8
from jaxchain.localization.mistuning import mistuned_stiffness
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.studies.mistuning import compute
from jaxchain.studies.mistuning.compute import (
    add_drift,
    analyse,
    base_chain,
    correlation,
    count_captures,
    frequencies,
    initial_state,
    random_half,
    stiffness_pattern,
    vibrating,
)
from jaxchain.studies.mistuning.figure import draw, rows
from jaxchain.studies.mistuning.report import half_width, halving, summary, verdict
from jaxchain.studies.mistuning.study import run

DISORDER = [0.0, 0.02, 0.1]
POINT = ("coupling", "belt_speed", "disorder")


@pytest.fixture(scope="module")
def study():
    return load_scene("mistuning").scene


def made_up(study, start="one", chains=30, couplings=(0.01,), speeds=(1.2, 1.3)):
    """Amplitudes as a sweep gives them; a neighbour is drawn in at a detuning below 0.03."""
    part = next(p for p in study.ensemble.values() if p.start == start)
    part = part.model_copy(
        update={
            "chains": chains, "disorder": DISORDER, "coupling": list(couplings),
            "belt_speed": list(speeds),
        }
    )  # fmt: skip
    u = np.asarray(stiffness_pattern(study, chains))
    shape = (len(couplings), len(speeds), 3, chains, 20)
    amplitude = np.full(shape, 0.05 if start == "one" else 1.5)
    if start == "one":
        amplitude[..., 10] = 1.5
        for j, d in enumerate(DISORDER):
            for m in (9, 11):
                drawn = np.abs(d * (u[:, m] - u[:, 10])) < 0.03
                amplitude[:, :, j, drawn, m] = 1.5
    else:
        amplitude[:, :, 1:] = np.where(u > 0.5, 1.5, 0.1)
    over = {
        "coupling": list(couplings), "belt_speed": list(speeds), "disorder": DISORDER,
        "seed": range(chains), "oscillator": range(1, 21),
    }  # fmt: skip
    lanes = (*POINT, "seed")
    data = xr.Dataset(
        {
            "amplitude": ((*lanes, "oscillator"), amplitude),
            "energy": (lanes, 0.5 * np.sum(amplitude**2, -1)),
            "active_count": (lanes, np.sum(amplitude > 0.65, -1)),
            "result": (lanes, np.zeros(shape[:-1], int)),
        },
        coords=over,
    )
    return part, data


@pytest.fixture(scope="module")
def analysed(study):
    found = {}
    with pytest.MonkeyPatch.context() as patch:  # what is costly has a test of its own
        patch.setattr(compute, "capture_interval", lambda chain, speed: np.array([-0.04, 0.01]))
        analyse_all(study, found)
    found["locking"] = frequencies(peaks(), 1.5)
    return found


def analyse_all(study, found):
    for name, start, couplings, speeds in (
        ("one", "one", (0.01,), (1.2, 1.3)), ("coupling", "one", (0.001, 0.05), (1.3,)),
        ("all", "all", (0.01,), (1.75,)),
    ):  # fmt: skip
        part, data = made_up(study, start, couplings=couplings, speeds=speeds)
        found[name] = analyse(study, part, data)
        add_drift(found[name], data.isel(seed=slice(5)))


def peaks():
    """Two neighbours of one frequency, a third of another, and one at rest."""
    omega = np.array([1.0, 1.0, 1.02, 1.0])
    times = 100.0 + 2 * np.pi * np.arange(40)[:, None] / omega
    times[:, 3] = np.nan
    amplitude = np.array([1.5, 1.5, 1.5, 0.1])
    rows = ("disorder", "seed")
    return xr.Dataset(
        {
            "peak_time": ((*rows, "peak", "oscillator"), np.tile(times, (2, 1, 1, 1))),
            "amplitude": ((*rows, "oscillator"), np.tile(amplitude, (2, 1, 1))),
            "active_count": (rows, [[3], [3]]),
            "result": (rows, [[0], [0]]),
        },
        coords={"disorder": [0.0, 0.02], "seed": [0]},
    )


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("base.masses=2", "base.masses"),
        ("base.mu_dynamic=1.5", "mu_static"),
        ("ensemble.one.disorder=[-0.1]", "disorder"),
        ("ensemble.one.disorder=[0.5]", "disorder"),
        ("ensemble.one.start='some'", "start"),
        ("ensemble.one.chains=1", "chains"),
        ("ensemble.one.belt_speed=[]", "belt_speed"),
        ("ensemble.one.disorder=[0.1, 0.0]", "disorder"),
        ("longer.factor=1.0", "factor"),
        ("locking.window=5.0", "window"),
        ("ensemble.one.window=5e-324", "ensemble.one.window: must hold at least one period"),
        ("distribution='cauchy'", "distribution"),
        ("colour=1", "colour"),
    ],
)
def test_a_bad_table_is_refused_with_its_key(override, key):
    with pytest.raises(SceneError, match=key):
        load_scene("mistuning", [override])


def test_the_shipped_study_has_a_thousand_chains_in_every_point(study):
    assert all(part.chains >= 1000 for part in study.ensemble.values())
    assert {part.start for part in study.ensemble.values()} == {"disturbed", "all", "half", "one"}
    couplings = {c for part in study.ensemble.values() for c in part.coupling}
    assert {0.001, 0.01, 0.05} <= couplings


def test_a_correlation_is_that_of_numpy():
    values = np.random.default_rng(1).gamma(2.0, size=(2, 400))
    x, y = (xr.DataArray(row, dims="seed") for row in values)
    np.testing.assert_allclose(correlation(x, y, "seed"), np.corrcoef(x, y)[0, 1])
    assert np.isnan(correlation(x, xr.ones_like(x), "seed"))
    assert np.isnan(correlation(x.where(np.arange(x.size) < 2), y, "seed"))


@pytest.mark.long
def test_starts_and_patterns_depend_on_the_seed_alone(study):
    chain = base_chain(study)
    half = np.stack([np.asarray(random_half(seed, 20)) for seed in range(30)])
    assert np.all(half.sum(1) == 10)
    assert len({tuple(row) for row in half}) == 30
    x, v = initial_state("half", 1.0)(chain, seed=4)
    rest = float(equation_8(chain, 0)[0][0])
    np.testing.assert_array_equal(np.abs(np.asarray(x) - rest) > 1.0, half[4])
    assert not np.any(v)
    np.testing.assert_array_equal(initial_state("one", 1.0)(chain)[0], equation_8(chain, 1)[0])
    np.testing.assert_array_equal(initial_state("all", 1.0)(chain)[0], equation_8(chain, 20)[0])
    many = jax.vmap(lambda s: initial_state("disturbed", 0.01)(chain, s)[0])(jnp.arange(200))
    assert abs(float(many.std()) - 0.01) < 5e-4
    u = stiffness_pattern(study, 5)
    np.testing.assert_allclose(1.0 + 0.03 * u[3], mistuned_stiffness(3, 20, 0.03), rtol=1e-12)


def test_counts_of_captures(study):
    _, data = made_up(study)
    u = np.asarray(stiffness_pattern(study, 30))
    edges = np.linspace(-0.4, 0.4, 9)
    data["pattern"] = (("seed", "oscillator"), u)
    hits, total = count_captures(data, edges)
    detuning = np.concatenate([d * (u[:, m] - u[:, 10]) for d in (0.02, 0.1) for m in (9, 11)])
    np.testing.assert_array_equal(total[0, 0], np.histogram(detuning, edges)[0])
    near = detuning[np.abs(detuning) < 0.03]
    np.testing.assert_array_equal(hits[0, 1], np.histogram(near, edges)[0])
    assert vibrating(data)[..., 10].all()


def test_what_is_computed_from_amplitudes(study, analysed):
    data = analysed["one"]
    a = data["amplitude"].values[0, 0, 2, 7]
    np.testing.assert_allclose(
        data["participation_ratio"][0, 0, 2, 7], np.sum(a**2) ** 2 / np.sum(a**4)
    )
    mean = data["participation_ratio"].mean("seed")
    np.testing.assert_allclose(data["participation_mean"], mean)
    low, high = np.moveaxis(data["participation_interval"].values, -1, 0)
    assert np.all((low <= mean.values + 1e-12) & (mean.values - 1e-12 <= high))
    np.testing.assert_array_equal(data["vibrating_share"], 1.0)
    # The modes of one of the chains, by NumPy.
    u = data["pattern"].values[3]
    k = np.diag(1.02 + 0.02 * u) - 0.01 * (np.roll(np.eye(20), 1, 0) + np.roll(np.eye(20), -1, 0))
    _, columns = np.linalg.eigh(k)
    np.testing.assert_allclose(
        data["mode_participation"][0, 1, 3], np.mean(1 / np.sum(columns**4, 0)), rtol=1e-9
    )
    # A chain without any vibration is spread over no mass.
    part, rest = made_up(study, "all", couplings=(0.01,), speeds=(1.75,))
    rest["amplitude"][:] = 1e-3
    rest["active_count"][:] = 0
    assert np.all(analyse(study, part, rest)["participation_ratio"] == 0)
    np.testing.assert_allclose(data["drift"], 0.0)


def test_fates_go_with_what_they_were_made_from(analysed):
    survived = analysed["all"]["stiffness_correlation"].sel(fate="survived")
    u = analysed["all"]["pattern"].values
    expected = np.corrcoef(u.ravel(), (u > 0.5).ravel())[0, 1]
    np.testing.assert_allclose(survived[0, 0, 1:], expected)
    assert np.isnan(survived[0, 0, 0])  # no disorder, no difference
    assert np.isnan(analysed["all"]["stiffness_correlation"].sel(fate="joined").values).all()
    joined = analysed["one"]["return_correlation"].sel(fate="joined").values
    assert np.all(joined[0, :, 2] < 0)  # who is out of tune moves alone, and does not join


def test_frequencies_of_masses_that_move():
    found = frequencies(peaks(), 1.5)
    np.testing.assert_allclose(found["frequency"][0, 0, :3], [1.0, 1.0, 1.02], rtol=1e-12)
    assert np.isnan(found["frequency"][0, 0, 3])
    np.testing.assert_allclose(found["frequency_spread"], np.std([1.0, 1.0, 1.02]))
    np.testing.assert_allclose(found["locked_share"], 0.5)  # of the pairs 1-2 and 2-3


def test_half_ways():
    assert halving(np.array([0.0, 1.0, 3.0]), np.array([10.0, 8.0, 0.0])) == 1.75
    assert np.isnan(halving(np.array([0.0, 1.0]), np.array([1.0, 2.0])))
    x = np.linspace(-2, 2, 5)
    assert half_width(x, np.array([0.0, 0.25, 1.0, 0.75, 0.0])) == pytest.approx((-2 / 3, 4 / 3))
    assert half_width(x, np.array([1.0, 1.0, 1.0, np.nan, 0.0])) == pytest.approx((-np.inf, 1.0))
    assert np.isnan(half_width(x, np.zeros(5))).all()


def test_the_summary_says_who_decides(analysed):
    said = "\n".join(summary(key, data) for key, data in analysed.items())
    assert "one: 30 chains in every point, all 180 runs ended well\n" in said
    assert "disorder takes part, from 20.00 without" in said
    assert "a neighbour is drawn in at detunings -0.0" in said
    assert said.splitlines()[-1].split()[-1] == "50"  # % of the neighbours agree
    flat = analysed["one"].isel(coupling=0, belt_speed=0).copy(deep=True)
    flat["participation_mean"][:] = [5.0, 5.01, 5.02]
    flat["participation_interval"][:] = [[4.9, 5.1]] * 3
    assert "friction decides" in verdict(flat)
    failed = analysed["one"].copy(deep=True)
    failed["result"][0, 0, 0, 0] = 3
    assert ", 1 of 180 runs FAILED" in summary("one", failed)


def test_the_picture_shows_every_row(analysed):
    page = draw(analysed)
    found = [row for row in rows(analysed) if row.coupling == 0.01]
    assert [(row.start, row.speed) for row in found] == [("one", 1.2), ("one", 1.3), ("all", 1.75)]
    first, second = page.axes[:2]
    labels = [line.get_label() for line in first.get_lines()]
    assert labels == ["1.2, one", "1.3, one", "1.75, all", "linear modes"]
    np.testing.assert_array_equal(
        first.get_lines()[0].get_ydata(), found[0].data["participation_mean"]
    )
    couplings = {line.get_label() for line in second.get_lines()}
    assert {r"$\eta_c = 0.001$", r"$\eta_c = 0.01$", r"$\eta_c = 0.05$"} <= couplings
    assert len(page.axes[3].texts) == 9  # three rows, three disorders


@pytest.mark.exhaustive
def test_a_small_study(tmp_path):
    small = [
        *(f"ensemble.{name}.chains=4" for name in ("disturbed", "one", "coupling", "half", "all")),
        *(f"ensemble.{name}.disorder=[0.0, 0.05]" for name in
          ("disturbed", "one", "coupling", "half", "all")),
        "ensemble.one.transient=300.0", "longer.chains=2", "locking.chains=2",
        "locking.disorder=[0.0, 0.05]",
    ]  # fmt: skip
    said = []
    data = run(load_scene("mistuning", small).scene, tmp_path, name="small", report=said.append)
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {"small.zarr", "small.nc", "small.png", "small.pdf", "report.html"}
    assert stored(tmp_path / "small")["half"].identical(data["half"])
    # Below the Hopf speed all vibrate, whatever the modes; in the middle each stays as it began.
    assert np.all(data["disturbed"]["participation_mean"][:, 0] > 19.5)
    np.testing.assert_array_equal(data["half"]["count_mean"][0, 0, 1], 10.0)
    assert np.all(data["all"]["active_count"][0, 1, 0] == 20)
    assert np.all(data["all"]["active_count"][0, 1, 1] < 20)
    assert data["locking"]["locked_share"][0].min() == 1.0
    assert said[4].startswith("all: 4 chains in every point, ")
