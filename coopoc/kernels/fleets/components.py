"""Vehicles that share information, over others or at an earlier step: between components, covariances are zero.

Each component keeps the upper triangle of its covariance in a flat array, with a stride of its own size. A plan
(6, N+1) of whole numbers describes where:

    HOME: the component of a column, -1 where absent. ROW: its place among the component's members.
    MEMBER: columns, component by component, in order. BEGIN: the first member of a component, and the end.
    BASE: where a component's matrix begins. STRIDE: distance of its rows; it has as many.
"""

from __future__ import annotations

from ...arrays import AnyArray
from ..compiling.compile import compiled, part

HOME, ROW, MEMBER, BEGIN, BASE, STRIDE = range(6)
TILE = 12
"""Rows and columns come in multiples of it."""


@part
def connect(
    before: AnyArray, here: AnyArray, first: AnyArray, second: AnyArray, alive: AnyArray, label: AnyArray
) -> bool:
    """Update the labels of the components for joining and leaving vehicles and for pairs; True if any changed.

    Args:
        before: (N,) True where a vehicle was active at the last step.
        here: (N,) True where it is active now.
        first: (P,) columns of the step's pairs.
        second: (P,) columns.
        alive: (P,) whether the pair takes part.
        label: (N,) component, -1 where absent.
    """
    changed, fresh = False, 0
    for c in range(len(label)):
        fresh = max(fresh, label[c] + 1)
    for c in range(len(label)):
        changed = changed or before[c] != here[c]
        if not here[c]:
            label[c] = -1
        elif not before[c]:
            label[c], fresh = fresh, fresh + 1
    for k in range(len(first)):
        one, other = label[first[k]], label[second[k]]
        if alive[k] and one != other:
            changed = True
            for c in range(len(label)):
                if label[c] == other:
                    label[c] = one
    return changed


@part
def arrange(label: AnyArray, plan: AnyArray) -> int:
    """Make the plan of these labels; how many components it has."""
    components, slot, base = 0, 0, 0
    plan[HOME] = -1
    for c in range(len(label)):
        if label[c] >= 0 and plan[HOME, c] < 0:
            begin = slot
            for d in range(c, len(label)):
                if label[d] == label[c]:
                    plan[HOME, d], plan[ROW, d], plan[MEMBER, slot] = components, slot - begin, d
                    slot += 1
            stride = padded(slot - begin)
            plan[BEGIN, components], plan[BASE, components], plan[STRIDE, components] = begin, base, stride
            components, base = components + 1, base + stride * stride
    plan[BEGIN, components] = slot
    return components


@compiled
def padded(members: int) -> int:
    """Stride of a component's matrix."""
    return (3 * members + TILE - 1) // TILE * TILE


@part
def place(plan: AnyArray, c: int, d: int) -> int:
    """Where the (3, 3) block of two members of a component begins."""
    home = plan[HOME, c]
    return int(plan[BASE, home] + 3 * (plan[ROW, c] * plan[STRIDE, home] + plan[ROW, d]))


@part
def move(old: AnyArray, plan: AnyArray, before: AnyArray, source: AnyArray, target: AnyArray, components: int) -> None:
    """Copy covariances from their places in the old plan to those of the new one; zeros for vehicles that join."""
    for component in range(components):
        base, stride = plan[BASE, component], plan[STRIDE, component]
        target[base : base + stride * stride] = 0.0
        members = plan[MEMBER, plan[BEGIN, component] : plan[BEGIN, component + 1]]
        for i in range(len(members)):
            a = members[i]
            for j in range(i, len(members) if before[a] else i):
                b, home = members[j], old[HOME, a]
                if before[b] and old[HOME, b] == home:
                    there, here = place(old, a, b), place(plan, a, b)
                    for c in range(3):
                        for d in range(3):
                            target[here + c * stride + d] = source[there + c * old[STRIDE, home] + d]
