"""`report.html`: one file that tells of a folder of results, whoever has written the scene."""

import base64
import io
import shutil
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic
import xarray as xr
from matplotlib.figure import Figure
from PIL import Image

from jaxchain._outcomes import ADVICE
from jaxchain.cli import main
from jaxchain.scenes import reading, running
from jaxchain.scenes.errors import StudyFailedError
from jaxchain.scenes.pages import contents
from jaxchain.scenes.pages.page import PAGE, page_behind, renew_page
from jaxchain.scenes.pages.picture import as_text
from jaxchain.scenes.reading import LoadedScene, load_scene
from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.running import run_scene
from jaxchain.scenes.storage import Results
from jaxchain.studies._study import RESULT, Study

TITLE = "<script>alert('x')</script> & {{ 7 * 7 }}"
SCENE = f"""
title = "{TITLE}"
description = '<img src="http://far.away/x.png" onerror="alert(1)">'

[experiment.ladder]
description = "</pre><b>A ring of three"
chain = {{ n = 3, damping_ratio = 0.05, coupling = 0.01, friction = {{ \
law = "exponential_decay", mu_static = 1.0, mu_dynamic = 0.5, v_ref = 0.5, width = 1e-2 }} }}
initial = {{ kind = "equation_8" }}
sweep = {{ belt_speed = [1.4, 1.6], excited = [0, 1, 3] }}
time = {{ transient = 60.0, window = 20.0 }}
numerics = {{ model = "both" }}
"""
EMPTY = {"meta", "img", "br", "hr", "link", "input"}


class Reader(HTMLParser):
    """What a page holds; fails where an element is not closed, or another one is."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.images, self.headings, self.rows = [], [], [], [], []
        self.title = self.shown = self.style = ""
        self.attributes = {}
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            self.attributes.setdefault(name, []).append(value)
        if tag == "img":
            self.images.append(dict(attrs)["src"])
        if tag == "h2":
            self.headings.append("")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        where = self.open[-1] if self.open else ""
        if where == "title":
            self.title += data
        elif where == "style":
            self.style += data
        else:
            self.shown += data
        if where == "h2":
            self.headings[-1] += data
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def read(folder):
    return Reader((folder / PAGE).read_text(encoding="utf-8"))


def made_up_sweep(last_fails=True):
    """In the place of `sweep`: the last run of three masses fails, none of the others."""

    def sweep(chain, initial, t1, *, over, **options):
        axes = {name: np.asarray(values) for name, values in over.items()}
        vibrating = np.ones(tuple(map(len, axes.values())), int)
        vibrating[-1, -1] = -1 if last_fails else 1
        return synthetic.results(axes, vibrating, chain.n)

    return sweep


def scene_in(folder):
    (folder / "mine.toml").write_text(SCENE, encoding="utf-8")
    return load_scene(str(folder / "mine.toml"))


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """The folder of a run with its figure."""
    place = tmp_path_factory.mktemp("page")
    folder = place / "out"
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(running, "sweep", made_up_sweep())
        run_scene(scene_in(place), folder, report=lambda text: None, command="jaxchain run mine")
    return folder


@pytest.fixture
def folder(ran, tmp_path):
    """A copy of it, to be changed."""
    return Path(shutil.copytree(ran, tmp_path / "out"))


def test_it_is_well_formed_and_asks_for_nothing_from_elsewhere(ran):
    page = read(ran)
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(page.tags)
    assert not {"href", "action", "srcset", "data", "background"} & page.attributes.keys()
    assert not [name for name in page.attributes if name.startswith("on")]
    assert all(image.startswith("data:image/png;base64,") for image in page.images)
    assert not [word for word in ("url(", "@import", "http") if word in page.style]
    assert "prefers-color-scheme: dark" in page.style
    assert "width=device-width, initial-scale=1" in page.attributes["content"]
    assert any("default-src 'none'" in value for value in page.attributes["content"])
    assert (ran / PAGE).stat().st_size < 3e6


def test_what_a_stranger_has_written_stays_text(ran):
    page = read(ran)
    assert page.title == TITLE
    assert '<img src="http://far.away/x.png" onerror="alert(1)">' in page.shown
    assert "</pre><b>A ring of three" in page.shown
    assert "b" not in page.tags
    assert "<script" not in (ran / PAGE).read_text(encoding="utf-8")


def test_it_shows_the_figure(ran):
    (image,) = read(ran).images
    assert base64.b64decode(image.partition(",")[2]) == (ran / "mine.png").read_bytes()


def test_failures_come_first_with_advice(ran):
    page = read(ran)
    assert page.headings[:2] == ["Failures", "Figure"]
    before = page.shown.partition("Figure")[0]
    assert "ladder: 1 of 6 nonfinite." in before
    assert "belt_speed 1.6, excited 3" in before
    assert ADVICE["nonfinite"] in before
    start = page.rows.index(["dataset", "reason", "runs", "share", "what it means, what to do"])
    kinds = [row[:3] for row in page.rows[start + 1 : start + 5]]
    assert kinds[:2] == [["ladder", "nonfinite", "1"], ["ladder_nonsmooth", "nonfinite", "1"]]
    assert kinds[2:] == [["ladder", "successful", "5"], ["ladder_nonsmooth", "successful", "5"]]


def test_it_tells_what_was_asked_what_was_found_and_where_it_comes_from(ran):
    page = read(ran)
    assert (ran / "mine.toml").read_text(encoding="utf-8") in page.shown
    rows = {row[0]: row[1:] for row in page.rows}
    window = rows["experiment.NAME.time.window"]
    assert window == ["Time units over which amplitudes are measured; a period is about 2 pi."]
    chain = rows["experiment.NAME.chain"]
    assert chain[0].startswith("Masses, springs, belt and friction. A chain of masses on a belt:")
    assert rows["Hopf speed"] == ["1.1513 (steady sliding is stable above)"]
    assert rows["active_count"][0] == "belt_speed 2 x excited 3"
    assert rows["command"] == ["jaxchain run mine"]
    assert {"jax", "python", "started", "ended", "devices"} <= rows.keys()
    assert ["ladder", "friction", "smoothed over the width 0.001"] in page.rows
    assert ["ladder_nonsmooth", "friction", "true dry friction, no width"] in page.rows
    told = [row[1] for row in page.rows if row[0] == "chain"]
    assert ["width" in text for text in told] == ["truly dry" not in text for text in told]
    assert sorted("truly dry" in text for text in told) == [False, True]
    (compared,) = [row for row in page.rows if "against true dry friction" in row]
    assert "5 of 6 runs end with the same number of vibrating masses" in compared[2]
    assert "jaxchain run ./out" in page.shown


def test_its_python_opens_the_data(ran, monkeypatch):
    monkeypatch.chdir(ran)
    with xr.open_datatree("mine.nc") as tree:
        programs = dict(contents.programs("mine", {"ladder": tree["ladder"].to_dataset()}, []))
    assert list(programs) == ["Python", "MATLAB", "Julia", "R"]
    assert all(code.strip() in read(ran).shown for code in programs.values())
    found = {}
    exec(programs["Python"], found)
    assert found["energy"].dims == ("belt_speed", "excited")
    found["tree"].close()


def test_it_is_renewed_to_the_last_byte_from_what_lies_there(folder, monkeypatch, capsys):
    before = (folder / PAGE).read_bytes()
    (folder / PAGE).unlink()
    monkeypatch.chdir(folder.parent)
    assert main(["report", "out"]) == 0
    assert capsys.readouterr().out == f"out/{PAGE}\n"
    assert (folder / PAGE).read_bytes() == before
    (folder / "mine.png").unlink()
    (folder / "mine.toml").write_text("of another version", encoding="utf-8")
    assert main(["report", "out"]) == 0
    page = read(folder)
    assert not page.images
    assert "There is no figure" in page.shown
    assert "of another version" in page.shown


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere", "but nowhere is none."),
        ("out/mine.nc", "but out/mine.nc is a file: its folder is out."),
        ("empty", "but empty is a folder without a scene: it holds no TOML file."),
    ],
)
def test_a_report_of_what_is_no_folder_of_results_is_refused(
    name, words, folder, monkeypatch, capsys
):
    monkeypatch.chdir(folder.parent)
    (folder.parent / "empty").mkdir(exist_ok=True)
    assert main(["report", name]) == 2
    assert capsys.readouterr().err == (
        f"jaxchain: Argument `folder` must be a folder of results, {words}\n"
    )


def test_a_large_figure_becomes_smaller(folder):
    noise = np.random.default_rng(0).integers(0, 255, (1200, 1500, 3), np.uint8)
    Image.fromarray(noise).save(folder / "mine.png")
    assert (folder / "mine.png").stat().st_size > 4e6
    renew_page(folder)
    page = read(folder)
    assert (folder / PAGE).stat().st_size < 3e6
    with Image.open(io.BytesIO(base64.b64decode(page.images[0].partition(",")[2]))) as image:
        assert 500 < image.width < 1500
    assert "Smaller than mine.png" in page.shown
    (folder / "mine.png").write_bytes(b"no image" * 10**6)
    assert as_text(folder / "mine.png", 10**6) is None


def test_a_page_in_whose_place_nothing_can_be_written_costs_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(running, "sweep", made_up_sweep())
    (tmp_path / "out" / PAGE).mkdir(parents=True)
    loaded = scene_in(tmp_path)
    found = run_scene(loaded, tmp_path / "out", plot=False, report=lambda text: None)
    assert list(found) == ["ladder", "ladder_nonsmooth"]
    said = capsys.readouterr().err
    assert said == f"jaxchain: cannot write {tmp_path / 'out' / PAGE}: Is a directory\n"


@pytest.fixture
def figure_there(tmp_path):
    """Of 240 kB, written while there is room."""
    noise = np.random.default_rng(0).integers(0, 255, (200, 400, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "mine.png")


@pytest.mark.usefixtures("figure_there", "short_of_room")
def test_a_disk_without_room_for_it_costs_nothing(tmp_path, capsys):
    results = Results(tmp_path, "mine")
    with page_behind(results, None):
        results.save("one", xr.Dataset({"a": ("x", [1.0])}))
    assert "cannot write" in (said := capsys.readouterr().err)
    assert said.endswith("File too large\n")
    assert {file.name for file in tmp_path.iterdir()} == {"mine.nc", "mine.png", "mine.zarr"}


def test_a_run_that_is_interrupted_has_one_if_it_has_anything(tmp_path, monkeypatch):
    (tmp_path / "nothing").mkdir()
    (tmp_path / "first").mkdir()
    loaded, calls = scene_in(tmp_path), []

    def sweep(*arguments, **options):
        calls.append(arguments)
        if len(calls) != 2:
            raise KeyboardInterrupt
        return made_up_sweep(last_fails=False)(*arguments, **options)

    monkeypatch.setattr(running, "sweep", sweep)
    for name in ("nothing", "first"):
        with pytest.raises(KeyboardInterrupt):
            run_scene(loaded, tmp_path / name, plot=False, report=lambda text: None)
    assert [path.name for path in (tmp_path / "nothing").iterdir()] == ["mine.toml"]
    page = read(tmp_path / "first")
    assert page.headings[0] == "Failures"
    assert "Not all was computed. Missing: ladder_nonsmooth." in page.shown


def test_of_a_study_it_holds_what_the_study_says(tmp_path, monkeypatch):
    def part(table, job):
        speed = ("place", [1.0, 1.5], {"long_name": "half-width of the 95 % interval"})
        return xr.Dataset({"error": speed, "result": ("place", [0, 5], RESULT)})

    study = Study(
        parts={"first": part}, report=lambda name, data: f"{name}: <{data.sizes['place']}>",
        figure=lambda datasets: Figure(), fault=lambda datasets: "1 of 2 is WRONG",
    )  # fmt: skip
    for module in (running, contents):
        monkeypatch.setattr(module, "study_run", lambda name: study)
    monkeypatch.setattr(reading, "studies", lambda: ["made_up"])
    monkeypatch.setattr(reading, "study_table", lambda name: StudyTable)
    folder = tmp_path / "out"
    folder.mkdir()
    loaded = LoadedScene("mine", StudyTable(study="made_up", title="A study"))
    with pytest.raises(StudyFailedError, match="WRONG"):
        run_scene(loaded, folder, plot=False, report=lambda text: None)
    page = read(folder)
    assert (page.title, page.headings[0]) == ("A study", "Failures")
    assert "1 of 2 is WRONG" in page.shown
    assert "first: 1 of 2 untrusted_linear_solve." in page.shown
    assert "first: <2>" in page.shown
    assert ["first", "error", "half-width of the 95 % interval", "", "1 to 1.5"] in page.rows
    assert ["study", "Which study this file is for."] in page.rows
    renew_page(folder)
    assert read(folder).shown == page.shown


def test_what_cannot_be_told_is_left_out(tmp_path, monkeypatch):
    """A study that has changed since, say."""

    def broken(name, data):
        raise KeyError("speed")

    monkeypatch.setattr(contents, "study_run", lambda name: SimpleNamespace(report=broken))
    results = Results(tmp_path, "mine")
    about = {"definition": '{"study": "made_up", "title": "A study"}'}
    with page_behind(results, None):
        results.save("one", xr.Dataset({"a": ("x", [1.0])}, attrs=about))
    assert ["a", "x 1", "", "", "1"] in read(tmp_path).rows
