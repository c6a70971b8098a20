"""Active constraints at a point: their multipliers, the directions that remain, and the largest violation."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..model.factor import as_factor, bounded, stacked
from ..model.problem import Problem, linearised

ACTIVE_STEP = 5e-7
"""m or rad, a step this long reaches the bound: the constraint is active."""
DEPENDENT = 1e-9
"""Singular value, of rows of length 1, below which they are dependent."""


class Rows(NamedTuple):
    """All numbers of a problem that are bounded, at x.

    Attributes:
        value: (rows,).
        lower: as `value`.
        upper: as `value`.
        matrix: (rows, n dof) sparse derivative of the values by the steps.
        origin: (rows, 3) constraint, row of its nodes and component.
    """

    value: Floats
    lower: Floats
    upper: Floats
    matrix: Any
    origin: Ints

    @property
    def sides(self) -> tuple[Floats, Floats]:
        """(rows,) bounds of what a step may add to each."""
        return self.lower - self.value, self.upper - self.value

    @property
    def outside(self) -> Floats:
        """(rows,) by how much each is violated."""
        low, high = self.sides
        return np.maximum(np.maximum(low, -high), 0.0)


class Active(NamedTuple):
    """The constraints that hold at x: equalities, and the inequalities with a multiplier.

    Attributes:
        rows: all numbers that are bounded.
        multipliers: (rows,) of them, the gradient of the cost plus matrix^T multipliers vanishes at a minimum; at a
            lower bound they are <= 0, at an upper one >= 0.
        onto: (n dof,) the least step onto what holds.
        along: (n dof, k) sparse, orthonormal directions in which all that holds stays as it is.
        exact: the same for the equalities alone.
        violated: the constraint that is violated most, in words.
    """

    rows: Rows
    multipliers: Floats
    onto: Floats
    along: Any
    exact: Any
    violated: str


def constraint_rows(problem: Problem, x: Floats) -> Rows:
    """The constraints of a problem at x (n, ambient)."""
    items = problem.constraints
    part = problem.replace_unchecked(factors=tuple(map(as_factor, items)))
    (linear, J), finite = linearised(part, x), stacked(bounded(item).ravel() for item in items)
    values = [residual + item.middle for residual, item in zip(linear.residual, items, strict=True)]
    value, lower, upper = (
        stacked(side.ravel() for side in sides)[finite]
        for sides in (values, [item.lower for item in items], [item.upper for item in items])
    )
    origin = [np.insert(np.argwhere(bounded(item)), 0, k, axis=1) for k, item in enumerate(items)]
    return Rows(value, lower, upper, J[finite], np.concatenate(origin))


def active_at(problem: Problem, x: Floats, gradient: Floats) -> Active:
    """The constraints that hold at x (n, ambient), where the gradient of the cost is (n, dof).

    Multipliers are the least-squares ones with the signs that a minimum needs; an inequality that does not push does
    not hold. Constraints that share no direction are looked at apart from each other.
    """
    from scipy.optimize import lsq_linear

    rows = constraint_rows(problem, x)
    length = np.sqrt(rows.matrix.power(2).sum(1))
    reach = ACTIVE_STEP * length
    low, high = rows.value - rows.lower <= reach, rows.upper - rows.value <= reach
    equal, touched = rows.lower == rows.upper, np.flatnonzero((low | high) & (length > 0))
    multipliers, onto = np.zeros(len(length)), np.zeros(gradient.size)
    own_columns, along, exact = [], [], []
    for members, columns, block in _apart(rows.matrix[touched]):
        own = touched[members]
        unit, partials = block / length[own, None], gradient.ravel()[columns]
        scale = max(abs(partials).max(), 1e-300)
        bounds = np.where((low | equal)[own], -np.inf, 0.0), np.where((high | equal)[own], np.inf, 0.0)
        of_active = scale * lsq_linear(unit.T, -partials / scale, bounds, method="bvls", tol=1e-14).x
        multipliers[own] = of_active / length[own]
        pushes = equal[own] | (of_active != 0)
        gap = (rows.value - np.where(multipliers < 0, rows.lower, rows.upper))[own] / length[own]
        onto[columns], ways = _split(unit[pushes], gap[pushes])
        own_columns.append(columns)
        along.append(ways)
        exact.append(_split(unit[equal[own]], gap[equal[own]])[1])
    ways, fixed = (_directions(gradient.size, own_columns, blocks) for blocks in (along, exact))
    return Active(rows, multipliers, onto, ways, fixed, _words(problem, rows))


def _apart(matrix: Any) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Rows that share no column with the others: their numbers, their columns and the dense block."""
    from scipy.sparse.csgraph import connected_components

    matrix.eliminate_zeros()
    count, label = connected_components(abs(matrix) @ abs(matrix).T, directed=False)
    for group in range(count):
        members = np.flatnonzero(label == group)
        part = matrix[members]
        columns = np.unique(part.indices)
        yield members, columns, part[:, columns].toarray()


def _split(unit: Floats, gap: Floats) -> tuple[Floats, Floats]:
    """The least step that undoes the gaps of the rows, and orthonormal directions (columns) that no row sees.

    >>> _split(np.array([[2.0, 0.0]]), np.array([4.0]))[0].round()
    array([-2.,  0.])
    """
    left, values, right = np.linalg.svd(unit)
    rank = int((values > DEPENDENT).sum())
    return -right[:rank].T @ ((left[:, :rank].T @ gap) / values[:rank]), right[rank:].T


def _directions(size: int, columns: list[Ints], blocks: list[Floats]) -> Any:
    """(size, k) sparse: the blocks' directions on their columns, and each coordinate that is in no block."""
    from scipy.sparse import block_diag, eye_array

    own = stacked(columns)
    rest = np.setdiff1d(np.arange(size), own)
    return block_diag([*blocks, eye_array(len(rest))], format="csr")[np.argsort(np.r_[own, rest])].tocsc()


def _words(problem: Problem, rows: Rows) -> str:
    """Which constraint is violated most, of which nodes, and by how much."""
    worst = rows.outside.argmax()
    k, row, component = rows.origin[worst].tolist()
    item = problem.constraints[k]
    below = rows.value[worst] < rows.lower[worst]
    side, bound = ("below its lower", rows.lower[worst]) if below else ("above its upper", rows.upper[worst])
    which = f", component {component}," * (item.lower.shape[1] > 1)
    nodes = f"{item.kind} of {' and '.join(problem.names[n] for n in item.nodes[row])}"
    return f"{nodes}{which} is {rows.outside[worst]:.3g} {side} bound {bound:.6g}"
