"""The clients' half of a round: local training, of one client or of all clients as one stack."""

from __future__ import annotations

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
from .participation import Turn
from .server import Group, Standing


def local_fit(
    model: Gain,
    theta: Tensor,
    client: Client,
    seed: int,
    number: int,
    rounds: int,
    local: Schedule,
    share: float = 1.0,
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
        local: schedule as `Rule.local` gives it, with the local epochs.
        share: of the steps that are made.

    Returns:
        Weights (P,), mean training loss m^2, and why the training failed (None: it did not).
    """
    weights, members, key = theta.detach().clone()[None], [np.arange(len(client.training))], [(seed, client.name)]
    with one_core():
        loss, stopped = adapt(weights, model, client.training, members, key, number, rounds, local, [share])
    return weights[0], float(loss[0]), stopped.get(0)


def adapt(
    theta: Tensor,
    like: Gain,
    pool: Segments,
    members: Sequence[Ints],
    keys: Sequence[tuple[int, str]],
    number: int,
    rounds: int,
    local: Schedule,
    shares: Sequence[float] | None = None,
) -> tuple[Tensor, dict[int, str]]:
    """Local training of every client in round `number`, in place: a pure function of weights, data and (seed, client).

    Args:
        theta: (S, P) weights.
        like: shape of the net.
        pool: pieces of all clients.
        members: (S,) indices of each client's pieces in the pool.
        keys: (S,) seed and name of each client.
        number: of the round.
        rounds: in all.
        local: schedule as `Rule.local` gives it.
        shares: (S,) of the steps that each client makes, at least one; default all.

    Returns:
        Mean training loss (S,) m^2, NaN for a row whose training failed, and the reasons of those.
    """
    streams = [stream(seed, "batches", number - 1, name) for seed, name in keys]
    plans = [rows[local.plan(len(rows), draw)] for rows, draw in zip(members, streams, strict=True)]
    span = (number - 1) / rounds, number / rounds
    rates = [local.learning_rate * cosine(len(plan), *span) for plan in plans]
    made = shares or [1.0] * len(plans)
    plans = [plan[: math.ceil(share * len(plan))] for plan, share in zip(plans, made, strict=True)]
    draws, stopped = [generator(draw) for draw in streams], dict[int, str]()
    losses = torch.stack([loss for _, loss in descend(theta, like, pool, plans, rates, local, draws, stopped)], 1)
    means = [math.nan if r in stopped else losses[r, : len(plan)].mean() for r, plan in enumerate(plans)]
    return torch.tensor(means), stopped


class Work(NamedTuple):
    """Local training of a federation: weights (P,) by name, training losses (C,) m^2, reasons of failures."""

    weights: dict[str, Tensor]
    losses: tuple[float, ...]
    failed: dict[str, str]


class Stack(NamedTuple):
    """All clients of all federations as rows of one stack."""

    like: Gain
    teams: Sequence[Group]
    pool: Segments
    members: Sequence[Ints]
    judge: Judge

    def validated(self, standings: Sequence[Standing]) -> list[tuple[float, ...]]:
        """Validation losses (C,) m^2 of each federation's weights, by its own clients."""
        scores = self.judge(torch.cat([s.theta.expand_as(s.held) for s in standings]))
        return [tuple(part.tolist()) for part in scores.split([len(team.names) for team in self.teams])]

    def adapted(
        self, standings: Sequence[Standing], turns: Sequence[Sequence[Turn]], number: int, rounds: int, local: Schedule
    ) -> list[Work]:
        """Local training of all clients that answer in a round, as one stack."""
        keys = [(team.seed, name) for team in self.teams for name in team.names]
        shares = [turn.share for group in turns for turn in group]
        rows = [row for row, share in enumerate(shares) if share > 0]
        theta, losses, stopped = torch.cat([s.held for s in standings]), torch.full((len(keys),), math.nan), {}
        if rows:
            active, members = theta[rows], [self.members[r] for r in rows]
            names, made = [keys[r] for r in rows], [shares[r] for r in rows]
            losses[rows], failed = adapt(active, self.like, self.pool, members, names, number, rounds, local, made)
            theta[rows], stopped = active, {rows[i]: reason for i, reason in failed.items()}
        found, at = [], 0
        for team in self.teams:
            span, at = range(at, at + len(team.names)), at + len(team.names)
            done = {keys[r][1]: theta[r] for r in span if shares[r] > 0 and r not in stopped}
            reasons = {keys[r][1]: stopped[r] for r in span if r in stopped}
            found.append(Work(done, tuple(losses[span.start : span.stop].tolist()), reasons))
        return found


def stacked(like: Gain, groups: Sequence[Sequence[Client]], teams: Sequence[Group]) -> Stack:
    """The clients of all federations, stacked."""
    clients = [client for group in groups for client in group]
    pool, members = pooled([c.training for c in clients])
    judge = Judge([[c.validation for c in clients], [c.long for c in clients]], like)
    return Stack(like, teams, pool, members, judge)
