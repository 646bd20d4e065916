"""Ensembles: every combination of parameters and starts, as one labelled dataset.

- `axes`: checks of what is swept and observed
- `claims`: who computes which unit of a store
- `dask_engine`: units of a store by workers of Dask
- `dataset`: labels, units and provenance of results
- `ensemble`: what a sweep computes, whatever runs it, checked before anything is compiled
- `filling`: units of a store, claimed, run, written and recorded
- `fingerprint`: what decides the numbers of a sweep, to know a store by
- `grid`: every combination of values, cut into blocks
- `lanes`: what a lane does, and what all lanes of a device do
- `programs`: programs for lanes, compiled once and loaded on every device
- `records`: what lies beside a store, for whoever looks at it
- `scheduler`: lanes on every device, and the jobs that wait for them
- `starts`: the chain and the state that a lane starts with
- `status`: what is done of a store, by whom and how fast
- `store`: a sweep on disk, and the records of its units
- `sweeping`: `sweep`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
