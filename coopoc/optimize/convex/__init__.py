"""Convex relaxations and certificates: what no estimate can beat, and whether one is the best there is."""

from .relaxation import Certificate, Relaxation, certify, shor

__all__ = ["Certificate", "Relaxation", "certify", "shor"]
