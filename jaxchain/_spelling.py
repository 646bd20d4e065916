"""Suggestions for misspelt names.  This module does not need JAX."""

import difflib
from collections.abc import Iterable


def did_you_mean(word: object, allowed: Iterable[str]) -> str:
    """ " (did you mean `...`?)", or nothing if no allowed word is near.

    >>> did_you_mean("belt_sped", ["belt_speed", "width"])
    ' (did you mean `belt_speed`?)'
    """
    if not isinstance(word, str):
        return ""
    names = {name.lower(): name for name in allowed}
    near = difflib.get_close_matches(word[:50].lower(), names, n=1)
    return f" (did you mean `{names[near[0]]}`?)" if near else ""
