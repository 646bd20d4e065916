"""The site as a reader uses it: pages, formulas, search, copying, dark and light, a phone."""

import re
from html.parser import HTMLParser
from urllib.parse import quote_plus, unquote, urldefrag, urljoin

import pytest

import jaxchain

pytestmark = pytest.mark.site

# What a user types into the search, and the pages whose first place answers it.
QUESTIONS = {
    **dict.fromkeys(
        (
            "export", "CSV", "interrupt", "time series", "cubic", "noise", "fit a signal",
            "Neimark-Sacker", "two-parameter", "GPU", "cluster", "chaos", "slow",
        ),
        ("faq",),
    ),
    "resume": ("faq", "guides/large_sweeps", "guides/command_line_and_scenes"),
    "own friction law": ("guides/custom_friction_law",),
    "NaN": ("faq", "guides/failures"),
    "SI units": ("faq", "guides/units"),
    "gradient": ("guides/gradients",),
    "accuracy": ("guides/accuracy",),
    "cite": ("cite",),
    "brake squeal": ("why", "guides/squeal_from_matrices"),
    # Tasks in a newcomer's words.
    **dict.fromkeys(
        (
            "where does vibration begin", "change the friction curve", "export results to excel",
            "continue after ctrl-c", "plot amplitude over belt speed", "unstable limit cycle",
            "figure for a paper", "probability of vibration",
            "video of the chain", "stick slip phase portrait", "saddle node of limit cycles",
            "job array slurm", "stochastic excitation", "how long does a block stick",
        ),
        ("faq",),
    ),
    "does it run on gpu": ("faq", "guides/gpu"),
    "convert newton and metre": ("faq", "guides/units"),
    "ode45": ("coming_from/matlab",),
    "unilateral contact gap": (
        "guides/drives", "guides/contacts", "examples/11_a_pad_that_lifts_off",
    ),
    "derivative with respect to mass": ("guides/gradients",),
    "interactive sliders": ("guides/explorer", "start"),
    "monte carlo uncertain parameters": ("guides/maps_and_scatter",),
    "accelerometer data": ("faq", "guides/signals"),
    "two-mass brake model with mode coupling": ("guides/squeal_from_matrices",),
    "simulation does not converge": ("faq", "guides/failures"),
    "brake pad with stiffness matrix": ("guides/squeal_from_matrices",),
    "random stiffness of masses": ("guides/maps_and_scatter",),
    "damping to avoid squeal": ("faq", "guides/squeal_from_matrices"),
    "install": ("start",),
    "what units are used": ("faq", "guides/units"),
    "read csv signal": ("guides/drives", "guides/signals"),
    "estimate friction coefficient from measurement": ("guides/signals",),
    "scene file format": ("guides/command_line_and_scenes",),
    "print the amplitude of each mass": ("faq",),
    "gradient wrong through stick slip": ("guides/gradients",),
    "my run takes forever": ("faq",),
}  # fmt: skip
# Words of which functions have the answer: those that must come first, in any order.
FUNCTIONS = {
    "hopf": {"find_hopf_point", "hopf_belt_speed", "hopf_by_descent", "hopf_points"},
    "limit cycle": {"find_limit_cycle", "find_limit_cycles"},
    "fold": {"find_fold", "fold_belt_speed", "fold_by_descent"},
}
PHONE, DESK = {"width": 390, "height": 800}, {"width": 1280, "height": 800}
# Elements of a page that are wider than their place: they would be cut, or have to be scrolled.
CUT = """() => [...document.querySelectorAll(
    'mjx-container[display="true"], .bd-article pre, .bd-article div.math, '
    + '.bd-article :is(p, li):not(table *)'
)].filter(e => e.clientWidth && e.scrollWidth > e.clientWidth + 1).map(e => e.textContent)"""

# The page that the search of this page shows first, for each question.
FIRST = """questions => questions.map(
    words => Search._performSearch(...Search._parseQuery(words)).at(-1)[0]
)"""


class Links(HTMLParser):
    """The links and anchors of a page."""

    def __init__(self, text):
        super().__init__()
        self.out, self.anchors = [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        known = dict(attrs)
        self.anchors |= {known[key] for key in ("id", "name") if known.get(key)}
        self.out += [known[key] for key in ("href", "src") if known.get(key)]


def pages(built):
    found = (path.relative_to(built) for path in built.rglob("*.html"))
    return sorted(path.as_posix() for path in found if path.parts[0] != "_static")


def test_every_link_goes_somewhere(built):
    read = {page: Links((built / page).read_text(encoding="utf-8")) for page in pages(built)}
    broken = []
    for page, links in read.items():
        for link in links.out:
            if re.match(r"[a-z]+:", link):
                assert link.startswith(("https:", "data:", "mailto:")), (page, link)
                continue
            path, anchor = urldefrag(urljoin(f"/{page}", unquote(link)))
            target = path.split("?")[0].lstrip("/") or "index.html"
            known = read[target].anchors | {""} if target in read else {anchor}
            if not (built / target).is_file() or anchor not in known:
                broken.append((page, link))
    assert not broken


def test_every_public_name_stands_in_it(built):
    from sphinx.util.inventory import InventoryFile

    with (built / "objects.inv").open("rb") as file:
        inventory = InventoryFile.load(file, "", lambda base, url: url)
    known = {name for kind, names in inventory.items() if kind.startswith("py:") for name in names}
    for submodule in jaxchain.SUBMODULES:
        names = getattr(getattr(jaxchain, submodule), "__all__", ())
        assert {f"jaxchain.{submodule}.{name}" for name in names} <= known


def test_every_page_draws_its_formulas_and_nothing_is_cut(built, address, open_tab):
    """Each page is loaded once, as a phone does, and then widened to a desk's window."""
    watched = open_tab(address, viewport=PHONE, is_mobile=True, has_touch=True)
    wide = {}
    for page in pages(built):
        watched.tab.set_viewport_size(PHONE)
        watched.tab.goto(address + page, wait_until="load")
        formulas = watched.tab.locator(".math").count()
        if formulas:
            watched.tab.wait_for_function("window.MathJax?.startup?.promise !== undefined")
            watched.tab.evaluate("MathJax.startup.promise")
            assert watched.tab.locator(".math mjx-container").count() == formulas, page
            assert watched.tab.locator("mjx-merror, [data-mjx-error]").count() == 0, page
        for size in (PHONE, DESK):
            watched.tab.set_viewport_size(size)
            whole, cut = watched.tab.evaluate(
                f"[document.scrollingElement.scrollWidth, ({CUT})()]"
            )
            if cut or whole > size["width"]:
                wide[page, size["width"]] = whole, cut
    assert not wide


def first_result(tab):
    tab.locator("#search-results ul.search > li > a").first.wait_for()
    tab.locator("#search-results p.search-summary").filter(has_text="found").wait_for()
    return tab.locator("#search-results ul.search > li > a").first.get_attribute("href")


def test_a_search_in_a_users_words_has_the_right_page_first(address, open_tab):
    """One page is loaded, with what is shown for the last question; it ranks for all of them."""
    tab = open_tab(address).tab
    tab.goto(f"{address}search.html?q={quote_plus([*QUESTIONS][-1])}", wait_until="load")
    shown = urldefrag(urljoin(tab.url, first_result(tab)).split("?")[0])[0]
    first = tab.evaluate(FIRST, [*QUESTIONS])
    assert shown == f"{address}{first[-1]}.html"
    found = zip(QUESTIONS.items(), first, strict=True)
    assert not {words: page for (words, right), page in found if page not in right}


def test_functions_named_by_the_words_of_a_search_come_first(address, open_tab):
    tab = open_tab(address).tab
    for words, names in FUNCTIONS.items():
        tab.goto(f"{address}search.html?q={quote_plus(words)}", wait_until="load")
        first_result(tab)
        links = tab.locator("#search-results ul.search > li > a").all()[: len(names)]
        found = {link.inner_text().rsplit(".", 1)[-1] for link in links}
        assert found == names, words


def test_a_search_without_a_page_of_all_words_finds_those_of_most(address, open_tab):
    tab = open_tab(address).tab
    tab.goto(f"{address}search.html?q=squeal+xylophone+matrices", wait_until="load")
    assert "squeal_from_matrices" in first_result(tab)
    tab.goto(f"{address}search.html?q=xylophone+quark", wait_until="load")
    tab.locator("#search-results p.search-summary").filter(has_text="did not match").wait_for()
    assert tab.locator("#search-results ul.search > li").count() == 0


def test_sessions_of_docstrings_are_code(built):
    """Markdown would read `>>>` as a quotation."""
    for page in (built / "reference").glob("*.html"):
        assert "<blockquote" not in page.read_text(encoding="utf-8"), page.name


def test_results_appear_while_typing(address, open_tab):
    tab = open_tab(address).tab
    tab.goto(address, wait_until="load")
    tab.keyboard.press("Control+k")
    tab.keyboard.type("export")
    assert "faq.html" in first_result(tab)


def test_code_is_copied_without_prompts(address, open_tab):
    watched = open_tab(address, permissions=["clipboard-read", "clipboard-write"])
    watched.tab.goto(f"{address}reference/boundaries.html", wait_until="load")
    block = watched.tab.locator("div.highlight", has_text=">>> import jax").first
    block.hover()
    block.locator("button.copybtn").click()
    watched.tab.wait_for_function("navigator.clipboard.readText().then(text => text !== '')")
    copied = watched.tab.evaluate("navigator.clipboard.readText()")
    assert copied.startswith("import jax, jax.numpy as jnp\n")
    assert ">>>" not in copied
    assert "[[0.89  1.486]" in block.inner_text()  # what is printed
    assert "1.486" not in copied
    compile(copied, "copied", "exec")


def test_it_is_dark_or_light_as_the_reader_wants(address, open_tab):
    back = "getComputedStyle(document.body).backgroundColor"
    seen = {}
    for scheme in ("light", "dark"):
        tab = open_tab(address, color_scheme=scheme).tab
        tab.goto(address, wait_until="load")
        seen[scheme] = tab.evaluate(back)
    assert seen["light"] != seen["dark"]
