"""Films the explorer in Chromium: `python docs/film_explorer.py` writes two pictures for the site.

`examples/explorer.gif`: twenty masses of a ring vibrate; the belt speeds up until they stop, and
slows down until they start again, far below.  `examples/explorer.png`: the page.  Needs the extras
`explore` and `dev`, and Chromium.
"""

import io
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, Playwright, ViewportSize, sync_playwright

FOLDER = Path(__file__).parents[1] / "examples"
SIZE: ViewportSize = {"width": 1366, "height": 672}
SHARE, COLOURS, FRAME = 0.62, 96, 110  # of the size; of the palette; milliseconds
SPEEDS = [*np.arange(1.3, 1.9, 0.05), *np.arange(1.9, 1.04, -0.05), 1.0, 0.98, 0.96]
FIND = "[...(Bokeh.documents[0]?._all_models.values() ?? [])].find("
FIND += 'one => one.type == "{}" && {})'
DRAWN = FIND.format("Figure", "one.tags[0] > 3")
BELT = FIND.format("Slider", 'one.title.startsWith("belt speed")')
SPEED = FIND.format("Slider", 'one.title == ""')


def shot(tab: Page) -> Image.Image:
    """What the tab shows."""
    return Image.open(io.BytesIO(tab.screenshot())).convert("RGB")


def film(tab: Page) -> list[Image.Image]:
    """The belt speeds up and slows down."""
    tab.get_by_label("masses excited").fill("20")
    tab.get_by_label("masses excited").press("Enter")
    tab.evaluate(f"{BELT}.value = {SPEEDS[0]}")
    tab.get_by_role("button", name="Restart").click()
    # Two hundred time units a second: a mass that must stop has the time to.
    tab.evaluate(f"{SPEED}.value = {SPEED}.end - 1")
    tab.wait_for_timeout(1500)
    shots = [shot(tab)]
    for speed in SPEEDS:
        tab.evaluate(f"{BELT}.value = {round(float(speed), 3)}")
        for _ in range(2):
            tab.wait_for_timeout(350)
            shots.append(shot(tab))
    return shots


def pictures(tool: Playwright, url: str) -> list[Image.Image]:
    """The frames of the film; the picture of the page is written."""
    own = shutil.which("chromium") or shutil.which("google-chrome")
    browser = tool.chromium.launch(executable_path=own, args=["--no-sandbox", "--disable-gpu"])
    tab = browser.new_page(viewport=SIZE)
    tab.goto(url)
    tab.wait_for_function(DRAWN, timeout=120_000)
    shots = film(tab)
    tab.close()
    page = browser.new_page(viewport={"width": 1366, "height": 700})
    page.goto(url)
    page.wait_for_function(DRAWN, timeout=120_000)
    page.get_by_text("Fold speed").wait_for(timeout=300_000)
    page.wait_for_timeout(8000)
    shot(page).save(FOLDER / "explorer.png", optimize=True)
    browser.close()
    return shots


def main() -> None:
    """Starts the explorer, films it, and writes both pictures."""
    command = [sys.executable, "-m", "jaxchain", "explore", "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        found = re.search(r"http://\S+/", process.stdout.readline())
        assert found is not None
        with sync_playwright() as tool:
            shots = pictures(tool, found[0])
    finally:
        process.terminate()
    small = [one.resize((round(one.width * SHARE), round(one.height * SHARE))) for one in shots]
    palette = small[0].quantize(COLOURS)
    frames = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in small]
    file = FOLDER / "explorer.gif"
    how = {"save_all": True, "append_images": frames[1:], "duration": FRAME, "loop": 0}
    frames[0].save(file, **how, optimize=True)
    print(f"{file}: {len(frames)} frames, {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
