"""The chain: its masses, springs and friction, its equilibrium, its initial states."""
