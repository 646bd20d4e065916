from .classification import Criteria as Criteria
from .classification import Evidence as Evidence
from .classification import Verdict as Verdict
from .classification import verdict as verdict
from .classification import verdicts as verdicts
from .lyapunov import LyapunovSpectrum as LyapunovSpectrum
from .lyapunov import kaplan_yorke_dimension as kaplan_yorke_dimension
from .lyapunov import lyapunov_spectrum as lyapunov_spectrum
