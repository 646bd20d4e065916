"""Quantities to measure along a run, and quantities derived from amplitudes and peak times.

- `amplitude`: half peak-to-peak of displacements, with early ends of runs
- `base`: the base class of observers
- `crossings`: when a variable of a cell, or a function of all, passes a level
- `energy_balance`: work of the belt, losses, stored energy; the integral of tr J
- `fronts`: the positions of the two fronts of a vibrating block
- `quantities`: energy, vibrating masses, periods, delays, from amplitudes and peak times
- `samples`: states at given times, some masses at regular times
- `section`: Poincare sections, and the times of the maxima of every displacement
- `stick_time`: times of sticking, and numbers of masses that stick at once
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
