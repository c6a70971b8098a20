"""Distributed solves by consensus ADMM: each robot holds its own part, pairs that share nodes exchange their copies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats, Ints, instance, number
from ..errors import InputError
from ..short_repr import short_repr
from .algebra.sparse import Sparse, sparse
from .descent.levenberg_marquardt import arrive
from .model.derivatives import numbers_of
from .model.factor import Factor, unchecked
from .model.problem import Problem
from .model.space import Space, log

BYTES = 8
"""Of a number that is sent."""
CLOSE = 1e-9
"""m or rad, a step at which a local solve has arrived."""


@dataclass(frozen=True, eq=False)
class Distributed:
    """Where the robots are after each round; the first entry is before any.

    Args:
        x: (n, ambient) every node as its owner has it at the end.
        cost: (rounds + 1,) of the whole problem with every node as its owner has it.
        apart: (rounds + 1,) m or rad, largest difference between two copies of a node.
        messages: (rounds + 1,) sent so far by all robots.
        sent_bytes: (rounds + 1,) in these messages.
        robots: the labels of the owners.
    """

    x: Floats
    cost: Floats
    apart: Floats
    messages: Ints
    sent_bytes: Ints
    robots: tuple[str, ...]

    __repr__ = short_repr


def solve_distributed(
    problem: Problem,
    owner: Sequence[str] | None = None,
    rounds: int = 100,
    rho: float = 0.3,
    steps: int = 5,
    loss: float = 0.0,
    seed: int = 0,
) -> Distributed:
    """A minimum of the problem by consensus ADMM with a copy of a shared node at either end of a link between robots.

    Robot i minimises f_i, the cost of what it measured, over its nodes and its copies of others' nodes. For the copies
    y of node k at the two ends of a link, with z between them and scaled duals u in the tangent space,

        y_i = argmin f_i + sum 1/2 |y_ik - z_k + u_ik|^2_B,   z_k = mean of both y_k,   u_ik += y_ik - z_k

    (Exp and Log understood), B = rho times the information of the observer's measurements of k, which weighs metres and
    radians as the problem does. Both ends compute the same z and opposite u, so that a message holds copies alone: d
    numbers of a point or of a pose that is only ranged, d plus angles of another pose. A link whose exchange is lost
    keeps z and u. Factors may have robust losses, which the local solves then minimise.

    Args:
        problem: a single one with an x0, which all robots know for the nodes that they measure.
        owner: (n,) the robot of each node; None: the letter of its name, and of a node without poses of its letter (a
            landmark) the first robot that measures it.
        rounds: of a local solve and an exchange on every link.
        rho: the penalty; large values agree quickly and move slowly.
        steps: of each local solve, at most.
        loss: probability that the exchange on a link is lost in a round.
        seed: of the losses.

    Raises:
        InputError: no x0, B realisations, constraints, rho not > 0, loss outside [0, 1), rounds, steps or a seed that
            are no whole numbers, another number of owners, or a formula that CasADi cannot run.

    References:
        Boyd et al., Distributed Optimization and Statistical Learning via the ADMM, 2011, section 7; McGann, Lassak and
        Kaess, Asynchronous Distributed Smoothing and Mapping via On-Manifold Consensus ADMM (MESA), ICRA 2024.

    >>> problem = Problem(("a0", "b0"), x0=np.array([[0.0, 0.0], [4.0, 0.0]]), dimension=2)
    >>> problem = problem.add("position", ["a0", "b0"], [[0, 0], [4, 0]], std=1.0)
    >>> problem = problem.add("displacement", ("a0", "b0"), [7, 0], std=1.0)
    >>> solve_distributed(problem, owner="ab").x.round(3)[:, 0] + 0.0
    array([-1.,  5.])
    """
    _check(problem)
    rho = number("rho", rho, 1e-12, allowed="> 0", hint="Leave it out for 0.3.")
    loss = number("loss", loss, 0.0, 1.0 - 1e-12, allowed=">= 0 and < 1", hint="It is a probability.")
    rounds, steps, seed = (
        number(field, value, least, kind=int, allowed=f">= {least}")
        for field, value, least in (("rounds", rounds, 0), ("steps", steps, 1), ("seed", seed, 0))
    )
    labels = owners(problem) if owner is None else tuple(owner)
    links = links_of(problem, labels, rho)
    agents = {agent.robot: agent for agent in agents_of(problem, labels, links)}
    pairs = [tuple(sorted(link.ends)) for link in links]
    once = 2 * len(set(pairs)), 2 * BYTES * sum(link.information.size for link in links)
    system, rng, x = sparse(problem), np.random.default_rng(seed), np.array(problem.x0)
    cost, apart = [problem.cost(x)], [0.0]
    for _ in range(rounds):
        for agent in agents.values():
            agent.minimise(steps)
        arrived = {pair: rng.random() >= loss for pair in dict.fromkeys(pairs)}
        gaps = [0.0]
        for link, pair in zip(links, pairs, strict=True):
            if arrived[pair]:
                gaps.append(link.agree(problem.space, *(agents[end].at(link.nodes) for end in link.ends)))
        apart.append(max(gaps))
        for agent in agents.values():
            x[agent.nodes[agent.own]] = agent.x[agent.own]
        cost.append(system.cost(x))
    messages, sent_bytes = np.outer(once, np.arange(rounds + 1))
    return Distributed(x, np.array(cost), np.array(apart), messages, sent_bytes, tuple(agents))


def owners(problem: Problem) -> tuple[str, ...]:
    """(n,) the letter of each node's name; of a point among poses that of the first pose measured with it.

    >>> from coopoc.optimize import pose
    >>> problem = Problem(("a0", "L0"), x0=pose(np.zeros((2, 2))), dimension=2, poses=(0,))
    >>> owners(problem.add("range", ("a0", "L0"), 5.0, std=1.0))
    ('a', 'a')
    """
    labels = [name[0] for name in problem.names]
    poses = set(problem.poses)
    waiting = set(range(len(labels))) - poses if poses else set()
    for factor in problem.factors:
        for pair in factor.nodes.tolist() if factor.nodes.shape[1] == 2 and waiting else ():
            for point, other in (pair, pair[::-1]):
                if point in waiting and other in poses:
                    labels[point] = labels[other]
                    waiting.discard(point)
    return tuple(labels)


def _check(problem: Problem) -> None:
    instance("problem", problem, Problem)
    if problem.batch is not None or problem.constraints or problem.x0 is None:
        hint = "Pick one realisation, give an x0, and leave constraints to solve."
        raise InputError("problem", repr(problem), "must be a single one with an x0 and no constraints", hint)


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

    def goal(self, space: Space, robot: str) -> Floats:
        """(K, ambient) z - u, towards which the copies of one end are drawn."""
        return space.retract(self.mean, -self.dual if robot == self.ends[0] else self.dual)

    def agree(self, space: Space, own: Floats, other: Floats) -> float:
        """Take the mean of the owner's and the observer's copies (K, ambient), move the dual, return their distance."""
        gap = _difference(space, own, other)
        gap[:, self.information.shape[1] :] = 0.0
        self.mean = space.retract(own, -0.5 * gap)
        self.dual = self.dual + 0.5 * gap
        return float(np.abs(gap).max(initial=0.0))


def _difference(space: Space, x: Floats, y: Floats) -> Floats:
    """(K, dof) p_x - p_y and Log(R_y^T R_x): the step from y to x."""
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
    labels, found = np.array(owner), []
    for robot in dict.fromkeys(owner):
        rows = [np.flatnonzero(labels[maker] == robot) for maker in by]
        used = labels == robot
        for factor, own in zip(problem.factors, rows, strict=True):
            used[factor.nodes[own]] = True
        mine = [link for link in links if robot in link.ends]
        local = problem.restricted(used, np.array(problem.x0), rows)
        nodes = np.flatnonzero(used)
        points = [k for link in mine if robot == link.ends[1] and not link.turns for k in link.nodes.tolist()]
        poses = np.setdiff1d(local.poses, np.searchsorted(nodes, points))
        penalty = [_penalty(problem, link, np.searchsorted(nodes, link.nodes)) for link in mine]
        local = local.replace_unchecked(poses=tuple(poses.tolist()), factors=(*local.factors, *penalty))
        found.append(Agent(robot, nodes, labels[nodes] == robot, mine, penalty, sparse(local), np.array(local.x0)))
    return found


def _penalty(problem: Problem, link: Link, rows: Ints) -> Factor:
    """Of copies towards where a link wants them."""
    space, kind = problem.space, "pose" if link.turns else "position"
    z = link.mean if link.turns else space.position(link.mean)
    any_of_its_kind = Factor(kind, rows[:, None], z, std=np.ones_like(link.information))
    return unchecked(any_of_its_kind, std=1.0 / np.sqrt(link.information))
