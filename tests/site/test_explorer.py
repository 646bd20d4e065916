"""The explorer in Chromium: what a visitor does, and what he sees."""

import re
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.site

# The model of Bokeh of a kind, and with a title.
MODEL = """(() => [...Bokeh.documents[0]._all_models.values()].find(one => one.type == "{kind}"
    && String(one.title?.text ?? one.title ?? "").startsWith("{title}")))()"""
MOVING = "(() => Bokeh.documents[0] && [...Bokeh.documents[0]._all_models.values()]"
MOVING += '.some(one => one.type == "Figure" && one.tags[0] > {frame}))()'


@pytest.fixture(scope="module")
def served():
    """The address of an explorer that the command has started; it ends without a word."""
    command = [sys.executable, "-m", "jaxchain", "explore", "--no-browser"]
    # In the background, under `nohup`, a process ignores Ctrl-C, and so do those that it starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        said = process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:\d+/", said)
        assert found is not None
        yield found[0]
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stderr.read() == ""


def visit(open_tab, served, query="", **options):
    options = {"viewport": {"width": 1366, "height": 768}, **options}
    tab = open_tab(served, **options).tab
    tab.goto(served + query, timeout=120_000)
    tab.wait_for_function(MOVING.format(frame=3), timeout=120_000)
    return tab


def model(tab, kind, title, then):
    return tab.evaluate(MODEL.format(kind=kind, title=title) + then)


def belt_line(tab):
    """The belt speed in the phase portrait."""
    then = '.center.find(one => one.type == "Span").location'
    return model(tab, "Figure", "Phase portrait", then)


def numbers(tab):
    return tab.locator("dl").inner_text().replace("\n", " ")


def test_the_pictures_move_and_nothing_goes_wrong(open_tab, served):
    tab = visit(open_tab, served)
    frame = model(tab, "Figure", "Chain", ".tags[0]")
    tab.wait_for_function(MOVING.format(frame=frame + 10))
    assert "energy E" in numbers(tab)
    assert model(tab, "Figure", "Bifurcation", ".below[0].axis_label").startswith("belt speed")


def test_a_slider_moves_the_picture_and_a_wrong_number_is_refused(open_tab, served):
    tab = visit(open_tab, served)
    assert belt_line(tab) == 1.5
    model(tab, "Slider", "belt speed", ".value = 1.25")
    there = '.center.find(one => one.type == "Span").location == 1.25'
    tab.wait_for_function(MODEL.format(kind="Figure", title="Phase portrait") + there)
    box = tab.get_by_role("textbox").nth(2)
    box.fill("-1")
    box.press("Enter")
    tab.get_by_role("alert").wait_for()
    said = "Argument `coupling` must be zero or positive, and finite, but is -1.0"
    assert said in tab.get_by_role("alert").inner_text()
    assert model(tab, "Slider", "coupling", ".value") == 0.01


def test_a_click_kicks_a_mass(open_tab, served):
    tab = visit(open_tab, served)
    tab.get_by_role("button", name="Pause").click()
    canvas = tab.locator("canvas").first.bounding_box()
    ends = model(tab, "Figure", "Chain", ".x_range.end"), 0.3
    across = (3.0 - ends[1]) / (ends[0] - ends[1])
    tab.wait_for_timeout(500)
    tab.mouse.click(canvas["x"] + across * canvas["width"], canvas["y"] + 0.5 * canvas["height"])
    tab.get_by_role("button", name="Step").click()
    tab.wait_for_timeout(500)
    tab.get_by_role("button", name="Link").click()
    tab.wait_for_url(re.compile("state="))
    query = re.search(r"state=([^&]*)", tab.url)
    assert query is not None
    x, _ = re.sub(r"\+|%20", " ", query[1].replace("%3B", ";")).split(";")
    pulled = [abs(float(word) - 0.525) > 0.3 for word in x.replace("%22", "").split()]
    assert pulled[2]
    assert not any(pulled[4:9])


def test_a_link_and_a_hostile_link(open_tab, served):
    tab = visit(open_tab, served, "?belt_speed=1.3&coupling=0.02")
    assert model(tab, "Slider", "belt speed", ".value") == 1.3
    assert belt_line(tab) == 1.3
    tab = visit(open_tab, served, "?belt_speed=__import__('os')&other=<script>alert(1)</script>")
    assert "which is no number" in tab.get_by_role("alert").inner_text()
    assert belt_line(tab) == 1.5


def test_five_tabs_are_independent_and_none_stalls(open_tab, served):
    tabs = [visit(open_tab, served) for _ in range(5)]
    for k, tab in enumerate(tabs):
        model(tab, "Slider", "belt speed", f".value = {1.1 + 0.1 * k}")
    before = [model(tab, "Figure", "Chain", ".tags[0]") for tab in tabs]
    for k, (tab, frame) in enumerate(zip(tabs, before, strict=True)):
        tab.wait_for_function(MOVING.format(frame=frame + 10), timeout=60_000)
        assert belt_line(tab) == pytest.approx(1.1 + 0.1 * k)


def test_files_are_taken_away(open_tab, served):
    tab = visit(open_tab, served)
    for name, text in (("Program", "model = Chain("), ("Scene", "[experiment.present"),
                       ("CSV", "time,displacement_1")):  # fmt: skip
        with tab.expect_download() as taken:
            tab.get_by_role("link", name=name).or_(
                tab.get_by_role("button", name=name)
            ).first.click()
        assert text in taken.value.path().read_text(encoding="utf-8")
    with tab.expect_download() as taken:
        tab.get_by_role("button", name="PNG").click()
    assert taken.value.path().read_bytes()[:4] == b"\x89PNG"


def test_dry_and_smoothed_side_by_side(open_tab, served):
    tab = visit(open_tab, served)
    assert "two numbers" not in numbers(tab)
    tab.get_by_role("checkbox").first.check()
    tab.get_by_text("smoothed (circle); dry (square)").wait_for(timeout=120_000)
    assert model(tab, "Figure", "Chain", ".y_range.start") < -2.0


def test_on_a_phone_nothing_is_wider_than_the_screen(open_tab, served):
    tab = visit(open_tab, served, viewport={"width": 390, "height": 844}, has_touch=True)
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390
    chain = tab.locator("canvas").first.bounding_box()
    assert chain["y"] < 100  # the chain comes first, the sliders below
