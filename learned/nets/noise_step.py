"""The noise that a NoiseNet estimates, step by step; tests compare it with `NoiseNet.variances` of a whole drive."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from coopoc.arrays import AnyArray, Floats
from coopoc.kernels.compiling.compile import as_written, inside

from .noise_guess import EVEN, GNSS_STD, LEAST, MEMORY, SHARE, SHARED, SPEED

FIX, FIX_BIAS, FIX_OUT, MOTION, MOTION_BIAS, MOTION_OUT, WIDTH = 0, 2, 3, 4, 9, 10, 12
"""Columns of a packed net, a row for each hidden unit: weights into it, its bias, weights out of it, for the variance
of fixes and of motions. The row behind them holds the biases of the three outputs and the floor."""
SUMS, GNSS, BEFORE, LAST, STEPS, SIZE = 0, 12, 15, 18, 21, 22
"""Memory of a vehicle: four sums per axis (`noise_guess.evidence`), where the next fix is expected by the last one m,
the last but one and the last velocity m/s, and the number of steps."""
TOTAL = SHARE**2 * SPEED**2 / 3.0


def packed(weights: Mapping[str, Floats]) -> Floats:
    """The parameters of a NoiseNet, by name, as one array (hidden + 1, WIDTH)."""
    hidden = len(weights["fix_hidden.bias"])
    net = np.zeros((hidden + 1, WIDTH))
    columns = ("fix_hidden.weight", FIX), ("motion_hidden.weight", MOTION)
    for name, at in columns:
        net[:hidden, at : at + weights[name].shape[1]] = weights[name]
    net[:hidden, FIX_BIAS], net[:hidden, MOTION_BIAS] = weights["fix_hidden.bias"], weights["motion_hidden.bias"]
    net[:hidden, FIX_OUT], net[:hidden, MOTION_OUT:] = weights["fix.weight"][0], weights["motion.weight"].T
    net[hidden, :4] = np.concatenate([weights["fix.bias"], weights["motion.bias"], weights["floor"]])
    return net


def new_memory() -> Floats:
    """Before the first step."""
    memory = np.zeros(SIZE)
    memory[GNSS : GNSS + 3] = np.nan
    return memory


@as_written
def noise_step(net: AnyArray, memory: AnyArray, given: AnyArray, out: AnyArray) -> None:
    """One step of a vehicle: variances m^2 of its fix and of its motion into `out` (6,).

    Args:
        net: packed weights.
        memory: (SIZE,), renewed.
        given: (7,) fix m, NaN where it is missing; velocity m/s; dt s.
        out: (6,).
    """
    dt = given[6]
    remember(memory, given)
    sums, jumps, count, driven, speed = memory[SUMS:GNSS], 2.0 * GNSS_STD**2, 1.0, SPEED**2, 0.0
    for i in range(3):
        jumps, count, driven = jumps + sums[i], count + sums[3 + i], driven + sums[9 + i]
        speed += given[3 + i] ** 2 + 0.01
    mean, square, product = 0.0, 0.0, 0.0
    for i in range(3):
        noise, part = (sums[6 + i] + TOTAL) / driven, (sums[9 + i] + SPEED**2 / 3.0) / driven
        mean, square, product = mean + noise / 3.0, square + part * part, product + part * noise
    slope = min(max((product - mean) / (square - 1.0 / 3.0 + EVEN), 0.0), 3.0 * mean)
    axis, whole = 0.5 * math.log(slope + LEAST**2), 0.5 * math.log(mean - slope / 3.0 + LEAST**2)
    last, moved = net[len(net) - 1], given[3] ** 2 + given[4] ** 2 + given[5] ** 2
    for i in range(3):
        unseen = SHARED / (sums[3 + i] + SHARED)
        r = 0.5 * math.log((sums[i] + SHARED * jumps / count) / (2.0 * (sums[3 + i] + SHARED)))
        of_fix = unseen * (r - math.log(GNSS_STD)), unseen
        of_motion = (
            0.5 * (axis - math.log(SHARE)),
            0.3 * (whole - math.log(SHARE)),
            0.25 * math.log(driven / SPEED**2),
            math.log((given[3 + i] ** 2 + 0.01) / speed) / 8.0,
            0.25 * math.log(speed),
        )
        fix, along, across = last[0], last[1], last[2]
        for row in range(len(net) - 1):
            unit = net[row]
            one, other = unit[FIX_BIAS], unit[MOTION_BIAS]
            for j in range(2):
                one += unit[FIX + j] * of_fix[j]
            for j in range(5):
                other += unit[MOTION + j] * of_motion[j]
            one, other = math.tanh(one), math.tanh(other)
            fix += unit[FIX_OUT] * one
            along, across = along + unit[MOTION_OUT] * other, across + unit[MOTION_OUT + 1] * other
        of_axis = math.exp(2.0 * (axis + along)) * given[3 + i] ** 2
        of_speed = math.exp(2.0 * (whole + across)) * moved
        out[i], out[3 + i] = math.exp(2.0 * (r + fix)), dt * dt * (of_axis + of_speed + math.exp(2.0 * last[3] - 10.0))


@inside
def remember(memory: AnyArray, given: Any) -> None:
    """Add a step to the sums; the first velocity is left out."""
    steps = memory[STEPS]
    for i in range(3):
        for row in range(4):
            memory[SUMS + 3 * row + i] *= 1.0 - 1.0 / MEMORY
        z, u = given[i], given[3 + i]
        expected = memory[GNSS + i] + given[6] * u
        jump = z - expected
        if not math.isnan(jump):
            memory[SUMS + i] += jump * jump
            memory[SUMS + 3 + i] += 1.0
        if steps >= 3.0:
            second_difference = u - 2.0 * memory[LAST + i] + memory[BEFORE + i]
            memory[SUMS + 6 + i] += second_difference**2 / 6.0
            memory[SUMS + 9 + i] += u * u
        memory[GNSS + i] = expected if math.isnan(z) else z
        memory[BEFORE + i], memory[LAST + i] = memory[LAST + i], u
    memory[STEPS] = steps + 1.0
