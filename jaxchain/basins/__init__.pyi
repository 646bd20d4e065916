from .classifiers import AbstractClassifier as AbstractClassifier
from .classifiers import Settled as Settled
from .classifiers import VibratingMasses as VibratingMasses
from .regions import Box as Box
