// First pages whose heading asks the question, then functions and classes with all its words in
// their names, then pages that explain, then lists of names and code.
var Scorer = {
  score: (result) => {
    const [page, name, anchor, description, score, , kind] = result;
    if (/^faq/.test(page) && anchor && kind === "title") return 46 + score; // the question itself
    if (/^Python (function|class)/.test(description ?? "")) {
      const words = Scorer.words();
      const last = name.split(".").pop().toLowerCase();
      if (words.length && words.every((word) => last.includes(word))) {
        const isFunction = description.startsWith("Python function");
        return (isFunction ? 41 : 37) + (3 * words.join("").length) / last.length;
      }
    }
    const factor = [
      [/^(faq|cite)/, 3], [/^start/, 2.2], [/^guides/, 2],
      [/^(why|coming_from|explanation)/, 1.5], [/^(examples|notebooks)/, 0.7],
      [/^reference/, 0.5],
    ].find(([pattern]) => pattern.test(page));
    return score * (factor ? factor[1] : 1);
  },
  // The words of the query: of the field in which a reader types, or of the address of the page.
  words: () => {
    const field = document.activeElement;
    const asked = field?.name === "q" ? field.value : null;
    const query = asked || new URLSearchParams(window.location.search).get("q") || "";
    return query.toLowerCase().split(/[^a-z0-9]+/).filter((word) => word);
  },
  objNameMatch: 20, objPartialMatch: 6, objPrio: {0: 15, 1: 5, 2: -5}, objPrioDefault: 0,
  title: 15, partialTitle: 7, term: 5, partialTerm: 2,
};
