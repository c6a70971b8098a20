"""Arrowhead elimination: groups of points that only meet at a separator, by its Schur complement, B problems at once.

A snapshot has a separator of one point (the ego) and groups of one (its neighbours); a window has the ego's points as
separator and one group per neighbour's chain. One Schur complement serves both, batched in LAPACK.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..model.problem import Problem
from .normal import Pattern, pattern

if TYPE_CHECKING:
    from ...kernels.graphs.star import Star

Part: TypeAlias = tuple[tuple[Ints, ...], tuple[Ints, ...]]


@dataclass(frozen=True, eq=False)
class Arrow:
    """A separator of h points and G groups of up to s points that only meet at the separator: J^T J is an arrowhead.

    Args:
        separator: (h,) points.
        group: (G, s) points, -1 where a group is smaller.
        corner: source block and destination (group, row, column) of the three parts, first of the blocks (i, j) that
            are taken as they are, then of those (j, i) that are transposed.
        arm: as `corner`.
        head: as `corner`.
    """

    separator: Ints
    group: Ints
    corner: Part
    arm: Part
    head: Part

    @cached_property
    def star(self) -> Star | None:
        """The same in short, if it is one whose nodes are all measured."""
        from ...kernels.graphs.star import Star

        own = len(self.corner[0][0]), len(self.head[0][0])
        if len(self.separator) != 1 or self.group.shape[1] != 1 or own != (1, len(self.group)):
            return None
        head, arm = np.empty(len(self.group), np.int64), np.full(len(self.group), -1)
        transposed = np.zeros(len(self.group), bool)
        head[self.head[0][1]] = self.head[0][0]
        for over, (source, group, *_) in enumerate(self.arm):
            arm[group], transposed[group] = source, bool(over)
        return Star(int(self.separator[0]), self.group[:, 0].copy(), int(self.corner[0][0][0]), head, arm, transposed)


def structure(problem: Problem) -> tuple[Pattern, Arrow]:
    """Pattern and arrowhead of a problem, kept for the next problems of the same structure: a drive has few."""
    factors = tuple((f.nodes.shape[1], f.nodes.tobytes()) for f in problem.factors)
    still = b"" if problem.movable is None else (~problem.movable).tobytes()
    return _structure(len(problem.names), problem.space.dof, problem.separator, factors, still)


@lru_cache(maxsize=512)
def _structure(
    n: int, dof: int, separator: tuple[int, ...], factors: tuple[tuple[int, bytes], ...], still: bytes
) -> tuple[Pattern, Arrow]:
    nodes = [np.frombuffer(raw, np.int64).reshape(-1, arity) for arity, raw in factors]
    scheme = pattern(n, nodes, np.frombuffer(still, bool).reshape(n, dof) if still else None)
    return scheme, _arrow(np.array(separator or range(n), dtype=np.int64), scheme)


def _arrow(separator: Ints, scheme: Pattern) -> Arrow:
    """Groups are what is left connected when the separator is taken out (no separator: all is separator)."""
    n = scheme.nodes
    label = _groups(n, separator, scheme.pairs)
    count = int(label.max(initial=-1)) + 1
    members = [np.flatnonzero(label == g) for g in range(count)]
    size = max((len(m) for m in members), default=0)
    group = np.full((count, size), -1, dtype=np.int64)
    place = np.empty(n, dtype=np.int64)
    place[separator] = np.arange(len(separator))
    for g, m in enumerate(members):
        group[g, : len(m)] = m
        place[m] = np.arange(len(m))
    i, j = scheme.pairs.T
    row, col = np.concatenate([scheme.pairs, scheme.pairs[i != j][:, ::-1]]).T
    source = np.concatenate([np.arange(len(i)), np.flatnonzero(i != j)])
    transposed, in_separator = np.arange(len(source)) >= len(i), label < 0

    def part(chosen: Bools) -> Part:
        kept = [np.flatnonzero(chosen & over) for over in (~transposed, transposed)]
        straight, over = ((source[k], np.maximum(label[row[k]], 0), place[row[k]], place[col[k]]) for k in kept)
        return straight, over

    return Arrow(
        separator,
        group,
        part(in_separator[row] & in_separator[col]),
        part(~in_separator[row] & in_separator[col]),
        part(~in_separator[row] & ~in_separator[col]),
    )


def _groups(n: int, separator: Ints, pairs: Ints) -> Ints:
    """(n,) group of each point, -1 for the separator."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    rest = np.ones(n, dtype=bool)
    rest[separator] = False
    edges = pairs[rest[pairs].all(axis=1)]
    graph = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    out = np.full(n, -1, dtype=np.int64)
    out[rest] = np.unique(label[rest], return_inverse=True)[1]
    return out


def _parts(frame: Arrow, blocks: Floats, damping: Floats) -> tuple[Floats, Floats, Floats]:
    """Corner (B, dh, dh), arms (B, G, ds, dh) and heads (B, G, ds, ds), damping added to the diagonal; d is dof."""
    batch, d, h, (count, size) = len(blocks), blocks.shape[-1], len(frame.separator), frame.group.shape

    def fill(part: Part, groups: int, rows: int, cols: int) -> Floats:
        out = np.zeros((batch, groups, rows, d, cols, d))
        (source, group, row, col), (transposed, *over) = part
        inside = out.swapaxes(3, 4)
        inside[:, group, row, col] = blocks[:, source]
        if len(transposed):
            inside[:, over[0], over[1], over[2]] = blocks[:, transposed].swapaxes(-1, -2)
        return out.reshape(batch, groups, d * rows, d * cols)

    corner = fill(frame.corner, 1, h, h)[:, 0]
    at = np.arange(d * h)
    corner[:, at, at] += damping[:, frame.separator].reshape(batch, -1)
    arm, head = fill(frame.arm, count, size, h), fill(frame.head, count, size, size)
    extra = np.where((frame.group >= 0)[None, :, :, None], damping[:, frame.group], 1.0)
    at = np.arange(d * size)
    head[:, :, at, at] += extra.reshape(batch, count, d * size)
    return corner, arm, head


def eliminate(frame: Arrow, blocks: Floats, gradient: Floats, damping: Floats) -> Floats:
    """dx (B, n, dof) of (J^T J + diag(damping)) dx = -gradient by the Schur complement on the separator.

    Raises:
        numpy.linalg.LinAlgError: a singular block.
    """
    corner, arm, head = _parts(frame, blocks, damping)
    batch, d = len(blocks), blocks.shape[-1]
    eta = gradient[:, frame.separator].reshape(batch, -1, 1)
    dx = np.empty_like(gradient)
    if not frame.group.size:
        dx[:, frame.separator] = -np.linalg.solve(corner, eta).reshape(batch, -1, d)
        return dx
    there = frame.group >= 0
    side = np.where(there[None, :, :, None], gradient[:, frame.group], 0.0).reshape(batch, len(frame.group), -1, 1)
    reduced = np.linalg.solve(head, np.concatenate([arm, side], axis=-1))
    taken = arm.swapaxes(-1, -2) @ reduced
    schur = corner - taken[..., :-1].sum(axis=1)
    separator = np.linalg.solve(schur, taken[..., -1:].sum(axis=1) - eta)
    rest = -(reduced[..., -1:] + reduced[..., :-1] @ separator[:, None])
    dx[:, frame.separator] = separator.reshape(batch, -1, d)
    dx[:, frame.group[there]] = rest.reshape(batch, *frame.group.shape, d)[:, there]
    return dx


def marginals(frame: Arrow, blocks: Floats, gradient: Floats) -> tuple[Floats, Floats]:
    """(B, n, dof, dof) diagonal blocks of (J^T J)^-1, and dx (B, n, dof) of J^T J dx = -gradient.

    Raises:
        numpy.linalg.LinAlgError: a singular block.
    """
    batch, d, n = len(blocks), blocks.shape[-1], len(frame.separator) + int((frame.group >= 0).sum())
    if frame.star is not None:
        return _compiled(frame.star, blocks, gradient)
    corner, arm, head = _parts(frame, blocks, np.zeros((batch, n, d)))
    cov = np.empty((batch, n, d, d))
    dx, eta = np.empty_like(gradient), gradient[:, frame.separator].reshape(batch, -1, 1)
    if not frame.group.size:
        separator = np.linalg.inv(corner)
        cov[:, frame.separator], dx[:, frame.separator] = _own(separator, d), -(separator @ eta).reshape(batch, -1, d)
        return cov, dx
    there = frame.group >= 0
    side = np.where(there[None, :, :, None], gradient[:, frame.group], 0.0).reshape(batch, len(frame.group), -1, 1)
    inverse = np.linalg.inv(head)
    reduced = inverse @ arm
    separator = np.linalg.inv(corner - (arm.swapaxes(-1, -2) @ reduced).sum(axis=1))
    transposed = reduced.swapaxes(-1, -2)
    step = separator @ ((transposed @ side).sum(axis=1) - eta)
    cov[:, frame.separator], dx[:, frame.separator] = _own(separator, d), step.reshape(batch, -1, d)
    rest = inverse @ side + reduced @ step[:, None]
    dx[:, frame.group[there]] = -rest.reshape(batch, *frame.group.shape, d)[:, there]
    rest = _own(inverse + reduced @ separator[:, None] @ transposed, d)
    cov[:, frame.group[there]] = rest[:, there]
    return cov, dx


def _compiled(star: Star, blocks: Floats, gradient: Floats) -> tuple[Floats, Floats]:
    """`marginals` of a star by the kernel; LinAlgError as there."""
    from ...kernels.graphs.star import Solved, star_marginals

    d = blocks.shape[-1]
    found = Solved(np.empty((*gradient.shape, d)), np.empty_like(gradient))
    if not star_marginals(star, blocks, gradient, found, (0,) * d).all():
        raise np.linalg.LinAlgError("a block is not positive definite")
    return found


def _own(matrix: Floats, d: int) -> Floats:
    """(..., m, d, d) diagonal blocks of (..., dm, dm)."""
    m = matrix.shape[-1] // d
    if m == 1:
        return matrix[..., None, :, :]
    split = matrix.reshape(*matrix.shape[:-2], m, d, m, d)
    at = np.arange(m)
    return np.moveaxis(split[..., at, :, at, :], 0, -3)
