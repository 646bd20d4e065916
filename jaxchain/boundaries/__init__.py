"""Where vibration sets in (Hopf), up to which speed it survives (fold), smoothed and dry.

- `descent`: both boundaries by gradient descent, with optax
- `equilibria`: equilibria of any model, their branches and Hopf points
- `fold`: the greatest belt speed at which a vibration survives
- `grazing`: the fold of dry friction, and the effect of smoothing
- `hopf`: the belt speed above which steady sliding stays stable
- `hopf_scan`: every Hopf point in a range of belt speeds, super- or subcritical
- `limit`: extrapolation to width zero, with its error bar
- `modes`: frequencies, growth rates and shapes of a linearised model over a parameter
- `ranges`: both boundaries of one chain with error bars, and the bistable range between them
- `special_curves`: curves of special points in two numbers, and special cycles to all digits
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
