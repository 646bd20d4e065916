"""Experiments as TOML files: read, checked, run, saved.  Reading and checking needs no JAX.

- `boundaries`: the Hopf speed and the cycles that belong to an experiment, saved as data
- `building`: chain, initial state, observers and solver from the tables of an experiment
- `errors`: what may go wrong with a scene or a study
- `files`: the TOML files: found and read
- `folders`: the folder of results: its groups and stores, and how a run goes on in it
- `observing`: what is observed, as tables
- `own_code`: a friction law or observers of one's own, named on the command line
- `pages`: `report.html`, which tells of a folder of results to people
- `reading`: `load_scene`: a file read and checked
- `registry`: studies: what one is, and how one is found
- `report`: what a run found, in a few lines
- `running`: `run_scene`: experiments to datasets to a folder
- `scene`: what an experiment is, as data
- `storage`: the folder of results
- `tables`: the tables a scene file is made of
- `values`: numbers, names, lists and ranges, each within bounds
- `wording`: words for what is wrong in a scene file
- `writing`: a scene written beside its results, to be run again
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
