"""A start by linear solves: rotations relaxed to matrices together with all positions, then positions alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ...formats.graph import Graph
from ..algebra.cholesky import Cholesky
from ..model.space import Space, exp

TIE = 1e-6
"""Weight of the start that is given beside the least weight of a measurement: it decides only what nothing measures."""
PROXIMAL = 1e-4
"""Weight of the last rotations beside that of a median relative rotation: it acts over a hundred poses of a chain."""
SWEEPS = 10
"""Solves with the rotations of the one before; the matrix is factored once."""


class Rows(NamedTuple):
    """Rows of a sparse least squares problem, weight (value . x[column] - goal)^2, the same matrix for each of d goals;
    an infinite weight is the largest of the others, and a goal of None is given when it is solved."""

    column: Ints
    value: Floats
    goal: Floats | None
    weight: Floats


def linear_start(graph: Graph, start: Floats) -> Floats:
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
    d, n = graph.dimension, len(graph.names)
    space = Space(d, has_rotation=True)
    rotation, position = space.rotation(start), space.position(start)
    at, anchors = np.arange(n)[:, None] * (d + 1) + np.arange(d + 1), _anchors(graph)
    rows = _rows(graph, at)
    kappa = np.median(1.0 / _turn_variance(graph.relative_pose.covariance, d)) if len(graph.relative_pose) else 1.0
    turns = at[graph.is_pose][:, :d].ravel()
    whole = np.concatenate([np.swapaxes(rotation, 1, 2), position[:, None]], axis=1).reshape(n * (d + 1), d)
    last = Rows(turns[:, None], np.ones((len(turns), 1)), None, np.full(len(turns), PROXIMAL * kappa))
    solve = _least_squares([*rows, last], n * (d + 1), d + 1)
    for _ in range(SWEEPS):
        found = solve(whole, whole[turns]).reshape(n, d + 1, d)
        rotation[graph.is_pose] = project(np.swapaxes(found[graph.is_pose, :d], 1, 2))
        found[:, :d] = np.swapaxes(rotation, 1, 2)
        whole = found.reshape(n * (d + 1), d)
    held = Rows(anchors[:, None], np.ones((len(anchors), 1)), None, np.full(len(anchors), np.inf))
    steady = _least_squares([*_positions(graph, rotation), held], n, 1)
    return space.join(steady(position, position[anchors]), rotation)


def project(matrix: Floats) -> Floats:
    """The nearest rotations (..., d, d), by singular values.

    >>> project(np.array([[0.0, -2.0], [2.0, 0.0]])).round(6) + 0.0
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    if matrix.shape[-1] == 2:
        angle = np.arctan2(matrix[..., 1, 0] - matrix[..., 0, 1], matrix[..., 0, 0] + matrix[..., 1, 1])
        return exp(angle[..., None])
    left, _, right = np.linalg.svd(matrix)
    sign = np.linalg.det(left @ right)
    left[..., :, -1] *= sign[..., None]
    return np.asarray(left @ right)


def _anchors(graph: Graph) -> Ints:
    """One pose of each part of the graph that has no prior and that no linear measurement joins to another."""
    part = parts(len(graph.names), np.concatenate([graph.relative_pose.nodes, graph.relative_point.nodes]))
    held = part[np.concatenate([graph.pose_prior.nodes[:, 0], graph.point_prior.nodes[:, 0]])]
    poses = np.flatnonzero(graph.is_pose & ~np.isin(part, held))
    return np.asarray(poses[np.unique(part[poses], return_index=True)[1]])


def parts(n: int, pairs: Ints) -> Ints:
    """(n,) number of the connected part that each node is in, by pairs (M, 2) that are joined."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    joined = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return np.asarray(connected_components(joined, directed=False)[1])


def _rows(graph: Graph, at: Ints) -> list[Rows]:
    """Of all that is linear in matrices and positions; `at` (n, d + 1) numbers each node's R columns and position."""
    d, found = graph.dimension, []
    pairs, priors = graph.relative_pose, graph.pose_prior
    for k in range(d if len(pairs) else 0):
        i, j = pairs.nodes.T
        column = np.concatenate([at[j][:, [k]], at[i][:, :d]], axis=1)
        value = np.concatenate([np.ones((len(i), 1)), -pairs.rotation[:, :, k]], axis=1)
        found.append(Rows(column, value, np.zeros((len(i), d)), 1.0 / _turn_variance(pairs.covariance, d)))
    for edges in (pairs, graph.relative_point):
        if len(edges):
            i, j = edges.nodes.T
            column = np.concatenate([at[j][:, [d]], at[i][:, [d]], at[i][:, :d]], axis=1)
            value = np.concatenate([np.ones((len(i), 1)), -np.ones((len(i), 1)), -edges.position], axis=1)
            found.append(Rows(column, value, np.zeros((len(i), d)), 1.0 / _variance(edges.covariance, d)))
    for k in range(d if len(priors) else 0):
        goal, column = priors.rotation[:, :, k], at[priors.nodes[:, 0]][:, [k]]
        found.append(Rows(column, np.ones(column.shape), goal, 1.0 / _turn_variance(priors.covariance, d)))
    return [*found, *_fixes(graph, at[:, d])]


def _positions(graph: Graph, rotation: Floats) -> list[Rows]:
    """Of positions alone, where rotations are known."""
    found = []
    for edges in (graph.relative_pose, graph.relative_point):
        if len(edges):
            i, j = edges.nodes.T
            goal = np.einsum("mab,mb->ma", rotation[i], edges.position)
            value = np.tile([1.0, -1.0], (len(i), 1))
            found.append(
                Rows(np.stack([j, i], axis=1), value, goal, 1.0 / _variance(edges.covariance, graph.dimension))
            )
    return [*found, *_fixes(graph, np.arange(len(graph.names)))]


def _fixes(graph: Graph, at: Ints) -> list[Rows]:
    """Positions of priors."""
    return [
        Rows(
            at[edges.nodes],
            np.ones((len(edges), 1)),
            edges.position,
            1.0 / _variance(edges.covariance, graph.dimension),
        )
        for edges in (graph.pose_prior, graph.point_prior)
        if len(edges)
    ]


def _least_squares(rows: list[Rows], count: int, width: int) -> Callable[[Floats, Floats], Floats]:
    """(start (count, d), goals of the rows that have none of their own) -> (count, d), by one factorisation;
    what has no information stays at the start; `width` unknowns of a node follow one another."""
    from scipy.sparse import csc_matrix, csr_array, diags_array, triu

    finite = np.concatenate([part.weight[np.isfinite(part.weight)] for part in rows])
    tie, most = TIE * float(finite.min(initial=1.0)), float(finite.max(initial=1.0))
    matrix = diags_array(np.full(count, tie)).tocsr()
    weighted: list[Any] = []
    for part in rows:
        indptr = np.arange(len(part.column) + 1) * part.column.shape[1]
        G: Any = csr_array((part.value.ravel(), part.column.ravel(), indptr), shape=(len(part.column), count))
        weighted.append(G.T @ diags_array(np.minimum(part.weight, most)))
        matrix = matrix + weighted[-1] @ G
    upper = csc_matrix(triu(matrix))
    upper.sort_indices()
    cholesky = Cholesky(upper.indptr, upper.indices, np.arange(count) // width)
    sound = cholesky.factor(upper.data)

    def solve(start: Floats, goal: Floats) -> Floats:
        if not sound:
            return start
        right = tie * start
        for part, each in zip(rows, weighted, strict=True):
            right = right + each @ (goal if part.goal is None else part.goal)
        return np.stack([cholesky.solve(np.ascontiguousarray(column)) for column in right.T], axis=1)

    return solve


def _variance(covariance: Floats, d: int) -> Floats:
    """(M,) mean variance of the position."""
    return np.asarray(np.einsum("mii->m", covariance[:, :d, :d]) / d)


def _turn_variance(covariance: Floats, d: int) -> Floats:
    """(M,) of an entry of the rotation, as the chordal objective has it."""
    turn = np.einsum("mii->m", covariance[:, d:, d:])
    return np.asarray(turn if d == 2 else 2.0 * turn / 3.0)
