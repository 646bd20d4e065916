"""Studies: found, checked and listed like scenes, run into a folder like scenes."""

import json
import tomllib
from pathlib import Path
from typing import Literal

import matplotlib.figure
import numpy as np
import pytest
import xarray as xr
from pydantic import Field
from synthetic import stored

from jaxchain.cli import main
from jaxchain.scenes import storage
from jaxchain.scenes.errors import SceneError, StudyFailedError
from jaxchain.scenes.files import builtin_scenes
from jaxchain.scenes.reading import load_scene, schema
from jaxchain.scenes.registry import StudyTable, studies, study_run, study_table
from jaxchain.scenes.tables import FrictionTable
from jaxchain.scenes.values import Table
from jaxchain.studies.states.table import Study


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path


class Part(Table):
    size: float


class MadeUp(StudyTable):
    study: Literal["made_up"]
    part: Part
    parts: dict[str, Part] = Field(default_factory=dict)
    several: list[Part] = Field(default_factory=list)
    friction: FrictionTable | None = None


class MadeUpModule:
    """What a module `study` offers."""

    fails = False

    @classmethod
    def run(cls, study, folder, *, name, plot, progress, report):
        data = xr.Dataset({"size": ("part", [study.part.size])})
        results = storage.Results.of(folder, name)
        results.save("sizes", data)
        report(f"size {study.part.size}")
        if plot:
            results.draw(matplotlib.figure.Figure)
        if cls.fails:
            raise StudyFailedError("1 of 1 sizes is WRONG")
        return results.datasets


@pytest.fixture
def made_up(workplace, monkeypatch):
    """A study of the name `made_up`, and a file of it."""
    monkeypatch.setattr("jaxchain.scenes.reading.studies", lambda: ["made_up", "states"])
    monkeypatch.setattr("jaxchain.scenes.reading.study_table", lambda name: MadeUp)
    monkeypatch.setattr("jaxchain.scenes.running.study_run", lambda name: MadeUpModule.run)
    text = 'study = "made_up"\ntitle = "A test"\npart = { size = 2.5 }\n'
    Path("mine.toml").write_text(text, encoding="utf-8")
    return "mine.toml"


def scenes_of_studies():
    """Which study each built-in scene asks for (None: it is a sweep); one may have several."""
    return {
        name: tomllib.loads(file.read_text(encoding="utf-8")).get("study")
        for name, file in builtin_scenes().items()
    }


@pytest.mark.parametrize("name", studies())
def test_every_study_has_its_file_its_table_and_its_run(name):
    own = [load_scene(scene) for scene, study in scenes_of_studies().items() if study == name]
    assert own, f"the study {name} has no built-in scene"
    assert all(type(loaded.scene) is study_table(name) for loaded in own)
    assert study_table(name).model_fields["study"].annotation == Literal[name]
    assert callable(study_run(name))


def test_every_scene_of_a_study_has_its_study():
    assert set(scenes_of_studies().values()) - {None} == set(studies())


def test_an_unknown_study_has_neither_table_nor_run():
    for look_up in (study_table, study_run):
        with pytest.raises(ModuleNotFoundError, match="nothing"):
            look_up("nothing")


def test_a_study_runs_into_its_folder(made_up, capsys):
    assert main(["run", made_up, "--set", "part.size=3"]) == 0
    files = {file.name for file in Path("results/mine").iterdir()}
    kinds = ("toml", "zarr", "nc", "png", "pdf")
    assert files == {"report.html", *(f"mine.{kind}" for kind in kinds)}
    assert stored(Path("results/mine/mine"))["sizes"]["size"].values.tolist() == [3.0]
    again = load_scene("results/mine").scene
    assert again == load_scene(made_up, ["part.size=3"]).scene
    assert "size 3.0" in capsys.readouterr().out
    assert main(["run", made_up, "--no-plot", "--quiet"]) == 0
    said = capsys.readouterr()
    assert said.out == ""
    assert "the results go to results/mine-2" in said.err
    assert not Path("results/mine-2/mine.png").exists()


def test_a_study_that_fails_ends_with_1_and_keeps_its_results(made_up, monkeypatch, capsys):
    monkeypatch.setattr(MadeUpModule, "fails", True)
    assert main(["run", made_up, "--no-plot"]) == 1
    assert capsys.readouterr().err == "jaxchain: 1 of 1 sizes is WRONG\n"
    assert Path("results/mine/mine.zarr").exists()


def test_a_drawing_that_fails_costs_no_data(made_up, monkeypatch, capsys):
    def broken(page, path):
        raise RuntimeError("no ink")

    monkeypatch.setattr(storage, "save_figure", broken)
    assert main(["run", made_up]) == 1
    assert "the results are in results/mine, but drawing" in capsys.readouterr().err
    assert Path("results/mine/mine.nc").exists()


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("part.size=x", 'part.size: must be a number, but is "x"'),
        ("part.size=nan", "part.size: must be a finite number, but is nan"),
        (
            "part.sice=1",
            "part.sice: is not a known key (did you mean `size`?); allowed: size",
        ),
        (
            "titel=x",
            "titel: is not a known key (did you mean `title`?); allowed: study, title, "
            "description, part, parts, several, friction",
        ),
        ("title=''", "title: must not be empty"),
        ("part=1", "part: must be a table, but is 1"),
        ("parts.one.weight=1", "parts.one.weight: is not a known key; allowed: size"),
        (
            "several=[{size=1},{size=1,weight=1}]",
            "several[1].weight: is not a known key; allowed: size",
        ),
        (
            "friction={law='coulomb',mu_static=1}",
            "friction.mu_static: is not a known key (did you mean `mu_dynamic`?); allowed: law, "
            "width, mu_dynamic",
        ),
        (
            "study=made_upp",
            'study: must be one of "made_up", "states", but is "made_upp" (did you mean '
            "`made_up`?); without it the file is a scene",
        ),
        ("study=[1]", 'study: must be one of "made_up", "states", but is a list'),
    ],
)
def test_a_wrong_key_is_named_with_value_and_remedy(made_up, override, problem):
    with pytest.raises(SceneError) as error:
        load_scene(made_up, [override, *(["parts.one.size=1"] if "parts." in override else [])])
    assert any(found.startswith(problem) for found in error.value.problems), error.value.problems


def test_a_wrong_study_ends_with_2_before_anything_is_made(made_up, capsys):
    assert main(["run", made_up, "--set", "part.size=x"]) == 2
    assert (
        "scene mine.toml has an error:\n  part.size: must be a number" in capsys.readouterr().err
    )
    assert not Path("results").exists()


def test_studies_are_listed_shown_and_described(workplace, capsys):
    assert main(["scenes"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert load_scene("fig6").scene.title in lines["fig6"]
    assert main(["scenes", "fig6"]) == 0
    shown = capsys.readouterr().out
    Path("own.toml").write_text(shown.replace("1e-7", "1e-6"), encoding="utf-8")
    assert load_scene("own.toml").scene.states.numerics.rtol == 1e-6
    assert main(["scenes", "fig6", "--schema"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert set(described["properties"]) == set(Study.model_fields)
    assert schema(Study) == described
    assert np.all(["description" in described["properties"][key] for key in ("panels", "states")])
