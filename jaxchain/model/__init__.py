"""The chain: masses on a moving belt, their springs and friction, sliding, initial states.

- `arguments`: checks of a chain, a state, a mass and a symmetry
- `cells`: equal-shaped cells with m variables each
- `chain`: the equations, the paper's chain, steady sliding
- `contacts`: contacts with friction in any direction, and rigid stops
- `drives`: what drives a model from outside: tables of measured values over time
- `entries`: entries of parameters that are arrays, by name
- `friction`: laws mu(s), one class each, and their smoothing by a width
- `initial_states`: eq. (8) and eq. (10) of the paper, and blocks of excited masses
- `locality`: checks that forces act mass by mass
- `measured`: measured friction, read from CSV and checked
- `mechanical`: cells of several displacements, from matrices, springs, friction and forcing
- `model`: what every model answers
- `oscillators`: the base class of chains and of your own oscillators
- `parameters`: the parameters of a chain and of friction: symbol, unit, sign, description
- `provenance`: the origin of numbers, as attributes of datasets
- `ready_made`: seven models from the literature as cells
- `sliding`: linear stability of steady sliding: damping, stiffness, eigenvalues
- `springs`: neighbours of a mass, and the springs between them
- `tabulated`: measured friction as a law, a curve through points
- `tridiagonal`: linear systems of cells that see their neighbours, solved in O(N)
- `units`: conversion between SI units and the dimensionless chain
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
