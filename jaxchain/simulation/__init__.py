"""One run of a chain, smoothed or event by event, with the accuracy that is asked of it.

- `accuracy`: which solver, width and tolerance suit what is asked
- `event_driven`: true dry friction, from event to event
- `event_times`: how the end of such a step moves with its events
- `observing_solver`: a diffrax solver that lets observers see every accepted step
- `plan`: how a run goes forward, whatever integrates it
- `records`: states at given times, which the steps meet exactly
- `rounds`: loops in which large arrays are touched once in many steps
- `run`: `simulate`, one run of a chain
- `smoothed`: smoothed friction; the only place that calls `diffeqsolve`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
