"""A formula as a tape of scalar operations, run for LANES measurements of a graph at a time and added up where it says.

One kernel runs every kind of measurement, those of plug-ins too, so that nothing is compiled when a kind is added: the
loop over a block of measurements within each operation leaves little of the cost of reading the tape.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled, inside
from .operations import Operation, piecewise, transcendental

LANES = 32
"""Measurements side by side: the rows of a tape's slots then stay in the nearest cache."""


class Tape(NamedTuple):
    """Operations in the order in which they run.

    Attributes:
        code: (K,) each an Operation.
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
        numbers: (P, M) the inputs that follow.
        goal: (outputs, M).
        total: (T,) in place.
    """
    ambient, own = x.shape[1], nodes.shape[1] * x.shape[1]
    w = np.empty((tape.slots, LANES))
    for first in range(0, len(nodes), LANES):
        count = min(LANES, len(nodes) - first)
        for k in range(len(tape.code)):
            code, o, a, b = tape.code[k], tape.place[k, 0], tape.place[k, 1], tape.place[k, 2]
            if code == Operation.INPUT:
                if a < own:
                    at, column = a // ambient, a % ambient
                    for i in range(count):
                        w[o, i] = x[nodes[first + i, at], column]
                else:
                    for i in range(count):
                        w[o, i] = numbers[a - own, first + i]
                for i in range(count, LANES):  # lanes beyond the last measurement repeat it
                    w[o, i] = w[o, count - 1]
            elif code == Operation.OUTPUT:
                for i in range(count):
                    total[goal[o, first + i]] += w[a, i]
            elif code == Operation.CONST:
                for i in range(LANES):
                    w[o, i] = tape.value[k]
            elif code <= Operation.SQRT:
                arithmetic(code, w, o, a, b)
            elif code < Operation.FABS:
                for i in range(LANES):
                    w[o, i] = transcendental(code, w[a, i], w[b, i])
            else:
                for i in range(LANES):
                    w[o, i] = piecewise(code, w[a, i], w[b, i])


@inside
def arithmetic(code: int, w: Floats, o: int, a: int, b: int) -> None:
    """ASSIGN to SQRT of slots a and b into slot o, a vector instruction for several lanes."""
    if code == Operation.MUL:
        for i in range(LANES):
            w[o, i] = w[a, i] * w[b, i]
    elif code == Operation.ADD:
        for i in range(LANES):
            w[o, i] = w[a, i] + w[b, i]
    elif code == Operation.SUB:
        for i in range(LANES):
            w[o, i] = w[a, i] - w[b, i]
    elif code == Operation.DIV:
        for i in range(LANES):
            w[o, i] = w[a, i] / w[b, i]
    elif code == Operation.NEG:
        for i in range(LANES):
            w[o, i] = -w[a, i]
    elif code == Operation.INV:
        for i in range(LANES):
            w[o, i] = 1.0 / w[a, i]
    elif code == Operation.SQRT:
        for i in range(LANES):
            w[o, i] = np.sqrt(w[a, i])
    else:
        for i in range(LANES):
            w[o, i] = w[a, i]
