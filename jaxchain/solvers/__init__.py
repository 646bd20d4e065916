"""How a step is made: Rosenbrock methods for smoothed friction, Taylor series for dry friction."""
