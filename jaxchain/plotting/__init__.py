"""Pictures: sweeps, the model, films."""
