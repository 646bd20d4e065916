"""Experiments as TOML files: read, checked, run, saved.

- `files`: scene files as TOML: found, read and written
- `tables`: the tables a scene file is made of, from the classes of the library
- `scene`: an experiment as data, read and checked key by key
- `building`: model, start, observers and method from the tables; your own classes
- `running`: `run_scene`: experiments to datasets to a folder
- `folder`: the folder of results
- `report`: the summary of a run, in a few lines and as `report.html`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
