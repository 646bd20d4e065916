"""Basins of attraction: how likely each state is, and how hard a blow starts vibration.

- `blows`: the gentlest blow that starts the vibration
- `classifiers`: the state in which a run ends
- `edges`: edge states, which stay on the boundary between two basins
- `kicks`: runs after a kick from steady sliding, and the threshold of vibration along a direction
- `regions`: regions of initial states, and their sampling
- `shares`: how likely each state is
- `single_mass`: the basin of steady sliding of one mass, and its gentlest blow, exactly
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
