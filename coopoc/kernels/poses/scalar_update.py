"""Sequential scalar EKF update of the joint pose state, and the rows of compasses, fixes, ranges and angles.

The state of a member is d = 4, 6, 7 or 10 numbers: position m, heading rad and, of six, the odometer's scale error and
the yaw rate's bias rad/s, of seven also what its ranges are too long by, m, of ten also the slow error of its velocity,
m/s. Behind all members stand 0 and what the ranges of pairs are too long by beside that, m. A row is linear in the pose
of one member and those offsets, (a, b, c, h, e), and at most in the pose of another, (-a, -b, -c, g): every measurement
here is one of the vector between the two, or between their tags, and of headings.
"""

from math import atan2, cos, floor, inf, isfinite, isinf, isnan, log, pi, sin
from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import Floats
from ..compiling.compile import inside, part
from ..compiling.small import add, apply, inner_product, less_inner_product, subtract
from ..compiling.vectors import LANES, less, plus, put, take
from ..gate import FIX_GATE, GATE, count, gate_fix, inflation
from ..geometry import Numbers, axes, direction, submatrix
from ..motion import MotionNoise
from ..stars.gaussian import three_rows

HEADING = 3
"""Index of the heading in a member's state."""
OFFSET = 6
"""Index of the offset of its ranges."""
SLOW = 7
"""Index of the error of its velocity forward; those left and up follow."""
ROWS = 4
"""Rows that may be pending, so that one pass over the covariance serves them all."""
MIN_ANGLE_DISTANCE = 1e-3
"""m, least distance at which an angle is linearised."""
Ends = tuple[int, int, int]
"""First number of the member and of the other, number of the offset of the pair, where ranges have one."""
ALONE: Any = np.int64(-1)
ZERO: Any = np.int64(0)
"""Numbers of the type of a variable: a literal would compile a function of ends once more."""
Row = tuple[float, float, float, float, float, float]
Three = tuple[float, float, float]
POSITION_ROWS: tuple[Row, ...] = ((1.0,) + (0.0,) * 5, (0.0, 1.0) + (0.0,) * 4, (0.0, 0.0, 1.0) + (0.0,) * 3)


class PoseNoise(NamedTuple):
    """What a pose filter assumes, and how it filters.

    Attributes:
        fix: three variances, m^2.
        heading: rad^2, of a compass.
        relative: three variances, m^2, rad^2, rad^2.
        odometer: of a velocity, as of the motion of 1 s.
        yaw_rate: rad^2/s^2.
        lasting: stationary variances of scale error, of yaw-rate bias, rad^2/s^2, of the offset of ranges, m^2, and of
            the slow error of a velocity on three axes, m^2/s^2.
        longer: 1 where that offset is a state, else 0.
        keep: share of these but the offset that is left after a step.
        flat: m^2, prior of a member that joins.
        gate: squared normalised innovation beyond which a measurement weighs less.
        d: numbers of a member, 4, 6, 7 or 10.
        passes: of the relative measurements, each linear at the state that the last one found.
        fusion: JOINT, NAIVE or INTERSECTION.
    """

    fix: Three
    heading: float
    relative: Three
    odometer: MotionNoise
    yaw_rate: float
    lasting: tuple[float, float, float, float, float, float]
    longer: float
    keep: float
    flat: float
    gate: float
    d: int = 4
    passes: int = 1
    fusion: int = 0


class Poses(NamedTuple):
    """State of n members of d numbers each and of pairs, filled up to a multiple of LANES, and memory of an update.

    Attributes:
        x: (size,).
        cov: (size, size), to which pending rows have not been applied.
        linear: (size,) state at which relative measurements are linearised.
        prior_x: (size,) before the relative measurements.
        prior_cov: (size, size), zero where these are linear once.
        columns: (ROWS, size) P h of pending rows.
        gains: (ROWS, size) P h / s of these.
        weights: (ROWS,) 1 / s of these.
        hits: (size,) of `coopoc.kernels.gate`: of fixes at a member's first number, of its other rows at the second.
        pace: (3, size) its square (m/s)^2 forward, left and up, at each member's first numbers, the variance of a
            velocity by it, and the velocity in the world.
        totals: (3,) sum of r^2 / s + log s, number of rows that were used, and of those that are pending.
    """

    x: Floats
    cov: Floats
    linear: Floats
    prior_x: Floats
    prior_cov: Floats
    columns: Floats
    gains: Floats
    weights: Floats
    hits: Floats
    pace: Floats
    totals: Floats


COST, USED, PENDING = range(3)


def new_poses(numbers: int) -> Poses:
    """Room for so many numbers."""
    size = -(-numbers // LANES) * LANES
    (x, linear, prior_x, hits), (cov, prior_cov) = np.zeros((4, size)), np.zeros((2, size, size))
    columns, gains = np.zeros((2, ROWS, size))
    weights, pace = np.zeros(ROWS), np.zeros((3, size))
    return Poses(x, cov, linear, prior_x, prior_cov, columns, gains, weights, hits, pace, np.zeros(3))


@part
def update_row(poses: Poses, ends: Ends, row: Row, residual: float, variance: float, gate: float) -> bool:
    """x += P h r / s, P -= P h h^T P / s with s = h^T P h + variance, inflated where r^2 > gate s.

    The covariance follows when ROWS rows are pending, or with `apply_pending_rows`; a row sees those that are pending.

    Args:
        poses: the state.
        ends: of the row.
        row: (a, b, c, h, e, g).
        residual: r, at the state.
        variance: of the measurement.
        gate: on r^2 / s.

    Returns:
        Whether the measurement is used.
    """
    if poses.totals[PENDING] == ROWS:
        apply_pending_rows(poses)
    (k, o, p), (a, b, c, h, e, g), cov, columns = ends, row, poses.cov, poses.columns
    pending, tiles = int(poses.totals[PENDING]), len(poses.x) // LANES
    for tile in range(tiles):
        x, y, z = three_rows(cov, k * tiles + tile, tiles)
        if o >= 0:
            x, y, z = subtract((x, y, z), three_rows(cov, o * tiles + tile, tiles))
        total = plus(plus(plus(h * entries(cov, k + HEADING, tile, tiles), a, x), b, y), c, z)
        if g != 0.0:
            total = plus(total, g, entries(cov, o + HEADING, tile, tiles))
        if e != 0.0:
            total = plus(total, e, entries(cov, k + OFFSET, tile, tiles))
            total = plus(total, e, entries(cov, p, tile, tiles))
        put(columns, uint64(pending * tiles + tile), total)
    for q in range(pending):
        share = along(columns[q], ends, row) * poses.weights[q]
        for tile in range(tiles):
            left = less(entries(columns, pending, tile, tiles), share, entries(columns, q, tile, tiles))
            put(columns, uint64(pending * tiles + tile), left)
    s = variance + along(columns[pending], ends, row)
    square, hits = residual * residual / s, poses.hits[k + 1]
    share = inflation(square, gate, hits)
    if isfinite(gate):
        poses.hits[k + 1] = count(square, gate, hits, 1.0 - variance / s)
    poses.totals[COST] += min(square, gate) + log(s)
    if isinf(share):
        return False
    weight = 1.0 / (s * share)
    for tile in range(tiles):
        column = entries(columns, pending, tile, tiles)
        put(poses.x, uint64(tile), plus(take(poses.x, uint64(tile)), residual * weight, column))
        put(poses.gains, uint64(pending * tiles + tile), weight * column)
    poses.weights[pending] = weight
    poses.totals[USED] += 1.0
    poses.totals[PENDING] += 1.0
    return True


@inside
def entries(rows: Floats, row: int, tile: int, tiles: int) -> Any:
    """LANES numbers of a row of `tiles` times as many."""
    return take(rows, uint64(row * tiles + tile))


@part
def along(column: Floats, ends: Ends, row: Row) -> float:
    """h^T v of a row and a column."""
    (k, o, p), (a, b, c, h, e, g) = ends, row
    total = a * column[k] + b * column[k + 1] + c * column[k + 2] + h * column[k + HEADING]
    if e != 0.0:
        total += e * (column[k + OFFSET] + column[p])
    if o >= 0:
        total += g * column[o + HEADING] - (a * column[o] + b * column[o + 1] + c * column[o + 2])
    return float(total)


@part
def apply_pending_rows(poses: Poses) -> None:
    """Apply the pending rows to the covariance, two of its rows at a time: each column is read half as often."""
    cov, columns, gains = poses.cov, poses.columns, poses.gains
    size, tiles, pending = len(poses.x), len(poses.x) // LANES, int(poses.totals[PENDING])
    if pending == 0:
        return
    for q in range(pending, ROWS):
        for i in range(size):
            gains[q, i] = 0.0
    for i in range(0, size, 2):
        upper = gains[0, i], gains[1, i], gains[2, i], gains[3, i]
        lower = gains[0, i + 1], gains[1, i + 1], gains[2, i + 1], gains[3, i + 1]
        if inner_product(upper, upper) + inner_product(lower, lower) != 0.0:
            for tile in range(tiles):
                rows = *three_rows(columns, tile, tiles), entries(columns, 3, tile, tiles)
                above, below = uint64(i * tiles + tile), uint64((i + 1) * tiles + tile)
                put(cov, above, less_inner_product(take(cov, above), upper, rows))
                put(cov, below, less_inner_product(take(cov, below), lower, rows))
    poses.totals[PENDING] = 0.0


@part
def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return angle - 2.0 * pi * floor((angle + pi) / (2.0 * pi))


@part
def update_heading(poses: Poses, member: int, heading: float, variance: float, gate: float) -> None:
    """A compass heading rad."""
    residual = wrapped(heading - poses.x[member + HEADING])
    update_row(poses, (member, ALONE, ALONE), (0.0, 0.0, 0.0, 1.0, 0.0, 0.0), residual, variance, gate)


@part
def update_fix(poses: Poses, member: int, fix: Floats, variance: Three, gate: float) -> None:
    """A position m, gated as a whole."""
    share, m, cov, hits = 1.0, member, poses.cov, poses.hits
    if isfinite(gate):
        apply_pending_rows(poses)
        gap = fix[0] - poses.x[m], fix[1] - poses.x[m + 1], fix[2] - poses.x[m + 2]
        share, hits[m] = gate_fix(gap, submatrix(cov, m, m), variance, FIX_GATE / GATE * gate, hits[m])
    for axis in range(3 if isfinite(share) else 0):
        residual, noise = fix[axis] - poses.x[m + axis], share * variance[axis]
        update_row(poses, (member, ALONE, ALONE), POSITION_ROWS[axis], residual, noise, inf)


@part
def rotated(tag: Floats, heading: float) -> Three:
    """East, north and up of what is forward, left and up."""
    c, s = cos(heading), sin(heading)
    return c * tag[0] - s * tag[1], s * tag[0] + c * tag[1], tag[2]


@part
def relative_row(
    polar: Numbers, heading: float, tags: tuple[Three, Three], component: int, measured: float, longer: float
) -> tuple[float, Row]:
    """Residual and row of a range (0), a bearing from the observer's heading (1) or an inclination (2).

    Args:
        polar: form of the vector to the other, of a range between tags, at which they are taken.
        heading: of the observer, rad.
        tags: of the observer and the other, m east, north, up.
        component: which of the three.
        measured: m or rad.
        longer: 1 where the offset of ranges is a state, else 0.
    """
    (ray, side, up), d = axes(polar), max(polar[0], MIN_ANGLE_DISTANCE)
    if component == 0:
        (east, north, _), (right, ahead, _), (x, y, z) = *tags, ray
        return measured - d, (-x, -y, -z, x * north - y * east, longer, y * right - x * ahead)
    if component == 1:
        flat = max(d * polar[3], MIN_ANGLE_DISTANCE)
        residual = wrapped(measured - atan2(polar[1], polar[2]) + heading)
        return residual, (-side[0] / flat, -side[1] / flat, 0.0, -1.0, 0.0, 0.0)
    return wrapped(measured - atan2(polar[3], polar[4])), (-up[0] / d, -up[1] / d, -up[2] / d, 0.0, 0.0, 0.0)


@part
def update_relative(
    poses: Poses,
    ends: Ends,
    landmark: Floats,
    measured: Floats,
    noise: PoseNoise,
    left_out: int,
    tags: tuple[Floats, Floats],
) -> int:
    """The components of one relative measurement, linear at `poses.linear`.

    Args:
        poses: the state.
        ends: observer, the other or -1 for a landmark, and the pair.
        landmark: of the landmark, m.
        measured: m, rad, rad, NaN where missing.
        noise: that is assumed.
        left_out: a bit for each component that is left out.
        tags: of the observer and the other, m forward, left, up.

    Returns:
        The bits, and those of the components that are rejected.
    """
    (k, o, p), linear = ends, poses.linear
    position = landmark if o < 0 else linear[o : o + 3]
    x, y, z = position[0] - linear[k], position[1] - linear[k + 1], position[2] - linear[k + 2]
    own, other = rotated(tags[0], linear[k + HEADING]), rotated(tags[1], linear[o + HEADING] if o >= 0 else 0.0)
    between = direction((x + other[0] - own[0], y + other[1] - own[1], z + other[2] - own[2]))
    polar, heading = direction((x, y, z)), linear[k + HEADING]
    curved = curvature(poses.prior_cov, ends, polar)
    for component in range(3):
        if isnan(measured[component]) or left_out & (1 << component):
            continue
        to = polar if component else between
        residual, row = relative_row(to, heading, (own, other), component, measured[component], noise.longer)
        residual -= along(poses.x, ends, row) - along(linear, ends, row)
        if row[HEADING + 1] != 0.0:
            residual -= linear[k + OFFSET] + linear[p]
        if not update_row(poses, ends, row, residual, noise.relative[component] + curved[component], noise.gate):
            left_out |= 1 << component
    return left_out


@part
def curvature(cov: Floats, ends: Ends, polar: Numbers) -> Three:
    """Variances tr(H P H P) / 2 of what is not linear in a range, a bearing and an inclination, of second derivatives
    H, where the vector between both ends errs by P (the second-order filter)."""
    (ray, side, up), d = axes(polar), max(polar[0], MIN_ANGLE_DISTANCE)
    flat, out = max(d * polar[3], MIN_ANGLE_DISTANCE), (polar[2], polar[1], 0.0)
    (k, o, _), steep = ends, d * polar[4] / flat
    p = submatrix(cov, k, k)
    if o >= 0:
        p = subtract(add(p, submatrix(cov, o, o)), add(submatrix(cov, k, o), submatrix(cov, o, k)))
    aside, above = apply(p, side), apply(p, up)
    ss, su, uu = inner_product(side, aside), inner_product(side, above), inner_product(up, above)
    rs, ru, rr = inner_product(ray, aside), inner_product(ray, above), inner_product(ray, apply(p, ray))
    oo, os = inner_product(out, apply(p, out)), inner_product(out, aside)
    return (
        (0.5 * (ss * ss + uu * uu) + su * su) / d**2,
        (oo * ss + os * os) / flat**4,
        (rr * uu + ru * ru - 2.0 * steep * rs * su + 0.5 * steep**2 * ss * ss) / d**4,
    )
