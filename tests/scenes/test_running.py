"""Scenes with smoothed friction, with true dry friction, and with both on one picture."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from synthetic import stored

from jaxchain import find_limit_cycle, fold_belt_speed, paper_chain, simulate
from jaxchain.observers.stick_time import StickTime
from jaxchain.plotting.sweeps import figure
from jaxchain.scenes import running
from jaxchain.scenes.boundaries import cycles, hopf_speed
from jaxchain.scenes.building import build_chain, build_observers, describe_start
from jaxchain.scenes.errors import SceneError, StudyFailedError
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.running import run_experiment, run_scene
from jaxchain.scenes.tables import TimeTable

SCENE = """
title = "Three masses"

[experiment.ladder]
chain = { n = 3, damping_ratio = 0.05, coupling = 0.01, friction = { law = "exponential_decay", \
mu_static = 1.0, mu_dynamic = 0.5, v_ref = 0.5, width = 1e-2 } }
initial = { kind = "equation_8" }
sweep = { belt_speed = [1.4, 1.6], excited = [0, 1, 3] }
time = { transient = 60.0, window = 20.0 }
numerics = { model = "MODEL" }
"""


def scene(tmp_path, model, more=""):
    file = tmp_path / "three.toml"
    file.write_text(SCENE.replace("MODEL", model) + more, encoding="utf-8")
    return load_scene(str(file))


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("both")
    reports = []
    data = run_scene(scene(folder, "both"), folder, plot=False, report=reports.append)
    return folder, data, reports


def test_both_models_share_a_file(both):
    folder, data, reports = both
    assert list(data) == ["ladder", "ladder_nonsmooth"]
    saved = stored(folder / "three")
    assert saved.keys() == data.keys()
    smoothed, dry = saved.values()
    assert smoothed.attrs["model"] == "smoothed"
    assert smoothed["amplitude"].dims == ("belt_speed", "excited", "oscillator")
    assert dry.attrs["model"] == "nonsmooth"
    assert "EventDriven" in dry.attrs["solver"]
    assert len(reports) == 2


def test_the_two_differ_by_the_width_and_by_no_more(both):
    """Relative amplitudes of the vibrating masses, at a width of 1e-2."""
    _, data, _ = both
    smoothed, dry = data["ladder"], data["ladder_nonsmooth"]
    assert np.array_equal(smoothed["active_count"], dry["active_count"])
    vibrates = smoothed["amplitude"].values > 1.0
    ratio = smoothed["amplitude"].values[vibrates] / dry["amplitude"].values[vibrates]
    assert np.all(np.abs(ratio - 1) < 0.05)
    assert np.all(np.abs(ratio - 1) > 0.001)


def test_the_truth_is_drawn_around_the_points_of_its_own_panel(both):
    _, data, _ = both
    page = figure(data)
    legend = page.axes[0].get_legend()
    assert legend is not None
    labels = [text.get_text() for text in legend.get_texts()]
    assert "true dry friction" in labels
    ring = next(a for a in page.axes[0].lines if a.get_label() == "true dry friction")
    heights = data["ladder_nonsmooth"]["energy"].values.ravel()
    np.testing.assert_allclose(np.sort(ring.get_ydata()), np.sort(heights))
    assert len([axes for axes in page.axes if axes.get_ylabel()]) <= 2  # a panel, a colour bar


def test_true_dry_friction_alone_goes_by_the_name_of_the_experiment(tmp_path, monkeypatch):
    # Cycles are looked for with smoothed friction only.
    monkeypatch.setattr(running, "cycles", lambda *of: pytest.fail("asked for cycles"))
    data = run_scene(scene(tmp_path, "nonsmooth"), tmp_path, plot=False, report=lambda text: None)
    assert list(data) == ["ladder"]
    assert data["ladder"].attrs["model"] == "nonsmooth"


def test_who_runs_an_experiment_may_bring_a_start_and_an_observer(tmp_path):
    experiment = scene(tmp_path, "nonsmooth").scene.experiment["ladder"]
    short = experiment.model_copy(
        update={
            "time": TimeTable(transient=0.0, window=3.0),
            "sweep": {"belt_speed": [0.5], "excited": [1.0]},
        }
    )
    run = partial(run_experiment, short, model="nonsmooth")

    def start(chain, excited):
        return jnp.full(chain.n, 0.1 * excited), jnp.full(chain.n, 0.5)

    data = run(initial=start, observe=StickTime())
    assert "amplitude" not in data
    # Carried from 0.1 to where k x = 1 - 2 xi v, all alike.
    np.testing.assert_allclose(data["stick_time"].values.ravel(), (0.95 - 0.1) / 0.5, atol=1e-6)


@pytest.mark.long
def test_the_width_has_no_part_in_true_dry_friction(tmp_path):
    scene(tmp_path, "nonsmooth")
    found = []
    for width in (1e-2, 1e-6):
        change = f"experiment.ladder.chain.friction.width={width}"
        loaded = load_scene(str(tmp_path / "three.toml"), [change])
        found.append(run_experiment(loaded.scene.experiment["ladder"], model="nonsmooth"))
    assert np.array_equal(found[0]["amplitude"], found[1]["amplitude"])


def test_names_must_not_meet(tmp_path):
    second = SCENE.split("\n\n")[1].replace("MODEL", "both").replace("ladder", "ladder_nonsmooth")
    with pytest.raises(SceneError, match="ladder_nonsmooth"):
        scene(tmp_path, "both", "\n" + second)


def one_oscillator(tmp_path, count, model="smoothed"):
    text = SCENE.replace("MODEL", model).replace("n = 3", "n = 1").replace("coupling = 0.01, ", "")
    text = text.replace('"equation_8"', '"excited", excited = 1')
    speeds = f"{{ start = 1.0, stop = 1.9, count = {count} }}"
    text = text.replace("[1.4, 1.6], excited = [0, 1, 3]", f"{speeds}, displacement = [0.5, 2.0]")
    file = tmp_path / "one.toml"
    file.write_text(text, encoding="utf-8")
    return load_scene(str(file))


@pytest.mark.long
def test_the_branch_of_cycles_is_saved_before_it_is_drawn(tmp_path):
    run_scene(one_oscillator(tmp_path, 10), tmp_path, plot=False, report=lambda text: None)
    saved = stored(tmp_path / "one")
    cycles, chain = saved["ladder_cycles"], paper_chain(1, width=1e-2)
    fold = cycles["fold_belt_speed"].item()
    assert fold == pytest.approx(float(fold_belt_speed(chain)), rel=1e-12)
    assert cycles["belt_speed"].max() <= fold + 1e-9
    # A stable and an unstable cycle of speed 1.5, and a run that reaches the stable one.
    stable = cycles["stable"].values
    below = [np.interp(1.5, *ordered(cycles, side)) for side in (stable, ~stable)]
    assert below[0] > below[1] > 0
    found = find_limit_cycle(chain.with_(belt_speed=1.5))
    assert below[0] == pytest.approx(float(found.amplitude[0]), rel=1e-3)
    assert saved["ladder"]["displacement"].attrs["units"] == "x0"
    hopf = saved["ladder"]["hopf_belt_speed"].item()
    assert hopf == pytest.approx(0.5 * np.log(10), rel=1e-12)


def ordered(cycles, which):
    speed, amplitude = (cycles[name].values[which] for name in ("belt_speed", "amplitude"))
    order = np.argsort(speed)
    return speed[order], amplitude[order]


def test_what_a_start_is_made_of_has_its_unit():
    data = xr.Dataset({"velocity": ("time", [0.0])}, coords={"displacement": [0.5, 2.0]})
    data["displacement"].attrs["units"] = "1"
    describe_start(data)
    words = "how far excited masses are pulled away at the start"
    assert data["displacement"].attrs == {"long_name": words, "units": "x0"}
    assert not data["velocity"].attrs  # no coordinate, and so not swept


def test_a_few_belt_speeds_have_no_branch(tmp_path):
    experiment = one_oscillator(tmp_path, 3).scene.experiment["ladder"]
    assert cycles(build_chain(experiment), experiment.grid()) is None


@pytest.mark.long
def test_dry_friction_has_no_branch(tmp_path):
    loaded = one_oscillator(tmp_path, 10, "nonsmooth")
    data = run_scene(loaded, tmp_path, plot=False, report=lambda text: None)
    assert list(data) == ["ladder"]


def test_the_hopf_speed_follows_what_is_swept():
    chain, damping = paper_chain(4), np.array([0.05, 0.1])
    grid = {"belt_speed": np.array([1.0, 1.5]), "damping_ratio": damping, "excited": np.arange(2)}
    found = hopf_speed(chain, grid)
    assert found is not None
    assert found.dims == ("damping_ratio",)
    np.testing.assert_allclose(found, 0.5 * np.log(0.5 / damping), rtol=1e-12)
    assert hopf_speed(chain, {"damping_ratio": damping}) is None
    uneven = chain.with_(damping_ratio=np.array([0.05, 0.05, 0.06, 0.05]))
    assert hopf_speed(uneven, {"belt_speed": np.array([1.0, 1.5])}) is None


def test_no_experiment_is_named_like_the_cycles_of_another(tmp_path):
    second = SCENE.split("\n\n")[1].replace("MODEL", "both").replace("ladder", "ladder_cycles")
    with pytest.raises(SceneError, match="the cycles of `ladder`"):
        scene(tmp_path, "both", "\n" + second)


def test_an_unknown_model_is_refused(tmp_path):
    with pytest.raises(SceneError, match="nonsmooth"):
        scene(tmp_path, "rough")


def test_what_only_the_numbers_together_show_is_told_of_all_experiments_before_any_runs(tmp_path):
    rough = [f"experiment.{name}.numerics.rtol=0.5" for name in ("single", "ladder")]
    with pytest.raises(SceneError) as error:
        run_scene(load_scene("fig3", rough), tmp_path, plot=False)
    single, ladder = error.value.problems
    assert single.startswith("experiment.single: Arguments `rtol` = 0.5 and `atol` = 0.05 are too")
    assert ladder.startswith("experiment.ladder: Arguments `rtol` = 0.5")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("fails", "kind", "said"),
    [
        (
            lambda: jnp.ones(10**14),
            MemoryError,
            r"out of memory \(RESOURCE.*\): take fewer",
        ),
        (
            lambda: np.ones(10**15),
            MemoryError,
            r"out of memory \(Unable to .*\): take fewer",
        ),
        (lambda: bytes(10**18), MemoryError, "^out of memory: take fewer values, masses or"),
        (lambda: paper_chain(0), SceneError, "has an error:\n  Argument `n` must be an integer"),
        (
            lambda: simulate(
                paper_chain(1, 1.9), (jnp.full(1, 0.6), jnp.zeros(1)), 9.0, max_steps=2
            ),
            StudyFailedError,
            "max_steps_reached",
        ),
    ],
)
def test_what_fails_on_the_way_through_a_study_is_said_in_words(
    fails, kind, said, tmp_path, monkeypatch
):
    monkeypatch.setattr(running, "study_run", lambda name: lambda *table, **how: fails())
    with pytest.raises(kind, match=said) as error:
        run_scene(load_scene("fig6"), tmp_path)
    assert len(str(error.value)) < 2000


OTHERS = """
observe = { quantities = ["energy"], others = [
    { observer = "StickTime", window = 20.0 }, { observer = "PeakTimes", capacity = 3 },
    { observer = "Section", oscillator = 2, capacity = 2, start = 50.0 },
    { observer = "Samples", interval = 10.0, capacity = 3, oscillators = [3] },
    { observer = "FrontTrack", windows = 2, middle = 2 }, { observer = "MostSticking" },
    { observer = "EnergyBalance" }, { observer = "Divergence" },
] }
"""


FEW = """
observe = { quantities = ["energy"], others = [
    { observer = "StickTime", window = 20.0 },
    { observer = "Section", oscillator = 2, capacity = 2, start = 50.0 },
    { observer = "EnergyBalance" },
] }
"""


def test_a_scene_observes_what_it_names(tmp_path):
    experiment = scene(tmp_path, "nonsmooth", OTHERS).scene.experiment["ladder"]
    assert len(build_observers(experiment.observe, 20.0)) == 9
    data = run_scene(scene(tmp_path, "nonsmooth", FEW), tmp_path, plot=False, report=str)
    found = data["ladder"].sel(excited=1, belt_speed=1.4)
    assert "amplitude" not in found
    assert np.argmax(found.stick_time.values) == 1
    assert np.argmax(found.section_displacement.values[0]) == 1
    assert found.section_time.min() > 50.0
    gained = found.belt_work - found.energy_lost
    np.testing.assert_allclose(gained, found.energy_stored, atol=1e-3)
    saved = stored(tmp_path / "three")["ladder"]
    assert saved["stick_time"].attrs["units"] == "1 / omega_n"


@pytest.mark.long
def test_a_scene_has_what_all_observers_saw(tmp_path):
    data = run_scene(scene(tmp_path, "nonsmooth", OTHERS), tmp_path, plot=False, report=str)
    found = data["ladder"].sel(excited=1, belt_speed=1.4)
    assert "amplitude" not in found
    assert np.argmax(found.stick_time.values) == 1
    assert np.argmax(found.section_displacement.values[0]) == 1
    assert found.section_time.min() > 50.0
    assert found.sampled_oscillator.size == 1
    assert int(found.most_sticking) == 1
    gained = found.belt_work - found.energy_lost
    np.testing.assert_allclose(gained, found.energy_stored, atol=1e-3)
    saved = stored(tmp_path / "three")["ladder"]
    assert saved["stick_time"].attrs["units"] == "1 / omega_n"
