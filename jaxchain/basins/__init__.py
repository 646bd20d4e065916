"""How likely each state is, and how hard one must push: basins of attraction.

- `classifiers`: in which state a run ends
- `points`: points spread evenly, whose scatter is an error
- `regions`: from where a system may start
- `runs`: the runs from all of them
- `shares`: how likely each state is
- `tally`: how many runs ended in which state, and how sure that is
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
