"""The filter of the whole fleet, island by island: `coopoc.methods.central_filter`.

Arguments travel in plain tuples, `measured`, `contacts` and `assumed` as in `coopoc.kernels.gossip`; `alive` counts a
pair as soon as a message gets through one way.

    state: label (N,), two plans and covariances of `islands`, which of the two counts and how many islands (2,).
    scratch: information and pull of the most pairs of a step, and what `rank.learn` takes beside the state.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import AnyArray
from .compile import compiled, part
from .consensus import times
from .gossip import both
from .islands import BASE, BEGIN, HOME, MEMBER, ROW, STRIDE, meet, move, room, settle
from .pseudo_fix import PLACE, one_of
from .rank import COPIED, learn

WHICH, ISLANDS = range(2)


def begin(vehicles: int, most: int, runs: int) -> tuple[Any, Any]:
    """State before the first step, and scratch for so many pairs a step and runs together."""
    size, wide = room(vehicles) ** 2 + vehicles * room(1) ** 2, room(vehicles)
    plans, near = np.zeros((2, 6, vehicles + 1), np.int64), np.zeros((vehicles, vehicles), np.bool_)
    memory = np.zeros((COPIED + wide) * wide), np.zeros((4, vehicles), np.int64)
    scratch = (np.zeros((most, 6)), np.zeros((runs, most, 3)), np.zeros((runs, vehicles, 3)), np.zeros((runs, wide)),
               np.zeros(size), near, memory)  # fmt: skip
    return (np.full(vehicles, -1), plans, np.zeros((2, size)), np.zeros(2, np.int64)), scratch


@compiled
def follow(
    measured: Any, contacts: Any, assumed: Any, there: AnyArray, state: Any, scratch: Any, runs: Any, span: Any,
    x: AnyArray, cov: AnyArray,
) -> None:  # fmt: skip
    """Fill positions (R, T, N, 3) m and covariances (R, T, N, 3, 3) m^2 of some runs over a span of steps.

    Args:
        there: (T+1, N) who is present, nobody before the first step. runs: the first and how many, which share its
            covariance. span: the first step and the one behind the last.
    """
    gnss, _, seen, _ = measured
    first, second, _, _, start, alive = contacts
    label, plans, spreads, now = state
    weight, force, pull, moved, info, near, memory = scratch
    for t in range(span[0], span[1]):
        was, pairs = there[t], slice(start[t], start[t + 1])
        if meet(was, there[t + 1], first[pairs], second[pairs], alive[runs[0], pairs], label):
            old, new = now[WHICH], 1 - now[WHICH]
            now[WHICH], now[ISLANDS] = new, settle(label, plans[new])
            move(plans[old], plans[new], was, spreads[old], spreads[new], now[ISLANDS])
        plan, spread = plans[now[WHICH]], spreads[now[WHICH]]
        predict(measured, assumed, runs, t, was, plan, spread, x)
        for run in range(runs[1]):
            sightings, at, pulls = seen[runs[0] + run], x[runs[0] + run, t], force[run]
            for k in range(start[t], start[t + 1]):
                if alive[runs[0], k]:
                    link(sightings, contacts, assumed, k, plan, spread, at, weight[k - start[t]], pulls[k - start[t]])
        gather(contacts, assumed[1], runs[0], t, was, plan, now[ISLANDS], spread, weight, info, near)
        for run in range(runs[1]):
            drawn(contacts, assumed[1], gnss[runs[0] + run, t], runs[0], t, x[runs[0] + run, t], force[run], pull[run])
        for island in range(now[ISLANDS]):
            learn(plan, island, spread, info, near, memory, pull, moved)
            for run in range(runs[1]):
                conclude(plan, island, spread, moved[run], x[runs[0] + run, t], cov[runs[0] + run, t])


@part
def predict(
    measured: Any, assumed: Any, runs: Any, t: int, was: AnyArray, plan: AnyArray, spread: AnyArray, x: AnyArray
) -> None:  # fmt: skip
    """Everyone moves with its velocity; who has just come stands at its fix, and nothing is known of it."""
    gnss, velocity, _, dt = measured
    for c in range(x.shape[2]):
        if plan[HOME, c] >= 0:
            for a in range(3):
                for run in range(runs[0], runs[0] + runs[1]):
                    moved = x[run, t - 1, c, a] + dt * velocity[run, t, c, a]
                    x[run, t, c, a] = moved if was[c] else gnss[run, t, c, a]
                at = block(plan, c, c) + a * (plan[STRIDE, plan[HOME, c]] + 1)
                spread[at] = spread[at] + one_of(assumed[0], runs[0], t, c, a) if was[c] else assumed[4]


@part
def block(plan: AnyArray, c: int, d: int) -> int:
    """Where the block of two members of an island begins."""
    home = plan[HOME, c]
    return int(plan[BASE, home] + 3 * (plan[ROW, c] * plan[STRIDE, home] + plan[ROW, d]))


@part
def link(
    seen: AnyArray, contacts: Any, assumed: Any, k: int, plan: AnyArray, spread: AnyArray, x: AnyArray,
    weight: AnyArray, force: AnyArray,
) -> None:  # fmt: skip
    """Information of a pair's sightings and its pull at the beliefs, linear where these and the sightings agree."""
    i, j, links, std, least = contacts[0][k], contacts[1][k], (contacts[2][k], contacts[3][k]), assumed[2], assumed[3]
    vx, vy, vz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    both(vx, vy, vz, links, seen, std, least, False, weight, force)
    if len(std) == 0:
        return
    mx, my, mz = shifted(apart(plan, spread, i, j), weight, force)
    both(vx + mx, vy + my, vz + mz, links, seen, std, least, True, weight, force)
    px, py, pz = times(weight, mx, my, mz)
    force[0], force[1], force[2] = force[0] + px, force[1] + py, force[2] + pz


@part
def shifted(s: Any, w: AnyArray, force: AnyArray) -> Any:
    """(1 + S W)^-1 S force by Cramer's rule, and once more with what is left: W may be next to singular."""
    p, q, r = times(s, force[0], force[1], force[2])
    xx, yx, zx = times(s, w[0], w[1], w[2])
    xy, yy, zy = times(s, w[1], w[3], w[4])
    xz, yz, zz = times(s, w[2], w[4], w[5])
    xx, yy, zz = xx + 1.0, yy + 1.0, zz + 1.0
    a, b, c = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    d, e, f = xz * zy - xy * zz, xx * zz - xz * zx, xy * zx - xx * zy
    g, h, i = xy * yz - xz * yy, xz * yx - xx * yz, xx * yy - xy * yx
    scale = 1.0 / (xx * a + xy * b + xz * c)
    x, y, z = 0.0, 0.0, 0.0
    for _ in range(2):
        u, v, t = p - xx * x - xy * y - xz * z, q - yx * x - yy * y - yz * z, r - zx * x - zy * y - zz * z
        x += scale * (a * u + d * v + g * t)
        y += scale * (b * u + e * v + h * t)
        z += scale * (c * u + f * v + i * t)
    return x, y, z


@part
def apart(plan: AnyArray, spread: AnyArray, i: int, j: int) -> Any:
    """Covariance of x_j - x_i, the upper triangle; i before j."""
    a, b, c, step = block(plan, i, i), block(plan, j, j), block(plan, i, j), plan[STRIDE, plan[HOME, i]]
    xx = spread[a] + spread[b] - 2.0 * spread[c]
    xy = spread[a + 1] + spread[b + 1] - spread[c + 1] - spread[c + step]
    xz = spread[a + 2] + spread[b + 2] - spread[c + 2] - spread[c + 2 * step]
    a, b, c = a + step + 1, b + step + 1, c + step + 1
    yy = spread[a] + spread[b] - 2.0 * spread[c]
    yz = spread[a + 1] + spread[b + 1] - spread[c + 1] - spread[c + step]
    a, b, c = a + step + 1, b + step + 1, c + step + 1
    return xx, xy, xz, yy, yz, spread[a] + spread[b] - 2.0 * spread[c]


@part
def gather(
    contacts: Any, noise: AnyArray, run: int, t: int, was: AnyArray, plan: AnyArray, islands: int, spread: AnyArray,
    weight: AnyArray, info: AnyArray, near: AnyArray,
) -> None:  # fmt: skip
    """The step's information, lower triangles, and who shares some.

    Half of the fix of those who have just come is all that they begin with: so neither matrix is singular.
    """
    last = islands - 1
    info[: plan[BASE, last] + plan[STRIDE, last] ** 2 if islands > 0 else 0] = 0.0
    for island in range(islands):
        members = slice(plan[BEGIN, island], plan[BEGIN, island + 1])
        near[members, members] = False
    for c in range(len(was)):
        for a in range(3 if plan[HOME, c] >= 0 else 0):
            at = block(plan, c, c) + a * (plan[STRIDE, plan[HOME, c]] + 1)
            info[at] = (1.0 if was[c] else 0.5) / noise[a]
            if not was[c]:
                spread[at] = 2.0 * noise[a]
    first, second, _, _, start, alive = contacts
    for k in range(start[t], start[t + 1]):
        if alive[run, k]:
            i, j, w = first[k], second[k], weight[k - start[t]]
            step, one, other = plan[STRIDE, plan[HOME, i]], begin_of(plan, i), begin_of(plan, j)
            near[one, other] = near[other, one] = True
            put_in(info, block(plan, i, i), step, 1.0, w)
            put_in(info, block(plan, j, j), step, 1.0, w)
            put_in(info, block(plan, j, i), step, -1.0, w)


@part
def begin_of(plan: AnyArray, c: int) -> int:
    """The slot of a column."""
    return int(plan[BEGIN, plan[HOME, c]] + plan[ROW, c])


@part
def put_in(info: AnyArray, at: int, step: int, sign: float, w: AnyArray) -> None:
    """Add a symmetric block given as six numbers."""
    for c in range(3):
        for d in range(3):
            info[at + c * step + d] += sign * w[PLACE[c][d]]


@part
def drawn(
    contacts: Any, noise: AnyArray, fix: AnyArray, run: int, t: int, x: AnyArray, force: AnyArray, pull: AnyArray
) -> None:  # fmt: skip
    """What fixes and pairs pull at each position, 1/m."""
    first, second, _, _, start, alive = contacts
    for c in range(len(pull)):
        for a in range(3):
            pull[c, a] = (fix[c, a] - x[c, a]) / noise[a]
    for k in range(start[t], start[t + 1]):
        if alive[run, k]:
            for a in range(3):
                pull[first[k], a] -= force[k - start[t], a]
                pull[second[k], a] += force[k - start[t], a]


@part
def conclude(plan: AnyArray, island: int, spread: AnyArray, moved: AnyArray, x: AnyArray, cov: AnyArray) -> None:
    """Positions of the members of an island and their own covariances."""
    members, stride = plan[MEMBER, plan[BEGIN, island] : plan[BEGIN, island + 1]], plan[STRIDE, island]
    for i in range(len(members)):
        at = plan[BASE, island] + 3 * i * (stride + 1)
        for c in range(3):
            x[members[i], c] += moved[3 * i + c]
            for d in range(3):
                cov[members[i], c, d] = spread[at + min(c, d) * stride + max(c, d)]
