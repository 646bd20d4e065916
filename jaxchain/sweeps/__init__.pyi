from .dask_engine import cluster as cluster
from .store import StoreError as StoreError
from .sweeping import SweepInterrupted as SweepInterrupted
from .sweeping import sweep as sweep
