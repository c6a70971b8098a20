"""The quadratically constrained quadratic programme (QCQP) of a problem, whose relaxations bound every cost.

The rows of X are points on simple manifolds, every measurement is linear in them, and the cost is 1/2 |A X|_F^2
(CORA, arXiv 2302.11614):

    X = [ H ; R_k^T ; s_e ; t_i ]       H H^T = I,  R_k R_k^T = I,  |s_e| = 1,  t_i free

with H the world's frame (only where something is measured in it) and s_e the unit vector from the second to the first
point of range e: w (|t_j - t_i| - r)^2 = min over |s| = 1 of w |t_j - t_i + r s|^2. A common rotation X G, G in O(d),
changes nothing; H = I picks the world's. A scalar weight w acts on all d columns of X alike; where a fix or a
displacement weighs its axes differently the columns are stacked into one, X = [1; vec s; vec t], of d times the rows.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.linalg import det, norm, svd

from ...arrays import Floats, Ints
from ...errors import InputError
from ..backend import Capabilities
from ..model.factor import Factor, stacked
from ..model.problem import Problem, row_matrix
from ..model.space import nearest_rotation


class Quadratic(NamedTuple):
    """minimise 1/2 |A X|_F^2 over X (N, columns), X_B X_B^T = I on each Stiefel block, |X_B|_F = 1 on each sphere.

    Attributes:
        rows: sparse A (M, N). The first `bound` rows of X are constrained, the others free positions.
        stiefel: (n, k) rows of X.
        sphere: (m, d / columns) rows of X.
        dimension: d.
        columns: of X, d or, stacked, 1.
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
    columns: int
    framed: bool
    nodes: Ints
    poses: Ints
    position: Floats
    rotation: Floats
    edges: Ints
    origin: Floats

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
        length = norm(gap, axis=1, keepdims=True)
        unit = np.where(length > 0, gap / np.maximum(length, 1e-300), np.eye(self.dimension)[0])
        frame = np.eye(self.columns)[: self.columns * self.framed]
        turned = rotation[self.poses].mT.reshape(-1, self.dimension)
        return np.concatenate([frame, *(part.reshape(-1, self.columns) for part in (turned, unit, at[self.nodes]))])

    def drop(self, X: Floats) -> tuple[Floats, Floats]:
        """Positions (n, d) m and rotations (n, d, d) of X, turned so that H = I, mirrored if most R_k are."""
        d, poses = self.dimension, len(self.poses)
        if self.framed:
            X = X @ orthogonal(X[: self.stiefel.shape[1]]).T
        at = X[self.bound :].reshape(-1, d)
        position, rotation = self.position.copy(), self.rotation.copy()
        if poses:
            turned = X[self.stiefel[-poses:].ravel()].reshape(poses, d, d).mT
            if not self.framed and det(turned).sum() < 0:
                mirror = np.diag([*np.ones(d - 1), -1.0])
                at, turned = at @ mirror, mirror @ turned
            rotation[self.poses] = nearest_rotation(turned)
        position[self.nodes] = at + self.origin
        return position, rotation

    def project(self, X: Floats) -> Floats:
        """The nearest point on the manifolds to rows X (bound, p): the polar factor on a Stiefel block.

        Unlike a triangular factor that turns all blocks alike where X does, so that a robot's chain stays rigid.
        """
        out = np.array(X)
        out[self.stiefel] = orthogonal(X[self.stiefel])
        s = X[self.sphere]
        length = norm(s, axis=(1, 2), keepdims=True)
        even = np.sqrt(1.0 / max(s[:1].size, 1))
        out[self.sphere] = np.where(length > 1e-12, s / np.maximum(length, 1e-12), even)
        return out


class Multipliers(NamedTuple):
    """Of the constraints of `problem`: stiefel (n, k, k) symmetric, sphere (m,)."""

    problem: Quadratic
    stiefel: Floats
    sphere: Floats

    @property
    def trace(self) -> float:
        """1/2 trace is a lower bound if C - L is positive semidefinite."""
        return float(np.einsum("nii->", self.stiefel) + self.sphere.sum())

    @property
    def matrix(self) -> Any:
        """L (bound, bound), sparse."""
        from scipy.sparse import block_diag

        unit = np.eye(self.problem.sphere.shape[1])
        return block_diag([*self.stiefel, *(unit * each for each in self.sphere)], format="csc")


def multipliers(problem: Quadratic, X: Floats, CX: Floats) -> Multipliers:
    """In closed form at X (bound, p)."""
    block = CX[problem.stiefel] @ X[problem.stiefel].mT
    along = np.einsum("mqp,mqp->m", CX[problem.sphere], X[problem.sphere])
    return Multipliers(problem, 0.5 * (block + block.mT), along)


def orthogonal(blocks: Floats) -> Floats:
    """The nearest matrices with orthonormal rows to (..., k, p)."""
    u, _, v = svd(blocks, full_matrices=False)
    return np.asarray(u @ v)


def quadratic(problem: Problem) -> Quadratic:
    """The QCQP of a problem.

    Exact for position, displacement (any weights; among poses the same for all axes), range, relative_position (one
    weight), pose_chordal and relative_pose_chordal (one weight for the position, one for the rotation). Other kinds
    have no such form.

    Raises:
        InputError: another kind, weights that differ between axes where a rotation acts, a robust loss, constraints.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> quadratic(problem.add("range", ("a", "b"), 5.0, std=0.5)).rows.shape
    (3, 6)
    """
    from scipy.sparse import csr_array, hstack

    if not problem.factors:
        raise InputError("problem", repr(problem), "has no measurements", "Add factors: problem.add(...).")
    if lacking := QUADRATIC.lacking(problem):
        hint = "Use least squares of ranges and chords, or trust the curvature that `solve` checks."
        allowed = f"is not quadratic: it must be one of {sorted(KINDS)}, without losses and constraints"
        raise InputError("problem", f"with {', '.join(lacking)}", allowed, hint)
    d, n = problem.dimension, len(problem.names)
    world = [f for f in problem.factors if f.kind in WORLD]
    uneven = [f for f in world if f.kind != "pose_chordal" and one_weight(f.root) is None]
    if uneven and problem.poses:
        _refuse(uneven[0])
    fixes = [f.z[:, :d] for f in world if f.kind != "displacement"]
    origin = np.concatenate(fixes).mean(0) if fixes else np.zeros(d)
    ranges = [f.nodes for f in problem.factors if f.kind == "range"]
    columns, framed = 1 if uneven else d, bool(world or problem.fixed)
    poses, fixed = (np.unique(np.array(nodes, int)) for nodes in (problem.poses, problem.fixed))
    q, edges = d // columns, stacked(ranges, 2)
    sizes = columns * framed, d * len(poses), q * len(edges), q * n
    frame, turns, units, at = np.split(np.arange(sum(sizes)), np.cumsum(sizes[:3]))
    each = iter(np.split(units.reshape(-1, q), np.cumsum([*map(len, ranges)])))
    rows = _Rows(columns, origin, frame, np.zeros((n, d), int), each, at.reshape(n, q))
    rows.rotation[poses] = turns.reshape(-1, d)
    blocks = [block for factor in problem.factors for block in _terms(rows, factor)]
    A = row_matrix(((np.concatenate(v, axis=2), np.concatenate(c, axis=1)) for v, c in blocks), sum(sizes))
    A.sum_duplicates()
    x = np.zeros((n, problem.space.ambient)) if problem.x0 is None else problem.x0
    position, rotation = problem.space.position(x), np.array(problem.space.rotation(x))
    if len(fixed):  # whose terms move to the frame: t_i = p_i^T H and R_i^T = R_i^T H
        turned = np.intersect1d(fixed, poses)
        gone = np.concatenate([rows.position[fixed].ravel(), rows.rotation[turned].ravel()])
        values = [part.reshape(-1, columns) for part in ((position - origin)[fixed], rotation[turned].mT)]
        moved = A[:, frame] + A[:, gone] @ csr_array(np.concatenate(values))
        A = hstack([moved, A[:, np.setdiff1d(np.arange(len(frame), A.shape[1]), gone)]], format="csr")
    else:
        rotation[:] = np.eye(d)
    poses = np.setdiff1d(poses, fixed)
    top = len(frame) + d * len(poses)
    return Quadratic(
        rows=A,
        stiefel=np.arange(top).reshape(-1, columns),
        sphere=top + np.arange(units.size).reshape(-1, q),
        dimension=d,
        columns=columns,
        framed=framed,
        nodes=np.setdiff1d(np.arange(n), fixed),
        poses=poses,
        position=position,
        rotation=rotation,
        origin=origin,
        edges=edges,
    )


class _Rows(NamedTuple):
    """Which rows of X are the `frame`, R^T of each pose, `rotation` (n, d), the unit vectors (M, q) of one factor of
    ranges after the other, and each `position` (n, q)."""

    columns: int
    origin: Floats
    frame: Ints
    rotation: Ints
    units: Iterator[Ints]
    position: Ints


Blocks = list[tuple[list[Floats], list[Ints]]]
"""k rows of A per measurement: values (M, k, c) in columns (M, c), side by side."""


def _terms(rows: _Rows, factor: Factor) -> Blocks:
    """The rows of a factor of one of KINDS.

    Raises:
        InputError: weights of axes that differ where a rotation acts.
    """
    nodes, z, root, d = factor.nodes.T, factor.z, factor.root, len(rows.origin)
    at, q, frame = rows.position[nodes], rows.position.shape[1], np.tile(rows.frame, (len(z), 1))
    if factor.kind == "range":  # w (t_j - t_i + r s)
        root = root * np.eye(q)
        return [([-root, root, z[..., None] * root], [*at, next(rows.units)])]
    if factor.kind in ("position", "displacement"):  # W (t_i - z), or W (t_j - t_i - z), z in the world's frame
        root = root[:, :q, :q]
        ends, moved = ([root], z - rows.origin) if len(nodes) == 1 else ([-root, root], z)
        return [([*ends, -root @ moved.reshape(-1, q, rows.columns)], [*at, frame])]
    weight, turn = one_weight(root[:, :d, :d]), one_weight(root[:, d:, d:])
    if weight is None or turn is None or root[:, :d, d:].any() or root[:, d:, :d].any():
        _refuse(factor)
    w, angular, turned = weight[:, None, None], turn[:, None, None], z[:, d:].reshape(-1, d, d).mT
    if factor.kind == "pose_chordal":  # w (t_i - z), and w (R_i^T - R_z^T H)
        moved, places = -w * (z[:, None, :d] - rows.origin), [*rows.rotation[nodes], frame]
        return [([w, moved], [*at, frame]), ([angular * np.eye(d), -angular * turned], places)]
    i, j = rows.rotation[nodes]
    blocks = [([-w, w, -w * z[:, None, :d]], [*at, i])]  # w (t_j - t_i - z R_i^T)
    if factor.measurement.compares_poses:  # and w (R_j^T - R_ij^T R_i^T)
        blocks.append(([-angular * turned, angular * np.eye(d)], [i, j]))
    return blocks


KINDS = ("position", "displacement", "range", "relative_position", "pose_chordal", "relative_pose_chordal")
"""Measurements of this form."""
QUADRATIC = Capabilities(kinds=KINDS, losses=())
"""What has this form."""
WORLD = ("position", "displacement", "pose_chordal")
"""Measurements in the world's frame."""


def one_weight(root: Floats) -> Floats | None:
    """(M,) w if every W (M, k, k) is w I, else None."""
    weight = root[:, 0, 0] if root.size else np.zeros(len(root))
    return weight if np.allclose(root, weight[:, None, None] * np.eye(root.shape[-1]), rtol=1e-9, atol=0.0) else None


def _refuse(factor: Factor) -> NoReturn:
    raise InputError(
        f"std of {factor.kind}",
        "differs between axes",
        "must be one number for the position and one for the rotation "
        "where poses turn: other weights are no QCQP of this form, and would cost the relaxation its tightness",
        "Give one std to all axes.",
    )
