"""What the messages of one ego's star say at a step, in one run.

The arguments of all kernels of a star travel in plain tuples, which numba's cache can name:

    measured: gnss, velocity (R, T, N, 3) m, m/s; seen (R, M, 5) of `unfolded`; neighbour (M,); start (T+1,); newest and
        fresh (R, M), of the ego's inbox; ego; dt s.
    assumed: variance of the motion and of a fix, broadcastable to (R, T, N, 3) m^2; std (3,) m, rad, rad, of no length
        for unit matrices; least range m; variance of who joins m^2; acceleration m/s^2; pace (3,), `Knowledge.pace`,
        from which the variance of the motion is made instead, or of no length.
"""

from __future__ import annotations

import math
from typing import Any

from numpy import uint64

from ..arrays import AnyArray
from .compile import as_written, inside

LEAST_PROCESS = 1e-90
"""m^2; the cube of its inverse is still a number, and far beyond any digit that counts."""


@as_written
def hear(measured: Any, assumed: Any, run: int, t: int, who: AnyArray, was: AnyArray, motion: AnyArray) -> None:
    """Who is in the star, in `who`: column, step of the message held, uses of it, place in the last star; what their
    messages say, in `motion`: moved m, its variance m^2, innovation-free fix m, and the weight of that 1/m^2."""
    neighbour, start, newest, fresh, ego = measured[3:8]
    for k in range(who.shape[1]):
        link = start[t] + k - 1
        member, sent = (ego, t) if k == 0 else (neighbour[link], newest[run, link])
        place = place_of(member, was)
        again = place >= 0 and was[1, place] == sent
        who[0, k], who[1, k], who[2, k], who[3, k] = member, sent, was[2, place] + 1 if again else 1, place
        heard = k == 0 or fresh[run, link]
        said = says(measured, assumed, run, t, member, sent, who[2, k], heard)
        for i in range(4):
            motion[i, k, 0], motion[i, k, 1], motion[i, k, 2] = said[i]


@as_written
def place_of(member: int, was: AnyArray) -> int:
    """Where the member stood in the last star, -1 for nowhere."""
    place = -1
    for i in range(was.shape[1]):
        if was[0, i] == member:
            place = i
    return place


@as_written
def says(measured: Any, assumed: Any, run: int, t: int, member: int, sent: int, uses: int, heard: bool) -> Any:
    """A message sent at a step, -1 for none: moved, its variance, fix and the weight of the fix, three numbers each."""
    gnss, velocity, dt = measured[0], measured[1], measured[8]
    forgotten, acceleration = assumed[4], assumed[5]
    at = sent if sent >= 0 else t
    age = t - at
    i, j, k = uint64(run), uint64(at), uint64(member)
    x, y, z = three_of(gnss, i, j, k)
    u, v, w = three_of(velocity, i, j, k)
    p, q, r = process_of(assumed[0], assumed[6], (u, v, w), dt, i, j, k)
    a, b, c = three_of(assumed[1], i, j, k)
    u, v, w = (dt * u, dt * v, dt * w) if sent >= 0 else (0.0, 0.0, 0.0)
    if age > 0:
        late = dt * dt * age * acceleration
        p, q, r = p + late * late, q + late * late, r + late * late
        x, y, z = x + age * u, y + age * v, z + age * w
        a, b, c = a + age * age * p, b + age * age * q, c + age * age * r
    often = 2.0 * uses - 1.0
    spread = (often * p, often * q, often * r) if sent >= 0 else (forgotten, forgotten, forgotten)
    return (u, v, w), spread, (x, y, z), (1.0 / a, 1.0 / b, 1.0 / c) if heard else (0.0, 0.0, 0.0)


@inside
def process_of(variance: AnyArray, pace: AnyArray, velocity: Any, dt: float, run: Any, t: Any, member: Any) -> Any:
    """Variance of the motion m^2: made from the measured velocity, or looked up."""
    if len(pace) == 0:
        return three_of(variance, run, t, member)
    return paced(pace, velocity[0], velocity[1], velocity[2], dt)


@inside
def paced(pace: AnyArray, u: Any, v: Any, w: Any, dt: float) -> Any:
    """Variance m^2 of the motion at a measured velocity, of numbers or of vectors."""
    a, b, c = abs(u), abs(v), abs(w)
    if pace[2] > 0.0:
        a = b = c = math.sqrt(u * u + v * v + w * w)
    a, b, c = dt * max(pace[0] * a, pace[1]), dt * max(pace[0] * b, pace[1]), dt * max(pace[0] * c, pace[1])
    return a * a, b * b, c * c


@inside
def three_of(values: AnyArray, run: Any, t: Any, member: Any) -> Any:
    """Three of what is broadcastable to (R, T, N, 3)."""
    one = uint64(1)
    i, j = min(run, uint64(values.shape[0]) - one), min(t, uint64(values.shape[1]) - one)
    k = min(member, uint64(values.shape[2]) - one)
    return values[i, j, k, uint64(0)], values[i, j, k, one], values[i, j, k, uint64(2)]
