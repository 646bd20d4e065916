"""One run of a chain, smoothed or dry, with a given accuracy.

- `accuracy`: width and tolerance for a given accuracy
- `dataset`: the results of runs as a labelled dataset
- `event_driven`: dry friction, from event to event
- `method`: solver, tolerances and steps of a run, chosen and checked
- `plan`: the interface of a run that can be continued
- `run`: `simulate`, one run of a chain
- `smoothed`: smoothed friction, by the steps of a diffrax solver
- `sticking`: which masses stick to the belt in a state
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
