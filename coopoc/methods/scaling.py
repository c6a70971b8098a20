"""Multidimensional scaling: shapes from distances, their fit to positions, and stress majorisation, B at once."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats


def complete(measured: Floats, guess: Floats | None = None) -> Floats:
    """All distances: the mean of the two ends' measurements; where neither did, a guess or the shortest path.

    Args:
        measured: (B, n, n) m, NaN where i has not measured j; measured pairs must connect all.
        guess: (B, n, n) m, symmetric; None for the length of the shortest path.

    >>> nan = np.nan
    >>> complete(np.array([[[nan, 3, 5], [3, nan, nan], [nan, nan, nan]]]))[0, 1, 2]
    np.float64(8.0)
    """
    ends = np.stack([measured, np.swapaxes(measured, 1, 2)])
    known = np.isfinite(ends).sum(axis=0)
    direct = np.where(known > 0, np.nansum(ends, axis=0) / np.maximum(known, 1), np.inf)
    own = np.arange(measured.shape[1])
    direct[:, own, own] = 0.0
    if guess is not None:
        return np.where(np.isfinite(direct), direct, guess)
    path = direct.copy()
    for k in own:
        path = np.minimum(path, path[:, :, k, None] + path[:, None, k, :])
    return np.where(np.isfinite(direct), direct, path)


def shape(distance: Floats) -> Floats:
    """Classical scaling: X = V sqrt(Lambda) of the three largest eigenpairs of B = -1/2 J D^2 J, (B, n, 3) m, centred.

    Exact up to a rigid motion or reflection if the distances are those of points in space.

    Args:
        distance: (B, n, n) m, symmetric.

    >>> line = shape(np.abs(np.arange(3.0)[:, None] - np.arange(3.0))[None])[0]
    >>> np.abs(line[:, 0]).round(6).tolist()
    [1.0, 0.0, 1.0]
    """
    square = distance**2
    rows = square.mean(axis=2, keepdims=True)
    gram = -0.5 * (square - rows - np.swapaxes(rows, 1, 2) + rows.mean(axis=1, keepdims=True))
    value, vector = np.linalg.eigh(gram)
    top = min(3, distance.shape[1])
    points = np.zeros((*distance.shape[:2], 3))
    points[..., :top] = vector[..., -top:][..., ::-1] * np.sqrt(np.maximum(value[:, None, -top:], 0.0))[..., ::-1]
    return points


def fit(points: Floats, target: Floats, weight: Floats) -> Floats:
    """The points moved to the target: min over R in O(3) and t of sum_i w_i |R x_i + t - z_i|^2 (weighted Procrustes).

    R = V U^T of the singular vectors U S V^T of sum w (x - xm)(z - zm)^T: it is a reflection where that fits better,
    because distances do not distinguish a shape from its mirror image.

    Args:
        points: (B, n, 3) m.
        target: (B, n, 3) m.
        weight: (B, n) >= 0, not all zero.
    """
    share = (weight / weight.sum(axis=1, keepdims=True))[..., None]
    middle, there = (share * points).sum(axis=1, keepdims=True), (share * target).sum(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(share * (points - middle), 1, 2) @ (target - there))
    moved: Floats = (points - middle) @ (u @ vt) + there
    return moved


def majorise(
    points: Floats, distance: Floats, weight: Floats, anchor: Floats, anchor_weight: Floats, iterations: int
) -> Floats:
    """SMACOF with anchors: each step lowers sum_{i<j} w_ij (d_ij - |x_i - x_j|)^2 + sum_i a_i |x_i - z_i|^2.

    X <- (V + diag a)^-1 (B(X) X + diag(a) Z), V the Laplacian of w and B(X) that of w d / |x_i - x_j| (de Leeuw's
    majorisation): no step length, and slow where the anchors are weak.

    Args:
        points: (B, n, 3) m, the start.
        distance: (B, n, n) m.
        weight: (B, n, n) 1/m^2, symmetric, 0 if not measured.
        anchor: (B, n, 3) m.
        anchor_weight: (B, n, 3) 1/m^2 per axis, 0 for none; each connected component needs one.
        iterations: of the majorisation.
    """
    own = np.arange(points.shape[1])
    fixed = _laplacian(weight)[:, None] + np.swapaxes(anchor_weight, 1, 2)[..., None] * np.eye(len(own))
    inverse = np.linalg.inv(fixed)
    for _ in range(iterations):
        gap = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        ratio = np.where(gap > 0, weight * distance / np.where(gap > 0, gap, 1.0), 0.0)
        target = _laplacian(ratio) @ points + anchor_weight * anchor
        points = np.swapaxes((inverse @ np.swapaxes(target, 1, 2)[..., None])[..., 0], 1, 2)
    return points


def _laplacian(weight: Floats) -> Floats:
    """diag(W 1) - W of symmetric weights (B, n, n) with a zero diagonal."""
    return np.asarray(weight.sum(axis=2)[..., None] * np.eye(weight.shape[1]) - weight)
