from .classification import verdict as verdict
from .classification import verdicts as verdicts
from .criteria import Criteria as Criteria
from .lyapunov import lyapunov_spectrum as lyapunov_spectrum
from .records import Evidence as Evidence
from .records import Verdict as Verdict
from .spectrum import LyapunovSpectrum as LyapunovSpectrum
from .spectrum import kaplan_yorke_dimension as kaplan_yorke_dimension
