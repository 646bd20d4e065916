// The search by sections, ranked by the table that `docs/extensions/sections.py` has written.
const split = (text) => text.toLowerCase().split(/[^a-z0-9]+/).filter((word) => word);
const stems = (text) => {
  const stemmer = new Stemmer();
  const kept = split(text).filter((word) => !sections.ignored.includes(word));
  return [...new Set(kept.map((word) => stemmer.stemWord(word)))];
};
// [section, worth, section, worth, ...]; of a word that is being typed, those that begin like it.
const found = (stem) => sections.terms[stem]
  ?? Object.keys(sections.terms).filter((known) => stem.length > 2 && known.startsWith(stem))
    .flatMap((known) => sections.terms[known]);

// Questions that the words fill come first, then functions with all of them in their names, the
// shortest before; elsewhere a title that they fill counts more.
const FIRST = 1e6;
const ranked = ([page, , title, module], asked, score) => {
  const own = stems(module ? title.replace(/([a-z])([A-Z])/g, "$1 $2") : title);
  const filled = asked.every((stem) => own.includes(stem)) && asked.length > own.length / 2;
  if (filled && page === "faq") return 2 * FIRST + score;
  if (module && /^[a-z0-9_]+$/.test(title) && asked.every((stem) => own.includes(stem))) {
    return FIRST + FIRST / title.length;
  }
  return filled && !page.startsWith("reference") ? 4 * score : score;
};

Search._performSearch = (query, terms, excluded) => {
  document.getElementById("search-progress")?.replaceChildren();
  const asked = stems(query.replace(/(^|\s)-\S+/g, " "));
  const scores = new Map();
  for (const stem of asked) {
    const best = new Map();
    const list = found(stem);
    for (let k = 0; k < list.length; k += 2) {
      best.set(list[k], Math.max(list[k + 1], best.get(list[k]) ?? 0));
    }
    for (const [k, worth] of best) scores.set(k, worth + (scores.get(k) ?? 0));
  }
  for (const [k, worth, ...phrase] of sections.phrases) {
    if (phrase.every((stem) => asked.includes(stem))) scores.set(k, worth + (scores.get(k) ?? 0));
  }
  for (const stem of excluded) {
    const list = found(stem);
    for (let k = 0; k < list.length; k += 2) scores.delete(list[k]);
  }
  const {docnames, titles, filenames} = Search._index;
  return [...scores].map(([k, score]) => {
    const [page, id, title, module] = sections.places[k];
    const file = docnames.indexOf(page);
    const inside = id ? `${titles[file]} > ${title}` : titles[file];
    return [
      page, module ? `${module}.${title}` : inside, id ? `#${id}` : "",
      module ? "Python name" : null, ranked(sections.places[k], asked, score), filenames[file],
      module ? "object" : id ? "title" : "text",
    ];
  }).sort((a, b) => a[4] - b[4]).slice(-60);
};

// The table comes with the first search.
const perform = Search.performSearch;
Search.performSearch = (query) => {
  if (typeof sections !== "undefined") return perform(query);
  const script = document.createElement("script");
  script.src = `${document.documentElement.dataset.content_root}_static/sections.js`;
  script.onload = () => perform(query);
  document.head.append(script);
};
