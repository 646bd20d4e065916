"""How likely each state is, and how hard one must push: basins of attraction.

- `classifiers`: in which state a run ends
- `regions`: from where a system may start
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
