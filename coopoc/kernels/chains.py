"""A neighbour's points in a window, a chain of motion that meets the ego's points only: eliminate it onto these.

Arrays are those of `coopoc.kernels.window`. The ego's matrix (3h, 3h), which remains, is eliminated from the oldest
point on, so that its last block ends as the covariance of the newest.
"""

from __future__ import annotations

from ..arrays import AnyArray
from .blocks import inverse3
from .compile import compiled
from .roster import FIX, MOVED, PROCESS

LEAST_PROCESS = 1e-90
"""m^2; the cube of its inverse is still a number, and far beyond any digit that counts."""


@compiled
def fold(
    said: AnyArray, weight: AnyArray, edge: AnyArray, point: AnyArray, later: AnyArray, first: int, step: int,
    last: int, k: int, arms: AnyArray, pivots: AnyArray, a: AnyArray, b: AnyArray,
) -> None:  # fmt: skip
    """Eliminate the chain that begins at place k of a step onto the ego's points.

    With S the information of a point without the motion that leaves it, of information Q, the next one inherits
    (S^-1 + Q^-1)^-1 = Q - Q (S + Q)^-1 Q, arms and pulls times Q (S + Q)^-1. Kept per point: the arms (3, 3h) to the
    ego's, and in `pivots` (S + Q)^-1 and the pull.
    """
    length, begin = len(point), 3 * (step - first)
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    fx, fy, fz = 0.0, 0.0, 0.0
    while True:
        slot = step % length
        e, w, arm = edge[slot, k], weight[slot, k], arms[slot, k]
        end = 3 * (step - first)
        xx, xy, xz = xx + e[0] + w[0], xy + e[1], xz + e[2]
        yy, yz, zz = yy + e[3] + w[1], yz + e[4], zz + e[5] + w[2]
        fx += e[6] + w[0] * (said[slot, FIX, k, 0] - point[slot, k, 0])
        fy += e[7] + w[1] * (said[slot, FIX, k, 1] - point[slot, k, 1])
        fz += e[8] + w[2] * (said[slot, FIX, k, 2] - point[slot, k, 2])
        arm[0, end], arm[0, end + 1], arm[0, end + 2] = -e[0], -e[1], -e[2]
        arm[1, end], arm[1, end + 1], arm[1, end + 2] = -e[1], -e[3], -e[4]
        arm[2, end], arm[2, end + 1], arm[2, end + 2] = -e[2], -e[4], -e[5]
        for j in range(begin):
            arm[0, j], arm[1, j], arm[2, j] = 0.0, 0.0, 0.0
        goes = later[slot, k] if step < last else -1
        qx, qy, qz, gx, gy, gz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if goes >= 0:
            then = (step + 1) % length
            px, py, pz = said[then, PROCESS, goes]
            qx, qy, qz = 1.0 / max(px, LEAST_PROCESS), 1.0 / max(py, LEAST_PROCESS), 1.0 / max(pz, LEAST_PROCESS)
            gx = qx * (said[then, MOVED, goes, 0] - point[then, goes, 0] + point[slot, k, 0])
            gy = qy * (said[then, MOVED, goes, 1] - point[then, goes, 1] + point[slot, k, 1])
            gz = qz * (said[then, MOVED, goes, 2] - point[then, goes, 2] + point[slot, k, 2])
        ux, uy, uz = fx - gx, fy - gy, fz - gz
        ixx, ixy, ixz, iyy, iyz, izz = inverse3(xx + qx, xy, xz, yy + qy, yz, zz + qz)
        p = pivots[slot, k]
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8] = ixx, ixy, ixz, iyy, iyz, izz, ux, uy, uz
        vx, vy, vz = ixx * ux + ixy * uy + ixz * uz, ixy * ux + iyy * uy + iyz * uz, ixz * ux + iyz * uy + izz * uz
        for i in range(begin, end + 3):
            one, two, three = arm[0, i], arm[1, i], arm[2, i]
            b[i] -= one * vx + two * vy + three * vz
            jx, jy, jz = (
                ixx * one + ixy * two + ixz * three, ixy * one + iyy * two + iyz * three,
                ixz * one + iyz * two + izz * three,
            )  # fmt: skip
            for j in range(i, end + 3):
                a[i, j] -= jx * arm[0, j] + jy * arm[1, j] + jz * arm[2, j]
            if goes >= 0:
                on = arms[(step + 1) % length, goes]
                on[0, i], on[1, i], on[2, i] = qx * jx, qy * jy, qz * jz
        if goes < 0:
            return
        sxx, sxy, sxz, syy, syz, szz = inverse3(xx, xy, xz, yy, yz, zz)
        xx, xy, xz, yy, yz, zz = inverse3(sxx + 1.0 / qx, sxy, sxz, syy + 1.0 / qy, syz, szz + 1.0 / qz)
        fx, fy, fz = gx + qx * vx, gy + qy * vy, gz + qz * vz
        step, k = step + 1, goes


@compiled
def unfold(
    said: AnyArray, point: AnyArray, later: AnyArray, first: int, step: int, k: int, arms: AnyArray, pivots: AnyArray,
    b: AnyArray,
) -> float:  # fmt: skip
    """Move one point of a chain, the next one's being known, and the ego's `b`; its largest move m.

    The move itself is left in the place of the pull, for the point before it.
    """
    arm, p = arms[step % len(point), k], pivots[step % len(point), k]
    x, y, z = p[6], p[7], p[8]
    for j in range(3 * (step - first + 1)):
        x -= arm[0, j] * b[j]
        y -= arm[1, j] * b[j]
        z -= arm[2, j] * b[j]
    goes = later[step % len(point), k]
    if goes >= 0:
        slot = (step + 1) % len(point)
        x += pivots[slot, goes, 6] / max(said[slot, PROCESS, goes, 0], LEAST_PROCESS)
        y += pivots[slot, goes, 7] / max(said[slot, PROCESS, goes, 1], LEAST_PROCESS)
        z += pivots[slot, goes, 8] / max(said[slot, PROCESS, goes, 2], LEAST_PROCESS)
    p[6], p[7], p[8] = (
        p[0] * x + p[1] * y + p[2] * z, p[1] * x + p[3] * y + p[4] * z, p[2] * x + p[4] * y + p[5] * z
    )  # fmt: skip
    for c in range(3):
        point[step % len(point), k, c] += p[6 + c]
    return float(max(abs(p[6]), abs(p[7]), abs(p[8])))


@compiled
def dissolve(a: AnyArray, b: AnyArray, n: int, cov: AnyArray) -> None:
    """Solution in place of `b` with the symmetric `a` (n, n), used up, and the last block (3, 3) of its inverse."""
    for k in range(n - 3):
        inverse = 1.0 / a[k, k]
        for i in range(k + 1, n):
            ratio = a[k, i] * inverse
            for j in range(i, n):
                a[i, j] -= ratio * a[k, j]
            b[i] -= ratio * b[k]
    k = n - 3
    xx, xy, xz, yy, yz, zz = inverse3(a[k, k], a[k, k + 1], a[k, k + 2], a[k + 1, k + 1], a[k + 1, k + 2],
                                      a[k + 2, k + 2])  # fmt: skip
    cov[0, 0], cov[0, 1], cov[0, 2], cov[1, 0], cov[1, 1] = xx, xy, xz, xy, yy
    cov[1, 2], cov[2, 0], cov[2, 1], cov[2, 2] = yz, xz, yz, zz
    x, y, z = b[k], b[k + 1], b[k + 2]
    b[k], b[k + 1], b[k + 2] = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
    for i in range(k - 1, -1, -1):
        total = b[i]
        for j in range(i + 1, n):
            total -= a[i, j] * b[j]
        b[i] = total / a[i, i]
