"""Studies: questions that are no single sweep; each is a folder, see `scenes/registry.py`."""
