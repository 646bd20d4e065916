"""jaxchain: differentiable simulation of friction-excited oscillator chains on JAX."""

from .amplitude import Amplitude as Amplitude
from .chain import Chain as Chain
from .chain import paper_chain as paper_chain
from .chain import steady_sliding as steady_sliding
from .choice import Numerics as Numerics
from .choice import choose_numerics as choose_numerics
from .control import SwitchingController as SwitchingController
from .ensemble import SweepInterrupted as SweepInterrupted
from .ensemble import sweep as sweep
from .filippov import EventDriven as EventDriven
from .friction import Coulomb as Coulomb
from .friction import ExponentialDecay as ExponentialDecay
from .friction import TanhFriction as TanhFriction
from .friction import WeakeningStrengthening as WeakeningStrengthening
from .measures import active as active
from .measures import delays as delays
from .measures import energy as energy
from .observe import PeakTimes as PeakTimes
from .observe import Section as Section
from .observe import StickTime as StickTime
from .observe import Trajectory as Trajectory
from .result import Result as Result
from .rosenbrock import Rodas4 as Rodas4
from .rosenbrock import Rodas5P as Rodas5P
from .simulate import Simulation as Simulation
from .simulate import simulate as simulate
from .states import equation_8 as equation_8
from .states import equation_10 as equation_10
from .states import excited_state as excited_state
from .units import Scales as Scales

__version__ = "0.1.0"
