"""How likely each state is, and how hard one must push: basins of attraction.

- `blows`: the gentlest blow that starts the vibration
- `classifiers`: in which state a run ends
- `dataset`: shares as a labelled dataset
- `descent`: from many directions to the gentlest near each
- `edge_tracking`: a bracket of the edge between two basins, cut and followed
- `edges`: edge states, what moves for ever on such an edge
- `enclosed_area`: the area that a closed curve has in common with a box
- `fates`: whether a kicked chain comes to rest or goes on
- `innermost`: the innermost unstable cycle of one mass, by its return map
- `regions`: from where a system may start, and points spread evenly over that
- `runs`: the runs from all of them
- `shares`: how likely each state is
- `single_mass`: the basin of steady sliding of one mass, and its gentlest blow, exactly
- `tally`: how many runs ended in which state, and how sure that is
- `thresholds`: how hard to push in a given direction, and the edge's normal there
- `turns`: one mass that slides round steady sliding once
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
