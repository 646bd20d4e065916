"""Pictures: figures of sweeps, drawings of the model, films.

- `animation`: a chain in motion: animations, GIFs, strips of stills
- `branches`: a branch with its stability and its special points
- `chain_artist`: what moves in an animation
- `diagram`: what a bifurcation diagram shows beside its points
- `facets`: a sweep, a dimension across, others as series or as panels
- `films`: who sticks when, and loops that close
- `friction`: the friction law as a drawing
- `groups`: which datasets of a scene are the same sweep, smoothed and dry
- `labels`: words, symbols and units of axes, dimensionless or SI
- `model`: the chain on its belt as a drawing
- `motions`: a run over time, and in the phase plane
- `style`: page width, colours, symbols, files of figures
- `sweeps`: whole figures of sweeps: amplitude or energy over what was swept
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
