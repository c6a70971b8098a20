"""The filter of `coopoc.kernels.star_filter` for LANES runs abreast: same steps, same order, same digits.

Who is seen is the same in all runs; what arrived of it is not, and is told by numbers alone: a weight of zero, or a
stiffness next to it. So every number becomes a vector over runs and no run takes another way. Memory is in flat arrays
of vectors; of a star of n vehicles the ego's state comes first, its block last.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import uint64

from ..arrays import AnyArray
from .abreast import pack, put, take
from .blocks_abreast import eliminate, loosen, nine, put_nine, put_three, substitute, three
from .compile import as_written
from .lanes import LANES
from .messages_abreast import tell as tell_abreast
from .sighting import converted, exact, vector
from .star_messages import LEAST_PROCESS, place_of


@as_written
def follow_abreast(measured: Any, assumed: Any, refine: bool, first: int, last: int, out: Any) -> None:
    """Fill x, covariance and neighbours, as `follow` does, of the runs first to last, at most LANES of them."""
    start = measured[4]
    most = 1 + np.diff(start).max()
    matrix, three_each = 9 * most * most * LANES, 3 * most * LANES
    information, before, a = np.zeros(matrix), np.zeros(matrix), np.zeros(matrix)
    state, was_state, stiffness = np.zeros(three_each), np.zeros(three_each), np.zeros(three_each)
    side, move, motion, scratch = (
        np.zeros(three_each), np.zeros(three_each), np.zeros(4 * three_each), np.zeros(6 * three_each)
    )  # fmt: skip
    member, was_member, kept = np.zeros((1, most), np.int64), np.zeros((1, most), np.int64), np.zeros(most, np.int64)
    held, was_held = np.zeros((5, most, LANES)), np.zeros((5, most, LANES))
    runs, old = (first, last), 0
    for t in range(len(start) - 1):
        n = 1 + start[t + 1] - start[t]
        hear(measured, assumed, runs, t, member[:, :n], was_member[:, :old], kept, held, was_held, motion)
        here = measured[2], start[t], first, last
        predict(was_state, old, kept[:n], motion, here, state, stiffness)
        loosen(before, old, most, stiffness, scratch)
        if n == old and unmoved(kept[:n]):
            information, before = before, information
        else:
            rearrange(before, old, most, kept[:n], 1.0 / assumed[4], information)
        pivot = update(state, n, most, motion, here, assumed, refine, (information, a, side, move, scratch))
        tell(out, t, start[t], n, runs, state, pivot, scratch)
        state, was_state, information, before = was_state, state, before, information
        member, was_member, held, was_held, old = was_member, member, was_held, held, n


@as_written
def hear(
    measured: Any, assumed: Any, runs: Any, t: int, member: AnyArray, was: AnyArray, kept: AnyArray, held: AnyArray,
    was_held: AnyArray, motion: AnyArray,
) -> None:  # fmt: skip
    """Who is in the star and its place in the last one; of each run the step of the message held and its uses, in
    `held`; what the messages say, in `motion`."""
    neighbour, start, newest, ego = measured[3], measured[4], measured[5], measured[7]
    for k in range(member.shape[1]):
        link = start[t] + k - 1
        member[0, k] = ego if k == 0 else neighbour[link]
        kept[k] = place = place_of(member[0, k], was)
        for lane in range(LANES):
            sent = t if k == 0 else newest[min(runs[0] + lane, runs[1]), link]
            again = place >= 0 and was_held[0, place, lane] == sent
            held[0, k, lane], held[1, k, lane] = sent, was_held[1, place, lane] + 1.0 if again else 1.0
        tell_abreast(measured, assumed, runs, t, k, member[0, k], held, motion)


@as_written
def sighted(here: Any, k: int) -> Any:
    """What is seen of member k, five vectors of `unfolded`."""
    seen, start, first, last = here
    at, last = uint64(start + k - 1), uint64(last)
    a, b, c, d = uint64(first), min(uint64(first + 1), last), min(uint64(first + 2), last), min(uint64(first + 3), last)
    o, p, q, r, s = uint64(0), uint64(1), uint64(2), uint64(3), uint64(4)
    return (pack(seen[a, at, o], seen[b, at, o], seen[c, at, o], seen[d, at, o]),
            pack(seen[a, at, p], seen[b, at, p], seen[c, at, p], seen[d, at, p]),
            pack(seen[a, at, q], seen[b, at, q], seen[c, at, q], seen[d, at, q]),
            pack(seen[a, at, r], seen[b, at, r], seen[c, at, r], seen[d, at, r]),
            pack(seen[a, at, s], seen[b, at, s], seen[c, at, s], seen[d, at, s]))  # fmt: skip


@as_written
def block(k: int, n: int) -> int:
    """Block of member k among n: the ego's is the last."""
    return k - 1 if k > 0 else n - 1


@as_written
def predict(
    before: AnyArray, old: int, kept: AnyArray, motion: AnyArray, here: Any, state: AnyArray, stiffness: AnyArray
) -> None:  # fmt: skip
    """State of the new star from that of the last one, and the stiffness of the motion of who stays."""
    stiffness[: 3 * old * LANES] = 0.0
    for k in range(len(kept)):
        place = kept[k]
        if place >= 0:
            x, y, z = three(before, place)
            u, v, w = three(motion, 4 * k)
            put_three(state, k, (x + u, y + v, z + w))
            p, q, r = three(motion, 4 * k + 1)
            p, q, r = 1.0 / max(p, LEAST_PROCESS), 1.0 / max(q, LEAST_PROCESS), 1.0 / max(r, LEAST_PROCESS)
            put_three(stiffness, block(place, old), (p, q, r))
        elif k == 0:
            put_three(state, k, three(motion, 2))
        else:
            x, y, z = three(state, 0)
            u, v, w = vector(sighted(here, k))
            put_three(state, k, (x + u, y + v, z + w))


@as_written
def unmoved(kept: AnyArray) -> bool:
    """True if every member stands where it stood."""
    moved = 0
    for k in range(len(kept)):
        moved += kept[k] != k
    return moved == 0


@as_written
def rearrange(last: AnyArray, old: int, stride: int, kept: AnyArray, forgotten: float, information: AnyArray) -> None:
    """Information of the new star from that of the last one, which lacks who left; `forgotten` of who joins."""
    n = len(kept)
    for k in range(n):
        row = block(k, n)
        for j in range(n):
            column = block(j, n)
            if column < row:
                continue
            at = row * stride + column
            if kept[k] < 0 or kept[j] < 0:
                for i in range(9 * LANES):
                    on_diagonal = k == j and i // LANES % 4 == 0
                    information[uint64(9 * LANES * at + i)] = forgotten if on_diagonal else 0.0
                continue
            from_row, from_column = block(kept[k], old), block(kept[j], old)
            if from_row <= from_column:
                put_nine(information, at, nine(last, from_row * stride + from_column))
            else:
                p, q, r, s, t, u, v, w, x = nine(last, from_column * stride + from_row)
                put_nine(information, at, (p, s, v, q, t, w, r, u, x))


@as_written
def update(
    state: AnyArray, n: int, stride: int, motion: AnyArray, here: Any, assumed: Any, refine: bool, memory: Any
) -> Any:  # fmt: skip
    """State and information given the fixes and the sightings; upper triangle of minus the ego's covariance."""
    information, a, side, move, scratch = memory
    add_fixes(information, n, stride, state, motion, side)
    move[: 3 * n * LANES] = 0.0
    if refine and n > 1:
        copy(information, a, n, stride)
        move[: 3 * n * LANES] = side[: 3 * n * LANES]
        for k in range(1, n):
            add_converted(a, move, stride, n, k, state, sighted(here, k), assumed)
        eliminate(a, a, move, n, stride, scratch)
        substitute(a, move, n, stride)
    for k in range(1, n):
        if refine:
            add_exact(information, side, stride, n, k, state, move, sighted(here, k), assumed)
        else:
            add_converted(information, side, stride, n, k, state, sighted(here, k), assumed)
    pivot = eliminate(information, a, side, n, stride, scratch)
    substitute(a, side, n, stride)
    for k in range(n):
        x, y, z = three(state, k)
        u, v, w = three(side, block(k, n))
        put_three(state, k, (x + u, y + v, z + w))
    return pivot


@as_written
def copy(source: AnyArray, target: AnyArray, n: int, stride: int) -> None:
    """What is on and above the diagonal."""
    for i in range(n):
        for j in range(i, n):
            put_nine(target, i * stride + j, nine(source, i * stride + j))


@as_written
def add_fixes(information: AnyArray, n: int, stride: int, state: AnyArray, motion: AnyArray, side: AnyArray) -> None:
    """The fixes that are new, and in `side` what they pull."""
    for k in range(n):
        row = block(k, n)
        diagonal = uint64(9 * (row * stride + row))
        x, y, z = three(state, k)
        a, b, c = three(motion, 4 * k + 2)
        p, q, r = three(motion, 4 * k + 3)
        put(information, diagonal, take(information, diagonal) + p)
        put(information, diagonal + uint64(4), take(information, diagonal + uint64(4)) + q)
        put(information, diagonal + uint64(8), take(information, diagonal + uint64(8)) + r)
        put_three(side, row, (p * (a - x), q * (b - y), r * (c - z)))


@as_written
def add_converted(
    a: AnyArray, side: AnyArray, stride: int, n: int, k: int, state: AnyArray, seen: Any, assumed: Any
) -> None:  # fmt: skip
    """The converted sighting of member k, with its covariance at the predicted geometry."""
    u, v, w = three(state, 0)
    x, y, z = three(state, k)
    x, y, z = x - u, y - v, z - w
    std = assumed[2]
    o, e = 0.0 * x, 0.0 * x + 1.0
    xx, xy, xz, yy, yz, zz = converted(x, y, z, std, assumed[3]) if len(std) else (e, o, o, e, o, e)
    to_x, to_y, to_z = vector(seen)
    x, y, z = to_x - x, to_y - y, to_z - z
    pull = (xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z)
    add_edge(a, side, stride, n, k, (xx, xy, xz, yy, yz, zz), pull)


@as_written
def add_exact(
    a: AnyArray, side: AnyArray, stride: int, n: int, k: int, state: AnyArray, move: AnyArray, seen: Any, assumed: Any
) -> None:  # fmt: skip
    """The sighting of member k linear at the state moved by `move`, as seen from the state."""
    u, v, w = three(move, n - 1)
    x, y, z = three(move, k - 1)
    x, y, z = x - u, y - v, z - w
    a0, b0, c0 = three(state, 0)
    ak, bk, ck = three(state, k)
    xx, xy, xz, yy, yz, zz, px, py, pz = exact(ak - a0 + x, bk - b0 + y, ck - c0 + z, seen, assumed[2], assumed[3])
    pull = (px + xx * x + xy * y + xz * z, py + xy * x + yy * y + yz * z, pz + xz * x + yz * y + zz * z)
    add_edge(a, side, stride, n, k, (xx, xy, xz, yy, yz, zz), pull)


@as_written
def add_edge(a: AnyArray, side: AnyArray, stride: int, n: int, k: int, weight: Any, pull: Any) -> None:
    """Information and pull of a measured x_k - x_0, on and above the diagonal and in `side`."""
    xx, xy, xz, yy, yz, zz = weight
    for i in (k - 1, n - 1):
        p, q, r, s, t, u, v, w, x = nine(a, i * stride + i)
        put_nine(a, i * stride + i, (p + xx, q + xy, r + xz, s, t + yy, u + yz, v, w, x + zz))
    p, q, r, s, t, u, v, w, x = nine(a, (k - 1) * stride + n - 1)
    put_nine(a, (k - 1) * stride + n - 1, (p - xx, q - xy, r - xz, s - xy, t - yy, u - yz, v - xz, w - yz, x - zz))
    u, v, w = three(side, k - 1)
    put_three(side, k - 1, (u + pull[0], v + pull[1], w + pull[2]))
    u, v, w = three(side, n - 1)
    put_three(side, n - 1, (u - pull[0], v - pull[1], w - pull[2]))


@as_written
def tell(out: Any, t: int, start: int, n: int, runs: Any, state: AnyArray, pivot: Any, scratch: AnyArray) -> None:
    """What the step found, run by run."""
    x, cov, others = out
    a, b, c, d, e, f = pivot
    put_nine(scratch, 0, (-a, -b, -c, -b, -d, -e, -c, -e, -f))
    for lane in range(runs[1] - runs[0] + 1):
        run = runs[0] + lane
        for i in range(3):
            x[run, t, i] = state[LANES * i + lane]
            for j in range(3):
                cov[run, t, i, j] = scratch[LANES * (3 * i + j) + lane]
        for k in range(1, n):
            for i in range(3):
                others[run, start + k - 1, i] = state[LANES * (3 * k + i) + lane]
