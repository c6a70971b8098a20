"""Which nodes robots share, and what two ends of a link agree upon: the mean of both copies, and duals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays import Floats, Ints
from ...errors import InputError
from ..model.problem import Problem
from ..model.space import Space, log


@dataclass(eq=False)
class Link:
    """Nodes of one robot that another has copies of: all with their rotation, or all without.

    Args:
        ends: the owner, then the observer.
        nodes: (K,) of the problem.
        turns: the copies have a rotation.
        information: (K, size) of the observer's measurements of each, times rho: 1/m^2, then 1/rad^2.
        mean: (K, ambient) z.
        dual: (K, dof) u of the owner; the observer's is minus it.
    """

    ends: tuple[str, str]
    nodes: Ints
    turns: bool
    information: Floats
    mean: Floats
    dual: Floats

    @property
    def numbers(self) -> int:
        """That a message holds."""
        return int(self.information.size)

    def goal(self, space: Space, robot: str) -> Floats:
        """(K, ambient) z - u, towards which the copies of one end are drawn."""
        return space.retract(self.mean, -self.dual if robot == self.ends[0] else self.dual)

    def agree(self, space: Space, own: Floats, other: Floats) -> float:
        """Take the mean of the owner's and the observer's copies (K, ambient), move the dual, return their distance."""
        gap = difference(space, own, other)
        gap[:, self.information.shape[1] :] = 0.0
        self.mean = space.retract(own, -0.5 * gap)
        self.dual = self.dual + 0.5 * gap
        return float(np.abs(gap).max(initial=0.0))


def difference(space: Space, x: Floats, y: Floats) -> Floats:
    """(K, dof) p_x - p_y and Log(R_y^T R_x): the step from y to x.

    >>> space = Space(2, has_rotation=True)
    >>> difference(space, np.array([[1.0, 0, 0, -1, 1, 0]]), np.array([[0.0, 0, 1, 0, 0, 1]])).round(3)
    array([[1.   , 0.   , 1.571]])
    """
    gap = space.position(x) - space.position(y)
    if not space.has_rotation:
        return gap
    return np.concatenate([gap, log(np.swapaxes(space.rotation(y), -1, -2) @ space.rotation(x))], axis=-1)


def makers(problem: Problem, owner: tuple[str, ...]) -> list[Ints]:
    """(M,) of each factor the place of the node whose owner measured it: the first pose, or the first node.

    Raises:
        InputError: fewer or more owners than nodes.
    """
    if len(owner) != len(problem.names):
        raise InputError("owner", f"{len(owner)} labels", f"must be {len(problem.names)}", "Give one per node.")
    is_pose = np.zeros(len(problem.names), dtype=bool)
    is_pose[list(problem.poses)] = True
    return [f.nodes[np.arange(len(f.nodes)), np.argmax(is_pose[f.nodes], axis=1)] for f in problem.factors]


def links_of(problem: Problem, owner: tuple[str, ...], rho: float) -> list[Link]:
    """A link for every pair of owner and observer, two where some copies have a rotation and others have none."""
    space, x0 = problem.space, np.array(problem.x0)
    linear, seen = problem.linearise(x0[None]), dict[tuple[str, int], Floats]()
    for factor, maker, jacobians in zip(problem.factors, makers(problem, owner), linear.jacobian, strict=True):
        for column, jacobian in zip(factor.nodes.T, jacobians, strict=True):
            square = np.broadcast_to(np.square(jacobian[0]).sum(axis=-2), (len(column), space.dof))
            for row, (node, by) in enumerate(zip(column.tolist(), maker.tolist(), strict=True)):
                if owner[node] != owner[by] and node not in problem.fixed:
                    seen[owner[by], node] = seen.get((owner[by], node), 0.0) + square[row]
    groups: dict[tuple[str, str, bool], list[int]] = {}
    for observer, node in sorted(seen):
        turns = bool(seen[observer, node][space.dimension :].any())
        groups.setdefault((owner[node], observer, turns), []).append(node)
    found = []
    for (own, observer, turns), nodes in groups.items():
        square = np.stack([seen[observer, node] for node in nodes])
        parts = [square[:, : space.dimension], square[:, space.dimension :]][: 1 + turns]
        information = np.concatenate([np.repeat(p.mean(axis=1, keepdims=True), p.shape[1], 1) for p in parts], axis=1)
        at = x0[nodes]
        found.append(
            Link((own, observer), np.array(nodes), turns, rho * information, at, np.zeros((len(nodes), space.dof)))
        )
    return found
