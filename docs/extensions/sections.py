"""The search by sections: what each word is worth for each section and each public name.

Sphinx finds pages that contain all words.  Readers ask for a section in words of their own, so
each section is ranked by itself (BM25 with fields), and words of one meaning count for each other.
"""

import json
import math
import re
from collections import Counter, defaultdict
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.search.en import SearchEnglish

# Words of one meaning, a line each; what a synonym counts for.
MEANINGS = Path(__file__).with_name("synonyms.txt")
SYNONYM = 0.3
# Weights of a word in a title, among the index entries, and in the title of the page; of BM25:
# how fast repetition saturates, and how much long sections lose.
TITLE, ENTRY, PAGE = 6.0, 4.0, 2.0
SATURATION, LENGTH = 1.5, 0.3
# What a section with a title as on other pages is worth, and a member of a class; what a page is
# worth, by the beginning of its name.
REPEATED, MEMBER = 0.7, 0.6
PRIORS = {
    "faq": 1.25, "start": 1.1, "guides": 1.1, "explanation/methods": 0.6, "notebooks": 0.7,
    "examples": 0.8, "reference/datasets": 0.6, "reference": 0.8, "": 1.0,
}  # fmt: skip
# What each word of an index entry adds if the search has all words of the entry.
PHRASE = 60
# Words of questions, which say nothing of what is asked for.
QUESTION = {
    "all", "can", "could", "did", "do", "does", "each", "from", "get", "give", "had", "has",
    "have", "how", "i", "make", "me", "much", "must", "my", "need", "one", "our", "see",
    "should", "so", "take", "use", "used", "want", "we", "what", "when", "where", "which",
    "who", "why", "would", "you", "your",
}  # fmt: skip
_LANGUAGE = SearchEnglish({})
STOPWORDS = (_LANGUAGE.stopwords | QUESTION) - {"own"}


def stems(text):
    """The stems of the words of a text, without those that every text has."""
    words = re.findall(r"[a-z0-9]+", text.lower())
    return [_LANGUAGE.stem(word) for word in words if word not in STOPWORDS]


def _sections(doctree):
    """(node, id, title, public name or not) of each section and each public name."""
    for node in doctree.findall(nodes.section):
        yield node, node["ids"][0], node[0].astext(), ""
    for node in doctree.findall(addnodes.desc):
        signature = node[0]
        if signature.get("ids"):
            yield node, signature["ids"][0], signature["fullname"], signature["module"] or ""


def _own(node):
    """The text of a section without the sections within it, and its index entries."""
    text, entries = [], []
    for child in node.children:
        if isinstance(child, addnodes.index):
            entries += [entry[1] for entry in child["entries"]]
        elif isinstance(child, nodes.Text):
            text.append(child.astext())
        elif not isinstance(child, nodes.section | addnodes.desc | nodes.title):
            parts = _own(child)
            text, entries = text + parts[0], entries + parts[1]
    return text, entries


def _counts(documents):
    """Of each section: page, id, title and module; words of its text, title, entries, page."""
    found = []
    for page, doctree in documents:
        heading = next(iter(doctree.findall(nodes.title)), None)
        whole = stems(heading.astext()) if heading is not None else []
        for node, anchor, title, module in _sections(doctree):
            text, entries = _own(node)
            first = heading is not None and node[0] is heading
            # A name of code is read as its words.
            words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", title) if module else title
            body = Counter(stems(" ".join(text)))
            found.append(
                ([page, "" if first else anchor, title, module], body, Counter(stems(words)),
                 [stems(entry) for entry in entries], Counter(whole))
            )  # fmt: skip
    return found


def index(documents):
    """Sections; of each stem the numbers of those that have it, each with its worth there.

    Of each entry of several words: the number of its section, its worth, and its stems.
    """
    found = _counts(documents)
    titles = Counter(place[2] for place, *_ in found)
    usual = sum(sum(body.values()) for _, body, *_ in found) / len(found)
    worth, phrases = defaultdict(dict), []
    for k, (_, body, title, named, whole) in enumerate(found):
        phrases += [[k, PHRASE * len(part), *part] for part in named if len(part) > 1]
        entries = {stem for phrase in named for stem in phrase}
        long = 1.0 - LENGTH + LENGTH * sum(body.values()) / usual
        for stem in {*body, *title, *entries, *whole}:
            worth[stem][k] = (
                min(body[stem], 8) / long + TITLE * (title[stem] > 0)
                + ENTRY * (stem in entries) + PAGE * (whole[stem] > 0)
            )  # fmt: skip
    near = defaultdict(set)
    for line in MEANINGS.read_text(encoding="utf-8").splitlines():
        group = set(stems(line))
        for stem in group:
            near[stem] |= group - {stem}
    priors = [
        _prior(page)
        * (REPEATED if titles[title] > 1 else 1.0)
        * (MEMBER if module and "." in title else 1.0)
        for (page, _, title, module), *_ in found
    ]
    terms = {}
    for stem in {*worth, *near}:
        counts = Counter(worth.get(stem, {}))
        for other in near[stem]:
            for k, count in worth.get(other, {}).items():
                counts[k] = max(counts[k], SYNONYM * count)
        rare = math.log(1.0 + len(found) / max(len(counts), 1))
        terms[stem] = [
            part for k, count in sorted(counts.items())
            for part in (k, round(100 * rare * count / (SATURATION + count) * priors[k]))
        ]  # fmt: skip
    places = [place for place, *_ in found]
    return {"places": places, "terms": terms, "phrases": phrases, "ignored": sorted(STOPWORDS)}


def _prior(page):
    return next(prior for start, prior in PRIORS.items() if page.startswith(start))


def _write(app, exception):
    if exception is None and app.builder.name == "html":
        table = index([(page, app.env.get_doctree(page)) for page in sorted(app.env.found_docs)])
        target = Path(app.outdir) / "_static" / "sections.js"
        text = json.dumps(table, separators=(",", ":"))
        target.write_text(f"const sections = {text}\n", encoding="utf-8")


def setup(app):
    app.connect("build-finished", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
