"""How likely each state is, and how hard one must push: basins of attraction.

- `blows`: the gentlest blow that starts the vibration
- `classifiers`: in which state a run ends
- `edges`: edge states, what moves for ever on the edge between two basins
- `regions`: from where a system may start, and points spread evenly over that
- `shares`: how likely each state is
- `single_mass`: the basin of steady sliding of one mass, and its gentlest blow, exactly
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
