"""Quadratic: a quadratic cost with quadratic equalities (QCQP), the form of a problem that relaxations need.

The rows of X are points on simple manifolds, every measurement is linear in them, and the cost is 1/2 |A X|_F^2
(CORA, arXiv 2302.11614):

    X = [ H ; R_k^T ; s_e ; t_i ]       H H^T = I,  R_k R_k^T = I,  |s_e| = 1,  t_i free

with H the world's frame (only where something is measured in it) and s_e the unit vector from the second to the first
point of range e: w (|t_j - t_i| - r)^2 = min over |s| = 1 of w |t_j - t_i + r s|^2. A common rotation X G, G in O(d),
changes nothing; H = I picks the world's. A scalar weight w acts on all d columns of X alike; where a fix or a
displacement weighs its axes differently the columns are stacked into one, X = [1; vec s; vec t], of d times the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Quadratic:
    """minimise 1/2 |A X|_F^2 over X (N, columns), X_B X_B^T = I on each Stiefel block, |X_B|_F = 1 on each sphere.

    Args:
        rows: sparse A (M, N). The first `bound` rows of X are constrained, the others free positions.
        stiefel: (n, k) rows of X.
        sphere: (m, q) rows of X, q = d if the columns are stacked, else 1.
        dimension: d.
        stacked: one column instead of d.
        framed: the first Stiefel block is H.
        nodes: whose position, and whose rotation, X holds; the others stay as they are in `position` (n, d) m and
            `rotation` (n, d, d).
        poses: as `nodes`.
        edges: (m, 2) nodes of the ranges.
        origin: (d,) m, subtracted from positions.
    """

    rows: Any
    stiefel: Ints
    sphere: Ints
    dimension: int
    stacked: bool
    framed: bool
    nodes: Ints
    poses: Ints
    position: Floats
    rotation: Floats
    edges: Ints
    origin: Floats

    @property
    def columns(self) -> int:
        """Of X."""
        return 1 if self.stacked else self.dimension

    @property
    def bound(self) -> int:
        """Number of constrained rows of X."""
        return self.stiefel.size + self.sphere.size

    @property
    def trace(self) -> int:
        """Of X X^T over the constrained rows: the constraints fix it."""
        return self.stiefel.size + len(self.sphere)

    def lift(self, position: Floats, rotation: Floats) -> Floats:
        """X (N, columns) of positions (n, d) m and rotations (n, d, d); a unit vector is drawn along each range."""
        at = position - self.origin
        gap = at[self.edges[:, 0]] - at[self.edges[:, 1]]
        length = np.linalg.norm(gap, axis=1, keepdims=True)
        unit = np.where(length > 0, gap / np.where(length > 0, length, 1.0), np.eye(self.dimension)[0])
        frame = np.eye(self.columns)[: self.columns * self.framed]
        turned = np.swapaxes(rotation[self.poses], 1, 2).reshape(-1, self.dimension)
        parts = [frame, *(part.reshape(-1, self.columns) for part in (turned, unit, at[self.nodes]))]
        return np.concatenate(parts)

    def drop(self, X: Floats) -> tuple[Floats, Floats]:
        """Positions (n, d) m and rotations (n, d, d) of X, turned so that H = I, mirrored if most R_k are."""
        d, k, poses = self.dimension, self.stiefel.shape[1], len(self.poses)
        if self.framed:
            X = X @ _orthogonal(X[:k]).T
        at = X[self.bound :].reshape(-1, d)
        position, rotation = self.position.copy(), self.rotation.copy()
        if poses:
            turned = np.swapaxes(X[self.stiefel[-poses:].ravel()].reshape(poses, d, d), 1, 2)
            if not self.framed and np.linalg.det(turned).sum() < 0:
                mirror = np.diag([*np.ones(d - 1), -1.0])
                at, turned = at @ mirror, mirror @ turned
            rotation[self.poses] = nearest_rotation(turned)
        position[self.nodes] = at + self.origin
        return position, rotation

    def project(self, X: Floats) -> Floats:
        """The nearest point on the manifolds to the constrained rows X (bound, p)."""
        out = np.array(X)
        if len(self.stiefel):
            out[self.stiefel] = _orthogonal(X[self.stiefel])
        if len(self.sphere):
            s = X[self.sphere]
            length = np.sqrt(np.square(s).sum(axis=(1, 2), keepdims=True))
            out[self.sphere] = np.where(
                length > 1e-12, s / np.where(length > 1e-12, length, 1.0), np.sqrt(1 / s[0].size)
            )
        return out


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Of the constraints of `problem`: stiefel (n, k, k) symmetric, sphere (m,)."""

    problem: Quadratic
    stiefel: Floats
    sphere: Floats

    @property
    def trace(self) -> float:
        """What they promise: 1/2 trace is a lower bound if C - L is positive semidefinite."""
        return float(np.einsum("nii->", self.stiefel) + self.sphere.sum())

    def times(self, V: Floats) -> Floats:
        """L V."""
        out = np.zeros_like(V)
        out[self.problem.stiefel] = self.stiefel @ V[self.problem.stiefel]
        out[self.problem.sphere] = self.sphere[:, None, None] * V[self.problem.sphere]
        return out

    @property
    def dense(self) -> Floats:
        """L (bound, bound)."""
        stiefel, sphere = self.problem.stiefel, self.problem.sphere
        out = np.zeros((self.problem.bound, self.problem.bound))
        out[stiefel[:, :, None], stiefel[:, None, :]] = self.stiefel
        out[sphere, sphere] = self.sphere[:, None]
        return out

    @property
    def sparse(self) -> Any:
        """L, sparse."""
        from scipy.sparse import csc_array

        stiefel, sphere = self.problem.stiefel, self.problem.sphere
        row, col = np.broadcast_arrays(stiefel[:, :, None], stiefel[:, None, :])
        row, col = (np.concatenate([part.ravel(), sphere.ravel()]) for part in (row, col))
        data = np.concatenate([self.stiefel.ravel(), np.broadcast_to(self.sphere[:, None], sphere.shape).ravel()])
        return csc_array((data, (row, col)), shape=(self.problem.bound, self.problem.bound))


def multipliers(problem: Quadratic, X: Floats, CX: Floats) -> Multipliers:
    """In closed form at X (bound, p)."""
    block = CX[problem.stiefel] @ np.swapaxes(X[problem.stiefel], 1, 2)
    along = np.einsum("mqp,mqp->m", CX[problem.sphere], X[problem.sphere])
    return Multipliers(problem, 0.5 * (block + np.swapaxes(block, 1, 2)), along)


def _orthogonal(blocks: Floats) -> Floats:
    """The nearest matrices with orthonormal rows to (..., k, p)."""
    u, _, v = np.linalg.svd(blocks, full_matrices=False)
    return np.asarray(u @ v)


def nearest_rotation(blocks: Floats) -> Floats:
    """The nearest rotations to (..., d, d)."""
    u, _, v = np.linalg.svd(blocks)
    u[..., -1] *= np.sign(np.linalg.det(u @ v))[..., None]
    return np.asarray(u @ v)
