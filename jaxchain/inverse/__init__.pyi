from .identification import Identification as Identification
from .identification import identify as identify
from .measurements import Measurements as Measurements
from .measurements import predict as predict
from .optimal_design import Design as Design
from .optimal_design import design as design
