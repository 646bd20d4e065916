"""Roots of equations, their derivatives, and branches of solutions.

- `arclength`: branches of F(u, p) = 0 by pseudo-arclength continuation
- `bracket`: an interval around a change, halved
- `branch`: the result of continuation: points, special points, the reason of its end
- `corrector`: one point of a branch from a guess
- `damped_newton`: a root from a guess
- `elimination`: small linear systems, compiled with the loop around them
- `fold_points`: folds as roots of a system bordered by one equation
- `gradient_descent`: descent with any optax optimiser, in one compiled loop
- `implicit`: derivatives by the implicit function theorem
- `iteration`: the loop of a search, and steps that are shortened until one is accepted
- `special_points`: folds, branch points and zeros between two points of a branch
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
