// Pages that answer questions come before lists of names and before code.
var Scorer = {
  score: (result) => {
    const [name, title, anchor, description, score] = result;
    const factor = [
      [/^(faq|cite)/, 3], [/^guides/, 2], [/^(start|why|coming_from|explanation)/, 1.5],
      [/^(examples|notebooks)/, 0.7], [/^reference/, 0.5],
    ].find(([pattern]) => pattern.test(name));
    return score * (factor ? factor[1] : 1);
  },
  objNameMatch: 20, objPartialMatch: 6, objPrio: {0: 15, 1: 5, 2: -5}, objPrioDefault: 0,
  title: 15, partialTitle: 7, term: 5, partialTerm: 2,
};
