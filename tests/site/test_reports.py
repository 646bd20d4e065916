"""`report.html` as a colleague opens it: from the disk, without a network, in a browser."""

import numpy as np
import pytest
from synthetic import stored

from jaxchain.cli import main

pytestmark = pytest.mark.site

TITLE = "<script>alert('x')</script> & <b>bold</b>"
SCENE = f"""
title = "{TITLE}"
description = '<img src="https://far.away/x.png" onerror="alert(1)">'

[experiment.ladder]
chain = {{ n = 3, damping_ratio = 0.05, coupling = 0.01, friction = {{ \
law = "exponential_decay", mu_static = 1.0, mu_dynamic = 0.5, v_ref = 0.5, width = 1e-2 }} }}
initial = {{ kind = "equation_8" }}
sweep = {{ belt_speed = [1.4, 1.6], excited = [0, 3] }}
time = {{ transient = 20.0, window = 20.0 }}
"""


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Address of the page of a run in which some lanes fail, and of one in which none does."""
    root = tmp_path_factory.mktemp("reports")
    (root / "mine.toml").write_text(SCENE, encoding="utf-8")
    found = {}
    for name, change in (
        ("failed", ["--set", "experiment.ladder.numerics.max_steps=150"]),
        ("well", []),
    ):
        main(["run", str(root / "mine.toml"), "--quiet", "--output", str(root / name), *change])
        found[name] = root / name
    energy = stored(found["failed"] / "mine")["ladder"].energy
    assert 0 < int(np.isnan(energy).sum()) < energy.size
    return found


@pytest.mark.parametrize(("width", "scheme"), [(360, "light"), (1200, "dark")])
def test_it_opens_without_a_network_and_what_a_stranger_wrote_is_text(
    ran, open_tab, width, scheme
):
    page = ran["well"] / "report.html"
    watched = open_tab(
        page.as_uri(), offline=True, color_scheme=scheme,
        viewport={"width": width, "height": 800},
    )  # fmt: skip
    watched.tab.goto(page.as_uri(), wait_until="load")
    assert watched.tab.title() == TITLE
    assert watched.tab.locator("h1").inner_text() == TITLE
    assert watched.tab.locator("script, main b").count() == 0
    assert "onerror" in watched.tab.locator(".description").first.inner_text()
    assert watched.tab.locator("img").evaluate_all(
        "all => all.every(one => one.naturalWidth > 300)"
    )
    assert watched.tab.locator("img").count() == 1
    assert watched.tab.locator("h2").first.inner_text() == "Figure"
    assert watched.tab.evaluate("document.scrollingElement.scrollWidth") <= width


def test_failures_are_seen_first(ran, open_tab):
    page = ran["failed"] / "report.html"
    watched = open_tab(page.as_uri(), offline=True)
    watched.tab.goto(page.as_uri(), wait_until="load")
    first = watched.tab.locator("main section").first
    assert first.locator("h2").inner_text() == "Failures"
    assert "max_steps" in first.inner_text()
    assert watched.tab.locator("#failures").bounding_box()["y"] < 700
