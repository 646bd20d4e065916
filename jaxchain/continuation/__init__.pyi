from .arclength import continue_branch as continue_branch
from .arclength import switch_branch as switch_branch
from .bracket import bisect as bisect
from .branch import Branch as Branch
from .branch import SpecialPoint as SpecialPoint
from .damped_newton import newton as newton
