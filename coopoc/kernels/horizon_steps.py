"""Sweeps over a moving horizon, whose arrays are those of `coopoc.kernels.horizon`: on, solve, back.

A step's information goes on to the next one block by block: with motion of information D the block k leaves
A - U (A_kk + D)^-1 U^T, U its columns, which are kept. Going back, the point was (A_kk + D)^-1 (b_k + D d - U z), d
being what the next step says of it and z all others as they stood then.
"""

from __future__ import annotations

from typing import Any

from numpy import uint64

from ..arrays import AnyArray
from .blocks import eliminate, inverse3, substitute, width
from .compile import as_written
from .lanes import LANES, minus_product, subtract
from .sighting import converted, exact, vector
from .snapshot_step import widened
from .star_abreast import block
from .star_filter import add_edge, copy, rearrange
from .star_messages import LEAST_PROCESS

MOVED, PROCESS, FIX, WEIGHT, PLACE = 0, 1, 2, 3, 3


@as_written
def size(start: AnyArray, step: int) -> int:
    """Of the star."""
    return int(1 + start[step + 1] - start[step])


@as_written
def enter(window: Any, seen: AnyArray, start: AnyArray, t: int, assumed: Any) -> None:
    """A new step where it is expected, its sightings converted: `coopoc.methods.slice.entering`."""
    who, motion, point, at, _, edge = window[:6]
    slot = t % len(point)
    for k in range(size(start, t)):
        place = who[slot, PLACE, k]
        ahead = vector(seen[start[t] + k - 1]) if k > 0 else (0.0, 0.0, 0.0)
        for c in range(3):
            if place >= 0:
                point[slot, k, c] = point[slot - 1, place, c] + motion[slot, MOVED, k, c]
            else:
                point[slot, k, c] = point[slot, 0, c] + ahead[c] if k > 0 else motion[slot, FIX, 0, c]
            at[slot, k, c] = point[slot, k, c]
    if t == 0:
        begin(window[6][slot], 3 * size(start, 0), 1.0 / assumed[4])
    for k in range(1, size(start, t)):
        x, y, z = gap(point, slot, k)
        xx, xy, xz, yy, yz, zz = 1.0, 0.0, 0.0, 1.0, 0.0, 1.0
        if len(assumed[2]):
            xx, xy, xz, yy, yz, zz = converted(x, y, z, assumed[2], assumed[3])
        x, y, z = vector(seen[start[t] + k - 1])
        say(edge[slot, k], (xx, xy, xz, yy, yz, zz), (x, y, z), (0.0, 0.0, 0.0))


@as_written
def begin(past: AnyArray, n: int, forgotten: float) -> None:
    """Nothing is known of anybody."""
    for i in range(n * width(n)):
        past[i] = 0.0
    for i in range(n):
        past[i * (width(n) + 1)] = forgotten


@as_written
def gap(point: AnyArray, slot: int, k: int) -> Any:
    """Vector from the ego to a member, m."""
    return (point[slot, k, 0] - point[slot, 0, 0], point[slot, k, 1] - point[slot, 0, 1],
            point[slot, k, 2] - point[slot, 0, 2])  # fmt: skip


@as_written
def say(edge: AnyArray, weight: Any, v: Any, pull: Any) -> None:
    """An edge of this information that says weight v + pull."""
    xx, xy, xz, yy, yz, zz = weight
    x, y, z = v
    edge[0], edge[1], edge[2], edge[3], edge[4], edge[5] = xx, xy, xz, yy, yz, zz
    edge[6], edge[7], edge[8] = (
        xx * x + xy * y + xz * z + pull[0], xy * x + yy * y + yz * z + pull[1], xz * x + yz * y + zz * z + pull[2]
    )  # fmt: skip


@as_written
def look(window: Any, seen: AnyArray, start: AnyArray, step: int, assumed: Any) -> None:
    """Sightings of a step linear in range and angles where its points are."""
    point, base, edge = window[2], window[4], window[5]
    slot = step % len(point)
    for k in range(1, size(start, step)):
        one = seen[start[step] + k - 1]
        x, y, z = gap(point, slot, k)
        base[slot, k, 0], base[slot, k, 1], base[slot, k, 2] = x, y, z
        xx, xy, xz, yy, yz, zz, px, py, pz = exact(x, y, z, one, widened(one, assumed[2], assumed[3]), 0.0)
        say(edge[slot, k], (xx, xy, xz, yy, yz, zz), (x, y, z), (px, py, pz))


@as_written
def strayed(window: Any, start: AnyArray, first: int, last: int, most: float) -> bool:
    """True where a vector has left the geometry around which its sighting is linear by more than `most` m."""
    point, base = window[2], window[4]
    for step in range(first, last + 1):
        slot = step % len(point)
        for k in range(1, size(start, step)):
            x, y, z = gap(point, slot, k)
            x, y, z = x - base[slot, k, 0], y - base[slot, k, 1], z - base[slot, k, 2]
            if max(abs(x), abs(y), abs(z)) > most:
                return True
    return False


@as_written
def assemble(window: Any, start: AnyArray, step: int, a: AnyArray, away: AnyArray) -> None:
    """Information of a step and its past around its points, and beside it the pull."""
    motion, point, at, edge, past = window[1], window[2], window[3], window[5], window[6]
    slot, n = step % len(point), 3 * size(start, step)
    stride = width(n)
    copy(past[slot], a, n * stride)
    moved = 0.0
    for k in range(size(start, step)):
        row = 3 * block(k, size(start, step))
        for c in range(3):
            away[row + c] = at[slot, k, c] - point[slot, k, c]
            moved = max(moved, abs(away[row + c]))
    if moved > 0.0:
        push(a, n, stride, away)
    for k in range(size(start, step)):
        row = 3 * block(k, size(start, step))
        for c in range(3):
            if motion[slot, WEIGHT, k, c] > 0.0:
                a[(row + c) * (stride + 1)] += motion[slot, WEIGHT, k, c]
                a[(row + c) * stride + n] += motion[slot, WEIGHT, k, c] * (motion[slot, FIX, k, c] - point[slot, k, c])
        if k > 0:
            x, y, z = gap(point, slot, k)
            e = edge[slot, k]
            pull = (e[6] - (e[0] * x + e[1] * y + e[2] * z), e[7] - (e[1] * x + e[3] * y + e[4] * z),
                    e[8] - (e[2] * x + e[4] * y + e[5] * z))  # fmt: skip
            add_edge(a, stride, n, k, (e[0], e[1], e[2], e[3], e[4], e[5]), pull)


@as_written
def push(a: AnyArray, n: int, stride: int, away: AnyArray) -> None:
    """Add to the column beside the symmetric A (n, n) its product with a vector (n,)."""
    end, step = uint64(n), uint64(stride)
    for i in range(end):
        row, mine = i * step, away[i]
        total = a[row + i] * mine
        for j in range(i + uint64(1), end):
            total += a[row + j] * away[j]
            a[j * step + end] += a[row + j] * mine
        a[row + end] += total


@as_written
def go_on(window: Any, start: AnyArray, step: int, assumed: Any, memory: Any) -> None:
    """A step becomes the past of the next one."""
    a, stiffness, scratch = memory[0], memory[3], memory[5]
    assemble(window, start, step, a, memory[4])
    who, motion, point, at, past, kept = window[0], window[1], window[2], window[3], window[6], window[7]
    here, then, m, n = step % len(point), (step + 1) % len(point), size(start, step), size(start, step + 1)
    stiffness[: 3 * m] = 0.0
    for k in range(n):
        place = who[then, PLACE, k]
        if place >= 0:
            row = 3 * block(place, m)
            for c in range(3):
                stiffness[row + c] = 1.0 / max(motion[then, PROCESS, k, c], LEAST_PROCESS)
                at[then, k, c] = point[here, place, c] + motion[then, MOVED, k, c]
    loosen_and_keep(a, 3 * m, width(3 * m), stiffness, kept[here], scratch)
    rearrange(a, m, who[then, PLACE, :n], 1.0 / assumed[4], past[then])
    for k in range(n):
        place = who[then, PLACE, k]
        if place >= 0:
            target, source = 3 * block(k, n), 3 * block(place, m)
            for c in range(3):
                past[then, (target + c) * width(3 * n) + 3 * n] = a[(source + c) * width(3 * m) + 3 * m]


@as_written
def loosen_and_keep(
    a: AnyArray, n: int, stride: int, stiffness: AnyArray, kept: AnyArray, scratch: AnyArray
) -> None:  # fmt: skip
    """`coopoc.kernels.blocks.loosen`, and of each block in turn what it takes to go back: U^T (3, stride), then
    -(A_kk + D)^-1 (3, 3)."""
    step, one, two, three = uint64(stride), uint64(1), uint64(2), uint64(3)
    for k in range(0, n, 3):
        u, column = uint64(k * (stride + 3)), uint64(k)
        pivot = u + three * step
        for i in range(column):
            at, to = i * step + column, u + i
            kept[to], kept[to + step], kept[to + step + step] = a[at], a[at + one], a[at + two]
        at, to = column * step, u
        for j in range(column, step):
            to = u + j
            kept[to], kept[to + step], kept[to + step + step] = a[at + j], a[at + step + j], a[at + step + step + j]
        to = u + column
        kept[to + step], kept[to + step + step] = kept[to + one], kept[to + two]
        kept[to + step + step + one] = kept[to + step + two]
        xx, xy, xz, yy, yz, zz = inverse3(
            kept[to] + stiffness[k], kept[to + one], kept[to + two], kept[to + step + one] + stiffness[k + 1],
            kept[to + step + two], kept[to + step + step + two] + stiffness[k + 2],
        )  # fmt: skip
        to = pivot
        for value in (xx, xy, xz, xy, yy, yz, xz, yz, zz):
            kept[to] = -value
            to += one
        minus_product(scratch, 0, kept, k * (stride + 3) + 3 * stride, kept, k * (stride + 3), stride, stride // LANES)
        for i in range(0, n, 3):
            j = i // LANES * LANES
            subtract(a, i * stride + j, kept, k * (stride + 3) + i, scratch, j, stride, (stride - j) // LANES)


@as_written
def look_back(kept: AnyArray, n: int, stride: int, stiffness: AnyArray, z: AnyArray) -> None:
    """Moves of the points of a step in the place of z (n,), what the next step says of them, 0 of who left."""
    step, end = uint64(stride), uint64(n)
    for k in range(n - 3, -1, -3):
        u = uint64(k * (stride + 3))
        x, y, w = stiffness[k] * z[k], stiffness[k + 1] * z[k + 1], stiffness[k + 2] * z[k + 2]
        x, y, w = x + kept[u + end], y + kept[u + step + end], w + kept[u + step + step + end]
        z[k], z[k + 1], z[k + 2] = 0.0, 0.0, 0.0
        for j in range(end):
            x, y = x - kept[u + j] * z[j], y - kept[u + step + j] * z[j]
            w -= kept[u + step + step + j] * z[j]
        at = u + step + step + step
        for c in range(uint64(3)):
            row = at + uint64(3) * c
            z[uint64(k) + c] = -(kept[row] * x + kept[row + uint64(1)] * y + kept[row + uint64(2)] * w)


@as_written
def go_back(window: Any, start: AnyArray, step: int, memory: Any) -> None:
    """Move the points of a step, those of the next one being known."""
    who, motion, point, at, kept = window[0], window[1], window[2], window[3], window[7]
    here, then, m = step % len(point), (step + 1) % len(point), size(start, step)
    stiffness, z = memory[3], memory[4]
    stiffness[: 3 * m], z[: 3 * m] = 0.0, 0.0
    for k in range(size(start, step + 1)):
        place = who[then, PLACE, k]
        if place >= 0:
            row = 3 * block(place, m)
            for c in range(3):
                stiffness[row + c] = 1.0 / max(motion[then, PROCESS, k, c], LEAST_PROCESS)
                z[row + c] = point[then, k, c] - at[then, k, c]
    look_back(kept[here], 3 * m, width(3 * m), stiffness, z)
    add(point[here], m, z)


@as_written
def add(point: AnyArray, n: int, move: AnyArray) -> None:
    """Move the points of a star."""
    for k in range(n):
        for c in range(3):
            point[k, c] += move[3 * block(k, n) + c]


@as_written
def solve_newest(window: Any, start: AnyArray, t: int, memory: Any) -> None:
    """Move the newest points to where their information, eliminated, says."""
    a, factor, pivots, _, move, _ = memory
    n = size(start, t)
    assemble(window, start, t, a, move)
    eliminate(a, 3 * n, width(3 * n), factor, pivots)
    substitute(factor, 3 * n, width(3 * n), move)
    add(window[2][t % len(window[2])], n, move)


@as_written
def sweep(
    window: Any, seen: AnyArray, start: AnyArray, first: int, last: int, assumed: Any, refine: bool, entered: bool,
    memory: Any, cov: AnyArray,
) -> None:  # fmt: skip
    """One Gauss-Newton step of the window and the ego's covariance: `coopoc.methods.window.sweep`."""
    for step in range(first, last + 1):
        if refine and not (entered and step == last):
            look(window, seen, start, step, assumed)
        if step < last:
            go_on(window, start, step, assumed, memory)
    solve_newest(window, start, last, memory)
    if refine and entered:
        look(window, seen, start, last, assumed)
        solve_newest(window, start, last, memory)
    for step in range(last - 1, first - 1, -1):
        go_back(window, start, step, memory)
    at = 9 * (size(start, last) - 1)
    for i in range(3):
        for j in range(3):
            cov[i, j] = -memory[2][at + 3 * i + j]
