// First sections of the questions that contain the words asked, then functions and classes with all
// of them in their names, then pages by their headings: the rarer a word is, the more it counts.
var Scorer = {
  score: (result) => {
    const [page, name, anchor, description, score, , kind] = result;
    if (/^faq/.test(page) && anchor && kind === "title") return 46 + score;
    const asked = Scorer.words();
    if (/^Python (function|class)/.test(description ?? "")) {
      const last = name.split(".").pop();
      const parts = last.split(/_|(?=[A-Z])/).map((part) => part.toLowerCase());
      const has = (word) => parts.some((part) => part.startsWith(word));
      if (asked.length && asked.every(has)) {
        const isFunction = description.startsWith("Python function");
        return (isFunction ? 41 : 37) + (3 * asked.join("").length) / last.length;
      }
    }
    const factor = [
      [/^(faq|cite)/, 3], [/^start/, 2.2], [/^guides/, 2],
      [/^explanation.methods/, 0.7], [/^(why|coming_from|explanation)/, 1.5],
      [/^(examples|notebooks)/, 0.7],
      [/^reference/, 0.5],
    ].find(([pattern]) => pattern.test(page));
    const weight = factor ? factor[1] : 1;
    if (kind !== "text") return score * weight;
    const {share, title, id} = Scorer.heading(page, asked);
    if (share > 0.4 && id) { // leads there
      result[1] = `${name} > ${title}`;
      result[2] = `#${id}`;
    }
    const covered = Math.min(1, score); // below 1 of a page without all words
    return covered * (4 * Math.min(weight, 2) + 11 * weight * share);
  },
  // The words of the query: of the field in which a reader types, or of the address of the page.
  words: () => {
    const field = document.activeElement;
    const typed = field?.name === "q" ? field.value : null;
    const query = typed || new URLSearchParams(window.location.search).get("q") || "";
    return Scorer.split(query).filter((word) => !stopwords.has(word));
  },
  split: (text) => text.toLowerCase().split(/[^a-z0-9]+/).filter((word) => word),
  stems: (words) => words.map((word) => new Stemmer().stemWord(word)),
  // The heading of a page with the greatest share of the words of the query, by their rarity.
  heading: (page, asked) => {
    const headings = (Scorer.headings ??= Object.entries(Search._index.alltitles).flatMap(
      ([title, places]) => places.map(([file, id]) =>
        ({page: Search._index.docnames[file], id, title, stems: Scorer.stems(Scorer.split(title))})),
    ));
    const wanted = Scorer.stems(asked);
    const rarity = wanted.map((stem) => {
      const count = headings.filter(({stems}) => stems.includes(stem)).length;
      return Math.log(1 + headings.length / (1 + count));
    });
    const total = rarity.reduce((sum, value) => sum + value, 0);
    let best = {share: 0, title: "", id: null};
    for (const {stems, title, id} of headings.filter((heading) => heading.page === page)) {
      const sum = wanted.reduce((sum, stem, k) => sum + (stems.includes(stem) ? rarity[k] : 0), 0);
      if (sum > best.share * total) best = {share: sum / total, title, id};
    }
    return best;
  },
  objNameMatch: 20, objPartialMatch: 6, objPrio: {0: 15, 1: 5, 2: -5}, objPrioDefault: 0,
  title: 15, partialTitle: 7, term: 5, partialTerm: 2,
};

// Where fewer than three pages have all words, those with most of the words are found, too.
const withAllWords = Search.performTermsSearch;
Search.performTermsSearch = (words, excluded) => {
  const found = withAllWords(words, excluded);
  if (found.length > 2 || words.size < 2) return found;
  const pages = new Map(found.map((result) => [result[0], [result, words.size]]));
  for (const result of [...words].flatMap((word) => withAllWords(new Set([word]), excluded))) {
    const [kept, count] = pages.get(result[0]) ?? [result, 0];
    if (count < words.size) pages.set(result[0], [kept, count + 1]);
  }
  const counts = [...pages.values()].map(([, count]) => count).filter((n) => n < words.size);
  const most = Math.max(...counts);
  const whole = new Set(found);
  return [...pages.values()].filter(([result, count]) => whole.has(result) || count === most)
    .map(([result, count]) => {
      if (!whole.has(result)) result[4] = count / words.size;
      return result;
    });
};
