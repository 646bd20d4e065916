from .accuracy import Numerics as Numerics
from .accuracy import choose_numerics as choose_numerics
from .event_driven import EventDriven as EventDriven
from .method import Method as Method
from .run import Simulation as Simulation
from .run import simulate as simulate
