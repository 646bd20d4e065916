"""`report.html`: one file that shows a folder of results, for any text in the scene."""

import base64
from html.parser import HTMLParser

import pytest
import xarray as xr
from synthetic import results

from jaxchain._outcomes import ADVICE
from jaxchain.cli import main
from jaxchain.scenes.report import PAGE, renew_page, summary
from jaxchain.scenes.running import run_scene
from jaxchain.scenes.scene import load_scene

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


class Reader(HTMLParser):
    """The content of a page; fails if the wrong element is closed."""

    def __init__(self, folder):
        super().__init__()
        self.open, self.tags, self.images, self.headings, self.attributes = [], [], [], [], set()
        self.shown, self.within = "", {"title": "", "style": ""}
        self.feed((folder / PAGE).read_text(encoding="utf-8"))
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}
        self.images += [value for name, value in attrs if (tag, name) == ("img", "src")]
        self.open.append(tag)

    def handle_endtag(self, tag):
        while self.open.pop() != tag:
            pass

    def handle_data(self, data):
        where = self.open[-1] if self.open else ""
        if where in self.within:
            self.within[where] += data
        else:
            self.shown += data
        self.headings += [data] * (where == "h2")


@pytest.fixture(scope="module")
def ran(tmp_path_factory, made_up_sweep):
    """The folder of a run with its figure."""
    folder = tmp_path_factory.mktemp("page") / "out"
    folder.mkdir()
    file = folder.parent / "mine.toml"
    file.write_text(SCENE, encoding="utf-8")
    run_scene(load_scene(str(file)), folder, report=lambda text: None, command="jaxchain run mine")
    return folder


def test_it_asks_for_nothing_from_elsewhere_and_what_a_stranger_wrote_stays_text(ran):
    page = Reader(ran)
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(page.tags)
    assert not {"href", "action", "srcset", "background"} & page.attributes
    assert not [name for name in page.attributes if name.startswith("on")]
    assert page.within["title"] == TITLE
    assert '<img src="http://far.away/x.png" onerror="alert(1)">' in page.shown
    assert "</pre><b>A ring of three" in page.shown
    assert "b" not in page.tags
    assert "Content-Security-Policy" in (ran / PAGE).read_text(encoding="utf-8")


def test_it_shows_failures_first_the_figure_the_results_and_what_was_asked(ran):
    page = Reader(ran)
    assert page.headings[:2] == ["Failures", "Figure"]
    (image,) = page.images
    assert base64.b64decode(image.partition(",")[2]) == (ran / "mine.png").read_bytes()
    before = page.shown.partition("Figure")[0]
    assert "belt_speed 1.6, excited 3: nonfinite" in before
    assert ADVICE["nonfinite"] in before
    for text in (
        (ran / "mine.toml").read_text(encoding="utf-8"),
        'command = "jaxchain run mine"',
        "Hopf speed    1.1513 (steady sliding is stable above)",
        "5 successful, 1 nonfinite",
        "ExponentialDecay, truly dry",
        'xr.open_datatree("mine.zarr")',
        "jaxchain run ./out",
    ):
        assert text in page.shown


def test_it_is_renewed_from_what_lies_there(ran, monkeypatch, capsys):
    before = Reader(ran)
    (ran / PAGE).unlink()
    monkeypatch.chdir(ran.parent)
    assert main(["report", "out"]) == 0
    assert capsys.readouterr().out == f"out/{PAGE}\n"
    # Files keep no order of variables.
    assert sorted(Reader(ran).shown) == sorted(before.shown)
    (ran / "mine.png").rename(ran / "other.png")
    (ran / "mine.toml").write_text("of another version", encoding="utf-8")
    renew_page(ran)
    page = Reader(ran)
    assert not page.images
    assert "of another version" in page.shown


def test_a_page_that_cannot_be_written_costs_nothing(tmp_path, made_up_sweep):
    (tmp_path / "mine.toml").write_text(SCENE, encoding="utf-8")
    (tmp_path / "out" / PAGE).mkdir(parents=True)
    loaded = load_scene(str(tmp_path / "mine.toml"))
    with pytest.warns(UserWarning, match=r"cannot write .*report.html: Is a directory"):
        found = run_scene(loaded, tmp_path / "out", plot=False, report=lambda text: None)
    assert list(found) == ["ladder", "ladder_dry"]


def test_a_summary_names_the_speeds_that_vibrate_and_five_failures():
    axes = {"belt_speed": [1.0, 1.2, 1.4, 1.6], "excited": [0, 3]}
    text = summary("mine", results(axes, [[1, 1], [0, 1], [0, 0], [-1, 1]], 4))
    assert "vibrating     at belt speeds 1 to 1.2, 1.6\n" in text
    assert "sliding       at belt speeds 1.2 to 1.4\n" in text
    assert "failed        belt_speed 1.6, excited 0: nonfinite\n" in text
    assert "of" not in summary("mine", results(axes, [[1, 1]] * 4, 4)).partition("failed")[2]
    cut = xr.Dataset({"fold_belt_speed": 1.8, "fold_amplitude": 1.7}, attrs={"cut_off": "why"})
    assert "  cut off       why" in summary("one_cycles", cut)
    text = summary("mine", results(axes, [[-1, -1]] * 4, 4))
    assert text.count(": nonfinite") == 5
    assert "and 3 more, see `result`" in text
