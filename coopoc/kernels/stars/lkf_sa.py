"""The Laplacian Kalman filter of one ego's star in information form, run by run with the three axes side by side.

Memory is that of the joint filter with one number per member and axis; lanes are axes, the last one repeated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import uint64

from ...arrays import AnyArray, Floats
from ..compiling.compile import as_written, inner, inside
from ..compiling.small import load, store
from ..compiling.vectors import LANES, pack
from .elimination import predict
from .joint import LEAST_PROCESS, Joint, block_of, joint_in, joint_size, move, rearrange, solve, stayed
from .messages import (
    MOVED,
    NEW,
    NONE,
    POSITION,
    PROCESS,
    VARIANCE,
    Assumptions,
    Measurements,
    Star,
    clear,
    gather,
    largest,
    star_within,
)
from .relative import vector

ONE = (0.0,)


@as_written
def follow(seen: Measurements, known: Assumptions, ones: bool, reset: bool) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, its variance (R, T, 3) m^2, neighbours (R, M, 3) m.

    Args:
        ones: propagate the covariance with blocks of ones.
        reset: restart all states when a member joins or leaves.
    """
    runs, steps = seen.gnss.shape[:2]
    out = np.empty((runs, steps, 3)), np.empty((runs, steps, 3)), np.empty((runs, seen.relative.shape[1], 3))
    most = largest(seen.start)
    size = joint_size(most, ONE) * LANES + 16 * LANES
    for first in range(0, runs, LANES):
        last, old = min(first + LANES, runs) - 1, NONE
        star, memory = star_within(most), np.zeros((LANES, size))
        for t in range(steps):
            n = gather(star, seen, known, (first, last), t, old)
            for lane in range(last - first + 1):
                joint = joint_in(memory[lane], most, ONE)
                step(star, joint, known, (ones, reset), (n, old), lane)
                write(out, joint, (first + lane, t, seen.start[t]), n)
            old = n
    return out


@inside
def write(out: Any, joint: Joint, at: Any, n: int) -> None:
    """Copy what a step found in one run."""
    (x, variance, others), (run, t, link) = out, at
    for c in range(3):
        x[run, t, c], variance[run, t, c] = joint.state[0, c], -joint.scratch[0, c]
        for k in range(1, n):
            others[run, link + k - 1, c] = joint.state[k, c]


@inside
def axes(memory: AnyArray, at: int, lane: int) -> Any:
    """Three numbers of one run as one number per axis."""
    i, last = uint64(at), uint64(at + 2)
    return pack(memory[i, lane], memory[i + uint64(1), lane], memory[last, lane], memory[last, lane])


@inside
def message(star: Star, k: int, row: int, lane: int) -> Any:
    """A row of member k's last message."""
    return axes(star.motion, 12 * k + 3 * row, lane)


@inside
def edge(star: Star, k: int, lane: int) -> Any:
    """1 if the measurement of member k is complete, else 0, and the measured vector m."""
    at = 8 * k
    complete = star.relative[at + 5, lane] + star.relative[at + 6, lane] + star.relative[at + 7, lane] < np.inf
    x, y, z = vector(
        (
            star.relative[at, lane],
            star.relative[at + 1, lane],
            star.relative[at + 2, lane],
            star.relative[at + 3, lane],
            star.relative[at + 4, lane],
        )
    )
    return 1.0 if complete else 0.0, pack(x, y, z, z)


@inner
def step(star: Star, joint: Joint, known: Assumptions, choice: Any, sizes: Any, lane: int) -> None:
    """Predict and update one run; minus the ego's variance comes first in `scratch`."""
    (ones, reset), (n, old), prior = choice, sizes, (1.0 / known.flat,)
    restart = reset and not stayed(star, n, old)
    predict_state(star, joint, (n, old), restart, lane)
    if restart:
        forget(joint, n, known.flat)
    elif ones and old > 0:
        predict_with_ones(star, joint, n, old, known.flat)
    else:
        predict(joint.information, old, joint.stride, joint.process, joint.scratch, ONE, ONE)
        rearrange(star, joint, n, old, prior, ONE)
    clear(joint.eta)
    for k in range(n):
        new = star.status[5 * k + NEW, lane]
        weight, i = new / message(star, k, VARIANCE, lane), block_of(k, n)
        gap = message(star, k, POSITION, lane) - load(joint.state, k, ONE)[0]
        add_to(joint.information, i * joint.stride + i, weight)
        add_to(joint.eta, i, weight * gap)
    add_laplacian(star, joint, known, restart, n, lane)
    variance = solve(joint.information, joint, joint.eta, n, ONE)
    move(joint, n, ONE)
    if restart:
        forget(joint, n, 1.0)
        variance = (0.0 * variance[0] - 1.0,)
    store(joint.scratch, 0, variance)


@inside
def add_to(memory: AnyArray, at: int, number: Any) -> None:
    """Add to a number in memory."""
    store(memory, at, (load(memory, at, ONE)[0] + number,))


@inside
def forget(joint: Joint, n: int, variance: float) -> None:
    """Diagonal information."""
    for i in range(n):
        for j in range(i, n):
            store(joint.information, i * joint.stride + j, (1.0 / variance if i == j else 0.0,))


@inside
def predict_state(star: Star, joint: Joint, sizes: Any, restart: bool, lane: int) -> None:
    """Move the members that stay; one that joins is where the ego measures it, the ego where its first fix is.

    Fills the inverse process noise in the order of the last star, zero for members that left.
    """
    n, old = sizes
    for k in range(old):
        store(joint.move, k, load(joint.state, k, ONE))
    clear(joint.process)
    for k in range(n):
        place = star.previous[k]
        if place >= 0:
            process = max(message(star, k, PROCESS, lane), LEAST_PROCESS)
            store(joint.process, block_of(place, old), (1.0 / process,))
        if k == 0 and (place < 0 or (restart and star.status[NEW, lane] > 0.0)):
            store(joint.state, k, (message(star, k, POSITION, lane),))
        elif place >= 0 and (k == 0 or not restart):
            store(joint.state, k, (load(joint.move, place, ONE)[0] + message(star, k, MOVED, lane),))
        else:
            store(joint.state, k, (load(joint.state, 0, ONE)[0] + edge(star, k, lane)[1],))


@inner
def predict_with_ones(star: Star, joint: Joint, n: int, old: int, flat: float) -> None:
    """Information (s 1 1^T + Q)^-1 of the members that stay, s = 1^T P 1 over them; W - W 1 1^T W / (1 / s + 1^T W 1)
    with W = Q^-1. It is made in the order of the new star."""
    clear(joint.eta)
    for k in range(n):
        if star.previous[k] >= 0:
            store(joint.eta, block_of(star.previous[k], old), (1.0,))
    solve(joint.information, joint, joint.eta, old, ONE)
    s, w = 0.0 * load(joint.eta, 0, ONE)[0], 0.0 * load(joint.eta, 0, ONE)[0]
    for k in range(n):
        if star.previous[k] >= 0:
            at = block_of(star.previous[k], old)
            s, w = s + load(joint.eta, at, ONE)[0], w + load(joint.process, at, ONE)[0]
    share = 1.0 / (1.0 / s + w)
    for k in range(n):
        for j in range(n):
            i, c = block_of(k, n), block_of(j, n)
            if c < i:
                continue
            value = 0.0 * s
            if star.previous[k] >= 0 and star.previous[j] >= 0:
                a = load(joint.process, block_of(star.previous[k], old), ONE)[0]
                b = load(joint.process, block_of(star.previous[j], old), ONE)[0]
                value = (a if k == j else 0.0 * s) - a * share * b
            elif k == j:
                value = 0.0 * s + 1.0 / flat
            store(joint.information, i * joint.stride + c, (value,))


@inner
def add_laplacian(star: Star, joint: Joint, known: Assumptions, unit: bool, n: int, lane: int) -> None:
    """Add L W L and L W (delta - L x), L the Laplacian of the star of complete measurements: W is 1, or the edges'
    information over the degree."""
    unit = unit or len(known.relative_std) == 0
    count, outer = edge_information(star, known, n, unit, lane)
    if count == 0.0:
        return
    central, stride, e = outer if unit else outer / count, joint.stride, n - 1
    total, ego = 0.0 * load(joint.state, 0, ONE)[0], load(joint.state, 0, ONE)[0]
    for k in range(1, n):
        there, ahead = edge(star, k, lane)
        total = total + there * (ahead - load(joint.state, k, ONE)[0] + ego)
    for k in range(1, n):
        there, ahead = edge(star, k, lane)
        gap = there * (ahead - load(joint.state, k, ONE)[0] + ego)
        add_to(joint.eta, k - 1, outer * gap + there * central * total)
        add_to(joint.information, (k - 1) * stride + k - 1, outer * there)
        add_to(joint.information, (k - 1) * stride + e, -there * (count * central + outer))
        for j in range(k, n):
            add_to(joint.information, (k - 1) * stride + j - 1, central * there * edge(star, j, lane)[0])
    add_to(joint.eta, e, -(count * central + outer) * total)
    add_to(joint.information, e * stride + e, count * count * central + count * outer)


@inside
def edge_information(star: Star, known: Assumptions, n: int, unit: bool, lane: int) -> Any:
    """How many measurements are complete, and the information 1/m^2 of an edge: that of the mean variance per axis of
    the converted vectors, or 1."""
    count, total, std = 0.0, 0.0, known.relative_std
    for k in range(1, n):
        there = edge(star, k, lane)[0]
        count += there
        if not unit:
            d, up = max(star.relative[8 * k, lane], known.min_range), star.relative[8 * k + 3, lane]
            total += there * (std[0] ** 2 + d * d * ((std[1] * up) ** 2 + std[2] ** 2))
    return count, 1.0 if unit or count == 0.0 else 3.0 * count / total
