"""A graph solved by its robots: each holds its own part, and pairs of robots that share nodes exchange their copies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Floats, Ints, instance, number
from ...errors import InputError
from ...short_repr import short_repr
from ..algebra.sparse import sparse
from ..model.problem import Problem
from .agent import Agent, agents_of
from .links import Link, links_of

BYTES = 8
"""Of a number that is sent."""


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
    size: dict[tuple[str, ...], int] = {}
    for link in links:
        size[_pair(link)] = size.get(_pair(link), 0) + BYTES * link.numbers
    system, rng, x = sparse(problem), np.random.default_rng(seed), np.array(problem.x0)
    cost, apart, sent = [problem.cost(x)], [0.0], [(0, 0)]
    for _ in range(rounds):
        for agent in agents.values():
            agent.minimise(steps)
        arrived = {pair for pair in size if rng.random() >= loss}
        apart.append(max((_agree(problem, link, agents) for link in links if _pair(link) in arrived), default=0.0))
        for agent in agents.values():
            x[agent.nodes[agent.own]] = agent.x[agent.own]
        cost.append(system.cost(x))
        sent.append((2 * len(size), 2 * sum(size.values())))
    messages, sent_bytes = np.cumsum(sent, axis=0).T
    return Distributed(x, np.array(cost), np.array(apart), messages, sent_bytes, tuple(agents))


def owners(problem: Problem) -> tuple[str, ...]:
    """(n,) the letter of each node's name; of a point among poses that of the first pose measured with it.

    >>> from ..model.space import pose
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


def _pair(link: Link) -> tuple[str, ...]:
    return tuple(sorted(link.ends))


def _agree(problem: Problem, link: Link, agents: Mapping[str, Agent]) -> float:
    """Exchange the copies of a link; how far they were apart."""
    own, other = (agents[end].at(link.nodes) for end in link.ends)
    return link.agree(problem.space, own, other)


def _check(problem: Problem) -> None:
    instance("problem", problem, Problem)
    if problem.batch is not None or problem.constraints or problem.x0 is None:
        hint = "Pick one realisation, give an x0, and leave constraints to solve."
        raise InputError("problem", repr(problem), "must be a single one with an x0 and no constraints", hint)
