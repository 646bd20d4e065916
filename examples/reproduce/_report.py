"""What the programs of this folder print: the published value, ours, and whether they agree."""

import sys

import pandas as pd

import jaxchain

jaxchain.configure(cache=True)


def report(source, *rows):
    """Prints rows of (quantity, published value, ours, tolerance); fails if one does not agree.

    Without a published value (None) a row only tells what we find.
    """
    table = pd.DataFrame(rows, columns=["quantity", "published", "jaxchain", "tolerance"])
    table["jaxchain"] = table.jaxchain.astype(float)
    table["difference"] = table.jaxchain - table.published.astype(float)
    known = table.published.notna()
    table["agrees"] = (table.difference.abs() <= table.tolerance).map(
        {True: "pass", False: "FAIL"}
    )
    table.loc[~known, "agrees"] = "-"
    print(f"{source}\n\n{table.to_string(index=False, float_format='%.12g')}")
    sys.exit(bool((table.agrees == "FAIL").any()))
