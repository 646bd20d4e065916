"""What was run is written so that it can be run again: the same scene, from the folder alone."""

import json
import os
import tomllib

import jax
import pytest

import jaxchain
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.files import builtin_scenes
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.writing import as_run, circumstances, scene_files, to_toml

SCENE = """
title = "A test"

[experiment.pair]
chain = { n = 2, damping_ratio = [0.05, 0.06], friction = { law = "tabulated", file = "mu.csv", \
width = 1e-2 } }
initial = { kind = "excited", oscillators = [2] }
sweep = { velocity = { start = 1, stop = 0.7, step = -0.1 }, belt_speed = [1.0, 1.5] }
time = { transient = 0.5, window = 6.5 }
observe = { others = [{ observer = "Section", oscillator = 2 }, { observer = "Divergence" }] }
"""
TEXTS = [
    "", 'one "line"', "two\nlines", '\n"""\n', "a\\nb \\", "tab\t, bell \a, \x7f, \u0085",
    "ξ ũ 🎻", "\r\n", "ends\\\n", "'", "#", " = ",
]  # fmt: skip


def written(folder, loaded, **own):
    """The folder as a run leaves it, but for the results."""
    folder.mkdir()
    files = scene_files(loaded.name, as_run(loaded.scene, **own), circumstances())
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return str(folder)


@pytest.mark.parametrize("name", builtin_scenes())
def test_every_built_in_scene_comes_back_as_it_was(name, tmp_path):
    loaded = load_scene(name)
    again = load_scene(written(tmp_path / "results", loaded))
    assert again == loaded
    # An equal dictionary may have another order, and so may the axes of a sweep.
    assert again.scene.model_dump_json() == loaded.scene.model_dump_json()


def test_what_a_scene_was_given_comes_back_from_its_folder_alone(tmp_path):
    (tmp_path / "mu.csv").write_text("0,1\n1,0.5\n3,0.7\n", encoding="utf-8")
    file = tmp_path / "own.toml"
    file.write_text(SCENE, encoding="utf-8")
    overrides = ["experiment.pair.time.window=7", "experiment.pair.numerics.lanes=3"]
    loaded = load_scene(str(file), overrides)
    folder = written(tmp_path / "results", loaded)
    (tmp_path / "mu.csv").unlink()
    again = load_scene(folder)
    assert again == loaded
    experiment = again.scene.experiment["pair"]
    assert list(experiment.grid()) == ["velocity", "belt_speed"]
    assert (experiment.time.window, experiment.numerics.lanes) == (7.0, 3)
    assert experiment.chain.friction.speed == [0.0, 1.0, 3.0]
    other = load_scene(folder, ["experiment.pair.sweep.belt_speed=[2.0]"]).scene
    assert other.experiment["pair"].grid()["belt_speed"].tolist() == [2.0]


@pytest.mark.parametrize("text", TEXTS)
def test_any_text_comes_back_as_a_value_a_key_and_in_a_list(text):
    data = {"a": text, text: [text, {text: text}], "t": {text: {"inner": text}, "b": []}, "e": {}}
    assert tomllib.loads(to_toml(data)) == data


def test_any_number_comes_back():
    numbers = [1e-300, 1e16, 0.1 + 0.2, -0.0, 5e-324, 10**18, -3, True, False, float("inf")]
    back = tomllib.loads(to_toml({"numbers": numbers}))["numbers"]
    assert list(map(repr, back)) == list(map(repr, numbers))


def test_a_file_says_in_comments_what_else_the_results_depend_on(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--some_flag=1")
    about = circumstances("jaxchain run 'two\nlines' " + os.fsdecode(b"\xff"))
    text = scene_files("x", {"title": "A"}, about)["x.toml"].decode()
    assert tomllib.loads(text) == {"title": "A"}
    comments = [line[2:] for line in text.splitlines() if line.startswith("# ") and " = " in line]
    said = tomllib.loads("\n".join(comments))
    assert said == {**about, "versions": json.loads(about["versions"])}
    assert said["command"] == "jaxchain run 'two\nlines' \\udcff"
    assert said["xla_flags"] == "--some_flag=1"
    assert said["devices"] == f"{len(jax.devices())} x {jax.devices()[0].device_kind}"
    assert said["versions"]["jaxchain"] == jaxchain.__version__
    assert said["versions"].keys() >= {"jax", "jaxlib", "diffrax", "equinox", "numpy"}
    assert said["started"].endswith("+00:00")


def test_copies_of_own_code_do_not_hide_each_other(tmp_path):
    for folder, text in (("a", "1"), ("b", "2"), ("c", "1")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.py").write_text(text, encoding="utf-8")
    files = scene_files("x", {}, {}, [tmp_path / folder / "own.py" for folder in "abca"])
    del files["x.toml"]
    assert files == {"own.py": b"1", "own-2.py": b"2"}


def test_own_code_is_asked_for_wherever_it_was_used(tmp_path):
    """Also where the scene named a law that it took the place of, or no observer."""
    loaded = load_scene("quickstart")
    folder = written(tmp_path / "results", loaded, own_law=True, own_observers=["Mine"])
    experiment = load_scene(folder).scene.experiment["ladder"]
    assert experiment.chain.friction.model_dump() == {
        "law": "own", "width": 1e-3, "mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5,
    }  # fmt: skip
    assert [other.model_dump() for other in experiment.observe.others] == [
        {"observer": "own", "name": "Mine"}
    ]
    once_more = load_scene(folder).scene
    assert as_run(once_more, own_observers=["Mine"]) == as_run(once_more)


def test_a_folder_with_no_scene_or_several_says_so(tmp_path):
    with pytest.raises(SceneError, match="is a folder without a scene: it holds no TOML file"):
        load_scene(str(tmp_path))
    with pytest.raises(SceneError, match="cannot be read"):
        load_scene("x" * 300)
    for name in ("b", "a"):
        (tmp_path / f"{name}.toml").write_text("", encoding="utf-8")
    with pytest.raises(SceneError, match=r"with several scenes: name one of a\.toml, b\.toml"):
        load_scene(str(tmp_path))
