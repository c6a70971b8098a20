"""A formula as a tape of scalar operations, run for LANES measurements of a graph at a time and added up where it says.

One kernel runs every kind of measurement, those of plug-ins too, so that nothing is compiled when a kind is added: the
loop over a block of measurements within each operation leaves little of the cost of reading the tape.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Ints
from .compile import compiled

LANES = 32
"""Measurements side by side: the rows of a tape's slots then stay in the nearest cache."""

_NAMES = """
    INPUT OUTPUT CONST ASSIGN ADD SUB MUL DIV NEG SQ TWICE INV SQRT SIN COS TAN ASIN ACOS ATAN ATAN2 EXP EXPM1 LOG
    LOG1P POW CONSTPOW SINH COSH TANH FABS SIGN FMIN FMAX FLOOR CEIL FMOD REMAINDER HYPOT LT LE EQ NE NOT AND OR
    IF_ELSE_ZERO
"""
OPERATIONS = tuple(_NAMES.split())
"""Names of what a tape can hold, CasADi's without "OP_"; the kernel knows them by their place here."""


class Tape(NamedTuple):
    """Operations in the order in which they run.

    Attributes:
        code: (K,) places in OPERATIONS.
        place: (K, 3) slot written and the two read; of an INPUT slot and number, of an OUTPUT number and slot.
        value: (K,) of each CONST.
        slots: how many.
    """

    code: Ints
    place: Ints
    value: Floats
    slots: int


@compiled
def accumulate(tape: Tape, x: Floats, nodes: Ints, numbers: Floats, goal: Ints, total: Floats) -> None:
    """Add output k of measurement m to total[goal[k, m]].

    Args:
        x: (n, ambient) nodes; a measurement's first inputs are those of its nodes.
        nodes: (M, arity).
        numbers: (P, M or 1) the inputs that follow.
        goal: (outputs, M or 1).
        total: (T,) in place.
    """
    ambient, own = x.shape[1], nodes.shape[1] * x.shape[1]
    w = np.empty((tape.slots, LANES))
    for first in range(0, len(nodes), LANES):
        count = min(LANES, len(nodes) - first)
        for k in range(len(tape.code)):
            code, o, a, b = tape.code[k], tape.place[k, 0], tape.place[k, 1], tape.place[k, 2]
            if code == 6:
                for i in range(LANES):
                    w[o, i] = w[a, i] * w[b, i]
            elif code == 4:
                for i in range(LANES):
                    w[o, i] = w[a, i] + w[b, i]
            elif code == 5:
                for i in range(LANES):
                    w[o, i] = w[a, i] - w[b, i]
            elif code == 0:
                if a < own:
                    at, column = a // ambient, a % ambient
                    for i in range(count):
                        w[o, i] = x[nodes[first + i, at], column]
                elif numbers.shape[1] == 1:
                    for i in range(count):
                        w[o, i] = numbers[a - own, 0]
                else:
                    for i in range(count):
                        w[o, i] = numbers[a - own, first + i]
                for i in range(count, LANES):  # what is not there repeats the last, so that no lane is undefined
                    w[o, i] = w[o, count - 1]
            elif code == 1:
                if goal.shape[1] == 1:
                    for i in range(count):
                        total[goal[o, 0]] += w[a, i]
                else:
                    for i in range(count):
                        total[goal[o, first + i]] += w[a, i]
            elif code == 2:
                for i in range(LANES):
                    w[o, i] = tape.value[k]
            elif code == 3:
                for i in range(LANES):
                    w[o, i] = w[a, i]
            elif code == 7:
                for i in range(LANES):
                    w[o, i] = w[a, i] / w[b, i]
            elif code == 8:
                for i in range(LANES):
                    w[o, i] = -w[a, i]
            elif code == 9:
                for i in range(LANES):
                    w[o, i] = w[a, i] * w[a, i]
            elif code == 10:
                for i in range(LANES):
                    w[o, i] = 2.0 * w[a, i]
            elif code == 11:
                for i in range(LANES):
                    w[o, i] = 1.0 / w[a, i]
            elif code == 12:
                for i in range(LANES):
                    w[o, i] = np.sqrt(w[a, i])
            else:
                for i in range(LANES):
                    w[o, i] = _rare(code, w[a, i], w[b, i])


@compiled
def _rare(code: int, a: float, b: float) -> float:
    """What takes longer than to look it up for each measurement."""
    if code == 13:
        return float(np.sin(a))
    if code == 14:
        return float(np.cos(a))
    if code == 15:
        return float(np.tan(a))
    if code == 16:
        return float(np.arcsin(a))
    if code == 17:
        return float(np.arccos(a))
    if code == 18:
        return float(np.arctan(a))
    if code == 19:
        return float(np.arctan2(a, b))
    if code == 20:
        return float(np.exp(a))
    if code == 21:
        return float(np.expm1(a))
    if code == 22:
        return float(np.log(a))
    if code == 23:
        return float(np.log1p(a))
    if code == 24 or code == 25:
        return float(a**b)
    if code == 26:
        return float(np.sinh(a))
    if code == 27:
        return float(np.cosh(a))
    if code == 28:
        return float(np.tanh(a))
    if code == 29:
        return abs(a)
    if code == 30:
        return float(np.sign(a))
    if code == 31:
        return float(np.fmin(a, b))
    if code == 32:
        return float(np.fmax(a, b))
    if code == 33:
        return float(np.floor(a))
    if code == 34:
        return float(np.ceil(a))
    if code == 35:
        return float(np.fmod(a, b))
    if code == 36:
        return float(a - b * np.rint(a / b))
    if code == 37:
        return float(np.hypot(a, b))
    if code == 38:
        return 1.0 if a < b else 0.0
    if code == 39:
        return 1.0 if a <= b else 0.0
    if code == 40:
        return 1.0 if a == b else 0.0
    if code == 41:
        return 1.0 if a != b else 0.0
    if code == 42:
        return 1.0 if a == 0.0 else 0.0
    if code == 43:
        return 1.0 if a != 0.0 and b != 0.0 else 0.0
    if code == 44:
        return 1.0 if a != 0.0 or b != 0.0 else 0.0
    return b if a != 0.0 else 0.0
