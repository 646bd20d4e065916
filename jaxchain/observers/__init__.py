"""What is watched along a run, and what amplitudes and peak times say.

- `amplitude`: half peak-to-peak, and when a run need not go on for its sake
- `base`: what an observer is; base class for observers of one's own
- `energy_balance`: work of the belt, losses, what is stored; the integral of tr J
- `fronts`: where the two fronts of a vibrating block are
- `quantities`: what amplitudes and peak times say: energy, who vibrates, periods, delays
- `samples`: states at given times, some masses at regular times
- `section`: Poincare sections, and the times of the maxima of every displacement
- `stick_time`: for how long each mass sticks, and how many at once
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
