from .sweeping import SweepInterrupted as SweepInterrupted
from .sweeping import sweep as sweep
