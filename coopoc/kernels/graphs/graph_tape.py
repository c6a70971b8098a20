"""A formula as a tape of scalar operations, run for TAPE_LANES measurements at a time and added to the sums of a graph.

One kernel runs every kind of measurement, those of plug-ins too, so that nothing is compiled when a kind is added: the
loop over a block of measurements within each operation leaves little of the cost of reading the tape.
"""

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled, inside, part
from ..compiling.vectors import LANES, put, take

TAPE_LANES = 32
"""Measurements side by side: the rows of a tape's slots then stay in the nearest cache."""
VECTORS = TAPE_LANES // LANES


Operation = IntEnum(
    "Operation",
    "INPUT OUTPUT CONST ASSIGN ADD SUB MUL DIV NEG INV SQRT SIN COS TAN ASIN ACOS ATAN ATAN2 EXP LOG LOG1P POW "
    "CONSTPOW FABS SIGN FMIN FMAX REMAINDER LT LE EQ NE NOT AND OR IF_ELSE_ZERO",
    start=0,
)
"""What a tape can hold; CasADi's names without "OP_"."""


class Tape(NamedTuple):
    """Operations in the order in which they run.

    Attributes:
        code: (K,) each an Operation.
        operands: (K, 3) slot written and the two read; of an INPUT slot and number, of an OUTPUT number and slot.
        value: (K,) of each CONST.
        slots: how many.
    """

    code: Ints
    operands: Ints
    value: Floats
    slots: int


@compiled
def accumulate(tape: Tape, x: Floats, nodes: Ints, numbers: Floats, goal: Ints, total: Floats) -> None:
    """Add output k of measurement m to total[goal[k, m]].

    Args:
        x: (n, ambient) nodes; a measurement's first inputs are those of its nodes.
        nodes: (M, arity).
        numbers: (P, M) the inputs that follow.
        goal: (outputs, M).
        total: (T,) in place.
    """
    ambient, own = x.shape[1], nodes.shape[1] * x.shape[1]
    w = np.empty((tape.slots, TAPE_LANES))
    for first in range(0, len(nodes), TAPE_LANES):
        count = min(TAPE_LANES, len(nodes) - first)
        for k in range(len(tape.code)):
            code, o, a, b = tape.code[k], tape.operands[k, 0], tape.operands[k, 1], tape.operands[k, 2]
            if code == Operation.INPUT:
                if a < own:
                    at, column = a // ambient, a % ambient
                    for i in range(count):
                        w[o, i] = x[nodes[first + i, at], column]
                else:
                    for i in range(count):
                        w[o, i] = numbers[a - own, first + i]
                for i in range(count, TAPE_LANES):  # lanes beyond the last measurement repeat it
                    w[o, i] = w[o, count - 1]
            elif code == Operation.OUTPUT:
                for i in range(count):
                    total[goal[o, first + i]] += w[a, i]
            elif code == Operation.CONST:
                for i in range(TAPE_LANES):
                    w[o, i] = tape.value[k]
            elif code <= Operation.SQRT:
                for i in range(VECTORS):
                    p, q = take(w, a * VECTORS + i), take(w, b * VECTORS + i)
                    put(w, o * VECTORS + i, arithmetic(code, p, q))
            else:
                for i in range(TAPE_LANES):
                    w[o, i] = scalar(code, w[a, i], w[b, i])


@inside
def arithmetic(code: int, a: float, b: float) -> float:
    """ASSIGN to SQRT, a vector instruction for several lanes."""
    y = a
    if code == Operation.MUL:
        y = a * b
    elif code == Operation.ADD:
        y = a + b
    elif code == Operation.SUB:
        y = a - b
    elif code == Operation.DIV:
        y = a / b
    elif code == Operation.NEG:
        y = -a
    elif code == Operation.INV:
        y = 1.0 / a
    elif code == Operation.SQRT:
        y = math.sqrt(a)
    return y


@part
def scalar(code: int, a: float, b: float) -> float:
    """SIN to IF_ELSE_ZERO; comparisons and logic give 1 for true."""
    y = 0.0
    if code == Operation.SIN:
        y = np.sin(a)
    elif code == Operation.COS:
        y = np.cos(a)
    elif code == Operation.TAN:
        y = np.tan(a)
    elif code == Operation.ASIN:
        y = np.arcsin(a)
    elif code == Operation.ACOS:
        y = np.arccos(a)
    elif code == Operation.ATAN:
        y = np.arctan(a)
    elif code == Operation.ATAN2:
        y = np.arctan2(a, b)
    elif code == Operation.EXP:
        y = np.exp(a)
    elif code == Operation.LOG:
        y = np.log(a)
    elif code == Operation.LOG1P:
        y = np.log1p(a)
    elif code == Operation.POW or code == Operation.CONSTPOW:
        y = a**b
    elif code == Operation.FABS:
        y = abs(a)
    elif code == Operation.SIGN:
        y = np.sign(a)
    elif code == Operation.FMIN:
        y = np.fmin(a, b)
    elif code == Operation.FMAX:
        y = np.fmax(a, b)
    elif code == Operation.REMAINDER:
        y = a - b * np.rint(a / b)
    elif code == Operation.IF_ELSE_ZERO:
        y = b if a != 0.0 else 0.0
    elif (
        (code == Operation.LT and a < b)
        or (code == Operation.LE and a <= b)
        or (code == Operation.EQ and a == b)
        or (code == Operation.NE and a != b)
        or (code == Operation.NOT and a == 0.0)
        or (code == Operation.AND and a != 0.0 and b != 0.0)
        or (code == Operation.OR and (a != 0.0 or b != 0.0))
    ):
        y = 1.0
    return y
