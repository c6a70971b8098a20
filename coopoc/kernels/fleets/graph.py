"""Measurement graph of a whole fleet: each vehicle's own filter, information of pairs, components, delayed fusion.

The methods of `coopoc.methods.whole_fleet` share it. A vector is a tuple of 3 numbers, a matrix one of 9
(`coopoc.kernels.compiling.small`). A fix, a range or an angle that is missing (NaN) is no factor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import compiled, part, storage
from ..compiling.small import add, add_diagonal, apply, load, plus_applied, scale, store, subtract
from ..gate import FIX_GATE, distance, inflation
from ..geometry import Numbers, completed, direction, exact, information, with_std
from ..geometry import vector as to_vector
from ..stars.gated import gate_components

Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
Measurement = tuple[float, ...]
Information = tuple[Numbers, Numbers]
VECTOR: Vector = (0.0, 0.0, 0.0)
MATRIX: Matrix = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Their lengths are the counts that `load` takes."""
SEEN = (0.0,) * 8


class Measured(NamedTuple):
    """What a fleet of N vehicles measured in R runs.

    Attributes:
        gnss: (R, T, N, 3) m, NaN for no fix.
        velocity: (R, T, N, 3) m/s.
        relative: (R, L, 8) `coopoc.kernels.geometry.components`, and factors of their three standard deviations,
            which gates set.
        active: (R, T, N) True from a vehicle's first fix on, while it is present.
        dt: s.
    """

    gnss: Floats
    velocity: Floats
    relative: Floats
    active: Bools
    dt: float


class Pairs(NamedTuple):
    """Vehicles in contact, sorted by step.

    Attributes:
        first: (P,) column, less than `second`.
        second: (P,) column.
        link: (P,) the measurement of `second` by `first`, -1 for none.
        link_back: (P,) the measurement of `first` by `second`, -1 for none.
        start: (T+1,) the pairs of step t are start[t]:start[t+1].
        alive: (R, P) whether the pair takes part.
    """

    first: Ints
    second: Ints
    link: Ints
    link_back: Ints
    start: Ints
    alive: Bools


class Assumed(NamedTuple):
    """The noise model.

    Attributes:
        process: broadcastable to (R, T, N, 3) m^2, variance of the motion.
        fix: broadcastable to (R, T, N, 3) m^2, variance of a fix, infinite for one that is rejected.
        std: (3,) m, rad, rad of a relative measurement; of no length for vectors of unit covariance.
        min_range: m, angles are no more certain than at this range.
        robust: gate relative measurements.
    """

    process: Floats
    fix: Floats
    std: Floats
    min_range: float
    robust: bool


@storage
def at(values: Floats, run: int, t: int, n: int) -> Floats:
    """Row (3,) of an array that is broadcastable to (R, T, N, 3)."""
    row: Floats = values[min(run, values.shape[0] - 1), min(t, values.shape[1] - 1), min(n, values.shape[2] - 1)]
    return row


@part
def correct(x: Floats, cov: Floats, run: int, t: int, n: int, measured: Measured, assumed: Assumed) -> None:
    """One Kalman step of vehicle n alone, in place: x += dt u, P += Q, then one update per axis that was measured.

    Args:
        x: (3 N) m.
        cov: (9 N) m^2.
        run: of the measurements.
        t: step.
        n: column.
        measured: what the fleet measured.
        assumed: the noise model.
    """
    u, z, a, b = measured.velocity[run, t, n], measured.gnss[run, t, n], 3 * n, 9 * n
    q, r = at(assumed.process, run, t, n), at(assumed.fix, run, t, n)
    for c in range(3):
        x[a + c] += measured.dt * u[c]
        cov[b + 4 * c] += q[c]
    for c in range(3):
        if not math.isnan(z[c]):
            row, innovation = load(cov, 3 * n + c, VECTOR), z[c] - x[a + c]
            total = row[c] + r[c]
            for i in range(3):
                gain = row[i] / total
                x[a + i] += gain * innovation
                for j in range(3):
                    cov[b + 3 * i + j] -= gain * row[j]


@part
def begin_at_fix(x: Floats, cov: Floats, run: int, t: int, n: int, measured: Measured, assumed: Assumed) -> None:
    """Vehicle n stands at its fix, with the covariance of that."""
    r = at(assumed.fix, run, t, n)
    store(cov, n, MATRIX)
    for c in range(3):
        x[3 * n + c], cov[9 * n + 4 * c] = measured.gnss[run, t, n, c], r[c]


@compiled
def measurement(vector: Vector, measured: Measurement, std: Floats, min_range: float, linear: bool) -> Information:
    """Information J^T J and information vector J^T r of one relative measurement at `vector`.

    J and r belong to the whitened range and angles. One that is `linear` is converted to a vector, with J at the
    measured one.
    """
    unit = len(std) == 0
    a, b, c = (1.0, 1.0, 1.0) if unit else (std[0], std[1], std[2])
    seen = with_std(measured, (a * measured[5], b * measured[6], c * measured[7]))
    if not unit and not linear:
        return exact(vector, seen, min_range)
    here = completed(seen, direction(vector[0], vector[1], vector[2]))
    weight = information(here, seen[5:], unit, min_range)
    return weight, apply(weight, subtract(to_vector(here), vector))


@part
def pair(vector: Vector, k: int, pairs: Pairs, relative: Floats, assumed: Assumed, converted: bool) -> Information:
    """`measurement` of a pair's vector x_second - x_first by both of its vehicles, summed."""
    information, eta = MATRIX, VECTOR
    for link, sign in ((pairs.link[k], 1.0), (pairs.link_back[k], -1.0)):
        if link >= 0:
            seen = load(relative[link], 0, SEEN)
            weight, pair_eta = measurement(scale(vector, sign), seen, assumed.std, assumed.min_range, converted)
            information, eta = add(information, weight), add(eta, scale(pair_eta, sign))
    return information, eta


@part
def gate_pair(vector: Vector, cov: Matrix, k: int, pairs: Pairs, relative: Floats, assumed: Assumed) -> None:
    """Factors of the standard deviations of what a pair measured, at its vector, of covariance `cov`.

    Each number is gated alone, and all of them as a vector: false fixes of either vehicle displace the believed one.
    """
    for link, sign in ((pairs.link[k], 1.0), (pairs.link_back[k], -1.0)):
        if link >= 0:
            there = scale(vector, sign)
            seen = with_std(load(relative[link], 0, SEEN), assumed.std)
            std = seen[5:]
            _, _, factor, _ = gate_components(there, cov, seen, std, VECTOR, assumed.min_range)
            here, extra = completed(seen, direction(there[0], there[1], there[2])), 0.0
            for c in range(3):
                own = std[c] if c == 0 else std[c] * max(here[0], assumed.min_range)
                extra += own * own if own < math.inf else 0.0
            gap = subtract(to_vector(here), there)
            whole = inflation(distance(gap, add_diagonal(cov, (extra, extra, extra))), FIX_GATE, 0.0)
            for c in range(3):
                relative[link, 5 + c] = factor[c] * math.sqrt(whole)


@part
def pair_at_agreement(
    vector: Vector, cov: Matrix, k: int, pairs: Pairs, relative: Floats, assumed: Assumed
) -> Information:
    """`pair`, linear where the believed vector and the converted measurements agree; eta refers to `vector`.

    They agree at v + (I + C W)^-1 C eta, C the covariance of the believed vector v. A good belief decides alone: then
    the weight does not depend on the noise, as it does at the measured geometry. A poor one is ignored.
    """
    information, eta = pair(vector, k, pairs, relative, assumed, True)
    if len(assumed.std) == 0:
        return information, eta
    shift = agreement(cov, information, eta)
    information, eta = pair(add(vector, shift), k, pairs, relative, assumed, False)
    return information, plus_applied(eta, information, shift)


@part
def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@part
def dot(a: Numbers, b: Numbers) -> float:
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@part
def agreement(cov: Matrix, w: Numbers, eta: Numbers) -> Vector:
    """(I + C W)^-1 C eta by Cramer's rule, and once more for the residual: W may be next to singular."""
    a, b, c = apply(cov, (w[0], w[1], w[2])), apply(cov, (w[3], w[4], w[5])), apply(cov, (w[6], w[7], w[8]))
    a, b, c = (a[0] + 1.0, a[1], a[2]), (b[0], b[1] + 1.0, b[2]), (c[0], c[1], c[2] + 1.0)
    p, q, r = cross(b, c), cross(c, a), cross(a, b)
    determinant, right, x = dot(a, p), apply(cov, eta), VECTOR
    for _ in range(2):
        rest = subtract(right, add(add(scale(a, x[0]), scale(b, x[1])), scale(c, x[2])))
        x = add(x, (dot(p, rest) / determinant, dot(q, rest) / determinant, dot(r, rest) / determinant))
    return x


@part
def connect(label: Ints, first: int, second: int) -> None:
    """Merge the connected components of two vehicles, of which label (N,) is the number."""
    old = label[second]
    for n in range(len(label)):
        if label[n] == old:
            label[n] = label[first]


@compiled
def latest_available(pairs: Pairs, arrival: Ints, vehicles: int) -> Ints:
    """(R, T, N) latest step whose result is available to a vehicle at each step, -1 for none.

    A result is available when those of all vehicles that contribute to it are, and the messages between them have
    arrived: of the vehicles in contact, of those in contact with these, and so on.

    Args:
        pairs: whose `alive` is not read.
        arrival: (R, P) step at which a pair's messages have arrived, -1 if it takes no part.
        vehicles: N.
    """
    runs, steps = len(arrival), len(pairs.start) - 1
    latest = np.full((runs, steps, vehicles), -1)
    for run in range(runs):
        ready = np.zeros(vehicles, np.int64)
        for t in range(steps):
            ready = np.maximum(ready, t)
            changed = True
            while changed:
                changed = False
                for k in range(pairs.start[t], pairs.start[t + 1]):
                    i, j = pairs.first[k], pairs.second[k]
                    if arrival[run, k] >= 0:
                        late = max(arrival[run, k], ready[i], ready[j])
                        changed = changed or ready[i] < late or ready[j] < late
                        ready[i] = ready[j] = late
            for n in range(vehicles):
                if ready[n] < steps:
                    latest[run, ready[n], n] = t
        for t in range(1, steps):
            latest[run, t] = np.maximum(latest[run, t], latest[run, t - 1])
    return latest


@compiled
def fuse_delayed(latest: Ints, x: Floats, cov: Floats, measured: Measured, assumed: Assumed) -> tuple[Floats, Floats]:
    """Delayed fusion: the latest result available to each vehicle, and its own filter since that step.

    Without a result the vehicle's own filter runs from its first fix: own measurements are never late.

    Args:
        latest: (R, T, N) as `latest_available` returns.
        x: (R, T, 3 N) m, the result of each step.
        cov: (R, T, 9 N) m^2.
        measured: what these vehicles measured; they are present throughout.
        assumed: the noise model.

    Returns:
        Positions (R, T, 3 N) m and covariances (R, T, 9 N) m^2.
    """
    now, covariance = np.empty_like(x), np.zeros_like(cov)
    for run in range(x.shape[0]):
        for t in range(x.shape[1]):
            for n in range(latest.shape[2]):
                step, last = latest[run, t, n], t - 1
                if step < 0 and t == 0:
                    begin_at_fix(now[run, 0], covariance[run, 0], run, 0, n, measured, assumed)
                    continue
                if step >= 0 and (t == 0 or step > latest[run, t - 1, n]):
                    last = step
                    store(now[run, t], n, load(x[run, step], n, VECTOR))
                    store(covariance[run, t], n, load(cov[run, step], n, MATRIX))
                else:
                    store(now[run, t], n, load(now[run, t - 1], n, VECTOR))
                    store(covariance[run, t], n, load(covariance[run, t - 1], n, MATRIX))
                for u in range(last + 1, t + 1):
                    correct(now[run, t], covariance[run, t], run, u, n, measured, assumed)
    return now, covariance
