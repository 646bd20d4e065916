"""Both boundaries over damping, friction, coupling and width."""
