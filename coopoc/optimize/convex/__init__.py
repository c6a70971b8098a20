"""Convex relaxations and certificates: what no estimate can beat, and whether one is the best there is."""

from .certificate import Certificate, certify
from .relaxation import Relaxation, shor, staircase

__all__ = ["Certificate", "Relaxation", "certify", "shor", "staircase"]
