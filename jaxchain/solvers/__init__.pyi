from .rosenbrock import AbstractStructuredRosenbrock as AbstractStructuredRosenbrock
from .rosenbrock import Rodas4 as Rodas4
from .rosenbrock import Rodas5P as Rodas5P
from .rosenbrock import RosenbrockTableau as RosenbrockTableau
from .step_control import SwitchingController as SwitchingController
