"""Measurement graph of a whole fleet: what is measured and assumed, information of pairs, components.

A vector is a tuple of 3 numbers, a matrix one of 9 (`coopoc.kernels.compiling.small`). A fix, a range or an angle that
is missing (NaN) is no factor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import compiled, part, storage
from ..compiling.small import add, add_diagonal, apply, load, plus_applied, scale, subtract
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


@compiled
def measurement(vector: Vector, measured: Measurement, std: Floats, min_range: float, linear: bool) -> Information:
    """Information J^T J and information vector J^T r of one relative measurement at `vector`.

    J and r belong to the whitened range and angles. One that is `linear` is converted to a vector, with J at the
    measured one.
    """
    unit = len(std) == 0
    a, b, c = (1.0, 1.0, 1.0) if unit else (std[0], std[1], std[2])
    measured_std = with_std(measured, (a * measured[5], b * measured[6], c * measured[7]))
    if not unit and not linear:
        return exact(vector, measured_std, min_range)
    here = completed(measured_std, direction(vector[0], vector[1], vector[2]))
    weight = information(here, measured_std[5:], unit, min_range)
    return weight, apply(weight, subtract(to_vector(here), vector))


@part
def pair(vector: Vector, k: int, pairs: Pairs, relative: Floats, assumed: Assumed, converted: bool) -> Information:
    """`measurement` of a pair's vector x_second - x_first by both of its vehicles, summed."""
    information, eta = MATRIX, VECTOR
    for link, sign in ((pairs.link[k], 1.0), (pairs.link_back[k], -1.0)):
        if link >= 0:
            relative_row = load(relative[link], 0, SEEN)
            weight, pair_eta = measurement(scale(vector, sign), relative_row, assumed.std, assumed.min_range, converted)
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
            relative_row = with_std(load(relative[link], 0, SEEN), assumed.std)
            std = relative_row[5:]
            _, _, factor, _ = gate_components(there, cov, relative_row, std, VECTOR, assumed.min_range)
            here, extra = completed(relative_row, direction(there[0], there[1], there[2])), 0.0
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
