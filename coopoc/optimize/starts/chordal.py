"""Chordal initialisation: rotations relaxed to matrices together with all positions, then positions alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from ...formats.graph import Graph
from ..algebra.cholesky import Cholesky
from ..model.space import Space

TIE = 1e-6
"""Weight of the start that is given beside the least weight of a measurement: it decides only what nothing measures."""
PROXIMAL = 1e-4
"""Weight of the last rotations beside that of a median relative rotation: it acts over a hundred poses of a chain."""
SWEEPS = 10
"""Solves with the rotations of the one before; the matrix is factored once."""


def chordal_start(graph: Graph, start: Floats) -> Floats:
    """(n, ambient): the least squares of relative poses, seen landmarks and priors over any matrices R_i, which
    are then projected to rotations; last over the positions with these rotations.

    sum kappa |R_j - R_i R_ij|_F^2 + tau |t_j - t_i - R_i t_ij|^2 + tau |l_k - t_i - R_i z_ik|^2 + mu |R_i - P_i|_F^2,
    P the rotations before: row a of all matrices and component a of all positions form one problem, and all d share one
    matrix. Without the last term matrices shrink towards zero along a chain, and what is left of them turns at random;
    with it each sweep is a step of a projected inverse power iteration, which lengthens them again. Ranges have no
    linear form; what they alone hold stays at the `start` (n, ambient).

    References:
        Carlone, Tron, Daniilidis, Dellaert, Initialization techniques for 3D SLAM, ICRA 2015 (chordal relaxation);
        Boumal, Nonconvex phase synchronization, SIAM J. Optim. 2016 (generalized power method).
    """
    from scipy.sparse import eye_array, vstack

    d, n = graph.dimension, len(graph.names)
    space, size = Space(d, has_rotation=True), n * (d + 1)
    rotation, position = space.rotation(start), space.position(start)
    at = np.arange(size).reshape(n, d + 1)
    A, goal, weight = _rows(graph, at)
    turns, places = at[graph.is_pose, :d].ravel(), at[:, d]
    kappa = np.median(1.0 / rotation_variance(graph.relative_pose.covariance, d)) if len(graph.relative_pose) else 1.0
    proximal = np.append(weight, np.full(len(turns), PROXIMAL * kappa))
    whole = np.concatenate([np.swapaxes(rotation, 1, 2), position[:, None]], axis=1).reshape(size, d)
    solve = _least_squares(vstack([A, eye_array(size, format="csr")[turns]], format="csr"), proximal, d + 1)
    for _ in range(SWEEPS):
        found = solve(whole, np.concatenate([goal, whole[turns]])).reshape(n, d + 1, d)
        rotation[graph.is_pose] = nearest_rotation(np.swapaxes(found[graph.is_pose, :d], 1, 2))
        found[:, :d] = np.swapaxes(rotation, 1, 2)
        whole = found.reshape(size, d)
    anchors = _anchors(graph)
    held = vstack([A[:, places], eye_array(n, format="csr")[anchors]], format="csr")
    solve = _least_squares(held, np.append(weight, np.full(len(anchors), weight.max(initial=1.0))), 1)
    return space.join(solve(position, np.concatenate([goal - A[:, turns] @ whole[turns], position[anchors]])), rotation)


def parts(n: int, pairs: Ints) -> Ints:
    """(n,) number of the connected component that each node is in, by pairs (M, 2) that are joined."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    joined = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return np.asarray(connected_components(joined, directed=False)[1])


def nearest_rotation(matrix: Floats) -> Floats:
    """The nearest rotations (..., d, d), by singular values.

    >>> nearest_rotation(np.array([[0.0, -2.0], [2.0, 0.0]])).round(6) + 0.0
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    left, _, right = np.linalg.svd(matrix)
    left[..., :, -1] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def _anchors(graph: Graph) -> Ints:
    """One pose of each part of the graph that has no prior and that no linear measurement joins to another."""
    part = parts(len(graph.names), np.concatenate([graph.relative_pose.nodes, graph.relative_point.nodes]))
    held = part[np.concatenate([graph.pose_prior.nodes[:, 0], graph.point_prior.nodes[:, 0]])]
    poses = np.flatnonzero(graph.is_pose & ~np.isin(part, held))
    return np.asarray(poses[np.unique(part[poses], return_index=True)[1]])


def _rows(graph: Graph, at: Ints) -> tuple[Any, Floats, Floats]:
    """A (M, n (d + 1)), goals (M, d) and weights (M,) of all that is linear in matrices and positions; `at` (n, d + 1)
    numbers each node's columns of R^T and its position."""
    from scipy.sparse import csr_array, vstack

    d, matrices, goals, weights = graph.dimension, [csr_array((0, at.size))], list[Floats](), list[Floats]()

    def add(columns: Ints, values: Floats, goal: Floats, variance: Floats) -> None:
        ends = np.arange(len(columns) + 1) * columns.shape[1]
        matrices.append(csr_array((values.ravel(), columns.ravel(), ends), shape=(len(columns), at.size)))
        goals.append(goal)
        weights.append(1.0 / variance)

    pairs, priors = graph.relative_pose, graph.pose_prior
    for k in range(d):
        if len(pairs):
            i, j = pairs.nodes.T
            columns = np.concatenate([at[j, k : k + 1], at[i, :d]], axis=1)
            values = np.concatenate([np.ones((len(i), 1)), -pairs.rotation[:, :, k]], axis=1)
            add(columns, values, np.zeros((len(i), d)), rotation_variance(pairs.covariance, d))
        if len(priors):
            columns = at[priors.nodes[:, 0], k : k + 1]
            add(columns, np.ones(columns.shape), priors.rotation[:, :, k], rotation_variance(priors.covariance, d))
    for edges in (pairs, graph.relative_point):
        if len(edges):
            i, j = edges.nodes.T
            columns = np.concatenate([at[j, d:], at[i, d:], at[i, :d]], axis=1)
            values = np.concatenate([np.tile([1.0, -1.0], (len(i), 1)), -edges.position], axis=1)
            add(columns, values, np.zeros((len(i), d)), position_variance(edges.covariance, d))
    for fixes in (priors, graph.point_prior):
        if len(fixes):
            columns = at[fixes.nodes[:, 0], d:]
            add(columns, np.ones(columns.shape), fixes.position, position_variance(fixes.covariance, d))
    return (
        vstack(matrices, format="csr"),
        np.concatenate([np.empty((0, d)), *goals]),
        np.concatenate([np.empty(0), *weights]),
    )


def _least_squares(A: Any, weight: Floats, width: int) -> Callable[[Floats, Floats], Floats]:
    """(start (m, d), goals (M, d)) -> (m, d), by one factorisation; what has no information stays at the start;
    `width` unknowns of a node follow one another."""
    from scipy.sparse import csc_matrix, diags_array, triu

    tie, weighted = TIE * float(weight.min(initial=1.0)), A.T @ diags_array(weight)
    upper = csc_matrix(triu(weighted @ A + diags_array(np.full(A.shape[1], tie))))
    upper.sort_indices()
    cholesky = Cholesky(upper.indptr, upper.indices, np.arange(A.shape[1]) // width)
    sound = cholesky.factor(upper.data)

    def solve(start: Floats, goal: Floats) -> Floats:
        if not sound:
            return start
        right = tie * start + weighted @ goal
        return np.stack([cholesky.solve(np.ascontiguousarray(column)) for column in right.T], axis=1)

    return solve


def position_variance(covariance: Floats, d: int) -> Floats:
    """(M,) mean variance of the position."""
    return np.asarray(np.einsum("mii->m", covariance[:, :d, :d]) / d)


def rotation_variance(covariance: Floats, d: int) -> Floats:
    """(M,) of an entry of the rotation, as the chordal objective has it."""
    turn = np.einsum("mii->m", covariance[:, d:, d:])
    return np.asarray(turn if d == 2 else 2.0 * turn / 3.0)
