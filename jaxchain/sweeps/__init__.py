"""Ensembles: every combination of parameters and starts, as one labelled dataset.

- `sweeping`: `sweep`
- `axes`: checks of what is swept, and the grid of all combinations in blocks
- `ensemble`: settings, labels of results, and the fingerprint of a sweep in a store
- `lanes`: the traced part: starts, rounds and records of lanes
- `programs`: programs for lanes, compiled once and loaded on every device
- `scheduler`: lanes on every device, and the queue of jobs
- `store`: a sweep on disk, and its progress
- `dask_engine`: units of a store by workers of Dask
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
