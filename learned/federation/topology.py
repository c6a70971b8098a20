"""Topology: decentralised training, each client mixing its weights with those of its neighbours."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import Bools, Floats
from coopoc.errors import InputError
from coopoc.plugins import one_of
from coopoc.world.fleet import Fleet

from .guard import screen
from .participation import Participation, Turn
from .server import FLOAT32, NO_ANSWER, Exchange, Group, Standing


class Topology(ABC):
    """An undirected communication graph of the clients."""

    @abstractmethod
    def links(self, names: Sequence[str]) -> Bools:
        """(C, C) True where two clients exchange weights, symmetric, False on the diagonal."""


@dataclass(frozen=True)
class Ring(Topology):
    """Every client and its two neighbours in the order of their names.

    >>> Ring().links(["a", "b", "c", "d"]).sum(0).tolist()
    [2, 2, 2, 2]
    """

    def links(self, names: Sequence[str]) -> Bools:
        """The ring."""
        place = np.argsort(np.argsort(np.array(names)))
        gap = (place[:, None] - place) % len(names)
        return np.isin(gap, [1, len(names) - 1]) & ~np.eye(len(names), dtype=bool)


@dataclass(frozen=True)
class Complete(Topology):
    """All pairs of clients.

    >>> Complete().links(["a", "b", "c"]).sum().item()
    6
    """

    def links(self, names: Sequence[str]) -> Bools:
        """All pairs."""
        return ~np.eye(len(names), dtype=bool)


@dataclass(frozen=True)
class Pairs(Topology):
    """The named pairs.

    >>> Pairs((("a", "b"),)).links(["a", "b", "c"]).tolist()[0]
    [False, True, False]
    """

    pairs: tuple[tuple[str, str], ...]

    def links(self, names: Sequence[str]) -> Bools:
        """The pairs; InputError for an unknown client."""
        there = np.zeros((len(names), len(names)), dtype=bool)
        for pair in self.pairs:
            for name in pair:
                one_of("pairs", name, names)
            i, j = (list(names).index(name) for name in pair)
            there[i, j] = there[j, i] = i != j
        return there


@dataclass(frozen=True, eq=False)
class V2XGraph(Topology):
    """Pairs of clients that were ever within `radius` m of each other.

    Args:
        fleet: drives of the clients.
        radius: m.

    >>> t = np.arange(2) / 10
    >>> x = np.zeros((2, 3, 3)); x[:, 1, 0], x[:, 2, 0] = 20.0, 45.0
    >>> V2XGraph(Fleet(("a", "b", "c"), t, x, 0 * x), 30.0).links(["a", "b", "c"]).sum(0).tolist()
    [1, 2, 1]
    """

    fleet: Fleet
    radius: float = 30.0

    def links(self, names: Sequence[str]) -> Bools:
        """Pairs within the radius; InputError for a client that is not in the fleet."""
        at = self.fleet.position[:, [self.fleet.index(name) for name in names]]
        met = np.zeros((len(names), len(names)), dtype=bool)
        for i in range(len(names)):
            met[i] = (np.linalg.norm(at - at[:, i : i + 1], axis=-1) <= self.radius).any(0)
        return met & ~np.eye(len(names), dtype=bool)


def connected(topology: Topology, names: Sequence[str]) -> Bools:
    """Links (C, C) of the clients; InputError if the graph is not connected."""
    links = topology.links(names)
    reached = np.eye(len(names), dtype=bool)[0]
    for _ in names:
        reached = reached | links[reached].any(0)
    if not reached.all():
        apart = [name for name, there in zip(names, reached, strict=True) if not there]
        hint = "Increase the radius, or add a pair that connects them."
        raise InputError("topology", f"without a path from {names[0]} to {apart}", "must be connected", hint)
    return links


def metropolis(links: Bools) -> Floats:
    """(C, C) c_ij = 1 / max(deg_i + 1, deg_j + 1) on links, c_ii = 1 - sum_j c_ij: symmetric, rows sum to 1.

    Args:
        links: (C, C) graph.

    References:
        Xiao, Boyd, Systems and Control Letters 53, 2004, section 4.2.

    >>> metropolis(np.array([[False, True], [True, False]])).tolist()
    [[0.5, 0.5], [0.5, 0.5]]
    """
    size = links.sum(1) + 1
    mix = links / np.maximum(size[:, None], size)
    mixed: Floats = mix + np.diag(1.0 - mix.sum(1))
    return mixed


def disagreement(held: Tensor) -> float:
    """Largest distance between two rows of (C, P).

    >>> disagreement(torch.tensor([[0.0, 0.0], [3.0, 4.0]]))
    5.0
    """
    return max((float(torch.linalg.vector_norm(held - one, dim=1).max()) for one in held), default=0.0)


@dataclass(frozen=True, eq=False)
class Mesh:
    """One round without a server: adapt, then combine, theta_i <- sum_j c_ij psi_j over i and its neighbours.

    The weights c are `metropolis` among the clients that answer; the others keep their weights. Every client screens
    the weights that it receives as a server would; the share of a rejected neighbour stays with the client itself.

    Args:
        links: (C, C) graph.
        participation: of the clients.

    References:
        Chen, Sayed, IEEE TSP 60, 2012 (adapt then combine); Lian et al., NeurIPS 2017 (for nets).
    """

    links: Bools
    participation: Participation

    def __call__(
        self,
        group: Group,
        standing: Standing,
        number: int,
        turns: Sequence[Turn],
        adapted: Mapping[str, Tensor],
        reports: Sequence[float],
    ) -> tuple[Standing, Exchange]:
        """Standing after round `number`, and its exchange; arguments as of `Server`."""
        held, names = standing.held, group.names
        here = [i for i, name in enumerate(names) if name in adapted]
        near = np.zeros_like(self.links)
        near[np.ix_(here, here)] = self.links[np.ix_(here, here)]
        sent = {i: self.participation.answer(names[i], number, held[i], adapted[names[i]]) for i in here}
        share, after, usual, rejected = metropolis(near), held.clone(), list(standing.usual), dict[str, str]()
        for i in here:
            received = {names[j]: sent[j] for j in np.flatnonzero(near[i]).tolist()} | {names[i]: adapted[names[i]]}
            bad, usual[i] = screen(held[i], received, usual[i])
            own = held[i] if names[i] in bad else adapted[names[i]]
            good = {names[i]: own} | {name: weights for name, weights in received.items() if name not in bad}
            rejected |= {name: f"{reason} (at {names[i]})" for name, reason in bad.items()}
            parts = [float(share[i, names.index(name)]) * (good[name] - own) for name in sorted(good)]
            after[i] = own + torch.stack(parts).sum(0)
        traffic = {(names[j], names[i]): FLOAT32 * held.shape[1] for i, j in np.argwhere(near).tolist()}
        ordered = after[sorted(range(len(names)), key=names.__getitem__)]
        standing = replace(standing, theta=ordered.mean(0), held=after, usual=tuple(usual))
        return standing, Exchange(rejected, traffic, "" if here else NO_ANSWER)
