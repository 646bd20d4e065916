"""What is watched along a run, and what amplitudes and peak times say.

- `amplitude`: half peak-to-peak, and when a run need not go on for its sake
- `base`: what an observer is; base class for observers of one's own
- `divergence`: integral of tr J along a run
- `energy_balance`: work of the belt, losses, what is stored
- `fronts`: where the two fronts of a vibrating block are
- `peaks`: times of the maxima of every displacement
- `quantities`: what amplitudes and peak times say: energy, who vibrates, periods, delays
- `samples`: some masses at regular times
- `section`: Poincare sections: states at which a mass turns or is fastest
- `stick_time`: for how long each mass sticks, and how many at once
- `trajectory`: the states at given times
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
