"""The site as a reader uses it: pages, formulas, search, copying, dark and light, a phone."""

import re
from html.parser import HTMLParser
from urllib.parse import unquote, urldefrag, urljoin

import pytest

import jaxchain

pytestmark = pytest.mark.site

PHONE = {"width": 360, "height": 740}
# A newcomer's questions: what is typed into the search, where the answer stands, and words of it.
QUESTIONS = [
    ("own friction law", "guides/custom_friction_law", "AbstractFrictionLaw"),
    ("active_count", "guides/reading_results", "how many masses vibrate"),
    ("NaN lanes", "guides/failures", "NaN"),
    ("resume", "guides/large_sweeps", "jaxchain resume"),
]


class Links(HTMLParser):
    """What a page refers to, and what in it may be referred to."""

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
        inventory = InventoryFile.load(file, "", lambda base, place: place)
    known = {name for kind, names in inventory.items() if kind.startswith("py:") for name in names}
    for room in jaxchain.ROOMS:
        names = getattr(getattr(jaxchain, room), "__all__", ())
        assert {f"jaxchain.{room}.{name}" for name in names} <= known


def test_every_page_loads_and_draws_its_formulas(built, address, open_tab):
    watched = open_tab(address)
    for page in pages(built):
        watched.tab.goto(address + page, wait_until="load")
        formulas = watched.tab.locator(".math")
        if formulas.count():
            watched.tab.wait_for_function("window.MathJax?.startup?.promise !== undefined")
            watched.tab.evaluate("MathJax.startup.promise")
            drawn = watched.tab.locator(".math mjx-container").count()
            assert drawn == formulas.count(), page
            assert watched.tab.locator("mjx-merror, [data-mjx-error]").count() == 0, page


def test_no_page_is_wider_than_a_phone(built, address, open_tab):
    watched = open_tab(address, viewport=PHONE, is_mobile=True, has_touch=True)
    wide = []
    for page in pages(built):
        watched.tab.goto(address + page, wait_until="load")
        width = watched.tab.evaluate("document.scrollingElement.scrollWidth")
        if width > PHONE["width"]:
            wide.append((page, width))
    assert not wide


@pytest.mark.parametrize(("words", "page", "answer"), QUESTIONS)
def test_a_newcomers_question_is_answered_by_one_search(address, open_tab, words, page, answer):
    tab = open_tab(address).tab
    tab.goto(address, wait_until="load")
    tab.keyboard.press("Control+k")
    tab.keyboard.type(words)
    tab.keyboard.press("Enter")
    tab.locator("#search-results ul.search > li > a").first.wait_for()
    tab.locator("#search-results p.search-summary").filter(has_text="found").wait_for()
    links = tab.locator("#search-results ul.search > li > a")
    found = [link.split("?")[0] for link in links.evaluate_all("all => all.map(a => a.href)")]
    place = [urldefrag(link)[0] for link in found].index(f"{address}{page}.html")
    assert place < 5
    links.nth(place).click()
    tab.locator("article").get_by_text(answer).first.wait_for()


def test_code_is_copied_without_prompts(address, open_tab):
    watched = open_tab(address, permissions=["clipboard-read", "clipboard-write"])
    watched.tab.goto(f"{address}reference/boundaries.html", wait_until="load")
    block = watched.tab.locator("div.highlight", has_text=">>> import jax").first
    block.hover()
    block.locator("button.copybtn").click()
    watched.tab.wait_for_function("navigator.clipboard.readText().then(text => text !== '')")
    copied = watched.tab.evaluate("navigator.clipboard.readText()")
    assert copied.startswith("import jax\n")
    assert ">>>" not in copied
    assert "1.792" not in copied  # what is printed
    compile(copied, "copied", "exec")


def test_it_is_dark_or_light_as_the_reader_wants(address, open_tab):
    back = "getComputedStyle(document.body).backgroundColor"
    seen = {}
    for scheme in ("light", "dark"):
        tab = open_tab(address, color_scheme=scheme).tab
        tab.goto(address, wait_until="load")
        seen[scheme] = tab.evaluate(back)
    assert seen["light"] != seen["dark"]
