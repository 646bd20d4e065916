"""Where vibration starts (Hopf) and up to where it can survive (fold), smoothed and dry.

- `axis_crossings`: where eigenvalues of sliding cross the imaginary axis, none missed
- `bistable`: the belt speeds at which a mass slides or vibrates, as it started
- `criticality`: super- or subcritical, by the first Lyapunov coefficient, and where that changes
- `descent`: both boundaries by gradient, with optax
- `fold`: the greatest belt speed at which a smoothed vibration survives
- `fold_search`: the loop that finds a fold of cycles
- `fold_start`: where that loop starts
- `grazing`: the fold of true dry friction
- `hopf`: the belt speed above which steady sliding stays stable
- `hopf_scan`: every Hopf point in a range of belt speeds
- `many_folds`: folds of many sets of numbers, on every device
- `overview`: both boundaries of one chain, smoothed and dry, with error bars
- `single_mass`: all vibrations of one mass over the belt speed
- `touch`: equations of the cycle that touches the belt's speed
- `touch_search`: the search for that cycle
- `zero_width`: extrapolation in the width, with its error bar
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
