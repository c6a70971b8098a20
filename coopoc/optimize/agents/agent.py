"""A robot of a distributed solve: its nodes, copies of others, its measurements, and what draws the copies together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Floats, Ints
from ..algebra.sparse import Sparse, sparse
from ..descent.trust_region import arrive
from ..model.factor import Factor, unchecked
from ..model.parts import restricted
from ..model.problem import Problem
from ..model.symbolic import numbers_of
from .links import Link, makers

CLOSE = 1e-9
"""m or rad, a step at which a local solve has arrived."""


@dataclass(eq=False)
class Agent:
    """One robot.

    Args:
        robot: its label.
        nodes: (k,) of the problem that it has, its own and copies, ascending.
        own: (k,) True for its own.
        links: that end at it.
        penalty: the factor of each link, whose z moves.
        system: its measurements, then the penalties.
        x: (k, ambient).
    """

    robot: str
    nodes: Ints
    own: Ints
    links: Sequence[Link]
    penalty: Sequence[Factor]
    system: Sparse
    x: Floats

    def minimise(self, steps: int) -> None:
        """Move to the minimum of its cost and penalties, by at most some steps."""
        space = self.system.space
        moved = [
            numbers_of(unchecked(factor, z=link.goal(space, self.robot)[:, : factor.z.shape[1]]))
            for link, factor in zip(self.links, self.penalty, strict=True)
        ]
        numbers = (*self.system.numbers[: len(self.system.numbers) - len(moved)], *moved)
        self.x = arrive(replace(self.system, numbers=numbers), self.x, steps, CLOSE).x

    def at(self, nodes: Ints) -> Floats:
        """(K, ambient) its copies of nodes of the problem."""
        return self.x[np.searchsorted(self.nodes, nodes)]


def agents_of(problem: Problem, owner: tuple[str, ...], links: Sequence[Link]) -> list[Agent]:
    """The robots of a problem.

    Raises:
        InputError: a formula that CasADi cannot run.
    """
    by = makers(problem, owner)
    labels = np.array(owner)
    found = []
    for robot in dict.fromkeys(owner):
        rows = [np.flatnonzero(labels[maker] == robot) for maker in by]
        used = labels == robot
        for factor, own in zip(problem.factors, rows, strict=True):
            used[factor.nodes[own]] = True
        mine = [link for link in links if robot in link.ends]
        local = restricted(problem, used, np.array(problem.x0), rows)
        nodes = np.flatnonzero(used)
        points = [k for link in mine if robot == link.ends[1] and not link.turns for k in link.nodes.tolist()]
        poses = np.setdiff1d(local.poses, np.searchsorted(nodes, points))
        penalty = [_penalty(problem, link, np.searchsorted(nodes, link.nodes)) for link in mine]
        local = local.replace_unchecked(poses=tuple(poses.tolist()), factors=(*local.factors, *penalty))
        system = sparse(local)
        found.append(Agent(robot, nodes, labels[nodes] == robot, mine, penalty, system, np.array(local.x0)))
    return found


def _penalty(problem: Problem, link: Link, rows: Ints) -> Factor:
    """Of copies towards where a link wants them."""
    space, kind = problem.space, "pose" if link.turns else "position"
    z = link.mean if link.turns else space.position(link.mean)
    any_of_its_kind = Factor(kind, rows[:, None], z, std=np.ones_like(link.information))
    return unchecked(any_of_its_kind, std=1.0 / np.sqrt(link.information))
