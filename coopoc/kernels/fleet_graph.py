"""What the whole fleet measured, as information about differences of positions, into each step's matrix.

Of a matrix only the lower triangle counts. Arguments travel in plain tuples, which numba's cache can name:

    graph: place (T, N), the vehicle's number among those of its step, -1 where absent; first, second (P,) columns of
        the pairs that count, first < second; sight, back (P,) their links, -1 for none; start (T+1,), the pairs of step
        t are start[t]:start[t+1]; seen (L, 5) of `unfolded`; std (3,) m, rad, rad, of no length for unit matrices;
        least range m.
    own: weight of a fix (3,) 1/m^2; fixes (T, N, 3) m; weight of the motion from the step before (T, N, 3) 1/m^2; that
        motion (T, N, 3) m. NaN where there is none.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import AnyArray, Floats
from .compile import compiled
from .sighting import exact, facing, vector


@compiled
def linearise(at: AnyArray, graph: Any, again: bool) -> tuple[Floats, Floats]:
    """Information (P, 3, 3) of both sightings of each pair, and what they pull at its vector, (P, 3).

    Args:
        at: (T, N, 3) m. again: True linearises range and angles there; False where they were measured (converted).
    """
    _, first, second, sight, back, start, seen, std, least = graph
    weight, pull = np.zeros((len(first), 3, 3)), np.zeros((len(first), 3))
    for t in range(len(start) - 1):
        for k in range(start[t], start[t + 1]):
            i, j = first[k], second[k]
            x, y, z = at[t, j, 0] - at[t, i, 0], at[t, j, 1] - at[t, i, 1], at[t, j, 2] - at[t, i, 2]
            for link, sign in ((sight[k], 1.0), (back[k], -1.0)):
                if link >= 0:
                    one = (seen[link, 0], seen[link, 1], seen[link, 2], seen[link, 3], seen[link, 4])
                    found = sighted(sign * x, sign * y, sign * z, one, std, least, again)
                    add(weight[k], pull[k], found, sign)
    return weight, pull


@compiled
def sighted(x: float, y: float, z: float, seen: Any, std: Any, least: float, again: bool) -> Any:
    """Information, upper triangle, and pull of one sighting at the vector (x, y, z) from observer to neighbour."""
    a, b, c = vector(seen)
    u, v, w = a - x, b - y, c - z
    if len(std) == 0:
        return 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, u, v, w
    if again:
        return exact(x, y, z, seen, std, least)
    xx, xy, xz, yy, yz, zz = facing(seen, std, least)
    return (xx, xy, xz, yy, yz, zz, xx * u + xy * v + xz * w, xy * u + yy * v + yz * w,
            xz * u + yz * v + zz * w)  # fmt: skip


@compiled
def add(weight: AnyArray, pull: AnyArray, found: Any, sign: float) -> None:
    """Add what `sighted` found to its pair; sign -1 for what the second saw of the first."""
    xx, xy, xz, yy, yz, zz, p, q, r = found
    for row, three, force in ((0, (xx, xy, xz), p), (1, (xy, yy, yz), q), (2, (xz, yz, zz), r)):
        weight[row, 0] += three[0]
        weight[row, 1] += three[1]
        weight[row, 2] += three[2]
        pull[row] += sign * force


@compiled
def gather(t: int, graph: Any, weight: AnyArray, fix_weight: AnyArray, total: AnyArray) -> None:
    """Add the information of the fixes and pairs of step t to its matrix (n, n)."""
    place, first, second, _, _, start = graph[:6]
    for column in range(place.shape[1]):
        a = 3 * place[t, column]
        if a >= 0:
            for c in range(3):
                total[a + c, a + c] += fix_weight[c]
    for k in range(start[t], start[t + 1]):
        a, b = 3 * place[t, first[k]], 3 * place[t, second[k]]
        for c in range(3):
            for r in range(3):
                total[b + r, a + c] -= weight[k, r, c]
                if r >= c:
                    total[a + r, a + c] += weight[k, r, c]
                    total[b + r, b + c] += weight[k, r, c]


@compiled
def toward(at: AnyArray, graph: Any, force: AnyArray, own: Any) -> Floats:
    """(T, N, 3) 1/m, what fixes and pairs pull at every position, NaN where a vehicle is absent."""
    first, second, start = graph[1], graph[2], graph[5]
    pull: Floats = own[0] * (own[1] - at)
    for t in range(len(start) - 1):
        for k in range(start[t], start[t + 1]):
            for c in range(3):
                pull[t, first[k], c] -= force[k, c]
                pull[t, second[k], c] += force[k, c]
    return pull
