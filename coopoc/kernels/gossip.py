"""The whole fleet over a drive, each vehicle with its own filter, and a few rounds of messages at each step.

The methods of `coopoc.methods.gbp` and `coopoc.methods.admm` after `coopoc.methods.network`, one run after the other.
Between steps a vehicle keeps the mean that comes out and its own filter's covariance, which is diagonal. A pair k has
its information `weight[k]` (six numbers, the upper triangle) and `pull[k]` about x_second - x_first, and two directed
messages: to its first vehicle `[k, 0]`, to its second `[k, 1]`. Arguments travel in plain tuples:

    measured: gnss, velocity (R, T, N, 3) m, m/s; seen (R, L, 5) of `unfolded`; dt s.
    contacts: first, second (P,) columns; sight, back (P,) links, -1 for none; start (T+1,); alive (R, P), whether the
        pair's messages get through both ways.
    assumed: variance of the motion, broadcastable to (R, T, N, 3) m^2; noise (3,) m^2 of a fix; std (3,) m, rad, rad,
        of no length for unit matrices; least range m.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..arrays import AnyArray, Floats
from .blocks import inverse3
from .compile import compiled
from .consensus import consent, times
from .fleet_graph import sighted


@compiled
def follow(
    measured: Any, contacts: Any, assumed: Any, rounds: int, damping: float, rho: float
) -> tuple[Floats, Floats]:
    """Positions (R, T, N, 3) m and covariances (R, T, N, 3, 3) m^2 of all vehicles, NaN m where absent.

    Args:
        damping: share of the old message, of belief propagation. rho: 1/m^2, of ADMM; 0 for belief propagation.
    """
    gnss, velocity, seen, dt = measured
    first, second, sight, back, start, alive = contacts
    variance, noise, std, least = assumed
    runs, steps, vehicles = gnss.shape[0], gnss.shape[1], gnss.shape[2]
    x, cov = np.full((runs, steps, vehicles, 3), np.nan), np.zeros((runs, steps, vehicles, 3, 3))
    own, most = np.zeros((vehicles, 3)), np.diff(start).max()
    weight, pull, told = np.zeros((most, 6)), np.zeros((most, 3)), np.zeros((most, 2, 6))
    eta, heard, total = np.zeros((most, 2, 3)), np.zeros(most, np.bool_), np.zeros((vehicles, 9))
    z, duals = np.zeros((vehicles, 9)), np.zeros((most, 2, 6))
    for run in range(runs):
        for t in range(steps):
            step_alone(gnss, velocity, variance, noise, dt, run, t, x, own)
            here, count = slice(start[t], start[t + 1]), start[t + 1] - start[t]
            for k in range(count):
                heard[k] = alive[run, start[t] + k]
                if heard[k]:
                    links = (sight[start[t] + k], back[start[t] + k])
                    link(x[run, t], own, first[start[t] + k], second[start[t] + k], links, seen[run], std, least,
                         weight[k], pull[k])  # fmt: skip
            for n in range(vehicles):
                for c in range(3):
                    cov[run, t, n, c, c] = own[n, c]
            if rho > 0.0:
                consent(rounds, rho, first[here], second[here], heard, weight, pull, own, total, z, told, duals,
                        x[run, t])  # fmt: skip
            else:
                believe(rounds, damping, first[here], second[here], heard, weight, pull, own, total, told, eta)
                gather(first[here], second[here], own, told, eta, total)
                conclude(total, x[run, t], cov[run, t])
    return x, cov


@compiled
def step_alone(
    gnss: AnyArray, velocity: AnyArray, variance: AnyArray, noise: AnyArray, dt: float, run: int, t: int, x: AnyArray,
    own: AnyArray,
) -> None:  # fmt: skip
    """Prediction and fix of each vehicle; who has just come stands at its fix."""
    i, j = min(run, variance.shape[0] - 1), min(t, variance.shape[1] - 1)
    for n in range(x.shape[2]):
        m = min(n, variance.shape[2] - 1)
        for c in range(3):
            fix, prior = gnss[run, t, n, c], np.nan
            if t > 0:
                prior = x[run, t - 1, n, c] + dt * velocity[run, t, n, c]
            if math.isnan(prior) or math.isnan(fix):
                x[run, t, n, c], own[n, c] = fix, noise[c]
            else:
                spread = own[n, c] + variance[i, j, m, c]
                gain = spread / (spread + noise[c])
                x[run, t, n, c] = prior + gain * (fix - prior)
                own[n, c] = (1.0 - gain) ** 2 * spread + gain * gain * noise[c]


@compiled
def link(
    x: AnyArray, own: AnyArray, i: int, j: int, links: Any, seen: AnyArray, std: AnyArray, least: float,
    weight: AnyArray, pull: AnyArray,
) -> None:  # fmt: skip
    """Information of a pair's sightings and its pull at the beliefs, linear where these and the sightings agree."""
    vx, vy, vz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    both(vx, vy, vz, links, seen, std, least, False, weight, pull)
    if len(std) == 0:
        return
    a, b, c, d, e, f = inverse3(
        weight[0] + 1.0 / (own[i, 0] + own[j, 0]), weight[1], weight[2], weight[3] + 1.0 / (own[i, 1] + own[j, 1]),
        weight[4], weight[5] + 1.0 / (own[i, 2] + own[j, 2]),
    )  # fmt: skip
    mx, my, mz = (
        a * pull[0] + b * pull[1] + c * pull[2], b * pull[0] + d * pull[1] + e * pull[2],
        c * pull[0] + e * pull[1] + f * pull[2],
    )  # fmt: skip
    both(vx + mx, vy + my, vz + mz, links, seen, std, least, True, weight, pull)
    pull[0] += weight[0] * mx + weight[1] * my + weight[2] * mz
    pull[1] += weight[1] * mx + weight[3] * my + weight[4] * mz
    pull[2] += weight[2] * mx + weight[4] * my + weight[5] * mz


@compiled
def both(
    x: float, y: float, z: float, links: Any, seen: AnyArray, std: AnyArray, least: float, again: bool,
    weight: AnyArray, pull: AnyArray,
) -> None:  # fmt: skip
    """Both sightings of a pair at the vector (x, y, z)."""
    weight[:] = 0.0
    pull[:] = 0.0
    for way in range(2):
        at, sign = links[way], 1.0 - 2.0 * way
        if at >= 0:
            one = (seen[at, 0], seen[at, 1], seen[at, 2], seen[at, 3], seen[at, 4])
            xx, xy, xz, yy, yz, zz, p, q, r = sighted(sign * x, sign * y, sign * z, one, std, least, again)
            weight[0] += xx
            weight[1] += xy
            weight[2] += xz
            weight[3] += yy
            weight[4] += yz
            weight[5] += zz
            pull[0] += sign * p
            pull[1] += sign * q
            pull[2] += sign * r


@compiled
def gather(first: AnyArray, second: AnyArray, own: AnyArray, told: AnyArray, eta: AnyArray, total: AnyArray) -> None:
    """Prior and all messages of each vehicle: information (six numbers) and its pull (three)."""
    for n in range(len(own)):
        for c in range(9):
            total[n, c] = 0.0
        total[n, 0], total[n, 3], total[n, 5] = 1.0 / own[n, 0], 1.0 / own[n, 1], 1.0 / own[n, 2]
    for k in range(len(first)):
        for way, to in enumerate((first[k], second[k])):
            for c in range(6):
                total[to, c] += told[k, way, c]
            for c in range(3):
                total[to, 6 + c] += eta[k, way, c]


@compiled
def believe(
    rounds: int, damping: float, first: AnyArray, second: AnyArray, heard: AnyArray, weight: AnyArray, pull: AnyArray,
    own: AnyArray, total: AnyArray, told: AnyArray, eta: AnyArray,
) -> None:  # fmt: skip
    """The messages (pairs, 2, 6) and (pairs, 2, 3) of belief propagation after some rounds."""
    for k in range(len(first)):
        told[k] = 0.0
        eta[k] = 0.0
    for _ in range(rounds):
        gather(first, second, own, told, eta, total)
        for k in range(len(first)):
            if heard[k]:
                to_first = message(weight[k], pull[k], -1.0, total[second[k]], told[k, 1], eta[k, 1])
                to_second = message(weight[k], pull[k], 1.0, total[first[k]], told[k, 0], eta[k, 0])
                for c in range(6):
                    told[k, 0, c] = damping * told[k, 0, c] + (1.0 - damping) * to_first[c]
                    told[k, 1, c] = damping * told[k, 1, c] + (1.0 - damping) * to_second[c]
                for c in range(3):
                    eta[k, 0, c] = damping * eta[k, 0, c] + (1.0 - damping) * to_first[6 + c]
                    eta[k, 1, c] = damping * eta[k, 1, c] + (1.0 - damping) * to_second[6 + c]


@compiled
def message(w: AnyArray, pull: AnyArray, sign: float, sender: AnyArray, told: AnyArray, eta: AnyArray) -> Any:
    """W (W + Lambda)^-1 Lambda and its pull, with Lambda the sender's belief without what the receiver told it."""
    lxx, lxy, lxz = sender[0] - told[0], sender[1] - told[1], sender[2] - told[2]
    lyy, lyz, lzz = sender[3] - told[3], sender[4] - told[4], sender[5] - told[5]
    a, b, c, d, e, f = inverse3(w[0] + lxx, w[1] + lxy, w[2] + lxz, w[3] + lyy, w[4] + lyz, w[5] + lzz)
    px, py, pz = sign * pull[0], sign * pull[1], sign * pull[2]
    u, v, r = sender[6] - eta[0] - px, sender[7] - eta[1] - py, sender[8] - eta[2] - pz
    ex, ey, ez = times(w, a * u + b * v + c * r, b * u + d * v + e * r, c * u + e * v + f * r)
    xx, xy, xz = times(w, a * lxx + b * lxy + c * lxz, b * lxx + d * lxy + e * lxz, c * lxx + e * lxy + f * lxz)
    yx, yy, yz = times(w, a * lxy + b * lyy + c * lyz, b * lxy + d * lyy + e * lyz, c * lxy + e * lyy + f * lyz)
    zx, zy, zz = times(w, a * lxz + b * lyz + c * lzz, b * lxz + d * lyz + e * lzz, c * lxz + e * lyz + f * lzz)
    return xx, 0.5 * (xy + yx), 0.5 * (xz + zx), yy, 0.5 * (yz + zy), zz, ex + px, ey + py, ez + pz


@compiled
def conclude(total: AnyArray, x: AnyArray, cov: AnyArray) -> None:
    """Beliefs as position and covariance."""
    for n in range(len(x)):
        a, b, c, d, e, f = inverse3(total[n, 0], total[n, 1], total[n, 2], total[n, 3], total[n, 4], total[n, 5])
        p, q, r = total[n, 6], total[n, 7], total[n, 8]
        x[n, 0] += a * p + b * q + c * r
        x[n, 1] += b * p + d * q + e * r
        x[n, 2] += c * p + e * q + f * r
        whole = cov[n]
        whole[0, 0], whole[0, 1], whole[0, 2], whole[1, 0], whole[1, 1] = a, b, c, b, d
        whole[1, 2], whole[2, 0], whole[2, 1], whole[2, 2] = e, c, e, f
