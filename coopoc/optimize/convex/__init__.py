"""Convex relaxations and certificates: what no estimate can beat, and whether one is the best there is."""

from .certificate import Certificate, certify
from .relaxation import Relaxation, shor
from .staircase import staircase
from .surrogate import Surrogate, surrogate

__all__ = ["Certificate", "Relaxation", "Surrogate", "certify", "shor", "staircase", "surrogate"]
