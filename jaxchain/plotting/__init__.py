"""Pictures of the model, of sweeps, branches and runs; films.

- `branches`: a branch with its stability and its special points
- `cells`: a mechanical cell: blocks, springs and dashpots, contacts, stops
- `colours`: the colours of all figures
- `diagram`: what a bifurcation diagram shows beside its points
- `fits`: the profile likelihood of a fitted number
- `groups`: which datasets of a scene are the same sweep, smoothed and dry
- `maps`: a quantity over two swept parameters, with curves of special points laid over
- `model`: the chain on its belt, and its friction law
- `modes`: frequencies and growth rates of modes over a parameter
- `motions`: a run over time, in the phase plane, and as a film
- `pages`: figures of whole scenes, a panel for each sweep
- `states`: localized states: amplitudes, delays, time series and orbits
- `style`: page width, colours, symbols, labels of axes, files of figures
- `sweeps`: amplitude or energy over a swept number, also in panels
- `symbols`: springs, dashpots, belts and arrows
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
