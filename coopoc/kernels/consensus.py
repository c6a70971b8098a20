"""One step of consensus ADMM over a fleet: the methods of `coopoc.methods.admm`, arrays of `coopoc.kernels.gossip`."""

from __future__ import annotations

from typing import Any

from ..arrays import AnyArray
from .blocks import inverse3
from .compile import compiled


@compiled
def times(a: AnyArray, x: float, y: float, z: float) -> Any:
    """Symmetric (3, 3) as six numbers, times a vector."""
    return a[0] * x + a[1] * y + a[2] * z, a[1] * x + a[3] * y + a[4] * z, a[2] * x + a[4] * y + a[5] * z


@compiled
def consent(
    rounds: int, rho: float, first: AnyArray, second: AnyArray, heard: AnyArray, weight: AnyArray, pull: AnyArray,
    own: AnyArray, outer: AnyArray, z: AnyArray, inner: AnyArray, duals: AnyArray, x: AnyArray,
) -> None:  # fmt: skip
    """Add to x (N, 3) what the rounds of ADMM agree upon.

    Args:
        outer: (N, 9) scratch: the inverse that a vehicle solves with, the holders of it. z: (N, 9): mean, own dual, own
            copy. inner: (pairs, 2, 6), (half + rho)^-1 in the first. duals: (pairs, 2, 6): duals and copies of the two.
    """
    for n in range(len(x)):
        outer[n, 0], outer[n, 3], outer[n, 5] = 1.0 / own[n, 0] + rho, 1.0 / own[n, 1] + rho, 1.0 / own[n, 2] + rho
        outer[n, 1], outer[n, 2], outer[n, 4], outer[n, 6] = 0.0, 0.0, 0.0, 1.0
        z[n] = 0.0
    for k in range(len(first)):
        duals[k] = 0.0
        if heard[k]:
            w, g = weight[k], inner[k, 0]
            for c in range(6):
                w[c] *= 0.5
            for c in range(3):
                pull[k, c] *= 0.5
            g[0], g[1], g[2], g[3], g[4], g[5] = inverse3(w[0] + rho, w[1], w[2], w[3] + rho, w[4], w[5] + rho)
            xx, xy, xz = times(g, w[0], w[1], w[2])
            _, yy, yz = times(g, w[1], w[3], w[4])
            _, _, zz = times(g, w[2], w[4], w[5])
            for n in (first[k], second[k]):
                for c, value in enumerate((xx, xy, xz, yy, yz, zz)):
                    outer[n, c] += rho * value
                outer[n, 6] += 1.0
    for n in range(len(x)):
        o = outer[n]
        o[0], o[1], o[2], o[3], o[4], o[5] = inverse3(o[0], o[1], o[2], o[3], o[4], o[5])
    for _ in range(rounds):
        _solve(rho, first, second, heard, weight, pull, outer, z, inner, duals)
        _agree(first, second, heard, outer, z, duals)
    for n in range(len(x)):
        for c in range(3):
            x[n, c] += z[n, c]


@compiled
def _solve(
    rho: float, first: AnyArray, second: AnyArray, heard: AnyArray, weight: AnyArray, pull: AnyArray, outer: AnyArray,
    z: AnyArray, inner: AnyArray, duals: AnyArray,
) -> None:  # fmt: skip
    """Each vehicle's copies of itself and of those that it hears."""
    for n in range(len(z)):
        for c in range(3):
            z[n, 6 + c] = z[n, c] - z[n, 3 + c]
    for k in range(len(first)):
        for way, sign in ((0, 1.0), (1, -1.0)):
            if heard[k]:
                holder, of = (first[k], second[k]) if way == 0 else (second[k], first[k])
                p, q, r = times(weight[k], *_wish(z, of, duals[k, way]))
                p, q, r = times(inner[k, 0], p - sign * pull[k, 0], q - sign * pull[k, 1], r - sign * pull[k, 2])
                z[holder, 6] += p
                z[holder, 7] += q
                z[holder, 8] += r
    for n in range(len(z)):
        p, q, r = times(outer[n], z[n, 6], z[n, 7], z[n, 8])
        z[n, 6], z[n, 7], z[n, 8] = rho * p, rho * q, rho * r
    for k in range(len(first)):
        for way, sign in ((0, 1.0), (1, -1.0)):
            if heard[k]:
                holder, of = (first[k], second[k]) if way == 0 else (second[k], first[k])
                one = duals[k, way]
                a, b, c = _wish(z, of, one)
                p, q, r = times(weight[k], z[holder, 6], z[holder, 7], z[holder, 8])
                one[3], one[4], one[5] = times(
                    inner[k, 0], p + sign * pull[k, 0] + rho * a, q + sign * pull[k, 1] + rho * b,
                    r + sign * pull[k, 2] + rho * c,
                )  # fmt: skip


@compiled
def _wish(z: AnyArray, of: int, one: AnyArray) -> Any:
    """The mean less a copy's dual."""
    return z[of, 0] - one[0], z[of, 1] - one[1], z[of, 2] - one[2]


@compiled
def _agree(
    first: AnyArray, second: AnyArray, heard: AnyArray, outer: AnyArray, z: AnyArray, duals: AnyArray
) -> None:  # fmt: skip
    """The new means of all copies, and the duals of what is left between them."""
    for n in range(len(z)):
        for c in range(3):
            z[n, c] = z[n, 6 + c] + z[n, 3 + c]
    for k in range(len(first)):
        if heard[k]:
            for c in range(3):
                z[second[k], c] += duals[k, 0, 3 + c] + duals[k, 0, c]
                z[first[k], c] += duals[k, 1, 3 + c] + duals[k, 1, c]
    for n in range(len(z)):
        for c in range(3):
            z[n, c] /= outer[n, 6]
            z[n, 3 + c] += z[n, 6 + c] - z[n, c]
    for k in range(len(first)):
        if heard[k]:
            for c in range(3):
                duals[k, 0, c] += duals[k, 0, 3 + c] - z[second[k], c]
                duals[k, 1, c] += duals[k, 1, 3 + c] - z[first[k], c]
