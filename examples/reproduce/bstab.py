"""Which share of random starts ends in steady sliding?

From public programs: bSTAB (Stender, Hoffmann, Nonlinear Dynamics 107, 2022), labels of 2,000
starts in the test data of pyBasin (commit 925877c), case "friction"; and pyBasin, 5,000 starts.
Ours is the area inside the unstable cycle.  The tolerance is three standard errors of the starts.
"""

import numpy as np
from _report import report

from jaxchain import paper_chain
from jaxchain.basins import Box, sliding_share

PUBLISHED = {  # belt speed: bSTAB, pyBasin
    1.25: (0.0800, 0.0838), 1.475: (0.2980, 0.2824), 1.625: (0.4500, 0.4336),
    1.775: (0.5680, 0.5552),
}  # fmt: skip
chain, box = paper_chain(1, width=None), Box(displacement=(-2, 2), velocity=(0, 2))
rows = []
for speed, shares in PUBLISHED.items():
    exact = float(sliding_share(chain.with_(belt_speed=speed), box))
    for name, share, starts in zip(("bSTAB", "pyBasin"), shares, (2000, 5000), strict=True):
        bar = 3 * np.sqrt(exact * (1 - exact) / starts)
        rows.append((f"{name}, belt speed {speed:g}", share, exact, bar))
report(__doc__, *rows)
