"""Vehicles that ever had to do with each other, over others or a while ago: between islands, covariances are zero.

Each island keeps the upper triangle of its covariance at a place of a flat array of its own size, so that what is far
apart costs nothing together. A plan (6, N+1) says where:

    HOME: the island of a column, -1 where absent. ROW: its place among the island's members.
    MEMBER: columns, island by island, in order. BEGIN: the first member of an island, and the end.
    BASE: where an island's matrix begins. STRIDE: how far its rows are apart; it has room for as many.
"""

from __future__ import annotations

from ..arrays import AnyArray
from .compile import part

HOME, ROW, MEMBER, BEGIN, BASE, STRIDE = range(6)
TILE = 12
"""Rows and columns come in multiples of it."""


@part
def meet(was: AnyArray, here: AnyArray, first: AnyArray, second: AnyArray, heard: AnyArray, label: AnyArray) -> bool:
    """Labels (N,) of the islands after those who come, those who go and the pairs that are heard; True if any changed.

    Args:
        was, here: (N,) True where a vehicle is present, at the last step and this one. label: -1 where absent.
    """
    changed, fresh = False, 0
    for c in range(len(label)):
        fresh = max(fresh, label[c] + 1)
    for c in range(len(label)):
        changed = changed or was[c] != here[c]
        if not here[c]:
            label[c] = -1
        elif not was[c]:
            label[c], fresh = fresh, fresh + 1
    for k in range(len(first)):
        one, other = label[first[k]], label[second[k]]
        if heard[k] and one != other:
            changed = True
            for c in range(len(label)):
                if label[c] == other:
                    label[c] = one
    return changed


@part
def settle(label: AnyArray, plan: AnyArray) -> int:
    """The plan of these labels, and how many islands it has."""
    islands, slot, base = 0, 0, 0
    plan[HOME] = -1
    for c in range(len(label)):
        if label[c] >= 0 and plan[HOME, c] < 0:
            begin = slot
            for d in range(c, len(label)):
                if label[d] == label[c]:
                    plan[HOME, d], plan[ROW, d], plan[MEMBER, slot] = islands, slot - begin, d
                    slot += 1
            stride = room(slot - begin)
            plan[BEGIN, islands], plan[BASE, islands], plan[STRIDE, islands] = begin, base, stride
            islands, base = islands + 1, base + stride * stride
    plan[BEGIN, islands] = slot
    return islands


@part
def room(members: int) -> int:
    """Stride of an island's matrix."""
    return (3 * members + TILE - 1) // TILE * TILE


@part
def move(old: AnyArray, plan: AnyArray, was: AnyArray, source: AnyArray, target: AnyArray, islands: int) -> None:
    """Covariances from their places in the old plan to those of the new one; nothing but zeros for those who join."""
    for island in range(islands):
        base, stride = plan[BASE, island], plan[STRIDE, island]
        target[base : base + stride * stride] = 0.0
        members = plan[MEMBER, plan[BEGIN, island] : plan[BEGIN, island + 1]]
        for i in range(len(members)):
            a = members[i]
            for j in range(i, len(members) if was[a] else i):
                b, home = members[j], old[HOME, a]
                if was[b] and old[HOME, b] == home:
                    there = old[BASE, home] + 3 * (old[ROW, a] * old[STRIDE, home] + old[ROW, b])
                    here = base + 3 * (i * stride + j)
                    for c in range(3):
                        for d in range(3):
                            target[here + c * stride + d] = source[there + c * old[STRIDE, home] + d]
