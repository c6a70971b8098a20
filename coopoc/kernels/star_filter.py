"""The joint filter of one ego's star over a whole drive: all runs and steps, neighbours that join and leave.

The filter of `coopoc.methods.joint_filter` with the gather of `coopoc.methods.star`, kept in information form: a step
adds process noise to it block by block, then fixes and sightings, and no matrix is ever inverted. The ego's block is
the last, so that elimination ends with its covariance. LANES runs go abreast, and one that is left over alone, with the
same digits: a run's numbers do not depend on who runs beside it. Arguments are those of `star_messages`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import uint64

from ..arrays import AnyArray, Floats
from .blocks import eliminate, loosen, substitute, width
from .compile import as_written
from .lanes import LANES
from .sighting import converted, exact, vector
from .star_abreast import block, follow_abreast
from .star_messages import LEAST_PROCESS, hear


@as_written
def follow(measured: Any, assumed: Any, refine: bool) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m; one Gauss-Newton step more to `refine`."""
    runs, steps = measured[0].shape[:2]
    x, cov = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3))
    others = np.empty((runs, measured[2].shape[1], 3))
    for first in range(0, runs, LANES):
        last = min(first + LANES, runs) - 1
        if first < last:
            follow_abreast(measured, assumed, refine, first, last, (x, cov, others))
        else:
            follow_one(measured, assumed, refine, first, (x, cov, others))
    return x, cov, others


@as_written
def follow_one(measured: Any, assumed: Any, refine: bool, run: int, out: Any) -> None:
    """Fill x, covariance and neighbours, as `follow` does, of one run."""
    seen, start = measured[2], measured[4]
    x, cov, others = out
    most = 1 + np.diff(start).max()
    size = 3 * most * width(3 * most)
    information, last, a, factor = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    pivots, move, scratch = np.zeros(9 * most), np.zeros(3 * most), np.zeros(6 * width(3 * most) + 9)
    state, before, stiffness = np.zeros((most, 3)), np.zeros((most, 3)), np.zeros(3 * most)
    who, was = np.zeros((4, most), np.int64), np.zeros((3, most), np.int64)
    motion = np.zeros((4, most, 3))
    old = 0
    for t in range(len(start) - 1):
        n = 1 + start[t + 1] - start[t]
        hear(measured, assumed, run, t, who[:, :n], was[:, :old], motion)
        here = seen[run, start[t] : start[t + 1]]
        stiffness[: 3 * old] = 0.0
        predict(before[:old], who[3, :n], motion, here, state, stiffness)
        loosen(last, 3 * old, width(3 * old), stiffness, scratch)
        rearrange(last, old, who[3, :n], 1.0 / assumed[4], information)
        update(state[:n], motion, here, assumed, refine, (information, a, factor, pivots, move))
        for i in range(3):
            x[run, t, i] = state[0, i]
            for j in range(3):
                cov[run, t, i, j] = -pivots[9 * (n - 1) + 3 * i + j]
        for k in range(n):
            for i in range(3):
                before[k, i], was[i, k] = state[k, i], who[i, k]
                if k > 0:
                    others[run, start[t] + k - 1, i] = state[k, i]
        old, information, last = n, last, information


@as_written
def predict(
    before: AnyArray, kept: AnyArray, motion: AnyArray, seen: AnyArray, state: AnyArray, stiffness: AnyArray
) -> None:  # fmt: skip
    """State of the new star from that of the last one, and the stiffness of the motion of who stays."""
    for k in range(len(kept)):
        place = kept[k]
        if place < 0:
            origin = motion[2, 0] if k == 0 else state[0]
            ahead = vector(seen[k - 1]) if k > 0 else (0.0, 0.0, 0.0)
            for c in range(3):
                state[k, c] = origin[c] + ahead[c]
            continue
        row = 3 * block(place, len(before))
        for c in range(3):
            state[k, c] = before[place, c] + motion[0, k, c]
            stiffness[row + c] = 1.0 / max(motion[1, k, c], LEAST_PROCESS)


@as_written
def rearrange(last: AnyArray, old: int, kept: AnyArray, forgotten: float, information: AnyArray) -> None:
    """Information of the new star from that of the last one, which lacks who left; `forgotten` of who joins."""
    n = len(kept)
    step, from_step = uint64(width(3 * n)), uint64(width(3 * old))
    for i in range(uint64(3 * n) * step):
        information[i] = 0.0
    for k in range(n):
        row = 3 * block(k, n)
        if kept[k] < 0:
            for c in range(3):
                information[uint64(row + c) * (step + uint64(1))] = forgotten
            continue
        from_row = 3 * block(kept[k], old)
        for j in range(n):
            column = 3 * block(j, n)
            if kept[j] < 0 or column < row:
                continue
            from_column = 3 * block(kept[j], old)
            down, across = from_step, uint64(1)
            source = uint64(from_row) * from_step + uint64(from_column)
            if from_column < from_row:
                source, down, across = uint64(from_column) * from_step + uint64(from_row), across, down
            target = uint64(row) * step + uint64(column)
            for c in range(uint64(3)):
                for d in range(uint64(3)):
                    information[target + c * step + d] = last[source + c * down + d * across]


@as_written
def update(state: AnyArray, motion: AnyArray, seen: AnyArray, assumed: Any, refine: bool, memory: Any) -> None:
    """State and information given the fixes and the sightings."""
    information, a, factor, pivots, move = memory
    n = 3 * len(state)
    stride = width(n)
    add_fixes(information, stride, state, motion)
    move[:n] = 0.0
    if refine and len(state) > 1:
        copy(information, a, n * stride)
        for k in range(1, len(state)):
            add_converted(a, stride, n, k, state, seen[k - 1], assumed)
        eliminate(a, n, stride, factor, pivots)
        substitute(factor, n, stride, move)
    for k in range(1, len(state)):
        if refine:
            add_exact(information, stride, n, k, state, move, seen[k - 1], assumed)
        else:
            add_converted(information, stride, n, k, state, seen[k - 1], assumed)
    copy(information, a, n * stride)
    eliminate(a, n, stride, factor, pivots)
    substitute(factor, n, stride, move)
    for k in range(len(state)):
        row = 3 * block(k, len(state))
        for c in range(3):
            state[k, c] += move[row + c]
            information[(row + c) * stride + n] = 0.0


@as_written
def copy(source: AnyArray, target: AnyArray, count: int) -> None:
    """A loop, since a slice would first be looked at for overlap."""
    for i in range(uint64(count)):
        target[i] = source[i]


@as_written
def add_fixes(information: AnyArray, stride: int, state: AnyArray, motion: AnyArray) -> None:
    """The fixes that are new, and in the column beside what they pull."""
    n = 3 * len(state)
    for k in range(len(state)):
        row = 3 * block(k, len(state))
        for c in range(3):
            if motion[3, k, c] > 0.0:
                information[(row + c) * (stride + 1)] += motion[3, k, c]
                information[(row + c) * stride + n] = motion[3, k, c] * (motion[2, k, c] - state[k, c])


@as_written
def add_converted(a: AnyArray, stride: int, n: int, k: int, state: AnyArray, seen: AnyArray, assumed: Any) -> None:
    """The converted sighting of member k, with its covariance at the predicted geometry."""
    x, y, z = state[k, 0] - state[0, 0], state[k, 1] - state[0, 1], state[k, 2] - state[0, 2]
    std = assumed[2]
    xx, xy, xz, yy, yz, zz = converted(x, y, z, std, assumed[3]) if len(std) else (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    to_x, to_y, to_z = vector(seen)
    x, y, z = to_x - x, to_y - y, to_z - z
    pull = (xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z)
    add_edge(a, stride, n, k, (xx, xy, xz, yy, yz, zz), pull)


@as_written
def add_exact(
    a: AnyArray, stride: int, n: int, k: int, state: AnyArray, move: AnyArray, seen: AnyArray, assumed: Any
) -> None:
    """The sighting of member k linear at the state moved by `move`, as seen from the state."""
    i, e = 3 * (k - 1), n - 3
    x, y, z = move[i] - move[e], move[i + 1] - move[e + 1], move[i + 2] - move[e + 2]
    xx, xy, xz, yy, yz, zz, px, py, pz = exact(
        state[k, 0] - state[0, 0] + x, state[k, 1] - state[0, 1] + y, state[k, 2] - state[0, 2] + z, seen, assumed[2],
        assumed[3],
    )  # fmt: skip
    pull = (px + xx * x + xy * y + xz * z, py + xy * x + yy * y + yz * z, pz + xz * x + yz * y + zz * z)
    add_edge(a, stride, n, k, (xx, xy, xz, yy, yz, zz), pull)


@as_written
def add_edge(a: AnyArray, stride: int, n: int, k: int, weight: Any, pull: Any) -> None:
    """Information and pull of a measured x_k - x_0, in the upper triangle and the column beside it."""
    xx, xy, xz, yy, yz, zz = weight
    step, one, two = uint64(stride), uint64(1), uint64(2)
    row, ego, beside = uint64(3 * (k - 1)), uint64(n - 3), uint64(n)
    for at in (row * (step + one), ego * (step + one)):
        a[at] += xx
        a[at + one] += xy
        a[at + two] += xz
        a[at + step + one] += yy
        a[at + step + two] += yz
        a[at + step + step + two] += zz
    at, below = row * step, ego * step
    for c, (x, y, z) in enumerate(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))):
        a[at + ego] -= x
        a[at + ego + one] -= y
        a[at + ego + two] -= z
        a[at + beside] += pull[c]
        a[below + beside] -= pull[c]
        at, below = at + step, below + step
