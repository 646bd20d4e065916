"""The documentation, built as a reader builds it, and Chromium to read it with."""

import functools
import http.server
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
# As root, as CI is, Chromium starts without its sandbox only; the rest keeps it from looking for
# news of its own, which would be requests off this machine.
OPTIONS = [
    "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run",
]  # fmt: skip


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """The folder of the site, built strictly: no warning.  Nothing is written into the sources."""
    sources, folder = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("site")
    for name in ("docs", "examples"):
        own = shutil.ignore_patterns("_build", ".*")
        shutil.copytree(REPOSITORY / name, sources / name, ignore=own)
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q", "docs", folder]
    done = subprocess.run(command, cwd=sources, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return folder


@pytest.fixture(scope="session")
def address(built):
    """Where the site is served."""
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=os.fspath(built))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="session")
def browser():
    from playwright.sync_api import Error, sync_playwright

    # That of the system, or else the one that `playwright install chromium` has brought.
    own = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as tool:
        try:
            found = tool.chromium.launch(executable_path=own, args=OPTIONS)
        except Error as error:
            pytest.fail(f"needs Chromium (apt-get install chromium): {error}")
        yield found
        found.close()


class Watched:
    """A tab, with all that went wrong in it."""

    def __init__(self, context, base):
        self.faults: list[str] = []
        self.tab = context.new_page()
        self.tab.on("console", lambda m: self._see(m.type in ("error", "warning"), m.text))
        self.tab.on("pageerror", lambda error: self._see(True, str(error)))
        own = (base, "data:", "blob:")
        self.tab.on("request", lambda r: self._see(not r.url.startswith(own), r.url))
        # ERR_ABORTED: the next page was asked for before it came.
        self.tab.on("requestfailed", lambda r: self._see(r.failure != "net::ERR_ABORTED", r.url))
        self.tab.on("response", lambda r: self._see(r.status >= 400, r.url))

    def _see(self, wrong, text):
        # Sphinx's search warns so of every name in the reference, and shows it nevertheless.
        if wrong and not text.startswith("Anchored content block not found"):
            self.faults.append(text)


@pytest.fixture
def open_tab(browser):
    """Opens a tab for pages below an address; at the end nothing has gone wrong in it."""
    opened, contexts = [], []

    def start(base, **options):
        contexts.append(browser.new_context(**options))
        opened.append(Watched(contexts[-1], base))
        return opened[-1]

    yield start
    for context in contexts:
        context.close()
    assert not [fault for watched in opened for fault in watched.faults]
