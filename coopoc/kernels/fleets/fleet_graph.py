"""The measured graph of a whole fleet: arguments by name, each vehicle's own filter, and the information of a pair.

The methods of `coopoc.methods.whole_fleet` share it. A vector is a tuple of 3 numbers, a matrix one of 9
(`coopoc.kernels.compiling.small`). A fix, a range or an angle that is missing (NaN) is no factor.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ...arrays import AnyArray
from ..compiling.compile import compiled, part, storage
from ..compiling.small import add, apply, from_upper, load, plus_applied, scale, store, subtract
from ..stars.relative import at_measurement, completed, exact

VECTOR, MATRIX = (0.0,) * 3, (0.0,) * 9
"""Their lengths are the counts that `load` takes."""
UNIT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Measured(NamedTuple):
    """What a fleet of N vehicles measured in R runs.

    Attributes:
        gnss: (R, T, N, 3) m, NaN for no fix.
        velocity: (R, T, N, 3) m/s.
        relative: (R, L, 5) of `coopoc.kernels.stars.relative.components`.
        active: (R, T, N) True from a vehicle's first fix on, while it is present.
        dt: s.
    """

    gnss: AnyArray
    velocity: AnyArray
    relative: AnyArray
    active: AnyArray
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

    first: AnyArray
    second: AnyArray
    link: AnyArray
    link_back: AnyArray
    start: AnyArray
    alive: AnyArray


class Assumed(NamedTuple):
    """The noise model.

    Attributes:
        process: broadcastable to (R, T, N, 3) m^2, variance of the motion.
        fix: broadcastable to (R, T, N, 3) m^2, variance of a fix.
        std: (3,) m, rad, rad of a relative measurement; of no length for vectors of unit covariance.
        min_range: m, angles are no more certain than at this range.
    """

    process: AnyArray
    fix: AnyArray
    std: AnyArray
    min_range: float


@storage
def at(values: AnyArray, run: int, t: int, n: int) -> Any:
    """Row (3,) of an array that is broadcastable to (R, T, N, 3)."""
    return values[min(run, values.shape[0] - 1), min(t, values.shape[1] - 1), min(n, values.shape[2] - 1)]


@part
def correct(x: AnyArray, cov: AnyArray, run: int, t: int, n: int, measured: Measured, assumed: Assumed) -> None:
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
def begin_at_fix(x: AnyArray, cov: AnyArray, run: int, t: int, n: int, measured: Measured, assumed: Assumed) -> None:
    """Vehicle n stands at its fix, with the covariance of that."""
    r = at(assumed.fix, run, t, n)
    store(cov, n, MATRIX)
    for c in range(3):
        x[3 * n + c], cov[9 * n + 4 * c] = measured.gnss[run, t, n, c], r[c]


@part
def advance(run: int, t: int, x: AnyArray, own: AnyArray, measured: Measured, assumed: Assumed) -> None:
    """Positions x[t] (3 N) m and covariances own (9 N) m^2 of each vehicle from its own sensors; NaN m if inactive."""
    for n in range(measured.active.shape[2]):
        if not measured.active[run, t, n]:
            store(x[t], n, (math.nan, math.nan, math.nan))
        elif t > 0 and measured.active[run, t - 1, n]:
            store(x[t], n, load(x[t - 1], n, VECTOR))
            correct(x[t], own, run, t, n, measured, assumed)
        else:
            begin_at_fix(x[t], own, run, t, n, measured, assumed)


@compiled
def copy(source: AnyArray, target: AnyArray, count: int) -> None:
    """The first numbers of a flat array: a slice would compile the text of its errors as well."""
    for k in range(count):
        target[k] = source[k]


@part
def most_pairs(pairs: Pairs) -> int:
    """At one step."""
    most = 0
    for t in range(len(pairs.start) - 1):
        most = max(most, pairs.start[t + 1] - pairs.start[t])
    return most


@part
def filled(seen: Any, vector: Any, std: Any) -> Any:
    """A missing range or angle is that of `vector`, with infinite standard deviation."""
    a, b, c = std
    a = math.inf if seen[0] < 0.0 else a
    b = math.inf if seen[1] == 0.0 and seen[2] == 0.0 else b
    c = math.inf if seen[3] == 0.0 and seen[4] == 0.0 else c
    if a + b + c == math.inf:
        seen = completed((seen[0], seen[1], seen[2], seen[3], seen[4], a, b, c), vector)
    return seen, (a, b, c)


@compiled
def measurement(vector: Any, seen: Any, std: AnyArray, min_range: float, converted: bool) -> Any:
    """Information J^T J and information vector J^T r of one relative measurement at `vector`.

    J and r belong to the whitened range and angles. A converted measurement is linear in the vector, with J at the
    measured one.
    """
    unit = len(std) == 0
    here, noise = filled(seen, vector, (1.0, 1.0, 1.0) if unit else (std[0], std[1], std[2]))
    d, ground = here[0], here[0] * here[3]
    if not unit and not converted:
        xx, xy, xz, yy, yz, zz, p, q, r = exact(vector[0], vector[1], vector[2], here, noise, min_range)
        return from_upper((xx, xy, xz, yy, yz, zz)), (p, q, r)
    information = UNIT
    if not unit:
        information = from_upper(at_measurement(here, noise, min_range))
    elif noise[0] + noise[1] + noise[2] == math.inf:
        information = from_upper(at_measurement(here, (noise[0], noise[1] / max(ground, 1e-9), noise[2] / d), 0.0))
    return information, apply(information, subtract((ground * here[2], ground * here[1], d * here[4]), vector))


@part
def pair(vector: Any, k: int, pairs: Pairs, relative: AnyArray, assumed: Assumed, converted: bool) -> Any:
    """`measurement` of a pair's vector x_second - x_first by both of its vehicles, summed."""
    information, eta = MATRIX, VECTOR
    for link, sign in ((pairs.link[k], 1.0), (pairs.link_back[k], -1.0)):
        if link >= 0:
            seen = load(relative[link], 0, (0.0, 0.0, 0.0, 0.0, 0.0))
            more, one = measurement(scale(vector, sign), seen, assumed.std, assumed.min_range, converted)
            information, eta = add(information, more), add(eta, scale(one, sign))
    return information, eta


@part
def pair_at_agreement(vector: Any, cov: Any, k: int, pairs: Pairs, relative: AnyArray, assumed: Assumed) -> Any:
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
def cross(a: Any, b: Any) -> Any:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@part
def dot(a: Any, b: Any) -> float:
    """a . b."""
    product: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


@part
def agreement(cov: Any, information: Any, eta: Any) -> Any:
    """(I + C W)^-1 C eta by Cramer's rule, and once more for the residual: W may be next to singular."""
    w = information
    a, b, c = apply(cov, (w[0], w[1], w[2])), apply(cov, (w[3], w[4], w[5])), apply(cov, (w[6], w[7], w[8]))
    a, b, c = (a[0] + 1.0, a[1], a[2]), (b[0], b[1] + 1.0, b[2]), (c[0], c[1], c[2] + 1.0)
    p, q, r = cross(b, c), cross(c, a), cross(a, b)
    each, right, x = 1.0 / dot(a, p), apply(cov, eta), VECTOR
    for _ in range(2):
        rest = subtract(right, add(add(scale(a, x[0]), scale(b, x[1])), scale(c, x[2])))
        x = add(x, (each * dot(p, rest), each * dot(q, rest), each * dot(r, rest)))
    return x
