"""The clients' half of a round: local training, of one client or of all clients as one stack."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import Ints
from coopoc.world.sensors import stream

from ..nets.gain import Gain
from ..training.clients import Client, Segments
from ..training.fit import Judge, descend, pooled
from ..training.machine import one_core
from ..training.schedule import Schedule, cosine, generator


def local_fit(
    model: Gain,
    theta: Tensor,
    client: Client,
    seed: int,
    number: int,
    rounds: int,
    local: Schedule,
) -> tuple[Tensor, float, str | None]:
    """The client's half of round `number`: its weights after local training, from theta (P,) and its own pieces.

    The result equals the client's row of `adapt` bit for bit, for nets whose gradients do not depend on the other rows.

    Args:
        model: shape of the net.
        theta: (P,) received weights, not changed.
        client: with its pieces.
        seed: of the federation.
        number: of the round.
        rounds: in all.
        local: schedule with the local epochs.

    Returns:
        Weights (P,), mean training loss m^2, and why the training failed (None: it did not).
    """
    weights, members, key = theta.detach().clone()[None], [np.arange(len(client.training))], [(seed, client.name)]
    with one_core():
        loss, stopped = adapt(weights, model, client.training, members, key, number, rounds, local)
    return weights[0], loss[0], stopped.get(0)


def adapt(
    theta: Tensor,
    like: Gain,
    pool: Segments,
    members: Sequence[Ints],
    keys: Sequence[tuple[int, str]],
    number: int,
    rounds: int,
    local: Schedule,
) -> tuple[list[float], dict[int, str]]:
    """Local training of every client in round `number`, in place: a pure function of weights, data and (seed, client).

    Args:
        theta: (S, P) weights.
        like: shape of the net.
        pool: pieces of all clients.
        members: (S,) indices of each client's pieces in the pool.
        keys: (S,) seed and name of each client.
        number: of the round.
        rounds: in all.
        local: schedule with the local epochs.

    Returns:
        Mean training loss (S,) m^2, NaN for a row whose training failed, and the reasons of those.
    """
    streams = [stream(seed, "batches", number - 1, name) for seed, name in keys]
    plans = [rows[local.plan(len(rows), draw)] for rows, draw in zip(members, streams, strict=True)]
    span = (number - 1) / rounds, number / rounds
    rates = [local.learning_rate * cosine(len(plan), *span) for plan in plans]
    draws, stopped = [generator(draw) for draw in streams], dict[int, str]()
    losses = torch.stack([loss for _, loss in descend(theta, like, pool, plans, rates, local, draws, stopped)], 1)
    means = [math.nan if r in stopped else float(losses[r, : len(plan)].mean()) for r, plan in enumerate(plans)]
    return means, stopped


class Work(NamedTuple):
    """Local training of a federation: weights (P,) by name, training losses (C,) m^2, reasons of failures."""

    weights: dict[str, Tensor]
    losses: tuple[float, ...]
    failed: dict[str, str]


class Group(NamedTuple):
    """The clients of a federation: names, training pieces of each, and the seed of all draws."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    seed: int


class Stack(NamedTuple):
    """All clients of all federations as rows of one stack."""

    like: Gain
    teams: Sequence[Group]
    pool: Segments
    members: Sequence[Ints]
    judge: Judge

    def validated(self, thetas: Sequence[Tensor]) -> list[tuple[float, ...]]:
        """Validation losses (C,) m^2 of each federation's weights (P,), by its own clients."""
        scores = self.judge(self._rows(thetas))
        return [tuple(part.tolist()) for part in scores.split([len(team.names) for team in self.teams])]

    def adapted(
        self, thetas: Sequence[Tensor], asked: Sequence[frozenset[str]], number: int, rounds: int, local: Schedule
    ) -> list[Work]:
        """Local training of all clients that are asked in a round, as one stack."""
        keys = [(i, team.seed, name) for i, team in enumerate(self.teams) for name in team.names]
        rows = [row for row, (i, _, name) in enumerate(keys) if name in asked[i]]
        theta, members = self._rows(thetas)[rows], [self.members[row] for row in rows]
        seeds = [keys[row][1:] for row in rows]
        losses, stopped = adapt(theta, self.like, self.pool, members, seeds, number, rounds, local)
        works = []
        trained = {keys[row][::2]: at for at, row in enumerate(rows)}
        for i, team in enumerate(self.teams):
            here = {name: trained[i, name] for name in team.names if name in asked[i]}
            weights = {name: theta[at] for name, at in here.items() if at not in stopped}
            own = tuple(losses[here[name]] if name in here else math.nan for name in team.names)
            works.append(Work(weights, own, {name: stopped[at] for name, at in here.items() if at in stopped}))
        return works

    def _rows(self, thetas: Sequence[Tensor]) -> Tensor:
        """(S, P) weights of every client, those of its federation."""
        pairs = zip(thetas, self.teams, strict=True)
        return torch.cat([theta.expand(len(team.names), -1) for theta, team in pairs])


def stacked(like: Gain, groups: Sequence[Sequence[Client]], teams: Sequence[Group]) -> Stack:
    """The clients of all federations, stacked."""
    clients = [client for group in groups for client in group]
    pool, members = pooled([c.training for c in clients])
    judge = Judge([[c.validation for c in clients], [c.long for c in clients]], like)
    return Stack(like, teams, pool, members, judge)
