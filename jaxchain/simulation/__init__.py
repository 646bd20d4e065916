"""One run of a chain, smoothed or event by event, with the accuracy that is asked of it.

- `accuracy`: which solver, width and tolerance suit what is asked
- `event_driven`: true dry friction, from event to event
- `plan`: how a run goes forward, whatever integrates it
- `run`: `simulate`, one run of a chain
- `smoothed`: smoothed friction; the only place that calls `diffeqsolve`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
